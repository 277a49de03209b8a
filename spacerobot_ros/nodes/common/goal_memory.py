"""The goals that a commander flies to, kept where its own end does not reach."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.planning import Goal

BASE = "base"
"""What the goal of the base is kept as."""


class GoalMemory:
    """A file that holds the present goals while they are flown to; who starts again goes on.

    Parameters
    ----------
    path
        The file; empty: nothing is kept.
    names
        What goals may be of; a file with others is somebody else's.
    """

    def __init__(self, path: str, names: tuple[str, ...] = (BASE,)) -> None:
        self._path = Path(path) if path else None
        self._names = names

    def keep(self, goals: Mapping[str, Goal]) -> None:
        """Write goals by name in place of those before, as a whole or not at all.

        Raises
        ------
        ParameterError
            The file cannot be written.
        """
        if self._path is None:
            return
        text = json.dumps({name: _values(goal) for name, goal in goals.items()})
        whole = self._path.with_name(f"{self._path.name}.new")
        try:
            whole.write_text(text, encoding="utf-8")
            os.replace(whole, self._path)
        except OSError as error:
            raise ParameterError(
                f"Parameter 'resume_file' is '{self._path}', which cannot be written: "
                f"{error.strerror or error}."
            ) from error

    def forget(self) -> None:
        """Forget the goals: they are met, or given up."""
        if self._path is not None:
            with suppress(OSError):
                self._path.unlink()

    def recall(self) -> dict[str, Goal]:
        """Return by name the goals that were flown to when their commander ended, if any.

        Raises
        ------
        ParameterError
            The file holds something else.
        """
        if self._path is None:
            return {}
        try:
            goals = self._read(self._path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError, PlanningError) as error:
            why = str(error).rstrip(".")
            raise ParameterError(
                f"Parameter 'resume_file' is '{self._path}', which holds no goal: {why}."
            ) from error
        return goals

    def _read(self, text: str) -> dict[str, Goal]:
        values = json.loads(text)
        if not isinstance(values, dict) or not values:
            raise ValueError("it names none")
        for name in values:
            if name not in self._names:
                raise ValueError(f"'{name}' is not one of {', '.join(self._names)}")
        try:
            return {
                name: Goal.checked(goal["position"], goal["quaternion"], goal["joint_positions"])
                for name, goal in values.items()
            }
        except (KeyError, TypeError) as error:
            raise ValueError(
                "a goal has 'position', 'quaternion' and 'joint_positions' (null: any shape)"
            ) from error


def _values(goal: Goal) -> dict[str, list[float] | None]:
    shape = goal.joint_positions
    return {
        "position": goal.position.tolist(),
        "quaternion": goal.quaternion.tolist(),
        "joint_positions": None if shape is None else shape.tolist(),
    }
