"""Two balls on sliders that cross and may touch: their distance is known."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.model.description import Array

_INERTIA = '<inertia ixx="1" iyy="1.5" izz="2" ixy="0" ixz="0" iyz="0"/>'

RADII, HEIGHT = (0.05, 0.07), 0.1
"""Of the balls, and of the right one's way above that of the left one, m."""


def _link(name: str, mass: float, solid: str = "") -> str:
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/>{_INERTIA}</inertial>{solid}</link>'
    )


def _ball(radius: float) -> str:
    return f'<collision><geometry><sphere radius="{radius}"/></geometry></collision>'


URDF = f"""<robot name="crossing">
{_link("base", 9.0)}{_link("left", 1.0, _ball(RADII[0]))}{_link("right", 2.0, _ball(RADII[1]))}
<joint name="y" type="prismatic"><parent link="base"/><child link="right"/>
<origin xyz="0 0 {HEIGHT}"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="1.5" effort="1"/>
</joint>
<joint name="x" type="prismatic"><parent link="base"/><child link="left"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" velocity="2" effort="1"/></joint></robot>"""
"""The shape is (y, x)."""

LINKS = ["left", "right"]


def distance(shapes: Array) -> Array:
    """Return the distances of the balls at shapes (N, 2), m."""
    middles = np.sqrt(np.sum(np.square(shapes), axis=1) + HEIGHT**2)
    return np.asarray(middles - sum(RADII))
