"""Monitors of a controller's goal: reached, failed, lost, or stalled.

The executive evaluates :class:`GoalMonitor` numerically, state by state; SIMD lanes are compiled
from the same methods, called with CasADi symbols. Its conditions are therefore numbers, 1 or 0,
combined by arithmetic: ``a * b`` is "a and b", ``1 - a`` is "not a".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.outputs import OutputDistance

if TYPE_CHECKING:
    from spacerobot_ros.control.controller import CoordinatedController
    from spacerobot_ros.control.limits import Saturated

Scalar = Any
"""A number or a CasADi symbol."""

LOST_RATE = 1.5
"""Ratio of joint rate to rate limit above which control of the joint is lost."""

LOST_STATES = 3
"""Number of consecutive states beyond a bound after which control is lost; a single such state may
be a bad measurement."""

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
        Time since which all errors have been within tolerance with the reference at rest, s; -1:
        there is no such time.
    fast_states, large_error_states
        Numbers of consecutive states with an excessive joint rate, and with an error beyond its
        bound.
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
        errors: OutputDistance,
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
        errors: OutputDistance,
        rate_share: Scalar,
        error_share: Scalar,
        config: ControllerConfig,
    ) -> Scalar:
        """Return the :class:`Decision` from one state: lost, or else :meth:`decide_by_errors`."""
        rates, lost = self.check_rates(rate_share), self.check_errors(error_share)
        controlled = (1 - rates) * (1 - lost)
        outcome = self.decide_by_errors(time, at_rest, ends, errors, config)
        return (1 - controlled) * Decision.LOST + controlled * outcome


# -- progress --------------------------------------------------------------------------------------

_SHORTEST_WINDOW, _LONGEST_WINDOW = 2.0, 10.0
"""Shortest and longest time over which errors are compared, s."""

_LIMITED_WINDOW = 5.0
"""Comparison time while commands are limited, which slows the loop, s."""

_LEAST_WINDOW_PERIODS = 20
"""Shortest comparison time, in control periods."""

_SAMPLES = 32
"""Number of states whose errors are checked within a comparison time."""

_LEAST_PROGRESS = 0.02
"""Smallest fraction by which errors must shrink between windows; in a linear loop they shrink by
0.6 per time constant."""

_LAG_SHARE = 0.5
"""Largest lag of an unimpeded robot behind its reference, as a fraction of the distance."""

_LEAST_SMALLEST_TOLERANCE = 1e-9
"""Tolerance (m, rad) used if the given tolerance is zero."""

_STOP_SHARE = 0.005
"""Distance, as a fraction of the joint range, at which a joint is considered to be at its stop."""

_SINGULAR_SHARE = 0.7
"""Fraction of the error in singular directions above which a singularity is taken as the cause."""


class StallMonitor:
    """Compares the largest ratio of an error to its tolerance between successive time windows.

    A window is the time in which the slowest error of the closed loop decays to a third
    (:meth:`.ControlLaw.slowest_decay`), at least 2 s and at most 10 s; while commands are limited,
    it is 5 s. The robot is stalled if the largest error shrinks from one window to the next by less
    than 2 % and by less than before:

    * after the reference has come to rest, and while an error is beyond its tolerance;
    * while the reference moves, if the robot lags behind by more than half the distance and more
    than its tolerance, and the error has not begun to shrink.

    The stall ends when the errors shrink again.
    """

    def __init__(self) -> None:
        self.cause = ""
        """Cause of the stall, as the second half of a sentence; empty if not stalled."""
        self.restart()

    def restart(self) -> None:
        """Restart the monitor, at a new goal or after a jump in time or position."""
        self.cause = ""
        self._ends = self._next_sample = -math.inf
        self._window = 0.0
        self._at_rest = False
        """Whether the reference was at rest when the current window began."""
        self._largest: list[float] = []
        """Largest ratios of an error to its tolerance in the current and earlier windows, the
        latest first."""
        self._share = self._lag = 0.0
        """Largest ratio of an error to its tolerance, and lag behind the reference, in the last
        state."""
        self._samples = self._limited = 0

    def observe(
        self,
        time: float,
        controller: CoordinatedController,
        result: Saturated,
        config: ControllerConfig,
    ) -> None:
        """Process the controller's state and command at a given time (s)."""
        if time < self._next_sample:
            return
        if not self._largest:
            self._begin(time, controller, config)
        elif not self._at_rest and controller.reference_at_rest(time):
            # Errors of a reference at rest are compared only with each other: earlier ones depend
            # on its speed.
            self._largest = []
            self._begin(time, controller, config)
        self._next_sample = time + self._window / _SAMPLES
        assert controller.profile is not None
        errors, tolerances = controller.errors(), config.tolerances
        parts = list(zip(errors, controller.profile.distances(), tolerances, strict=True))
        self._share = max(e / max(most, _LEAST_SMALLEST_TOLERANCE) for e, _, most in parts)
        self._lag = max((e / way for e, way, most in parts if min(e, way) > most), default=0.0)
        self._largest[0] = max(self._largest[0], self._share)
        self._samples += 1
        self._limited += result.limited
        if time >= self._ends:
            self._compare(controller, result)
            self._begin(time, controller, config)

    def _begin(
        self, time: float, controller: CoordinatedController, config: ControllerConfig
    ) -> None:
        rate = 1 / _LIMITED_WINDOW if self._is_limited else controller.law.slowest_decay()
        shortest = max(_SHORTEST_WINDOW, _LEAST_WINDOW_PERIODS * config.control_period)
        self._window = max(1 / max(rate, 1 / _LONGEST_WINDOW), shortest)
        self._ends = time + self._window
        self._at_rest = controller.reference_at_rest(time)
        self._largest = [0.0, *self._largest[:2]]
        self._samples = self._limited = 0

    @property
    def _is_limited(self) -> bool:
        return 2 * self._limited > self._samples

    def _compare(self, controller: CoordinatedController, result: Saturated) -> None:
        if len(self._largest) < 2:
            return
        now, before = self._largest[:2]
        progress = before - now
        earlier = self._largest[2] - before if len(self._largest) > 2 else 0.0
        if now <= 1.0 or progress >= _LEAST_PROGRESS * before:
            self.cause = ""
        elif not self._at_rest and self._share < (1 - _LEAST_PROGRESS) * now:
            self.cause = ""  # The errors grew during the motion, and shrink again.
        # Robots with little thrust start slowly and then speed up.
        elif progress > max(earlier, 0.0) and not self.cause:
            pass
        elif self._at_rest or (self._lag > _LAG_SHARE and progress <= 0.0):
            self.cause = self._find_cause(controller, result)

    def _find_cause(self, controller: CoordinatedController, result: Saturated) -> str:
        law, limited = controller.law, self._is_limited
        robot, q = law.robot, law.state.q
        span = robot.upper - robot.lower
        margin = _STOP_SHARE * np.where(np.isfinite(span), span, 0.0)
        at_stop = (q <= robot.lower + margin) | (q >= robot.upper - margin)
        first = next(iter(np.flatnonzero(at_stop)), None)
        stop = "" if first is None else f"joint '{robot.joint_names[first]}' is at its stop"
        if stop and limited:
            return stop
        if law.singular_error_share > _SINGULAR_SHARE:
            cause = "the arm is stretched out or folded (singular)"
            profile = controller.profile
            if profile is not None and not profile.carries:
                cause += "; the end-effector keeps its own goal until ~/abort"
            return cause
        if limited:
            if result.excess.wrench_B[:3].any():
                return "the thruster force is at its limit"
            if result.excess.wrench_B[3:].any():
                return "the base torque is at its limit"
            return "joint efforts are at their limits"
        return stop or "its errors no longer shrink"
