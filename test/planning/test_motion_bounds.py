"""Bounds that are proved before a search, against random motions, plans, and numbers by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planning.test_optimal import ARM_START, QUICK
from planning.test_reach import some_robot, some_shape
from scipy.spatial.transform import Rotation
from support.hand_motion import attitude_after

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance, plan
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.methods.optimal.goal_specification import BaseRotations
from spacerobot_ros.planning.methods.optimal.motion_bounds import (
    ConnectionBounds,
    DurationBound,
    link_demands,
)
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits
from spacerobot_ros.resources import robot_file

PERIOD = 0.1
WHOLE = np.eye(3)
LINK = (
    '<link name="{0}"><inertial><origin xyz="{1}"/><mass value="{2}"/>'
    '<inertia ixx="{3}" iyy="{3}" izz="{3}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)


def of_two(kind: str, origin: str, axis: str, com: str = "0 0 0") -> SpaceRobot:
    """Return a base of 6 kg and 3 kg m^2 that carries 2 kg of 0.5 kg m^2 by one joint."""
    joint = (
        f'<joint name="one" type="{kind}"><parent link="base"/><child link="arm"/>'
        f'<origin xyz="{origin}"/><axis xyz="{axis}"/>'
        '<limit lower="-0.5" upper="1.5" velocity="1" effort="1"/></joint>'
    )
    links = LINK.format("base", "0 0 0", 6, 3), LINK.format("arm", com, 2, 0.5)
    return SpaceRobot.from_urdf(f'<robot name="two">{links[0]}{links[1]}{joint}</robot>')


def bound_of(
    robot: SpaceRobot,
    boundary: BoundaryConditions,
    velocity: Array,
    acceleration: Array,
    axes: Array | None = None,
    **options: Any,
) -> DurationBound:
    """Return the bound with limits (n,), for any attitude or that about the robot's axis."""
    axes = BaseRotations.of(robot).axes if axes is None else axes
    within = MotionLimits(robot.lower, robot.upper, velocity, acceleration)
    given = {"final_is_given": boundary.final is not None, **options}
    connection = ConnectionBounds.of(robot, axes)
    return DurationBound.of(robot, boundary, within, PERIOD, axes, connection, **given)


# -- motion of the base by each joint ---------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["tree", "chain", "planar", "sliders"])
def test_no_joint_moves_the_base_beyond_its_bound(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot, oracle = some_robot(kind, rng)
    axes = BaseRotations.of(robot).axes
    bounds = ConnectionBounds.of(robot, axes)
    step = 1e-5
    for _ in range(8):
        q = some_shape(robot, rng)
        turns = np.linalg.norm(oracle.connection(q)[3:], axis=0)
        assert np.all(turns <= bounds.turn * (1 + 1e-9) + 1e-12)
        for joint, most in enumerate(bounds.center):
            either = [oracle.center_of_mass(q + x * step * np.eye(robot.n)[joint]) for x in (-1, 1)]
            assert np.linalg.norm(either[1] - either[0]) / (2 * step) <= most * (1 + 1e-6) + 1e-9


@pytest.mark.parametrize("name", ["planar_chain", "three_joint_arm"])
def test_the_bounds_are_no_empty_claims(name: str) -> None:
    robot = SpaceRobot.from_file(robot_file(name))
    bounds = ConnectionBounds.of(robot, BaseRotations.of(robot).axes)
    rng = np.random.default_rng(1)
    shapes = [some_shape(robot, rng) for _ in range(60)]
    turns = np.max([np.linalg.norm(robot.connection(q)[3:], axis=0) for q in shapes], axis=0)
    assert turns[0] > 0.4 * bounds.turn[0]


@pytest.mark.parametrize(
    ("joint", "turn", "center"),
    [
        # A wheel in the middle has its share of the inertia.
        (("revolute", "0 0 0", "0 0 1"), 0.5 / 3.5, 0.0),
        # The reduced mass of a slider is 1.5 kg, its lever 0.4 m; the way along the slot is none.
        (("prismatic", "0.3 0.4 0", "1 0 0"), 1.5 * 0.4 / 3.5, 0.25),
        # The energy of the slider, 1.5 kg, is the smaller bound of a long lever.
        (("prismatic", "0 40 0", "1 0 0"), np.sqrt(1.5 / (3.5 + 3.0)), 0.25),
        # Beside its axis: 0.5 + 1.5 * 0.2^2 of the link, 1.5 * 0.2 * 0.3 of the base's lever.
        (
            ("revolute", "0.3 0 0", "0 0 1", "0.2 0 0"),
            (0.5 + 1.5 * 0.04 + 1.5 * 0.06) / 3.5,
            0.25 * 0.2,
        ),
    ],
    ids=["wheel", "slider", "slider far off", "link beside its axis"],
)
def test_a_joint_turns_the_base_by_its_share_of_inertia_and_lever(
    joint: tuple[str, ...], turn: float, center: float
) -> None:
    bounds = ConnectionBounds.of(of_two(*joint), WHOLE)
    assert bounds.inertia == pytest.approx(3.5)
    np.testing.assert_allclose(bounds.turn, [turn])
    np.testing.assert_allclose(bounds.center, [center])


def of_three(first: tuple[str, str], second: tuple[str, str]) -> SpaceRobot:
    """Return a chain of three equal links with joints of these types and elements."""
    links = "".join(LINK.format(name, "0.1 0 0", 2, 0.5) for name in ("base", "one", "two"))
    joints = "".join(
        f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/>{elements}</joint>'
        for parent, child, (kind, elements) in (("base", "one", first), ("one", "two", second))
    )
    return SpaceRobot.from_urdf(f'<robot name="three">{links}{joints}</robot>')


def test_a_joint_moves_all_that_follow_it() -> None:
    turn = '<axis xyz="0 0 1"/><limit lower="{0}" upper="{1}" velocity="{1}" effort="1"/>'
    first = "revolute", f'<origin xyz="0.4 0 0"/>{turn.format(-1, 1)}'
    second = f'<origin xyz="0.5 0 0"/>{turn.format(-3, 2)}'
    mimic = '<mimic joint="to_one" multiplier="-2"/>'
    axis = np.array([[0.0, 0.0, 1.0]])
    free = ConnectionBounds.of(of_three(first, ("revolute", second)), axis)
    robot = of_three(first, ("revolute", second + mimic))
    bounds = ConnectionBounds.of(robot, axis)
    np.testing.assert_allclose(bounds.turn, [free.turn[0] + 2 * free.turn[1]])
    turns = [abs(robot.connection(np.array([q]))[5, 0]) for q in np.linspace(-1, 1, 9)]
    assert max(turns) <= bounds.turn[0]


def test_the_way_of_a_slider_without_limits_is_not_known() -> None:
    endless = '<axis xyz="1 0 0"/><limit lower="-1e400" upper="1e400" velocity="2" effort="1"/>'
    robot = of_three(("continuous", '<axis xyz="0 0 1"/>'), ("prismatic", endless))
    bounds = ConnectionBounds.of(robot, WHOLE)
    assert bounds.turn[0] == np.inf
    assert np.isfinite(bounds.turn[1])
    goal = Rotation.from_rotvec([0, 0, 1.0]).as_quat()
    boundary = BoundaryConditions(np.zeros(2), goal, np.zeros(2))
    found = bound_of(robot, boundary, velocity=np.ones(2), acceleration=np.ones(2))
    assert found.seconds == 0.0


# -- durations --------------------------------------------------------------------------------


def held_rates(ticks: int, velocity: Array, acceleration: Array) -> Array:
    """Return the fastest rates (ticks, n) that are held from rest to rest."""
    k = np.arange(1, ticks + 1)[:, np.newaxis]
    ramps = np.minimum(k, ticks + 1 - k) * PERIOD * acceleration
    return np.minimum(velocity, ramps)


@pytest.mark.parametrize("way", [1e-4, 0.03, 0.4, 1.9])
@pytest.mark.parametrize("acceleration", [0.7, 40.0])
def test_a_joint_takes_the_time_of_its_fastest_motion(way: float, acceleration: float) -> None:
    robot = of_two("revolute", "0 0 0", "0 0 1")
    limits = {"velocity": np.array([0.9]), "acceleration": np.array([acceleration])}
    start, final = np.array([-0.4]), np.array([-0.4 + way])
    boundary = BoundaryConditions(start, np.array([0, 0, 0, 1.0]), final, final)
    found = bound_of(robot, boundary, **limits)
    fewest = next(
        ticks
        for ticks in range(1, 1000)
        if held_rates(ticks, **limits).sum() * PERIOD >= way * (1 - 1e-9)
    )
    # The bound is that of a continuous motion of one period more.
    assert (fewest - 1) * PERIOD - 1e-9 <= found.seconds <= fewest * PERIOD + 1e-9
    assert found.seconds == 0 or found.reason == (
        f"joint 'one' moves by {way:.4g} rad within the velocity and acceleration limits that it "
        "has"
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["tree", "chain", "planar", "sliders"])
def test_no_motion_is_faster_than_the_bound(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot, oracle = some_robot(kind, rng)
    velocity, acceleration = rng.uniform(0.1, 0.6, robot.n), rng.uniform(0.2, 2.0, robot.n)
    ticks = int(rng.integers(2, 30))
    rates = held_rates(ticks, velocity, acceleration) * rng.choice([-1, 1], robot.n)
    lower, upper = robot.description.shape_box
    way = rates.sum(axis=0) * PERIOD
    share = np.minimum(1.0, (upper - lower) / np.abs(way))
    rates, way = rates * share, way * share
    start = (lower + upper - way) / 2
    shapes = start + PERIOD * np.vstack([np.zeros(robot.n), np.cumsum(rates, axis=0)])
    attitude, q = attitude_after(oracle, shapes), shapes[-1]
    turn = attitude.as_quat()
    limits = {"velocity": velocity, "acceleration": acceleration}
    free = BoundaryConditions(start, turn, q)
    center = replace(free, center=oracle.center_of_mass(q))
    given = replace(free, final=q)
    for boundary in (free, center, given):
        assert bound_of(robot, boundary, **limits).seconds <= (ticks + 1e-6) * PERIOD
    # Without thrust the centre of mass stays; the last link is at its goal then.
    link = robot.link_names[-1]
    position = oracle.center_of_mass(start) - attitude.apply(oracle.center_of_mass(q))
    oracle.set_configuration(q, turn, position)
    R, r = oracle.frame_W(link)
    goal = Goal.checked(np.zeros(3), turn)
    ends = (EndEffectorGoal(link, r, Rotation.from_matrix(R).as_quat()),)
    goal = replace(goal, end_effectors=ends)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), start)
    request = PlanRequest(state, goal, Tolerance(0.0, 0.0))
    axes = BaseRotations.of(robot).axes
    demands = list(link_demands(robot, request, free, ConnectionBounds.of(robot, axes)))
    found = bound_of(robot, free, **limits, axes=np.zeros((0, 3)), demands=demands)
    assert found.seconds <= (ticks + 1e-6) * PERIOD
    assert found.seconds > 0 or ticks < 4 or max(each.amount for each in demands) < 1e-3
    if share.max() == 1.0:
        # A joint is as fast as it can be.
        assert bound_of(robot, given, **limits).seconds >= (ticks - 1 - 1e-6) * PERIOD


def test_ends_in_motion_and_a_drift_shorten_the_bound() -> None:
    robot = of_two("revolute", "0 0 0", "0 0 1")
    limits = {"velocity": np.ones(1), "acceleration": np.full(1, 0.1)}
    goal = Rotation.from_rotvec([0.0, 0.0, 0.2]).as_quat()
    rest = BoundaryConditions(np.zeros(1), goal, np.zeros(1))
    # The base turns by a seventh of the joint: 1.4 rad.
    ways = {0.0: 2 * np.sqrt(1.4 / 0.1), 1.0: 1.4}
    for speed, time in ways.items():
        found = bound_of(robot, replace(rest, velocity=speed), **limits, axes=WHOLE)
        assert time - 2 * PERIOD < found.seconds <= time
    drifting = replace(rest, angular_momentum=np.array([0.35, 0.0, 0.0]))
    assert bound_of(robot, drifting, **limits, axes=WHOLE).seconds <= 0.2 / 0.1
    slow = bound_of(robot, rest, **limits, axes=WHOLE, base_rate_limit=0.01)
    assert slow.seconds == pytest.approx(20.0)
    assert slow.reason == "the base rotates by 0.2 rad at no more than optimal.max_base_rate"
    # A turn about another axis than the only one is no part of the goal.
    along = bound_of(robot, rest, **limits, axes=np.array([[1.0, 0.0, 0.0]]))
    assert along == DurationBound(0.0, "")


# -- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (
            {"robot": "planar_chain", "rotvec": (0, 0, 2.6), "longest": 1.0},
            r"within optimal\.longest = 1 s: no manoeuvre to this goal takes less than 1\.\d+ s, "
            r"as the base rotates by 2\.6 rad within the velocity and acceleration limits of the "
            r"joints\. Allow more time\.",
        ),
        (
            {
                "robot": "three_joint_arm",
                "rotvec": (0, 0, 0.1),
                "start": ARM_START,
                "joint_positions": (1.0, -0.7, 1.5),
                "duration": 2.0,
            },
            # 1 rad at 0.5 rad/s, with ramps of 0.5 s: 2.5 s, less a period.
            r"within optimal\.duration = 2 s: no manoeuvre to this goal takes less than 2\.4 s, as "
            r"joint 'shoulder_yaw' moves by 1 rad",
        ),
        (
            {
                "robot": "three_joint_arm",
                "start": ARM_START,
                "end_effector_position": (0.3, 0.9, 0.2),
                "max_velocity": [0.05] * 3,
                "longest": 3.0,
            },
            r"within optimal\.longest = 3 s: no manoeuvre to this goal takes less than \d\.\d s, "
            r"as 'end_effector' moves by 1\.5\d+ m within the velocity and acceleration limits of",
        ),
        (
            {
                "robot": "three_joint_arm",
                "rotvec": (0, 0, 0.5),
                "start": ARM_START,
                "max_base_rate": 0.05,
                "longest": 9.0,
            },
            r"no manoeuvre to this goal takes less than 10 s, as the base rotates by 0\.5 rad at "
            r"no more than optimal\.max_base_rate\. Allow more time\.",
        ),
    ],
)
@pytest.mark.usefixtures("no_search")
def test_a_time_that_is_too_short_is_refused_before_a_search(
    asked: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(PlanningError, match=sentence):
        plan(**asked, **{**QUICK, "control_period": PERIOD})


@pytest.mark.parametrize(("option", "limit"), [("longest", 1.5), ("duration", 2.0)])
def test_a_refusal_says_how_long_the_fastest_manoeuvre_takes(option: str, limit: float) -> None:
    few = {**QUICK, "starts": 6, "answers": 2, "intervals": 20, option: limit}
    sentence = rf"within optimal\.{option} = {limit:g} s: the fastest one found takes 2\."
    with pytest.raises(PlanningError, match=sentence):
        plan("three_joint_arm", rotvec=(0.05, 0.0, 0.0), base_position=2, **few)
