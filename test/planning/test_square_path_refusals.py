"""Robots and goals that no square path will do for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.planar_manoeuvres import (
    DEPLOYED,
    FOLDED,
    URDF,
    about_z,
    at_rest,
    closed_forms,
    goal_of,
    paper_gait,
    phase_density,
    planner,
    turns,
)
from support.planar_trees import Part, PlanarTree, random_tree
from support.planning_refusals import refusal_in

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal, RobotState, Tolerance
from spacerobot_ros.planning.methods.geometric_phase import PlanarPhase, planar_axis

Array = npt.NDArray[np.float64]


def refusal_of(robot: SpaceRobot, state: RobotState, goal: Goal, **options: Any) -> str:
    return refusal_in(lambda: planner(robot, **options).plan(state, goal))


NEAR = goal_of(about_z(0.2))


@pytest.mark.parametrize("links", [1, 2])
def test_fewer_than_three_links_are_refused(links: int) -> None:
    tree = random_tree(np.random.default_rng(5), links)
    tree = replace(tree, plane=np.eye(3))
    text = refusal_of(SpaceRobot.from_urdf(tree.urdf), at_rest(np.zeros(links - 1)), NEAR)
    assert f"has {links} link(s)" in text
    assert "fewer than three" in text


@pytest.mark.parametrize(
    ("old", "new", "mention"),
    [
        ('"pin_2" type="continuous"', '"pin_2" type="prismatic"', "joint 'pin_2' slides"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0.02 1"/>', "axis of joint 'pin_2' is not parallel"),
        (
            '<origin xyz="0.5 0 0"/>\n      <mass',
            '<origin xyz="0.5 0 0.05"/>\n      <mass',
            "plane",
        ),
        ('ixz="0" iyy="1"', 'ixz="0.05" iyy="1"', "products of inertia"),
        ('<origin xyz="1 0 0"/>', '<origin xyz="1 0 0.1"/>', "outside of one plane"),
    ],
)
def test_what_is_not_planar_is_refused(old: str, new: str, mention: str) -> None:
    before, last, after = URDF.read_text().rpartition(old)
    assert last
    text = f"{before}{new}{after}".replace(
        "<limit velocity", '<limit lower="-1" upper="1" velocity'
    )
    reason = refusal_of(SpaceRobot.from_urdf(text), at_rest(np.zeros(2)), NEAR)
    assert "not planar" in reason
    assert mention in reason


def test_angles_written_with_six_digits_are_planar() -> None:
    text = URDF.read_text()
    # The whole chain turned about x, the joint's frame by 1.5708.
    text = text.replace(
        '<origin xyz="0.5 0 0"/>\n    <axis', '<origin xyz="0.5 0 0" rpy="1.5708 0 0"/>\n    <axis'
    )
    text = text.replace('iyy="10" iyz="0" izz="10"', 'iyy="10" iyz="0" izz="9"')
    axis = planar_axis(SpaceRobot.from_urdf(text))
    np.testing.assert_allclose(np.abs(axis), [0, 1, 0], atol=1e-5)


@pytest.mark.parametrize("tilt", [0.3, 0.01])
def test_a_goal_out_of_the_plane_is_refused(chain: SpaceRobot, tilt: float) -> None:
    goal = goal_of(about_z(1.0) * Rotation.from_rotvec([0.6 * tilt, 0.8 * tilt, 0.0]))
    text = refusal_of(chain, at_rest(FOLDED), goal)
    assert f"{tilt:.4g} rad off any rotation about the axis [0.0, 0.0, 1.0]" in text
    assert "base_link" in text
    # Within the tolerance it is as good as in the plane.
    gait = planner(chain, Tolerance(1e-3, 1.01 * tilt)).plan(at_rest(FOLDED), goal)
    assert turns(closed_forms, gait.positions).sum() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("shape", "mention"),
    [
        ([0.0], "1 joint position(s); robot 'planar_chain' has 2 joints"),
        ([0.0, 1.2], "joint 'pin_2' at 1.2 rad, and its limits are [-1, 1] rad"),
        ([-1.001, 0.0], "joint 'pin_1' at -1.001 rad"),
    ],
)
def test_a_shape_that_the_robot_cannot_take_is_refused(shape: list[float], mention: str) -> None:
    robot = limited(1.0)
    assert mention in refusal_of(robot, at_rest(np.zeros(2)), goal_of(about_z(0.1), shape))


def limited(reach: float, middle: float = 0.0) -> SpaceRobot:
    """Return the paper's chain with joints that go so far to either side of the middle, rad."""
    text = URDF.read_text().replace('type="continuous"', 'type="revolute"')
    limit = f'<limit lower="{middle - reach!r}" upper="{middle + reach!r}" velocity'
    return SpaceRobot.from_urdf(text.replace("<limit velocity", limit))


def test_limits_too_narrow_for_a_square_are_refused() -> None:
    text = refusal_of(limited(0.01, 1.5), at_rest(np.full(2, 1.5)), NEAR)
    assert "more than most_loops = 20" in text
    assert "sides of up to 0.02 rad within the joint limits" in text
    assert "'pin_1' and 'pin_2'" in text
    # The curvature times the largest square, and how many of those.
    phase = 0.02**2 * abs(phase_density([1.5, 1.5]))
    loops = int(text.split(" loops, more")[0].rsplit(" ", 1)[1])
    assert loops == pytest.approx(0.2 / phase, rel=0.05)


@pytest.mark.parametrize("centre", [(2.0, 0.0), (0.0, -1.0)])
def test_a_given_centre_beyond_the_limits_is_refused(centre: tuple[float, float]) -> None:
    options: dict[str, Any] = {"given_centre": 1, "centre_1": centre[0], "centre_2": centre[1]}
    text = refusal_of(limited(1.0), at_rest(np.zeros(2)), NEAR, **options)
    assert "given centre" in text
    assert "joint limits" in text


def test_wheels_on_their_mass_centres_turn_the_base_by_no_loop() -> None:
    base = Part(-1, np.zeros(2), np.zeros(2), 50.0, 5.0)
    wheels = [Part(0, np.array([x, 0.0]), np.zeros(2), 5.0, 1.0) for x in (0.5, -0.5)]
    tree = PlanarTree((base, *wheels), np.eye(3))
    text = refusal_of(SpaceRobot.from_urdf(tree.urdf), at_rest(np.zeros(2)), NEAR)
    assert "cannot be turned" in text
    assert "joint limits" not in text


def test_joints_without_speed_are_refused(chain: SpaceRobot) -> None:
    head, tail = URDF.read_text().rsplit('velocity="2"', 1)
    robot = SpaceRobot.from_urdf(f'{head}velocity="0"{tail}')
    assert "velocity limit above zero" in refusal_of(robot, at_rest(DEPLOYED), NEAR)
    # No loop is needed here, and step 1 takes for ever.
    shape = np.array([np.pi, 0.0])
    turn = float(PlanarPhase(chain).turns_by_legs(FOLDED[np.newaxis], shape[np.newaxis])[0])
    text = refusal_of(robot, at_rest(FOLDED), goal_of(about_z(turn), shape))
    assert "'pin_2'" in text
    assert "inf s" in text


def test_a_manoeuvre_that_takes_too_long_is_refused(chain: SpaceRobot) -> None:
    text = refusal_of(chain, at_rest(FOLDED), goal_of(about_z(1.0), DEPLOYED), longest=20.0)
    assert "24 s" in text
    assert "longest = 20 s" in text


@pytest.mark.parametrize(
    ("momentum", "shown"),
    [
        ({"linear_momentum": np.array([0.0, 3e-3, 4e-3])}, "0.005 kg m/s"),
        ({"angular_momentum": np.array([0.0, 0.0, -2e-3])}, "0.002 kg m^2/s"),
    ],
)
def test_a_drifting_robot_is_refused(
    chain: SpaceRobot, momentum: dict[str, Array], shown: str
) -> None:
    text = refusal_of(chain, replace(at_rest(FOLDED), **momentum), NEAR)
    assert "drifts" in text
    assert shown in text


def test_the_goal_position_is_checked_on_request(chain: SpaceRobot) -> None:
    end = np.array(paper_gait(chain).notes["final_position"])
    attitude = about_z(np.pi / 2).as_quat()
    reached = Goal.checked(end + np.array([0, 0, 9e-7]), attitude, DEPLOYED)
    assert planner(chain, check_position=1).plan(at_rest(FOLDED), reached).ticks == 480
    missed = Goal.checked(end + np.array([0, 0.01, 0]), attitude, DEPLOYED)
    text = refusal_of(chain, at_rest(FOLDED), missed, check_position=1)
    assert "0.01 m from the goal position" in text
    assert str(np.round(end, 4).tolist()) in text
    assert planner(chain).plan(at_rest(FOLDED), missed).ticks == 480


@pytest.mark.parametrize("times", [{"t2": 8.0}, {"t3": 11.0}, {"t1": 30.0}, {"t4": 20.0}])
def test_times_that_do_not_follow_each_other_are_refused(
    chain: SpaceRobot, times: dict[str, Any]
) -> None:
    with pytest.raises(ParameterError, match="t1 to t4") as refusal:
        planner(chain, **times)
    assert f"{next(iter(times.values())):g}" in str(refusal.value)
