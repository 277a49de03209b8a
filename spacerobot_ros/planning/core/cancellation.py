"""Cancellation of plans: the caller asks for it, and long searches look for it."""

from __future__ import annotations

from typing import NoReturn

from spacerobot_ros.errors import PlanningError


class PlanningCancelled(PlanningError):  # noqa: N818 - a request, not a failure
    """The caller cancelled the plan before it was found."""


class Cancellation:
    """A request to stop planning, made in one thread and looked for in another."""

    def __init__(self) -> None:
        self._requested = False

    @property
    def requested(self) -> bool:
        """Whether the plan is no longer wanted."""
        return self._requested

    def cancel(self) -> None:
        """Request that planning stops."""
        self._requested = True

    def raise_if_requested(self) -> None:
        """Stop planning if that is requested.

        Raises
        ------
        PlanningCancelled
            It is.
        """
        if self._requested:
            raise PlanningCancelled("Planning was cancelled.")


class _Never(Cancellation):
    """The cancellation of a plan that cannot be cancelled."""

    def cancel(self) -> NoReturn:
        """Refuse: every plan without a cancellation of its own shares this one."""
        raise RuntimeError("NEVER is shared by all plans that are not to be cancelled.")


NEVER: Cancellation = _Never()
"""The cancellation of plans that are never cancelled."""
