"""End-effectors on straight lines with the base free, held against Pinocchio's momentum."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from support.hand_motion import end_of_motion
from support.planner_loop import Loop, robot_of
from support.planners import assert_within

from spacerobot_ros.errors import ParameterError, PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState, Tolerance, build_method, plan
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.planning.methods.registry import method_options
from spacerobot_ros.planning.methods.resolved_rate import ResolvedRateGait
from spacerobot_ros.simulation import InitialState

Pose = tuple[Array, Rotation]

PLACE, ATTITUDE = np.array([0.4, -0.3, 0.2]), Rotation.from_rotvec([0.3, -0.5, 0.4])
ARM = np.array([0.4, -0.9, 1.1])
HAND, LINK = "end_effector", "left_link_7"
DUAL = np.array([0.2, -0.3, 0.4, 0.5, 0.1, -0.2, 1.0, 1.2, 0.3, 0.1, 0.6, 0.7, -0.1, 0.2])
PERIOD = 0.08


def poses(robot: str, positions: Array, *links: str) -> dict[str, Pose]:
    """Return where links are after shapes (N + 1, n)."""
    model = robot_of(robot)
    urdf = model.description.urdf
    return end_of_motion(urdf, model.joint_names, positions, list(links), PLACE, ATTITUDE)


def hand(positions: Array) -> Pose:
    """Return where the hand of the arm of three joints is after shapes (N + 1, 3)."""
    return poses("three_joint_arm", positions, HAND)[HAND]


def method_of(robot: str = "three_joint_arm", **options: Any) -> ResolvedRateGait:
    chosen = {"resolved_rate": method_options("resolved_rate", options)}
    method = build_method("resolved_rate", robot_of(robot), PERIOD, 0.01, chosen)
    assert isinstance(method, ResolvedRateGait)
    return method


def request_of(
    link: str, place: npt.ArrayLike, q: Array = ARM, state: RobotState | None = None
) -> PlanRequest:
    """Return the request of a position (3,) of a link, from a shape at rest or a state."""
    goal = Goal.of_end_effectors([EndEffectorGoal(link, np.asarray(place))])
    start = state or RobotState(PLACE, ATTITUDE.as_quat(), q)
    return PlanRequest(start, goal, Tolerance(1e-6, 1e-6))


def planned(robot: str, q: Array, link: str, goal: npt.ArrayLike, **options: Any) -> GaitSchedule:
    """Return the motion of a link to a position (3,) or a pose (7,)."""
    kind = "end_effector_pose" if len(np.ravel(goal)) == 7 else "end_effector_position"
    return plan(
        robot,
        start=RobotState(PLACE, ATTITUDE.as_quat(), q),
        method="resolved_rate",
        **{"control_period": PERIOD, kind: {link: goal}, **options},
    )


@pytest.fixture(scope="module")
def arm() -> tuple[GaitSchedule, Pose, Array]:
    """Return a motion of the arm of three joints, where it begins, and its goal."""
    start = hand(ARM[np.newaxis])
    goal = start[0] + np.array([0.2, -0.25, 0.2])
    return planned("three_joint_arm", ARM, HAND, goal), start, goal


def test_the_end_effector_keeps_to_the_line_at_every_tick(
    arm: tuple[GaitSchedule, Pose, Array],
) -> None:
    schedule, (start, _), goal = arm
    way, shares = goal - start, []
    for tick in (3, schedule.ticks // 2 + 1, schedule.ticks):
        r, _ = hand(schedule.positions[: tick + 1])
        shares.append(float((r - start) @ way / (way @ way)))
        np.testing.assert_allclose(r, start + shares[-1] * way, atol=1e-8)
    assert 0.0 < shares[0] < shares[1] < 1.0
    assert shares[2] == pytest.approx(1.0, abs=1e-8)
    assert schedule.controls == {"end_effectors"}
    assert schedule.notes["predicted_end_effector_position_error"] == pytest.approx(0.0, abs=1e-9)


def test_the_motion_is_as_fast_as_the_limits_of_the_joints_allow(
    arm: tuple[GaitSchedule, Pose, Array],
) -> None:
    schedule, robot = arm[0], robot_of("three_joint_arm")
    rest = np.zeros((1, robot.n))
    rates = np.vstack([rest, schedule.velocities, rest])
    speeds = np.abs(rates) / robot.velocity_limit
    changes = np.abs(np.diff(rates, axis=0)) / PERIOD / (robot.velocity_limit / 0.5)
    assert max(speeds.max(), changes.max()) <= 1 + 1e-8
    # Somewhere a joint is at a limit, but for the ticks in which the limit is another one.
    at_limit = np.maximum(np.maximum(speeds[:-1], speeds[1:]).max(axis=1), changes.max(axis=1))
    assert np.mean(at_limit > 0.9) > 0.8


@pytest.mark.parametrize(
    "options",
    [
        {"max_velocity": (0.25, 0.2, 0.3)},
        {"max_acceleration": (0.1, 0.2, 0.15)},
        {"ramp_time": 3.0},
    ],
)
def test_lower_limits_are_kept(
    arm: tuple[GaitSchedule, Pose, Array], options: dict[str, Any]
) -> None:
    schedule, _, goal = arm
    slower = planned("three_joint_arm", ARM, HAND, goal, **options)
    assert slower.duration > 1.4 * schedule.duration
    limit = robot_of("three_joint_arm").velocity_limit
    fastest = np.array(options.get("max_velocity", limit))
    change = np.array(options.get("max_acceleration", fastest / options.get("ramp_time", 0.5)))
    assert_within(slower, fastest, change)


@pytest.mark.slow
def test_the_base_keeps_its_attitude_where_that_is_asked_for() -> None:
    start, _ = poses("dual_arm", DUAL[np.newaxis], LINK)[LINK]
    goal = start + np.array([0.1, 0.05, -0.08])
    turned = {}
    for keep in (0, 1):
        schedule = planned("dual_arm", DUAL, LINK, goal, keep_attitude=keep)
        for tick in (schedule.ticks // 2, schedule.ticks):
            found = poses("dual_arm", schedule.positions[: tick + 1], LINK, "base_link")
            turned[keep, tick < schedule.ticks] = (
                ATTITUDE.inv() * found["base_link"][1]
            ).magnitude()
        np.testing.assert_allclose(found[LINK][0], goal, atol=1e-8)
    assert min(turned[0, True], turned[0, False]) > 1e-3
    assert max(turned[1, True], turned[1, False]) < 1e-8


@pytest.mark.slow
def test_two_end_effectors_arrive_together() -> None:
    links = ("left_link_7", "right_link_7")
    starts = poses("dual_arm", DUAL[np.newaxis], *links)
    ways = {"left_link_7": [0.05, -0.08, 0.1], "right_link_7": [-0.1, 0.04, 0.02]}
    goals = {link: starts[link][0] + np.array(ways[link]) for link in links}
    schedule = plan(
        "dual_arm",
        start=RobotState(PLACE, ATTITUDE.as_quat(), DUAL),
        method="resolved_rate",
        control_period=PERIOD,
        end_effector_position=goals,
    )
    half = poses("dual_arm", schedule.positions[: schedule.ticks // 2 + 1], *links)
    shares = [
        np.linalg.norm(half[link][0] - starts[link][0]) / np.linalg.norm(ways[link])
        for link in links
    ]
    assert shares[0] == pytest.approx(shares[1], abs=1e-8)
    end = poses("dual_arm", schedule.positions, *links)
    for link in links:
        np.testing.assert_allclose(end[link][0], goals[link], atol=1e-8)


def test_a_small_way_and_none_are_planned_too(arm: tuple[GaitSchedule, Pose, Array]) -> None:
    start, _ = arm[1]
    for way in (0.0, 3e-7):
        goal = start + way * np.array([0.6, 0.0, -0.8])
        schedule = planned("three_joint_arm", ARM, HAND, goal)
        end, _ = hand(schedule.positions)
        np.testing.assert_allclose(end, goal, atol=1e-10)
        assert (schedule.ticks == 0) == (way == 0.0)


# -- through waypoints --------------------------------------------------------------------------

WAYPOINTS = np.array([[0.15, -0.1, 0.05], [0.2, -0.3, 0.2]])
"""From the start of the arm, m."""


def smooth_path(start: Array, goal: Array) -> Array:
    """Return 4001 places (N, 3) of the natural cubic spline by chords through the waypoints."""
    points = np.vstack([start, start + WAYPOINTS, goal])
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    path = CubicSpline(along, points, bc_type="natural")
    return np.asarray(path(np.linspace(0.0, along[-1], 4001)))


def test_the_end_effector_goes_through_waypoints_on_a_smooth_path(
    arm: tuple[GaitSchedule, Pose, Array],
) -> None:
    (start, _), goal = arm[1], arm[1][0] + np.array([0.05, -0.4, 0.1])
    # A waypoint that comes twice is no obstacle.
    given = np.vstack([start, start + WAYPOINTS, start + WAYPOINTS[1]])
    options = {"waypoints": tuple(given.ravel().tolist())}
    schedule = planned("three_joint_arm", ARM, HAND, goal, **options)
    path, places = smooth_path(start, goal), []
    for tick in (schedule.ticks // 4, schedule.ticks // 2, schedule.ticks):
        r, _ = hand(schedule.positions[: tick + 1])
        near = np.linalg.norm(path - r, axis=1)
        assert near.min() < 2e-4  # Half of the spacing of the path's places.
        places.append(int(near.argmin()))
    assert 0 < places[0] < places[1] < places[2] == 4000
    np.testing.assert_allclose(r, goal, atol=1e-8)
    limit = robot_of("three_joint_arm").velocity_limit
    assert_within(schedule, limit, limit / 0.5)


def test_a_path_may_end_where_it_began_and_a_correction_goes_straight(
    arm: tuple[GaitSchedule, Pose, Array],
) -> None:
    start, _ = arm[1]
    method = method_of(waypoints=tuple((start + WAYPOINTS).ravel().tolist()))
    request = request_of(HAND, start)
    schedule = method.plan(request)
    end, _ = hand(schedule.positions)
    np.testing.assert_allclose(end, start, atol=1e-8)
    assert schedule.duration > 1.0
    assert method.plan(replace(request, correction=True)).ticks == 0


def test_waypoints_that_lead_nowhere_are_refused(arm: tuple[GaitSchedule, Pose, Array]) -> None:
    start, _ = arm[1]
    with pytest.raises(ParameterError, match=r"resolved_rate\.waypoints has 4 numbers; a way"):
        planned("three_joint_arm", ARM, HAND, start, waypoints=(1.0, 2.0, 3.0, 4.0))
    with pytest.raises(
        PlanningError, match=r"^The path through the waypoints meets a dynamic|at its limit"
    ):
        planned("three_joint_arm", ARM, HAND, start, waypoints=(90.0, 2.0, 3.0))
    tip = poses("planar_chain", np.array([[0.4, -0.9]]), "segment_2")["segment_2"][0]
    above = tuple((tip + ATTITUDE.apply([0.1, 0.0, 0.2])).tolist())
    with pytest.raises(UnreachableError, match="in one plane"):
        planned("planar_chain", np.array([0.4, -0.9]), "segment_2", tip, waypoints=above)
    both = {"left_link_7": [1.0, 1.0, 1.0], "right_link_7": [1.0, -1.0, 1.0]}
    with pytest.raises(PlanningError, match="are for one end-effector, but the goal is for 2"):
        plan(
            "dual_arm",
            start=RobotState(PLACE, ATTITUDE.as_quat(), DUAL),
            method="resolved_rate",
            end_effector_position=both,
            waypoints=(1.0, 1.0, 1.0),
        )


# -- refusals -----------------------------------------------------------------------------------


def test_a_joint_at_its_limit_ends_the_line() -> None:
    start, _ = hand(np.zeros((1, 3)))
    goal = start + ATTITUDE.apply([-0.6, 0.9, 0.4])
    with pytest.raises(PlanningError, match=r"is at its limit after 0\.\d+ of 1\.1536 m") as said:
        planned("three_joint_arm", np.array([0.0, 0.0, 1e-3]), "end_effector", goal)
    assert not isinstance(said.value, UnreachableError)


@pytest.mark.parametrize(
    ("way", "keep_attitude"), [([10.0, 0.0, 0.0], 0), ([1.0, -9.0, 4.0], 0), ([0.085, 0.0, 0.0], 1)]
)
def test_a_line_is_not_traced_beyond_the_point_nearest_to_a_singularity(
    way: list[float], keep_attitude: int
) -> None:
    q, link = np.array([0.5, 0.5, 0.5, -0.5, 0.5, 0.5, 0.5]), "link_7"
    start = poses("seven_joint_arm", q[np.newaxis], link)[link][0]
    robot, cancellation = robot_of("seven_joint_arm"), Cancellation()
    method = method_of("seven_joint_arm", keep_attitude=keep_attitude, as_far_as_possible=1)
    request = request_of(link, start + way, q)
    # Beyond, the joints turn by hundreds of radians for little progress.
    timer = Timer(60.0, cancellation.cancel)
    timer.start()
    try:
        path = method.path(request, cancellation)
    finally:
        timer.cancel()
    assert path.path_fractions[-1] < 1.0
    assert np.all((robot.lower - 0.02 < path.shapes) & (path.shapes < robot.upper + 0.02))


def test_goals_out_of_reach_and_long_slow_motions_are_refused() -> None:
    with pytest.raises(UnreachableError, match=r"is out of reach: it is 9\.\d+ m from") as said:
        planned("seven_joint_arm", np.full(7, -0.5), "link_7", [10.0, 0.0, 0.0])
    assert said.value.proof is Proof.LIMITS
    start, _ = hand(ARM[np.newaxis])
    goal, slow = start + np.array([0.2, -0.25, 0.2]), (1e-9,) * 3
    with pytest.raises(PlanningError, match=r"takes \S+ s, more than 500000 ticks of 0\.08 s"):
        planned("three_joint_arm", ARM, HAND, goal, max_velocity=slow)


@pytest.fixture
def gantry(tmp_path: Path) -> Path:
    """Return the file of a robot that moves its tip with sliders of 200 km."""
    bodies = "".join(
        f'<link name="{name}"><inertial><mass value="{mass}"/><inertia ixx="1" iyy="1" izz="1" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name, mass in (("base_link", 30), ("x", 10), ("end_effector", 10))
    )
    sliders = "".join(
        f'<joint name="slider_{child}" type="prismatic"><parent link="{parent}"/><child '
        f'link="{child}"/><axis xyz="{axis}"/><limit lower="-1e5" upper="1e5" velocity="1" '
        'effort="1"/></joint>'
        for parent, child, axis in (("base_link", "x", "1 0 0"), ("x", "end_effector", "0 1 0"))
    )
    urdf = tmp_path / "gantry.urdf"
    urdf.write_text(f'<robot name="gantry">{bodies}{sliders}</robot>', "utf-8")
    return urdf


def test_the_range_of_sliders_does_not_make_a_singularity(gantry: Path) -> None:
    schedule = plan(gantry, end_effector_position=(3.0, 4.0, 0.0), method="resolved_rate")
    # The centre of mass stays: the tip moves by (0.6 x, 0.8 y).
    np.testing.assert_allclose(schedule.positions[-1], [5.0, 5.0], atol=1e-9)


@pytest.mark.slow
def test_a_line_of_kilometres_is_too_long(gantry: Path) -> None:
    with pytest.raises(PlanningError, match=r"too long: the joints move by 600 rad or m after \d"):
        plan(gantry, end_effector_position=(3e4, 4e4, 0.0), method="resolved_rate")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rotvec": (0.1, 0.0, 0.0)}, "the goal is for the base: use optimal for it"),
        (
            {"end_effector_position": (1.5, 0.4, 0.3), "position": (0, 0, 0)},
            "also requests the pose of the base: use optimal for both",
        ),
        (
            {"end_effector_position": (1.5, 0.4, 0.3), "joint_positions": (0, 0, 0.5)},
            "also requests joint positions",
        ),
        (
            {"end_effector_pose": (1.5, 0.4, 0.3, 0, 0, 0, 1)},
            "requires 6 independent coordinates, .* no more than 3: request a position instead",
        ),
        (
            {"end_effector_position": (1.5, 0.4, 0.3), "keep_attitude": 1},
            "with the base attitude kept requires 6 .* omit resolved_rate.keep_attit",
        ),
    ],
)
def test_goals_of_another_kind_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(PlanningError, match=message):
        plan("three_joint_arm", method="resolved_rate", start=ARM, **arguments)


def test_a_goal_off_the_plane_of_a_planar_robot_is_unreachable() -> None:
    with pytest.raises(UnreachableError, match="in one plane") as refusal:
        planned("planar_chain", np.array([0.4, -0.9]), "segment_2", [0.4, 0.2, 1.9])
    assert refusal.value.proof is Proof.RANK


def test_limits_without_a_speed_are_refused_by_the_name_of_the_method() -> None:
    with pytest.raises(ParameterError, match=r"resolved_rate\.max_velocity has 2 number"):
        planned("three_joint_arm", ARM, HAND, [1, 1, 1], max_velocity=(1.0, 1.0))
    with pytest.raises(ParameterError, match=r"see resolved_rate\.max_acceleration"):
        planned("three_joint_arm", ARM, HAND, [1, 1, 1], max_velocity=(1.0, 0.0, 1.0))


def test_a_line_into_the_base_ends_where_links_come_too_near() -> None:
    into: dict[str, Any] = {"start": ARM, "end_effector_position": [0.0, 0.0, 0.0]}
    asked = {**into, "method": "resolved_rate", "clearance": 0.02}
    schedule = plan("three_joint_arm", **asked, as_far_as_possible=1)
    assert str(schedule.notes["stopped"]).startswith("On the way links 'base_link' and 'link_3' ")
    geometry = Clearance(robot_of("three_joint_arm").description, 0.02).geometry
    nearest = geometry.nearest_along(schedule.positions)[0]
    assert 0.02 <= nearest.min() < 0.05


def test_a_robot_that_drifts_is_refused_and_a_search_is_cancelled() -> None:
    request = request_of(HAND, [1.6, 0.3, 0.5])
    drifting = replace(request.state, linear_momentum=np.array([0.1, 0, 0]))
    with pytest.raises(PlanningError, match="drifts"):
        method_of().plan(replace(request, state=drifting))
    cancelled = Cancellation()
    cancelled.cancel()
    with pytest.raises(PlanningCancelled):
        method_of().plan(request, cancelled)


# -- paper 4 ------------------------------------------------------------------------------------

MANIPULATOR = np.radians([-58.0, 60.3])
THETA = np.radians(21.0)
BEGIN, B = np.array([2.000077, -0.002373, 0.0]), np.array([1.5, 1.5, 0.0])


@pytest.fixture(scope="module")
def manipulator() -> tuple[SpaceRobot, RobotState]:
    """Return paper 4's robot, the centre of mass of the system at the origin."""
    robot = robot_of("planar_manipulator")
    attitude = Rotation.from_euler("z", THETA)
    r_WB = -attitude.apply(robot.center_of_mass(MANIPULATOR))
    return robot, RobotState(r_WB, attitude.as_quat(), MANIPULATOR)


def reach_b(manipulator: tuple[SpaceRobot, RobotState], **options: Any) -> GaitSchedule:
    robot, state = manipulator
    return plan(robot, end_effector_position=B, start=state, **options)


def test_paper_4_the_straight_line_to_b_meets_a_dynamic_singularity(
    manipulator: tuple[SpaceRobot, RobotState],
) -> None:
    # Computed independently of this program, from the paper's Table I.
    with pytest.raises(
        PlanningError,
        match=r"meets a dynamic singularity after 1\.19498 of 1\.5834\d m of the line of "
        r"'end_effector': \|det J\*\|, 0\.373488 at the start, is zero at the shape "
        r"\(1\.27635, 0\.198006\).*optimal may reach",
    ) as refusal:
        reach_b(manipulator, method="resolved_rate")
    assert not isinstance(refusal.value, UnreachableError)


def test_paper_4_the_path_ends_at_the_singularity(
    manipulator: tuple[SpaceRobot, RobotState],
) -> None:
    robot, state = manipulator
    path = method_of("planar_manipulator").path(request_of(HAND, B, state=state))
    assert path.progress_rate[-1] == pytest.approx(0.0, abs=1e-8)
    # Computed independently of this program, from the paper's Table I.
    assert 1.583415 * path.path_fractions[-1] == pytest.approx(1.194983, abs=2e-6)
    assert np.degrees(path.shapes[-1]) == pytest.approx([73.1295, 11.3449], abs=1e-4)
    turned = Rotation.from_quat(path.turns[-1]).as_rotvec(degrees=True)
    assert 21.0 + turned[2] == pytest.approx(-31.9510, abs=1e-4)
    attitude = Rotation.from_euler("z", np.radians(21.0) + np.radians(turned[2]))
    q = path.shapes[-1]
    reached = attitude.apply(robot.link_pose(HAND, q)[1] - robot.center_of_mass(q))
    assert reached[:2] == pytest.approx([1.622675, 1.131448], abs=2e-6)


def test_paper_4_the_line_is_followed_until_shortly_before_the_singularity(
    manipulator: tuple[SpaceRobot, RobotState],
) -> None:
    schedule = reach_b(manipulator, method="resolved_rate", as_far_as_possible=1)
    assert "meets a dynamic singularity after 1.19498 of" in str(schedule.notes["stopped"])
    reached = np.array(schedule.notes["final_pose_of_end_effector"][:3])  # type: ignore[index]
    way = (B - BEGIN) / np.linalg.norm(B - BEGIN)
    np.testing.assert_allclose(reached, BEGIN + (reached - BEGIN) @ way * way, atol=2e-6)
    assert 1.18 < (reached - BEGIN) @ way < 1.194983
    # It goes slowly in the end: from rest to rest, with rates that are possible.
    rates = np.vstack([schedule.velocities, np.zeros((1, 2))])
    assert np.abs(np.diff(rates, axis=0)).max() <= schedule.control_period * 4.0 * (1 + 1e-8)
    path = schedule.path
    state = RobotState(path.position[-1], path.quaternion[-1], schedule.positions[-1])
    # From there no rates lead on, and the line is refused.
    with pytest.raises(PlanningError, match=r"meets a dynamic singularity after 0\.00"):
        reach_b((manipulator[0], state), method="resolved_rate", as_far_as_possible=1)


@pytest.mark.slow
def test_paper_4_a_flight_stops_before_the_singularity_and_says_why(
    manipulator: tuple[SpaceRobot, RobotState],
) -> None:
    state = manipulator[1]
    loop = Loop(
        {"method": "resolved_rate", "resolved_rate.as_far_as_possible": 1},
        robot="planar_manipulator",
        initial=InitialState(state.position, state.quaternion, state.q),
    )
    status = loop.decide(request_of(HAND, B).goal)
    assert status.state is PlannerState.FAILED
    assert "The straight line meets a dynamic singularity after 0.00" in status.message
    loop.tick(5)
    assert not loop.commands[-1].any()
    pose, (_, r_BE) = loop.poses[-1], loop.plant.robot.link_pose(HAND, loop.shapes[-1])
    reached = pose[:3] + Rotation.from_quat(pose[3:]).apply(r_BE)
    assert 1.18 < np.linalg.norm(reached - BEGIN) < 1.194983


def test_paper_4_lines_that_end_before_the_singularity_are_followed(
    manipulator: tuple[SpaceRobot, RobotState],
) -> None:
    robot, state = manipulator
    goal = BEGIN + 1.194 * (B - BEGIN) / np.linalg.norm(B - BEGIN)
    schedule = plan(robot, end_effector_position=goal, start=state, method="resolved_rate")
    found = end_of_motion(
        *(robot.description.urdf, robot.joint_names, schedule.positions, [HAND, "base_link"]),
        state.position,
        Rotation.from_quat(state.quaternion),
    )
    np.testing.assert_allclose(found["end_effector"][0], goal, atol=1e-8)
    # Near theta = -31.9510 deg and q = (73.1295, 11.3449) deg of the singularity.
    assert np.degrees(schedule.positions[-1]) == pytest.approx([73.13, 11.34], abs=3.5)
    assert found["base_link"][1].as_euler("xyz", degrees=True)[2] == pytest.approx(-31.95, abs=3.5)
    assert schedule.notes["at_start"] == pytest.approx(0.373488, abs=1e-6)
    assert 0.0 < float(str(schedule.notes["least"])) < 0.05


def test_paper_4_optimal_reaches_b(manipulator: tuple[SpaceRobot, RobotState]) -> None:
    schedule = reach_b(manipulator, cache=0, answers=1, max_acceleration=(4.0, 4.0))
    assert schedule.duration < 3.5
    assert schedule.notes["predicted_end_effector_position_error"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("clearance", "longest"), [(0.0, 3.00), (0.01, 3.22)])
def test_paper_4_optimal_reaches_b_as_fast_as_published(
    manipulator: tuple[SpaceRobot, RobotState], clearance: float, longest: float
) -> None:
    schedule = reach_b(
        manipulator, cache=0, max_acceleration=(4.0, 4.0), clearance=clearance, control_period=0.01
    )
    # A tick or two more, for held commands that end on the goal.
    assert schedule.notes["solution_time"] <= longest + 0.005  # type: ignore[operator]
    assert schedule.duration <= longest + 0.02
