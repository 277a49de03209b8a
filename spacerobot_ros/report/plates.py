"""What a figure shows, for whatever draws it: pictures for paper, charts of a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from matplotlib.figure import Figure

from spacerobot_ros.report.signals import Signal
from spacerobot_ros.report.style import PictureFormat, picture_of


@dataclass(frozen=True)
class Group:
    """Traces that share a panel, called by ``names``, ``label`` and ``unit``.

    Attributes
    ----------
    signal, names, label, unit, colours
        The traces.
    goals
        (start, end, trace, value) of each.
    limits
        (trace, value) of each.
    window
        Lower and upper end of the axis where some peaks are far beyond what can be read beside
        them; None: all is shown.
    decades
        So many powers of ten below the largest value are shown, on a logarithmic axis; 0: a linear
        one.
    rows
        Whether each trace has a row of its own, one high: how much of the time something is on.
    """

    signal: Signal
    names: Sequence[str]
    label: str
    unit: str
    colours: Sequence[str]
    goals: Sequence[tuple[float, float, int, float]] = ()
    limits: Sequence[tuple[int, float]] = ()
    window: tuple[float, float] | None = None
    decades: int = 0
    rows: bool = False


@dataclass(frozen=True)
class Plate:
    """A figure: a short name, its heading, what is to be seen, and the picture.

    ``groups`` are its panels where they are over the time of the flight, each over all of it;
    ``of_picture`` is the part of the caption that is about the picture and no chart of them.
    """

    name: str
    heading: str
    caption: str
    figure: Figure
    groups: Sequence[Group] = ()
    of_picture: str = ""

    @cached_property
    def svg(self) -> bytes:
        """The picture as SVG."""
        return picture_of(self.figure, PictureFormat.SVG)
