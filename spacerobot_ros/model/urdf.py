"""Reads URDF files and strings into :class:`.RobotDescription`.

The syntax is checked first (:func:`_checked_root`): every message names the element and its
correction. Then links and joints are read, links connected by fixed joints are merged, and
robots with singular equations are rejected.
"""

from __future__ import annotations

import math
import os
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

import numpy as np

from spacerobot_ros.errors import RobotDescriptionError, reason
from spacerobot_ros.files import read_regular, warn_once
from spacerobot_ros.model import xacro_files
from spacerobot_ros.model.description import (
    Array,
    Inertia,
    Joint,
    JointKind,
    JointLimits,
    Link,
    Mimic,
    Pose,
    RobotDescription,
    Shape,
    editable_root,
    leading_limit,
    weld_links,
)
from spacerobot_ros.model.inertial_parameters import (
    INERTIA_ENTRIES,
    TRIANGLE_SLACK,
    symmetric_of_entries,
)
from spacerobot_ros.model.meshes import mesh_beside, mesh_file, with_mesh_files
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    matrix_from_rpy,
    rpy_from_matrix,
)
from spacerobot_ros.model.srdf import disabled_pairs, with_srdf
from spacerobot_ros.model.wheels import require_reaction_wheels
from spacerobot_ros.resources import suggestion

_MAX_NUMBER = 1e12
"""Largest value (kg, m, kg m^2): larger ones are typing errors, and their squares overflow."""

_MAX_LINKS = 200

_XACRO_CPU_TIME = 10
"""CPU time limit for expanding a xacro file, s; the wall time limit is six times as long."""

XACRO_ARGUMENTS_VARIABLE = "SPACEROBOT_XACRO_ARGS"
"""Environment variable with xacro arguments, ``NAME:=VALUE``, separated as in a shell."""


def load_robot(path: str | Path) -> RobotDescription:
    """Read a robot from a URDF file, or from a xacro file (by its suffix), which is expanded.

    Mesh paths that are relative to the file, or in a package that is not installed and contains the
    file, become absolute in the robot's URDF. If the folder contains an SRDF of the same name,
    contacts of the link pairs disabled in it are ignored.

    Raises
    ------
    RobotDescriptionError
        The file cannot be read, is not URDF, or does not describe a free-floating tree.
    """
    path = Path(path)
    robot = _loaded(path, parse_robot)
    beside = path.with_name(f"{path.name.split('.')[0]}.srdf")
    if not beside.is_file():
        return robot
    try:
        return with_srdf(robot, beside)
    except RobotDescriptionError as error:
        raise RobotDescriptionError(f"{path}: {error}") from error


def load_world(path: str | Path) -> RobotDescription:
    """Read obstacles, fixed in the world, from a URDF or xacro file.

    The root link frame is the world frame W. Links need no mass.

    Raises
    ------
    RobotDescriptionError
        The file cannot be read or is not URDF, a mesh is not found, or :func:`parse_world` rejects
        it.
    """
    world = _loaded(Path(path), parse_world)
    require_found_meshes(world)
    return world


def require_found_meshes(world: RobotDescription) -> None:
    """Check that the meshes of obstacles exist.

    Raises
    ------
    RobotDescriptionError
        A mesh is not found; the message names it.
    """
    for link in world.links:
        for shape in link.collisions or link.shapes:
            if shape.kind == "mesh" and mesh_file(shape.resource) is None:
                raise RobotDescriptionError(
                    f"Obstacle '{link.name}' cannot be avoided: its mesh '{shape.resource}' "
                    "was not found. Give a path relative to the URDF, or source the workspace of "
                    "its package."
                )


def _loaded(path: Path, parse: Callable[[str], RobotDescription]) -> RobotDescription:
    """Return the description of a file, whose paths of meshes become absolute."""
    text = _read_text(path)
    try:
        return parse(text)
    except RobotDescriptionError as error:
        remedy = ""
        if path.suffix != ".xacro" and ("<xacro:" in text or "${" in text):
            remedy = f" To expand xacro in it, rename it to {path.stem}.xacro."
        raise RobotDescriptionError(f"{path}: {error}{remedy}") from error


def _read_text(path: Path) -> str:
    """Return the URDF text of a file, expanded and with absolute paths of meshes."""
    try:
        text = read_regular(path).decode("utf-8").replace("\r\n", "\n")
    except OSError as error:
        raise RobotDescriptionError(f"The URDF {path} cannot be read: {reason(error)}.") from error
    except UnicodeDecodeError as error:
        raise RobotDescriptionError(
            f"The URDF {path} cannot be read: it is not UTF-8 text ({error}). Save it as UTF-8."
        ) from error
    if path.suffix == ".xacro":
        text = _expand_xacro(path)
    folder = path.resolve().parent
    return with_mesh_files(text, lambda mesh: mesh_beside(mesh, folder))


def _expand_xacro(path: Path) -> str:
    by_hand = f"`xacro {path.name} [NAME:=VALUE ...] > {path.name.split('.')[0]}.urdf`"
    if find_spec("xacro") is None:
        raise RobotDescriptionError(
            f"{path} is a xacro file, and the package xacro is not installed: `pip install xacro`, "
            f"or expand it where xacro is installed: {by_hand}."
        )
    arguments = shlex.split(os.environ.get(XACRO_ARGUMENTS_VARIABLE, ""))
    for each in arguments:
        if not each.partition(":=")[1]:
            raise RobotDescriptionError(
                f"The xacro argument '{each}' is not of the form NAME:=VALUE."
            )
    words = [xacro_files.__file__, str(path), f"{_XACRO_CPU_TIME}", *arguments]
    try:
        done = subprocess.run(
            [sys.executable, "-X", "utf8", *words],
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=6 * _XACRO_CPU_TIME,
            check=False,
        )
    except subprocess.TimeoutExpired:
        reason = f"it takes longer than {6 * _XACRO_CPU_TIME} s"
    else:
        if done.returncode == 0:
            _name_unused_arguments(path, done.stderr)
            return done.stdout
        reasons = [line for line in done.stderr.splitlines() if line.startswith("REASON ")]
        reason = reasons[-1][7:] if reasons else "it needs too much time or memory"
    raise RobotDescriptionError(
        f"The xacro file {path} cannot be expanded: {reason.rstrip('.')}. Correct it, or expand it "
        f"by hand: {by_hand}."
    )


def _name_unused_arguments(path: Path, told: str) -> None:
    for line in told.splitlines():
        kind, *names = line.split()
        if kind == "UNUSED":
            has = f"its arguments are: {', '.join(names[1:])}" if names[1:] else "it has none"
            warn_once(
                f"The xacro file {path} has no argument '{names[0]}', which is ignored; {has}."
                f"{suggestion(names[0], names[1:])}"
            )


def parse_robot(text: str) -> RobotDescription:
    """Read a robot from a URDF string.

    Raises
    ------
    RobotDescriptionError
        The string is not URDF, or does not describe a free-floating tree of prismatic, revolute,
        continuous and fixed joints with positive definite inertia.
    """
    description = _read_tree(text)
    for number, body in enumerate(description.bodies):
        if describe_inertia_flaw(body.inertia.about_com):
            _refuse_impossible_inertia(
                [link for link in description.links if description.frames[link.name][0] == number]
            )
    _require_mass(description)
    require_reaction_wheels(description)
    return description


def with_held_joints(robot: RobotDescription, positions: Array | None = None) -> RobotDescription:
    """Return a robot with locked joints: one rigid body, also in its URDF.

    Parameters
    ----------
    robot
        The robot.
    positions
        (n,) m or rad, in joint order; None: zero, or the nearest limit.

    Raises
    ------
    RobotDescriptionError
        The number of positions is wrong, or a position is not finite or outside the limits.
    """
    names, limits = robot.joint_names, (robot.limits("lower"), robot.limits("upper"))
    q = np.clip(0.0, *limits) if positions is None else np.asarray(positions, dtype=float)
    if q.shape != (len(names),):
        raise RobotDescriptionError(
            f"{q.size} joint positions are given, but '{robot.name}' has {len(names)} joints"
            f"{': ' if names else ''}{', '.join(names)}."
        )
    for name, value, lower, upper in zip(names, q, *limits, strict=True):
        if not lower <= value <= upper:
            raise RobotDescriptionError(
                f"The position of joint '{name}', {value:g}, is outside its limits "
                f"[{lower:g}, {upper:g}]."
            )
    if not names:
        return robot
    held = {
        joint.name: joint for joint in robot.with_locked(dict(zip(names, q, strict=True))).joints
    }
    root = fromstring(robot.urdf)
    for element in root.findall("joint"):
        joint = held[element.get("name", "")]
        if element.get("type") == "fixed":
            continue
        _remove_children(element, ("origin", "axis", "limit", "mimic", "wheel", "dynamics"))
        element.set("type", "fixed")
        place, turn = joint.origin.r.tolist(), rpy_from_matrix(joint.origin.R).tolist()
        pose = {"xyz": " ".join(map(repr, place)), "rpy": " ".join(map(repr, turn))}
        element.append(Element("origin", pose))
    return parse_robot(tostring(root, encoding="unicode"))


def parse_world(text: str) -> RobotDescription:
    """Read obstacles, fixed in the world, from a URDF string; see :func:`load_world`.

    Raises
    ------
    RobotDescriptionError
        The string is not URDF, has a movable joint, or has no shape.
    """
    world = _read_tree(text)
    if world.moving_joints:
        joint = world.moving_joints[0]
        raise RobotDescriptionError(
            f"Obstacles must be fixed in the world, but joint '{joint.name}' is "
            f'{joint.kind.value}: give it type="fixed".'
        )
    if not any(link.collisions or link.shapes for link in world.links):
        raise RobotDescriptionError(
            f"The world '{world.name}' has no obstacles: give its links <collision> or <visual> "
            "elements."
        )
    return world


def _read_tree(text: str) -> RobotDescription:
    """Return the links and joints of a URDF text, whatever their masses."""
    root = _checked_root(text)
    if len(root.findall("link")) > _MAX_LINKS:
        raise RobotDescriptionError(
            f"The robot description has more than {_MAX_LINKS} links: deriving its equations "
            "would take hours."
        )
    colours = {
        material.get("name", ""): _read_colour(color, f"material '{material.get('name', '')}'")
        for material in root.findall("material")
        if (color := material.find("color")) is not None
    }
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise RobotDescriptionError(
                f"The {kind} name '{twice[0]}' is used twice; names must be unique."
            )
    links = {
        link.name: link for link in (_read_link(each, colours) for each in root.findall("link"))
    }
    joints = _with_leaders([_read_joint(each, links) for each in root.findall("joint")])
    bodies, frames = weld_links(links, joints)
    carried = root.find("world/robot")
    return RobotDescription(
        name=root.get("name", ""),
        links=tuple(links.values()),
        joints=tuple(joints),
        bodies=tuple(bodies),
        frames=frames,
        urdf=text,
        disabled_collisions=disabled_pairs(root, list(links), "The robot description"),
        world=None if carried is None else parse_world(tostring(carried, encoding="unicode")),
    )


# -- links ------------------------------------------------------------------------------------


def _read_numbers(element: Element | None, name: str, default: str, where: str) -> Array:
    text = default if element is None else element.get(name, default)
    return _require_finite([float(word) for word in text.split()], where)


def _read_number(element: Element | None, name: str, where: str) -> float:
    return float(_require_finite(0.0 if element is None else float(element.get(name, "0")), where))


def _require_finite(values: float | list[float], where: str) -> Array:
    array = np.array(values, dtype=float)
    if not np.all(np.isfinite(array)):
        raise RobotDescriptionError(f"A number in {where} is not finite: {array.tolist()}.")
    if array.size and np.abs(array).max() > _MAX_NUMBER:
        raise RobotDescriptionError(
            f"A number in {where} is larger than {_MAX_NUMBER:g} in its SI unit: {array.tolist()}."
        )
    return array


def _read_pose(element: Element, where: str) -> Pose:
    origin = element.find("origin")
    if origin is None:
        return Pose()
    where = f"the origin of {where}"
    r = _read_numbers(origin, "xyz", "0 0 0", where)
    quaternion = _read_numbers(origin, "quat_xyzw", "", where)
    if not quaternion.size:
        return Pose(matrix_from_rpy(_read_numbers(origin, "rpy", "0 0 0", where)), r)
    if origin.get("rpy") is not None:
        raise RobotDescriptionError(f"{where.capitalize()} has 'rpy' and 'quat_xyzw': give one.")
    if not (length := float(np.linalg.norm(quaternion))):
        raise RobotDescriptionError(f"'quat_xyzw' in {where} is zero: give a unit quaternion.")
    return Pose(matrix_from_quaternion(quaternion / length), r)


def _read_link(link: Element, colours: dict[str, tuple[float, ...]]) -> Link:
    name = link.get("name", "")
    where = f"link '{name}'"
    inertia = Inertia()
    if (inertial := link.find("inertial")) is not None:
        pose = _read_pose(inertial, where)
        mass = _read_number(inertial.find("mass"), "value", where)
        moments = inertial.find("inertia")
        about = _read_inertia(moments, where)
        if mass < 0:
            raise RobotDescriptionError(f"The mass of {where} is negative ({mass} kg).")
        inertia = Inertia(mass, np.zeros(3), about).moved(pose)
    shapes, collisions = (
        tuple(_read_shape(each, colours, where) for each in link.findall(tag))
        for tag in ("visual", "collision")
    )
    return Link(name, inertia, shapes, collisions)


def _read_inertia(moments: Element | None, where: str) -> Array:
    return symmetric_of_entries(
        _read_number(moments, f"i{'xyz'[row]}{'xyz'[column]}", where)
        for row, column in INERTIA_ENTRIES
    )


def describe_inertia_flaw(about: Array) -> str:
    """Return a clause that describes impossible moments of inertia (3, 3), kg m^2; empty: none.

    The clause completes a message that begins with the owner of the inertia.
    """
    low, middle, high = np.linalg.eigvalsh(about)
    if low < -1e-12 * max(1.0, float(np.abs(about).max())):
        return "has a negative principal moment; check its signs."
    if high > (1 + TRIANGLE_SLACK) * (low + middle) + 1e-12:
        return (
            f"is not physical: its principal moments are {low:.4g}, {middle:.4g} and "
            f"{high:.4g} kg m^2, and none may exceed the sum of the other two. Check units "
            "and digits of <inertia>."
        )
    return ""


def nearest_inertias(path: Path) -> tuple[str, dict[str, float]]:
    """Return a file's URDF with a physically possible inertia for every link.

    An impossible inertia is replaced by the nearest possible one in the Frobenius norm. Also return
    the relative change in inertia of each such link, in that norm.

    Raises
    ------
    RobotDescriptionError
        The file cannot be read, or is not URDF.
    """
    text = _read_text(path)
    links = {each.name: each for each in _read_tree(text).links}
    root, changes = editable_root(text), {}
    for element in root.findall("link"):
        name, inertia = element.get("name", ""), element.find("inertial/inertia")
        if inertia is None or not describe_inertia_flaw(links[name].inertia.about_com):
            continue
        given = _read_inertia(inertia, f"link '{name}'")
        found = _nearest_inertia(given)
        for row, column in INERTIA_ENTRIES:
            inertia.set(f"i{'xyz'[row]}{'xyz'[column]}", repr(float(found[row, column])))
        changes[name] = float(np.linalg.norm(found - given) / np.linalg.norm(given))
    return tostring(root, encoding="unicode"), changes


def _nearest_inertia(about: Array) -> Array:
    """Return the nearest moments of inertia (3, 3) that a body can have."""
    from scipy.optimize import nnls

    moments, axes = np.linalg.eigh(about)
    scale = float(np.abs(moments).max())
    # A principal moment is the sum of two second moments, and no second moment is negative.
    second = scale * nnls(1.0 - np.eye(3), moments / scale)[0]
    return np.asarray((axes * (second.sum() - second)) @ axes.T)


def _refuse_impossible_inertia(welded: list[Link]) -> NoReturn:
    """Refuse a body of impossible inertia; the message names the worst of its welded links."""

    def excess(link: Link) -> float:
        low, middle, high = np.linalg.eigvalsh(link.inertia.about_com)
        return float(max(high - middle - low, -low))

    worst = max(welded, key=excess)
    raise RobotDescriptionError(
        f"The inertia of link '{worst.name}' {describe_inertia_flaw(worst.inertia.about_com)} "
        "`spacerobot new URDF --nearest-inertia` writes a URDF with the nearest possible inertia."
    )


def _read_colour(color: Element, where: str) -> tuple[float, ...]:
    return tuple(_read_numbers(color, "rgba", "", f"a color of {where}").tolist())


def _read_shape(element: Element, colours: dict[str, tuple[float, ...]], where: str) -> Shape:
    geometry = element.find("geometry")
    assert geometry is not None
    (form,) = geometry
    if form.tag == "mesh":
        # A negative scale mirrors.
        size = _read_numbers(form, "scale", "1 1 1", f"the scale of a mesh of {where}")
    else:
        names = (attribute.name for attribute in _ATTRIBUTES[form.tag])
        numbers = " ".join(form.get(name, "") for name in names).split()
        size = _require_finite([float(number) for number in numbers], f"the geometry of {where}")
        if size.min() < 0:
            raise RobotDescriptionError(
                f"A size in a <geometry> of {where} is negative: {size.tolist()}. "
                "Give lengths in m."
            )
    rgba: tuple[float, ...] = Shape.rgba
    if (material := element.find("material")) is not None:
        color = material.find("color")
        if color is not None:
            rgba = _read_colour(color, where)
        else:
            rgba = colours.get(material.get("name", ""), rgba)
    red, green, blue, opacity = rgba
    return Shape(
        form.tag,
        tuple(size.tolist()),
        _read_pose(element, where),
        (red, green, blue, opacity),
        form.get("filename", "") if form.tag == "mesh" else "",
    )


# -- joints -----------------------------------------------------------------------------------


def _read_joint(joint: Element, links: dict[str, Link]) -> Joint:
    name = joint.get("name", "")
    where = f"joint '{name}'"
    ends = {}
    for role in ("parent", "child"):
        end = joint.find(role)
        assert end is not None
        ends[role] = end.get("link", "")
        if ends[role] not in links:
            raise RobotDescriptionError(
                f"The {role} of {where} is '{ends[role]}', but there is no such link."
                f"{suggestion(ends[role], links)}"
            )
    kind = JointKind(joint.get("type"))
    axis = _read_numbers(joint.find("axis"), "xyz", "1 0 0", where)
    if kind is not JointKind.FIXED:
        norm = float(np.linalg.norm(axis))
        if norm < 1e-9:
            raise RobotDescriptionError(f"The axis of {where} is zero; give it a direction.")
        axis = axis / norm
    return Joint(
        name,
        kind,
        ends["parent"],
        ends["child"],
        _read_pose(joint, where),
        axis,
        _read_limits(joint.find("limit"), kind, where),
        _read_mimic(joint.find("mimic"), where),
        joint.find("wheel") is not None,
    )


def _read_mimic(mimic: Element | None, where: str) -> Mimic | None:
    if mimic is None:
        return None
    leader = mimic.get("joint", "")
    (multiplier,) = _read_numbers(mimic, "multiplier", "1", f"<mimic> of {where}")
    (offset,) = _read_numbers(mimic, "offset", "0", f"<mimic> of {where}")
    if multiplier == 0:
        raise RobotDescriptionError(
            f"The {where} mimics '{leader}' with multiplier 0: it does not move; make it fixed."
        )
    return Mimic(leader, float(multiplier), float(offset))


def _with_leaders(joints: list[Joint]) -> list[Joint]:
    """Return the joints, with every chain of mimic joints resolved to its leading joint."""
    by_name = {joint.name: joint for joint in joints}
    found = []
    for joint in joints:
        multiplier, offset, leader, passed = 1.0, 0.0, joint, [joint.name]
        while leader.mimic is not None:
            follows = leader.mimic
            if follows.joint not in by_name:
                raise RobotDescriptionError(
                    f"The joint '{leader.name}' mimics '{follows.joint}', but there is no such "
                    f"joint.{suggestion(follows.joint, by_name)}"
                )
            if follows.joint in passed:
                raise RobotDescriptionError(
                    f"The joint '{joint.name}' mimics itself via {', '.join(passed[1:])}."
                    if passed[1:]
                    else f"The joint '{joint.name}' mimics itself."
                )
            # theta = k (k' q + b') + b
            offset += multiplier * follows.offset
            multiplier *= follows.multiplier
            leader = by_name[follows.joint]
            passed.append(leader.name)
        if joint.mimic is None:
            found.append(joint)
        elif leader.kind is JointKind.FIXED:
            found.append(joint.locked(offset))
        else:
            found.append(replace(joint, mimic=Mimic(leader.name, multiplier, offset)))
    return _without_contradicting_limits(found)


def _without_contradicting_limits(joints: list[Joint]) -> list[Joint]:
    """Drop the position limits of a mimic joint that would leave the joint it follows no range."""
    ranges = {each.name: (each.limits.lower, each.limits.upper) for each in joints}
    found = []
    for joint in joints:
        if joint.mimic is not None:
            leader, limits = joint.mimic.joint, joint.limits
            lower = max(ranges[leader][0], leading_limit(limits, joint.mimic, "lower"))
            upper = min(ranges[leader][1], leading_limit(limits, joint.mimic, "upper"))
            if lower < upper:
                ranges[leader] = lower, upper
            else:
                warn_once(
                    f"The position limits of joint '{joint.name}' are ignored: they would leave "
                    f"'{leader}', which it mimics, no range. Check multiplier, offset and limits."
                )
                joint = replace(joint, limits=replace(limits, lower=-np.inf, upper=np.inf))
        found.append(joint)
    return found


_NO_LIMIT = 1e4
"""Position, m or rad, from which a joint limit means no limit."""


def _read_limits(limit: Element | None, kind: JointKind, where: str) -> JointLimits:
    if limit is None:
        if kind in (JointKind.FIXED, JointKind.CONTINUOUS):
            return JointLimits()
        raise RobotDescriptionError(
            f"The {where} is {kind.value} and has no <limit>: "
            "give lower, upper, velocity and effort."
        )
    values = {
        name: float(limit.get(name, "0")) or 0.0
        for name in ("lower", "upper", "velocity", "effort")
    }
    for name, value in values.items():
        if math.isnan(value):
            raise RobotDescriptionError(f"The limit '{name}' of {where} is not a number.")
    for name in ("velocity", "effort"):
        if values[name] < 0:
            raise RobotDescriptionError(
                f"The limit '{name}' of {where} is negative ({values[name]})."
            )
    if kind is JointKind.CONTINUOUS:
        return JointLimits(velocity=values["velocity"], effort=values["effort"])
    if values["lower"] >= values["upper"]:
        raise RobotDescriptionError(
            f"The lower limit of {where} ({values['lower']}) is not below its upper limit "
            f"({values['upper']}): it cannot move; give it a range, or make it fixed."
        )
    for name in ("lower", "upper"):
        if abs(values[name]) >= _NO_LIMIT:
            values[name] = math.copysign(math.inf, values[name])
    return JointLimits(**values)


def _require_mass(robot: RobotDescription) -> None:
    """Refuse moving parts without mass, which would make the inertia matrix singular."""
    base = robot.bodies[0].inertia
    if base.mass <= 0:
        raise RobotDescriptionError(
            f"The base link '{robot.base_link}' has no mass; a free-floating base needs an "
            "<inertial> with mass and inertia. Give it those of the spacecraft that carries the "
            'robot, for instance <inertial><mass value="100"/><inertia ixx="10" iyy="10" '
            'izz="10" ixy="0" ixz="0" iyz="0"/></inertial>.'
        )
    outboard_mass = [body.inertia.mass for body in robot.bodies]
    outboard_moment = [float(np.trace(body.inertia.about_com)) for body in robot.bodies]
    for index in range(len(robot.bodies) - 1, 0, -1):
        parent = robot.bodies[index].parent
        outboard_mass[parent] += outboard_mass[index]
        outboard_moment[parent] += outboard_moment[index]
    for body, mass, moment in zip(
        robot.bodies[1:], outboard_mass[1:], outboard_moment[1:], strict=True
    ):
        assert body.joint is not None
        if mass <= 0 and (body.joint.kind is JointKind.PRISMATIC or moment <= 0):
            raise RobotDescriptionError(
                f"Joint '{body.joint.name}' moves link '{body.name}', which has no mass, so its "
                "dynamics are undefined. Give it an <inertial> or make the joint fixed."
            )


# -- form of the text -------------------------------------------------------------------------

_OTHER_FORMATS = {"sdf": "an SDF model", "mujoco": "a MuJoCo model"}

_ELEMENTS_READ = {
    "robot": ("link", "joint", "material", "disable_collisions", "world"),
    "link": ("inertial", "visual", "collision"),
    "joint": ("origin", "parent", "child", "axis", "limit", "mimic", "wheel"),
    "material": ("color",),
}
"""Element tags to read, by parent tag; other elements are ignored."""

_EXACT_ELEMENTS = ("origin", "mimic")
"""Elements with optional attributes: an unknown attribute is an error and would change the
robot."""

_GEOMETRIES = ("box", "cylinder", "sphere", "capsule", "mesh")
_ACCEPTED_GEOMETRIES = [[name] for name in _GEOMETRIES]
_GEOMETRY_REMEDY = f"a <geometry> with one of {', '.join(_GEOMETRIES)}"


@dataclass(frozen=True)
class _Attribute:
    """An attribute: count of its numbers (0: a text), meaning or unit, whether it is required."""

    name: str
    count: int
    meaning: str
    needed: bool = True


_ORIGIN_ATTRIBUTES = (
    _Attribute("xyz", 3, "m", needed=False),
    _Attribute("rpy", 3, "rad: roll, pitch and yaw", needed=False),
    _Attribute("quat_xyzw", 4, "a unit quaternion", needed=False),
)

_ATTRIBUTES = {
    "origin": _ORIGIN_ATTRIBUTES,
    "mass": (_Attribute("value", 1, "kg"),),
    "inertia": tuple(
        _Attribute(name, 1, "kg m^2") for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ),
    "parent": (_Attribute("link", 0, "the name of a link"),),
    "child": (_Attribute("link", 0, "the name of a link"),),
    "axis": (_Attribute("xyz", 3, "a direction"),),
    "limit": (
        _Attribute("velocity", 1, "m/s or rad/s"),
        _Attribute("effort", 1, "N or N m"),
        _Attribute("lower", 1, "m or rad", needed=False),
        _Attribute("upper", 1, "m or rad", needed=False),
    ),
    "mimic": (
        _Attribute("joint", 0, "the name of the joint to follow"),
        _Attribute(
            "multiplier", 1, "ratio of its motion to that of the leading joint", needed=False
        ),
        _Attribute("offset", 1, "m or rad", needed=False),
    ),
    "box": (_Attribute("size", 3, "m"),),
    "cylinder": (_Attribute("radius", 1, "m"), _Attribute("length", 1, "m")),
    "sphere": (_Attribute("radius", 1, "m"),),
    "capsule": (_Attribute("radius", 1, "m"), _Attribute("length", 1, "m")),
    "mesh": (
        _Attribute("filename", 0, "the file of the mesh"),
        _Attribute("scale", 3, "factors along x, y and z", needed=False),
    ),
    "color": (_Attribute("rgba", 4, "red, green, blue and opacity, from 0 to 1"),),
}

_REQUIRED_ELEMENTS = {
    "inertial": {"mass": '<mass value="..."/> in kg'},
    "visual": {"geometry": _GEOMETRY_REMEDY},
    "collision": {"geometry": _GEOMETRY_REMEDY},
    "joint": {"parent": '<parent link="..."/>', "child": '<child link="..."/>'},
}

_LIMITS_NOT_READ = ("acceleration", "deceleration", "jerk")
"""Limits of URDF 1.2 that are not enforced."""

_JOINT_TYPES = tuple(kind.value for kind in JointKind)


def _checked_root(text: str) -> Element:
    """Return the root of a URDF text, reduced to the :data:`_ELEMENTS_READ`."""
    try:
        root = fromstring(text)
    except (ParseError, ValueError) as error:
        raise RobotDescriptionError(
            f"The robot description is not valid URDF: it is not XML ({error})."
        ) from error
    if root.tag != "robot":
        raise RobotDescriptionError(
            "The robot description is not valid URDF but "
            f"{_OTHER_FORMATS.get(root.tag, 'something else')}: its root element is <{root.tag}>, "
            "but a URDF has the root element <robot>. Export or convert it to URDF."
        )
    for element in [root, *root.findall("link"), *root.findall("joint")]:
        unused = {child.tag for child in element} - set(_ELEMENTS_READ[element.tag])
        _remove_children(element, unused)
    for link in root.findall("link"):
        for collision in link.findall("collision"):
            # Other programs write forms of their own, such as planes.
            form = [each.tag for each in collision.iterfind("geometry/*")][0:1]
            if form not in _ACCEPTED_GEOMETRIES:
                warn_once(
                    f"A <collision> of link '{link.get('name', '')}' is "
                    f"{f'a <{form[0]}>' if form else 'empty'}, which is not supported: give it "
                    f"one of {', '.join(f'<{name}>' for name in _GEOMETRIES)}."
                )
                link.remove(collision)
    ignored = {
        name
        for limit in root.iterfind("joint/limit")
        for name in _LIMITS_NOT_READ
        if limit.get(name) is not None
    }
    if ignored:
        warn_once(
            f"The limits of {' and '.join(sorted(ignored))} in the URDF of "
            f"'{root.get('name', '')}' are ignored; only position, velocity and effort limits are "
            "enforced."
        )
    if not root.get("name"):
        raise _MalformedError("the <robot> has no name", '<robot name="...">')
    for kind in ("link", "joint"):
        for number, element in enumerate(root.findall(kind), 1):
            name = element.get("name", "")
            if not name:
                flaw = f"the {kind} number {number} has no name"
                raise _MalformedError(flaw, f'<{kind} name="...">')
            where = f"{kind} '{name}'"
            if kind == "joint":
                _require_type(element, where)
                if element.get("type") == "fixed":
                    _remove_children(element, ("axis", "limit", "mimic", "wheel"))
            _require_element(element, where)
    for material in root.findall("material"):
        _require_element(material, f"material '{material.get('name', '')}'")
    return root


def _remove_children(element: Element, tags: Collection[object]) -> None:
    for child in list(element):
        if child.tag in tags:
            element.remove(child)


class _MalformedError(RobotDescriptionError):
    """A flaw of the form of a URDF, with the text to write instead."""

    def __init__(self, flaw: str, remedy: str) -> None:
        super().__init__(f"The robot description is not valid URDF: {flaw}; write {remedy}.")


def _require_type(joint: Element, where: str) -> None:
    kind = joint.get("type")
    if kind is None:
        remedy = f'type="..." with one of {", ".join(_JOINT_TYPES)}'
        raise _MalformedError(f"the {where} has no type", remedy)
    if kind not in _JOINT_TYPES:
        raise RobotDescriptionError(
            f"The type of {where} is '{kind}'; a free-floating tree has "
            f"{', '.join(_JOINT_TYPES[:-1])} and {_JOINT_TYPES[-1]} joints. The base floats "
            "freely: remove any joint that connects it to a world, and that world's link."
        )


def _require_element(element: Element, where: str) -> None:
    if element.tag == "material":
        _remove_children(
            element, {child.tag for child in element} - set(_ELEMENTS_READ["material"])
        )
    owner = where if element.tag in ("link", "joint") else f"<{element.tag}> of {where}"
    for child, remedy in _REQUIRED_ELEMENTS.get(element.tag, {}).items():
        if element.find(child) is None:
            raise _MalformedError(f"the {owner} has no <{child}>", remedy)
    for tag, count in Counter(child.tag for child in element).items():
        if count > 1 and tag not in ("visual", "collision") and element.tag != "geometry":
            raise _MalformedError(f"the {owner} has {count} elements <{tag}>", "one of them")
    if element.tag == "geometry":
        _require_geometry(element, where)
    attributes = _ATTRIBUTES.get(element.tag, ())
    for attribute in attributes:
        _require_attribute(element, attribute, where)
    known = [attribute.name for attribute in attributes]
    unknown = set(element.keys()).difference(known)
    if unknown and element.tag in _EXACT_ELEMENTS:
        flaw = f"the <{element.tag}> of {where} has the unknown attribute '{min(unknown)}'"
        raise _MalformedError(flaw, f"one of {', '.join(known)}")
    for child_element in element:
        _require_element(child_element, where)


def _require_geometry(geometry: Element, where: str) -> None:
    shapes = [each.tag for each in geometry]
    remedy = f"one of {', '.join(f'<{name}>' for name in _GEOMETRIES)}"
    if len(shapes) != 1:
        raise _MalformedError(f"a <geometry> of {where} has {len(shapes)} shapes", remedy)
    if shapes[0] not in _GEOMETRIES:
        raise _MalformedError(f"a <geometry> of {where} is a <{shapes[0]}>", remedy)


def _require_attribute(element: Element, attribute: _Attribute, where: str) -> None:
    given = element.get(attribute.name)
    count = attribute.count
    numbers = {0: "", 1: "a number, "}.get(count, f"{count} numbers separated by spaces, ")
    remedy = f'<{element.tag} {attribute.name}="..."/>: {numbers}{attribute.meaning}'
    owner = f"the <{element.tag}> of {where}"
    if given is None:
        if attribute.needed:
            raise _MalformedError(f"{owner} has no '{attribute.name}'", remedy)
        return
    if not count:
        return
    words = given.split()
    wrong = next((word for word in words if not _is_number(word)), None)
    if wrong is not None:
        raise _MalformedError(
            f"'{attribute.name}' of {owner} has '{wrong}', which is not a number", remedy
        )
    if len(words) != count:
        flaw = f"'{attribute.name}' of {owner} has {len(words)} numbers instead of {count}"
        raise _MalformedError(flaw, remedy)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
