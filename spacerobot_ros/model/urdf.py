"""URDF text to :class:`RobotDescription`, refusing what cannot float, with a sentence."""

from __future__ import annotations

import contextlib
import io
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import quote, unquote, urlparse
from xml.etree import ElementTree
from xml.sax.saxutils import unescape

import numpy as np
from urdf_parser_py.urdf import URDF

from spacerobot_ros.errors import RobotDescriptionError, SpaceRobotError
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
    weld,
)
from spacerobot_ros.model.inertial_parameters import TRIANGLE_SLACK
from spacerobot_ros.model.rotations import matrix_from_rpy
from spacerobot_ros.model.urdf_form import urdf_root
from spacerobot_ros.resources import share_directory, suggestion

_LARGEST = 1e12
"""Larger numbers (kg, m, kg m^2) are slips, and their squares soon overflow."""

_MOST_LINKS = 200

_XACRO = re.compile(r"<xacro:|\$\{")
_MESH = re.compile(
    r"""(?P<before><mesh\b[^>]*?\bfilename\s*=\s*["'])(?P<file>[^"']+)(?P<after>["'])"""
)


def load_robot(path: str | Path) -> RobotDescription:
    """Read the robot of a URDF file, or of a xacro file, which is expanded.

    Paths of meshes that are relative to the file, or in a package that is not installed and is a
    folder around the file, become absolute in the text that the robot keeps.

    Raises
    ------
    RobotDescriptionError
        The file cannot be read, is not URDF, or does not describe a free-floating tree.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RobotDescriptionError(f"The URDF {path} cannot be read: {error}.") from error
    except UnicodeDecodeError as error:
        raise RobotDescriptionError(
            f"The URDF {path} cannot be read: it is no text in UTF-8 ({error}). Save it as UTF-8."
        ) from error
    if path.suffix == ".xacro" or _XACRO.search(text):
        text = _expanded(path)
    try:
        folder = path.resolve().parent
        return parse_robot(with_mesh_files(text, lambda mesh: _mesh_beside(mesh, folder)))
    except RobotDescriptionError as error:
        raise RobotDescriptionError(f"{path}: {error}") from error


def _expanded(path: Path) -> str:
    """Return the URDF text that a xacro file stands for."""
    try:
        import xacro
    except ImportError:
        raise RobotDescriptionError(
            f"{path} is a xacro file, and the package xacro is not installed: `pip install xacro`, "
            f"or expand it where it is: `xacro {path.name} > {path.name.split('.')[0]}.urdf`."
        ) from None
    # xacro reports on standard error where it was when it failed: the sentence says it.
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            return str(xacro.process_file(str(path)).toxml())
        except Exception as error:  # Of xacro, its expressions, the XML parser
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RobotDescriptionError(
                f"The xacro file {path} cannot be expanded: {reason}."
            ) from error


def with_mesh_files(text: str, find: Callable[[str], Path | None]) -> str:
    """Return a URDF text in which meshes are named by their files.

    Parameters
    ----------
    text
        Of the URDF.
    find
        Returns the file of a mesh by what the text calls it; None: it keeps its name.
    """

    def absolute(match: re.Match[str]) -> str:
        found = find(unescape(match["file"]))
        if found is None:
            return match[0]
        return f"{match['before']}file://{quote(str(found))}{match['after']}"

    return _MESH.sub(absolute, text)


def _mesh_beside(resource: str, folder: Path) -> Path | None:
    """Return the file of a mesh next to the URDF's folder, None where its URI says all."""
    scheme, mark, rest = resource.partition("://")
    if not mark:
        found = folder / resource
        return found.resolve() if found.is_file() else None
    if scheme != "package" or mesh_file(resource) is not None:
        return None
    package, _, inside = rest.partition("/")
    for parent in (folder, *folder.parents):
        if parent.name == package and (parent / inside).is_file():
            return parent / inside
    return None


def mesh_file(resource: str) -> Path | None:
    """Return the file of a mesh by its URI (``file://``, ``package://``) or path; None: not there.

    Packages are looked for in the ROS environment; this package's own need none.
    """
    url = urlparse(resource)
    if url.scheme == "package":
        folder = _package(url.netloc)
        path = None if folder is None else folder / unquote(url.path).lstrip("/")
    elif url.scheme in ("file", ""):
        path = Path(unquote(url.path))
    else:
        return None
    return path if path is not None and path.is_file() else None


def _package(name: str) -> Path | None:
    if name == "spacerobot_ros":
        return share_directory()
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(name))
    except (ImportError, LookupError, OSError, ValueError, SpaceRobotError):
        return None


def parse_robot(text: str) -> RobotDescription:
    """Read the robot of a URDF text.

    Raises
    ------
    RobotDescriptionError
        The text is not URDF, or does not describe a free-floating tree of prismatic, revolute,
        continuous and fixed joints with positive definite inertia.
    """
    if text.count("<link") > _MOST_LINKS:
        raise RobotDescriptionError(
            f"The robot description has more than {_MOST_LINKS} links: its equations would take "
            "hours to derive."
        )
    tree = _parse_xml(text)
    colours = {
        material.name: tuple(material.color.rgba)
        for material in tree.materials
        if material.color is not None and material.color.rgba is not None
    }
    links = {link.name: _link(link, colours) for link in tree.links}
    joints = [_joint(joint, links) for joint in tree.joints]
    for kind, names in (
        ("link", [x.name for x in tree.links]),
        ("joint", [x.name for x in joints]),
    ):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise RobotDescriptionError(
                f"The {kind} name '{twice[0]}' is used twice; names are unique."
            )
    joints = _with_leaders(joints)
    bodies, frames = weld(links, joints)
    for number, body in enumerate(bodies):
        if flaw_of_inertia(body.inertia.about_com):
            _refuse_inertia([link for link in links.values() if frames[link.name][0] == number])
    description = RobotDescription(
        name=tree.name or "robot",
        links=tuple(links.values()),
        joints=tuple(joints),
        bodies=tuple(bodies),
        frames=frames,
        urdf=text,
    )
    _require_mass(description)
    _require_common_range(description)
    return description


def _parse_xml(text: str) -> Any:
    root = urdf_root(text, ("prismatic", "revolute", "continuous", "fixed"))
    # The parser reports attributes it does not know on standard error; they are none of ours.
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            return URDF.from_xml_string(ElementTree.tostring(root))
        except Exception as error:  # lxml, assertion, key, value and type errors, by what is broken
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RobotDescriptionError(
                f"The robot description is not valid URDF: {reason}."
            ) from error


def _pose(origin: Any, where: str) -> Pose:
    if origin is None:
        return Pose()
    r = _finite(origin.xyz if origin.xyz is not None else (0, 0, 0), f"the origin of {where}")
    rpy = _finite(origin.rpy if origin.rpy is not None else (0, 0, 0), f"the origin of {where}")
    return Pose(matrix_from_rpy(rpy), r)


def _finite(values: Any, where: str) -> Array:
    array = np.array(values, dtype=float)
    if not np.all(np.isfinite(array)):
        raise RobotDescriptionError(f"A number in {where} is not finite: {array.tolist()}.")
    if array.size and np.abs(array).max() > _LARGEST:
        raise RobotDescriptionError(
            f"A number in {where} is larger than {_LARGEST:g} in its SI unit: {array.tolist()}."
        )
    return array


def _size(values: Any, where: str) -> tuple[float, ...]:
    size = _finite(values, f"the geometry of {where}")
    if size.min() < 0:
        raise RobotDescriptionError(
            f"A size in a <geometry> of {where} is negative: {size.tolist()}. Give lengths in m."
        )
    return tuple(size.tolist())


def _link(link: Any, colours: dict[str, Any]) -> Link:
    where = f"link '{link.name}'"
    inertia = Inertia()
    if link.inertial is not None:
        pose = _pose(link.inertial.origin, where)
        mass = float(_finite(link.inertial.mass, where))
        about = np.zeros((3, 3))
        if link.inertial.inertia is not None:
            about = _finite(link.inertial.inertia.to_matrix(), where)
        if mass < 0:
            raise RobotDescriptionError(f"The mass of {where} is negative ({mass} kg).")
        inertia = Inertia(mass, np.zeros(3), about).moved(pose)
    return Link(link.name, inertia, tuple(_shapes(link, colours, where)))


def flaw_of_inertia(about: Array) -> str:
    """Return what no body has of these moments of inertia (3, 3), kg m^2; empty if one may.

    It is the end of a sentence that begins with whose inertia it is.
    """
    low, middle, high = np.linalg.eigvalsh(about)
    if low < -1e-12 * max(1.0, float(np.abs(about).max())):
        return "has a negative principal moment; check its signs."
    if high > (1 + TRIANGLE_SLACK) * (low + middle) + 1e-12:
        return (
            f"is that of no body: its principal moments are {low:.4g}, {middle:.4g} and "
            f"{high:.4g} kg m^2, and none can be larger than the sum of the other two. Check units "
            "and digits of <inertia>."
        )
    return ""


def _refuse_inertia(welded: list[Link]) -> NoReturn:
    """Refuse a body whose inertia is impossible: that of its worst link, all welded together."""

    def excess(link: Link) -> float:
        low, middle, high = np.linalg.eigvalsh(link.inertia.about_com)
        return float(max(high - middle - low, -low))

    worst = max(welded, key=excess)
    raise RobotDescriptionError(
        f"The inertia of link '{worst.name}' {flaw_of_inertia(worst.inertia.about_com)}"
    )


def _shapes(link: Any, colours: dict[str, Any], where: str) -> list[Shape]:
    shapes = []
    for visual in link.visuals:
        geometry = visual.geometry
        kind = type(geometry).__name__.lower()
        resource = ""
        if kind == "box":
            size = _size(geometry.size, where)
        elif kind == "cylinder":
            size = _size((geometry.radius, geometry.length), where)
        elif kind == "sphere":
            size = _size((geometry.radius,), where)
        elif kind == "mesh":
            # A negative scale mirrors.
            scale = _finite(geometry.scale or (1.0, 1.0, 1.0), f"the scale of a mesh of {where}")
            size = tuple(scale.tolist())
            resource = str(geometry.filename)
        else:
            continue
        rgba: Any = None
        if visual.material is not None:
            if visual.material.color is not None:
                rgba = visual.material.color.rgba
            rgba = rgba if rgba is not None else colours.get(visual.material.name)
        colour = (
            Shape.rgba if rgba is None else tuple(_finite(rgba, f"a color of {where}").tolist())
        )
        shapes.append(Shape(kind, size, _pose(visual.origin, where), colour, resource))
    return shapes


def _joint(joint: Any, links: dict[str, Link]) -> Joint:
    where = f"joint '{joint.name}'"
    for role, name in (("parent", joint.parent), ("child", joint.child)):
        if name not in links:
            raise RobotDescriptionError(
                f"The {role} of {where} is '{name}', but there is no such link."
                f"{suggestion(name, links)}"
            )
    kind = JointKind(joint.type)
    axis = np.array([1.0, 0.0, 0.0])
    if joint.axis is not None:
        axis = _finite(joint.axis, where)
    if kind is not JointKind.FIXED:
        norm = float(np.linalg.norm(axis))
        if norm < 1e-9:
            raise RobotDescriptionError(f"The axis of {where} is zero; give it a direction.")
        axis = axis / norm
    return Joint(
        joint.name,
        kind,
        joint.parent,
        joint.child,
        _pose(joint.origin, where),
        axis,
        _limits(joint, kind, where),
        None if kind is JointKind.FIXED else _mimic(joint, where),
    )


def _mimic(joint: Any, where: str) -> Mimic | None:
    if joint.mimic is None:
        return None
    given = (1.0 if joint.mimic.multiplier is None else joint.mimic.multiplier, joint.mimic.offset)
    multiplier, offset = _finite([given[0], given[1] or 0.0], f"<mimic> of {where}")
    if multiplier == 0:
        raise RobotDescriptionError(
            f"The {where} mimics '{joint.mimic.joint}' with the multiplier 0: it does not move; "
            "make it fixed."
        )
    return Mimic(joint.mimic.joint, float(multiplier), float(offset))


def _with_leaders(joints: list[Joint]) -> list[Joint]:
    """Return the joints, each that follows another with the joint at the end of its chain."""
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
                    f"The joint '{joint.name}' mimics itself, by way of {', '.join(passed[1:])}."
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
    return found


def _require_common_range(robot: RobotDescription) -> None:
    """Refuse joints whose followers leave them no range."""
    lower, upper = robot.limits("lower"), robot.limits("upper")
    for name, low, high in zip(robot.joint_names, lower, upper, strict=True):
        if low >= high:
            raise RobotDescriptionError(
                f"The joint '{name}' and those that mimic it have no position in common: their "
                f"limits leave it [{low:.4g}, {high:.4g}]. Check multiplier, offset and limits."
            )


def _limits(joint: Any, kind: JointKind, where: str) -> JointLimits:
    if kind is JointKind.FIXED:
        return JointLimits()
    limit = joint.limit
    if limit is None:
        if kind is JointKind.CONTINUOUS:
            return JointLimits()
        raise RobotDescriptionError(
            f"The {where} is {kind.value} and has no <limit>: "
            "give lower, upper, velocity and effort."
        )
    values = {
        name: float(getattr(limit, name) or 0.0)
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
            f"({values['upper']}): it could not move; give it a range, or make it fixed."
        )
    return JointLimits(**values)


def _require_mass(robot: RobotDescription) -> None:
    """Refuse what would make the inertia matrix singular: parts that move without inertia."""
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
                f"Joint '{body.joint.name}' moves link '{body.name}', which has no mass: "
                "its motion would have no dynamics. Give it an <inertial> or make the joint fixed."
            )
