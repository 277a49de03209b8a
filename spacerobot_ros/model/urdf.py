"""Reads URDF files and strings into :class:`.RobotDescription`.

Links connected by fixed joints are merged, and robots with singular equations are rejected. A
robot's URDF also contains, in elements that other URDF readers ignore, the pairs of links whose
contacts are ignored (``<disable_collisions>``, from SRDF files as written by MoveIt) and the
obstacles around the robot (``<world>``). Nodes and bags therefore need only the URDF.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn
from urllib.parse import quote, unquote, urlparse
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

import numpy as np

from spacerobot_ros.errors import RobotDescriptionError, enumeration, reason
from spacerobot_ros.files import read_regular, warn_once
from spacerobot_ros.model import xacro_files
from spacerobot_ros.model.description import (
    Array,
    Link,
    RobotDescription,
    editable_root,
    weld_links,
)
from spacerobot_ros.model.inertial_parameters import INERTIA_ENTRIES, TRIANGLE_SLACK
from spacerobot_ros.model.rotations import rpy_from_matrix
from spacerobot_ros.model.urdf_elements import (
    MalformedError,
    disabled_pairs,
    read_colours,
    read_inertia,
    read_joint,
    read_link,
    with_leaders,
)
from spacerobot_ros.model.wheels import require_reaction_wheels
from spacerobot_ros.resources import installed_share_directory, share_directory, suggestion

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
        code = re.sub("<!--.*?-->", "", text, flags=re.DOTALL)
        if path.suffix != ".xacro" and ("<xacro:" in code or "${" in code):
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


def xacro_arguments() -> list[str]:
    """Return the arguments for xacro files in the environment, as NAME:=VALUE."""
    return shlex.split(os.environ.get(XACRO_ARGUMENTS_VARIABLE, ""))


def _expand_xacro(path: Path) -> str:
    by_hand = f"`xacro {path.name} [NAME:=VALUE ...] > {path.name.split('.')[0]}.urdf`"
    if find_spec("xacro") is None:
        raise RobotDescriptionError(
            f"{path} is a xacro file, and the package xacro is not installed: `pip install xacro`, "
            f"or expand it where xacro is installed: {by_hand}."
        )
    arguments = xacro_arguments()
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
    colours = read_colours(root)
    links = {name: read_link(name, each, colours) for name, each in elements["link"].items()}
    _name_limits_not_read(root)
    joints = with_leaders([read_joint(*each, links) for each in elements["joint"].items()])
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


_OTHER_FORMATS = {"sdf": "an SDF model", "mujoco": "a MuJoCo model"}

_LIMITS_NOT_READ = ("acceleration", "deceleration", "jerk")
"""Limits of URDF 1.2 that are not enforced."""


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
        raise MalformedError("the <robot> has no name", '<robot name="...">')
    return root


def _named_elements(root: Element, kind: str) -> dict[str, Element]:
    """Return the links or joints by their names, which are unique."""
    found: dict[str, Element] = {}
    for number, element in enumerate(root.findall(kind), 1):
        name = element.get("name", "")
        if not name:
            raise MalformedError(f"the {kind} number {number} has no name", f'<{kind} name="...">')
        if name in found:
            raise RobotDescriptionError(
                f"The {kind} name '{name}' is used twice; names must be unique."
            )
        found[name] = element
    return found


def _name_limits_not_read(root: Element) -> None:
    given = {name for limit in root.iterfind("joint/limit") for name in limit.attrib}
    ignored = [name for name in _LIMITS_NOT_READ if name in given]
    soft = {name for each in root.iterfind("joint/safety_controller") for name in each.attrib}
    if soft & {"soft_lower_limit", "soft_upper_limit"}:
        ignored.append("safety_controller")
    if ignored:
        warn_once(
            f"The limits of {enumeration(ignored)} in the URDF of '{root.get('name', '')}' are "
            "ignored; only position, velocity and effort limits are enforced."
        )


# -- inertias --------------------------------------------------------------------------------


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
        given = read_inertia(inertia, f"link '{name}'")
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


# -- elements that other URDF readers ignore ----------------------------------------------------


def with_srdf(robot: RobotDescription, path: str | Path) -> RobotDescription:
    """Return a robot with its disabled pairs replaced by the pairs in an SRDF file.

    The elements ``<disable_collisions link1="..." link2="..."/>``,
    ``<disable_default_collisions link="..."/>`` and
    ``<enable_collisions link1="..." link2="..."/>`` are read; the last element takes precedence.

    Raises
    ------
    RobotDescriptionError
        The file cannot be read, is not an SRDF, or names an unknown link.
    """
    try:
        root = fromstring(read_regular(path))
    except OSError as error:
        raise RobotDescriptionError(f"The SRDF {path} cannot be read: {reason(error)}.") from error
    except (ParseError, ValueError, LookupError) as error:
        raise RobotDescriptionError(f"The SRDF {path} is not XML ({error}).") from error
    if root.tag != "robot":
        raise RobotDescriptionError(
            f"The file {path} is not an SRDF: its root element is <{root.tag}> instead of <robot>."
        )
    disabled = disabled_pairs(root, [link.name for link in robot.links], f"The SRDF {path}")
    elements = []
    for first, second in sorted((min(pair), max(pair)) for pair in disabled):
        elements.append(Element("disable_collisions", link1=first, link2=second))
        elements[-1].tail = "\n"
    text = _with_elements(robot.urdf, "disable_collisions", elements)
    return replace(robot, disabled_collisions=disabled, urdf=text)


def with_world(robot: RobotDescription, world: RobotDescription | None) -> RobotDescription:
    """Return a robot with its obstacles replaced by the obstacles of a world (:func:`.load_world`).

    If the world is None, there are no obstacles.
    """
    if world is None and fromstring(robot.urdf).find("world") is None:
        return replace(robot, world=None)
    elements = []
    if world is not None:
        elements.append(Element("world"))
        elements[0].append(fromstring(world.urdf))
    return replace(robot, world=world, urdf=_with_elements(robot.urdf, "world", elements))


def _with_elements(urdf: str, tag: str, elements: Iterable[Element]) -> str:
    """Return a URDF text in which these elements replace all elements with the tag."""
    root = editable_root(urdf)
    for each in root.findall(tag):
        root.remove(each)
    root.extend(elements)
    return tostring(root, encoding="unicode")


def obstacles_from_topic(text: str) -> RobotDescription | None:
    """Return the obstacles from a string on the topic ``obstacles``; None if the string is empty.

    The string is plain URDF; xacro expressions in it are not expanded.

    Raises
    ------
    RobotDescriptionError
        The string has an element ``<world>`` or a missing mesh, or :func:`.parse_world` rejects it.
    """
    if not text.strip():
        return None
    world = parse_world(text)
    if world.world is not None:
        raise RobotDescriptionError(
            "Obstacles cannot contain obstacles: remove <world> from their URDF."
        )
    require_found_meshes(world)
    return world


def links_with_shapes(world: RobotDescription) -> list[str]:
    """Return the names of the obstacle links, which are the links with a shape."""
    return [each.name for each in world.links if each.collisions or each.shapes]


# -- files of meshes ------------------------------------------------------------------------------


def with_mesh_files(text: str, find: Callable[[str], Path | None]) -> str:
    """Return a URDF string with meshes referenced by ``file://`` URIs.

    Parameters
    ----------
    text
        URDF string; a string that is not XML is returned unchanged.
    find
        Function that returns the file for a mesh name in the URDF; None keeps the name.
    """
    try:
        root = editable_root(text)
    except (ParseError, ValueError):
        return text
    any_found = False
    for mesh in root.iter("mesh"):
        if found := find(mesh.get("filename", "")):
            mesh.set("filename", f"file://{quote(str(found))}")
            any_found = True
    return tostring(root, encoding="unicode") if any_found else text


def mesh_beside(resource: str, folder: Path) -> Path | None:
    """Return the file of a mesh named relative to a folder; None if the path is absolute."""
    scheme, mark, rest = resource.partition("://")
    if not mark:
        found = folder / resource
        return found.resolve() if found.is_file() else None
    if scheme != "package" or mesh_file(resource) is not None:
        return None
    package, _, inside = rest.partition("/")
    around = xacro_files.package_around(package, folder)
    return around / inside if around is not None and (around / inside).is_file() else None


def mesh_file(resource: str) -> Path | None:
    """Return the file of a mesh given its URI (``file://``, ``package://``) or path; None if not
    found.

    Packages are looked up in the ROS environment; the meshes in this package do not require a ROS
    environment.
    """
    url = urlparse(resource)
    if url.scheme == "package":
        own = url.netloc == "spacerobot_ros"
        folder = share_directory() if own else installed_share_directory(url.netloc)
        path = None if folder is None else folder / unquote(url.path).lstrip("/")
    elif url.scheme in ("file", ""):
        path = Path(unquote(url.path))
    else:
        return None
    return path if path is not None and path.is_file() else None
