"""The robot of a flight with the body that it held: who it was when, and its momentum budget."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.wheels import momentum_budget
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight, Signal
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.simulation.capture import capturing_link

BUDGET_PARTS = ("base", "arm", "wheels", "sum")
"""Columns of :func:`momentum_budget_over_time`."""

_SAME_TIME = 1e-6
"""Largest difference of times that count as equal, s."""


@dataclass(frozen=True)
class HeldBody:
    """The target, while the robot held it.

    Attributes
    ----------
    start, end
        Times of the capture and of the release, s; the end is infinite without a release.
    payload
        The body, by the target's description.
    """

    start: float
    end: float
    payload: Payload


@dataclass(frozen=True)
class States:
    """True states of the robot in which base and joints are known.

    Attributes
    ----------
    time
        (N,) s.
    pose, twist
        (N, 7) and (N, 6) of the base.
    q, qdot
        (N, n) in the order of the robot's joints.
    """

    time: Array
    pose: Array
    twist: Array
    q: Array
    qdot: Array

    @classmethod
    def of(cls, flight: Flight, robot: RobotDescription) -> States:
        """Return the states of a flight; none where its joints are not those of the robot."""
        pose, q = flight.signal("pose"), flight.signal("q")
        names = list(flight.joint_names)
        time, base, joints = np.intersect1d(pose.time, q.time, return_indices=True)
        if not set(robot.joint_names) <= set(names):
            time, base, joints = time[:0], base[:0], joints[:0]
            columns = []
        else:
            columns = [names.index(name) for name in robot.joint_names]
        return cls(
            time,
            pose.values[base],
            flight.signal("twist").values[base],
            q.values[joints][:, columns],
            flight.signal("qdot").values[joints][:, columns],
        )

    def __len__(self) -> int:
        return len(self.time)

    def at(self, rows: npt.NDArray[np.int64]) -> States:
        """Return some of the states."""
        return States(
            self.time[rows], self.pose[rows], self.twist[rows], self.q[rows], self.qdot[rows]
        )

    def between(self, start: float, end: float) -> States:
        """Return the states from ``start`` to ``end``, s, both included."""
        inside = (self.time >= start - _SAME_TIME) & (self.time <= end + _SAME_TIME)
        return self.at(np.flatnonzero(inside))

    def thinned(self, most: int) -> States:
        """Return at most so many states, at about equal intervals."""
        return self.at(np.unique(np.linspace(0, len(self) - 1, most).round().astype(int)))


def held_bodies(flight: Flight) -> tuple[HeldBody, ...]:
    """Return the bodies that the robot of a flight held, one for each capture.

    Where the grasp is follows from the poses of robot and target after the capture.
    """
    robot, target = flight.robot, flight.target
    if robot is None or target is None:
        return ()
    held: list[HeldBody] = []
    start = math.nan
    for event in flight.events:
        if event.kind is EventKind.CAPTURED and event.time_s is not None:
            start = event.time_s
        elif event.kind is EventKind.RELEASED and event.time_s is not None:
            held += _held_between(flight, robot, target, start, event.time_s)
            start = math.nan
    return (*held, *_held_between(flight, robot, target, start, math.inf))


def _held_between(
    flight: Flight, robot: RobotDescription, target: RobotDescription, start: float, end: float
) -> list[HeldBody]:
    """Return the body that was held between a capture and a release; none without states."""
    if math.isnan(start):
        return []
    states = States.of(flight, robot).between(start, end)
    poses = flight.signal("target_pose")
    _, own, other = np.intersect1d(states.time, poses.time, return_indices=True)
    if not len(own):
        return []
    link, kinematics = capturing_link(robot, flight.scenario.plant), ForwardKinematics(robot)
    R_BL, r_BL = kinematics.link_poses(states.q[own[:1]])
    number = list(kinematics.links).index(link)
    base, body = states.pose[own[0]], poses.values[other[0]]
    R_WB = matrix_from_quaternion(base[3:])
    R_WL, r_WL = R_WB @ R_BL[0, number], base[:3] + R_WB @ r_BL[0, number]
    grasp = Pose(R_WL.T @ matrix_from_quaternion(body[3:]), R_WL.T @ (body[:3] - r_WL))
    return [HeldBody(start, end, Payload(link, target.bodies[0].inertia.moved(grasp)))]


def momentum_budget_over_time(flight: Flight, most: int) -> Signal:
    """Return the angular momentum of base, arm, wheels and all about the centre of mass, N m s.

    The columns are :data:`BUDGET_PARTS`: norms of the parts of
    :func:`~spacerobot_ros.control.wheels.momentum_budget`, as controller/status has them, here from
    the true states. A body that the robot holds counts as a part of the link that holds it.

    Parameters
    ----------
    flight
        The flight; without a description of its robot, or without states, the signal is empty.
    most
        Largest number of states at which they are evaluated.

    Raises
    ------
    RobotDescriptionError
        The described robot has no positive inertia.
    """
    if flight.robot is None:
        return Signal.empty(len(BUDGET_PARTS))
    states = States.of(flight, flight.robot)
    if not len(states):
        return Signal.empty(len(BUDGET_PARTS))
    states = states.thinned(most)
    wheels = ReactionWheels.of(flight.robot)
    alone = SpaceRobot(wheels.gyrostat)
    held = [(each, each.payload.attached_to(alone)) for each in held_bodies(flight)]
    values = np.empty((len(states), len(BUDGET_PARTS)))
    for row, time in enumerate(states.time.tolist()):
        # The state of the capture itself shows the motion before it.
        robot = next((r for each, r in held if each.start < time <= each.end), alone)
        q, qdot, others = states.q[row], states.qdot[row], wheels.other
        parts = momentum_budget(
            wheels, robot, states.twist[row, 3:], q[others], qdot[others], qdot[wheels.index]
        )
        values[row] = [np.linalg.norm(parts[name]) for name in BUDGET_PARTS]
    return Signal(states.time, values)
