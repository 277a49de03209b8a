"""SRDF files as written by MoveIt: pairs of links whose contacts are ignored.

A robot's URDF contains these pairs as SRDF elements ``<disable_collisions>``, which other
URDF readers ignore. Nodes and bags therefore need only the URDF.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, SubElement, fromstring, tostring

from spacerobot_ros.errors import RobotDescriptionError, reason
from spacerobot_ros.files import read_regular
from spacerobot_ros.model.description import RobotDescription, editable_root
from spacerobot_ros.resources import suggestion


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
    text = _with_pairs(robot.urdf, disabled)
    return replace(robot, disabled_collisions=disabled, urdf=text)


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


def _with_pairs(urdf: str, pairs: frozenset[frozenset[str]]) -> str:
    """Return a URDF text that contains only these pairs."""
    root = editable_root(urdf)
    for each in root.findall("disable_collisions"):
        root.remove(each)
    for first, second in sorted((min(pair), max(pair)) for pair in pairs):
        SubElement(root, "disable_collisions", link1=first, link2=second).tail = "\n"
    return tostring(root, encoding="unicode")


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
