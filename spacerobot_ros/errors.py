"""This package's exceptions, each with an actionable message."""

import traceback
from collections.abc import Iterable
from enum import Enum
from pathlib import Path

_MAX_MESSAGE_LENGTH = 2000


def printable(text: str) -> str:
    """Return a string as one line without control characters.

    Terminals interpret control characters, so strings from topics and bags pass through this
    function before they are shown or logged.
    """
    line = " ".join(text.splitlines())
    if line.isprintable():
        return line
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)


def reason(error: Exception) -> str:
    """Return the reason why a file cannot be used, without the error number and the path."""
    return getattr(error, "strerror", None) or str(error)


def counted(count: int, noun: str) -> str:
    """Return a count with its noun:  ``1 joint``, ``2 joints``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def sentence_case(text: str) -> str:
    """Return a string with its first letter capitalised, as at the beginning of a sentence."""
    return text[:1].upper() + text[1:]


AT_JOINTS = "m or rad at the joints"
"""Unit of joint errors for :func:`quantity`."""


def quantity(value: float, unit: str) -> str:
    """Return a number as a readable string with three digits; a rounding error is shown as an
    upper bound.

    m, rad, m/s and rad/s get SI prefixes: ``1.38 mm``, ``< 1 µrad``, ``2 mm or mrad``.
    """
    size = abs(value)
    if not unit.startswith(("m", "rad")):
        digits = 4 if 999.5 <= size < 9999.5 else 3
        return f"< 1e-9 {unit}" if 0 < size < 1e-9 else f"{value + 0.0:.{digits}g} {unit}"
    milli, micro = size < 0.1, size < 1e-4
    factor, prefix = (1e6, "µ") if micro else (1e3, "m") if milli else (1.0, "")
    if 0 < size < 1e-6:
        number = "< 1"
    else:
        number, prefix = f"{factor * value + 0.0:.3g}", prefix if size else ""
    return f"{number} {' or '.join(prefix + each for each in unit.split(' or '))}"


def numbers(values: Iterable[float], digits: int = 5) -> str:
    """Format numbers with ``digits`` decimals; a number that is rounded to zero has no sign."""
    return ", ".join(f"{round(float(x), digits) + 0.0:.{digits}f}" for x in values)


def enumeration(words: Iterable[str]) -> str:
    """Return words as "a", "a and b" or "a, b and c"."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def shortened(name: str, length: int = 21) -> str:
    """Return a name, shortened in the middle if the name is too long for a label."""
    half = (length - 1) // 2
    return name if len(name) <= length else f"{name[:half]}…{name[-half:]}"


class SpaceRobotError(Exception):
    """Base class of this package's errors; the message is one sentence for the user.

    Line breaks and control characters are replaced, and a long message is shortened.
    """

    def __init__(self, message: str = "") -> None:
        line = printable(str(message))
        if len(line) > _MAX_MESSAGE_LENGTH:
            half = _MAX_MESSAGE_LENGTH // 2
            line = f"{line[:half]} ... {line[-half:]}"
        super().__init__(line)


class RobotDescriptionError(SpaceRobotError):
    """A URDF does not describe a free-floating robot; the message names the element."""


class MeshError(SpaceRobotError):
    """A mesh is missing or cannot be read; the message states the reason and a remedy."""


class ParameterError(SpaceRobotError):
    """The value of a parameter or option is invalid; the message names the parameter."""


class PlanningError(SpaceRobotError):
    """A goal is rejected or unreachable; the message states the reason."""


class Proof(Enum):
    """Types of proof that a goal is unreachable."""

    LIMITS = "joint limits"
    """No joint positions within the limits reach the goal."""

    MOMENTUM = "momentum"
    """The goal requires a displacement of the centre of mass, which is impossible at zero
    momentum, or more angular momentum than the reaction wheels can store."""

    COLLISION = "collision"
    """In the goal configuration, links are in contact or closer than the clearance."""

    RANK = "rank"
    """No joint motion produces the base rotation that the goal requires."""


class UnreachableError(PlanningError):
    """A goal that the robot cannot reach; ``proof`` is the type of proof.

    If the search merely found no manoeuvre, the error is a :class:`NotFoundError`.
    """

    def __init__(self, message: str, proof: Proof) -> None:
        super().__init__(message)
        self.proof = proof


class NotFoundError(PlanningError):
    """No manoeuvre to the goal was found; the goal may still be reachable.

    The message states the extent of the search and a remedy.
    """


class UnreadMeshError(PlanningError):
    """A collision mesh cannot be read, so its link cannot be checked for collisions."""


def refusal_of_all(message: str, refusals: Iterable[Exception]) -> PlanningError:
    """Return a single error for a goal that several methods have rejected.

    A proof by one method applies to all. If there is no proof, the result is a NotFoundError if
    one of the errors is a NotFoundError.
    """
    refusals = list(refusals)
    for refusal in refusals:
        if isinstance(refusal, UnreachableError):
            return UnreachableError(message, refusal.proof)
    if any(isinstance(refusal, NotFoundError) for refusal in refusals):
        return NotFoundError(message)
    return PlanningError(message)


class GoalError(PlanningError):
    """An invalid goal: it is not finite, is not a rotation, or has the wrong number of entries."""


class RecordingError(SpaceRobotError):
    """A bag cannot be written or read; the message names the bag and a remedy."""


class CommandError(SpaceRobotError):
    """The plant rejects a command; the message states the reason."""


def describe_exception(error: BaseException) -> str:
    """Return type, message and source line of an unexpected exception."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    text = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}{': ' if text else ''}{text}{place}"
