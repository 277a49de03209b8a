"""Schedules tick by tick: what is commanded, how joints brake, when the base is off its path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import StubMethod, goal_at, robot_of

from spacerobot_ros.planning import GaitSchedule, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.core.cancellation import Cancellation
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.path_deviation import PathCheck, TrackingError
from spacerobot_ros.planning.execution.tracker import (
    BrakingFollower,
    ScheduleFollower,
    TrajectoryTracker,
)
from spacerobot_ros.planning.execution.worker import PlanningTask, PlanningWorker

Array = npt.NDArray[np.float64]

PERIOD = 0.1
PERIOD_NS = 100_000_000
START_NS = 7_000_000_123
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
RAMP = np.outer(np.arange(21), [0.01, -0.02, 0.0])
"""20 ticks at 0.1 and -0.2 m/s, the third slider at rest."""


def schedule_of(positions: Array = RAMP, path: BasePath | None = None) -> GaitSchedule:
    time: Array = PERIOD * np.arange(len(positions), dtype=float)
    still = BasePath(time, np.zeros((len(time), 3)), np.tile(UPRIGHT, (len(time), 1)))
    return GaitSchedule(
        method="by hand",
        joint_names=robot_of().joint_names,
        control_period=PERIOD,
        positions=positions,
        path=path or still,
        goal=goal_at(([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])),
    )


def commanded(
    follower: ScheduleFollower | BrakingFollower, tick: float, q: Array
) -> tuple[Array, Array]:
    position, velocity = np.full(3, np.nan), np.full(3, np.nan)
    follower.command(START_NS + round(tick * PERIOD_NS), q, position, velocity)
    return position, velocity


# -- following --------------------------------------------------------------------------------


@pytest.mark.parametrize("deadband", [0.0, 0.004])
def test_the_velocity_of_the_tick_and_the_gain_times_the_error_are_commanded(
    deadband: float,
) -> None:
    follower = ScheduleFollower(schedule_of(), START_NS, 3.0, deadband)
    error = np.array([0.005, -0.001, 0.0])
    fed_back = np.sign(error) * np.maximum(np.abs(error) - deadband, 0.0)
    for tick, row, velocity in (
        (-2, 0, [0.1, -0.2, 0.0]),
        (0, 0, [0.1, -0.2, 0.0]),
        (5.5, 5, [0.1, -0.2, 0.0]),
        (19, 19, [0.1, -0.2, 0.0]),
        (20, 20, [0.0, 0.0, 0.0]),
        (31, 20, [0.0, 0.0, 0.0]),
    ):
        position, found = commanded(follower, tick, RAMP[row] - error)
        np.testing.assert_array_equal(position, RAMP[row])
        np.testing.assert_allclose(found, velocity + 3.0 * fed_back, atol=1e-15)


def test_the_gain_takes_no_more_than_the_whole_error_in_a_tick() -> None:
    follower = ScheduleFollower(schedule_of(), START_NS, 1e3)
    position, velocity = commanded(follower, 20, RAMP[20] - 0.01)
    np.testing.assert_allclose(position - 0.01 + PERIOD * velocity, position, atol=1e-15)


def test_a_schedule_has_ended_when_its_last_shape_is_reached_or_long_over() -> None:
    end = START_NS + 20 * PERIOD_NS
    for deadband, near in ((0.0, 1e-6), (0.004, 0.004)):
        follower = ScheduleFollower(schedule_of(), START_NS, 1.0, deadband)
        last = RAMP[-1]
        assert not follower.has_ended(end - 1, last)
        assert follower.has_ended(end, last + 0.99 * near)
        far = last + np.array([0.0, 0.0, 1.01 * near])
        assert not follower.has_ended(end, far)
        assert not follower.has_ended(end + 5_000_000_000, far)
        assert follower.has_ended(end + 5_000_000_001, far)


# -- braking ----------------------------------------------------------------------------------


def test_braking_takes_half_of_the_way_that_the_time_would_have_taken() -> None:
    """The time of the gait runs at the rate 1 - t/T: after t it is at t - t^2 / (2 T)."""
    follower = ScheduleFollower(schedule_of(), START_NS, 2.0)
    braking = follower.braking_follower(START_NS + 4 * PERIOD_NS, 1.2)
    for ticks in (0.0, 3.0, 7.5, 12.0, 40.0):
        t = min(ticks * PERIOD, 1.2)
        way = 0.4 + t - t**2 / (2 * 1.2)
        position, velocity = commanded(braking, 4 + ticks, np.zeros(3))
        np.testing.assert_allclose(position, way * np.array([0.1, -0.2, 0.0]), atol=1e-12)
        after = min(t + PERIOD, 1.2)
        rate = (after - after**2 / 2.4 - t + t**2 / 2.4) / PERIOD
        expected = rate * np.array([0.1, -0.2, 0.0]) + 2.0 * position
        np.testing.assert_allclose(velocity, expected, atol=1e-12)
    begin = START_NS + 4 * PERIOD_NS
    assert not braking.has_ended(begin + 1_199_999_999, np.zeros(3))
    assert braking.has_ended(begin + 1_200_000_000, np.zeros(3))


def test_braking_near_the_end_of_a_schedule_stays_on_it() -> None:
    follower = ScheduleFollower(schedule_of(), START_NS, 2.0)
    braking = follower.braking_follower(START_NS + 19 * PERIOD_NS, 1.0)
    np.testing.assert_allclose(commanded(braking, 30, RAMP[20])[0], RAMP[20])


def test_wheels_go_over_to_their_rates_after_the_schedule_while_the_others_brake() -> None:
    ends = np.array([0.0, 0.6, 0.0])
    schedule = replace(schedule_of(), end_velocities=ends)
    braking = ScheduleFollower(schedule, START_NS, 2.0).braking_follower(
        START_NS + 4 * PERIOD_NS, 1.2
    )
    places = np.array([commanded(braking, 4 + ticks, np.zeros(3))[0] for ticks in range(16)])
    plain = ScheduleFollower(schedule_of(), START_NS, 2.0).braking_follower(
        START_NS + 4 * PERIOD_NS, 1.2
    )
    others = np.array([commanded(plain, 4 + ticks, np.zeros(3))[0] for ticks in range(16)])
    np.testing.assert_array_equal(places[:, [0, 2]], others[:, [0, 2]])
    # From -0.2 to 0.6 rad/s in 1.2 s, by the trapezoids of a steady change; then steadily on.
    rates = np.interp(PERIOD * np.arange(16), [0.0, 1.2], [-0.2, 0.6])
    trapezoids = PERIOD * np.cumsum((rates[1:] + rates[:-1]) / 2)
    np.testing.assert_allclose(places[:, 1], -0.08 + np.append(0.0, trapezoids), atol=1e-12)


@pytest.mark.parametrize("since", [0, 3, 9, 40])
def test_the_shapes_of_braking_are_those_that_will_be_commanded(since: int) -> None:
    follower = ScheduleFollower(schedule_of(), START_NS, 2.0)
    braking = follower.braking_follower(START_NS + 4 * PERIOD_NS, 1.0)
    shapes = braking.shapes(START_NS + (4 + since) * PERIOD_NS)
    assert len(shapes) == max(1, 10 - since) + 1
    for k, shape in enumerate(shapes):
        np.testing.assert_allclose(shape, commanded(braking, 4 + since + k, shape)[0], atol=1e-12)


# -- off the path -----------------------------------------------------------------------------


def turned(angle: float) -> Array:
    return np.asarray(Rotation.from_rotvec([0.0, angle, 0.0]).as_quat())


def check_of(schedule: GaitSchedule, position: float, attitude: float) -> PathCheck:
    config = PlannerConfig(drift_position=position, drift_attitude=attitude)
    return PathCheck(robot_of(), schedule, START_NS, config)


def state_at(position: Array, quaternion: Array) -> RobotState:
    return RobotState(position, quaternion, np.zeros(3))


@pytest.mark.parametrize(
    ("limits", "distance", "angle", "off"),
    [
        ((1e-3, 1e-1), 0.9e-3, 0.9e-1, False),
        ((1e-3, 1e-1), 1.1e-3, 0.0, True),
        ((1e-3, 1e-1), 0.0, 1.1e-1, True),
        ((1e-1, 1e-3), 0.9e-1, 0.9e-3, False),
        ((1e-1, 1e-3), 1.1e-1, 0.0, True),
        ((1e-1, 1e-3), 0.0, 1.1e-3, True),
        ((0.0, 1e-3), 5.0, 0.9e-3, False),
        ((0.0, 1e-3), 0.0, 1.1e-3, True),
        ((1e-3, 0.0), 0.9e-3, 3.0, False),
        ((1e-3, 0.0), 1.1e-3, 0.0, True),
    ],
)
def test_distance_and_angle_have_limits_of_their_own(
    limits: tuple[float, float], distance: float, angle: float, off: bool
) -> None:
    check = check_of(schedule_of(), *limits)
    assert check.due(START_NS)
    found = check.error(state_at(np.array([0.0, distance, 0.0]), turned(angle)))
    if off:
        assert found is not None
        assert (found.distance, found.angle) == pytest.approx((distance, angle))
    else:
        assert found is None


def test_the_base_is_compared_with_the_pose_of_its_own_instant() -> None:
    time = np.array([0.0, 0.5, 2.0])
    places = np.outer([0.0, 1.0, 2.0], [1.0, 0.0, 0.0])
    path = BasePath(time, places, np.array([turned(0.0), turned(0.3), turned(0.6)]))
    check = check_of(schedule_of(path=path), 1e-6, 1e-6)
    due = []
    for tick in range(25):
        stamp = START_NS + tick * PERIOD_NS
        if check.due(stamp):
            due.append(tick)
            k = len(due) - 1
            assert check.error(state_at(places[k], turned(0.3 * k))) is None
            assert check.error(state_at(places[k - 1], turned(0.3 * k))) is not None
    assert due == [0, 5, 20]


def test_instants_between_two_ticks_and_missed_ones_are_passed_over() -> None:
    path = BasePath(np.array([0.0, 0.06, 1.0]), np.zeros((3, 3)), np.tile(UPRIGHT, (3, 1)))
    check = check_of(schedule_of(path=path), 1e-6, 0.0)
    assert check.due(START_NS + PERIOD_NS), "0.06 s is within half a tick of the first"
    assert not check.due(START_NS + 2 * PERIOD_NS)
    assert not check.due(START_NS + 15 * PERIOD_NS)
    unused = check_of(schedule_of(), 0.0, 0.0)
    assert not unused.due(START_NS)
    assert str(TrackingError(0.25, 1.5)) == "Off the path by 0.25 m and 1.5 rad"


# -- one schedule after the other -------------------------------------------------------------


def test_a_tracker_holds_the_last_shape_of_a_schedule_or_the_measured_one() -> None:
    config = replace(PlannerConfig(tick_rate=1 / PERIOD), output="reference")
    tracker = TrajectoryTracker(robot_of(), config)
    measured = RAMP[20] + 0.003
    tracker.start(schedule_of(), START_NS)
    assert (tracker.is_active, tracker.is_braking) == (True, False)
    assert tracker.track(START_NS + 3 * PERIOD_NS, measured) == []
    np.testing.assert_allclose(tracker.setpoint.velocity, [0.1, -0.2, 0.0], atol=1e-12)
    tracker.stop(at_last_shape=True)
    tracker.hold(measured)
    np.testing.assert_array_equal(tracker.setpoint.position, RAMP[20])
    tracker.start(schedule_of(), START_NS)
    tracker.brake(START_NS)
    assert tracker.is_braking
    tracker.stop(at_last_shape=False)
    tracker.hold(measured)
    np.testing.assert_array_equal(tracker.setpoint.position, measured)
    np.testing.assert_array_equal(tracker.setpoint.velocity, np.zeros(3))
    tracker.hold(measured + 1.0)
    np.testing.assert_array_equal(tracker.setpoint.position, measured)


def test_joints_that_move_while_no_command_is_in_force_are_not_pulled_back() -> None:
    config = replace(PlannerConfig(tick_rate=1 / PERIOD), output="reference")
    tracker = TrajectoryTracker(robot_of(), config)
    tracker.start(schedule_of(), START_NS)
    tracker.stop(at_last_shape=True)
    for step in (0.004, 0.006):
        tracker.hold(RAMP[20] + step, obeyed=False)
        np.testing.assert_array_equal(tracker.setpoint.position, RAMP[20] + step)
    tracker.hold(RAMP[20] + 0.1)
    np.testing.assert_array_equal(tracker.setpoint.position, RAMP[20] + 0.006)


def test_a_stuck_joint_is_commanded_to_rest_and_a_broken_measurement_stops_all() -> None:
    tracker = TrajectoryTracker(robot_of(), PlannerConfig(tick_rate=1 / PERIOD))
    tracker.start(schedule_of(), START_NS)
    tracker.stuck = [1]
    tracker.track(START_NS, RAMP[0])
    np.testing.assert_allclose(tracker.setpoint.velocity, [0.1, 0.0, 0.0], atol=1e-12)
    tracker.track(START_NS, np.array([0.0, np.nan, 0.0]))
    np.testing.assert_array_equal(tracker.setpoint.velocity, np.zeros(3))


# -- braking into the next plan ---------------------------------------------------------------


def test_a_plan_in_flight_begins_where_the_momenta_bring_the_base_meanwhile() -> None:
    """By hand: sliders that rest at the centre of a rigid base, which coasts and spins about x."""
    robot = robot_of()
    method = StubMethod()
    worker = PlanningWorker(robot, PlannerConfig(tick_rate=1 / PERIOD), method)
    resting = np.zeros((40, 3))
    follower = ScheduleFollower(schedule_of(resting), START_NS, 1.0)
    braking = follower.braking_follower(START_NS, 2.0).shapes(START_NS)
    inertia = robot.inertia_matrix(np.zeros(3))[3:6, 3:6]
    np.testing.assert_allclose(inertia, np.diag(np.diag(inertia)), atol=1e-12)
    p, L = np.array([0.3, -0.2, 0.1]), np.array([0.05, 0.0, 0.0])
    state = RobotState(np.array([0.1, 0.0, 0.2]), UPRIGHT, np.zeros(3), p, L)
    request = PlanRequest(state, goal_at(([0.2, 0.1, 0.0], [0.0, 0.0, 0.0])), Tolerance(1e-3, 1e-2))
    schedule = worker.plan(PlanningTask(request, braking=braking), Cancellation())
    (asked,) = method.requests
    at_rest = asked.state
    np.testing.assert_allclose(
        at_rest.position, state.position + 2.0 * p / robot.total_mass, atol=1e-9
    )
    expected = Rotation.from_rotvec([2.0 * L[0] / inertia[0, 0], 0.0, 0.0])
    miss = Rotation.from_quat(at_rest.quaternion).inv() * expected
    assert miss.magnitude() < 1e-9
    np.testing.assert_array_equal(at_rest.angular_momentum, L)
    np.testing.assert_array_equal(at_rest.linear_momentum, p)
    # The path of the whole: braking for 20 ticks of 0.1 s, then the plan.
    np.testing.assert_allclose(schedule.path.time[:21], PERIOD * np.arange(21), atol=1e-12)
    assert schedule.path.time[-1] == pytest.approx(2.0 + method.ticks * 0.05)
    np.testing.assert_allclose(schedule.path.position[20], at_rest.position, atol=1e-12)
    assert len(schedule.positions) == 20 + method.ticks + 1
