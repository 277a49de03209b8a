"""Bodies of revolution that spin in place, such as reaction wheels, come no nearer to others."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros.collision import CollisionGeometry, PathCheck
from spacerobot_ros.model import RobotDescription, parse_robot

INERTIA = (
    '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="2" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)


def robot(origin: str = "0 0 0.2", rpy: str = "0 0 0", shape: str = "") -> RobotDescription:
    """Return a disc that turns about z of its joint, beside a post on a slider."""
    shape = shape or '<cylinder radius="0.3" length="0.1"/>'
    return parse_robot(
        f"""<robot name="spinner">
<link name="base">{INERTIA}</link>
<link name="disc">{INERTIA}<collision><origin xyz="{origin}" rpy="{rpy}"/><geometry>{shape}
</geometry></collision></link>
<link name="post">{INERTIA}<collision><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="spin" type="continuous"><parent link="base"/><child link="disc"/>
<origin xyz="0.4 0 0"/><axis xyz="0 0 1"/><limit velocity="9" effort="1"/></joint>
<joint name="slide" type="prismatic"><parent link="base"/><child link="post"/>
<origin xyz="1.0 0 0.2"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="9" effort="1"/></joint></robot>"""
    )


@pytest.mark.parametrize(
    ("changes", "reach"),
    [
        ({}, 0.0),
        ({"shape": '<sphere radius="0.3"/>', "rpy": "0.4 0.3 0"}, 0.0),
        ({"rpy": "0.2 0 0"}, 0.3),
        ({"origin": "0.05 0 0.2"}, 0.3),
        ({"shape": '<box size="0.5 0.5 0.1"/>'}, 0.3),
    ],
)
def test_only_what_leaves_its_place_can_come_nearer(changes: dict[str, str], reach: float) -> None:
    geometry = CollisionGeometry(robot(**changes))
    ((spin, slide),), _ = geometry.largest_lever_arms(np.array([[0.0, 0.3], [50.0, -0.2]]))
    assert slide == 1.0
    assert spin == 0.0 if reach == 0.0 else spin > reach


def test_a_joint_that_moves_both_bodies_brings_none_nearer() -> None:
    """The disc spins in place, and the arm on it goes round with it."""
    arm = parse_robot(
        f"""<robot name="turret">
<link name="base">{INERTIA}</link>
<link name="disc">{INERTIA}<collision><geometry><cylinder radius="0.3" length="0.1"/></geometry>
</collision></link>
<link name="upper">{INERTIA}</link>
<link name="tip">{INERTIA}<collision><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="disc"/><axis xyz="0 0 1"/>
<limit velocity="9" effort="1"/></joint>
<joint name="lift" type="revolute"><parent link="disc"/><child link="upper"/>
<origin xyz="0.2 0 0.3"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="9" effort="1"/>
</joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="tip"/>
<origin xyz="0.5 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="9" effort="1"/>
</joint></robot>"""
    )
    geometry = CollisionGeometry(arm)
    ((turn, lift, bend),), _ = geometry.largest_lever_arms(np.zeros((1, 3)))
    assert turn == 0.0
    assert lift > 0.5
    assert bend == 0.0, "a ball about its joint stays where it is"


def test_the_nearest_approach_beside_a_fast_wheel_is_found_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    geometry = CollisionGeometry(robot())
    ticks = np.arange(41)
    path = np.column_stack([300.0 * ticks, np.linspace(-1.1, 1.5, 41)])
    asked: list[int] = []
    distances = geometry.distances

    def counted(pair: int, poses: object) -> object:
        found = distances(pair, poses)  # type: ignore[arg-type]
        asked.append(len(found))
        return found

    monkeypatch.setattr(geometry, "distances", counted)
    nearest = PathCheck(geometry).nearest(path)
    assert nearest is not None
    # Between disc and post along x, 0.6 m apart: their radii are 0.3 m and 0.1 m.
    assert nearest.distance == pytest.approx(0.2, abs=1e-3)
    assert sum(asked) < 400
