"""Nodes that a scenario has killed on the way, and started again."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from spacerobot_ros.errors import ParameterError

NEEDS_PROCESSES = """\
The scenario '{}' kills nodes on the way: fly it with --processes and --realtime."""

_LINE = re.compile(r"(\S+) at (\S+)(?: until (\S+))?")


@dataclass(frozen=True)
class Kill:
    """A node that ends by SIGKILL ``at`` a simulated time, and starts again at ``until``, s."""

    node: str
    at: float
    until: float


def parse_kills(lines: object, nodes: Sequence[str], where: str) -> tuple[Kill, ...]:
    """Read ``NODE at SECONDS [until SECONDS]``, a list of such lines, by time.

    Raises
    ------
    ParameterError
        A line is none, its node is not one of ``nodes``, or its times are not in order.
    """
    if not isinstance(lines, list):
        raise ParameterError(
            f"'kills' in {where} is {lines!r}, not a list of lines NODE at SECONDS."
        )
    return tuple(sorted((_parsed(line, nodes, where) for line in lines), key=lambda k: k.at))


def _parsed(line: object, nodes: Sequence[str], where: str) -> Kill:
    match = _LINE.fullmatch(" ".join(str(line).split()))
    if match is None:
        raise ParameterError(
            f"The kill {str(line)!r} in {where} is not NODE at SECONDS [until SECONDS]."
        )
    node, at, until = match[1], match[2], match[3] or "inf"
    if node not in nodes:
        raise ParameterError(
            f"The kill {str(line)!r} in {where} names '{node}'; it may name {', '.join(nodes)}."
        )
    try:
        kill = Kill(node, float(at), float(until))
    except ValueError:
        kill = Kill(node, 0.0, 0.0)
    if not 0 <= kill.at < kill.until:
        raise ParameterError(
            f"The kill {str(line)!r} in {where} needs times in s, the second after the first."
        )
    return kill


class KillTimeline:
    """Which node is to end and to start, as time goes on.

    Parameters
    ----------
    kills
        By time.
    """

    def __init__(self, kills: Sequence[Kill]) -> None:
        self._waiting = list(kills)
        self._away: list[Kill] = []

    def due(self, time: float) -> tuple[list[str], list[str]]:
        """Return the nodes to kill and those to start, by the simulated time in s."""
        killed = [kill for kill in self._waiting if kill.at <= time]
        started = [kill for kill in self._away if kill.until <= time]
        self._waiting = [kill for kill in self._waiting if kill.at > time]
        self._away = [kill for kill in self._away if kill.until > time] + killed
        return [kill.node for kill in killed], [kill.node for kill in started]

    @property
    def away(self) -> set[str]:
        """The nodes that were killed and are not started yet."""
        return {kill.node for kill in self._away}
