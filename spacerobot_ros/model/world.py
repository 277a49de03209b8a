"""Obstacles fixed in the world.

A robot's URDF contains the obstacles around it in an element ``<world>``, which holds the URDF of
the obstacles and is ignored by other URDF readers. Nodes and bags therefore need only the robot's
URDF.
"""

from __future__ import annotations

from dataclasses import replace
from xml.etree.ElementTree import SubElement, fromstring, tostring

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.description import RobotDescription, editable_root
from spacerobot_ros.model.urdf import parse_world, require_found_meshes


def with_world(robot: RobotDescription, world: RobotDescription | None) -> RobotDescription:
    """Return a robot with its obstacles replaced by the obstacles of a world (:func:`.load_world`).

    If the world is None, there are no obstacles.
    """
    root = editable_root(robot.urdf)
    carried = root.findall("world")
    if world is None and not carried:
        return replace(robot, world=None)
    for each in carried:
        root.remove(each)
    if world is not None:
        SubElement(root, "world").append(fromstring(world.urdf))
    return replace(robot, world=world, urdf=tostring(root, encoding="unicode"))


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
