"""Time-optimal manoeuvres within real limits, for any free-floating robot.

The manoeuvre is the solution of an optimal control problem (:mod:`.multiple_shooting`) that begins
at guesses with loops (:mod:`.initial_guesses`), made into held commands that end on the goal
(:mod:`.held_commands`).
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import casadi as ca
import numpy as np

from spacerobot_ros import __version__
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import cache_directory
from spacerobot_ros.model.description import Array
from spacerobot_ros.parameters import values_of
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.goal import Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule, Notes
from spacerobot_ros.planning.methods.optimal.goal_specification import GoalSpecification
from spacerobot_ros.planning.methods.optimal.options import OptimalOptions
from spacerobot_ros.planning.methods.optimal.problem import (
    CandidateError,
    MotionLimits,
    PathConstraints,
    per_joint,
)
from spacerobot_ros.planning.methods.optimal.search import ManoeuvreSearch, SearchBudget

_LOG = logging.getLogger(__name__)

_CORRECTION_INTERVALS = 40

_NOTHING_LEFT = 1e-10
"""A goal this near, rad, m and joint coordinates, is where the robot is."""


class OptimalGait(GaitMethod):
    """Minimum time, or least effort in a given time, from rest to rest.

    It reaches the attitude; the position where sliders can put the base anywhere, or where the
    options ask for it; and the final shape where the goal gives one. The search has a budget of
    wall time: equal requests have equal schedules as long as it is not used up.
    """

    name: ClassVar[str] = "optimal"
    Options: ClassVar[type[OptimalOptions]] = OptimalOptions
    options: OptimalOptions

    def _setup(self) -> None:
        robot, chosen = self.robot, self.options
        self._specification = GoalSpecification.of(robot, chosen)
        self.controls = self._specification.controls
        self._limits = MotionLimits.of(robot, chosen)
        self._margin = np.zeros(robot.n)
        if chosen.joint_margin:
            self._margin = per_joint(robot, "joint_margin", chosen.joint_margin)
        self._constraints = PathConstraints.of(robot, chosen)
        self._prediction = BasePrediction(robot, self.control_period, self.integration_step)
        self._search = ManoeuvreSearch(
            robot,
            self._prediction,
            self.control_period,
            self._specification.axes,
            self._constraints,
        )
        self._cache = PlanCache() if chosen.cache else None

    @classmethod
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Refuse robots that cannot turn their base; see :meth:`GaitMethod.require_suitable`."""
        GoalSpecification.of(robot, OptimalOptions()).require_suitable(robot)

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan within the time budget; see :meth:`GaitMethod.plan`.

        A correction takes the smallest way instead of the fastest, and may use the margins.
        """
        self._require_rest(request.state)
        # Measured shapes may be a little beyond the joint limits.
        q = np.clip(request.state.q, self.robot.lower, self.robot.upper)
        state, goal, correction = replace(request.state, q=q), request.goal, request.correction
        request = replace(request, state=state)
        margin = np.zeros(self.robot.n) if correction else self._margin
        boundary = self._specification.boundary_conditions(
            self.robot,
            request,
            self._goal_shape(goal),
            self._limits,
            self._constraints.direction_W,
        )
        # Where a goal needs the margin, the manoeuvre ends in it.
        limits = self._limits.within(margin, q, boundary.likely)
        if self._is_reached(state, goal):
            return self._schedule(state, goal, q[np.newaxis], {"starts": 0.0})
        attitude = state.quaternion[np.newaxis]
        try:
            self._constraints.check(q[np.newaxis], attitude, self.control_period)
        except CandidateError as reason:
            raise PlanningError(
                f"The robot is where it must not be: at the start, {reason}."
            ) from None
        key = None
        if self._cache is not None and not correction:
            key = self._key(request)
            if kept := self._cache.load(key):
                return self._loaded(goal, kept)
        found = self._search.search(
            boundary,
            limits,
            state.quaternion,
            self._intervals(correction),
            self._budget(correction),
            cancellation,
        )
        notes: Notes = {
            "starts": float(found.starts),
            "durations": list(found.solutions),
            "solution_time": found.solution_time,
        }
        schedule = self._schedule(state, goal, found.held.positions, notes)
        if self._cache is not None and key is not None:
            self._cache.store(key, _arrays(schedule))
        return schedule

    def _intervals(self, correction: bool) -> int:
        intervals = self.options.intervals
        return min(intervals, _CORRECTION_INTERVALS) if correction else intervals

    def _budget(self, correction: bool) -> SearchBudget:
        chosen = self.options
        return SearchBudget(
            duration=0.0 if correction else chosen.duration,
            longest=chosen.longest,
            starts=chosen.starts,
            solutions=1 if correction else chosen.answers,
            time_budget=chosen.time_budget,
            gentle=correction,
        )

    def _is_reached(self, state: RobotState, goal: Goal) -> bool:
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

    def _key(self, request: PlanRequest) -> str:
        state, goal, tolerance = request.state, request.goal, request.tolerance
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

    def _loaded(self, goal: Goal, kept: Mapping[str, Array]) -> GaitSchedule:
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


class PlanCache:
    """Arrays by a key; a file that cannot be read or written is as good as none."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or cache_directory() / "plans"

    def load(self, key: str) -> dict[str, Array] | None:
        """Return what was stored under a key, or None."""
        try:
            # A file that is opened here is closed where it turns out to be broken, too.
            with self._file(key).open("rb") as file, np.load(file) as content:
                return {name: content[name] for name in content.files}
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            _LOG.warning("The plan %s cannot be read and is made anew: %s", self._file(key), error)
            return None

    def store(self, key: str, arrays: Mapping[str, Array]) -> None:
        """Keep arrays under a key."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.folder, delete=False) as file:
                np.savez(file, allow_pickle=False, **arrays)
            # Whole or not at all, even if two processes write it.
            os.replace(file.name, self._file(key))
        except OSError as error:
            _LOG.warning("The plan cannot be saved in %s: %s", self.folder, error)

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


def plan_key(robot: SpaceRobot, numbers: Mapping[str, Array], options: Mapping[str, object]) -> str:
    """Return the name of a plan: a hash of the robot's equations and of the request."""
    digest = hashlib.sha256()
    for name in ("locked_inertia", "center_of_mass"):
        digest.update(robot.function(name, compile=False).serialize().encode())
    facts = {
        "versions": [__version__, ca.__version__, np.__version__],
        "joints": robot.joint_names,
        "options": options,
        "numbers": {
            name: [x.hex() for x in map(float, np.ravel(v))] for name, v in numbers.items()
        },
    }
    digest.update(json.dumps(facts, sort_keys=True, default=repr).encode())
    return digest.hexdigest()[:32]
