"""The result of planning: the shape at every tick, and the base path that it predicts."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.goal import POSE, Controlled, Goal, PoseError

Notes = dict[str, list[float] | float | str]
"""Named results of a method, for reports."""


@dataclass(frozen=True)
class BasePath:
    """Predicted base: ``time`` (K,) from the start, ``position`` (K, 3), ``quaternion`` (K, 4)."""

    time: Array
    position: Array
    quaternion: Array


@dataclass(frozen=True, repr=False)
class GaitSchedule:
    """A gait as held commands: the shape at each tick, joint velocities constant in between.

    Attributes
    ----------
    method
        Registry name of the method that made it.
    joint_names
        Names of the joints, the columns of ``positions``.
    control_period
        s.
    positions
        (N + 1, n) shape at the ticks 0..N, m or rad.
    path
        Predicted base path at instants of the method's choice, the first and the last included.
    goal
        The goal that it was planned for.
    notes
        Named results of the method, for reports (a paper's symbols where it has them).
    partial
        It ends short of the goal on purpose: the next piece is planned from the pose that is
        measured at its end.
    remaining
        What the schedules after a partial one are expected to take until the goal is reached, s.
    controls
        The parts of the goal that it controls, and by which its result is evaluated.
    progress
        What its method needs to go on with the same goal, of a type of the method's own; see
        ``PlanRequest.previous``.
    """

    method: str
    joint_names: tuple[str, ...]
    control_period: float
    positions: Array
    path: BasePath
    goal: Goal
    notes: Notes = field(default_factory=dict)
    partial: bool = False
    remaining: float = 0.0
    controls: frozenset[Controlled] = POSE
    progress: object = None

    def __repr__(self) -> str:
        error = PoseError.between(self.path.position[-1], self.path.quaternion[-1], self.goal)
        return (
            f"<GaitSchedule by {self.method}: {self.duration:.6g} s in {self.ticks} ticks of "
            f"{self.control_period:g} s for {len(self.joint_names)} joint(s), ends "
            f"{error.distance:.3g} m and {error.angle:.3g} rad from the goal>"
        )

    @property
    def ticks(self) -> int:
        """Number of held commands N."""
        return len(self.positions) - 1

    @property
    def duration(self) -> float:
        """Time the gait takes, s."""
        return self.ticks * self.control_period

    @property
    def expected_duration(self) -> float:
        """Time until the goal is reached, with the schedules that are expected after it, s."""
        return self.duration + self.remaining

    @cached_property
    def velocities(self) -> Array:
        """Held joint velocities (N, n), m/s or rad/s; they carry the shape from tick to tick."""
        return np.diff(self.positions, axis=0) / self.control_period
