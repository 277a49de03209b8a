"""Disturbances: constant wrenches from outside on links, for some time.

``LINK [force X Y Z] [torque X Y Z] [in world|link] [at SECONDS] [until SECONDS]``, for example
``hand force 1 0 0 torque 0 0 0.2 in link at 10 until 50``. Force (N) and torque (N m) act at the
origin of the link's frame, in components of the world or of the link, with which they then turn.
Without ``at`` a disturbance begins at once, without ``until`` it never ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from spacerobot_ros.simulation.timeline import (
    Timeline,
    format_times,
    line_refusal,
    parse_number,
    parse_times,
)

_MAX_COMPONENT = 1e6
"""Largest component of a force or torque, N or N m."""

_LINE_FORMAT = (
    "it must be LINK [force X Y Z] [torque X Y Z] [in world|link] [at SECONDS] [until SECONDS], "
    "with a force or a torque"
)


@dataclass(frozen=True)
class Disturbance:
    """One disturbance: active from ``start`` s on and until before ``end`` s of simulated time.

    ``force`` (3,), N, and ``torque`` (3,), N m, act at the origin of the frame of ``link``, in
    components of that frame where ``in_link``, else of the world.
    """

    link: str
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)
    in_link: bool = False
    start: float = 0.0
    end: float = math.inf

    def __str__(self) -> str:
        words = [self.link]
        for name, vector in (("force", self.force), ("torque", self.torque)):
            if any(vector):
                words += [name, *(f"{component:g}" for component in vector)]
        frame = "link" if self.in_link else "world"
        return " ".join([*words, "in", frame, format_times(self.start, self.end)])


def parse_disturbance(line: str, links: Sequence[str], now: float = 0.0) -> Disturbance:
    """Read a disturbance from its line.

    Parameters
    ----------
    line
        As the module describes.
    links
        Names of the robot's links.
    now
        Begin of the disturbance if the line has none, s.

    Raises
    ------
    ParameterError
        The line is not a disturbance of this robot; the message quotes it.
    """
    refusal = line_refusal(line, "disturbance")
    link, *rest = line.split() or [""]
    vectors = {"force": (0.0, 0.0, 0.0), "torque": (0.0, 0.0, 0.0)}
    given: list[str] = []
    while rest and rest[0] in vectors and rest[0] not in given:
        name, components = rest[0], rest[1:4]
        if len(components) < 3:
            raise refusal(_LINE_FORMAT)
        x, y, z = (parse_number(text, refusal) for text in components)
        if max(abs(x), abs(y), abs(z)) > _MAX_COMPONENT:
            raise refusal(f"components of its {name} must be at most {_MAX_COMPONENT:g}")
        vectors[name], given, rest = (x, y, z), [*given, name], rest[4:]
    if not given:
        raise refusal(_LINE_FORMAT)
    if link not in links:
        raise refusal(f"the robot has no link '{link[:40]}'; it has {', '.join(links)}")
    in_link = False
    if rest[:1] == ["in"]:
        if rest[1:2] not in (["world"], ["link"]):
            raise refusal("its frame is world or link")
        in_link, rest = rest[1] == "link", rest[2:]
    start, end = parse_times(rest, f"the {given[-1]}", now, refusal)
    if start < 0.0:
        raise refusal(f"it begins at {start:g} s, before the simulation does")
    return Disturbance(link, vectors["force"], vectors["torque"], in_link, start, end)


def disturbance_timeline(lines: Iterable[str], links: Sequence[str]) -> Timeline[Disturbance]:
    """Return the disturbances of one plant by time.

    Raises
    ------
    ParameterError
        A line is not a disturbance of this robot, or there are too many.
    """
    return Timeline(lines, lambda line, now: parse_disturbance(line, links, now), "disturbance")
