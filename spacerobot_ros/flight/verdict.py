"""The end of a flight in a word and a sentence, by its last true state.

A commander judges its goal by the measured state, at the moment of its decision. The verdict gives
the errors that the flight has in truth at its end, the same numbers as :attr:`Flight.error`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning import PoseError
from spacerobot_ros.planning.core.goal import Controlled, Tolerance
from spacerobot_ros.planning.execution.status import describe_remaining_error

if TYPE_CHECKING:
    from spacerobot_ros.flight.flight import Flight

_PARTS: frozenset[Controlled] = frozenset(("position", "attitude", "shape", "end_effectors"))


@dataclass(frozen=True)
class Verdict:
    """The end of a flight for people.

    Attributes
    ----------
    word
        The outcome in some words, such as ``Reached, but for the position``.
    sentence
        The message of the commander; of a goal that is reached, the true errors with their
        tolerances.
    complete
        Whether the whole goal is reached in truth.
    """

    word: str
    sentence: str
    complete: bool


def verdict_of(flight: Flight) -> Verdict:
    """Return the verdict about a flight."""
    late = flight.outcome is Outcome.FAILED and isinstance(flight.status, ControllerStatus)
    if flight.outcome is not Outcome.REACHED and not late:
        return Verdict(flight.outcome.value.capitalize(), flight.message, complete=False)
    left_out = flight.not_controlled
    word = "Failed" if late else "Reached"
    if left_out and not late:
        word += f", but for the {' and '.join(left_out)}"
    position, attitude = flight.tolerance("position"), flight.tolerance("attitude")
    error = _last_error(flight)
    if error is None or position is None or attitude is None or flight.goal is None:
        sentence = flight.message
        if left_out and "not controlled" not in sentence:
            sentence += f" Not controlled: {' and '.join(left_out)}."
        return Verdict(word, sentence, complete=not (late or left_out))
    controls = _PARTS - set(left_out)
    if flight.error is None:
        controls -= {"position", "attitude"}
    if not error.end_effectors:
        controls -= {"end_effectors"}
    tolerance = Tolerance(position, attitude, _joint_tolerance(flight))
    errors = describe_remaining_error(error, controls, tolerance, flight.goal)
    if late:
        return Verdict(word, f"The goal is not reached in time: {errors}.", complete=False)
    if "measured_pose" in flight.series and not tolerance.admits(error, controls):
        return Verdict(
            "Reached by the measured pose",
            f"The measured pose is within tolerance of the goal; the true one is {errors}.",
            complete=False,
        )
    missed = _automatic_capture_is_missing(flight)
    if missed:
        word += ", but the target is not captured"
    return Verdict(word, f"The goal is reached: {errors}.", complete=not (left_out or missed))


def _automatic_capture_is_missing(flight: Flight) -> bool:
    automatic = flight.scenario.plant.capture.mode == "automatic"
    return automatic and flight.capture == {"captured": False}


def _last_error(flight: Flight) -> PoseError | None:
    """Return the true error at the end, of base, joints and end-effectors; None without any."""
    base, links = flight.error, tuple(flight.end_effector_errors.values())
    hand = flight.end_effector_error
    if not links and hand is not None:
        # A controller that does not turn the end-effector leaves its attitude free.
        turn = hand.rotvec if flight.turns_end_effector else np.zeros(3)
        links = (PoseError(hand.position, turn),)
    if base is None and not links:
        return None
    shape = np.zeros(0)
    wanted = None if flight.goal is None else flight.goal.joint_positions
    if wanted is not None and len(flight.q) and wanted.shape == flight.q[-1].shape:
        shape = wanted - flight.q[-1]
    position, rotvec = (np.zeros(3),) * 2 if base is None else (base.position, base.rotvec)
    return PoseError(position, rotvec, shape, links)


def _joint_tolerance(flight: Flight) -> float:
    return flight.tolerance("joint") or Tolerance(0.0, 0.0).shape
