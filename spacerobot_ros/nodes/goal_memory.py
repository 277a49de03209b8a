"""The goal that a planner flies to, kept where its own end does not reach."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.planning import Goal


class GoalMemory:
    """A file that holds the present goal while it is flown; a planner that starts again goes on.

    Parameters
    ----------
    path
        The file; empty: nothing is kept.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path) if path else None

    def keep(self, goal: Goal) -> None:
        """Write the goal down, as a whole or not at all.

        Raises
        ------
        ParameterError
            The file cannot be written.
        """
        if self._path is None:
            return
        shape = None if goal.joint_positions is None else goal.joint_positions.tolist()
        text = json.dumps(
            {
                "position": goal.position.tolist(),
                "quaternion": goal.quaternion.tolist(),
                "joint_positions": shape,
            }
        )
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
        """Forget the goal: it is met, or given up."""
        if self._path is not None:
            with suppress(OSError):
                self._path.unlink()

    def recall(self) -> Goal | None:
        """Return the goal that was flown to when its planner ended, None if there was none.

        Raises
        ------
        ParameterError
            The file holds something else.
        """
        if self._path is None or not self._path.is_file():
            return None
        try:
            values = json.loads(self._path.read_text(encoding="utf-8"))
            return Goal.checked(values["position"], values["quaternion"], values["joint_positions"])
        except (OSError, ValueError, KeyError, TypeError, PlanningError) as error:
            raise ParameterError(
                f"Parameter 'resume_file' is '{self._path}', which holds no goal: {error}."
            ) from error
