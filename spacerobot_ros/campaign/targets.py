"""Quantities that a campaign can disperse, by name, and the effect of each quantity on a flight."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any
from xml.etree.ElementTree import canonicalize

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError, counted
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.rotations import quaternion_from_rotvec, quaternion_multiply
from spacerobot_ros.model.shared_parameters import RobotConfig
from spacerobot_ros.model.urdf import load_robot, parse_robot
from spacerobot_ros.parameters import Parameter, declared, values_of
from spacerobot_ros.planning import Goal
from spacerobot_ros.resources import is_path, robot_file, suggestion
from spacerobot_ros.scenario import CONFIGS, Scenario
from spacerobot_ros.simulation.capture import load_target, target_parameters
from spacerobot_ros.simulation.faults import (
    FAULT_KINDS,
    Fault,
    FaultTargets,
    edited_fault,
    parse_fault,
)

AXES = ("x", "y", "z")

_INDEXED_NAME_PATTERN = re.compile(r"(.+)\[([^\]]+)\]")
_FAULT_NAME_PATTERN = re.compile(r"faults\[(\d+)\]\.(at|until|value|kind|target|present)")
_PARAMETERS_EQUAL_IN_ALL_FLIGHTS = (
    *("plant.robot", "plant.robot_description", "plant.time_mode", "plant.resume_bag"),
    *("planner.resume_file", "coordinated_control.resume_file"),
)

_POSE_TARGET_NAMES = ("goal", "end_effector_goal", "initial")

_TARGET_NAMES = (
    "NODE.PARAMETER; mass, mass.BODY, mass.*; inertia, inertia.BODY, inertia.*; com.BODY.AXIS, "
    "com.*; target.mass, target.inertia; target.com.AXIS; goal.position.AXIS, goal.rotvec.AXIS; "
    "end_effector_goal. ...; initial.position.AXIS, initial.rotvec.AXIS; initial.joints.JOINT; "
    "faults[i].at, .until, .value, .kind, .target; faults[i].present"
)
"""Kinds of names, for users."""


@dataclass(frozen=True)
class DispersionTarget:
    """One number (or string) that differs between flights.

    Attributes
    ----------
    name, unit
        Name of its column, and unit, for people.
    apply
        Function that applies a drawn value to a flight.
    weigh
        Function that applies the drawn values (N,) of N flights to their mass properties; if given,
        the target changes nothing else.
    assigned_parameters
        Names of the values that the target sets; targets that set the same value share a name. By
        default, the name of the target.
    is_text
        Whether the values are strings.
    order
        Targets are applied in ascending order.
    """

    name: str
    unit: str
    apply: Callable[[DrawnFlight, Any], DrawnFlight] = lambda flight, drawn: flight
    weigh: Callable[[MassFactors, Array], None] | None = None
    assigned_parameters: frozenset[str] = frozenset()
    is_text: bool = False
    order: int = 0

    def __post_init__(self) -> None:
        if not self.assigned_parameters:
            object.__setattr__(self, "assigned_parameters", frozenset({self.name}))


@dataclass(frozen=True)
class MassFactors:
    """Changes in the mass properties of N flights; targets write into the arrays.

    Attributes
    ----------
    mass, inertia
        (N, B) factors for each body; the inertia is multiplied by both.
    com
        (N, B, 3) centre of mass offsets, m.
    """

    mass: Array
    inertia: Array
    com: Array

    @classmethod
    def of(cls, flights: int, bodies: int) -> MassFactors:
        """Return no changes."""
        ones = np.ones((flights, bodies))
        return cls(ones, ones.copy(), np.zeros((flights, bodies, 3)))

    @property
    def differ(self) -> npt.NDArray[np.bool_]:
        """(N,) whether the mass properties differ from those of the nominal robot."""
        changed = (self.mass != 1.0) | (self.inertia != 1.0) | self.com.any(axis=-1)
        return np.asarray(changed.any(axis=-1))

    def applied_to(self, nominal: InertialParameters) -> InertialParameters:
        """Return the mass properties of the flights, given those of the nominal robot."""
        scaled = nominal.scaled(self.mass, self.mass * self.inertia)
        moved = np.asarray(self.com.any(axis=(1, 2)))
        if not moved.any():
            return scaled
        # Where no centre moves, zeros keep their signs.
        return scaled.shifted(np.where(moved[:, np.newaxis, np.newaxis], self.com, -0.0))


@dataclass(frozen=True)
class DrawnFlight:
    """One campaign flight.

    Attributes
    ----------
    scenario
        The scenario without the plant's masses and the seed; flights whose draws do not change it
        share one object.
    nominal
        The robot without dispersions.
    inertial
        Body masses, centres of mass and inertias; None: those of the nominal robot.
    has_target_masses
        Whether the target's mass properties are drawn.
    seed
        Seed of sensor and actuator noise; None selects the seed in the scenario.
    """

    scenario: Scenario
    nominal: RobotDescription
    inertial: InertialParameters | None = None
    has_target_masses: bool = False
    seed: int | None = None

    @classmethod
    def of(cls, scenario: Scenario) -> DrawnFlight:
        """Return the flight without dispersions."""
        for node in ("plant", *scenario.commanders):
            scenario.config(node)  # Cached for all flights derived from this one.
        return cls(scenario, description_of(scenario))

    def with_overrides(self, node: str, parameters: Mapping[str, Any]) -> DrawnFlight:
        """Return the flight with different parameters for a node."""
        return replace(self, scenario=self.scenario.with_overrides(node, parameters))

    @cached_property
    def seeded_scenario(self) -> Scenario:
        """The scenario, including the flight's seed."""
        if self.seed is None:
            return self.scenario
        return self.scenario.with_overrides("plant", {"sensors.seed": self.seed})

    @property
    def scenario_with_draws(self) -> Scenario:
        """The scenario, including the flight's seed, with the masses in the plant's URDF.

        Commanders keep the nominal robot unless a separate robot is configured for them. Building
        such a robot takes milliseconds, so engines without ROS use :attr:`inertial` directly.
        """
        scenario, parameters = self.seeded_scenario, self.inertial
        if parameters is not None:
            text = urdf_with(self.nominal, parameters)
            scenario = scenario.with_overrides("plant", {"robot_description": text})
            for node in scenario.commanders:
                config = scenario.config(node)
                if not (config.robot or config.robot_description):
                    believed = {"robot_description": self.nominal.urdf}
                    scenario = scenario.with_overrides(node, believed)
        return scenario


def description_of(scenario: Scenario) -> RobotDescription:
    """Return the plant's robot.

    Raises
    ------
    ParameterError
        The scenario names none.
    """
    plant = scenario.plant
    if not (plant.robot or plant.robot_description):
        raise ParameterError(
            f"the scenario '{scenario.name}' specifies no robot for its plant: set plant.robot."
        )
    return _load_description(plant.robot, plant.robot_description, plant.world)


@cache
def _load_description(robot: str, text: str, world: str) -> RobotDescription:
    described = parse_robot(text) if text else load_robot(robot_file(robot))
    return RobotConfig(world=world).described(described)


def self_contained(scenario: Scenario) -> Scenario:
    """Return the scenario with embedded robot descriptions instead of file names, for use on other
    machines, and after changes to the files.

    Descriptions are canonical XML: files that differ only in white space, comments or attribute
    order yield the same description.
    """
    for node in ("plant", *scenario.commanders):
        config = scenario.config(node)
        named = config.robot and not config.robot_description
        if config.world or (named and is_path(config.robot)):
            if config.robot_description:
                robot = parse_robot(config.robot_description)
            elif config.robot:
                robot = load_robot(robot_file(config.robot))
            else:
                robot = description_of(scenario)
            urdf = canonicalize(config.described(robot).urdf, strip_text=True)
            text = {"robot_description": urdf, "robot": "", "world": ""}
            scenario = scenario.with_overrides(node, text)
    floating = scenario.plant.target
    if is_path(floating.robot) and not floating.robot_description:
        target = load_target(floating)
        assert target is not None
        urdf = canonicalize(target.urdf, strip_text=True)
        text = {**target_parameters(urdf), "target.robot": ""}
        scenario = scenario.with_overrides("plant", text)
    return scenario


# -- names ------------------------------------------------------------------------------------


def targets_of(name: str, scenario: Scenario) -> list[DispersionTarget]:
    """Return the target with the given name, or all targets whose names match it; ``*`` stands for
    any characters.

    Raises
    ------
    ParameterError
        There is no such target (the message suggests a similar name), or the targets have
        different units.
    """
    kind, _, rest = name.partition(".")
    if kind in CONFIGS:
        return [_parameter_target(name, kind, rest, scenario)]
    match = _FAULT_NAME_PATTERN.fullmatch(name)
    if match is not None:
        return [_fault_target(name, int(match[1]), match[2], scenario)]
    if kind == "target" and not scenario.plant.target.given:
        raise ParameterError(
            f"'{name}': there is no target: the scenario '{scenario.name}' has no "
            "plant.target.robot."
        )
    if kind == "end_effector_goal" and scenario.end_effector_goal is None:
        raise ParameterError(f"'{name}': the scenario has no goal for the end-effector.")
    available = _targets_by_name(kind, scenario)
    pattern = re.compile(re.escape(name).replace(r"\*", ".+"))
    found = [target for each, target in available.items() if pattern.fullmatch(each)]
    if len(units := {target.unit for target in found}) > 1:
        raise ParameterError(
            f"'{name}' stands for quantities with different units ({', '.join(sorted(units))}): "
            "name them separately."
        )
    if found:
        return found
    if available:
        raise ParameterError(
            f"'{name}' is not one of {', '.join(available)}.{suggestion(name, available)}"
        )
    known = [f"{node}.{p.name}" for node in CONFIGS for p in declared(CONFIGS[node])]
    known += ["mass", "inertia", "com", "target.mass", "target.inertia", "target.com.x"]
    known += [*_POSE_TARGET_NAMES, "faults[0].at", "faults[0].until"]
    raise ParameterError(
        f"'{name}' cannot be dispersed; available: {_TARGET_NAMES}.{suggestion(name, known)}"
    )


def _targets_by_name(kind: str, scenario: Scenario) -> dict[str, DispersionTarget]:
    """Return all targets of a kind that is neither a node nor a fault; none for another kind."""
    bodies = [body.name for body in description_of(scenario).bodies]
    found: list[DispersionTarget] = []
    match kind:
        case "mass" | "inertia":
            every = list(range(len(bodies)))
            chosen = {kind: every, **{f"{kind}.{name}": [k] for k, name in enumerate(bodies)}}
            found = [_mass_property_target(kind, x, chosen[x], bodies) for x in chosen]
        case "com":
            found = [
                _center_target(k, column, f"com.{name}.{axis}")
                for k, name in enumerate(bodies)
                for column, axis in enumerate(AXES)
            ]
        case "target":
            parts = ("mass", "inertia", *(f"com.{axis}" for axis in AXES))
            found = [_floating_target(part) for part in parts]
        case _ if kind in _POSE_TARGET_NAMES:
            found = [
                _pose_target(kind, part, column, scenario)
                for part in ("position", "rotvec")
                for column in range(3)
            ]
            if kind == "initial":
                start = _declared("plant")["initial_joint_positions"]
                found += [
                    _entry_target(f"initial.joints.{joint}", "plant", start, k, is_offset=True)
                    for k, joint in enumerate(description_of(scenario).joint_names)
                ]
    return {target.name: target for target in found}


def _parameter_target(name: str, node: str, rest: str, scenario: Scenario) -> DispersionTarget:
    if node not in ("plant", *scenario.commanders):
        raise ParameterError(
            f"'{name}' belongs to a node that is not in use: the scenario '{scenario.name}' flies "
            f"with {' and '.join(scenario.commanders)}."
        )
    match = _INDEXED_NAME_PATTERN.fullmatch(rest)
    bare, index = (match[1], match[2]) if match else (rest, "")
    known = _declared(node)
    if bare not in known:
        raise ParameterError(f"node '{node}' has no parameter '{bare}'.{suggestion(bare, known)}")
    declaration = known[bare]
    value = values_of(scenario.config(node))[bare]
    if isinstance(value, bool) or declaration.texts:
        raise ParameterError(f"'{name}' is neither a number nor a string: it cannot be dispersed.")
    if name in _PARAMETERS_EQUAL_IN_ALL_FLIGHTS:
        raise ParameterError(f"'{name}' is the same in all flights of a campaign.")
    if isinstance(value, tuple) and bare.startswith("initial_orientation"):
        raise ParameterError(f"'{name}' is a quaternion: disperse initial.rotvec.x, y and z.")
    if isinstance(value, tuple) is not bool(index):
        how = f"name an element of the list, such as {name}[0]" if not index else "it is not a list"
        raise ParameterError(f"'{name}': {how}.")
    if index:
        return _list_entry_target(name, node, declaration, index, scenario)
    whole = isinstance(declaration.default, int)

    def apply(flight: DrawnFlight, drawn: Any) -> DrawnFlight:
        # A description, such as that of the campaign's own robot, would take precedence.
        cleared = {"robot_description": ""} if bare == "robot" else {}
        return flight.with_overrides(node, {**cleared, bare: round(drawn) if whole else drawn})

    return DispersionTarget(name, declaration.unit, apply, is_text=isinstance(value, str))


def _declared(node: str) -> dict[str, Parameter]:
    return {parameter.name: parameter for parameter in declared(CONFIGS[node])}


def _list_entry_target(
    name: str, node: str, declaration: Parameter, index: str, scenario: Scenario
) -> DispersionTarget:
    values = _list_values(name, node, declaration, scenario)
    of_joints = declaration.of_joints or (node == "plant" and declaration.length is None)
    joints = list(description_of(scenario).joint_names) if of_joints else []
    if index in joints:
        place = joints.index(index)
    elif index.isdecimal() and int(index) < len(values):
        place = int(index)
    else:
        known = f", nor one of the joints {', '.join(joints)}" if joints else ""
        raise ParameterError(
            f"'{name}': '{index}' is not an index from 0 to {len(values) - 1} of the list{known}."
            f"{suggestion(index, joints)}"
        )

    return _entry_target(name, node, declaration, place)


def _entry_target(
    name: str, node: str, declaration: Parameter, place: int, *, is_offset: bool = False
) -> DispersionTarget:
    """Return the target that replaces an element of a list parameter, or adds to it."""

    def apply(flight: DrawnFlight, drawn: Any) -> DrawnFlight:
        values = _list_values(name, node, declaration, flight.scenario)
        values[place] = values[place] + float(drawn) if is_offset else float(drawn)
        return flight.with_overrides(node, {declaration.name: values})

    one = frozenset({f"{node}.{declaration.name}[{place}]"})
    return DispersionTarget(name, declaration.unit, apply, assigned_parameters=one)


def _list_values(name: str, node: str, declaration: Parameter, scenario: Scenario) -> list[float]:
    """Return the numbers of a list parameter; an empty list for joints is zeros."""
    values = values_of(scenario.config(node))[declaration.name]
    assert isinstance(values, tuple)
    if any(isinstance(each, str) for each in values):
        raise ParameterError(
            f"'{name}': the list consists of strings NAME:VALUE; set a number for each joint "
            "under 'set'."
        )
    if values:
        return [float(x) for x in values]
    if node == "plant" and declaration.length is None:
        robot = description_of(scenario)
        zeros = np.zeros(len(robot.joint_names))
        if declaration.name == "initial_joint_positions":  # As close to zero as limits allow.
            zeros = np.clip(zeros, robot.limits("lower"), robot.limits("upper"))
        return list(zeros.tolist())
    raise ParameterError(
        f"'{name}': the list is empty, and an empty list has a special meaning: set the whole "
        "list under 'set'."
    )


def _mass_property_target(
    kind: str, name: str, places: Sequence[int], bodies: Sequence[str]
) -> DispersionTarget:
    def weigh(factors: MassFactors, drawn: Array) -> None:
        getattr(factors, kind)[:, places] *= drawn[:, np.newaxis]

    sets = frozenset(f"{kind}.{bodies[k]}" for k in places)
    return DispersionTarget(name, "1", weigh=weigh, assigned_parameters=sets)


def _center_target(index: int, column: int, name: str) -> DispersionTarget:
    def weigh(factors: MassFactors, drawn: Array) -> None:
        factors.com[:, index, column] += drawn

    return DispersionTarget(name, "m", weigh=weigh)


def _floating_target(part: str) -> DispersionTarget:
    name = f"target.{part}"
    column = AXES.index(part[-1]) if part.startswith("com") else -1

    def apply(flight: DrawnFlight, drawn: Any) -> DrawnFlight:
        target = load_target(flight.scenario.plant.target)
        assert target is not None
        mass = np.array([float(drawn) if part == "mass" else 1.0])
        inertia = np.array([float(drawn) if part in ("mass", "inertia") else 1.0])
        offset = np.zeros((1, 3))
        offset[0, column] = float(drawn) if column >= 0 else 0.0
        parameters = InertialParameters.of(target).scaled(mass, inertia).shifted(offset)
        parameters.require_physical([target.base_link])
        given = target_parameters(urdf_with(target, parameters))
        return replace(flight.with_overrides("plant", given), has_target_masses=True)

    return DispersionTarget(name, "m" if column >= 0 else "1", apply)


def _pose_target(kind: str, part: str, column: int, scenario: Scenario) -> DispersionTarget:
    name = f"{kind}.{part}.{AXES[column]}"
    if kind == "initial" and part == "position":
        places = "initial_position", "initial_center_of_mass"
        declaration = _declared("plant")[places[bool(scenario.plant.initial_center_of_mass)]]
        target = _entry_target(name, "plant", declaration, column, is_offset=True)
        both = frozenset(f"plant.{place}[{column}]" for place in places)
        return replace(target, assigned_parameters=both)

    def apply(flight: DrawnFlight, drawn: Any) -> DrawnFlight:
        offset = np.zeros(3)
        offset[column] = float(drawn)
        if kind == "initial":
            attitude = np.array(flight.scenario.plant.initial_orientation or (0.0, 0.0, 0.0, 1.0))
            turned = quaternion_multiply(attitude, quaternion_from_rotvec(offset))
            return flight.with_overrides("plant", {"initial_orientation": turned.tolist()})
        goal: Goal = getattr(flight.scenario, kind)
        if part == "position":
            goal = replace(goal, position=goal.position + offset, asked=goal.asked | {"position"})
        else:
            turned = quaternion_multiply(goal.quaternion, quaternion_from_rotvec(offset))
            goal = replace(goal, quaternion=turned, asked=goal.asked | {"attitude"})
        changed: dict[str, Any] = {kind: goal}
        return replace(flight, scenario=replace(flight.scenario, **changed))

    return DispersionTarget(name, "m" if part == "position" else "rad", apply)


def _fault_target(name: str, index: int, part: str, scenario: Scenario) -> DispersionTarget:
    faults = scenario.plant.faults
    if index >= len(faults):
        raise ParameterError(
            f"'{name}': plant.faults has {counted(len(faults), 'fault')}"
            + ("; the first is faults[0]." if faults else ": add one to plant.faults.")
        )
    kind = _require_fault(faults[index], scenario).kind
    if part == "value" and not FAULT_KINDS[kind].value:
        raise ParameterError(f"'{name}': a fault of kind {kind} does not take a value.")
    is_text = part in ("kind", "target")

    def apply(flight: DrawnFlight, drawn: Any) -> DrawnFlight:
        lines = list(flight.scenario.plant.faults)
        if part == "present":
            lines[index : index + 1] = lines[index : index + 1] if drawn else []
        else:
            text = drawn if is_text else repr(float(drawn))
            lines[index] = edited_fault(lines[index], part, text)
        if is_text:
            _require_fault(lines[index], flight.scenario)
        return flight.with_overrides("plant", {"faults": lines})

    unit = "s" if part in ("at", "until") else ""
    # Absent faults are removed last, from the end of the list, so that indices stay valid.
    order = len(faults) - index if part == "present" else 0
    return DispersionTarget(name, unit, apply, is_text=is_text, order=order)


def _require_fault(line: str, scenario: Scenario) -> Fault:
    """Parse a fault line; only the plant can check whether it has the nozzle or wrench."""
    joints = description_of(scenario).joint_names
    return parse_fault(line, FaultTargets(joints, wrench=True, nozzles=line.split()[1:2]))


# -- the URDF of a robot with other masses ----------------------------------------------------


def urdf_with(robot: RobotDescription, parameters: InertialParameters) -> str:
    """Return a robot's URDF with different masses, centres of mass and inertias.

    The first link of each body carries the body's inertia; links attached by fixed joints have no
    inertia.
    """
    root = ET.fromstring(robot.urdf)
    weights: Any = zip(parameters.masses, parameters.centers, parameters.inertias, strict=True)
    of_body = {body.name: weight for body, weight in zip(robot.bodies, weights, strict=True)}
    for link in root.findall("link"):
        for inertial in link.findall("inertial"):
            link.remove(inertial)
        if link.get("name") in of_body:
            mass, center, tensor = of_body[link.get("name", "")]
            inertial = ET.SubElement(link, "inertial")
            xyz = " ".join(map(repr, center.tolist()))
            ET.SubElement(inertial, "origin", xyz=xyz, rpy="0 0 0")
            ET.SubElement(inertial, "mass", value=repr(float(mass)))
            upper = [(i, j) for i in range(3) for j in range(i, 3)]
            entries = {f"i{AXES[i]}{AXES[j]}": repr(float(tensor[i, j])) for i, j in upper}
            ET.SubElement(inertial, "inertia", entries)
    return ET.tostring(root, encoding="unicode")
