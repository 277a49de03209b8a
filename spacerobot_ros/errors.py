"""The exceptions of this package: each has a message that a user can act on."""

from collections.abc import Iterable
from enum import Enum

_LONGEST_MESSAGE = 2000


def printable(text: str) -> str:
    """Return a text of unknown origin in one line and without control characters.

    Terminals act on control characters: texts from topics and bags pass through here before they
    are shown or logged.
    """
    line = " ".join(text.splitlines())
    if line.isprintable():
        return line
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)


class SpaceRobotError(Exception):
    """Base of all errors of this package; the message is one sentence for the user.

    Line breaks and control characters are replaced, and a long message is shortened.
    """

    def __init__(self, message: str = "") -> None:
        line = printable(str(message))
        if len(line) > _LONGEST_MESSAGE:
            half = _LONGEST_MESSAGE // 2
            line = f"{line[:half]} ... {line[-half:]}"
        super().__init__(line)


class RobotDescriptionError(SpaceRobotError):
    """A URDF that does not describe a free-floating robot; the message names the element."""


class MeshError(SpaceRobotError):
    """A mesh that is not found or cannot be read; the message says why, and what to do."""


class ParameterError(SpaceRobotError):
    """A parameter or option whose value is refused; the message names it."""


class PlanningError(SpaceRobotError):
    """A goal that is refused or cannot be reached; the message says why."""


class Proof(Enum):
    """Kinds of proofs that a goal cannot be reached."""

    LIMITS = "joint limits"
    """No shape within them is that of the goal."""

    MOMENTUM = "momentum"
    """At zero momentum the centre of mass rests, and the goal would move it."""

    RANK = "rank"
    """No motion of the joints turns the base so."""


class UnreachableError(PlanningError):
    """A goal that the robot cannot reach; ``proof`` is the kind of the proof.

    A goal to which the search found no manoeuvre is a :class:`NotFoundError`.
    """

    def __init__(self, message: str, proof: Proof) -> None:
        super().__init__(message)
        self.proof = proof


class NotFoundError(PlanningError):
    """A goal to which no manoeuvre was found, which proves nothing.

    The message says how hard it was tried, and what may help.
    """


def refusal_of_all(message: str, refusals: Iterable[Exception]) -> PlanningError:
    """Return one refusal of a goal that several methods have refused.

    A proof of one holds for all; where there is none, one that searched may search longer.
    """
    refusals = list(refusals)
    for refusal in refusals:
        if isinstance(refusal, UnreachableError):
            return UnreachableError(message, refusal.proof)
    if any(isinstance(refusal, NotFoundError) for refusal in refusals):
        return NotFoundError(message)
    return PlanningError(message)


class GoalError(PlanningError):
    """An invalid goal: not finite, no rotation, the wrong number of entries."""


class RecordingError(SpaceRobotError):
    """A bag that cannot be written or read; the message says which, where and what to do."""


class CommandError(SpaceRobotError):
    """A joint command that the plant refuses; the message says why."""
