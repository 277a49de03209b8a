"""The exceptions of this package: every one carries a sentence that a user can act on."""

from collections.abc import Iterable
from enum import Enum

_LONGEST_SENTENCE = 2000


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
    """Base of every error this package raises on purpose, with one sentence for the user.

    Line breaks, control characters and endless lists in what it quotes go.
    """

    def __init__(self, sentence: str = "") -> None:
        line = printable(str(sentence))
        if len(line) > _LONGEST_SENTENCE:
            half = _LONGEST_SENTENCE // 2
            line = f"{line[:half]} ... {line[-half:]}"
        super().__init__(line)


class RobotDescriptionError(SpaceRobotError):
    """A URDF that does not describe a free-floating robot; the sentence names the element."""


class MeshError(SpaceRobotError):
    """A mesh that is not found or cannot be read; the sentence says why, and what to do."""


class ParameterError(SpaceRobotError):
    """A parameter or option whose value is refused; the sentence names it."""


class PlanningError(SpaceRobotError):
    """A goal that is refused or cannot be reached; the sentence says why."""


class Proof(Enum):
    """What proves that a goal cannot be reached."""

    LIMITS = "joint limits"
    """No shape within them is that of the goal."""

    MOMENTUM = "momentum"
    """At zero momentum the centre of mass rests, and the goal would move it."""

    RANK = "rank"
    """No motion of the joints turns the base so."""


class UnreachableError(PlanningError):
    """A goal that the robot cannot reach; ``proof`` is of what kind the reason is.

    A goal that merely was not reached by what was tried is a :class:`NotFoundError`.
    """

    def __init__(self, sentence: str, proof: Proof) -> None:
        super().__init__(sentence)
        self.proof = proof


class NotFoundError(PlanningError):
    """A goal to which no manoeuvre was found, which proves nothing.

    The sentence says how hard it was tried, and what may help.
    """


def refusal_of_all(sentence: str, refusals: Iterable[Exception]) -> PlanningError:
    """Return what a goal is refused with where several methods have refused it.

    A proof of one holds for all; where there is none, one that searched may search longer.
    """
    refusals = list(refusals)
    for refusal in refusals:
        if isinstance(refusal, UnreachableError):
            return UnreachableError(sentence, refusal.proof)
    if any(isinstance(refusal, NotFoundError) for refusal in refusals):
        return NotFoundError(sentence)
    return PlanningError(sentence)


class GoalError(PlanningError):
    """A goal that is none: not finite, no rotation, the wrong number of entries."""


class RecordingError(SpaceRobotError):
    """A bag that cannot be written or read; the sentence says which, where and what to do."""


class CommandError(SpaceRobotError):
    """A joint command that the plant refuses; the sentence says why."""
