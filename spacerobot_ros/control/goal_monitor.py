"""Monitor for a controller's goal (reached, failed or lost), with numbers or symbols.

The executive evaluates the monitor numerically, state by state; SIMD lanes are compiled
from the same methods, called with CasADi symbols. Conditions are therefore numbers, 1 or 0,
combined by arithmetic: ``a * b`` is "a and b", ``1 - a`` is "not a".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.reference import OutputErrors

Scalar = Any
"""A number or a CasADi symbol."""

LOST_RATE = 1.5
"""Ratio of joint rate to rate limit above which control of the joint is lost."""

LOST_STATES = 3
"""Number of consecutive states beyond a bound after which control is lost; a single one may be a
bad measurement."""

AUTOMATIC_TIME_LIMIT = 300.0
"""Time (s) from the end of the reference after which a goal without a time limit fails."""

_ROUNDING = 1e-9
"""Largest rounding error in a sum of control periods, s."""

_NOT_WITHIN_TOLERANCE = -1.0
"""Value of ``within_since`` while an error is beyond its tolerance."""


class Decision(IntEnum):
    """Outcome of a goal."""

    NONE = 0
    """The goal is still pursued."""
    REACHED = 1
    FAILED = 2
    """The goal was not reached within the time limit."""
    LOST = 3
    """Control was lost: a joint was too fast, or the errors grew."""


@dataclass
class GoalMonitor:
    """Summary of the states since a goal began, used for the decision.

    Attributes
    ----------
    started
        Goal start time, s.
    within_since
        Time since which all errors have been within tolerance with the reference at rest, s; -1 if
        they are not.
    fast_states, large_error_states
        Numbers of consecutive states with a joint too fast, and with an error beyond its bound.
    """

    started: Scalar = 0.0
    within_since: Scalar = _NOT_WITHIN_TOLERANCE
    fast_states: Scalar = 0
    large_error_states: Scalar = 0

    def begin(self, time: Scalar) -> None:
        """Begin a goal at a given time (s); the count of states with excessive joint rates is
        kept."""
        self.started, self.within_since, self.large_error_states = time, _NOT_WITHIN_TOLERANCE, 0

    def restart_settling(self) -> None:
        """Restart the settling time."""
        self.within_since = _NOT_WITHIN_TOLERANCE

    def shift_time(self, seconds: Scalar) -> None:
        """Shift the goal start by a time jump (s), and restart the settling time."""
        self.started += seconds
        self.restart_settling()

    def check_rates(self, largest_share: Scalar) -> Scalar:
        """Count a state whose largest joint rate, as a fraction of its limit, is too high.

        Returns whether joints exceeded :data:`LOST_RATE` in :data:`LOST_STATES` states.
        """
        self.fast_states = (largest_share > LOST_RATE) * (self.fast_states + 1)
        return self.fast_states >= LOST_STATES

    def check_errors(self, largest_share: Scalar) -> Scalar:
        """Count a state whose largest error, as a fraction of its bound, is too large.

        Returns whether errors exceeded their bounds in :data:`LOST_STATES` states.
        """
        self.large_error_states = (largest_share > 1.0) * (self.large_error_states + 1)
        return self.large_error_states >= LOST_STATES

    def is_late(self, time: Scalar, ends: Scalar, config: ControllerConfig) -> Scalar:
        """Whether a goal is late at a given time (s); ``ends`` is the end time (s) of its
        reference."""
        if config.time_limit:
            return time - self.started >= config.time_limit - _ROUNDING
        return time - ends >= AUTOMATIC_TIME_LIMIT - _ROUNDING

    def decide_by_errors(
        self,
        time: Scalar,
        at_rest: Scalar,
        ends: Scalar,
        errors: OutputErrors,
        config: ControllerConfig,
    ) -> Scalar:
        """Return the goal's :class:`Decision` from the errors in a state, if control is not lost.

        Parameters
        ----------
        time
            Time of the state, s.
        at_rest
            Whether the reference has come to rest at the goal.
        ends
            Time at which the reference comes to rest, s.
        errors
            Largest output errors by kind.
        config
            Tolerances, settling time and time limit.
        """
        within = (
            1.0
            * at_rest
            * (errors.position <= config.position_tolerance)
            * (errors.attitude <= config.attitude_tolerance)
            * (errors.joints <= config.joint_tolerance)
        )
        was_within = self.within_since >= 0
        since = was_within * self.within_since + (1 - was_within) * time
        self.within_since = within * since + (1 - within) * _NOT_WITHIN_TOLERANCE
        settled = within * (time - since >= config.settle_time - _ROUNDING)
        failed = (1 - settled) * self.is_late(time, ends, config)
        return settled * Decision.REACHED + failed * Decision.FAILED

    def decide(
        self,
        time: Scalar,
        at_rest: Scalar,
        ends: Scalar,
        errors: OutputErrors,
        rate_share: Scalar,
        error_share: Scalar,
        config: ControllerConfig,
    ) -> Scalar:
        """Return the :class:`Decision` from one state: lost, or else :meth:`decide_by_errors`."""
        rates, lost = self.check_rates(rate_share), self.check_errors(error_share)
        controlled = (1 - rates) * (1 - lost)
        outcome = self.decide_by_errors(time, at_rest, ends, errors, config)
        return (1 - controlled) * Decision.LOST + controlled * outcome
