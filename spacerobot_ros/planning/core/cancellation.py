"""Background planning jobs, and their cancellation, for which long searches poll."""

from __future__ import annotations

import math
from collections.abc import Callable
from threading import Thread
from time import perf_counter
from typing import Generic, TypeVar

from spacerobot_ros.errors import PlanningError

MAX_THREAD_END_TIME = 1.5
"""Longest wall time that a cancelled planning thread may take to end, s."""


class PlanningCancelled(PlanningError):  # noqa: N818 - a request, not a failure
    """The caller cancelled planning before a plan was found."""


class Cancellation:
    """A request to stop planning, made in one thread and polled in another."""

    _requested = False

    @property
    def requested(self) -> bool:
        """Whether planning was cancelled."""
        return self._requested

    def cancel(self) -> None:
        """Request that planning stops."""
        self._requested = True

    def raise_if_requested(self) -> None:
        """Raise :class:`PlanningCancelled` if planning was cancelled."""
        if self._requested:
            raise PlanningCancelled("Planning was cancelled.")


NEVER = Cancellation()
"""A cancellation that is never requested, for plans that run to completion."""

_Plan = TypeVar("_Plan")


class PlanningJob(Generic[_Plan]):
    """A plan being computed.

    Parameters
    ----------
    work
        Returns the plan, or raises an error.
    begins
        Time at which the plan starts, s, if it is ready by then; minus infinity: when it is ready.
    """

    def __init__(self, work: Callable[[Cancellation], _Plan], begins: float = -math.inf) -> None:
        self.begins, self.done = begins, False
        self.wall_time = 0.0
        """Wall time of the work, s."""
        self._cancellation, self._work = Cancellation(), work
        self._result: _Plan | None = None
        self._error: BaseException | None = None
        self._after: PlanningJob[_Plan] | None = None
        self._thread = Thread(target=self._run, daemon=True)

    def start(self, *, in_background: bool, after: PlanningJob[_Plan] | None = None) -> None:
        """Run the work in a thread, after another job has ended, or immediately."""
        self._after = after
        if in_background:
            self._thread.start()
        else:
            self._run()

    def _run(self) -> None:
        after, self._after = self._after, None
        if after is not None and after._thread.is_alive():
            after._thread.join()
        began = perf_counter()
        try:
            self._result = self._work(self._cancellation)
        except BaseException as error:
            self._error = error
        self.wall_time = perf_counter() - began
        self.done = True

    def cancel(self) -> None:
        """Cancel the job; its result is discarded. Any thread may call this."""
        self._cancellation.cancel()

    def close(self) -> None:
        """Cancel the job and wait for its thread to end."""
        self.cancel()
        if self._thread.is_alive():
            # A thread inside CasADi would crash an exiting process.
            self._thread.join(MAX_THREAD_END_TIME)

    def result(self) -> _Plan:
        """Return the plan of a job that is done, or raise the error that its work raised.

        Raises
        ------
        PlanningCancelled
            The job was cancelled.
        """
        self._cancellation.raise_if_requested()
        if self._error is not None:
            raise self._error
        assert self._result is not None
        return self._result
