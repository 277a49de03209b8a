"""Reads URDF files and strings into :class:`.RobotDescription`.

Every element and attribute is checked when it is read; messages name the element and its
correction. Elements that are not read are ignored. Links connected by fixed joints are merged, and
robots with singular equations are rejected.
"""

from __future__ import annotations

import math
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

import numpy as np

from spacerobot_ros.errors import RobotDescriptionError, enumeration, reason
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
"""Largest value (kg, m, kg m^2): larger values are typing errors, and their squares would
overflow."""

_MAX_LINKS = 200

_XACRO_CPU_TIME = 10
"""CPU time limit for expanding a xacro file, s; the wall time limit is six times as long."""

XACRO_ARGUMENTS_VARIABLE = "SPACEROBOT_XACRO_ARGS"
"""Environment variable with xacro arguments, ``NAME:=VALUE``, separated as in a shell."""


def load_robot(path: str | Path) -> RobotDescription:
    """Read a robot from a URDF file, or from a xacro file, which is identified by its suffix.

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
    """Return the description in a file, with absolute mesh paths."""
    text = _read_text(path)
    try:
        return parse(text)
    except RobotDescriptionError as error:
        remedy = ""
        if path.suffix != ".xacro" and ("<xacro:" in text or "${" in text):
            remedy = f" To expand xacro in it, rename it to {path.stem}.xacro."
        raise RobotDescriptionError(f"{path}: {error}{remedy}") from error


def _read_text(path: Path) -> str:
    """Return the URDF text of a file, expanded and with absolute mesh paths."""
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
    if description.bodies[0].inertia.mass <= 0:
        raise RobotDescriptionError(
            f"The base link '{description.base_link}' has no mass; a free-floating base needs an "
            "<inertial> with mass and inertia. Give it the mass and inertia of the spacecraft "
            'that carries the robot, for instance <inertial><mass value="100"/><inertia ixx="10" '
            'iyy="10" izz="10" ixy="0" ixz="0" iyz="0"/></inertial>.'
        )
    require_reaction_wheels(description)
    return description


def with_held_joints(robot: RobotDescription, positions: Array | None = None) -> RobotDescription:
    """Return a robot with locked joints as one rigid body; its URDF is changed accordingly.

    Parameters
    ----------
    robot
        The robot.
    positions
        (n,) m or rad, in joint order; by default zero, or the nearest limit.

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
        for tag in ("origin", "axis", "limit", "mimic", "wheel", "dynamics"):
            for child in element.findall(tag):
                element.remove(child)
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
    """Return the links and joints of a URDF text, regardless of their masses."""
    root = _root_of(text)
    elements = {kind: _named_elements(root, kind) for kind in ("link", "joint")}
    if len(elements["link"]) > _MAX_LINKS:
        raise RobotDescriptionError(
            f"The robot description has more than {_MAX_LINKS} links: deriving its equations "
            "would take hours."
        )
    colours = {
        material.get("name", ""): _read_colour(color, f"material '{material.get('name', '')}'")
        for material in root.findall("material")
        if (color := material.find("color")) is not None
    }
    links = {name: _read_link(name, each, colours) for name, each in elements["link"].items()}
    _name_limits_not_read(root)
    joints = _with_leaders(
        [_read_joint(name, each, links) for name, each in elements["joint"].items()]
    )
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


def _root_of(text: str) -> Element:
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
    if not root.get("name"):
        raise _MalformedError("the <robot> has no name", '<robot name="...">')
    return root


def _named_elements(root: Element, kind: str) -> dict[str, Element]:
    """Return the links or joints by their names, which are unique."""
    found: dict[str, Element] = {}
    for number, element in enumerate(root.findall(kind), 1):
        name = element.get("name", "")
        if not name:
            raise _MalformedError(f"the {kind} number {number} has no name", f'<{kind} name="...">')
        if name in found:
            raise RobotDescriptionError(
                f"The {kind} name '{name}' is used twice; names must be unique."
            )
        found[name] = element
    return found


def _name_limits_not_read(root: Element) -> None:
    given = {name for limit in root.iterfind("joint/limit") for name in limit.attrib}
    ignored = [name for name in _LIMITS_NOT_READ if name in given]
    if ignored:
        warn_once(
            f"The limits of {enumeration(ignored)} in the URDF of '{root.get('name', '')}' are "
            "ignored; only position, velocity and effort limits are enforced."
        )


# -- elements and attributes ------------------------------------------------------------------

_OTHER_FORMATS = {"sdf": "an SDF model", "mujoco": "a MuJoCo model"}

_LIMITS_NOT_READ = ("acceleration", "deceleration", "jerk")
"""Limits of URDF 1.2 that are not enforced."""

_ATTRIBUTES = {
    "origin": {
        "xyz": (3, "m"),
        "rpy": (3, "rad: roll, pitch and yaw"),
        "quat_xyzw": (4, "a unit quaternion"),
    },
    "mass": {"value": (1, "kg")},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (1, "kg m^2")),
    "parent": {"link": (0, "the name of a link")},
    "child": {"link": (0, "the name of a link")},
    "axis": {"xyz": (3, "a direction")},
    "limit": {
        "velocity": (1, "m/s or rad/s"),
        "effort": (1, "N or N m"),
        "lower": (1, "m or rad"),
        "upper": (1, "m or rad"),
    },
    "mimic": {
        "joint": (0, "the name of the joint to follow"),
        "multiplier": (1, "ratio of its motion to that of the leading joint"),
        "offset": (1, "m or rad"),
    },
    "box": {"size": (3, "m")},
    "cylinder": {"radius": (1, "m"), "length": (1, "m")},
    "sphere": {"radius": (1, "m")},
    "capsule": {"radius": (1, "m"), "length": (1, "m")},
    "mesh": {
        "filename": (0, "the file of the mesh"),
        "scale": (3, "factors along x, y and z"),
    },
    "color": {"rgba": (4, "red, green, blue and opacity, from 0 to 1")},
}
"""Count of numbers (0: text), and meaning or unit, of every attribute that is read."""

_GEOMETRIES = ("box", "cylinder", "sphere", "capsule", "mesh")

_REMEDIES = {
    "mass": '<mass value="..."/> in kg',
    "geometry": f"a <geometry> with one of {', '.join(_GEOMETRIES)}",
    "parent": '<parent link="..."/>',
    "child": '<child link="..."/>',
}
"""What to write for an element that is missing."""


class _MalformedError(RobotDescriptionError):
    """A formal error in a URDF, with the text to write instead."""

    def __init__(self, flaw: str, remedy: str) -> None:
        super().__init__(f"The robot description is not valid URDF: {flaw}; write {remedy}.")


def _child(parent: Element, tag: str, where: str) -> Element | None:
    """Return the only child with a tag; None: there is none. ``where`` is its link or joint."""
    found = parent.findall(tag)
    if len(found) > 1:
        flaw = f"the {_owner(parent, where)} has {len(found)} elements <{tag}>"
        raise _MalformedError(flaw, "one of them")
    return found[0] if found else None


def _needed_child(parent: Element, tag: str, where: str) -> Element:
    found = _child(parent, tag, where)
    if found is None:
        raise _MalformedError(f"the {_owner(parent, where)} has no <{tag}>", _REMEDIES[tag])
    return found


def _owner(element: Element, where: str) -> str:
    return where if element.tag in ("link", "joint") else f"<{element.tag}> of {where}"


def _text(element: Element, name: str, where: str, default: str | None = None) -> str:
    """Return an attribute; without a ``default``, it is required."""
    given = element.get(name, default)
    if given is None:
        flaw = f"the <{element.tag}> of {where} has no '{name}'"
        raise _MalformedError(flaw, _attribute_remedy(element, name))
    return given


def _attribute_remedy(element: Element, name: str) -> str:
    count, meaning = _ATTRIBUTES[element.tag][name]
    numbers = {0: "", 1: "a number, "}.get(count, f"{count} numbers separated by spaces, ")
    return f'<{element.tag} {name}="..."/>: {numbers}{meaning}'


def _numbers(
    element: Element,
    name: str,
    where: str,
    default: str | None = None,
    largest: float = _MAX_NUMBER,
) -> Array:
    """Return the numbers of an attribute (k,); without a ``default``, it is required."""
    words, owner = _text(element, name, where, default).split(), f"the <{element.tag}> of {where}"
    wrong = next((word for word in words if not _is_number(word)), None)
    if wrong is not None:
        flaw = f"'{name}' of {owner} has '{wrong}', which is not a number"
        raise _MalformedError(flaw, _attribute_remedy(element, name))
    if len(words) != (count := _ATTRIBUTES[element.tag][name][0]):
        flaw = f"'{name}' of {owner} has {len(words)} numbers instead of {count}"
        raise _MalformedError(flaw, _attribute_remedy(element, name))
    numbers = np.array(words, dtype=float)
    if not np.all(np.abs(numbers) <= largest):
        finite = np.isfinite(numbers).all()
        flaw = f"is larger than {_MAX_NUMBER:g} in its SI unit" if finite else "is not finite"
        raise RobotDescriptionError(f"A number in {owner} {flaw}: {' '.join(words)}.")
    return numbers


def _number(element: Element, name: str, where: str, default: str | None = None) -> float:
    return float(_numbers(element, name, where, default)[0])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def _require_known_attributes(element: Element, where: str) -> None:
    """Reject unknown attributes of an element whose attributes are optional: they are misspelt."""
    known = _ATTRIBUTES[element.tag]
    if unknown := set(element.keys()).difference(known):
        flaw = f"the <{element.tag}> of {where} has the unknown attribute '{min(unknown)}'"
        raise _MalformedError(flaw, f"one of {', '.join(known)}")


# -- links ------------------------------------------------------------------------------------


def _read_pose(element: Element, where: str) -> Pose:
    origin = _child(element, "origin", where)
    if origin is None:
        return Pose()
    _require_known_attributes(origin, where)
    r = _numbers(origin, "xyz", where, "0 0 0")
    if origin.get("quat_xyzw") is None:
        return Pose(matrix_from_rpy(_numbers(origin, "rpy", where, "0 0 0")), r)
    quaternion = _numbers(origin, "quat_xyzw", where)
    if origin.get("rpy") is not None:
        raise RobotDescriptionError(
            f"The origin of {where} has both 'rpy' and 'quat_xyzw': give one."
        )
    if not (length := float(np.linalg.norm(quaternion))):
        raise RobotDescriptionError(
            f"'quat_xyzw' in the origin of {where} is zero: give a unit quaternion."
        )
    return Pose(matrix_from_quaternion(quaternion / length), r)


def _read_link(name: str, link: Element, colours: dict[str, tuple[float, ...]]) -> Link:
    where = f"link '{name}'"
    inertia = Inertia()
    if (inertial := _child(link, "inertial", where)) is not None:
        mass = _number(_needed_child(inertial, "mass", where), "value", where)
        about = _read_inertia(_child(inertial, "inertia", where), where)
        if mass < 0:
            raise RobotDescriptionError(f"The mass of {where} is negative ({mass} kg).")
        inertia = Inertia(mass, np.zeros(3), about).moved(_read_pose(inertial, where))
    shapes = [_read_shape(each, colours, where) for each in link.findall("visual")]
    supported = [each for each in link.findall("collision") if _is_supported(each, where)]
    collisions = [_read_shape(each, colours, where) for each in supported]
    return Link(name, inertia, tuple(shapes), tuple(collisions))


def _is_supported(collision: Element, where: str) -> bool:
    """Warn about shapes known only to other programs, such as planes."""
    form = next((each.tag for each in collision.iterfind("geometry/*")), None)
    if form not in _GEOMETRIES:
        warn_once(
            f"A <collision> of {where} is {f'a <{form}>' if form else 'empty'}, which is not "
            f"supported: give it one of {', '.join(f'<{name}>' for name in _GEOMETRIES)}."
        )
    return form in _GEOMETRIES


def _read_inertia(moments: Element | None, where: str) -> Array:
    if moments is None:
        return np.zeros((3, 3))
    return symmetric_of_entries(
        _number(moments, f"i{'xyz'[row]}{'xyz'[column]}", where) for row, column in INERTIA_ENTRIES
    )


def describe_inertia_flaw(about: Array) -> str:
    """Return a clause that describes impossible moments of inertia (3, 3), kg m^2; empty if the
    moments are possible.

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

    An impossible inertia is replaced by the nearest possible inertia in the Frobenius norm. Also
    return the relative change in inertia of each such link, in that norm.

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
    """Reject a body with impossible inertia; the message names the worst of its welded links."""

    def excess(link: Link) -> float:
        low, middle, high = np.linalg.eigvalsh(link.inertia.about_com)
        return float(max(high - middle - low, -low))

    worst = max(welded, key=excess)
    raise RobotDescriptionError(
        f"The inertia of link '{worst.name}' {describe_inertia_flaw(worst.inertia.about_com)} "
        "`spacerobot new URDF --nearest-inertia` writes a URDF with the nearest possible inertia."
    )


def _read_colour(color: Element, where: str) -> tuple[float, ...]:
    return tuple(_numbers(color, "rgba", where).tolist())


def _read_shape(element: Element, colours: dict[str, tuple[float, ...]], where: str) -> Shape:
    forms = list(_needed_child(element, "geometry", where))
    remedy = f"one of {', '.join(f'<{name}>' for name in _GEOMETRIES)}"
    if len(forms) != 1:
        raise _MalformedError(f"a <geometry> of {where} has {len(forms)} shapes", remedy)
    (form,) = forms
    if form.tag not in _GEOMETRIES:
        raise _MalformedError(f"a <geometry> of {where} is a <{form.tag}>", remedy)
    resource = ""
    if form.tag == "mesh":
        resource = _text(form, "filename", where)
        size = _numbers(form, "scale", where, "1 1 1")  # A negative scale mirrors.
    else:
        size = np.concatenate([_numbers(form, name, where) for name in _ATTRIBUTES[form.tag]])
        if size.min() < 0:
            raise RobotDescriptionError(
                f"A size in a <geometry> of {where} is negative: {size.tolist()}. "
                "Give lengths in m."
            )
    rgba: tuple[float, ...] = Shape.rgba
    if (material := _child(element, "material", where)) is not None:
        color = _child(material, "color", where)
        if color is not None:
            rgba = _read_colour(color, where)
        else:
            rgba = colours.get(material.get("name", ""), rgba)
    red, green, blue, opacity = rgba
    pose = _read_pose(element, where)
    return Shape(form.tag, tuple(size.tolist()), pose, (red, green, blue, opacity), resource)


# -- joints -----------------------------------------------------------------------------------


def _read_joint(name: str, joint: Element, links: dict[str, Link]) -> Joint:
    where = f"joint '{name}'"
    kind = _read_kind(joint, where)
    ends = {}
    for role in ("parent", "child"):
        ends[role] = _text(_needed_child(joint, role, where), "link", where)
        if ends[role] not in links:
            raise RobotDescriptionError(
                f"The {role} of {where} is '{ends[role]}', but there is no such link."
                f"{suggestion(ends[role], links)}"
            )
    pose, axis = _read_pose(joint, where), np.array([1.0, 0.0, 0.0])
    if kind is JointKind.FIXED:
        return Joint(name, kind, ends["parent"], ends["child"], pose, axis, JointLimits())
    if (given := _child(joint, "axis", where)) is not None:
        axis = _numbers(given, "xyz", where)
    norm = float(np.linalg.norm(axis))
    if norm < 1e-9:
        raise RobotDescriptionError(f"The axis of {where} is zero; give it a direction.")
    return Joint(
        name,
        kind,
        ends["parent"],
        ends["child"],
        pose,
        axis / norm,
        _read_limits(_child(joint, "limit", where), kind, where),
        _read_mimic(_child(joint, "mimic", where), where),
        joint.find("wheel") is not None,
    )


def _read_kind(joint: Element, where: str) -> JointKind:
    kinds, kind = [each.value for each in JointKind], joint.get("type")
    if kind is None:
        remedy = f'type="..." with one of {", ".join(kinds)}'
        raise _MalformedError(f"the {where} has no type", remedy)
    if kind not in kinds:
        raise RobotDescriptionError(
            f"The type of {where} is '{kind}'; a free-floating tree has "
            f"{enumeration(kinds)} joints. The base floats "
            "freely: remove any joint that connects it to a world, and that world's link."
        )
    return JointKind(kind)


def _read_mimic(mimic: Element | None, where: str) -> Mimic | None:
    if mimic is None:
        return None
    _require_known_attributes(mimic, where)
    leader = _text(mimic, "joint", where)
    multiplier = _number(mimic, "multiplier", where, "1")
    if multiplier == 0:
        raise RobotDescriptionError(
            f"The {where} mimics '{leader}' with multiplier 0: it does not move; make it fixed."
        )
    return Mimic(leader, multiplier, _number(mimic, "offset", where, "0"))


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
"""Position, m or rad, beyond which a limit is treated as no limit."""


def _read_limits(limit: Element | None, kind: JointKind, where: str) -> JointLimits:
    if limit is None:
        if kind in (JointKind.FIXED, JointKind.CONTINUOUS):
            return JointLimits()
        raise RobotDescriptionError(
            f"The {where} is {kind.value} and has no <limit>: "
            "give lower, upper, velocity and effort."
        )
    values = {}
    for name, default in (("lower", "0"), ("upper", "0"), ("velocity", None), ("effort", None)):
        (number,) = _numbers(limit, name, where, default, largest=math.inf).tolist()
        values[name] = number or 0.0
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
