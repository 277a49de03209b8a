"""Errors that stay: integral gains, automatic gains, and stalls with their cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from control.flights import END_EFFECTOR, INVERTIBLE, PLANAR_GAINS, law_of, load, planar_start, pose
from scipy.spatial.transform import Rotation
from support.executive_loop import AIM, PERIOD, TIP, ExecutiveLoop, goal_at
from support.executive_loop import KP as STEP_KP
from support.oracles import PinocchioOracle
from support.sentences import assert_one_sentence

from spacerobot_ros.control import LAWS, ControlLaw, ControlState, GainPair, Gains, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.flight.api import fly
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.simulation import EffortPlant, InitialState
from spacerobot_ros.simulation.loads import PlantLoads

Array = npt.NDArray[np.float64]

STIFFNESS = PLANAR_GAINS.base_position.kp


def offset_by_formula(name: str, state: ControlState, link: str, wrench: Array) -> Array:
    """Return the errors of the planar manipulator at rest, with Jacobians and masses of Pinocchio:
    eq. (29) by Kp alone, eq. (27) by mobility.
    """
    robot = load("planar_manipulator")
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    oracle.set_configuration(state.q, state.quaternion_WB, state.r_WB)
    base, hand = (oracle.frame_jacobian_W(each) for each in (robot.base_link, END_EFFECTOR))
    J_z, Q_d = np.vstack([base[[0, 1, 5]], hand[:2]]), oracle.frame_jacobian_W(link).T @ wrench
    if name == "model_based":
        return np.asarray(-J_z @ np.linalg.solve(oracle.own_mass_matrix(), Q_d) / STIFFNESS)
    return np.asarray(-np.linalg.lstsq(J_z.T, Q_d, rcond=None)[0] / STIFFNESS)


def displaced(law: ControlLaw, state: ControlState, errors: Array) -> Reference:
    """Return the planar reference from which a state has these errors."""
    present = Reference.present(law.robot, state, END_EFFECTOR)
    assert present.base is not None
    assert present.end_effector is not None
    turn = Rotation.from_rotvec([0.0, 0.0, errors[2]]) * Rotation.from_quat(state.quaternion_WB)
    base = present.base.position + np.append(errors[:2], 0.0)
    return Reference(
        replace(pose(base), quaternion=turn.as_quat()),
        pose(present.end_effector.position + np.append(errors[3:], 0.0)),
    )


@pytest.mark.parametrize("name", INVERTIBLE)
@pytest.mark.parametrize("ki", [0.0, 2.0])
def test_the_robot_rests_where_the_formulas_say(name: str, ki: float) -> None:
    """The plant stays at rest under the command for these errors, or for their integral."""
    robot, state = load("planar_manipulator"), planar_start()
    wrench = np.array([0.7, -0.4, 0.0, 0.0, 0.0, 0.3])
    law = law_of(name, robot, PLANAR_GAINS)
    errors = offset_by_formula(name, state, "link_1", wrench)
    assert np.abs(errors).max() > 1e-4
    if ki:
        law.set_gains(Gains.uniform(STIFFNESS, 60.0, ki))
        law.command(state, displaced(law, state, errors))
        law.integrate_error(STIFFNESS / ki)
        errors = np.zeros(5)
    actuation = law.command(state, displaced(law, state, errors))
    start = InitialState(state.r_WB, state.quaternion_WB, state.q)
    plant, loads = EffortPlant(robot, 0.01, start), PlantLoads(robot)
    loads.in_world[robot.link_names.index("link_1")] = wrench
    plant.load(loads)
    plant.step(actuation.tau, actuation.wrench_B)
    np.testing.assert_allclose(plant.twist, 0.0, atol=1e-13)
    np.testing.assert_allclose(plant.qdot, 0.0, atol=1e-13)


# -- the integral term ------------------------------------------------------------------------

MIXED = Gains(GainPair(30.0, 60.0, 2.0), GainPair(30.0, 60.0), GainPair(30.0, 60.0, 0.5))


def law_with_error(errors: Array, gains: Gains = MIXED) -> ControlLaw:
    law = law_of("transposed_jacobian", load("planar_manipulator"), gains)
    law.command(planar_start(), displaced(law, planar_start(), errors))
    return law


ERRORS = np.array([0.1, -0.2, 0.3, 0.4, -0.5])


def integral_of(law: ControlLaw) -> Array:
    """Return the integral term by its effect: commands differ by it times the law's stiffness."""
    state = planar_start()

    def command(errors: Array) -> Array:
        given = law.command(state, displaced(law, state, errors))
        return np.append(given.wrench_B, given.tau)

    without_errors = command(np.zeros(5))
    stiffness = np.array([command(unit) - without_errors for unit in np.eye(5)]).T / STIFFNESS
    return np.asarray(np.linalg.lstsq(stiffness, without_errors, rcond=None)[0])


def test_errors_with_a_gain_are_integrated() -> None:
    law = law_with_error(ERRORS)
    assert law.integrates
    law.integrate_error(0.25)
    law.integrate_error(0.5)
    expected = 0.75 * ERRORS * [2.0, 2.0, 0.0, 0.5, 0.5]
    np.testing.assert_allclose(integral_of(law), expected, atol=1e-12)


def test_gains_of_the_integral_change_in_flight() -> None:
    law = law_with_error(ERRORS)
    law.integrate_error(1.0)
    law.set_gains(Gains(GainPair(30.0, 60.0, 4.0), GainPair(30.0, 60.0, 1.0), GainPair(30.0, 60.0)))
    expected = ERRORS * [4.0, 4.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(integral_of(law), expected, atol=1e-12)
    law.set_gains(MIXED)
    np.testing.assert_allclose(integral_of(law)[3:], 0.0, atol=1e-12)
    law.reset_integral()
    np.testing.assert_allclose(integral_of(law), 0.0, atol=1e-12)


def test_without_integral_gains_nothing_is_integrated() -> None:
    law = law_with_error(ERRORS, PLANAR_GAINS)
    law.integrate_error(1.0)
    assert not law.integrates
    np.testing.assert_allclose(integral_of(law), 0.0, atol=1e-12)


def test_a_limited_command_lets_integrals_shrink_only() -> None:
    law = law_with_error(ERRORS)
    law.integrate_error(1.0, limited=True)
    np.testing.assert_allclose(integral_of(law), 0.0, atol=1e-12)
    law = law_with_error(ERRORS)
    law.integrate_error(1.0)
    law.command(planar_start(), displaced(law, planar_start(), ERRORS * [-1, 1, 1, -1, 1]))
    law.integrate_error(0.5, limited=True)
    expected = ERRORS * [1.0, 2.0, 0.0, 0.25, 0.5]
    np.testing.assert_allclose(integral_of(law), expected, atol=1e-12)


def test_a_new_goal_and_a_reset_begin_the_integral_anew() -> None:
    gains = Gains.uniform(30.0, 60.0, 1.0)
    config = ControllerConfig(profile="step", gains=gains, tick_rate=100.0, max_force=1e3)
    controller, state = build_controller(load("planar_manipulator"), config), planar_start()
    far = replace(pose(state.r_WB + np.array([0.02, 0.0, 0.0])), quaternion=state.quaternion_WB)

    def term() -> float:
        return float(np.abs(integral_of(controller.law)).max())

    controller.set_goals(0.0, state, base=far)
    for tick in (0, 1, 2, 5):
        controller.command(tick / 100, state, state.q, state.qdot)
    # The last command follows a gap of three control periods, and is expected to be held so.
    assert term() == pytest.approx(0.02 * (0.01 * 3 + 0.03))
    controller.set_goals(0.05, state, base=far)
    assert term() == pytest.approx(0.0, abs=1e-12)
    controller.command(0.06, state, state.q, state.qdot)
    assert term() == pytest.approx(0.0002)
    controller.come_to_rest()
    controller.command(0.07, state, state.q, state.qdot)
    assert term() == pytest.approx(0.0002)
    controller.reset()
    assert term() == pytest.approx(0.0, abs=1e-12)


def test_saturated_thrusters_do_not_wind_the_integral_up() -> None:
    gains = Gains.uniform(30.0, 60.0, 1.0)
    config = ControllerConfig(profile="step", gains=gains, tick_rate=100.0, max_force=0.1)
    controller, state = build_controller(load("planar_manipulator"), config), planar_start()
    far = replace(pose(state.r_WB + np.array([0.5, 0.0, 0.0])), quaternion=state.quaternion_WB)
    controller.set_goals(0.0, state, base=far)
    assert controller.command(0.0, state, state.q, state.qdot).limited
    np.testing.assert_allclose(integral_of(controller.law), 0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("law", INVERTIBLE)
@pytest.mark.parametrize("ki", [0.0, 10.0])
def test_the_papers_robot_flies_into_its_steady_state(law: str, ki: float) -> None:
    """A goal that counts as reached by no error: the errors after a minute."""
    groups = ("base_position", "base_attitude", "end_effector_position")
    flight = fly(
        "coordinated_control",
        method=law,
        parameters={
            "plant.disturbances": ["base_link force 1 0 0 at 1"],
            "coordinated_control.position_tolerance": 1e-14,
            "coordinated_control.time_limit": 90.0,
            **{f"coordinated_control.gains.{group}.ki": ki for group in groups},
        },
    )
    pose_WB, q = (flight.series[name].values[-1] for name in ("pose", "q"))
    last = ControlState.at_rest(pose_WB[:3], pose_WB[3:], q)
    goal = Reference(pose([0.5, 0.5, 0.0], [0.0, 0.0, np.radians(15.0)]), pose([1.5, 1.5, 0.0]))
    controller = law_of(law, load("planar_manipulator"), Gains.uniform(30.0, 60.0, ki))
    controller.command(last, goal)
    predicted = offset_by_formula(law, last, "base_link", np.eye(6)[0]) * (ki == 0.0)
    np.testing.assert_allclose(controller.error, predicted, atol=1e-6)
    if not ki:
        expected = 0.0333333 if law == "transposed_jacobian" else 0.000773
        assert np.linalg.norm(controller.error[:2]) == pytest.approx(expected, rel=0.05)


# -- gains that nobody sets: they follow the masses, the shape and the control period ------------


FASTEST = 1.0
"""Natural frequency of errors under automatic gains, if the control period permits, rad/s."""


def accelerations(law: ControlLaw, state: ControlState, reference: Reference) -> Array:
    """Return the accelerations of the outputs under a command from rest, by the plant."""
    actuation, step = law.command(state, reference), 1e-4
    plant = EffortPlant(law.robot, step, InitialState(state.r_WB, state.quaternion_WB, state.q))
    plant.step(actuation.tau, actuation.wrench_B)
    moved = ControlState(
        plant.pose[:3], plant.pose[3:], plant.twist[:3], plant.twist[3:], plant.q, plant.qdot
    )
    law.command(moved, reference)
    return np.asarray(-law.error_rate / step)


@pytest.mark.parametrize("name", [*LAWS])
def test_from_rest_errors_are_accelerated_towards_zero_by_their_stiffness(name: str) -> None:
    robot, state = load("planar_manipulator"), planar_start()
    law = law_of(name, robot, Gains())
    present = Reference.present(robot, state, "end_effector")
    assert present.base is not None
    assert present.end_effector is not None
    assert present.joints is not None
    reference = Reference(
        replace(present.base, position=present.base.position + np.array([0.03, -0.02, 0.0])),
        replace(
            present.end_effector,
            position=present.end_effector.position + np.array([0.0, 0.05, 0.0]),
        ),
        replace(present.joints, q=present.joints.q + np.array([0.04, -0.03])),
    )
    found = accelerations(law, state, reference)
    law.command(state, reference)
    wanted = FASTEST**2 * law.error
    # The mass matrix of a law that commands forces is damped a little.
    np.testing.assert_allclose(found, wanted, atol=0.1 * np.abs(wanted).max())


@pytest.mark.parametrize("name", [*LAWS])
@pytest.mark.parametrize(("rate", "damping"), [(1.0, 0.4), (5.0, 2.0), (200.0, 2.0)])
def test_slow_controllers_have_low_gains(name: str, rate: float, damping: float) -> None:
    config = configured(ControllerConfig, {"law": name, "tick_rate": rate})
    law = build_controller(load("planar_manipulator"), config).law
    kp, kd = law.gain_diagonals
    np.testing.assert_allclose(kd, damping)
    np.testing.assert_allclose(kp, damping**2 / 4, err_msg="critical damping")


def test_at_a_singularity_commands_stay_bounded() -> None:
    robot = load("planar_manipulator")
    law = law_of("transposed_jacobian", robot, Gains())
    state = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(2))
    present = Reference.present(robot, state, "end_effector")
    assert present.end_effector is not None
    out = replace(
        present.end_effector, position=present.end_effector.position + np.array([1.0, 0.0, 0.0])
    )
    command = law.command(state, Reference(present.base, out))
    assert law.status.singular
    # No actuator moves it there. A force that gives the whole robot this acceleration is 47 N.
    assert np.linalg.norm(command.wrench_B) + np.linalg.norm(command.tau) < 47.0


def automatic_gains(*groups: str) -> dict[str, Any]:
    pairs = [group for group in groups if not group.endswith("_matrix")]
    return {f"gains.{group}.{name}": 0.0 for group in pairs for name in ("kp", "kd")}


def test_gains_become_automatic_in_flight_and_back() -> None:
    loop = ExecutiveLoop()
    loop.aim(base=goal_at(AIM))
    given = np.concatenate(loop.answer())
    loop.configure(gains=Gains())
    automatic = np.concatenate(loop.answer())
    assert np.linalg.norm(automatic - given) > 1.0
    fresh = ExecutiveLoop(**automatic_gains(*vars(Gains())))
    fresh.aim(base=goal_at(AIM))
    np.testing.assert_allclose(automatic, np.concatenate(fresh.answer()), rtol=1e-9)
    loop.configure(gains=Gains.uniform(STEP_KP, 2 * STEP_KP))
    np.testing.assert_allclose(np.concatenate(loop.answer()), given, rtol=1e-9, atol=1e-9)


def test_a_group_with_gains_keeps_them() -> None:
    """At rest the force on the base is the sum of those on both poses."""
    others = [group for group in vars(Gains()) if group != "base_position"]
    loop = ExecutiveLoop(**automatic_gains(*others))
    loop.aim(base=goal_at(AIM), end_effector=goal_at(TIP))
    np.testing.assert_allclose(loop.answer()[0][:3], STEP_KP * AIM, rtol=1e-9, atol=1e-9)


def test_a_robot_without_joints_is_controlled() -> None:
    urdf = """<robot name="cube"><link name="hull"><inertial><mass value="16"/>
      <inertia ixx="0.18" iyy="0.18" izz="0.18" ixy="0" ixz="0" iyz="0"/></inertial></link>
      </robot>"""
    robot = type(load("planar_manipulator")).from_urdf(urdf)
    controller = build_controller(robot, ControllerConfig(profile="step"))
    state = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(0))
    controller.set_goals(0.0, state, base=pose([0.5, 0.0, -0.25], [0.0, 0.1, 0.0]))
    unseen = controller.command(0.0, None, state.q, state.qdot).realised
    np.testing.assert_array_equal(unseen.wrench_B, np.zeros(6))
    result = controller.command(0.0, state, state.q, state.qdot).realised
    wanted = [*(16 * np.array([0.5, 0.0, -0.25])), 0.0, 0.18 * 0.1, 0.0]
    np.testing.assert_allclose(result.wrench_B, np.array(wanted) / 1.02, rtol=1e-6, atol=1e-12)


# -- robots that come no nearer to their goals: said, with the cause, and taken back -------------


SECONDS = round(1 / PERIOD)


def aimed(**settings: Any) -> ExecutiveLoop:
    loop = ExecutiveLoop(**settings)
    loop.answer()
    move(loop, AIM, "7")
    return loop


def move(loop: ExecutiveLoop, by: Array, goal_id: str) -> None:
    """Give goals to the base and to the end-effector, which is carried along."""
    loop.aim(base=goal_at(by, goal_id), end_effector=goal_at(TIP + by, goal_id))


def wait_for_stall(loop: ExecutiveLoop, longest: float = 40.0) -> float:
    """Show states until the robot is stalled; return the simulated time that it takes, s."""
    began = loop.tick
    while loop.state != "stalled":
        assert (loop.tick - began) * PERIOD < longest, loop.status.message
        loop.answer(10)
    assert loop.status.state.level == 1
    return (loop.tick - began) * PERIOD


def test_a_robot_that_does_not_move_is_stalled_until_it_moves() -> None:
    loop = aimed()
    assert wait_for_stall(loop) < 25.0
    message = loop.status.message
    where = "Stalled 0.559 m, 0 rad from the reference (tolerance 1 mm, 1 mrad): its errors no"
    assert_one_sentence(message, where)
    assert loop.status.goal_id == "7"
    assert loop.executive.unfinished_goals == {"7"}
    assert [event.kind.value for event in loop.events] == ["goal_accepted"], "it is no decision"
    loop.answer(5 * SECONDS)
    assert loop.state == "stalled"
    for share in np.linspace(0.0, 0.8, 30 * SECONDS):
        loop.place = share * AIM
        loop.answer()
    assert loop.state == "tracking"
    assert loop.status.message.startswith("Flying to the goal; ")
    # A new goal is not stalled from the beginning.
    wait_for_stall(loop)
    move(loop, -AIM, "8")
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("tracking", "8")
    wait_for_stall(loop)


@pytest.mark.parametrize(
    ("settings", "seconds", "share"),
    [
        # Within the tolerances.
        ({"position_tolerance": 1.0, "settle_time": 1000.0}, 40, lambda t: 0.0),
        # Errors shrink slowly.
        ({}, 60, lambda t: 1 - np.exp(-t / 30.0)),
        # With 1 mm/s^2, it makes 2 % of its way in 4.7 s at first, and more and more.
        ({"max_force": 0.05}, 25, lambda t: 0.5 * 0.001 * t**2 / np.linalg.norm(AIM)),
    ],
    ids=["near", "slow", "slow at first"],
)
def test_a_robot_that_comes_nearer_is_not_stalled(
    settings: dict[str, Any], seconds: int, share: Callable[[float], float]
) -> None:
    loop = aimed(**settings)
    for tick in range(seconds * SECONDS):
        loop.place = share(tick * PERIOD) * AIM
        loop.answer()
        assert loop.state == "tracking"


def test_limits_that_hold_the_robot_back_are_named_and_so_in_a_failure() -> None:
    loop = ExecutiveLoop(max_torque=0.01, base_outputs="x y rz", end_effector_outputs="")
    turned = np.array([0.0, 0.0, np.sin(0.1), np.cos(0.1)])
    loop.aim(base=IdentifiedGoal(Goal(np.zeros(3), turned), "turned"))
    loop.answer()
    wait_for_stall(loop)
    assert loop.status.message.endswith(": the base torque is at its limit.")
    loop = aimed(max_force=1.0, time_limit=40.0)
    wait_for_stall(loop)
    assert loop.status.message.endswith(": the thruster force is at its limit.")
    loop.answer(41 * SECONDS)
    assert loop.state == "failed"
    message = "The goal is not reached in time, as the thruster force is at its limit: 0.559"
    assert_one_sentence(loop.status.message, message)


def following(way: float, rotvec: float = 0.0, **settings: Any) -> ExecutiveLoop:
    """Return a robot on its way along x, with its end-effector, perhaps turning about z."""
    loop = ExecutiveLoop(profile="quintic", **settings)
    loop.answer()
    turned = np.array([0.0, 0.0, np.sin(rotvec / 2), np.cos(rotvec / 2)])
    far = np.array([way, 0.0, 0.0])
    goals = {"base": IdentifiedGoal(Goal(far, turned), "far")}
    if not rotvec:
        goals["end_effector"] = goal_at(TIP + far, "far")
    loop.aim(**goals)
    loop.answer()
    return loop


def follow(loop: ExecutiveLoop, error: Callable[[float], float], delay: float, end: float) -> None:
    """Show a robot that is so late and off up to a share of the motion; it is never stalled."""
    profile = loop.executive.controller.profile
    assert profile is not None
    while (time := loop.tick * PERIOD) < end * profile.duration:
        base = profile.at(time - delay).base
        assert base is not None
        loop.place = base.position - [error(time), 0.0, 0.0]
        loop.answer()
        assert loop.state == "tracking", (time, loop.status.message)


def test_a_robot_that_stays_behind_its_reference_is_stalled_on_the_way() -> None:
    loop = following(10.0)
    ends = loop.executive.controller.reference_ends
    assert ends is not None
    assert wait_for_stall(loop, ends) < 0.8 * ends
    assert not loop.executive.controller.reference_at_rest(loop.tick * PERIOD)


def test_a_robot_that_is_behind_and_follows_is_not_stalled_on_the_way() -> None:
    follow(following(2.0), lambda time: 0.0, delay=4.0, end=1.0)


def test_a_part_within_its_tolerance_lags_behind_no_reference() -> None:
    """The robot follows 2 m some seconds late, and need not turn by half of 0.015 rad yet."""
    loop = following(2.0, rotvec=0.015, attitude_tolerance=0.014)
    follow(loop, lambda time: 0.0, delay=2.0, end=0.8)


@pytest.mark.parametrize("decay", [0.02, 0.2])
def test_errors_that_have_begun_to_shrink_on_the_way_are_no_stall(decay: float) -> None:
    """A knock throws the robot back by 65 % of its way at 23 s; then it catches up."""

    def error(time: float) -> float:
        after = time - 23.0
        return float(1.3 * np.exp(-(after**2) if after < 0.0 else -decay * after))

    follow(following(2.0), error, delay=0.0, end=1.0)
