"""Reaction wheels of a controller: allocation, saturation, dumping, failures, and messages."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from control.flights import Reporting, load
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle, random_motion
from support.wheels import wheeled_robot

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.state import (
    Actuation,
    ControlState,
    JointReference,
    PoseReference,
    Reference,
)
from spacerobot_ros.control.wheels import WheelAllocation, WheelControl, WheelOptions
from spacerobot_ros.errors import CommandError, ParameterError, PlanningError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal, PursuedGoals
from spacerobot_ros.resources import robot_file

RNG = np.random.default_rng(3)
ROBOT = wheeled_robot()
WHEELS = ReactionWheels.of(ROBOT.description)
PERIOD = 0.02
PLANAR = load("planar_manipulator")
TENDER = ReactionWheels.of(SpaceRobot.from_file(robot_file("tender")).description)


def control(thruster_torque: float = 1.0, **options: object) -> WheelControl:
    return WheelControl(ROBOT, configured(WheelOptions, options), PERIOD, thruster_torque)


def observe(wheels: WheelControl, rates: list[float], omega: tuple[float, ...] = (0, 0, 0)) -> None:
    q, qdot = np.zeros(4), np.array([rates[0], rates[1], 0.0, rates[2]])
    zero = np.zeros(3)
    state = ControlState(
        zero, np.array([0.0, 0, 0, 1]), zero, np.array(omega, dtype=float), q, qdot
    )
    wheels.observe(state, q, qdot)


# -- allocation -------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6])
def test_torques_within_their_bounds_are_the_nearest(count: int) -> None:
    axes, torque = RNG.normal(size=(3, count)), RNG.uniform(0.1, 0.5, count)
    allocation = WheelAllocation(axes, torque)
    assert allocation.rank == min(count, 3)
    for size in (0.02, 0.3, 3.0):
        wanted = size * RNG.normal(size=3)
        lower, upper = -RNG.uniform(0.1, 1, count) * torque, RNG.uniform(0.1, 1, count) * torque
        tau = allocation.allocate(wanted, lower, upper)
        assert np.all((lower <= tau) & (tau <= upper))
        best = lsq_linear(axes, wanted, (lower, upper), method="trf", tol=1e-13)
        left = np.linalg.norm(axes @ tau - wanted)
        assert left == pytest.approx(math.sqrt(2 * best.cost), abs=1e-6)


def test_of_equal_allocations_the_one_with_least_shares_is_taken() -> None:
    allocation = WheelAllocation(np.array([[1.0, 1], [0, 0], [0, 0]]), np.array([0.4, 0.1]))
    bounds = np.array([0.4, 0.1])
    tau = allocation.allocate(np.array([0.17, 0.0, 0.0]), -bounds, bounds)
    # Least sum of (tau_i / torque_i)^2: in the ratio of the squares of the torques.
    np.testing.assert_allclose(tau, [0.16, 0.01])
    held = allocation.allocate(np.array([0.17, 0.0, 0.0]), -bounds, np.array([0.05, 0.1]))
    np.testing.assert_allclose(held, [0.05, 0.1], atol=1e-9)


def test_the_least_torque_of_a_pyramid_is_that_along_its_worst_direction() -> None:
    allocation = WheelAllocation(TENDER.axes_B, TENDER.torque)
    directions = RNG.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    inverse = np.linalg.pinv(TENDER.axes_B)
    reach = (TENDER.torque / np.abs(directions @ inverse.T)).min(axis=1)
    assert allocation.within(TENDER.torque) == pytest.approx(reach.min(), rel=0.01)
    assert allocation.within(TENDER.torque) <= reach.min()
    assert WheelAllocation(np.eye(3)[:, :2], np.ones(2)).within(np.ones(2)) == 0.0


# -- torques ----------------------------------------------------------------------------------


def test_a_torque_is_given_with_the_gyroscopic_torque_compensated() -> None:
    wheels, omega = control(), (0.02, -0.03, 0.01)
    observe(wheels, [20.0, -10.0, 15.0], omega)
    wanted = np.array([0.02, -0.01, 0.015])
    given = wheels.command_torque(wanted)
    assert given.tolist() == wanted.tolist()
    h = 0.03 * (WHEELS.axes_B.T @ omega + [20.0, -10.0, 15.0])
    demanded = -(wanted + np.cross(omega, WHEELS.axes_B @ h))
    np.testing.assert_allclose(WHEELS.axes_B @ wheels.torque, demanded)


def test_a_wheel_reaches_its_largest_rate_in_two_periods_at_the_earliest() -> None:
    wheels, inverse = control(), np.linalg.inv(WHEELS.axes_B)

    def strongest(sign: float) -> list[float]:
        """Return the torques for a demand so large that every wheel gives all it may."""
        wheels.command_torque(-1e6 * sign * inverse.T @ np.ones(3))
        return wheels.torque.tolist()

    observe(wheels, [199.9, -299.98, 0.0])
    assert strongest(1.0) == pytest.approx([0.03 * 0.1 / 0.04, 0.2, 0.3], rel=1e-6)
    assert strongest(-1.0) == pytest.approx([-0.3, -0.03 * 0.02 / 0.04, -0.3], rel=1e-6)
    observe(wheels, [200.5, -301.0, 0.0])
    assert (strongest(1.0)[0], strongest(-1.0)[1]) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_excluded_wheels_give_no_torque() -> None:
    wheels = control(excluded="spin_a")
    assert wheels.rank == 2
    observe(wheels, [0.0, 0.0, 0.0])
    wheels.command_torque(np.array([0.01, 0.02, 0.03]))
    assert wheels.torque[1] == 0.0
    assert np.all(wheels.torque[[0, 2]] != 0.0)


def test_coasting_wheels_have_no_torque() -> None:
    wheels = control()
    observe(wheels, [0.0, 0.0, 0.0])
    wheels.command_torque(np.array([0.01, 0.02, 0.03]))
    wheels.thrust = np.ones(6)
    wheels.coast()
    assert not wheels.torque.any()
    assert not wheels.thrust.any()


@pytest.mark.parametrize(
    ("options", "torque", "message"),
    [
        ({"excluded": "spin_d"}, 1.0,
         "Parameter 'wheels.excluded' names 'spin_d'; the wheels of robot 'gyro' are spin_c, "
         "spin_a, spin_b."),
        ({"dump_rate": 0.75}, 0.0,
         "Parameter 'wheels.dump_rate' is 0.75, but 'use_thrusters' is false: only thrusters can "
         "dump momentum; set it to 0."),
    ],
)  # fmt: skip
def test_options_that_no_wheel_fits_are_refused(
    options: dict[str, object], torque: float, message: str
) -> None:
    with pytest.raises(ParameterError) as refusal:
        control(torque, **options)
    assert str(refusal.value) == message


# -- saturation and dumping -------------------------------------------------------------------


def test_saturation_is_announced_once_before_it_comes() -> None:
    wheels = control()
    wheels.torque = np.array([0.3, 0.0, 0.0])
    observe(wheels, [179.0, 0.0, 0.0])
    assert wheels.events() == []
    observe(wheels, [182.0, 0.0, 0.0])
    (event,) = wheels.events()
    assert (event.kind, event.level) == (EventKind.WHEEL_NEAR_LIMIT, 1)
    assert event.message == (
        "Wheel 'spin_c' rotates at 182 of at most 200 rad/s, and will saturate in 1.8 s."
    )
    assert event.about == {"wheel": "spin_c"}
    observe(wheels, [185.0, 0.0, 0.0])
    observe(wheels, [171.0, 0.0, 0.0])
    observe(wheels, [185.0, 0.0, 0.0])
    assert wheels.events() == [], "it was not much slower in between"
    observe(wheels, [198.5, 0.0, 0.0])
    observe(wheels, [199.5, 0.0, 0.0])
    (event,) = wheels.events()
    assert (event.kind, event.level) == (EventKind.WHEEL_SATURATED, 1)
    assert event.message == (
        "Wheel 'spin_c' rotates at 198.5 of at most 200 rad/s: it is saturated and provides no "
        "more torque in this direction."
    )
    observe(wheels, [169.0, 0.0, 0.0])
    wheels.torque[:] = 0.0
    observe(wheels, [0.0, -272.0, 0.0])
    (event,) = wheels.events()
    assert event.message == "Wheel 'spin_a' rotates at -272 of at most 300 rad/s."


def test_the_time_to_saturation_is_that_at_the_present_torque() -> None:
    wheels = control()
    observe(wheels, [100.0, 100.0, 201.0])
    wheels.torque = np.array([0.1, -0.1, 0.2])
    assert wheels.time_to_saturation(0) == pytest.approx(0.03 * 100 / 0.1)
    assert wheels.time_to_saturation(1) == pytest.approx(0.03 * 400 / 0.1)
    assert wheels.time_to_saturation(2) == 0.0
    wheels.torque[:] = 0.0
    assert wheels.time_to_saturation(0) == math.inf


def test_momentum_is_dumped_on_request_until_the_wheels_rest() -> None:
    wheels = control(1e9)
    observe(wheels, [10.0, -20.0, 4.1])
    assert wheels.request_dump() == "The wheel momentum is being dumped to the thrusters."
    assert wheels.request_dump() == "Momentum is already being dumped."
    (event,) = wheels.events()
    assert (event.kind, event.message, event.level, event.about) == (
        EventKind.DUMP_STARTED, "The wheel momentum is being dumped on request.", 0, {},
    )  # fmt: skip
    given = wheels.command_torque(np.array([0.5, 0.5, 0.5]))
    np.testing.assert_allclose(wheels.torque, -0.03 * np.array([10.0, -20.0, 4.1]) / 5.0)
    np.testing.assert_allclose(given, -WHEELS.axes_B @ wheels.torque)
    observe(wheels, [3.0, 6.1, 3.0])
    assert wheels.dumping
    observe(wheels, [3.9, -5.9, 3.9])
    assert not wheels.dumping
    (event,) = wheels.events()
    assert (event.kind, event.message) == (
        EventKind.DUMP_ENDED, "The wheel momentum has been dumped.",
    )  # fmt: skip
    assert wheels.request_dump() == "The wheels have no momentum."
    assert not wheels.dumping


def test_dumping_keeps_the_torques_of_motors_and_thrusters() -> None:
    strong, weak = control(1e9), control(0.02)
    for wheels in (strong, weak):
        observe(wheels, [150.0, -200.0, 50.0])
        wheels.request_dump()
        wheels.command_torque(np.zeros(3))
    shares = np.abs(strong.torque) / WHEELS.torque
    assert shares.max() == pytest.approx(1.0)
    assert np.linalg.norm(WHEELS.axes_B @ weak.torque) == pytest.approx(0.01)
    ratios = weak.torque / strong.torque
    np.testing.assert_allclose(ratios, ratios[0])


def test_momentum_is_not_dumped_without_thrusters() -> None:
    wheels = control(0.0)
    observe(wheels, [100.0, 0.0, 0.0])
    words = r"no thrusters \(use_thrusters is false\) to absorb the wheel momentum"
    with pytest.raises(CommandError, match=words):
        wheels.request_dump()
    assert not wheels.dumping


def test_momentum_is_dumped_at_a_rate_that_is_set() -> None:
    wheels = control(dump_rate=0.5, warning_rate=1.0)
    observe(wheels, [99.0, -149.0, 0.0])
    assert not wheels.dumping
    observe(wheels, [0.0, -151.0, 0.0])
    assert wheels.dumping
    (event,) = wheels.events()
    assert event.message == "The wheel momentum is being dumped because wheel 'spin_a' is fast."


# -- failures ---------------------------------------------------------------------------------


def fly(wheels: WheelControl, torque: list[float], share: float, seconds: float) -> None:
    """Command a torque of which the first wheel takes up a share; the base turns meanwhile."""
    wheels.torque = np.array(torque)
    rates = wheels.rates.copy()
    for _ in range(round(seconds / PERIOD)):
        rates = rates + PERIOD * wheels.torque / WHEELS.inertia * [share, 1.0, 1.0]
        observe(wheels, rates.tolist())


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_a_wheel_that_does_not_answer_is_taken_out_of_use(share: float) -> None:
    wheels = control()
    observe(wheels, [5.0, 0.0, 0.0])
    fly(wheels, [-0.1, 0.05, 0.2], share, 1.4)
    assert wheels.events() == []
    fly(wheels, [-0.1, 0.05, 0.2], share, 0.2)
    (event,) = wheels.events()
    assert (event.kind, event.level, event.about) == (
        EventKind.WHEEL_FAILED, 1, {"wheel": "spin_c"},
    )  # fmt: skip
    answered = {0.0: "0", 0.4: "0.06"}[share]
    assert event.message == (
        f"Wheel 'spin_c' absorbed {answered} of 0.15 N m s and is no longer used: 2 wheels and "
        "the thrusters can be used."
    )
    assert wheels.rank == 2
    wheels.command_torque(np.array([0.01, 0.02, 0.03]))
    assert wheels.torque[0] == 0.0
    wheels.reset()
    assert wheels.rank == 2, "it stays out of use"


def test_a_wheel_that_answers_well_enough_goes_on() -> None:
    wheels = control(0.0)
    observe(wheels, [5.0, 0.0, 0.0])
    fly(wheels, [-0.1, 0.05, 0.2], 0.6, 5.0)
    assert wheels.events() == []
    assert wheels.rank == 3


def test_a_wheel_that_stops_answering_is_noticed_however_long_it_has_answered() -> None:
    wheels = control()
    observe(wheels, [0.0, 0.0, 0.0])
    for _ in range(6):
        fly(wheels, [-0.1, 0.05, 0.2], 1.0, 2.5)
        fly(wheels, [0.1, -0.05, -0.2], 1.0, 2.5)
    assert wheels.events() == []
    fly(wheels, [-0.1, 0.05, 0.2], 0.0, 3.2)
    assert [(each.kind, each.about) for each in wheels.events()] == [
        (EventKind.WHEEL_FAILED, {"wheel": "spin_c"})
    ]


def test_the_turn_of_the_base_counts_as_an_answer() -> None:
    wheels = control(0.0)
    observe(wheels, [0.0, 0.0, 0.0])
    wheels.torque = np.array([0.3, 0.0, 0.0])
    for tick in range(1, 60):
        spin = tick * PERIOD * 0.3 / 0.03
        observe(wheels, [0.0, 0.0, 0.0], tuple(spin * WHEELS.axes_B[:, 0]))
    assert wheels.events() == []


def test_answers_to_commands_that_were_not_obeyed_do_not_count() -> None:
    wheels = control()
    observe(wheels, [5.0, 0.0, 0.0])
    for _ in range(100):
        wheels.reset_response_check()
        fly(wheels, [-0.3, 0.0, 0.0], 0.0, 0.04)
    assert wheels.events() == []


def test_a_failure_without_thrusters_says_so() -> None:
    wheels = control(0.0)
    observe(wheels, [5.0, 0.0, 0.0])
    fly(wheels, [0.3, 0.0, 0.0], 0.0, 0.52)
    (event,) = wheels.events()
    assert event.message.endswith("and is no longer used: 2 wheels can be used.")


# -- the gyrostat and the robot ---------------------------------------------------------------


def test_states_and_commands_are_split_and_joined() -> None:
    wheels = control()
    q, qdot = np.array([1.0, 2, 3, 4]), np.array([10.0, 20, 0.5, 40])
    pose, twist = np.zeros(3), np.array([0.0, 0.1, 0.2])
    state = ControlState(pose, np.array([0.0, 0, 0, 1]), pose, twist, q, qdot)
    measured, shape, rates = wheels.observe(state, q, qdot)
    assert measured is not None
    assert (measured.q.tolist(), measured.qdot.tolist()) == ([3.0], [0.5])
    assert (shape.tolist(), rates.tolist()) == ([3.0], [0.5])
    assert wheels.rates.tolist() == [10.0, 20.0, 40.0]
    assert wheels.shares == {"spin_c": 0.05, "spin_a": 20 / 300, "spin_b": 0.2}
    assert wheels.observe(None, q, 2 * qdot)[0] is None
    assert wheels.rates.tolist() == [20.0, 40.0, 80.0]
    wheels.torque, wheels.thrust = np.array([1.0, 2, 3]), np.arange(6.0)
    sent = wheels.actuation(Actuation(np.ones(6), np.array([7.0])))
    assert sent.tau.tolist() == [1.0, 2.0, 7.0, 3.0]
    assert sent.wrench_B.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    joints = JointReference(q, 2 * q, 3 * q)
    base = PoseReference(pose, np.array([0.0, 0, 0, 1]))
    split = wheels.reference(Reference(base, None, joints))
    assert split is not None
    assert split.joints is not None
    parts = (split.joints.q, split.joints.qdot, split.joints.qddot)
    assert [part.tolist() for part in parts] == [[3.0], [6.0], [9.0]]
    assert split.base is base
    assert wheels.reference(None) is None


def test_the_parts_of_the_momentum_add_up_to_that_of_pinocchio() -> None:
    wheels = control()
    motion = random_motion(RNG, 4)
    motion.qdot[WHEELS.index] *= 120.0
    zero = np.zeros(3)
    state = ControlState(zero, motion.quaternion_WB, zero, motion.omega_WB_B, motion.q, motion.qdot)
    wheels.observe(state, motion.q, motion.qdot)
    budget = wheels.budget(motion.q[[2]], motion.qdot[[2]])
    oracle = PinocchioOracle(ROBOT.description.urdf, ROBOT.joint_names)

    def momentum(omega: np.ndarray, qdot: np.ndarray) -> np.ndarray:
        oracle.set_motion(type(motion)(motion.q, qdot, motion.quaternion_WB, zero, zero, omega))
        return oracle.momentum_W()[1]

    omega, still = motion.omega_WB_B, np.zeros(4)
    arm = np.where(np.arange(4) == 2, motion.qdot, 0.0)
    spins = momentum(zero, motion.qdot - arm)
    turning = Rotation.from_quat(motion.quaternion_WB).apply(
        WHEELS.axes_B @ (0.03 * WHEELS.axes_B.T @ omega)
    )
    expected = {
        "base": momentum(omega, still) - turning,
        "arm": momentum(zero, arm),
        "wheels": spins + turning,
        "sum": momentum(omega, motion.qdot),
    }
    assert list(budget) == list(expected)
    for name, part in expected.items():
        assert budget[name] == pytest.approx(np.linalg.norm(part), rel=1e-9), name


def test_references_keep_within_the_torque_and_momentum_of_wheels_alone() -> None:
    motion = MotionLimits(angular_acceleration=1e3, angular_speed=1e3, speed=0.7)
    q = np.array([0.4])
    assert control(1.0).limits_with_wheels(motion, q) is motion
    assert control(0.0, excluded="spin_c").limits_with_wheels(motion, q) is motion
    wheels = control(0.0)
    within = wheels.limits_with_wheels(motion, q)
    inertia = np.linalg.eigvalsh(SpaceRobot(WHEELS.gyrostat).inertia_matrix(q)[3:6, 3:6])[-1]
    rows = np.linalg.norm(np.linalg.inv(WHEELS.axes_B), axis=1)
    torque, momentum = (WHEELS.torque / rows).min(), (0.03 * WHEELS.rate / rows).min()
    assert within.angular_acceleration == pytest.approx(torque / inertia / 2)
    assert within.angular_speed == pytest.approx(momentum / inertia / 2)
    assert within.speed == 0.7


# -- the controller ---------------------------------------------------------------------------


def config(**changes: object) -> ControllerConfig:
    settings = {"law": "model_based", "tick_rate": 50.0, "profile": "quintic"}
    return configured(ControllerConfig, {**settings, **changes})


@pytest.mark.parametrize(
    ("robot", "changes", "message"),
    [
        (ROBOT, {"base_outputs": "x rx"},
         "The base position of robot 'gyro' cannot be controlled without thrusters "
         "(use_thrusters is false): remove x, y and z from base_outputs."),
        (ROBOT, {"wheels.excluded": "spin_a"},
         "Robot 'gyro' has no thrusters (use_thrusters is false), and its reaction wheels can "
         "rotate it about only 2 of 3 controlled axes: remove rx, ry or rz from base_outputs."),
        (PLANAR, {}, "reaction wheels can rotate it about only 0 of 1"),
    ],
)  # fmt: skip
def test_outputs_that_wheels_do_not_move_are_refused(
    robot: SpaceRobot, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ParameterError, match=re.escape(message)):
        build_controller(robot, config(use_thrusters=False, **changes))


@pytest.mark.parametrize("law", ["model_based", "transposed_jacobian"])
def test_without_thrusters_there_is_no_force(law: str) -> None:
    controller = build_controller(ROBOT, config(use_thrusters=False, law=law))
    assert controller.law.outputs.labels == ("base.rx", "base.ry", "base.rz", "joint.elbow")
    motion = random_motion(RNG, 1)
    state = ControlState(
        np.zeros(3), motion.quaternion_WB, motion.v_cm_B, 0.1 * motion.omega_WB_B, motion.q,
        motion.qdot,
    )  # fmt: skip
    wanted = controller.law.command(state, Reference.present(controller.law.robot, state))
    assert wanted.wrench_B[:3].tolist() == [0.0, 0.0, 0.0]
    assert np.all(wanted.wrench_B[3:] != 0.0)


class Loop(Reporting):
    """An executive whose reports are kept."""

    def __init__(self, robot: SpaceRobot = ROBOT, **changes: object) -> None:
        settings = config(**changes)
        self.executive = ControlExecutive(build_controller(robot, settings), settings)

    def tick(
        self, time: float, qdot: list[float], omega: tuple[float, ...] = (0, 0, 0)
    ) -> Actuation:
        zero, q = np.zeros(3), np.array([9.0, 8.0, 0.3, 7.0])
        twist = np.array(omega, dtype=float)
        state = ControlState(zero, np.array([0.0, 0, 0, 1]), zero, twist, q, np.array(qdot))
        result = self.executive.command(time, state, q, np.array(qdot))
        self.executive.evaluate(time, result)
        assert result.excess.tau.shape == (4,)
        return result.realised


def test_wheels_brake_the_base_and_thrusters_do_the_rest() -> None:
    loop = Loop(ROBOT, **{"max_torque": 0.5, "gains.base_attitude.kd": 1.0})
    loop.tick(0.0, [0.0] * 4)
    small = loop.tick(0.02, [0.0] * 4, (0.01, 0.0, 0.005))
    assert not small.wrench_B[3:].any()
    assert small.tau[[0, 1, 3]].all()
    large = loop.tick(0.04, [0.0] * 4, (0.2, -0.1, 0.3))
    assert np.linalg.norm(large.wrench_B[3:]) == pytest.approx(0.5)
    assert loop.statuses[-1].command is not None
    assert loop.statuses[-1].command.lost_torque_Nm > 0.0


def test_events_and_the_budget_are_reported() -> None:
    loop = Loop()
    loop.tick(0.0, [0.0] * 4)
    loop.tick(0.02, [190.0, 0.0, 0.0, 0.0])
    assert [event.kind for event in loop.events] == [EventKind.WHEEL_NEAR_LIMIT]
    report = loop.statuses[-1].command
    assert report is not None
    assert report.wheels == {"spin_c": 0.95, "spin_a": 0.0, "spin_b": 0.0}
    assert report.momentum["wheels"] == pytest.approx(0.03 * 190.0)
    assert not report.dumping


def test_momentum_is_dumped_by_the_executive() -> None:
    loop = Loop()
    loop.tick(0.0, [50.0, 0.0, 0.0, 0.0])
    assert "is being dumped" in loop.executive.dump_momentum()
    sent = loop.tick(0.02, [50.0, 0.0, 0.0, 0.0])
    assert sent.tau[0] == pytest.approx(-0.3)
    np.testing.assert_allclose(sent.wrench_B[3:], WHEELS.axes_B[:, 0] * sent.tau[0], atol=1e-9)
    assert loop.statuses[-1].to_values()["dumping"] == "true"


def test_a_robot_without_wheels_dumps_nothing() -> None:
    with pytest.raises(CommandError, match="'planar_manipulator' has no reaction wheels"):
        Loop(PLANAR).executive.dump_momentum()


def test_goal_shapes_are_those_of_the_whole_robot() -> None:
    loop = Loop()
    for count, refused in ((1, True), (4, False)):
        goal = Goal.checked([0, 0, 0], [0, 0, 0, 1], [0.1 * (i + 1) for i in range(count)])
        if refused:
            with pytest.raises(PlanningError, match="1 joint positions; robot 'gyro' has 4"):
                loop.executive.submit("base", IdentifiedGoal(goal, "g"))
        else:
            loop.executive.submit("base", IdentifiedGoal(goal, "g"))
    loop.tick(0.0, [0.0] * 4)
    reached = loop.executive.controller.goal.joints
    assert reached is not None
    np.testing.assert_allclose(reached.q, [0.3])
    (pursued,) = (each for each in loop.executive.outputs if isinstance(each, PursuedGoals))
    saved = pursued.goals["base"].goal.joint_positions
    assert saved is not None
    np.testing.assert_allclose(saved, [0.0, 0.0, 0.3, 0.0])
