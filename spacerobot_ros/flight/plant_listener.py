"""The plant's status as a commander needs it: whether it obeys, and events such as resets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.times import SECOND


@dataclass(frozen=True)
class Stopped:
    """The plant does not do what it is commanded.

    Attributes
    ----------
    why
        The plant's sentence.
    commanded_until_ns
        Where it rests because no command came: the stamp of the last one; None: it obeys nothing.
    rests_since_ns
        Since when it rests then, as far as is known.
    """

    why: str
    commanded_until_ns: int | None = None
    rests_since_ns: int = 0


class Change(Enum):
    """What else a plant reports."""

    OBEYS = "obeys"
    """Commands pass again."""
    RESET = "reset"
    """The robot is back in its initial state."""


class PlantListener:
    """What a commander knows of its plant from plant/status; nothing, if none is published."""

    def __init__(self) -> None:
        self._status: PlantStatus | None = None
        self._name = "plant"

    @property
    def blocked(self) -> str:
        """Why no goal is accepted now, as a sentence; empty: goals are."""
        status = self._status
        if status is None:
            return ""
        if status.latched_fault:
            return f"The plant is latched: {status.latched_fault}; call '{self._name}/rearm' first."
        if status.state is PlantState.FAILED:
            return f"The plant has failed: {status.message}"
        return ""

    @property
    def rests(self) -> bool:
        """Whether no command is in force: none has come, or none is obeyed."""
        status = self._status
        return status is not None and (status.state is PlantState.RESTING or bool(self.blocked))

    @property
    def paused(self) -> bool:
        """Whether the plant's time stands still."""
        return self._status is not None and self._status.state is PlantState.PAUSED

    def take(self, status: PlantStatus, name: str = "plant") -> list[Stopped | Change]:
        """Take up a status of the plant of this name; return what a commander has to do about it.

        Statuses may be missed: the counters of a plant tell what has happened in between.
        """
        before, was_blocked = self._status, bool(self.blocked)
        self._status, self._name = status, name
        news: list[Stopped | Change] = []
        if self.blocked:
            if before is None or not was_blocked or status.latched_fault != before.latched_fault:
                news.append(Stopped(status.message))
            return news
        if before is None:
            return news
        if status.rearms > before.rearms and not was_blocked:
            news.append(Stopped("Commands pass again after a fault was latched."))
        if status.timeouts > before.timeouts or (
            status.reason == "timeout" and before.reason != "timeout"
        ):
            rested = _rested(status)
            if rested is not None:
                news.append(rested)
        if status.resets > before.resets:
            news.append(Change.RESET)
        if was_blocked or status.rearms > before.rearms:
            news.append(Change.OBEYS)
        return news


def _rested(status: PlantStatus) -> Stopped | None:
    """Return that a plant rests, or has rested meanwhile; None if its times are nonsense."""
    last, since = status.last_command_s, status.time_s
    last = since if last is None else last
    why = status.message
    if status.reason != "timeout":
        since, why = last, "The joints were brought to rest: no command came in time."
    if not (math.isfinite(last) and math.isfinite(since)):
        return None
    return Stopped(why, round(last * SECOND), round(since * SECOND))
