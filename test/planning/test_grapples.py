"""Meetings with a target that tumbles: its motion by scipy, momenta by Pinocchio, coal."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles.integrated import tumbled_body
from support.sentences import assert_one_sentence
from support.thrust_flights import FOLDED, distance_from_target, pinocchio

from spacerobot_ros import fly
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.grasp import BodyMotion, RobotMotion, TargetBody
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.planning.methods.thrust.problem import Grapple, ThrustOptions
from spacerobot_ros.planning.methods.thrust.search import ThrustPlanner
from spacerobot_ros.resources import robot_file, share_directory

INERTIA = '<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial>'
BOOMED = f"""<robot name="boomed"><link name="base_link"><inertial><mass value="16"/>
{INERTIA.format(0.3, 0.35, 0.4)}<collision><geometry><box size="0.4 0.3 0.2"/></geometry>
</collision></link><link name="boom"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>
{INERTIA.format(0.001, 0.02, 0.02)}<collision><origin xyz="0.2 0 0"/><geometry>
<box size="0.4 0.05 0.05"/></geometry></collision></link><joint name="hinge" type="revolute">
<parent link="base_link"/><child link="boom"/><origin xyz="0.25 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="0.2" effort="5"/></joint><link name="end_effector"/>
<joint name="tip" type="fixed"><parent link="boom"/><child link="end_effector"/>
<origin xyz="0.4 0 0"/></joint></robot>"""
SLAB = f"""<robot name="slab"><link name="slab"><inertial><origin xyz="0.02 0.01 -0.03"/>
<mass value="30"/>{INERTIA.format(2.0, 1.4, 1.1)}<collision><geometry><box size="0.6 1.0 0.8"/>
</geometry></collision></link><link name="grapple"/><joint name="mount" type="fixed">
<parent link="slab"/><child link="grapple"/><origin xyz="-0.32 0.1 0"/></joint></robot>"""
TARGET = parse_robot(SLAB)
SATELLITE = share_directory() / "config" / "targets" / "satellite.urdf"
HERE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
REST, FOLDED_REST = (RobotMotion.at_rest(HERE, q) for q in (np.zeros(1), FOLDED))


def boomed(**options: Any) -> ThrustPlanner:
    chosen = ThrustOptions(intervals=20, **options)
    return ThrustPlanner(SpaceRobot.from_urdf(BOOMED), chosen, "end_effector", 1.0, 0.125)


def slab(place: tuple[float, ...], v: tuple[float, ...] = (0.0, 0.0, 0.0)) -> BodyMotion:
    """Return the slab, whose fixture is on the far side at first, as it turns about two axes."""
    R = Rotation.from_rotvec([0.0, 0.2, 2.6]).as_matrix()
    return BodyMotion(R, np.array(place), np.array(v), R @ np.array([0.03, 0.0, 0.04]))


def meeting(free: BodyMotion, clearance: float = 0.02) -> Grapple:
    return Grapple(TorqueFreeMotion(TargetBody.of(TARGET, "grapple"), free), TARGET, clearance)


def test_a_fixture_is_met_with_its_pose_and_velocities_round_the_target() -> None:
    planner, free = boomed(), slab((2.5, 0.2, -0.1), (0.004, -0.003, 0.0))
    motion = planner.plan(REST, meeting(free))
    T, dt = motion.duration, 1e-3
    R, r, _ = tumbled_body(TARGET.bodies[0].inertia, free, np.array([0.0, T - dt, T, T + dt]))
    hand = motion.at(T).end_effector
    fixture = r + R.apply([-0.32, 0.1, 0.0])
    assert hand.position == pytest.approx(fixture[2], abs=1e-4)
    assert (R[2].inv() * Rotation.from_quat(hand.quaternion)).magnitude() < 1e-4
    assert hand.velocity == pytest.approx((fixture[3] - fixture[1]) / (2 * dt), abs=1e-4)
    turned = (R[3] * R[1].inv()).as_rotvec() / (2 * dt)
    assert hand.angular_velocity == pytest.approx(turned, abs=1e-4)
    robot = planner.robot.description
    assert distance_from_target(robot, TARGET, motion, free) > 0.0199
    careless = planner.plan(REST, meeting(free, 0.0))
    assert distance_from_target(robot, TARGET, careless, free) < 0


def test_an_approach_stays_in_its_corridor_or_is_refused() -> None:
    planner, free, angle = boomed(), slab((2.5, 0.2, -0.1), (0.004, -0.003, 0.0)), 0.25
    clear = replace(meeting(free), standoff=(-0.4, 0.0, 0.0))
    outside = []
    for length in (0.0, 0.6):
        asked = replace(clear, corridor_angle=angle, corridor_length=length)
        motion = planner.plan(REST, asked)
        times = np.linspace(0, motion.duration, 8000)
        hand = np.array([motion.at(time).end_effector.position for time in times])
        R, r, _ = tumbled_body(TARGET.bodies[0].inertia, free, times)
        p = R.inv().apply(hand - r) - [-0.32, 0.1, 0.0]
        beyond = np.hypot(p[:, 1], p[:, 2]) - (0.02 - p[:, 0] * np.tan(angle))
        outside.append(beyond[np.linalg.norm(p, axis=1) < 0.6].max())
    assert outside[0] > 0.1, "the test is sharp"
    assert outside[1] < 3e-4
    near = replace(clear, corridor_angle=angle, corridor_length=4.0)
    with pytest.raises(PlanningError) as refused:
        planner.plan(REST, near)
    assert_one_sentence(
        str(refused.value), "m outside its corridor", "corridor_angle = 0.25", "move the robot"
    )


@pytest.mark.slow
def test_a_corridor_that_cannot_be_kept_is_refused_before_the_horizon() -> None:
    free = slab((2.5, 0.2, -0.1), (0.004, -0.003, 0.0))
    clear = replace(meeting(free), standoff=(-0.4, 0.0, 0.0))
    narrow = replace(clear, corridor_angle=0.1, corridor_length=2.0)
    began = time.process_time()
    with pytest.raises(PlanningError) as refused:
        boomed().plan(REST, narrow)
    assert time.process_time() - began < 60.0
    assert_one_sentence(str(refused.value), "m outside its corridor", "widen the corridor")


@cache
def servicer() -> ThrustPlanner:
    robot = SpaceRobot.from_file(robot_file("servicer"))
    options = ThrustOptions(intervals=15, thrusters="urdf")
    return ThrustPlanner(robot, options, "end_effector")


def satellite(quaternion: list[float], place: list[float], omega: list[float]) -> BodyMotion:
    """Return a satellite that turns about axes of its own, deg/s, and drifts by millimetres."""
    R = Rotation.from_quat(quaternion).as_matrix()
    v = np.array([-0.001, -0.002, 0.001])
    return BodyMotion(R, np.array(place), v, R @ np.deg2rad(omega))


@pytest.mark.slow
def test_a_fixture_that_faces_away_is_met_when_it_has_turned() -> None:
    planner, target = servicer(), load_robot(SATELLITE)
    free = satellite([0.254, 0.691, -0.641, -0.216], [-2.38, 1.2, 3.88], [-5.93, 0.91, 0.0])
    motion = TorqueFreeMotion(TargetBody.of(target, "grapple"), free)
    clear, careless = (
        planner.plan(FOLDED_REST, Grapple(motion, target, distance)) for distance in (0.02, 0.0)
    )
    robot = planner.robot.description
    assert distance_from_target(robot, target, careless, free) < -0.1
    assert distance_from_target(robot, target, clear, free) > 0.0199
    assert careless.duration < 16 < clear.duration < 40


@pytest.mark.slow
def test_a_fixture_that_turns_too_slowly_is_met_round_the_target() -> None:
    target = load_robot(SATELLITE)
    free = satellite([-0.04, -0.62, 0.59, 0.51], [2.94, 0.14, 0.42], [0.0, 0.5, 0.8])
    motion = TorqueFreeMotion(TargetBody.of(target, "grapple"), free)
    options = ThrustOptions(intervals=20, thrusters="urdf", duration=60.0)
    planner = ThrustPlanner(servicer().robot, options, "end_effector")
    # The motion of least propellant ends at the horizon, inside the target.
    clear = planner.plan(FOLDED_REST, Grapple(motion, target, 0.02, horizon=60.0))
    assert distance_from_target(planner.robot.description, target, clear, free) > 0.0199
    assert clear.duration <= 60.0


def test_a_grasp_leaves_no_angular_momentum_if_that_is_asked_for() -> None:
    planner, target = servicer(), load_robot(SATELLITE)
    body = TargetBody.of(target, "grapple")
    free = satellite([-0.04, -0.62, 0.59, 0.51], [3.9, 0.4, 0.6], [0.0, 2.0, -2.0])
    R, omega = free.R_WT, free.omega
    grapple = Grapple(TorqueFreeMotion(body, free))
    totals, durations = [], []
    for detumbles in (False, True):
        asked = replace(grapple, detumbles=detumbles)
        motion = planner.plan(FOLDED_REST, asked)
        oracle, last = pinocchio(planner.robot), motion.at(motion.duration)
        oracle.set_configuration(last.q, last.base.quaternion, last.base.position)
        twist = Rotation.from_quat(last.base.quaternion).inv().apply(last.base[2:4]).ravel()
        oracle.move(oracle.base_velocities(twist) + oracle.joint_velocities(last.qdot))
        (p, L, _), m = oracle.momentum_W(), oracle.data.mass[0]
        turned, r, _ = tumbled_body(body.inertia, free, np.array([0.0, motion.duration]))
        inertia = body.inertia
        spin = R @ inertia.about_com @ R.T @ omega
        of_target = free.v + np.cross(omega, R @ inertia.com)
        apart = r[1] + turned[1].apply(inertia.com) - oracle.center_of_mass_W()
        reduced = m * inertia.mass / (m + inertia.mass)
        orbit = reduced * np.cross(apart, of_target - p / m)
        totals.append(np.linalg.norm(L + spin + orbit) / np.linalg.norm(spin))
        durations.append(motion.duration)
        planned = motion.joined_momentum(grapple.motion)
        assert planned == pytest.approx(L + spin + orbit, abs=1e-3)
    assert totals[0] > 1
    assert totals[1] < 0.01
    assert durations[1] < 1.2 * durations[0]


def test_meetings_that_cannot_be_are_refused_in_a_sentence() -> None:
    def refusal(free: BodyMotion, **options: Any) -> str:
        with pytest.raises(PlanningError) as refused:
            boomed(**options).plan(REST, meeting(free))
        return str(refused.value)

    # From rest to 6 m/s takes 17 kg 128 s by 0.8 N.
    leaving = refusal(slab((2.5, 0.0, 0.0), (6.0, 0.0, 0.0)))
    assert_one_sentence(leaving, "recedes at 6 m/s", "0.8 N", "target.horizon", "120 s")
    touching = refusal(slab((0.4, 0.0, 0.0)))
    assert_one_sentence(touching, "obstacle 'slab' touch at the start", "target.clearance")
    short = refusal(slab((2.5, 0.2, -0.1)), duration=3.0)
    assert_one_sentence(short, "s at least", "plan.duration is 3 s")
    with pytest.raises(PlanningError) as late:
        boomed().plan(REST, replace(meeting(slab((2.5, 0.2, -0.1))), horizon=14.0))
    assert_one_sentence(str(late.value), "takes at least", "target.horizon is 14 s: increase it")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("detumble", "least", "most"),
    [("after", 1.8, 2.4), pytest.param("before", 0, 0.4, marks=pytest.mark.study)],
)
def test_the_plant_has_what_a_planned_grasp_leaves(
    detumble: str, least: float, most: float
) -> None:
    """Beside what wheels store, which cancels the spin; the satellite alone has 2.7 N m s."""
    flight = fly(
        "servicing",
        parameters={
            "coordinated_control.target.detumble": detumble,
            "coordinated_control.time_limit": 0.1,
        },
    )
    capture = flight.capture
    (began,) = (each for each in flight.events if each.kind.value == "approach_started")
    assert least <= float(began.about["planned_momentum_Nms"]) < most
    assert capture["captured"]
    robot = SpaceRobot.from_file(robot_file(flight.scenario.plant.robot))
    at = int(np.searchsorted(flight.time, capture["time_s"]))
    spins = capture["joint_rates_radps"] * np.array(["wheel" in x for x in robot.joint_names])
    oracle = pinocchio(robot)
    oracle.set_configuration(np.zeros(robot.n), flight.pose[at, 3:])
    oracle.move(oracle.joint_velocities(spins))
    _, stored, _ = oracle.momentum_W()
    assert detumble == "after" or np.linalg.norm(stored) > 0.1, "the test is sharp"
    left = np.linalg.norm(capture["angular_momentum_Nms"] - stored)
    assert least <= left < most
