"""Tasks of environments: observations, rewards, and the command of an action.

All functions take the states of N robots at once, so that one robot in a plant, many in lanes and a
robot behind ROS topics are observed by the same code.
"""

from __future__ import annotations

import numbers
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    quaternion_from_rotvec,
    quaternion_inverse,
    quaternion_multiply,
    rotvecs_from_quaternions,
)
from spacerobot_ros.planning.core.controllability import sample_shapes
from spacerobot_ros.planning.methods.optimal.goal_specification import BaseRotations

_SAMPLED_SHAPE_COUNT = 12

_MIN_SHARE_OF_MOTION = 1e-7
"""Singular values below this share of the largest are no motion."""

LARGEST_OBSERVATION = 1e6
"""Bound of observed quantities that have none of their own; observations are clipped to it."""


@dataclass(frozen=True)
class RobotStates:
    """States of N robots.

    Attributes
    ----------
    pose
        (N, 7) position ``r_WB`` (m) and quaternion ``R_WB`` (x, y, z, w) of the base.
    twist
        (N, 6) ``v_WB_B`` (m/s) and ``omega_WB_B`` (rad/s).
    q, qdot
        (N, n) joint positions and velocities.
    link_r
        (N, 3) position in B of the link that reaches, m; None where no link does.
    """

    pose: Array
    twist: Array
    q: Array
    qdot: Array
    link_r: Array | None = None


@dataclass(frozen=True)
class RewardWeights:
    """Weights of the terms of the reward of a step.

    Attributes
    ----------
    progress
        Per rad or m by which the error became smaller.
    time
        Penalty per s.
    action
        Penalty per s, times the mean square of the action's entries.
    reached
        Once, in the step in which the goal is reached.
    failed
        Penalty, once, where the flight cannot continue.
    """

    progress: float = 10.0
    time: float = 0.02
    action: float = 0.01
    reached: float = 5.0
    failed: float = 5.0

    @classmethod
    def of(cls, changes: Mapping[str, float] | None) -> RewardWeights:
        """Return the weights with some changed.

        Raises
        ------
        ParameterError
            There is no such weight, or it is no finite number.
        """
        known = [each.name for each in fields(cls)]
        for name in changes or {}:
            if name not in known:
                raise ParameterError(
                    f"There is no weight '{name}' of the reward; there are {', '.join(known)}."
                )
        for name, value in (changes or {}).items():
            if not (isinstance(value, numbers.Real) and np.isfinite(value)):
                raise ParameterError(
                    f"The weight '{name}' of the reward is {value!r}: give a finite number."
                )
        return cls(**(changes or {}))


class Task(ABC):
    """A kind of goal: its draws, its errors, and the observations of it.

    Parameters
    ----------
    robot
        The robot.
    link
        Link that reaches, where one does.
    pushed
        Whether actions push the base by a force, and turn it by a torque.
    """

    name: str
    goal_size: int
    tolerance: float
    """Default error within which the goal is reached, rad or m."""
    spread: float
    """Default size of random goals, rad or m."""

    def __init__(
        self, robot: SpaceRobot, link: str = "", pushed: tuple[bool, bool] = (False, False)
    ) -> None:
        self.robot, self.link = robot, link
        self.by_force, self.by_torque = pushed

    @property
    @abstractmethod
    def directions(self) -> Array:
        """Directions (m, 3) in B, orthonormal, in which random goals are drawn.

        Raises
        ------
        ParameterError
            There are none.
        """

    @abstractmethod
    def random_goal(self, start: RobotStates, spread: float, rng: np.random.Generator) -> Array:
        """Return a random goal (goal_size,) for one robot at its start."""

    @abstractmethod
    def remaining(self, states: RobotStates, goals: Array) -> Array:
        """Return the ways to the goals (N, 3) in B: rotation vectors (rad), or distances (m)."""

    @property
    @abstractmethod
    def largest_error(self) -> float:
        """Bound of the entries of :meth:`remaining`."""

    def errors(self, remaining: Array) -> Array:
        """Return the sizes of the errors (N,), rad or m."""
        return np.asarray(np.linalg.norm(remaining, axis=1))

    def observe(self, states: RobotStates, remaining: Array) -> Array:
        """Return observations (N, 9 + 2 n): way to the goal, q, qdot, twist of the base."""
        low, high = self.observation_bounds()
        parts = [remaining, states.q, states.qdot, states.twist]
        return np.clip(np.concatenate(parts, axis=1), low, high)

    def observation_bounds(self) -> tuple[Array, Array]:
        """Return the least and the largest observations (9 + 2 n,)."""
        robot, most = self.robot, LARGEST_OBSERVATION
        error, rest = np.full(3, self.largest_error), np.full(robot.n + 6, most)
        low = np.concatenate([-error, np.maximum(robot.lower, -most), -rest])
        return low, np.concatenate([error, np.minimum(robot.upper, most), rest])


class Reorient(Task):
    """The joints turn the base to a goal attitude; a goal is a quaternion (x, y, z, w) of R_WG."""

    name, goal_size, tolerance, spread = "reorient", 4, 0.01, 0.15
    largest_error = np.pi

    @cached_property
    def directions(self) -> Array:
        """Axes of random turns: one of a planar robot; see :attr:`Task.directions`."""
        axes = BaseRotations.of(self.robot).axes
        if len(axes):
            return axes
        if not self.by_torque:
            raise ParameterError(
                f"The joints of robot '{self.robot.description.name}' cannot rotate its base near "
                "the start, so there are no random goals: give 'max_torque' under "
                "efforts, or take the goal of a scenario (goals: scenario)."
            )
        return np.eye(3)

    def random_goal(self, start: RobotStates, spread: float, rng: np.random.Generator) -> Array:
        """Return an attitude within ``spread`` rad of the start; planar robots turn in plane."""
        axes, axis = self.directions, rng.normal(size=3)
        if len(axes) == 1:
            axis = axes[0] * np.copysign(1.0, axis[0])
        turn = spread * rng.uniform() * axis / np.linalg.norm(axis)
        return quaternion_multiply(start.pose[0, 3:], quaternion_from_rotvec(turn))

    def remaining(self, states: RobotStates, goals: Array) -> Array:
        """Return the rotation vectors (N, 3) from the bases to the goals in B, rad."""
        return rotvecs_from_quaternions(
            quaternion_multiply(quaternion_inverse(states.pose[:, 3:]), goals)
        )


class Reach(Task):
    """A link goes to a position; a goal is a position in W (3,), m."""

    name, goal_size, tolerance, spread = "reach", 3, 0.02, 0.3
    largest_error = LARGEST_OBSERVATION

    @cached_property
    def directions(self) -> Array:
        """Directions in which the link moves, two of a planar robot; :attr:`Task.directions`."""
        robot = self.robot
        if self.by_force:
            return np.eye(3)
        shapes = sample_shapes(robot, _SAMPLED_SHAPE_COUNT)
        ways = np.hstack([robot.generalised_jacobian(self.link, q)[:3] for q in shapes])
        U, sizes, _ = np.linalg.svd(ways, full_matrices=False)
        found = np.asarray(U[:, sizes > _MIN_SHARE_OF_MOTION * max(1.0, sizes[0])].T)
        if not len(found):
            raise ParameterError(
                f"The joints of robot '{robot.description.name}' do not move link '{self.link}', "
                "so there are no random goals: give another 'link'."
            )
        return np.eye(3) if len(found) == 3 else found

    def random_goal(self, start: RobotStates, spread: float, rng: np.random.Generator) -> Array:
        """Return a position within ``spread`` m of where the link starts, where it can go."""
        ways, way = self.directions, rng.normal(size=3)
        if len(ways) < 3:
            R = matrices_from_quaternions(start.pose[:1, 3:])[0]
            way = R @ (ways.T @ way[: len(ways)])
        way *= spread * rng.uniform() ** (1 / len(ways)) / np.linalg.norm(way)
        return np.asarray(self.link_positions(start)[0] + way)

    def remaining(self, states: RobotStates, goals: Array) -> Array:
        """Return the ways (N, 3) from the links to the goals in B, m."""
        R = matrices_from_quaternions(states.pose[:, 3:])
        of_base = np.einsum("nji,nj->ni", R, goals - states.pose[:, :3])
        assert states.link_r is not None
        return np.asarray(of_base - states.link_r)

    def link_positions(self, states: RobotStates) -> Array:
        """Return the positions of the links in W (N, 3), m."""
        R = matrices_from_quaternions(states.pose[:, 3:])
        assert states.link_r is not None
        return np.asarray(states.pose[:, :3] + np.einsum("nij,nj->ni", R, states.link_r))


TASKS: dict[str, type[Task]] = {task.name: task for task in (Reorient, Reach)}
"""Tasks by name."""


def action_scale(robot: SpaceRobot, actuation: str, max_force: float, max_torque: float) -> Array:
    """Return the command of an action of ones: joint rates, or efforts, force (N), torque (N m).

    Raises
    ------
    ParameterError
        A joint has no finite limit.
    """
    limits = robot.velocity_limit if actuation == "velocity" else robot.effort_limit
    for name, limit in zip(robot.joint_names, limits.tolist(), strict=True):
        if not np.isfinite(limit):
            raise ParameterError(
                f"Joint '{name}' has no limit of its {actuation}, which actions are shares of: "
                "state one in its URDF, or give action_scale."
            )
    if actuation == "velocity":
        return limits.copy()
    return np.concatenate([limits, [max_force] * 3, [max_torque] * 3])


def command_of(actions: Any, scale: Array, taken: Sequence[int] | npt.NDArray[np.int64]) -> Array:
    """Return the commands (N, len(scale)) of actions (N, len(taken)), shares from -1 to 1.

    ``taken`` are the entries of commands that actions have; the others are zero.
    """
    shares = np.asarray(actions, dtype=float)
    commands = np.zeros((len(shares), len(scale)))
    commands[:, taken] = np.clip(shares, -1.0, 1.0) * scale[taken]
    return commands
