"""The shortest detumbling, and the load of a grasp, against Pinocchio and the robot's equations."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from control.flights import PinocchioPlant
from control.test_approach import HELD, OPTIONS, plan, refusal, target
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.sentences import assert_one_sentence

from spacerobot_ros.collision import ObstaclePair
from spacerobot_ros.control import ControlState
from spacerobot_ros.control.approach import NearestLinks, TargetClearance
from spacerobot_ros.control.detumbling import (
    Detumbling,
    decay_rate,
    largest_feasible_share,
    shortest_detumbling,
)
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.description import Array, Inertia, Pose
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.target_motion import (
    FrameMotion,
    PathInWorld,
    RelativeMotionOverTime,
    RelativePath,
)
from spacerobot_ros.resources import robot_file

PERIOD = 0.02
HELD_BODY = Payload(
    "end_effector",
    Inertia(
        7.0,
        np.array([0.3, -0.1, 0.2]),
        np.array([[0.9, 0.1, -0.05], [0.1, 0.7, 0.08], [-0.05, 0.08, 1.1]]),
    ),
)


def test_the_shortest_detumbling_is_momentum_over_torque() -> None:
    assert shortest_detumbling(3.0, 1.5) == 2.0
    assert shortest_detumbling(3.0, math.inf) == 0.0
    assert shortest_detumbling(0.0, 0.0) == 0.0
    assert shortest_detumbling(3.0, 0.0) == math.inf


def test_motion_decays_at_two_a_second_or_slower_with_long_periods() -> None:
    assert decay_rate(0.01) == 2.0
    assert decay_rate(1.0) == 0.5


@pytest.mark.parametrize(
    ("start", "change", "limit", "share"),
    [
        ([0.0, 3.0, 4.0], [0.0, 0.0, 0.0], 1.0, 1.0),
        ([1.0, 0.0, 0.0], [4.0, 0.0, 0.0], 3.0, 0.5),
        ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], 3.0, 1.0),
        ([0.0, 0.6, 0.0], [4.0, 0.0, 0.0], 1.0, 0.2),
        ([3.0, 0.0, 0.0], [-4.0, 0.0, 0.0], 1.0, 1.0),
        ([3.0, 0.0, 0.0], [-8.0, 0.0, 0.0], 1.0, 0.5),
        ([3.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 1.0, 1.0),
        ([3.0, 0.0, 0.0], [1.0, 0.0, 0.0], 1.0, 0.0),
        ([3.0, 2.0, 0.0], [-6.0, 0.0, 0.0], 1.0, 0.5),
        ([3.0, 2.0, 0.0], [6.0, 0.0, 0.0], 1.0, 0.0),
    ],
)
def test_the_largest_share_of_a_change(
    start: list[float], change: list[float], limit: float, share: float
) -> None:
    assert largest_feasible_share(np.array(start), np.array(change), limit) == pytest.approx(share)


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-3, 3)] * 3), st.floats(0.1, 4.0))
def test_no_larger_share_is_within_the_limit(
    start: tuple[float, ...], change: tuple[float, ...], limit: float
) -> None:
    first, more = np.array(start), np.array(change)
    share = largest_feasible_share(first, more, limit)
    sizes = np.linalg.norm(first + np.linspace(0, 1, 201)[:, None] * more, axis=1)
    size = float(np.linalg.norm(first + share * more))
    if sizes.min() < limit:
        assert size <= limit + 1e-6
        within = np.linspace(0, 1, 201)[sizes <= limit]
        assert share >= within.max() - 1e-9
    else:
        assert size <= sizes.min() + 1e-6


class Case:
    """A three-joint arm in motion, with and without the body that it holds."""

    def __init__(self) -> None:
        self.alone = SpaceRobot(load_robot(robot_file("three_joint_arm")))
        self.robot = HELD_BODY.attached_to(self.alone)
        self.q = np.array([0.4, -0.9, 0.7])
        self.state = ControlState(
            np.array([0.3, -0.2, 0.1]),
            np.array([0.1, -0.3, 0.2, math.sqrt(0.86)]),
            np.array([0.02, -0.05, 0.03]),
            np.array([0.05, 0.08, -0.04]),
            self.q,
            np.array([0.03, -0.06, 0.09]),
        )

    def rates(self, robot: SpaceRobot) -> Array:
        """Return [v_cm, omega, qdot] of a robot, base components."""
        J = robot.jacobian(robot.base_link, self.q)
        s = self.state
        v_cm = s.v_WB_B - J[:3, 3:6] @ s.omega_WB_B - J[:3, 6:] @ s.qdot
        return np.concatenate([v_cm, s.omega_WB_B, s.qdot])

    def accelerations(self, wrench: Array, tau: Array) -> Array:
        z = self.rates(self.robot)
        return self.robot.forward_dynamics(self.q, z[:3], z[3:6], z[6:], wrench, tau)


@pytest.fixture(scope="module")
def case() -> Case:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPACEROBOT_COMPILE", "0")
        return Case()


def law(case: Case, force: float, torque: float, limit: float = 0.0) -> Detumbling:
    return Detumbling(case.robot, HELD_BODY, force, torque, limit, PERIOD)


def test_without_limits_momenta_and_joint_rates_decay_alike(case: Case) -> None:
    given = law(case, math.inf, math.inf)
    command = given.command(case.state)
    zdot, z = case.accelerations(command.wrench_B, command.tau), case.rates(case.robot)
    np.testing.assert_allclose(zdot[6:], -2.0 * z[6:], atol=1e-10)
    m = case.robot.total_mass
    np.testing.assert_allclose(command.wrench_B[:3], -2.0 * m * z[:3], rtol=1e-9)
    np.testing.assert_allclose(given.velocity(case.state), z[:3], rtol=1e-12)
    _, L, _ = case.robot.momentum(
        [0, 0, 0, 1], case.q, case.state.v_WB_B, case.state.omega_WB_B, case.state.qdot
    )
    np.testing.assert_allclose(given.angular_momentum(case.state), L, rtol=1e-10)
    about_cm = command.wrench_B[3:] - np.cross(
        case.robot.center_of_mass(case.q), command.wrench_B[:3]
    )
    np.testing.assert_allclose(about_cm, -2.0 * L, rtol=1e-9)


def test_the_torque_is_the_largest_one_against_the_angular_momentum(case: Case) -> None:
    given = law(case, 0.5, 0.3)
    command = given.command(case.state)
    L = given.angular_momentum(case.state)
    com = case.robot.center_of_mass(case.q)
    about_cm = command.wrench_B[3:] - np.cross(com, command.wrench_B[:3])
    np.testing.assert_allclose(about_cm, -0.3 * L / np.linalg.norm(L), rtol=1e-9)
    assert np.linalg.norm(command.wrench_B[3:]) <= 0.3 + 1e-9
    assert np.linalg.norm(command.wrench_B[:3]) <= 0.5 + 1e-12


def grasp_torque(case: Case, wrench: Array, tau: Array) -> Array:
    """Return the torque on the robot alone with which it moves as it does with the body."""
    alone, both = PinocchioPlant(case.alone, case.state), PinocchioPlant(case.alone, case.state)
    hand = both.model.frames[both.model.getFrameId("end_effector")]
    held = HELD_BODY.inertia
    body = pin.Inertia(held.mass, held.com, held.about_com)
    both.model.appendBodyToJoint(hand.parentJoint, body, hand.placement)
    both.data, both.state = both.model.createData(), case.state
    forces = both.joint_velocities(tau)
    forces[:6] += wrench
    udot = both.own_acceleration(wrench, tau)
    needed = alone.own_mass_matrix() @ udot + alone.own_bias() - forces
    load = np.linalg.lstsq(alone.frame_jacobian_W("end_effector").T, needed, rcond=None)[0]
    return np.asarray(load[3:])


@pytest.mark.parametrize("limit", [0.03, 0.05, 100.0])
def test_the_grasp_is_loaded_up_to_its_limit(case: Case, limit: float) -> None:
    """Its load is that on the robot alone, with opposite sign, by Pinocchio."""
    given = law(case, 2.0, 0.5, limit)
    command = given.command(case.state)
    found = float(np.linalg.norm(grasp_torque(case, command.wrench_B, command.tau)))
    assert found == pytest.approx(given.largest_grasp_torque, rel=1e-4)
    assert found == pytest.approx(limit, rel=1e-4) if limit < 1.0 else found < limit


def test_a_robot_that_holds_nothing_is_brought_to_rest_as_well(case: Case) -> None:
    free = Detumbling(case.alone, None, math.inf, math.inf, 0.001, PERIOD)
    z = case.rates(case.alone)
    np.testing.assert_allclose(
        free.command(case.state).wrench_B[:3], -2 * case.alone.total_mass * z[:3], rtol=1e-9
    )
    assert free.largest_grasp_torque == 0.0


WEIGHT = (
    '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)
LIMIT = '<axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/>'


def ball(x: float, y: float, z: float, radius: float) -> str:
    return (
        f'<visual><origin xyz="{x} {y} {z}"/><geometry><sphere radius="{radius}"/></geometry>'
        "</visual>"
    )


ROBOT = f"""<robot name="reacher"><link name="hull">{WEIGHT}{ball(0, 0, 0, 0.25)}</link>
  <link name="arm">{WEIGHT}{ball(0.5, 0, 0, 0.1)}</link>
  <joint name="shoulder" type="revolute"><parent link="hull"/><child link="arm"/>
    <origin xyz="0.4 0.1 0"/>{LIMIT}
  </joint>
  <link name="hand">{WEIGHT}{ball(0.3, 0, 0, 0.05)}</link>
  <joint name="wrist" type="revolute"><parent link="arm"/><child link="hand"/>
    <origin xyz="0.9 0 0"/>{LIMIT}
  </joint></robot>"""
BODY = f"""<robot name="body"><link name="core">{WEIGHT}{ball(0.1, -0.2, 0.05, 0.3)}</link>
  <link name="ring"/><joint name="mount" type="fixed"><parent link="core"/><child link="ring"/>
    <origin xyz="-0.4 0.3 0.1" rpy="0.3 -0.2 0.6"/></joint></robot>"""
BASE = Pose(Rotation.from_rotvec([0.2, -0.1, 0.7]).as_matrix(), np.array([0.3, -0.4, 0.2]))
SHAPES = np.array([[0.3, -0.5], [0.1, 0.4], [-0.6, 0.2], [-0.9, 0.8]])


def along(count: int) -> tuple[FrameMotion, list[Array]]:
    """Return a grapple frame that moves, and the centre of the ball of the target in W."""
    grapple = parse_robot(BODY).frames["ring"][1]
    R, r, centers = [], [], []
    for k in range(count):
        R_WT = Rotation.from_rotvec([0.2 * k, 0.5, -0.3 * k]).as_matrix()
        r_WT = np.array([1.9 - 0.2 * k, 0.9, 0.1 * k])
        R.append(R_WT @ grapple.R)
        r.append(r_WT + R_WT @ grapple.r)
        centers.append(r_WT + R_WT @ np.array([0.1, -0.2, 0.05]))
    zero = np.zeros((count, 3))
    return FrameMotion(np.array(R), np.array(r), zero, zero, zero, zero), centers


def distance(shape: Array, center: Array, ball: str) -> float:
    """Return the distance of a ball of the robot from that of the target."""
    first, second = shape
    shoulder = np.array([0.4, 0.1, 0.0])
    turn = Rotation.from_rotvec([0, 0, first]), Rotation.from_rotvec([0, 0, first + second])
    places = {
        "hull": (np.zeros(3), 0.25),
        "arm": (shoulder + turn[0].apply([0.5, 0, 0]), 0.1),
        "hand": (shoulder + turn[0].apply([0.9, 0, 0]) + turn[1].apply([0.3, 0, 0]), 0.05),
    }
    at, radius = places[ball]
    return float(np.linalg.norm(BASE.r + BASE.R @ at - center)) - radius - 0.3


@pytest.mark.parametrize("closes", [4, 2, 0])
def test_distances_are_those_of_balls(closes: int) -> None:
    """The hand counts up to the sample in which it closes in."""
    robot, body = parse_robot(ROBOT), parse_robot(BODY)
    clearance = TargetClearance(robot, "hand", body, body.frames["ring"][1], 0.07)
    assert clearance.min_distance == 0.07
    grapple, centers = along(4)
    found = clearance.nearest(BASE, SHAPES, grapple, closes)
    expected = {
        (link, k): distance(SHAPES[k], centers[k], link)
        for k in range(4)
        for link in ("hull", "arm", "hand")
        if link != "hand" or k < closes
    }
    (link, _), nearest = min(expected.items(), key=lambda each: each[1])
    assert found is not None
    assert found.distance == pytest.approx(nearest, abs=1e-6)
    assert tuple(found.links) == (link, "core")


def test_bodies_without_shapes_touch_nothing() -> None:
    robot = parse_robot(ROBOT)
    bare = parse_robot(BODY.replace(ball(0.1, -0.2, 0.05, 0.3), ""))
    clearance = TargetClearance(robot, "hand", bare, bare.frames["ring"][1], 0.07)
    assert clearance.nearest(BASE, SHAPES, along(4)[0], 4) is None


class Answers:
    """Distances in the order in which they are asked for; the last one from then on."""

    min_distance = 0.05

    def __init__(self, *distances: float | None) -> None:
        self.distances, self.asked = list(distances), 0
        self.closes: list[tuple[int, int]] = []

    def nearest(
        self, base: Pose, shapes: Array, grapple: FrameMotion, closes: int
    ) -> NearestLinks | None:
        assert len(shapes) == len(grapple.r)
        self.closes.append((len(shapes), closes))
        found = self.distances[min(self.asked, len(self.distances) - 1)]
        self.asked += 1
        return None if found is None else NearestLinks(found, ObstaclePair("arm", "core"))


NEAR = target((1.7, -0.5))


def test_a_way_that_is_clear_is_taken_as_it_is() -> None:
    answers: Any = Answers(0.08, 0.06)
    found = plan(NEAR, clearance=answers)
    assert (answers.asked, found.distance) == (2, 0.06)
    assert isinstance(found.path_to_standoff, RelativePath)
    direct = plan(NEAR)
    assert (found.start, found.contact) == (direct.start, direct.contact)
    # Few samples first, then all; the hand counts until it leaves the standoff.
    (few, _), (count, closes) = answers.closes
    assert few == -(-count // 8)
    assert 0 <= 0.25 * closes - found.closing_time < 0.25
    assert plan(NEAR, clearance=Answers(None)).distance == np.inf
    exactly: Any = Answers(0.05)
    assert plan(NEAR, clearance=exactly).distance == 0.05


def test_a_body_in_the_way_is_gone_round() -> None:
    """First by a path in the world, then to standoffs farther away."""
    answers: Any = Answers(0.01, 0.2, 0.07)
    found = plan(NEAR, clearance=answers)
    assert isinstance(found.path_to_standoff, PathInWorld)
    assert found.distance == 0.07
    standoff = found.path_to_standoff.at([found.path_to_standoff.duration]).values[0, :3]
    np.testing.assert_allclose(standoff, OPTIONS.standoff)
    answers = Answers(0.01, 0.2, 0.04, 0.3)
    farther = plan(NEAR, clearance=answers)
    outward = farther.path_to_standoff
    end = outward.at([outward.duration]).values[0, :3]
    np.testing.assert_allclose(end, 2 * np.array(OPTIONS.standoff))
    assert farther.path_to_contact.duration > found.path_to_contact.duration


def test_a_hand_in_motion_may_be_beside_the_target() -> None:
    moving = replace(HELD, velocity=np.array([0.02, -0.01, 0.0]))
    answers: Any = Answers(0.3)
    plan(NEAR, held=moving, clearance=answers)
    assert [closes for _, closes in answers.closes] == [0, 0]


def test_a_body_that_is_always_in_the_way_is_named() -> None:
    answers: Any = Answers(0.0104, 0.0123, 0.0102)
    soon = replace(OPTIONS, horizon=1.0)
    said = refusal(NEAR, clearance=answers, options=soon)
    assert_one_sentence(
        said,
        "The target cannot be met within the next 1 s",
        "link 'arm' would come within 0.0123 m of 'core' of the target, and 'target.clearance' is "
        "0.05 m",
    )
    assert 4 < answers.asked < 100
    touching: Any = Answers(-0.01)
    said = refusal(NEAR, clearance=touching, options=soon)
    assert said.endswith("s, link 'arm' would touch 'core' of the target.")


def test_the_number_of_ways_past_a_body_is_limited() -> None:
    """There are a thousand up to this horizon."""
    answers: Any = Answers(0.01)
    far = replace(OPTIONS, horizon=40.0)
    assert "come within 0.01 m" in refusal(NEAR, clearance=answers, options=far)
    assert answers.asked <= 100


def test_a_path_in_the_world_joins_motion_and_standoff() -> None:
    motion, start, T = target((1.7, -0.5), (0.01, -0.02), 0.2), 2.0, 6.0
    at_rest = HELD.motion
    begin = motion.grapple([start])
    begin_relative = RelativeMotionOverTime.between(begin, at_rest)
    relative = RelativePath(begin_relative, np.array(OPTIONS.standoff), T)
    path = PathInWorld(relative, motion, start, at_rest, np.array(OPTIONS.standoff))
    assert path.duration == T
    times = np.linspace(0.0, T, 4001)
    moved = motion.grapple(start + times).with_relative_motion(path.at(times))
    np.testing.assert_allclose(moved.r[0], HELD.position, atol=1e-12)
    np.testing.assert_allclose(moved.v[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(moved.a[0], 0.0, atol=1e-12)
    fixed = motion.grapple([start + T]).with_relative_motion(path.at([T]))
    for name in ("r", "v", "a"):
        np.testing.assert_allclose(getattr(moved, name)[-2], getattr(fixed, name)[0], atol=2e-3)
    # Velocity and acceleration are derivatives of the position.
    h = times[1]
    np.testing.assert_allclose(np.gradient(moved.r, h, axis=0)[1:-1], moved.v[1:-1], atol=1e-6)
    np.testing.assert_allclose(np.gradient(moved.v, h, axis=0)[1:-2], moved.a[1:-2], atol=1e-5)
    # It is shorter in W than the path relative to the frame that turns.
    around = motion.grapple(start + times).with_relative_motion(relative.at(times))
    lengths = [np.linalg.norm(np.diff(each.r, axis=0), axis=1).sum() for each in (moved, around)]
    assert lengths[0] < lengths[1]
    after = path.at([T + 1.0])
    np.testing.assert_allclose(after.values[0, :3], OPTIONS.standoff)
    np.testing.assert_allclose(after.rates[0, :3], 0.0)
