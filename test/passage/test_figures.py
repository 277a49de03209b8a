"""Every trace of every figure has the numbers of the bag in the unit that its axis names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from support.slow import some_fast

import spacerobot_ros
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight import api
from spacerobot_ros.model.description import Array
from spacerobot_ros.parameters import declared
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.report.figures import ReportFigure, TraceGroup
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.writing import FIGURES
from spacerobot_ros.scenario import CONFIGS

FLIGHTS: dict[str, dict[str, Any]] = {
    "slide": {"what": "sliding_masses", "goal": (0.05, -0.04, 0.02), "rotvec": (0.04, -0.02, 0.03)},
    "swing": {
        "what": "sliding_masses",
        "method": "lie_bracket",
        "goal": (0.05, -0.04, 0.02),
        "rotvec": (0.01, -0.005, 0.008),
        "parameters": {
            "plant.tick_rate": 10.0,
            "planner.tick_rate": 10.0,
            "planner.lie_bracket.t1": 10.0,
            "planner.lie_bracket.cycle_period": 4.0,
            "planner.attitude_tolerance": 1e-4,
        },
    },
    "loops": {
        "what": "arm_attitude",
        "rotvec": (0.01, 0.012, 0.008),
        "parameters": {
            "plant.tick_rate": 5.0,
            "planner.tick_rate": 5.0,
            "planner.attitude_tolerance": 0.006,
        },
    },
    "arm": {
        "what": "arm_attitude",
        "method": "optimal",
        "rotvec": (0.1, -0.05, 0.07),
        "parameters": {"planner.attitude_tolerance": 1e-4},
    },
    "square": {
        "what": "planar_chain",
        "rotvec": (0.0, 0.0, 0.9),
        "parameters": {
            "plant.tick_rate": 25.0,
            "planner.tick_rate": 25.0,
            "coordinated_control.tick_rate": 25.0,
        },
    },
    "hand": {
        "what": "coordinated_control",
        "parameters": {
            "coordinated_control.settle_time": 0.5,
            "coordinated_control.position_tolerance": 0.02,
            "coordinated_control.attitude_tolerance": 0.02,
        },
    },
    "servicer": {"what": "servicer", "parameters": {"coordinated_control.time_limit": 6.0}},
    "nozzles": {
        "what": "servicer_thrusters",
        "parameters": {
            "coordinated_control.time_limit": 3.0,
            "coordinated_control.profile": "quintic",
        },
    },
}
"""Arguments of :func:`spacerobot_ros.fly`: short flights that differ in robot and method."""


@dataclass(frozen=True)
class Case:
    """A parameter, the value that it is given, and the quantities of a flight that change.

    Attributes
    ----------
    parameter
        With its node: ``plant.sensors.seed``.
    flight
        One of :data:`FLIGHTS`.
    value
        That differs from the one of the flight.
    beside
        Further parameters, without which it would have no effect; the flight that it is compared
        with has them too.
    changes
        Empty: the robot flies in another way, which quantities follow in their own.
    """

    parameter: str
    flight: str
    value: Any
    beside: dict[str, Any]
    changes: tuple[str, ...]

    def found(self) -> tuple[str, ...]:
        """Return the quantities that differ between the flights with and without the value."""
        before = prints(self.flight, json.dumps(self.beside))
        after = prints(self.flight, json.dumps({**self.beside, self.parameter: self.value}))
        names = before.keys() | after.keys()
        return tuple(sorted(name for name in names if before.get(name) != after.get(name)))


TABLE: dict[str, dict[str, Any]] = yaml.safe_load(
    Path(__file__).with_name("parameters.yaml").read_text("utf-8")
)
"""Entries by parameter."""

CASES = [
    Case(
        parameter,
        entry["flight"],
        entry["value"],
        entry.get("beside", {}),
        tuple(entry.get("changes", ())),
    )
    for parameter, entry in TABLE.items()
    if "flight" in entry
]
"""The entries that are tried in flights."""


@cache
def prints(flight: str, parameters: str) -> dict[str, str]:
    """Return a fingerprint of every quantity of a flight by its name; a refusal is one.

    ``parameters`` are those beside the flight's, as JSON.
    """
    words = dict(FLIGHTS[flight])
    words["parameters"] = {**words.get("parameters", {}), **json.loads(parameters)}
    try:
        # The flight of a refused goal has quantities as well.
        with patch.object(api, "_raise_if_refused", lambda flight: flight):
            flown = spacerobot_ros.fly(words.pop("what"), words.pop("goal", None), **words)
    except SpaceRobotError as error:
        return {"refused": str(error)}
    found: dict[str, Any] = {
        "duration": flown.time[-1],
        "outcome": flown.outcome,
        "message": flown.message,
        "events": [str(event) for event in flown.events],
        "statuses": [
            # Notes say where a plan is from.
            (stamp, replace(status, notes={}) if isinstance(status, PlannerStatus) else status)
            for stamp, status in flown.statuses
        ],
        "refusals": [str(refusal) for refusal in flown.refusals],
        "schedules": [
            (stamp, s.method, s.velocities, s.path.position) for stamp, s in flown.schedules
        ],
    }
    series = {"pose": flown.pose, "twist": flown.twist, "q": flown.q, "qdot": flown.qdot}
    series |= {"effort": flown.effort, "momentum": flown.momentum, **flown.quantities}
    found |= series
    found |= {topic: (c.time, c.values) for topic, c in flown.commands.items()}
    return {name: _fingerprint(value) for name, value in found.items()}


def _fingerprint(value: Any) -> str:
    digest = hashlib.sha256()

    def feed(part: Any) -> None:
        if isinstance(part, np.ndarray):
            digest.update(np.ascontiguousarray(part).tobytes())
        elif isinstance(part, (list, tuple)):
            for each in part:
                feed(each)
        else:
            digest.update(repr(part).encode())
        digest.update(b"|")

    feed(value)
    return digest.hexdigest()[:16]


BAGS = Path(__file__).resolve().parents[2] / "bags"

NAMES = sorted(path.stem for path in BAGS.glob("*.mcap"))

SOME_QUICK = some_fast(NAMES, "servicer_thrusters")

Messages = Mapping[str, list[Any]]


@cache
def messages_of(name: str) -> Messages:
    """Return the messages of a bag by topic, read by other libraries."""
    found: dict[str, list[Any]] = {}
    with (BAGS / f"{name}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


@cache
def figures_of(name: str) -> dict[str, ReportFigure]:
    flight = read_report(BAGS / f"{name}.mcap", None)
    drawn = {key: draw(flight) for key, draw in FIGURES.items()}
    return {key: figure for key, figure in drawn.items() if isinstance(figure, ReportFigure)}


def vectors(parts: list[Any]) -> Array:
    return np.array([[p.x, p.y, p.z] for p in parts])


def quaternions(parts: list[Any]) -> Array:
    return np.array([[p.x, p.y, p.z, p.w] for p in parts])


def attitudes(messages: Messages) -> Rotation:
    return Rotation.from_quat(quaternions([m.pose.pose.orientation for m in messages["/odom"]]))


def joints(messages: Messages, field: str, names: list[str]) -> Array:
    states = messages["/joint_states"]
    return np.array([[getattr(m, field)[list(m.name).index(n)] for n in names] for m in states])


def numbers(messages: list[Any]) -> Array:
    return np.array([list(m.data) for m in messages])


def pose_error(messages: Messages, part: str, quantity: str) -> Array:
    """Return goal minus pose in the world; the goal is the one that was sent."""
    name = "" if part == "base" else "end_effector/"
    if "/goal_path" in messages and not name:
        ((*_, goal),) = (path.poses for path in messages["/goal_path"])
    else:
        (goal,) = messages[f"/{name}goal_pose"]
    poses = [m.pose for m in messages["/end_effector_pose"]] if name else [
        m.pose.pose for m in messages["/odom"]
    ]  # fmt: skip
    if quantity == "position":
        return vectors([goal.pose.position]) - vectors([pose.position for pose in poses])
    turns = Rotation.from_quat(quaternions([goal.pose.orientation]))
    turns *= Rotation.from_quat(quaternions([pose.orientation for pose in poses])).inv()
    return np.asarray(turns.as_rotvec())


def thruster_numbers(group: TraceGroup, messages: Messages) -> Array:
    states = messages["/thrusters"]
    if group.unit == "fraction of each tick during which they are on":
        share = np.array([m.velocity for m in states])
        assert share[:, share.any(axis=0)].max() <= 1.0
        return share[:, share.any(axis=0)]
    # Of each thruster of the servicer, and of the free-flyer, which has no joint: N, s.
    thrust, specific = (10.0, 290.0) if messages["/joint_states"][0].name else (0.2, 60.0)
    on = np.array([m.position for m in states])
    impulse = thrust * (on - on[0]).sum(axis=1, keepdims=True)
    return {"N s": impulse, "g": 1000.0 * impulse / (specific * 9.80665)}[group.unit]


def expected(figure: str, group: TraceGroup, messages: Messages) -> Array:
    """Return the numbers of a group of traces, in its unit."""
    names = list(group.names)
    odom = messages["/odom"]
    if figure in ("pose", "position") and group.label == "base position":
        return vectors([m.pose.pose.position for m in odom])
    if figure in ("pose", "attitude"):
        return attitudes(messages).as_rotvec()
    if figure in ("joints", "velocities"):
        of_rates = figure == "velocities" or group.label == "wheel rate"
        return joints(messages, "velocity" if of_rates else "position", names)
    if figure == "efforts" and group.label.startswith("thruster"):
        part = group.label.removeprefix("thruster ")
        return vectors([getattr(m.wrench, part) for m in messages["/base_wrench"]])
    if figure == "efforts":
        return joints(messages, "effort", names)[1:]  # Of the tick that ends with the state.
    if figure == "twist":
        part = "linear" if group.label == "velocity" else "angular"
        return vectors([getattr(m.twist.twist, part) for m in odom])
    if figure == "errors":
        kind, _, part = group.label.partition(" of ")
        quantity = {"distance": "position", "angle": "attitude"}[kind]
        return np.linalg.norm(pose_error(messages, part, quantity), axis=1, keepdims=True)
    if figure == "thrusters":
        return thruster_numbers(group, messages)
    assert figure == "momentum"
    if names == ["energy"]:
        return numbers(messages["/momentum"])[:, 6:7]
    change = numbers(messages["/momentum"])[:, :6]
    if "/momentum_expected" in messages:
        change = change - numbers(messages["/momentum_expected"])
    return np.linalg.norm((change - change[0]).reshape(-1, 2, 3), axis=2)


def units_of_joints(name: str) -> str:
    return "m" if name == "sliding_masses" else "rad"


UNITS = {
    "pose": {"base position": "m", "rotation vector": "rad"},
    "position": {"base position": "m"},
    "attitude": {"rotation vector": "rad"},
    "twist": {"velocity": "m/s", "rate": "rad/s"},
    "efforts": {"thruster force": "N", "thruster torque": "N m", "joint effort": "N m"},
    "clearance": {"smallest distance": "m"},
    "momentum_budget": {"angular momentum": "N m s"},
    "momentum": {"change": "kg m/s, kg m²/s", "kinetic energy": "J"},
    "thrusters": {
        "thrusters": "fraction of each tick during which they are on",
        "impulse given": "N s",
        "propellant": "g",
    },
}
"""The unit of each label of an axis, by figure; those of joints depend on their kind."""


COMPUTED = ("clearance", "link_errors", "momentum_budget")
"""Figures of numbers that are computed from those of the bag, and that no message of it has."""


def unit_of(name: str, figure: str, label: str) -> str:
    if label == "wheel rate":
        return "rad/s"
    if figure == "joints":
        return units_of_joints(name)
    if figure == "velocities":
        return f"{units_of_joints(name)}/s"
    if " of " in label and figure.endswith("errors"):
        return {"distance": "m", "angle": "rad"}[label.partition(" of ")[0]]
    return UNITS[figure][label]


@pytest.mark.parametrize("name", SOME_QUICK)
def test_every_trace_has_the_numbers_of_the_bag_in_the_unit_of_its_axis(name: str) -> None:
    for figure, drawn in figures_of(name).items():
        for group in drawn.groups:
            about = f"{figure}: {group.label}"
            assert group.unit == unit_of(name, figure, group.label), about
            if figure in COMPUTED:
                continue
            # A state at which a schedule follows another one counts for both.
            _, once = np.unique(group.signal.time, return_index=True)
            values, numbers = group.signal.values[once], expected(figure, group, messages_of(name))
            if group.unit == "rad" and len(group.names) == 3 and "rotation" in group.label:
                turns = Rotation.from_rotvec(values).inv() * Rotation.from_rotvec(numbers)
                assert turns.magnitude().max() < 1e-12, about
            else:
                assert values.shape[1] == numbers.shape[1] == len(group.names), about
                scale = np.abs(numbers).max()
                # A goal comes after the first states; after the last command comes no state.
                values = values[: len(numbers)]
                last = numbers[len(numbers) - len(values) :]
                np.testing.assert_allclose(values, last, rtol=0, atol=1e-9 * scale, err_msg=about)


@pytest.mark.slow
def test_smallest_distances_are_those_that_the_plant_published() -> None:
    compared = 0
    for name in NAMES:
        figure = figures_of(name).get("clearance")
        for message in messages_of(name).get("/clearance", ()) if figure else ():
            told = {each.key: float(each.value) for each in message.values[:2]}
            signal = figure.groups[0].signal  # type: ignore[union-attr]
            at = int(np.argmin(np.abs(signal.time - signal.time[0] - told["time"])))
            if abs(signal.time[at] - signal.time[0] - told["time"]) < 1e-6:
                assert signal.values[at, 0] == pytest.approx(told["distance"], abs=1e-7), name
                compared += 1
    assert compared > 20


@pytest.mark.slow
def test_budgets_of_momentum_have_the_sum_that_the_plant_published() -> None:
    for name in ("capture", "servicing", "wheels"):
        (group,) = figures_of(name)["momentum_budget"].groups
        L_W = numbers(messages_of(name)["/momentum"])[:, 3:6]
        np.testing.assert_allclose(
            group.signal.values[:, -1], np.linalg.norm(L_W, axis=1), atol=1e-12, err_msg=name
        )


@pytest.mark.parametrize("name", SOME_QUICK)
def test_axes_name_their_quantity_and_its_unit(name: str) -> None:
    for figure, drawn in figures_of(name).items():
        axes = drawn.figure.axes
        texts = [t for a in axes for t in (a.get_ylabel(), a.get_title(), a.get_title("left"))]
        for group in drawn.groups:
            unit = unit_of(name, figure, group.label)
            both = {f"{group.label} ({unit})"}
            assert both & set(texts) or {unit, group.label} <= set(texts), (
                f"{figure}: {group.label}"
            )
        if drawn.groups:
            assert "time (s)" in {each.get_xlabel() for each in axes}, figure


AXES_BESIDE_TIME = {
    "cycles": {
        ("number of the cycle", "rotation vector (rad)"),
        ("number of the cycle", "angle of base (rad)"),
    },
    "path": {("x (m)", "y (m)"), ("x (m)", "z (m)"), ("y (m)", "z (m)")},
}


@pytest.mark.parametrize("name", SOME_QUICK)
def test_axes_of_space_and_of_shapes_have_units(name: str) -> None:
    unit = units_of_joints(name)
    for figure in ("cycles", "path", "loops"):
        drawn = figures_of(name).get(figure)
        if drawn is None:
            continue
        labels = {(a.get_xlabel(), a.get_ylabel()) for a in drawn.figure.axes if a.lines}
        if figure == "loops":
            assert all(text.endswith(f" ({unit})") for pair in labels for text in pair)
        else:
            assert labels <= AXES_BESIDE_TIME[figure], labels


@pytest.mark.slow
def test_every_figure_is_drawn_from_one_of_the_bags_or_named_here() -> None:
    drawn = {figure for name in NAMES for figure in figures_of(name)}
    # Sensors of the reference flights have no errors (test/report/test_report_numbers.py), and
    # their plants measured no clearance (test/flight/test_clearance.py).
    assert drawn | {"sensors", "clearance"} == set(FIGURES)


TESTS = Path(__file__).resolve().parents[1]

NODES = ("plant", "planner", "coordinated_control")

_QUICK = ("hand", "square")
"""Flights that need no solver and take a few tenths of a second."""

_LONG = {
    "plant.actuation",
    "plant.initial_orientation",
    "plant.integration_step",
    "plant.initial_joint_velocities",
    "planner.area_loop.cycles_per_plan",
    "planner.attitude_tolerance",
    "planner.integration_step",
    "planner.joint_tolerance",
    "planner.method",
    "planner.square_path.t1",
    "coordinated_control.estimation_time",
    "coordinated_control.model_error",
    "coordinated_control.model_error_seed",
    "coordinated_control.model_based.singular_value_threshold",
}
"""Parameters with which even these take seconds."""


def test_parameters_of_the_table_exist() -> None:
    every = {f"{node}.{p.name}" for node in NODES for p in declared(CONFIGS[node])}
    assert set(TABLE) <= every


def test_named_tests_name_the_parameter() -> None:
    for parameter, entry in TABLE.items():
        if "test" in entry:
            file, _, name = entry["test"].partition("::")
            text = (TESTS / file).read_text("utf-8")
            assert parameter.rpartition(".")[2] in text, parameter
            assert f"def {name}" in text, parameter


def test_flights_are_short_and_all_are_used() -> None:
    assert {case.flight for case in CASES} == set(FLIGHTS)


@pytest.mark.parametrize(
    "case",
    some_fast(
        {case.parameter: case for case in CASES},
        *(
            each.parameter
            for each in CASES
            if each.flight in _QUICK and each.parameter not in _LONG
        ),
    ),
)
def test_a_parameter_changes_these_quantities_and_no_others(case: Case) -> None:
    found = case.found()
    assert found, "it changes nothing"
    assert "refused" not in found
    assert not case.changes or found == case.changes
