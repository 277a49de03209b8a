"""The form of a URDF: which elements have which attributes, with a sentence for each that is wrong.

urdf_parser_py refuses what is wrong, but names neither the element nor what to write there.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from xml.etree.ElementTree import Element, ParseError, fromstring

from spacerobot_ros.errors import RobotDescriptionError

_OTHER_FORMATS = {"sdf": "an SDF model", "mujoco": "a MuJoCo model", "COLLADA": "a COLLADA file"}
"""What files with another root element than <robot> are."""

_USED = {
    "robot": ("link", "joint", "material"),
    "link": ("inertial", "visual"),
    "joint": ("origin", "parent", "child", "axis", "limit", "mimic"),
    "material": ("color",),
}
"""Elements that are read; others are of other programs, or say what nothing here asks for."""

_GEOMETRIES = ("box", "cylinder", "sphere", "mesh")


@dataclass(frozen=True)
class _Attribute:
    """An attribute: its count of numbers (0: a text), its meaning, whether it is required."""

    name: str
    count: int
    meaning: str
    needed: bool = True


_ORIGIN = (
    _Attribute("xyz", 3, "m", needed=False),
    _Attribute("rpy", 3, "rad: roll, pitch and yaw", needed=False),
)

_ATTRIBUTES = {
    "origin": _ORIGIN,
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
        _Attribute("joint", 0, "the name of the joint that it follows"),
        _Attribute("multiplier", 1, "its position over that of the other", needed=False),
        _Attribute("offset", 1, "m or rad", needed=False),
    ),
    "box": (_Attribute("size", 3, "m"),),
    "cylinder": (_Attribute("radius", 1, "m"), _Attribute("length", 1, "m")),
    "sphere": (_Attribute("radius", 1, "m"),),
    "mesh": (
        _Attribute("filename", 0, "the file of the mesh"),
        _Attribute("scale", 3, "factors along x, y and z", needed=False),
    ),
    "color": (_Attribute("rgba", 4, "red, green, blue and opacity, from 0 to 1"),),
}

_NEEDED = {
    "inertial": {"mass": '<mass value="..."/> in kg'},
    "visual": {"geometry": f"a <geometry> with one of {', '.join(_GEOMETRIES)}"},
    "joint": {"parent": '<parent link="..."/>', "child": '<child link="..."/>'},
}
"""Elements that others must have, and what to write."""


def urdf_root(text: str, joint_types: tuple[str, ...]) -> Element:
    """Return the root of a URDF text without what is not read; see :data:`_USED`.

    Raises
    ------
    RobotDescriptionError
        The text is no XML, or no URDF; an attribute or an element is missing or is no number.
    """
    try:
        root = fromstring(text)
    except (ParseError, ValueError) as error:
        raise RobotDescriptionError(
            f"The robot description is not valid URDF: it is no XML ({error})."
        ) from error
    if root.tag != "robot":
        raise RobotDescriptionError(_of_another_kind(root.tag))
    for element in [root, *root.findall("link"), *root.findall("joint")]:
        unused = {child.tag for child in element} - set(_USED[element.tag])
        _leave_out(element, unused)
    if not root.get("name"):
        raise _MalformedError("the <robot> has no name", '<robot name="...">')
    for kind in ("link", "joint"):
        for number, element in enumerate(root.findall(kind), 1):
            name = element.get("name", "")
            if not name:
                what = f"the {kind} number {number} has no name"
                raise _MalformedError(what, f'<{kind} name="...">')
            where = f"{kind} '{name}'"
            if kind == "joint":
                _require_type(element, where, joint_types)
                if element.get("type") == "fixed":
                    _leave_out(element, ("axis", "limit", "mimic"))
            _require(element, where)
    for material in root.findall("material"):
        _require(material, f"material '{material.get('name', '')}'")
    return root


def _leave_out(element: Element, tags: Collection[object]) -> None:
    for child in list(element):
        if child.tag in tags:
            element.remove(child)


class _MalformedError(RobotDescriptionError):
    """What is wrong, in what, and what to write instead."""

    def __init__(self, what: str, mend: str) -> None:
        super().__init__(f"The robot description is not valid URDF: {what}; write {mend}.")


def _of_another_kind(tag: str) -> str:
    namespace = re.fullmatch(r"\{(.*)\}robot", tag)
    if namespace is not None:
        return (
            "The robot description is not valid URDF: its elements are in the namespace "
            f"'{namespace[1]}'; remove xmlns=\"...\" from <robot>."
        )
    return (
        f"The robot description is not valid URDF but {_OTHER_FORMATS.get(tag, 'something else')}: "
        f"its root element is <{tag}>, and that of a URDF is <robot>. Export or convert it to URDF."
    )


def _require_type(joint: Element, where: str, types: tuple[str, ...]) -> None:
    kind = joint.get("type")
    if kind is None:
        mend = f'type="..." with one of {", ".join(types)}'
        raise _MalformedError(f"the {where} has no type", mend)
    if kind not in types:
        raise RobotDescriptionError(
            f"The type of {where} is '{kind}'; a free-floating tree has "
            f"{', '.join(types[:-1])} and {types[-1]} joints (the base floats by itself)."
        )


def _require(element: Element, where: str) -> None:
    """Check an element of a link, joint or material, and those in it."""
    if element.tag == "material":
        _leave_out(element, {child.tag for child in element} - set(_USED["material"]))
    for child, mend in _NEEDED.get(element.tag, {}).items():
        if element.find(child) is None:
            owner = where if element.tag == "joint" else f"<{element.tag}> of {where}"
            raise _MalformedError(f"the {owner} has no <{child}>", mend)
    if element.tag == "geometry":
        _require_geometry(element, where)
    for attribute in _ATTRIBUTES.get(element.tag, ()):
        _require_attribute(element, attribute, where)
    for child_element in element:
        _require(child_element, where)


def _require_geometry(geometry: Element, where: str) -> None:
    shapes = [each.tag for each in geometry]
    mend = f"one of {', '.join(f'<{name}>' for name in _GEOMETRIES)}"
    if len(shapes) != 1:
        raise _MalformedError(f"a <geometry> of {where} has {len(shapes)} shapes", mend)
    if shapes[0] not in _GEOMETRIES:
        raise _MalformedError(f"a <geometry> of {where} is a <{shapes[0]}>", mend)


def _require_attribute(element: Element, attribute: _Attribute, where: str) -> None:
    given = element.get(attribute.name)
    count = attribute.count
    numbers = {0: "", 1: "a number, "}.get(count, f"{count} numbers with blanks between them, ")
    mend = f'<{element.tag} {attribute.name}="..."/>: {numbers}{attribute.meaning}'
    if given is None:
        if attribute.needed:
            raise _MalformedError(f"the <{element.tag}> of {where} has no '{attribute.name}'", mend)
        return
    if not count:
        return
    words = given.split()
    wrong = next((word for word in words if not _is_number(word)), None)
    if wrong is not None:
        what = f"'{attribute.name}' of the <{element.tag}> of {where} has '{wrong}', no number"
        raise _MalformedError(what, mend)
    if len(words) != count:
        what = (
            f"'{attribute.name}' of the <{element.tag}> of {where} has {len(words)} numbers "
            f"instead of {count}"
        )
        raise _MalformedError(what, mend)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
