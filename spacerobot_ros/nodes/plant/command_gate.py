"""What stands between commands and actuators: reasons to refuse, counted, and faults that latch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import Enum

from spacerobot_ros.errors import ParameterError


class Reason(str, Enum):
    """Why a command is refused; the value is the word for it in parameters and diagnostics."""

    MALFORMED = "malformed"
    """Unknown or missing joints, wrong lengths, another frame."""
    NOT_FINITE = "not_finite"
    STALE = "stale"
    EARLY = "early"
    """Stamped ahead of the plant's time."""
    OUT_OF_ORDER = "out_of_order"
    """Stamped before the command that is in force."""
    BEYOND_LIMITS = "beyond_limits"
    SECOND_COMMANDER = "second_commander"
    """Somebody else has already answered the same state."""
    LATCHED = "latched"
    """A fault is latched: nothing moves until it is rearmed."""


class CommandGate:
    """Counts what is refused, and keeps everything at rest once a fault has latched.

    Parameters
    ----------
    latching
        Words of the reasons that latch a fault, separated by spaces.

    Raises
    ------
    ParameterError
        A word is no reason.
    """

    def __init__(self, latching: str) -> None:
        self._latching = set(_reasons(latching.split()))
        self.counts: Counter[Reason] = Counter()
        self.fault = ""
        """Why nothing moves; empty while commands pass."""

    @property
    def refused(self) -> int:
        """How many commands were refused so far."""
        return self.counts.total()

    def refuse(self, reason: Reason, sentence: str) -> None:
        """Count a refused command; its sentence becomes the fault if its reason latches."""
        self.counts[reason] += 1
        if reason in self._latching:
            self.latch(sentence)

    def latch(self, sentence: str) -> None:
        """Let nothing pass from now on; the first fault stays the one that is shown."""
        self.fault = self.fault or sentence

    def rearm(self) -> None:
        """Let commands pass again."""
        self.fault = ""


def _reasons(words: Iterable[str]) -> Iterable[Reason]:
    known = [reason.value for reason in Reason if reason is not Reason.LATCHED]
    for word in words:
        if word not in known:
            raise ParameterError(
                f"Parameter 'latched_faults' has '{word}'; it takes {', '.join(known)}, separated "
                "by spaces."
            )
        yield Reason(word)
