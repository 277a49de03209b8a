"""Search progress, and announcements of other long-running work.

Listeners receive the progress of all searches in the process, also from planning threads.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum

from spacerobot_ros.model.compilation import announcement_listeners


class SearchPhase(Enum):
    """Phase of a search: find and refine solutions, remove contacts, shorten the result."""

    SEARCHING = "searching"
    REFINING = "refining"
    CLEARING = "clearing"
    SHORTENING = "shortening"


@dataclass(frozen=True)
class SearchProgress:
    """Progress of a search.

    Attributes
    ----------
    starts, max_starts
        Number of initial guesses tried so far, and the largest possible number; a search ends
        earlier if enough solutions agree. Both are 0 if the search does not count guesses.
    best_s
        Duration of the best manoeuvre so far, s; infinite before the first one.
    phase
        Current phase of the search.
    elapsed_s
        Wall time since the search began, s.
    """

    starts: int
    max_starts: int
    best_s: float = math.inf
    phase: SearchPhase = SearchPhase.SEARCHING
    elapsed_s: float = 0.0

    @property
    def message(self) -> str:
        """Progress message without a full stop."""
        best = f"best {self.best_s:.4g} s" if math.isfinite(self.best_s) else "none found yet"
        starts = f"start {self.starts} of at most {self.max_starts}, "
        counted = self.phase is SearchPhase.SEARCHING and self.max_starts > 0
        return f"{self.phase.value}, {starts * counted}{best}"


@dataclass(frozen=True)
class PieceProgress(SearchProgress):
    """Progress of a manoeuvre that is planned in pieces: ``starts`` pieces so far, which take
    ``best_s`` of about ``total_s``, s."""

    total_s: float = math.inf

    @property
    def message(self) -> str:
        """Progress message without a full stop."""
        return f"piece {self.starts}, {self.best_s:.4g} of about {self.total_s:.4g} s"


_BUDGET_FACTOR_WITHOUT_RESULT = 5.0
"""As ``optimal.time_budget`` is documented."""


@dataclass(frozen=True)
class SearchClock:
    """Wall time allowed for a plan, shared by all searches for the plan.

    Attributes
    ----------
    budget
        s; 0: no limit.
    began
        ``time.monotonic()``, s, at the start.
    """

    budget: float = 0.0
    began: float = field(default_factory=lambda: time.monotonic())

    @property
    def elapsed(self) -> float:
        """s."""
        return time.monotonic() - self.began

    def is_over(self, *, found: bool) -> bool:
        """Whether the wall time is used up; ``found``: whether there is a manoeuvre."""
        factor = 1.0 if found else _BUDGET_FACTOR_WITHOUT_RESULT
        return self.budget > 0 and self.elapsed > factor * self.budget


_listeners: list[Callable[[SearchProgress], None]] = []


def log_progress(logger: logging.Logger, progress: SearchProgress, line: str) -> None:
    """Log a message about a search, and report its progress."""
    logger.info(line)
    for show in tuple(_listeners):
        show(progress)


@contextmanager
def report_progress(
    show: Callable[[SearchProgress], None], announce: Callable[[str], None] = lambda message: None
) -> Iterator[None]:
    """While this context is active, call functions with the progress of searches in any thread.

    Parameters
    ----------
    show
        Called with the progress of every search.
    announce
        Called with a message when other long-running work begins.
    """
    _listeners.append(show)
    announcement_listeners.append(announce)
    try:
        yield
    finally:
        _listeners.remove(show)
        announcement_listeners.remove(announce)
