"""Time-optimal manoeuvres within real limits, for any free-floating robot.

The manoeuvre is the solution of an optimal control problem (:mod:`.optimal_control`) that begins at
guesses with loops (:mod:`.initial_guesses`), made into held commands that end on the goal
(:mod:`.held_commands`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.parameters import parameter, values_of
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.goal import Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule, Notes
from spacerobot_ros.planning.methods.optimal.constraints import PathConstraints
from spacerobot_ros.planning.methods.optimal.goal_specification import Wishes
from spacerobot_ros.planning.methods.optimal.limits import MotionLimits, per_joint
from spacerobot_ros.planning.methods.optimal.plan_cache import PlanCache, plan_key
from spacerobot_ros.planning.methods.optimal.search import Effort, Found, ManoeuvreSearch

_CORRECTION_INTERVALS = 40

_NOTHING_LEFT = 1e-10
"""A goal this near, rad, m and joint coordinates, is where the robot is."""


@dataclass(frozen=True)
class OptimalOptions:
    """The options of ``optimal``."""

    duration: float = parameter(
        0.0,
        "0: as fast as possible; else least effort in this time",
        unit="s",
        minimum=0.0,
        maximum=1000000000.0,
    )
    max_velocity: tuple[float, ...] = parameter(
        (),
        "of every joint, below the URDF's; []: those",
        unit="m/s or rad/s",
        minimum=0.0,
        maximum=1000000000.0,
        of_joints=True,
    )
    max_acceleration: tuple[float, ...] = parameter(
        (),
        "of every joint; []: by ramp_time",
        unit="m/s^2 or rad/s^2",
        minimum=0.0,
        maximum=1000000000.0,
        of_joints=True,
    )
    ramp_time: float = parameter(
        0.5,
        "from rest to full speed, without max_acceleration",
        unit="s",
        minimum=1e-06,
        maximum=1000000000.0,
    )
    joint_margin: tuple[float, ...] = parameter(
        (),
        "of every joint to its stops; not in corrections",
        unit="m or rad",
        minimum=0.0,
        maximum=1000000000.0,
        of_joints=True,
    )
    base_position: int = parameter(
        0, "0: met if sliders can, 1: met, 2: ignored", minimum=0, maximum=2
    )
    base_attitude: int = parameter(1, "1: met, 0: ignored", minimum=0, maximum=1)
    final_shape: int = parameter(
        0, "without one in the goal: 0: any, 1: the present one", minimum=0, maximum=1
    )
    max_base_rate: float = parameter(
        0.0, "fastest turn of the base; 0: any", unit="rad/s", minimum=0.0, maximum=1000000000.0
    )
    keep_axis: tuple[float, ...] = parameter(
        (),
        "direction in the base that is kept away ...",
        minimum=-1000000000.0,
        maximum=1000000000.0,
    )
    keep_direction: tuple[float, ...] = parameter(
        (), "... from this direction in the world ...", minimum=-1000000000.0, maximum=1000000000.0
    )
    keep_angle: float = parameter(
        0.0, "... by this angle", unit="rad", minimum=0.0, maximum=3.141592653589793
    )
    keep_out: tuple[float, ...] = parameter(
        (),
        "boxes of shapes: lower, then upper corner",
        unit="m or rad",
        minimum=-1000000000.0,
        maximum=1000000000.0,
    )
    intervals: int = parameter(
        80, "steps of the optimal control problem", minimum=10, maximum=10000
    )
    starts: int = parameter(12, "guesses that are tried at most", minimum=1, maximum=10000)
    answers: int = parameter(
        3, "manoeuvres to find, of which the fastest is flown", minimum=1, maximum=10000
    )
    time_budget: float = parameter(
        8.0,
        "wall time to search; 5 times that if nothing is found",
        unit="s",
        minimum=0.1,
        maximum=1000000000.0,
    )
    longest: float = parameter(
        3600.0,
        "longest manoeuvre that is still planned",
        unit="s",
        minimum=1.0,
        maximum=1000000000.0,
    )
    cache: int = parameter(1, "1: manoeuvres are kept on disk", minimum=0, maximum=1)


class OptimalGait(GaitMethod):
    """Minimum time, or least effort in a given time, from rest to rest.

    It meets the attitude; the position where sliders can put the base anywhere, or where it is
    asked to; and the final shape where the goal gives one.
    """

    name: ClassVar[str] = "optimal"
    Options: ClassVar[type[OptimalOptions]] = OptimalOptions
    options: OptimalOptions

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        options: OptimalOptions | None = None,
    ) -> None:
        super().__init__(robot, control_period, integration_step, options)
        chosen = self.options
        self._wishes = Wishes.of(
            robot, chosen.base_position, chosen.base_attitude, chosen.final_shape
        )
        self.controls = self._wishes.controls
        self._limits = MotionLimits.of(
            robot, chosen.max_velocity, chosen.max_acceleration, chosen.ramp_time
        )
        self._margin = _margin(robot, chosen.joint_margin)
        self._constraints = PathConstraints.of(
            robot,
            chosen.max_base_rate,
            chosen.keep_axis,
            chosen.keep_direction,
            chosen.keep_angle,
            chosen.keep_out,
        )
        self._prediction = BasePrediction(robot, control_period, integration_step)
        self._search = ManoeuvreSearch(
            robot, self._prediction, control_period, self._wishes.axes, self._constraints
        )
        self._cache = PlanCache() if chosen.cache else None

    @classmethod
    def objection(cls, robot: SpaceRobot) -> str:
        """Return why no goal of this robot can be planned; see :meth:`GaitMethod.objection`."""
        return Wishes.of(robot).objection(robot)

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan within the time budget; see :meth:`GaitMethod.plan`.

        A correction takes the smallest way instead of the fastest, and may use the margins.
        """
        state, goal, correction = request.state, request.goal, request.correction
        self._require_rest(state)
        # Measured shapes may be a little beyond the stops.
        state = replace(state, q=np.clip(state.q, self.robot.lower, self.robot.upper))
        margin = np.zeros(self.robot.n) if correction else self._margin
        shape = self._goal_shape(goal)
        direction = self._constraints.direction_W
        task = self._wishes.task(
            self.robot, state, goal, shape, self._limits, request.tolerance, direction
        )
        # Where a goal needs the margin, the manoeuvre ends in it.
        limits = self._limits.within(margin, state.q, task.likely)
        if self._is_met(state, goal):
            return self._schedule(state, goal, state.q[np.newaxis], {"starts": 0.0})
        attitude = state.quaternion[np.newaxis]
        broken = self._constraints.violation(state.q[np.newaxis], attitude, self.control_period)
        if broken:
            raise PlanningError(f"The robot is where it must not be: at the start, {broken}.")
        key = None
        if self._cache is not None and not correction:
            key = self._key(state, goal, request.tolerance)
        if self._cache is not None and key is not None and (kept := self._cache.load(key)):
            return self._kept(goal, kept)
        found = self._search.search(
            task,
            limits,
            state.quaternion,
            self._intervals(correction),
            self._effort(correction),
            cancellation,
        )
        schedule = self._schedule(state, goal, found.held.positions, _notes(found))
        if self._cache is not None and key is not None:
            self._cache.store(key, _arrays(schedule))
        return schedule

    def _intervals(self, correction: bool) -> int:
        intervals = int(self.options.intervals)
        return min(intervals, _CORRECTION_INTERVALS) if correction else intervals

    def _effort(self, correction: bool) -> Effort:
        chosen = self.options
        return Effort(
            duration=0.0 if correction else chosen.duration,
            longest=chosen.longest,
            starts=chosen.starts,
            answers=1 if correction else chosen.answers,
            time_budget=chosen.time_budget,
            gentle=correction,
        )

    def _is_met(self, state: RobotState, goal: Goal) -> bool:
        error = PoseError.between(state.position, state.quaternion, goal, state.q)
        nothing = Tolerance(_NOTHING_LEFT, _NOTHING_LEFT, _NOTHING_LEFT)
        return nothing.admits(error, self.controls)

    def _schedule(
        self, state: RobotState, goal: Goal, positions: Array, notes: Notes
    ) -> GaitSchedule:
        path = self._prediction.path(state, positions)
        left = PoseError.between(path.position[-1], path.quaternion[-1], goal)
        notes = {
            **notes,
            "final_shape": positions[-1].tolist(),
            "final_position": path.position[-1].tolist(),
            "predicted_attitude_error": left.angle,
            "predicted_position_error": left.distance,
        }
        return self._schedule_of(goal, positions, path, notes)

    def _key(self, state: RobotState, goal: Goal, tolerance: Tolerance) -> str:
        shape = goal.joint_positions
        numbers = {
            "state": np.concatenate([state.position, state.quaternion, state.q]),
            "goal": np.concatenate([goal.position, goal.quaternion]),
            "shape": np.zeros(0) if shape is None else shape,
            "time": np.array([self.control_period, self.integration_step]),
            "tolerance": np.array([tolerance.position, tolerance.attitude]),
            **vars(self._limits),
        }
        return plan_key(self.robot, numbers, values_of(self.options))

    def _kept(self, goal: Goal, kept: Mapping[str, Array]) -> GaitSchedule:
        path = BasePath(*(kept[f"path_{part}"] for part in _PATH))
        notes: Notes = {
            name.removeprefix(_NOTE): value.tolist()
            for name, value in kept.items()
            if name.startswith(_NOTE)
        }
        return self._schedule_of(goal, kept["positions"], path, {**notes, "from_cache": 1.0})


_PATH = ("time", "position", "quaternion")
_NOTE = "note_"


def _arrays(schedule: GaitSchedule) -> dict[str, Array]:
    """Return what a schedule is made from again."""
    return {
        "positions": schedule.positions,
        **{f"path_{part}": getattr(schedule.path, part) for part in _PATH},
        **{f"{_NOTE}{name}": np.asarray(value) for name, value in schedule.notes.items()},
    }


def _notes(found: Found) -> Notes:
    return {
        "starts": float(found.starts),
        "durations": list(found.answers),
        "solution_time": found.solution_time,
    }


def _margin(robot: SpaceRobot, values: Sequence[float]) -> Array:
    return per_joint(robot, "joint_margin", values) if len(values) else np.zeros(robot.n)
