"""Cancellation of plans: the caller requests it, and long searches poll it."""

from __future__ import annotations

from typing import NoReturn

from spacerobot_ros.errors import PlanningError


class PlanningCancelled(PlanningError):  # noqa: N818 - a request, not a failure
    """The caller cancelled the plan before it was found."""


class Cancellation:
    """A request to stop planning, made in one thread and polled in another."""

    def __init__(self) -> None:
        self._requested = False

    @property
    def requested(self) -> bool:
        """Whether the plan was cancelled."""
        return self._requested

    def cancel(self) -> None:
        """Request that planning stops."""
        self._requested = True

    def raise_if_requested(self) -> None:
        """Raise an error if the plan was cancelled.

        Raises
        ------
        PlanningCancelled
            It is.
        """
        if self._requested:
            raise PlanningCancelled("Planning was cancelled.")


class _Never(Cancellation):
    """A cancellation for plans that run to their end."""

    def cancel(self) -> NoReturn:
        """Raise an error: all plans without their own cancellation share this one."""
        raise RuntimeError("NEVER cannot be cancelled: all plans that run to their end share it.")


NEVER: Cancellation = _Never()
"""The cancellation for plans that run to their end."""
