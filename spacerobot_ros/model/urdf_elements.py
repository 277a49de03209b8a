"""Reads the elements of a URDF: links, joints, and pairs of links whose contacts are ignored.

Every element and attribute is checked when it is read; error messages name the element and the
remedy. Elements that are not read are ignored.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element

import numpy as np

from spacerobot_ros.errors import RobotDescriptionError, counted, enumeration
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
    "mesh": {"filename": (0, "the file of the mesh"), "scale": (3, "factors along x, y and z")},
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


@dataclass(frozen=True)
class _Part:
    """An element of a link, joint or material, which is named in messages."""

    element: Element
    where: str

    @property
    def name(self) -> str:
        tag = self.element.tag
        return self.where if tag in ("link", "joint") else f"<{tag}> of {self.where}"

    def child(self, tag: str) -> _Part | None:
        """Return the only child with a tag; None: there is none."""
        found = self.element.findall(tag)
        if len(found) > 1:
            flaw = f"the {self.name} has {len(found)} elements <{tag}>"
            raise MalformedError(flaw, "one of them")
        return _Part(found[0], self.where) if found else None

    def needed_child(self, tag: str) -> _Part:
        found = self.child(tag)
        if found is None:
            raise MalformedError(f"the {self.name} has no <{tag}>", _REMEDIES[tag])
        return found

    def text(self, name: str, default: str | None = None) -> str:
        """Return an attribute; without a ``default``, it is required."""
        given = self.element.get(name, default)
        if given is None:
            raise self._malformed(f"the {self.name} has no '{name}'", name)
        return given

    def numbers(self, name: str, default: str | None = None, largest: float = _MAX_NUMBER) -> Array:
        """Return the numbers of an attribute (k,); without a ``default``, it is required."""
        words, (count, _) = self.text(name, default).split(), _ATTRIBUTES[self.element.tag][name]
        wrong = next((word for word in words if not _is_number(word)), None)
        if wrong is not None:
            flaw = f"'{name}' of the {self.name} has '{wrong}', which is not a number"
            raise self._malformed(flaw, name)
        if len(words) != count:
            given = counted(len(words), "number")
            flaw = f"'{name}' of the {self.name} has {given} instead of {count}"
            raise self._malformed(flaw, name)
        numbers = np.array(words, dtype=float)
        if not np.all(np.abs(numbers) <= largest):
            finite = np.isfinite(numbers).all()
            flaw = f"is larger than {_MAX_NUMBER:g} in its SI unit" if finite else "is not finite"
            raise RobotDescriptionError(f"A number in the {self.name} {flaw}: {' '.join(words)}.")
        return numbers

    def number(self, name: str, default: str | None = None) -> float:
        return float(self.numbers(name, default)[0])

    def require_known_attributes(self) -> None:
        """Reject unknown attributes if all attributes are optional: they are misspelt."""
        known = _ATTRIBUTES[self.element.tag]
        if unknown := set(self.element.keys()).difference(known):
            flaw = f"the {self.name} has the unknown attribute '{min(unknown)}'"
            raise MalformedError(flaw, f"one of {', '.join(known)}")

    def _malformed(self, flaw: str, attribute: str) -> MalformedError:
        tag = self.element.tag
        count, meaning = _ATTRIBUTES[tag][attribute]
        numbers = {0: "", 1: "a number, "}.get(count, f"{count} numbers separated by spaces, ")
        return MalformedError(flaw, f'<{tag} {attribute}="..."/>: {numbers}{meaning}')


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


# -- links ------------------------------------------------------------------------------------


def _read_pose(part: _Part) -> Pose:
    origin, where = part.child("origin"), part.where
    if origin is None:
        return Pose()
    origin.require_known_attributes()
    r = origin.numbers("xyz", "0 0 0")
    if origin.element.get("quat_xyzw") is None:
        return Pose(matrix_from_rpy(origin.numbers("rpy", "0 0 0")), r)
    quaternion = origin.numbers("quat_xyzw")
    if origin.element.get("rpy") is not None:
        raise RobotDescriptionError(
            f"The origin of {where} has both 'rpy' and 'quat_xyzw': give one."
        )
    if not (length := float(np.linalg.norm(quaternion))):
        raise RobotDescriptionError(
            f"'quat_xyzw' in the origin of {where} is zero: give a unit quaternion."
        )
    return Pose(matrix_from_quaternion(quaternion / length), r)


def read_link(name: str, element: Element, colours: dict[str, tuple[float, ...]]) -> Link:
    """Read a link; ``colours`` are those of :func:`read_colours`."""
    where = f"link '{name}'"
    inertia = Inertia()
    if (inertial := _Part(element, where).child("inertial")) is not None:
        mass = inertial.needed_child("mass").number("value")
        moments = inertial.child("inertia")
        about = np.zeros((3, 3)) if moments is None else read_inertia(moments.element, where)
        if mass < 0:
            raise RobotDescriptionError(f"The mass of {where} is negative ({mass} kg).")
        inertia = Inertia(mass, np.zeros(3), about).moved(_read_pose(inertial))
    shapes = [_read_shape(_Part(each, where), colours) for each in element.findall("visual")]
    supported = [each for each in element.findall("collision") if _is_supported(each, where)]
    collisions = [_read_shape(_Part(each, where), colours) for each in supported]
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


def read_inertia(moments: Element, where: str) -> Array:
    """Read the moments of inertia (3, 3), kg m^2, of a link."""
    part = _Part(moments, where)
    return symmetric_of_entries(
        part.number(f"i{'xyz'[row]}{'xyz'[column]}") for row, column in INERTIA_ENTRIES
    )


def read_colours(root: Element) -> dict[str, tuple[float, ...]]:
    """Return the RGBA colours of a robot's materials by name."""
    colours = {}
    for material in root.findall("material"):
        if (color := material.find("color")) is not None:
            name = material.get("name", "")
            colours[name] = tuple(_Part(color, f"material '{name}'").numbers("rgba").tolist())
    return colours


def _read_shape(part: _Part, colours: dict[str, tuple[float, ...]]) -> Shape:
    where, forms = part.where, list(part.needed_child("geometry").element)
    remedy = f"one of {', '.join(f'<{name}>' for name in _GEOMETRIES)}"
    if len(forms) != 1:
        raise MalformedError(f"a <geometry> of {where} has {len(forms)} shapes", remedy)
    kind, form = forms[0].tag, _Part(forms[0], where)
    if kind not in _GEOMETRIES:
        raise MalformedError(f"a <geometry> of {where} is a <{kind}>", remedy)
    resource = ""
    if kind == "mesh":
        resource = form.text("filename")
        scale = form.element.get("scale", "1")
        if len(scale.split()) == 1:  # One factor for all axes
            form.element.set("scale", " ".join([scale] * 3))
        size = form.numbers("scale")  # A negative scale mirrors.
    else:
        size = np.concatenate([form.numbers(name) for name in _ATTRIBUTES[kind]])
        if size.min() < 0:
            raise RobotDescriptionError(
                f"A size in a <geometry> of {where} is negative: {size.tolist()}. "
                "Give lengths in m."
            )
    rgba: tuple[float, ...] = Shape.rgba
    # Of several materials, the first counts, as in urdfdom.
    if (found := part.element.find("material")) is not None:
        material = _Part(found, part.where)
        if (color := material.child("color")) is not None:
            rgba = tuple(color.numbers("rgba").tolist())
        else:
            rgba = colours.get(material.element.get("name", ""), rgba)
    red, green, blue, opacity = rgba
    pose = _read_pose(part)
    return Shape(kind, tuple(size.tolist()), pose, (red, green, blue, opacity), resource)


# -- joints -----------------------------------------------------------------------------------


def read_joint(name: str, element: Element, links: dict[str, Link]) -> Joint:
    """Read a joint between two of the links."""
    where = f"joint '{name}'"
    joint, ends = _Part(element, where), {}
    kind = _read_kind(joint)
    for role in ("parent", "child"):
        ends[role] = joint.needed_child(role).text("link")
        if ends[role] not in links:
            raise RobotDescriptionError(
                f"The {role} of {where} is '{ends[role]}', but there is no such link."
                f"{suggestion(ends[role], links)}"
            )
    pose, axis = _read_pose(joint), np.array([1.0, 0.0, 0.0])
    if kind is JointKind.FIXED:
        return Joint(name, kind, ends["parent"], ends["child"], pose, axis, JointLimits())
    if (given := joint.child("axis")) is not None:
        axis = given.numbers("xyz")
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
        _read_limits(joint, kind),
        _read_mimic(joint),
        element.find("wheel") is not None,
    )


def _read_kind(joint: _Part) -> JointKind:
    kinds, kind = [each.value for each in JointKind], joint.element.get("type")
    if kind is None:
        remedy = f'type="..." with one of {", ".join(kinds)}'
        raise MalformedError(f"the {joint.where} has no type", remedy)
    if kind not in kinds:
        raise RobotDescriptionError(
            f"The type of {joint.where} is '{kind}'; a free-floating tree has "
            f"{enumeration(kinds)} joints. The base floats freely: remove any joint that connects "
            "it to a world, and that world's link; elsewhere, use several joints in a row, with "
            "massless links between them."
        )
    return JointKind(kind)


def _read_mimic(joint: _Part) -> Mimic | None:
    if (mimic := joint.child("mimic")) is None:
        return None
    mimic.require_known_attributes()
    leader, multiplier = mimic.text("joint"), mimic.number("multiplier", "1")
    if multiplier == 0:
        raise RobotDescriptionError(
            f"The {joint.where} mimics '{leader}' with multiplier 0: it does not move; make it "
            "fixed."
        )
    return Mimic(leader, multiplier, mimic.number("offset", "0"))


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


def _read_limits(joint: _Part, kind: JointKind) -> JointLimits:
    where = joint.where
    if (limit := joint.child("limit")) is None:
        if kind in (JointKind.FIXED, JointKind.CONTINUOUS):
            return JointLimits()
        raise RobotDescriptionError(
            f"The {where} is {kind.value} and has no <limit>: "
            "give lower, upper, velocity and effort."
        )
    values = {}
    for name, default in (("lower", "0"), ("upper", "0"), ("velocity", None), ("effort", None)):
        (number,) = limit.numbers(name, default, largest=math.inf).tolist()
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
