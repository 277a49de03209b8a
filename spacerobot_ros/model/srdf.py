"""SRDF files: pairs of links whose contact does not count, as MoveIt writes them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, fromstring

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.resources import suggestion


def with_srdf(robot: RobotDescription, path: str | Path) -> RobotDescription:
    """Return a robot with the disabled pairs of an SRDF file.

    Read are ``<disable_collisions link1="..." link2="..."/>``, ``<disable_default_collisions
    link="..."/>`` and ``<enable_collisions link1="..." link2="..."/>``; the last one wins.

    Raises
    ------
    RobotDescriptionError
        The file cannot be read, is no SRDF, or names a link that the robot does not have.
    """
    try:
        root = fromstring(Path(path).read_bytes())
    except OSError as error:
        raise RobotDescriptionError(f"The SRDF {path} cannot be read: {error}.") from error
    except (ParseError, ValueError) as error:
        raise RobotDescriptionError(f"The SRDF {path} is no XML ({error}).") from error
    if root.tag != "robot":
        raise RobotDescriptionError(
            f"The file {path} is no SRDF: its root element is <{root.tag}>, and that of an SRDF "
            "is <robot>."
        )
    links = [link.name for link in robot.links]
    quiet = {
        _link(each, "link", links, path) for each in root.findall("disable_default_collisions")
    }
    disabled = {
        frozenset(pair) for pair in itertools.combinations(links, 2) if not quiet.isdisjoint(pair)
    }
    disabled |= {_pair(each, links, path) for each in root.findall("disable_collisions")}
    disabled -= {_pair(each, links, path) for each in root.findall("enable_collisions")}
    return replace(robot, disabled_collisions=frozenset(disabled))


def _pair(element: Element, links: list[str], path: str | Path) -> frozenset[str]:
    return frozenset(_link(element, name, links, path) for name in ("link1", "link2"))


def _link(element: Element, attribute: str, links: list[str], path: str | Path) -> str:
    name = element.get(attribute)
    if name not in links:
        raise RobotDescriptionError(
            f"The SRDF {path} has a <{element.tag}> whose {attribute} is '{name or ''}', but the "
            f"robot has no such link.{suggestion(name or '', links)}"
        )
    return name
