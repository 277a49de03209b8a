"""Reads the elements of a URDF: links, joints, and pairs of links whose contacts are ignored.

Every element and attribute is checked when it is read; error messages name the element and the
remedy. Elements that are not read are ignored.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np

from spacerobot_ros.errors import RobotDescriptionError, enumeration
from spacerobot_ros.files import warn_once
from spacerobot_ros.model.description import (
    Array,
    Inertia,
    Joint,
    JointKind,
    JointLimits,
    Link,
    Mimic,
    Pose,
    Shape,
    leading_limit,
)
from spacerobot_ros.model.inertial_parameters import INERTIA_ENTRIES, symmetric_of_entries
from spacerobot_ros.model.rotations import matrix_from_quaternion, matrix_from_rpy
from spacerobot_ros.resources import suggestion

_MAX_NUMBER = 1e12
"""Largest value (kg, m, kg m^2): larger values are typing errors, and their squares would
overflow."""

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


class MalformedError(RobotDescriptionError):
    """A formal error in a URDF, with the text to write instead."""

    def __init__(self, flaw: str, remedy: str) -> None:
        super().__init__(f"The robot description is not valid URDF: {flaw}; write {remedy}.")


def _child(parent: Element, tag: str, where: str) -> Element | None:
    """Return the only child with a tag; None: there is none. ``where`` is its link or joint."""
    found = parent.findall(tag)
    if len(found) > 1:
        flaw = f"the {_owner(parent, where)} has {len(found)} elements <{tag}>"
        raise MalformedError(flaw, "one of them")
    return found[0] if found else None


def _needed_child(parent: Element, tag: str, where: str) -> Element:
    found = _child(parent, tag, where)
    if found is None:
        raise MalformedError(f"the {_owner(parent, where)} has no <{tag}>", _REMEDIES[tag])
    return found


def _owner(element: Element, where: str) -> str:
    return where if element.tag in ("link", "joint") else f"<{element.tag}> of {where}"


def _text(element: Element, name: str, where: str, default: str | None = None) -> str:
    """Return an attribute; without a ``default``, it is required."""
    given = element.get(name, default)
    if given is None:
        flaw = f"the <{element.tag}> of {where} has no '{name}'"
        raise MalformedError(flaw, _attribute_remedy(element, name))
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
        raise MalformedError(flaw, _attribute_remedy(element, name))
    if len(words) != (count := _ATTRIBUTES[element.tag][name][0]):
        flaw = f"'{name}' of {owner} has {len(words)} numbers instead of {count}"
        raise MalformedError(flaw, _attribute_remedy(element, name))
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
        raise MalformedError(flaw, f"one of {', '.join(known)}")


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


def read_link(name: str, link: Element, colours: dict[str, tuple[float, ...]]) -> Link:
    """Read a link; ``colours`` are those of :func:`read_colours`."""
    where = f"link '{name}'"
    inertia = Inertia()
    if (inertial := _child(link, "inertial", where)) is not None:
        mass = _number(_needed_child(inertial, "mass", where), "value", where)
        about = read_inertia(_child(inertial, "inertia", where), where)
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


def read_inertia(moments: Element | None, where: str) -> Array:
    """Read the moments of inertia (3, 3), kg m^2, of a link; zero without ``<inertia>``."""
    if moments is None:
        return np.zeros((3, 3))
    return symmetric_of_entries(
        _number(moments, f"i{'xyz'[row]}{'xyz'[column]}", where) for row, column in INERTIA_ENTRIES
    )


def read_colours(root: Element) -> dict[str, tuple[float, ...]]:
    """Return the RGBA colours of a robot's materials by name."""
    return {
        name: _read_colour(color, f"material '{name}'")
        for material in root.findall("material")
        if (color := material.find("color")) is not None
        for name in (material.get("name", ""),)
    }


def _read_colour(color: Element, where: str) -> tuple[float, ...]:
    return tuple(_numbers(color, "rgba", where).tolist())


def _read_shape(element: Element, colours: dict[str, tuple[float, ...]], where: str) -> Shape:
    forms = list(_needed_child(element, "geometry", where))
    remedy = f"one of {', '.join(f'<{name}>' for name in _GEOMETRIES)}"
    if len(forms) != 1:
        raise MalformedError(f"a <geometry> of {where} has {len(forms)} shapes", remedy)
    (form,) = forms
    if form.tag not in _GEOMETRIES:
        raise MalformedError(f"a <geometry> of {where} is a <{form.tag}>", remedy)
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


def read_joint(name: str, joint: Element, links: dict[str, Link]) -> Joint:
    """Read a joint between two of the links."""
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
        raise MalformedError(f"the {where} has no type", remedy)
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


def with_leaders(joints: list[Joint]) -> list[Joint]:
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


# -- pairs of links ---------------------------------------------------------------------------


def disabled_pairs(root: Element, links: list[str], source: str) -> frozenset[frozenset[str]]:
    """Return the pairs of links whose contacts are ignored according to SRDF elements.

    Parameters
    ----------
    root
        Root of an SRDF, or of a URDF that contains SRDF elements.
    links
        Link names of the robot.
    source
        Subject of the error message about an unknown link.

    Raises
    ------
    RobotDescriptionError
        An element names an unknown link.
    """
    quiet = {
        _read_link_name(each, "link", links, source)
        for each in root.findall("disable_default_collisions")
    }
    disabled = {
        frozenset(pair) for pair in itertools.combinations(links, 2) if not quiet.isdisjoint(pair)
    }
    disabled |= {_read_pair(each, links, source) for each in root.findall("disable_collisions")}
    disabled -= {_read_pair(each, links, source) for each in root.findall("enable_collisions")}
    return frozenset(disabled)


def _read_pair(element: Element, links: list[str], source: str) -> frozenset[str]:
    return frozenset(_read_link_name(element, name, links, source) for name in ("link1", "link2"))


def _read_link_name(element: Element, attribute: str, links: list[str], source: str) -> str:
    name = element.get(attribute)
    if name not in links:
        raise RobotDescriptionError(
            f"{source} has a <{element.tag}> whose {attribute} is '{name or ''}', but the "
            f"robot has no such link.{suggestion(name or '', links)}"
        )
    return name
