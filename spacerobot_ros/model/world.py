"""Obstacles that are fixed in the world.

The URDF text of a robot carries the obstacles around it as an element ``<world>`` with the URDF of
the obstacles inside, which other readers of URDF leave out: nodes and bags that get the text of the
robot alone know them, too.
"""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree.ElementTree import fromstring, tostring

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.urdf import parse_world, require_found_meshes

_CARRIED = re.compile(r"\s*<world>.*</world>", re.DOTALL)
_END = re.compile(r"</robot\s*>")


def with_world(robot: RobotDescription, world: RobotDescription | None) -> RobotDescription:
    """Return a robot among obstacles (:func:`.load_world`), in place of those around it so far.

    Without a world there are none around it.
    """
    urdf = _CARRIED.sub("", robot.urdf)
    if world is not None and (ends := list(_END.finditer(urdf))):
        root = fromstring(world.urdf)
        root.tail = None
        place = ends[-1].start()
        carried = f"  <world>{tostring(root, encoding='unicode')}</world>\n"
        urdf = urdf[:place] + carried + urdf[place:]
    return replace(robot, world=world, urdf=urdf)


def obstacles_from_topic(text: str) -> RobotDescription | None:
    """Return the obstacles of a text on the topic ``obstacles``; None, where it is empty.

    The text is plain URDF: nothing in it is expanded.

    Raises
    ------
    RobotDescriptionError
        It has obstacles of its own around it or a mesh that is not found, or :func:`.parse_world`
        refuses it.
    """
    if not text.strip():
        return None
    if "<world" in text:
        raise RobotDescriptionError(
            "Obstacles are not among others: leave the element <world> out of their URDF."
        )
    world = parse_world(text)
    require_found_meshes(world)
    return world


def links_with_shapes(world: RobotDescription) -> list[str]:
    """Return the names of the links that are obstacles: those with a shape."""
    return [each.name for each in world.links if each.collisions or each.shapes]
