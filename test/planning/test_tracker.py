"""Schedules tick by tick, and where a robot is from several measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.planner_loop import TICK, StubMethod, goal_at, robot_of

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import GaitSchedule, Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.core.cancellation import Cancellation
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.measured_states import PathCheck, StateAverage
from spacerobot_ros.planning.execution.tracker import ScheduleFollower, TrajectoryTracker
from spacerobot_ros.planning.execution.worker import PlanningTask, PlanningWorker
from spacerobot_ros.simulation import EffortPlant, InitialState

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


def commanded(follower: ScheduleFollower, tick: float, q: Array) -> tuple[Array, Array]:
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
    braking = follower.braking(START_NS + 4 * PERIOD_NS, 1.2)
    for ticks in (0.0, 3.0, 7.0, 12.0, 40.0):
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
    braking = follower.braking(START_NS + 19 * PERIOD_NS, 1.0)
    np.testing.assert_allclose(commanded(braking, 30, RAMP[20])[0], RAMP[20])


def test_wheels_go_over_to_their_rates_after_the_schedule_while_the_others_brake() -> None:
    ends = np.array([0.0, 0.6, 0.0])
    schedule = replace(schedule_of(), end_velocities=ends)
    begin = START_NS + 4 * PERIOD_NS
    braking = ScheduleFollower(schedule, START_NS, 2.0).braking(begin, 1.2)
    places = np.array([commanded(braking, 4 + ticks, np.zeros(3))[0] for ticks in range(16)])
    plain = ScheduleFollower(schedule_of(), START_NS, 2.0).braking(begin, 1.2)
    others = np.array([commanded(plain, 4 + ticks, np.zeros(3))[0] for ticks in range(16)])
    np.testing.assert_array_equal(places[:, [0, 2]], others[:, [0, 2]])
    # From -0.2 to 0.6 rad/s in 1.2 s, by the trapezoids of a steady change; then steadily on.
    rates = np.interp(PERIOD * np.arange(16), [0.0, 1.2], [-0.2, 0.6])
    trapezoids = PERIOD * np.cumsum((rates[1:] + rates[:-1]) / 2)
    np.testing.assert_allclose(places[:, 1], -0.08 + np.append(0.0, trapezoids), atol=1e-12)


@pytest.mark.parametrize("since", [0, 3, 9])
def test_the_shapes_of_braking_are_those_that_will_be_commanded(since: int) -> None:
    follower = ScheduleFollower(schedule_of(), START_NS, 2.0)
    braking = follower.braking(START_NS + 4 * PERIOD_NS, 1.0)
    shapes = braking.shapes_from(START_NS + (4 + since) * PERIOD_NS)
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


def test_after_a_late_command_a_schedule_ends_well_within_the_tolerance() -> None:
    config, q = PlannerConfig(tick_rate=1 / PERIOD), RAMP[-1] + np.array([0.03, -0.05, 0.0])
    tracker, tolerance = TrajectoryTracker(robot_of(), config), Tolerance(2e-3, 1e-3, 3e-3)
    tracker.start(schedule_of(), START_NS, tolerance=tolerance)
    tick = 20
    while not tracker.has_ended(START_NS + tick * PERIOD_NS, q):
        tracker.track(START_NS + tick * PERIOD_NS, q)
        q = q + PERIOD * tracker.setpoint.velocity
        tick += 1
    assert 2e-5 < np.abs(RAMP[-1] - q).max() <= 5e-5
    assert tick - 20 == np.ceil(np.log(5e-5 / 0.05) / np.log(1 - config.shape_gain * PERIOD))


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
    braking = follower.braking(START_NS, 2.0).shapes_from(START_NS)
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


# -- where a robot is from several measurements, and what momenta they show ----------------------


ARM = robot_of("three_joint_arm")
Q = np.array([0.2, -0.4, 0.9])
REST = np.zeros(3)
STILL = np.zeros(6)


def pose(position: float = 0.0, turn: Rotation | None = None) -> np.ndarray:
    attitude = turn or Rotation.identity()
    return np.concatenate([[position, 0.0, 0.0], attitude.as_quat()])


def test_the_mean_of_noisy_states_is_nearer_by_the_root_of_their_number() -> None:
    rng = np.random.default_rng(0)
    true = Rotation.from_rotvec([2.0, -1.5, 1.0])
    single, averaged = [], []
    for _ in range(60):
        average = StateAverage(ARM, 25)
        for _ in range(25):
            assert not average.complete
            turned = true * Rotation.from_rotvec(rng.normal(0.0, 1e-3, 3))
            # Either sign of a quaternion is the same attitude.
            measured = pose(1.0, turned)
            measured[3:] *= rng.choice([-1.0, 1.0])
            measured[:3] += rng.normal(0.0, 2e-3, 3)
            average.add(measured, STILL, Q + rng.normal(0.0, 3e-3, 3), REST)
        assert average.complete
        state = average.state()
        error = (true.inv() * Rotation.from_quat(state.quaternion)).as_rotvec()
        averaged.append([*(state.position - [1.0, 0.0, 0.0]), *error, *(state.q - Q)])
        single.append([*(measured[:3] - [1.0, 0.0, 0.0]), *(true.inv() * turned).as_rotvec()])
    sigma = np.sqrt(np.mean(np.square(averaged).reshape(60, 3, 3), axis=(0, 2)))
    np.testing.assert_allclose(sigma, np.array([2e-3, 1e-3, 3e-3]) / 5, rtol=0.25)
    assert np.std(single) > 3 * np.std(averaged)


def test_momenta_are_those_measured_last_at_rest() -> None:
    average = StateAverage(ARM)
    twist = np.array([0.01, 0.0, -0.02, 0.03, 0.0, 0.01])
    average.add(pose(), twist, Q, REST)
    oracle = PinocchioOracle(ARM.description.urdf, ARM.joint_names)
    oracle.set_configuration(Q, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    oracle.move(oracle.base_velocities(twist) + oracle.joint_velocities(REST))
    p, L, _ = oracle.momentum_W()
    state = average.state()
    np.testing.assert_allclose(state.linear_momentum, p, atol=1e-12)
    np.testing.assert_allclose(state.angular_momentum, L, atol=1e-12)
    average.restart()
    assert average.count == 0
    average.add(pose(), 2 * twist, Q, np.array([0.1, 0.0, 0.0]))
    moving = average.state()
    np.testing.assert_array_equal(moving.linear_momentum, state.linear_momentum)


def test_before_a_robot_was_at_rest_its_momenta_are_those_in_motion() -> None:
    average = StateAverage(ARM)
    average.add(pose(), np.array([0.01, 0.0, -0.02, 0.03, 0.0, 0.01]), Q, REST)
    assert np.abs(average.state().angular_momentum).max() > 0.01
    # It is put elsewhere, where its momenta are others, and its joints move.
    average.forget()
    assert average.count == 0
    p, L = np.array([0.2, -0.1, 0.3]), np.array([0.03, 0.02, -0.01])
    initial = InitialState(
        joint_positions=Q, joint_velocities=-Q, linear_momentum=p, angular_momentum=L
    )
    plant = EffortPlant(ARM, 0.01, initial)
    assert plant.qdot.any()
    average.add(plant.pose, plant.twist, plant.q, plant.qdot)
    state = average.state()
    np.testing.assert_allclose(state.linear_momentum, p, atol=1e-12)
    np.testing.assert_allclose(state.angular_momentum, L, atol=1e-12)


def test_rates_within_the_tolerance_are_rest_and_larger_ones_are_not() -> None:
    average = StateAverage(ARM, 2, rest_tolerance=0.01)
    average.add(pose(), STILL + 0.012, Q, REST + 0.012)
    average.add(pose(), STILL + 0.006, Q, REST - 0.006)
    assert not average.state().linear_momentum.any(), "0.009 on the average"
    average.restart()
    average.add(pose(), STILL + 0.02, Q, REST)
    assert np.linalg.norm(average.state().linear_momentum) > 1.0


@pytest.mark.parametrize("part", range(4))
def test_what_is_not_finite_is_refused(part: int) -> None:
    parts = [pose(), STILL.copy(), Q.copy(), REST.copy()]
    parts[part][1] = np.nan
    average = StateAverage(ARM, 2)
    average.add(pose(), STILL, Q, REST)
    average.add(*parts)
    with pytest.raises(PlanningError, match="not finite"):
        average.state()


# -- aims of plans for end-effectors ------------------------------------------------------------


SHAPE = np.array([0.2, -0.6, 1.3])
END = Rotation.from_rotvec([0.2, 0.0, 0.4])
PLACE = np.array([1.0, 2.0, 3.0])
BEGIN_NS = 7_000_000_000


def checked_path(goal: Goal) -> PathCheck:
    """Return the check of a path to :data:`PLACE` with a pose every two ticks."""
    time = TICK * np.arange(0.0, 21.0, 2.0)
    places = np.linspace(0.0, 1.0, 11)[:, np.newaxis] * PLACE
    path = BasePath(time, places, np.tile(END.as_quat(), (11, 1)))
    shapes = np.tile(SHAPE, (21, 1))
    shapes[:2] += 0.2
    schedule = GaitSchedule("stub", ARM.joint_names, TICK, shapes, path, goal)
    return PathCheck(ARM, schedule, BEGIN_NS, PlannerConfig(), average=1)


def hand_of_arm() -> tuple[str, Array, Rotation]:
    """Return the last link, its position in the world and its attitude at the end of the path."""
    link = ARM.link_names[-1]
    R, r = ARM.link_pose(link, SHAPE)
    return link, PLACE + END.apply(r), END * Rotation.from_matrix(R)


WITHIN = Tolerance(0.5, 0.1)


@pytest.mark.parametrize("turned", [True, False])
@pytest.mark.parametrize(
    ("share", "angle", "late", "left"),
    [
        (0.59, 0.059, False, None),
        (0.61, 0.02, False, (0.4, 0.02)),
        (0.3, 0.061, False, (0.3, 0.04)),
        (0.79, 0.079, True, None),
        (0.81, 0.081, True, (0.6, 0.06)),
    ],
)
def test_the_aim_for_an_end_effector_leaves_a_share_of_each_tolerance(
    share: float, angle: float, late: bool, left: tuple[float, float] | None, turned: bool
) -> None:
    link, r_WE, R_WE = hand_of_arm()
    wanted = R_WE * Rotation.from_rotvec([0.0, 0.0, angle])
    aim_at = r_WE + np.array([0.3, -0.4, 0.0]) * share
    hand = EndEffectorGoal(link, aim_at, wanted.as_quat() if turned else None)
    goal = Goal(PLACE, END.as_quat(), None, (hand,), frozenset())
    check = checked_path(goal)
    assert check.due(BEGIN_NS)
    moved = check.shift_goal(goal, WITHIN, frozenset({"end_effectors"}), late=late)
    if left is None or (not turned and share < 0.6):
        assert moved is None
        return
    assert moved is not None
    (given,) = moved.end_effectors
    apart = aim_at - given.position
    np.testing.assert_allclose(apart, np.array([0.3, -0.4, 0.0]) * left[0], atol=1e-12)
    assert given.link == link
    if not turned:
        assert given.quaternion is None
        return
    assert given.quaternion is not None
    turn = Rotation.from_quat(given.quaternion).inv() * wanted
    np.testing.assert_allclose(turn.as_rotvec(), [0.0, 0.0, left[1]], atol=1e-9)
