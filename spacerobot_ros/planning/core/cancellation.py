"""Plans that nobody waits for any more: long searches look whether they are still wanted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from spacerobot_ros.errors import PlanningError

_wanted: ContextVar[Callable[[], bool]] = ContextVar("wanted", default=lambda: True)


@contextmanager
def wanted_while(condition: Callable[[], bool]) -> Iterator[None]:
    """Give up what is planned in this block, in this thread, when ``condition`` turns false."""
    token = _wanted.set(condition)
    try:
        yield
    finally:
        _wanted.reset(token)


def still_wanted() -> bool:
    """Whether somebody waits for what is being planned in this thread."""
    return _wanted.get()()


def require_wanted() -> None:
    """Give up unless somebody waits.

    Raises
    ------
    PlanningError
        Nobody does.
    """
    if not still_wanted():
        raise PlanningError("Planning was given up: nobody waits for the plan.")
