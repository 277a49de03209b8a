"""Search progress, and announcements of other long-running work.

A search writes its progress to the log, in a record recognised by :func:`report_progress`. So the
progress passes through methods that do not handle it, and out of planning threads.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum

from spacerobot_ros.model.compilation import ANNOUNCEMENT_ATTRIBUTE

_RECORD_ATTRIBUTE = "search_progress"
_PACKAGE = "spacerobot_ros"


class SearchPhase(Enum):
    """Phase of a search: finding solutions, refining them, removing contacts, and shortening the
    result.
    """

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
        Number of initial guesses tried so far, and the largest number: a search ends earlier if
        enough solutions agree. 0 and 0 if the search does not count them.
    best_s
        Duration of the best manoeuvre so far, s; infinite before the first one.
    phase
        What the search does.
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


def log_progress(logger: logging.Logger, progress: SearchProgress, line: str) -> None:
    """Log a message about a search, with its progress."""
    logger.info(line, extra={_RECORD_ATTRIBUTE: progress})


@contextmanager
def report_progress(
    show: Callable[[SearchProgress], None], announce: Callable[[str], None] = lambda message: None
) -> Iterator[None]:
    """Call functions with the progress of searches running in this context, in any thread.

    Parameters
    ----------
    show
        Called with the progress of every search.
    announce
        Called with a message when other long-running work begins.
    """
    handler, logger = _ProgressHandler(show, announce), logging.getLogger(_PACKAGE)
    before = logger.level
    # Python prints warnings only as long as no handler takes records.
    unhandled = None if logger.hasHandlers() else logging.lastResort
    if unhandled is not None:
        logger.addHandler(unhandled)
    logger.addHandler(handler)
    # Other handlers keep their own levels, so their output does not change.
    logger.setLevel(logging.INFO if before == logging.NOTSET else min(before, logging.INFO))
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)
        if unhandled is not None:
            logger.removeHandler(unhandled)


class _ProgressHandler(logging.Handler):
    def __init__(
        self, show: Callable[[SearchProgress], None], announce: Callable[[str], None]
    ) -> None:
        super().__init__(logging.INFO)
        self._show, self._announce = show, announce

    def emit(self, record: logging.LogRecord) -> None:
        progress = getattr(record, _RECORD_ATTRIBUTE, None)
        if isinstance(progress, SearchProgress):
            self._show(progress)
        elif getattr(record, ANNOUNCEMENT_ATTRIBUTE, False):
            self._announce(record.getMessage())
