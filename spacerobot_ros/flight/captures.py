"""The body held by a robot during a flight: times, parameters, and momentum budget."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from spacerobot_ros.control.wheels import BUDGET_PARTS, momentum_budget
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.grasp import Payload, RobotMotion, frame_motion
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.payload_estimation import (
    PayloadEstimate,
    estimate_payload,
    momentum_regressor,
)
from spacerobot_ros.model.rotations import (
    attitude_errors,
    matrices_from_quaternions,
    matrix_from_quaternion,
    quaternion_multiply,
    quaternions_from_rotvecs,
    relative_pose,
)
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.simulation.capture import capturing_link
from spacerobot_ros.simulation.loads import Surroundings

_SAME_TIME = 1e-6  # s


class HeldTarget(NamedTuple):
    """The target while held by the robot.

    Attributes
    ----------
    start, end
        Capture and release times, s; ``end`` is infinite if there is no release.
    payload
        The body, according to the target's description.
    """

    start: float
    end: float
    payload: Payload


def _states(flight: Flight, robot: RobotDescription, prefix: str = "") -> Signal:
    """Return the states with known base and joints, (N, 13 + 2 n): pose, twist, q, qdot.

    Joints are in the robot's order; with the prefix ``measured_``, states are the measured ones.
    """
    pose, q = flight.signal(f"{prefix}pose"), flight.signal(f"{prefix}q")
    names = list(flight.joint_names)
    if not set(robot.joint_names) <= set(names):
        return Signal.empty(13 + 2 * len(robot.joint_names))
    time, base, joints = np.intersect1d(pose.time, q.time, return_indices=True)
    columns = [names.index(name) for name in robot.joint_names]
    twist, qdot = flight.signal(f"{prefix}twist"), flight.signal(f"{prefix}qdot")
    of_joints = (each.values[joints][:, columns] for each in (q, qdot))
    return Signal(time, np.hstack([pose.values[base], twist.values[base], *of_joints]))


def _motion(state: Array) -> RobotMotion:
    return RobotMotion(*np.split(state, [7, 13, (13 + len(state)) // 2]))


def held_bodies(flight: Flight) -> tuple[HeldTarget, ...]:
    """Return the bodies held by the robot during a flight, one per capture.

    The grasp pose follows from the robot and target poses after the capture.
    """
    robot, target = flight.robot, flight.target
    if robot is None or target is None:
        return ()
    spans, start = list[tuple[float, float]](), math.nan
    for event in flight.events:
        if event.kind is EventKind.CAPTURED and event.time_s is not None:
            start = event.time_s
        elif event.kind is EventKind.RELEASED and event.time_s is not None:
            spans.append((start, event.time_s))
            start = math.nan
    spans.append((start, math.inf))
    held = []
    for start, end in spans:
        # There are no states after a time that is NaN.
        states, poses = _states(flight, robot).between(start, end), flight.signal("target_pose")
        _, own, other = np.intersect1d(states.time, poses.time, return_indices=True)
        if len(own):
            link = capturing_link(robot, flight.scenario.plant)
            first = _motion(states.values[own[0]])
            hand = ForwardKinematics(robot).link_in_world(link, first.pose, first.q)
            grasp = relative_pose(hand, poses.values[other[0]])
            pose = Pose(matrix_from_quaternion(grasp[3:]), grasp[:3])
            payload = Payload(link, target.bodies[0].inertia.moved(pose))
            held.append(HeldTarget(start, end, payload))
    return tuple(held)


def momentum_budget_over_time(flight: Flight, most: int) -> Signal:
    """Return the angular momenta of base, arm and wheels, and their total, about the centre of
    mass.

    The columns are :data:`BUDGET_PARTS`: norms of the components of
    :func:`~spacerobot_ros.control.wheels.momentum_budget`, as in controller/status, but computed
    from the true states. Values are in N m s. A held body is treated as part of the link that holds
    it.

    Parameters
    ----------
    flight
        The flight; if it has no robot description or no states, the returned signal is empty.
    most
        Maximum number of states to evaluate.

    Raises
    ------
    RobotDescriptionError
        The inertia of the described robot is not positive definite.
    """
    if flight.robot is None or not len(states := _states(flight, flight.robot)):
        return Signal.empty(len(BUDGET_PARTS))
    rows = np.unique(np.linspace(0, len(states) - 1, most).round().astype(np.int64))
    wheels = ReactionWheels.of(flight.robot)
    alone = SpaceRobot(wheels.gyrostat)
    held = [(each, each.payload.attached_to(alone)) for each in held_bodies(flight)]
    values = np.empty((len(rows), len(BUDGET_PARTS)))
    for row, (time, state) in enumerate(zip(states.time[rows], states.values[rows], strict=True)):
        # The state at the capture itself still shows the motion before it.
        robot = next((r for each, r in held if each.start < time <= each.end), alone)
        motion, others = _motion(state), wheels.other
        omega, q, qdot = motion.twist[3:], motion.q[others], motion.qdot
        parts = momentum_budget(wheels, robot, omega, q, qdot[others], qdot[wheels.index])
        values[row] = [np.linalg.norm(parts[name]) for name in BUDGET_PARTS]
    return Signal(states.time[rows], values)


def payload_estimates(flight: Flight, most: int = 600) -> tuple[PayloadEstimate, ...]:
    """Return the estimated parameters of each body held by the robot.

    The parameters are determined from conservation of momentum (:mod:`.model.payload_estimation`),
    the measured base and joint motion, the robot's masses and the thrust. The target's description
    is not used.

    Parameters
    ----------
    flight
        The flight.
    most
        Maximum number of states used per body.

    Raises
    ------
    SpaceRobotError
        Loads with unknown impulse acted on the robot.
    RobotDescriptionError
        The inertia of the described robot is not positive definite.
    """
    robot, plant = flight.robot, flight.scenario.plant
    held = held_bodies(flight)
    if robot is None or not held:
        return ()
    loaded = any(event.kind is EventKind.DISTURBANCE for event in flight.events)
    if loaded or plant.disturbances or Surroundings.of(plant.orbit, plant.table).has_loads:
        raise SpaceRobotError(
            "The parameters of the held body are not estimated: external loads (disturbances, an "
            "orbit or a table) acted on the robot, and their impulse is unknown; use a flight "
            "without such loads."
        )
    prefix = "measured_" if len(flight.signal("measured_pose")) else ""
    states, alone = _states(flight, robot, prefix), SpaceRobot(robot)
    # The state at the capture itself still shows the motion before it.
    spans = [
        (each.payload.link, states.between(each.start + 2 * _SAME_TIME, each.end)) for each in held
    ]
    return tuple(
        _payload_estimate(flight, alone, link, span, most) for link, span in spans if len(span) > 2
    )


def _payload_estimate(
    flight: Flight, robot: SpaceRobot, link: str, states: Signal, most: int
) -> PayloadEstimate:
    about = states.values[:, :3].mean(axis=0)
    impulses = _impulses(flight, states, about)
    # No state belongs to two triples.
    triples = max(min(most, len(states)) // 3, 1)
    middle = 1 + np.linspace(0, len(states) - 3, triples).round().astype(np.int64)
    rows = (middle[:, np.newaxis] + np.arange(-1, 2)).reshape(-1)
    regressors, known = np.empty((len(rows), 6, 10)), np.empty((len(rows), 6))
    for at, row in enumerate(rows.tolist()):
        motion = _motion(states.values[row])
        pose, twist, q = motion.pose, motion.twist, motion.q
        p, L, _ = robot.momentum(pose[3:], q, twist[:3], twist[3:], motion.qdot)
        center = pose[:3] + motion.R_WB @ robot.center_of_mass(q)
        known[at, :3], known[at, 3:] = p, L + np.cross(center - about, p)
        regressors[at] = momentum_regressor(frame_motion(robot, link, motion), about)
    inertia = robot.inertia_matrix(_motion(states.values[0]).q)[3:6, 3:6]
    radius = math.sqrt(float(np.trace(inertia)) / 2 / robot.total_mass)
    of_triples = regressors.reshape(-1, 3, 6, 10), (known - impulses[rows]).reshape(-1, 3, 6)
    return estimate_payload(link, *of_triples, robot.total_mass, radius)


def _impulses(flight: Flight, states: Signal, about: Array) -> Array:
    """Return the impulses (N, 6) of the thrust since the first of N states, N s and N m s about a
    point, in W. Wrenches are constant over a tick in the base frame.
    """
    wrench = _thrust_during_ticks_before(flight, states.time[1:])
    step = np.diff(states.time)[:, np.newaxis]
    r, q, twist = (states.values[:, part] for part in (slice(3), slice(3, 7), slice(7, 13)))
    R = matrices_from_quaternions(q)
    turn = attitude_errors(q[:-1], q[1:])
    omega = twist[:, 3:]
    turn_to_middle = turn / 2 + step * (omega[:-1] - omega[1:]) / 8
    q_middle = quaternion_multiply(q[:-1], quaternions_from_rotvecs(turn_to_middle))
    R_middle = matrices_from_quaternions(q_middle)
    v = np.einsum("nij,nj->ni", R, twist[:, :3])
    r_middle = (r[:-1] + r[1:]) / 2 + step * (v[:-1] - v[1:]) / 8
    total = np.zeros((len(states), 6))
    instants = (1 / 6, R[:-1], r[:-1]), (4 / 6, R_middle, r_middle), (1 / 6, R[1:], r[1:])
    for share, rotation, place in instants:
        force = np.einsum("nij,nj->ni", rotation, wrench[:, :3])
        torque = np.einsum("nij,nj->ni", rotation, wrench[:, 3:])
        torque += np.cross(place - about, force)
        total[1:] += share * step * np.hstack([force, torque])
    return np.cumsum(total, axis=0)


def _thrust_during_ticks_before(flight: Flight, times: Array) -> Array:
    """Return the thruster wrench (N, 6) on the base in the ticks that end at times (N,)."""
    fired = flight.signal("thruster_wrench")
    # A command acts in the tick that begins with its state.
    thrust, delay = (fired, 0) if len(fired) else (flight.wrench, 1)
    ends, own = (np.round(t / flight.control_period) for t in (times, thrust.time))
    _, rows, other = np.intersect1d(ends, own + delay, return_indices=True)
    found = np.zeros((len(times), 6))
    found[rows] = thrust.values[other]
    return found
