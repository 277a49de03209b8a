"""The publishers of a topic, distinguished where messages do not name them."""

from __future__ import annotations

_UNNUMBERED = 2**63
"""Middleware that does not number messages reports a larger number."""

_MOST_PUBLISHERS = 100
"""Largest number of publishers that are remembered."""


class Senders:
    """Tells the publishers of one topic apart, by the numbers that each gives its messages.

    A publisher numbers its messages one by one, so a message belongs to the publisher whose last
    one has the number before. Other numbers are those of a publisher that has not sent before, or
    was started again. A publisher that comes back after another has sent, and was not silent
    meanwhile, shares the topic with it; one that takes over for good does not.

    Parameters
    ----------
    silence_ns
        Simulated time without a message after which a publisher has handed over, ns.

    Attributes
    ----------
    current
        A number for the publisher of the last message; None where the middleware numbers nothing.
    multiple_publishers
        Whether that publisher and another one send by turns.
    """

    def __init__(self, silence_ns: int) -> None:
        self.current: int | None = None
        self.multiple_publishers = False
        self._silence = silence_ns
        self._next = -1
        self._heard = 0
        self._publishers = 0
        self._others: dict[int, tuple[int, int]] = {}
        """Of publishers that another one has followed, by their next number: which, and when."""

    def note(self, number: int, now_ns: int) -> None:
        """Note the number of a message that comes at a simulated time (ns)."""
        if number == self._next:
            self._next, self._heard, self.multiple_publishers = number + 1, now_ns, False
            return
        if not 0 < number < _UNNUMBERED:
            self.current = None
            return
        if self.current is not None:
            self._others[self._next] = self.current, self._heard
        publisher, heard = self._others.pop(number, (0, 0))
        self.multiple_publishers = bool(publisher) and now_ns - heard <= self._silence
        if not publisher:
            self._publishers = publisher = self._publishers + 1
        if len(self._others) > _MOST_PUBLISHERS:
            del self._others[next(iter(self._others))]
        self.current, self._next, self._heard = publisher, number + 1, now_ns
