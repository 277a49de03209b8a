"""Obstacles that are fixed in the world.

The URDF text of a robot carries the obstacles around it as an element ``<world>`` with the URDF of
the obstacles inside, which other readers of URDF leave out: nodes and bags that get the text of the
robot alone know them, too.
"""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree.ElementTree import fromstring, tostring

from spacerobot_ros.model.description import RobotDescription

_CARRIED = re.compile(r"\s*<world>.*</world>", re.DOTALL)
_END = re.compile(r"</robot\s*>")


def with_world(robot: RobotDescription, world: RobotDescription) -> RobotDescription:
    """Return a robot among obstacles (:func:`.load_world`), in place of those around it so far."""
    urdf = _CARRIED.sub("", robot.urdf)
    root = fromstring(world.urdf)
    root.tail = None
    carried = f"  <world>{tostring(root, encoding='unicode')}</world>\n"
    ends = list(_END.finditer(urdf))
    if ends:
        place = ends[-1].start()
        urdf = urdf[:place] + carried + urdf[place:]
    return replace(robot, world=world, urdf=urdf)
