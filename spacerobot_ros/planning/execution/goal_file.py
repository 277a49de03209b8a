"""Goals with ids, and the file from which a restarted commander loads its goals."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.files import UntrustedFileError, read_private, write_whole
from spacerobot_ros.planning.core.goal import NO_TOLERANCE, POSE, EndEffectorGoal, Goal, Tolerance

BASE_GOAL_KEY = "base"
"""Key of the base goal in the file."""


@dataclass(frozen=True)
class IdentifiedGoal:
    """A goal and its id in status messages.

    Attributes
    ----------
    goal
        The goal.
    goal_id
        Goal id; empty if unknown.
    tolerance
        Its tolerance; None: the commander's parameters.
    resumes
        Whether a restarted commander resumes the goal. Action goals are not resumed: their clients
        are notified when the commander stops.
    required
        Tolerances given by the sender, for components that must be controlled; 0: none.
    """

    goal: Goal
    goal_id: str = ""
    tolerance: Tolerance | None = None
    resumes: bool = True
    required: Tolerance = NO_TOLERANCE


@dataclass(frozen=True)
class PursuedGoals:
    """Report from an executive: the goals pursued from now on, by frame."""

    goals: Mapping[str, IdentifiedGoal]


class GoalIds:
    """Assigns ids to the goal poses received by a node."""

    def __init__(self) -> None:
        self._unstamped = 0

    def of(self, sec: int, nanosec: int) -> str:
        """Return the id of a goal pose with this header stamp.

        The id is the stamp, ``"<sec>.<nanosec, nine digits>"``; a goal without a stamp (zero) gets
        ``"unstamped-<n>"``, where n counts the goals without a stamp.
        """
        if sec or nanosec:
            return f"{sec}.{nanosec:09d}"
        self._unstamped += 1
        return f"unstamped-{self._unstamped}"


class GoalFile:
    """A file with a commander's current goals; reached and abandoned goals are removed.

    A restarted commander resumes them. Reports update the file: :meth:`pursue` and :meth:`end`.

    Parameters
    ----------
    path
        The file; if empty, nothing is saved or loaded.
    keys
        Allowed goal keys; a file with other keys is rejected.
    """

    def __init__(self, path: str, keys: tuple[str, ...] = (BASE_GOAL_KEY,)) -> None:
        self._path = Path(path) if path else None
        self._keys = keys
        self._ids: frozenset[str] = frozenset()
        """Goal ids in the file."""
        self._waiting: dict[str, IdentifiedGoal] = {}
        """Goals in the file that are not pursued yet."""

    def add_waiting(self, key: str, goal: IdentifiedGoal) -> None:
        """Write a goal that waits to be pursued, unless the file contains goals being pursued."""
        if not self._ids or self._waiting:
            waiting = {**self._waiting, key: goal}
            self.pursue(PursuedGoals(waiting))
            self._waiting = waiting

    def pursue(self, pursued: PursuedGoals) -> str:
        """Atomically write the goals to resume; return a message if that fails, else empty text."""
        self._waiting = {}
        kept = {key: goal for key, goal in pursued.goals.items() if goal.resumes}
        self._ids = frozenset(goal.goal_id for goal in kept.values())
        if not kept:
            self.delete()
        if self._path is None or not kept:
            return ""
        text = json.dumps({key: encode_goal(goal) for key, goal in kept.items()})
        try:
            write_whole(self._path, text.encode())
        except OSError as error:
            return (
                f"Parameter 'resume_file' is '{self._path}', which cannot be written: "
                f"{error.strerror or error}. The goal is pursued, but will not be resumed after a "
                "restart."
            )
        return ""

    def end(self, goal_id: str, *, refused: bool) -> None:
        """Delete the file when a goal ends, unless a goal that is not in the file was rejected."""
        if self._ids and (goal_id in self._ids or not refused):
            self.delete()

    def delete(self) -> None:
        """Delete the file, because its goals were reached, failed or aborted."""
        self._ids, self._waiting = frozenset(), {}
        if self._path is not None:
            with suppress(OSError):
                self._path.unlink()

    def load(self) -> dict[str, IdentifiedGoal]:
        """Return the goals that a commander was pursuing when it ended; empty if there is no file.

        Raises
        ------
        ParameterError
            The file has invalid content, or other users could have written it.
        """
        if self._path is None:
            return {}
        try:
            goals = self._parse_goals(read_private(self._path).decode())
            self._ids = frozenset(goal.goal_id for goal in goals.values())
            self._waiting = goals
            return goals
        except FileNotFoundError:
            return {}
        except UntrustedFileError as error:
            raise ParameterError(
                f"Parameter 'resume_file' is '{self._path}', whose goal is invalid: {error}"
            ) from error
        except (OSError, ValueError, RecursionError, PlanningError) as error:
            why = str(error).rstrip(".")
            raise ParameterError(
                f"Parameter 'resume_file' is '{self._path}', which contains no valid goals: {why}."
            ) from error

    def _parse_goals(self, text: str) -> dict[str, IdentifiedGoal]:
        entries = json.loads(text)
        if not isinstance(entries, dict) or not entries:
            raise ValueError("it names none")
        for key in entries:
            if key not in self._keys:
                raise ValueError(f"'{key}' is not one of {', '.join(self._keys)}")
        try:
            return {
                key: IdentifiedGoal(
                    decode_goal(entry),
                    # Files of earlier versions have no goal ids.
                    str(entry.get("id", "")),
                )
                for key, entry in entries.items()
            }
        except (KeyError, TypeError) as error:
            raise ValueError(
                "a goal must have 'position', 'quaternion' and 'joint_positions' (null: any shape)"
            ) from error


def decode_goal(entry: Mapping[str, Any]) -> Goal:
    """Return the goal of :func:`encode_goal`; raises `KeyError` or `TypeError` if invalid."""
    goal = Goal.checked(entry["position"], entry["quaternion"], entry["joint_positions"])
    asked = entry.get("asked", POSE)
    goal = replace(goal, asked=frozenset(part for part in POSE if part in asked))
    if "waypoints" in entry:
        given = Goal.through([*entry["waypoints"], goal.path_values[0].tolist()])
        goal = replace(goal, waypoints=given.waypoints)
    if "end_effectors" not in entry:
        return goal
    goals = [EndEffectorGoal.of_numbers(*each) for each in entry["end_effectors"].items()]
    parts = frozenset(part for part in POSE if part in entry["base"])
    return replace(goal, end_effectors=Goal.of_end_effectors(goals).end_effectors, base=parts)


def encode_goal(identified: IdentifiedGoal) -> dict[str, Any]:
    """Return a goal as JSON-compatible values."""
    goal = identified.goal
    shape = goal.joint_positions
    entry: dict[str, Any] = {
        "position": goal.position.tolist(),
        "quaternion": goal.quaternion.tolist(),
        "joint_positions": None if shape is None else shape.tolist(),
    }
    if goal.waypoints is not None:
        entry["waypoints"] = goal.waypoints.tolist()
    if goal.asked != POSE:
        entry["asked"] = sorted(goal.asked)
    if goal.end_effectors:
        entry["end_effectors"] = {each.link: each.numbers for each in goal.end_effectors}
        entry["base"] = sorted(goal.base)
    return {**entry, "id": identified.goal_id} if identified.goal_id else entry
