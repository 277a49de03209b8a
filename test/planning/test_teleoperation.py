"""Joints that follow others' words: twists of end-effectors, and trajectories of a controller."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.oracles.integrated import IDENTITY
from support.planner_loop import NEAR, TICK, Array, Loop, PlantState, robot_of
from support.planner_phases import executing, stub_of

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.execution.status import Notice, Phase, PlannerState
from spacerobot_ros.planning.execution.teleoperation import TwistCommand, TwistFollower, TwistFrame
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.planning.methods.resolved_rate import ResolvedRateOptions
from spacerobot_ros.simulation import InitialState, VelocityPlant

HAND = "end_effector"
START = InitialState(
    np.array([0.4, -0.3, 0.2]),
    Rotation.from_rotvec([0.3, -0.5, 0.4]).as_quat(),
    np.array([0.4, -0.9, 1.1]),
)
LINEAR, ANGULAR = np.array([0.02, -0.03, 0.025]), np.array([0.01, 0.02, -0.015])


def loop_of(robot: str = "three_joint_arm", initial: InitialState = START, **given: Any) -> Loop:
    most = [0.6, 0.8, 1.0, *4 * [1.0]][: robot_of(robot).n]
    parameters = {"resolved_rate.max_acceleration": most, **given}
    loop = Loop({"method": "resolved_rate", **parameters}, robot=robot, initial=initial)
    loop.tick(2)
    return loop


def send(loop: Loop, frame: TwistFrame = "world", link: str = HAND, **twist: Any) -> None:
    linear, angular = twist.get("linear", LINEAR), twist.get("angular", ANGULAR)
    loop.executive.propose_twist(TwistCommand(link, np.array(linear), np.array(angular), frame))


def twist_at(
    loop: Loop, q: Array, rates: Array, pose: Array = IDENTITY, link: str = HAND
) -> tuple[Array, Rotation]:
    """Return the twist (6,) of a link in W by Pinocchio, and R_WE, at joint rates and a pose."""
    robot = loop.plant.robot
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    u = oracle.joint_velocities(rates)
    u[:6] = -oracle.connection(q) @ rates
    oracle.set_configuration(q, pose[3:], pose[:3])
    return oracle.frame_jacobian_W(link) @ u, Rotation.from_matrix(oracle.frame_W(link)[0])


def twist_of(loop: Loop, tick: int, link: str = HAND) -> tuple[Array, Rotation]:
    """Return the same in the middle of a tick."""
    q, pose = ((at[tick] + at[tick + 1]) / 2 for at in (loop.shapes, loop.poses))
    return twist_at(loop, q, loop.commands[tick], pose, link)


def fly(loop: Loop, ticks: int, **options: Any) -> None:
    for _ in range(ticks):
        send(loop, **options)
        loop.tick()


@pytest.mark.parametrize("frame", get_args(TwistFrame))
def test_the_origin_of_the_link_has_the_velocity_of_the_twist_in_its_frame(
    frame: TwistFrame,
) -> None:
    loop = loop_of()
    fly(loop, 30, frame=frame)
    assert loop.executive.phase is Phase.TELEOPERATING
    for tick in (20, 31):
        twist, R_WE = twist_of(loop, tick)
        R = {
            "world": Rotation.identity(),
            "base": Rotation.from_quat(loop.poses[tick][3:] + loop.poses[tick + 1][3:]),
            "link": R_WE,
        }[frame]
        # Three joints: the rotation does not follow.
        np.testing.assert_allclose(twist[:3], R.apply(LINEAR), atol=1e-6)
    assert np.linalg.norm(loop.poses[-1][:3] - START.position) > 1e-3
    assert loop.states[-1] == "teleoperating"
    assert loop.statuses[-1].message == "'end_effector' follows twists."
    assert loop.states.count("teleoperating") == 1


def test_twists_are_followed_with_the_masses_that_a_capture_has_changed() -> None:
    loop, old = loop_of(), robot_of("three_joint_arm").description.urdf
    urdf = old.replace('<mass value="15"/>', '<mass value="90"/>')
    assert urdf != old
    heavy = SpaceRobot.from_urdf(urdf)
    loop.executive.use_robot(heavy, PlanningWorker(heavy, loop.config))
    loop.plant = VelocityPlant(heavy, TICK, START)
    stamp_ns, loop.measured = loop.measured.stamp_ns, PlantState(loop.plant)
    loop.measured.stamp_ns = stamp_ns
    fly(loop, 30)
    twist, _ = twist_of(loop, 31)
    np.testing.assert_allclose(twist[:3], LINEAR, atol=1e-6)


def test_seven_joints_follow_the_rotation_as_well() -> None:
    q = np.array([0.2, -0.3, 0.1, -1.8, 0.3, 1.6, 0.4])
    loop = loop_of("seven_joint_arm", InitialState(START.position, START.quaternion, q))
    fly(loop, 30, link="link_7")
    twist, _ = twist_of(loop, 31, "link_7")
    np.testing.assert_allclose(twist, [*LINEAR, *ANGULAR], atol=1e-6)
    # The least rates of all, each measured by its limit.
    robot = robot_of("seven_joint_arm")
    J = robot.generalised_jacobian("link_7", (loop.shapes[31] + loop.shapes[32]) / 2)
    R = Rotation.from_quat(loop.poses[31][3:] + loop.poses[32][3:]).as_matrix()
    J = np.vstack([R @ J[:3], R @ J[3:]]) * robot.velocity_limit
    least = robot.velocity_limit * (np.linalg.pinv(J) @ twist)
    np.testing.assert_allclose(loop.commands[31], least, atol=1e-6)


def test_with_keep_attitude_the_base_turns_by_nothing() -> None:
    q = np.array([-0.2, 1.04, -1.08, -1.9, -0.38, 0.38, -1.64])
    initial = InitialState(START.position, START.quaternion, q)
    loop = loop_of("seven_joint_arm", initial, **{"resolved_rate.keep_attitude": 1})
    fly(loop, 40, link="link_7")
    twist, _ = twist_of(loop, 41, "link_7")
    np.testing.assert_allclose(twist[:3], LINEAR, atol=1e-6)
    turned = Rotation.from_quat(loop.poses[-1][3:]) * Rotation.from_quat(START.quaternion).inv()
    assert turned.magnitude() < 5e-5
    free = loop_of("seven_joint_arm", initial)
    fly(free, 40, link="link_7")
    turned = Rotation.from_quat(free.poses[-1][3:]) * Rotation.from_quat(START.quaternion).inv()
    assert turned.magnitude() > 1e-4


def test_rates_change_within_the_limits_and_the_joints_brake_when_twists_stop() -> None:
    loop = loop_of(twist_timeout=0.32)
    fly(loop, 25, linear=10 * LINEAR)
    commands = np.array(loop.commands)
    most = np.array([0.6, 0.8, 1.0])
    assert np.abs(np.diff(commands, axis=0) / TICK / most).max() <= 1 + 1e-9
    assert np.abs(commands).max() <= 0.5 + 1e-12
    before = len(loop.commands)
    loop.tick(60)
    # The last twist came with tick 26, and is old with the seventh state after it.
    assert np.ptp(np.array(loop.commands[before : before + 6]), axis=0).max() < 0.2
    assert np.linalg.norm(loop.commands[before + 5]) > 0.05
    speeds = np.abs(np.array(loop.commands[before + 6 :])).max(axis=1)
    assert np.all(np.diff(speeds) <= 1e-12)
    assert speeds[-1] == 0.0
    assert loop.executive.phase is Phase.IDLE
    assert loop.statuses[-1].message == "No more twists arrive: the joints are at rest."
    assert loop.states[-1] == "idle"
    commands = np.array(loop.commands)
    assert np.abs(np.diff(commands, axis=0) / TICK / most).max() <= 1 + 1e-9
    # They may come again.
    fly(loop, 3)
    assert loop.states[-1] == "teleoperating"


def test_the_hand_stops_before_the_singularity_of_paper_4_and_comes_back() -> None:
    # Stretched, the arm has no rate that moves the hand on outwards.
    loop = loop_of("planar_manipulator", InitialState(joint_positions=np.array([0.9, 0.7])))
    outward = np.array([0.08, 0.02, 0.0])

    def determinant(shape: Array) -> float:
        J = loop.plant.robot.generalised_jacobian(HAND, shape)[:2]
        return abs(float(np.linalg.det(J)))

    fly(loop, 400, linear=outward, angular=np.zeros(3))
    assert np.abs(loop.commands[-1]).max() < 2e-3
    said = loop.statuses[-1].message
    assert "'end_effector' is near a dynamic singularity: it moves by " in said
    assert said.endswith("The twist is followed as far as possible.")
    assert determinant(loop.shapes[-1]) < 0.1 * determinant(loop.shapes[0])
    moves = np.array(loop.commands)
    assert np.abs(np.diff(moves, axis=0)).max() <= 0.8 * TICK + 1e-12
    fly(loop, 60, linear=-outward, angular=np.zeros(3))
    assert loop.statuses[-1].message == "'end_effector' follows twists."
    assert determinant(loop.shapes[-1]) > 0.1


def test_a_limit_is_over_when_it_has_not_come_for_the_timeout_of_twists(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop = loop_of(twist_timeout=0.3)
    fly(loop, 5)
    rates, limits = TwistFollower.rates, iter([*"ll....l", *40 * "."])

    def limited(*given: Any) -> tuple[Array, str]:
        return rates(*given)[0], "Joint 'wrist' is slow." if next(limits) == "l" else ""

    monkeypatch.setattr(TwistFollower, "rates", limited)
    begun = len(loop.statuses)
    told = []
    for _ in range(20):
        fly(loop, 1)
        told.append(loop.statuses[-1].message.startswith("Joint 'wrist' is slow."))
    # With the last of the limits, 6 ticks of 0.05 s after it, and never in between.
    assert told == 13 * [True] + 7 * [False]
    assert len(loop.statuses) == begun + 2


def test_joints_stop_at_their_limits() -> None:
    initial = InitialState(joint_positions=np.array([0.3, 2.5]))
    loop = loop_of("planar_manipulator", initial, clearance=0.0)
    for _ in range(60):
        towards, _ = twist_at(loop, loop.shapes[-1], np.array([0.0, 0.3]))
        fly(loop, 1, frame="base", linear=towards[:3], angular=np.zeros(3))
    shapes = np.array(loop.shapes)
    assert shapes[:, 1].max() <= 2.8 + 1e-9
    assert shapes[:, 1].max() > 2.75
    told = [s.message for s in loop.statuses if "reaches its limit" in s.message]
    assert [each.split(". ")[0] for each in told] == ["Joint 'elbow' reaches its limit of 2.8"]
    most = np.array([0.6, 0.8]) * TICK
    assert np.all(np.abs(np.diff(np.array(loop.commands), axis=0)) <= most + 1e-9)


@pytest.mark.slow
def test_links_do_not_come_too_near() -> None:
    robot = robot_of("three_joint_arm")
    clearance = Clearance(robot.description, 0.05)
    base = TwistCommand(HAND, np.array([-0.3, 0.0, -0.1]), np.zeros(3), "base")

    def nearest(kept: Clearance | None) -> float:
        follower = TwistFollower(robot, HAND, ResolvedRateOptions(), TICK, kept)
        q, rates, least = np.array([0.0, -0.9, 2.2]), np.zeros(3), np.inf
        for _ in range(150):
            rates, _ = follower.rates(base, IDENTITY, q, rates)
            q = q + TICK * rates
            least = min(least, clearance.geometry.nearest_along(q[np.newaxis])[0][0])
        return float(least)

    assert nearest(clearance) >= 0.05 - 2e-6
    assert nearest(None) < 0.04


@pytest.mark.parametrize(
    ("link", "linear", "frame", "message"),
    [
        ("nobody", LINEAR, "world", "Robot 'three_joint_arm' has no end-effector 'nobody'."),
        ("base_link", LINEAR, "world", "Robot 'three_joint_arm' has no end-effector 'base_link'."),
        (HAND, LINEAR, "odom", "The frame 'odom' of the twist is not one of"),
        (
            HAND,
            LINEAR,
            "",
            "The frame '' of the twist is not one of 'inertial', 'base_link', 'end_eff",
        ),
        (HAND, [0.0, np.nan, 0.0], "inertial", "The twist has a non-finite value."),
        (HAND, [0.0, 1e155, 0.0], "inertial", "The twist has a value beyond 1e+06 m/s"),
    ],
)
def test_twists_that_are_none_are_refused(link: str, linear: Any, frame: str, message: str) -> None:
    robot = robot_of("three_joint_arm")
    world = "inertial" if frame in ("", "inertial") else "world"
    with pytest.raises(PlanningError) as refusal:
        TwistCommand.checked(robot, link, np.array(linear), np.zeros(3), frame, world)
    assert str(refusal.value).startswith(message)


def test_frames_may_have_a_prefix() -> None:
    robot = robot_of("three_joint_arm")
    for name, frame in (
        ("robot_1/base_link", "base"),
        ("end_effector", "link"),
        ("world", "world"),
    ):
        found = TwistCommand.checked(robot, HAND, LINEAR, ANGULAR, name, "world")
        assert (found.frame, found.link) == (frame, HAND)


def refusal(loop: Loop, **options: Any) -> str:
    with pytest.raises(PlanningError) as found:
        send(loop, **options)
    return str(found.value)


def test_a_goal_comes_first_and_twists_have_to_pause_before_they_count_again() -> None:
    loop = Loop({"twist_timeout": 0.4}, initial=InitialState(joint_positions=np.zeros(3)))
    loop.tick()
    options: dict[str, Any] = {"link": "mass_1", "linear": [0.02, 0.0, 0.0]}
    fly(loop, 5, **options)
    loop.propose_goal(NEAR)
    pursued = "Twists are not followed while a goal is pursued: abort the goal first."
    assert refusal(loop, **options) == pursued
    for _ in range(400):
        loop.tick()
        if loop.states[-1] == "reached":
            break
        assert refusal(loop, **options) == pursued
    ignored = "Twists are ignored until no twist has arrived for 0.4 s."
    assert refusal(loop, **options) == ignored
    loop.tick(7)
    assert refusal(loop, **options) == ignored
    loop.tick(9)
    send(loop, **options)
    assert loop.executive.phase is Phase.TELEOPERATING


def test_an_abort_brakes_and_another_link_waits() -> None:
    loop = loop_of()
    fly(loop, 10)
    assert refusal(loop, link="link_2") == (
        "'end_effector' follows twists: 'link_2' waits until they stop."
    )
    loop.tick(20)
    fly(loop, 10)
    assert loop.abort() == "The joints brake."
    assert loop.statuses[-1].message == "Aborted on request. The joints brake."
    refusal(loop)
    loop.tick(30)
    assert loop.executive.phase is Phase.IDLE
    assert loop.abort() is None


def test_without_a_measured_base_the_joints_brake() -> None:
    loop = loop_of(twist_timeout=0.3)
    fly(loop, 10)
    for _ in range(20):
        send(loop)
        loop.tick(base=False)
    assert loop.commands[-1].tolist() == [0.0, 0.0, 0.0]
    assert loop.statuses[-1].message == (
        "The base motion is not measured. The twist is followed as far as possible."
    )
    loop.late()
    fly(loop, 3)
    assert np.abs(loop.commands[-1]).max() > 0
    loop.measured.broken = True
    loop.tick()
    assert loop.statuses[-1].message == "The joint motion is not measured."
    assert loop.executive.phase is Phase.IDLE


def test_joints_that_are_too_few_are_told() -> None:
    robot = robot_of("planar_manipulator")
    with pytest.raises(PlanningError) as found:
        TwistFollower(robot, HAND, ResolvedRateOptions(keep_attitude=1), TICK)
    assert str(found.value) == (
        "Robot 'planar_manipulator' has too few joints to move 'end_effector' by twists and keep "
        "the base attitude."
    )
    assert not TwistFollower(robot, HAND, ResolvedRateOptions(), TICK).turns
    seven = robot_of("seven_joint_arm")
    assert TwistFollower(seven, "link_7", ResolvedRateOptions(), TICK).turns


# -- an executive whose schedules the robot's own controller follows ----------------------------


def flown(ticks: int = 8, **options: float) -> Loop:
    """Return a loop in the schedule of 0.05 s a tick to a goal at 62 mm."""
    return executing(output="trajectory", ticks=ticks, **options)


def test_a_schedule_ends_when_its_controller_says_so() -> None:
    loop = flown()
    loop.tick(40)
    assert loop.executive.phase is Phase.EXECUTING
    loop.executive.schedule_ended()
    status = loop.until(PlannerState.REACHED)
    assert status.corrections == 0
    # The mark of the first schedule does not end the next one.
    loop.propose_goal(([-0.1, 0.2, 0.05], [0.0, 0.0, 0.0]))
    loop.tick(12)
    assert loop.executive.phase is Phase.EXECUTING


def test_a_violated_tolerance_is_corrected_from_the_measured_state() -> None:
    loop = flown(ticks=16)
    loop.tick(5)
    q = loop.plant.q.copy()
    loop.executive.schedule_ended("the trajectory ended early with PATH_TOLERANCE_VIOLATED")
    loop.tick(2)
    told = [each for each in loop.outputs if isinstance(each, Notice)]
    assert Notice("warning", "The trajectory ended early with PATH_TOLERANCE_VIOLATED.") in told
    _, second = stub_of(loop).requests
    assert second.correction
    assert second.state.q == pytest.approx(q, abs=1e-9)
    assert np.abs(q).max() > 0.01
    loop.tick(16)
    loop.executive.schedule_ended()
    assert loop.until(PlannerState.REACHED).corrections == 1


def test_a_trajectory_that_no_server_flies_fails_the_goal() -> None:
    loop = flown()
    loop.tick(2)
    loop.executive.schedule_ended("the action '/arm' has no server", final=True)
    status = loop.until(PlannerState.FAILED)
    begin = "The goal is not reached: the action '/arm' has no server. Remaining: "
    assert status.message.startswith(begin)
    assert status.message.endswith(").")
    assert status.corrections == 0
    assert len(stub_of(loop).requests) == 1
    loop.executive.schedule_ended("too late", final=True)  # There is no goal any more.
    loop.tick()
    assert loop.executive.phase is Phase.IDLE


def test_a_controller_that_never_answers_ends_nothing_for_five_seconds() -> None:
    loop = flown()
    loop.tick(8 + round(5.0 / TICK) - 1)
    assert loop.executive.phase is Phase.EXECUTING
    assert loop.until(PlannerState.REACHED).corrections == 0


def test_a_joint_that_lags_is_left_to_the_controller() -> None:
    loop = flown(ticks=60, stuck_ticks=3)
    loop.plant.hold(np.array([True, False, True]))
    loop.tick(55)
    assert loop.executive.phase is Phase.EXECUTING


def test_an_abort_leaves_the_braking_to_the_controller() -> None:
    loop = flown(ticks=60, abort_time=2.5)
    loop.tick(5)
    assert loop.abort() == "The joint controller has 2.5 s to bring them to rest."
    assert loop.executive.phase is Phase.BRAKING
