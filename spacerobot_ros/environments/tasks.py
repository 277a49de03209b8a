"""Environment tasks: goals, observations, rewards, episode ends, and the commands for actions.

All functions take the states of N robots at once, so the same code can observe one robot in a
plant, many robots in lanes, or a robot controlled through ROS topics. NumPy's functions also work
on device arrays, and return device arrays; constants are moved to the device by
``np.asarray(constant, like=array)``. A custom task is a class derived from :class:`Task`.
"""

from __future__ import annotations

import numbers
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_errors,
    matrices_from_quaternions,
    quaternion_multiply,
    quaternions_from_rotvecs,
)
from spacerobot_ros.parameters import require_names
from spacerobot_ros.planning.core.controllability import sample_shapes
from spacerobot_ros.planning.methods.optimal.goal_specification import BaseRotations
from spacerobot_ros.registry import Registry
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.simulation.plant import InitialState

_SAMPLED_SHAPE_COUNT = 12

_MIN_SHARE_OF_MOTION = 1e-7
"""Directions with singular values below this fraction of the largest are treated as immovable."""

Flags = npt.NDArray[np.bool_]
Generators = Sequence[np.random.Generator] | Any
"""A generator for each robot, or the generator of a device for all."""

LARGEST_OBSERVATION = 1e6
"""Bound for observed quantities that have no other bound; observations are clipped to this
value.
"""


@dataclass(frozen=True)
class RobotStates:
    """States of N robots."""

    pose: Array
    """(N, 7) position ``r_WB`` (m) and quaternion ``R_WB`` (x, y, z, w) of the base."""
    twist: Array
    """(N, 6) ``v_WB_B`` (m/s) and ``omega_WB_B`` (rad/s)."""
    q: Array
    """(N, n) joint positions."""
    qdot: Array
    """(N, n) joint velocities."""
    link_r: Array | None = None
    """(N, 3) position in B of the task's link, m; None if the task has no link."""

    def __getitem__(self, rows: slice | npt.NDArray[np.int64]) -> RobotStates:
        """Return the states of some robots."""
        link_r = None if self.link_r is None else self.link_r[rows]
        return RobotStates(self.pose[rows], self.twist[rows], self.q[rows], self.qdot[rows], link_r)


@dataclass(frozen=True)
class Step:
    """One step of N robots."""

    before: RobotStates
    """States before the step."""
    after: RobotStates
    """States after the step."""
    goals: Array
    """(N, goal_size) their goals."""
    actions: Array
    """(N, entries) fractions from -1 to 1 of the largest command."""
    errors_before: Array
    """(N,) errors before the step; see :meth:`Task.errors`."""
    errors: Array
    """(N,) errors after the step."""
    reached: Flags
    """(N,) whether the goal is reached."""
    failed: Flags
    """(N,) whether the episode ends without reaching the goal."""
    duration: float
    """Simulated time, s."""


@dataclass(frozen=True)
class RewardWeights:
    """Weights of the step reward terms."""

    progress: float = 10.0
    """Reward per rad or m of decrease in the error."""
    time: float = 0.02
    """Penalty per s."""
    action: float = 0.01
    """Penalty per second; it is multiplied by the mean square of the action entries."""
    reached: float = 5.0
    """One-time reward in the step in which the goal is reached."""
    failed: float = 5.0
    """One-time penalty if the flight cannot continue."""

    @classmethod
    def of(cls, changes: Mapping[str, float] | None) -> RewardWeights:
        """Return the weights with some changes; raise ParameterError if a change is invalid."""
        require_names("The reward has no weight", changes or {}, [x.name for x in fields(cls)])
        for name, value in (changes or {}).items():
            if not (isinstance(value, numbers.Real) and np.isfinite(value)):
                raise ParameterError(
                    f"The reward weight '{name}' is {value!r}: use a finite number."
                )
        return cls(**(changes or {}))


class Task(ABC):
    """A task type: its random goals, errors, observations and rewards.

    Subclasses define a name, :attr:`goal_size`, :meth:`random_goal` and :meth:`remaining`, and
    override other members as needed.

    Parameters
    ----------
    robot
        The robot.
    link
        Link from argument ``link`` or from the scenario, else the end-effector; empty: no link.
    pushed
        Whether actions include a base force and a base torque.
    """

    name: ClassVar[str]
    goal_size: ClassVar[int]
    """Number of entries in a goal."""
    scenario: ClassVar[str] = "arm_attitude"
    """Default scenario."""
    weights: ClassVar[type[RewardWeights]] = RewardWeights
    """Class of the reward weights; a subclass may define additional weights."""
    has_link: ClassVar[bool] = False
    """Whether the task has a link; if so, its position is in :attr:`RobotStates.link_r`."""
    tolerance: float = 0.01
    """Default for the largest error at which the goal is reached."""
    spread: float = 1.0
    """Default of the largest displacement to a random goal."""
    error_size: int = 3
    """Number of entries in :meth:`remaining`."""
    largest_error: float = LARGEST_OBSERVATION
    """Upper bound on the absolute values of the entries of :meth:`remaining`."""

    def __init__(
        self, robot: SpaceRobot, link: str = "", pushed: tuple[bool, bool] = (False, False)
    ) -> None:
        self.robot, self.link = robot, link
        self.by_force, self.by_torque = pushed

    @abstractmethod
    def random_goal(self, start: RobotStates, spread: float, rng: np.random.Generator) -> Array:
        """Return a random goal (goal_size,) for one robot at its start."""

    def random_goals(self, starts: RobotStates, spread: float, rngs: Generators) -> Array:
        """Return random goals (N, goal_size) for N robots, each from its own generator; on a
        device, all from one."""
        each = (self.random_goal(starts[i : i + 1], spread, rng) for i, rng in enumerate(rngs))
        return np.array(list(each))

    @abstractmethod
    def remaining(self, states: RobotStates, goals: Array) -> Array:
        """Return the remaining errors (N, error_size): rotation vectors (rad) or displacements
        (m).
        """

    def start(self, initial: InitialState, rng: np.random.Generator) -> InitialState:
        """Return the initial state of an episode, given the state in the scenario or the draw."""
        return initial

    def goal_of(self, scenario: Scenario) -> Array:
        """Return a scenario's goal (goal_size,).

        Raises
        ------
        ParameterError
            The scenario has no goal for this task.
        """
        raise ParameterError(
            f"Scenario '{scenario.name}' has no goal for task '{self.name}': use random goals."
        )

    def checked_goals(self, goals: Array) -> Array:
        """Return the given goals (N, goal_size) in the form used by the task.

        Raises
        ------
        ParameterError
            A goal is invalid.
        """
        return goals

    def goal_poses(self, states: RobotStates, goals: Array) -> Array | None:
        """Return the poses (N, 7) in W at which pictures show the goals; None: goals are not
        shown.
        """
        return None

    def errors(self, remaining: Array) -> Array:
        """Return the error magnitudes (N,)."""
        return np.linalg.norm(remaining, axis=1)

    def reached(self, states: RobotStates, errors: Array, tolerance: float) -> Flags:
        """Return which goals are reached (N,); a reached goal ends its episode."""
        return errors <= tolerance

    def failed(self, states: RobotStates, goals: Array) -> Flags:
        """Return which episodes fail (N,), apart from those whose flights cannot continue."""
        return np.zeros_like(states.pose[:, 0], dtype=np.bool_)

    def reward(self, step: Step, weights: Any) -> Array:
        """Return the rewards (N,) for a step."""
        reward = weights.progress * (step.errors_before - step.errors)
        square = np.mean(step.actions**2, axis=1)
        reward -= step.duration * (weights.time + weights.action * square)
        return reward + weights.reached * step.reached - weights.failed * step.failed

    def observe(self, states: RobotStates, remaining: Array) -> Array:
        """Return observations: remaining error, q, qdot and base twist."""
        seen = np.concatenate([remaining, states.q, states.qdot, states.twist], axis=1)
        bounds = (np.asarray(x, seen.dtype, like=seen) for x in self.observation_bounds())
        return np.clip(seen, *bounds)

    def observation_bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the observations (error_size + 2 n + 6,)."""
        robot, most = self.robot, LARGEST_OBSERVATION
        error, rest = np.full(self.error_size, self.largest_error), np.full(robot.n + 6, most)
        low = np.concatenate([-error, np.maximum(robot.lower, -most), -rest])
        return low, np.concatenate([error, np.minimum(robot.upper, most), rest])


class _DrawnTogether(Task):
    """A task whose random goals are drawn for all robots at once."""

    def random_goal(self, start: RobotStates, spread: float, rng: np.random.Generator) -> Array:
        return np.asarray(self.random_goals(start[:1], spread, [rng])[0])


def _directions_and_shares(rngs: Generators, count: int) -> tuple[Array, Array]:
    """Return isotropic random vectors (N, 3), and random numbers (N, 1) from 0 to 1."""
    if not isinstance(rngs, Sequence):
        return rngs.standard_normal((count, 3)), rngs.random((count, 1))
    drawn = np.array([(*rng.standard_normal(3), rng.random()) for rng in rngs])
    return drawn[:, :3], drawn[:, 3:]


class Reorient(_DrawnTogether):
    """The joints rotate the base to a goal attitude ``R_WG``, given as a quaternion (x, y, z,
    w).
    """

    name, goal_size, tolerance, spread = "reorient", 4, 0.01, 0.15
    largest_error = np.pi

    @cached_property
    def _directions(self) -> Array:
        """Axes of random rotations (m, 3) in B, orthonormal: one axis for a planar robot."""
        axes = BaseRotations.of(self.robot).axes
        if len(axes):
            return axes
        if not self.by_torque:
            raise ParameterError(
                f"The joints of robot '{self.robot.description.name}' cannot rotate its base near "
                "the start, so there are no random goals: set 'max_torque' for effort actuation, "
                "or use the scenario goal (goals: scenario)."
            )
        return np.eye(3)

    def random_goals(self, starts: RobotStates, spread: float, rngs: Generators) -> Array:
        """Return attitudes within ``spread`` rad of the starts; planar robots rotate in their
        plane."""
        turns, shares = _directions_and_shares(rngs, len(starts.pose))
        axes = np.asarray(self._directions, like=turns)
        if len(axes) == 1:
            turns = axes[0] * np.copysign(1.0, turns[:, :1])
        turns = spread * shares * turns / np.linalg.norm(turns, axis=1, keepdims=True)
        return quaternion_multiply(starts.pose[:, 3:], quaternions_from_rotvecs(turns))

    def remaining(self, states: RobotStates, goals: Array) -> Array:
        """Return the rotation vectors (N, 3), rad, from base to goal attitudes, in B."""
        return attitude_errors(states.pose[:, 3:], goals)

    def goal_of(self, scenario: Scenario) -> Array:
        """Return the base's goal attitude."""
        return scenario.goal.quaternion

    def checked_goals(self, goals: Array) -> Array:
        """Return unit quaternions; see :meth:`Task.checked_goals`."""
        sizes = np.linalg.norm(goals, axis=1, keepdims=True)
        if sizes.min() < 1e-3:
            raise ParameterError("The goal quaternion is zero, which is not an attitude.")
        return np.asarray(goals / sizes)

    def goal_poses(self, states: RobotStates, goals: Array) -> Array:
        """Return the goal attitudes at the base positions."""
        return np.hstack([states.pose[:, :3], goals])


class Reach(_DrawnTogether):
    """A link reaches a goal position (3,) in W, m."""

    name, goal_size, tolerance, spread = "reach", 3, 0.02, 0.3
    scenario, has_link = "reach", True

    @cached_property
    def _directions(self) -> Array:
        """Directions (m, 3) in B, orthonormal, in which the link moves: two for a planar robot."""
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
                "so there are no random goals: set another 'link'."
            )
        return np.eye(3) if len(found) == 3 else found

    def random_goals(self, starts: RobotStates, spread: float, rngs: Generators) -> Array:
        """Return positions within ``spread`` m of the initial link positions, in the directions in
        which the links can move.
        """
        ways, shares = _directions_and_shares(rngs, len(starts.pose))
        axes = np.asarray(self._directions, like=ways)
        if len(axes) < 3:
            R = matrices_from_quaternions(starts.pose[:, 3:])
            ways = np.einsum("nij,nj->ni", R, ways[:, : len(axes)] @ axes)
        distances = spread * shares ** (1 / len(axes))
        ways *= distances / np.linalg.norm(ways, axis=1, keepdims=True)
        return self.link_positions(starts) + ways

    def remaining(self, states: RobotStates, goals: Array) -> Array:
        """Return the displacements (N, 3), m, from link to goal, in B."""
        R = matrices_from_quaternions(states.pose[:, 3:])
        of_base = np.einsum("nji,nj->ni", R, goals - states.pose[:, :3])
        assert states.link_r is not None
        return of_base - states.link_r

    def goal_of(self, scenario: Scenario) -> Array:
        """Return the link's goal position; see :meth:`Task.goal_of`."""
        for each in scenario.goal.end_effectors:
            if each.link == self.link:
                return each.position
        if scenario.end_effector_goal is None:
            raise ParameterError(
                f"Scenario '{scenario.name}' has no goal for link '{self.link}': use random goals."
            )
        return scenario.end_effector_goal.position

    def goal_poses(self, states: RobotStates, goals: Array) -> Array:
        """Return goal poses with the attitude of the world frame."""
        return np.hstack([goals, np.tile([0.0, 0.0, 0.0, 1.0], (len(goals), 1))])

    def link_positions(self, states: RobotStates) -> Array:
        """Return the link positions in W (N, 3), m."""
        R = matrices_from_quaternions(states.pose[:, 3:])
        assert states.link_r is not None
        return states.pose[:, :3] + np.einsum("nij,nj->ni", R, states.link_r)


TASKS: Registry[Task] = Registry(
    "task", "spacerobot_ros.environment_tasks", Task, (Reorient, Reach)
)
"""Tasks by name; the registry's :meth:`~.Registry.register` adds custom tasks."""
TASKS.load()


def action_scale(robot: SpaceRobot, actuation: str, max_force: float, max_torque: float) -> Array:
    """Return the command for an action whose entries are all 1: joint rates; or joint efforts,
    force (N) and torque (N m).

    Raises
    ------
    ParameterError
        A joint has no finite limit.
    """
    limits = robot.velocity_limit if actuation == "velocity" else robot.effort_limit
    for name, limit in zip(robot.joint_names, limits.tolist(), strict=True):
        if not np.isfinite(limit):
            raise ParameterError(
                f"Joint '{name}' has no {actuation} limit, and actions are fractions of this "
                f"limit: set the limit in the URDF, or set action_scale."
            )
    if actuation == "velocity":
        return limits.copy()
    return np.concatenate([limits, [max_force] * 3, [max_torque] * 3])


def command_of(actions: Any, scale: Array, taken: Sequence[int] | npt.NDArray[np.int64]) -> Array:
    """Return the commands (N, len(scale)) for actions (N, len(taken)), which are fractions from -1
    to 1.

    ``taken`` are the command entries set by actions; the others are zero.
    """
    shares = actions if hasattr(actions, "ndim") else np.asarray(actions, dtype=float)
    commands = np.zeros_like(scale, shape=(len(shares), len(scale)))
    commands[:, taken] = np.clip(shares, -1.0, 1.0) * scale[taken]
    return commands
