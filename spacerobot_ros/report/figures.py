"""Report figures: style, panels, traces, and files (SVG, PDF, PNG)."""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from spacerobot_ros.errors import SpaceRobotError, reason
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.model.description import Array

TEXT_COLOUR, SECONDARY_COLOUR, LINE_COLOUR = "#1f2328", "#667085", "#c3c8d0"
_OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_TOL = ("#332288", "#882255", "#999933", "#44AA99")
PALETTE = (*_OKABE_ITO, *_TOL)
"""Colours that can be distinguished with any type of colour vision."""

BASE_COLOUR, HAND_COLOUR, PLANNED_COLOUR, GHOST_COLOUR = (PALETTE[i] for i in (0, 3, 4, 2))
"""Colours of base and end-effector paths, plans and goals in space: blue, pink, orange and
green, as on the live page."""

WIDTH = 9.6
"""Figure width on a page, inches."""

_NARROW_WIDTH = 6.0
"""Width, in inches, below which a figure is styled for one column of a paper."""

TRACE_TIME_SLICES = 960
"""Number of time slices into which a dense trace is summarised across a figure."""

_PATH_DATA = re.compile(rb' d="[^"]*"')
_DECIMALS = re.compile(rb"(\.\d\d)\d+")

_FONT_SIZE = 8.5
"""Font size, in points, for which the distances in the figure modules are designed."""

_FONT_SIZE_RANGE = (3.0, 30.0)
"""Smallest and largest font size in a style file, points."""

_FIXED_SETTINGS: Any = {
    # Names of joints may contain dollar signs.
    "text.parse_math": False,
    # Figures keep their requested width; these modules place the panels.
    "savefig.bbox": None,
    "figure.autolayout": False,
    "figure.constrained_layout.use": False,
}


class _Look(NamedTuple):
    """How figures are drawn; ``scale``: ratio of the font size to 8.5 points."""

    width: float = WIDTH
    degrees: bool = False
    scale: float = 1.0


_PAGE = _Look()
_look = ContextVar("_look", default=_PAGE)


@contextmanager
def drawing(
    width: float = WIDTH, style: str = "report", own: Path | None = None, *, degrees: bool = False
) -> Iterator[None]:
    """Apply the figure style within a ``with`` block.

    Parameters
    ----------
    width
        Figure width, inches.
    style
        Style file in this package: ``report`` for report pages, ``paper`` for publications.
    own
        User style file, or name of a style in this package or in matplotlib; it overrides
        ``style``.
    degrees
        Whether angles over time are in degrees instead of rad.

    Raises
    ------
    SpaceRobotError
        The style file cannot be read, or its font settings cannot be used.
    """
    with mpl.rc_context():
        _apply_style(_shipped_style(style))
        if own is not None:
            _apply_style(own)
            _require_fonts(own)
        mpl.rcParams.update(_FIXED_SETTINGS)
        scale = float(mpl.rcParams["font.size"]) / _FONT_SIZE
        before = _look.set(_Look(width, degrees, scale))
        try:
            yield
        finally:
            _look.reset(before)


def _shipped_style(name: str) -> Path:
    return Path(str(files("spacerobot_ros.report").joinpath(f"{name}.mplstyle")))


def _apply_style(path: Path) -> None:
    import matplotlib.style as styles  # This import reads all matplotlib styles.

    shipped = _shipped_style(str(path))
    warnings: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        """Collect and suppress a warning, such as one about a style line unknown to matplotlib."""
        if record.levelno < logging.WARNING:
            return True
        warnings.append(record.getMessage().strip().splitlines()[0].rstrip("."))
        return False

    log = logging.getLogger("matplotlib")
    log.addFilter(collect)
    try:
        styles.use(str(shipped if shipped.is_file() and not path.exists() else path))
    except (OSError, ValueError, KeyError) as error:
        raise SpaceRobotError(f"The style file {path} cannot be read: {reason(error)}.") from error
    finally:
        log.removeFilter(collect)
    if warnings:
        raise SpaceRobotError(f"The style file {path} is refused: {warnings[0]}.")


def _require_fonts(path: Path) -> None:
    size = float(mpl.rcParams["font.size"])
    if not _FONT_SIZE_RANGE[0] <= size <= _FONT_SIZE_RANGE[1]:
        raise SpaceRobotError(
            f"The style file {path} is refused: font.size is {size:g}, but must be "
            f"{_FONT_SIZE_RANGE[0]:g} to {_FONT_SIZE_RANGE[1]:g} points."
        )
    if mpl.rcParams["text.usetex"]:
        raise SpaceRobotError(
            f"The style file {path} is refused: text.usetex would interpret joint names as TeX "
            "and leave no editable text."
        )
    families, found = mpl.rcParams["font.family"], []
    for family in families:
        with suppress(ValueError):  # Another family is not installed.
            findfont(FontProperties(family=[family]), fallback_to_default=False)
            found.append(family)
    if not found:
        raise SpaceRobotError(
            f"The style file {path} is refused: none of its fonts ({', '.join(families)}) is "
            "installed."
        )
    # DejaVu Sans comes with matplotlib and has signs that many fonts lack: 10⁻¹⁵, p₀.
    mpl.rcParams["font.family"] = list(dict.fromkeys([*found, "DejaVu Sans"]))


def width() -> float:
    """Return the figure width, inches."""
    return _look.get().width


def narrow() -> bool:
    """Whether a figure fits in one column of a paper."""
    return _look.get().width / _look.get().scale < _NARROW_WIDTH


def inches(length: float) -> float:
    """Scale a length, in inches, from a font size of 8.5 points to the current font size."""
    return length * _look.get().scale


def angle_unit() -> tuple[float, str]:
    """Return the angle unit, and the number of units per rad."""
    return (180.0 / np.pi, "deg") if _look.get().degrees else (1.0, "rad")


def sheet(
    rows: Sequence[Sequence[float]],
    heights: Sequence[float],
    *,
    left: float = 0.72,
    right: float = 0.25,
    bottom: float = 0.5,
    gap: float = 0.62,
    lane: float = 0.0,
    top: float = 0.3,
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure with rows of panels.

    Each row contains the relative widths of its panels; ``heights`` are the row heights in inches.
    ``left``, ``right`` and ``bottom`` are the space for panel labels, ``top`` the space for
    titles, ``gap`` the space between rows, and ``lane`` the space below every row.
    """
    scale = _look.get().scale
    if narrow() and left > 0.5:
        # Panels are small, so tick labels have few digits.
        left = max(left, 0.95)
    left, right, top = (scale * x for x in (left, right, top))
    bottom, gap = scale * (bottom + lane), scale * (gap + lane)
    heights = [scale * each for each in heights]
    between = right + left - 0.1 * scale
    height = top + sum(heights) + gap * (len(heights) - 1) + bottom
    figure = new_figure(height)
    panels = []
    y = height - top
    for widths, row_height in zip(rows, heights, strict=True):
        y -= row_height
        room = width() - left - right - between * (len(widths) - 1)
        if room <= 0.0:
            raise SpaceRobotError(
                f"A font size of {mpl.rcParams['font.size']:g} points leaves no room for the "
                f"panels in a figure {25.4 * width():.3g} mm wide."
            )
        x, row = left, []
        for share in widths:
            across = room * share / sum(widths)
            row.append(panel(figure, x, y, across, row_height))
            x += across + between
        panels.append(row)
        y -= gap
    return figure, panels


EVENTS = "events"
"""Label of event strip axes."""

_LETTER_WIDTH = 0.32
"""Space for the letter above a panel, inches."""


def letter_panels(figure: Figure) -> None:
    """Prefix the panel titles with (a), (b) and so on if there are several panels."""
    panels = [each for each in figure.axes if each.get_visible() and each.get_label() != EVENTS]
    where = mpl.rcParams["axes.titlelocation"]
    for number, axes in enumerate(panels if len(panels) > 1 else ()):
        axes.set_title(f"({chr(ord('a') + number % 26)}) {axes.get_title(where)}".rstrip())


_LEFT_EDGE = 0.03
"""Distance, in inches, from the left edge of a figure with extended panels to its labels."""


def widen_panels(figure: Figure) -> None:
    """Extend the panels of a single-column figure to the left as far as the labels allow."""
    places = [axes.get_position() for axes in figure.axes]
    if len({round(place.x0, 6) for place in places}) != 1:
        return
    if not all(axes.axison for axes in figure.axes):
        return
    boxes = [axes.yaxis.get_tightbbox() for axes in figure.axes]
    ends = [box.x0 for box in boxes if box is not None]
    spare = min(ends, default=0.0) / figure.dpi - _LEFT_EDGE
    share = spare / float(figure.get_size_inches()[0])
    if share <= 0:
        return
    for axes, place in zip(figure.axes, places, strict=True):
        axes.set_position((place.x0 - share, place.y0, place.width + share, place.height))


def new_figure(height: float) -> Figure:
    """Return an empty figure with the given height, inches."""
    figure = Figure(figsize=(width(), height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def panel(figure: Figure, x: float, y: float, width: float, height: float) -> Axes:
    """Add axes to a figure, given their lower left corner and their size in inches."""
    across, up = figure.get_size_inches()
    return figure.add_axes((x / across, y / up, width / across, height / up))


def room_for(names: Sequence[str]) -> float:
    """Return the width of the longest name, inches, for the margin to the right of a panel."""
    return 0.15 + 0.075 * max(map(len, names), default=0)


class PictureFormat(str, Enum):
    """Picture file format, by suffix."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"

    @classmethod
    def of(cls, path: Path) -> PictureFormat:
        """Return the format of a file.

        Raises
        ------
        SpaceRobotError
            The suffix matches no supported format.
        """
        try:
            return cls(path.suffix[1:].lower())
        except ValueError:
            raise SpaceRobotError(
                f"Pictures can be .png, .svg or .pdf, not '{path.name}'."
            ) from None


def picture_of(figure: Figure, format: PictureFormat, pixels: int = 1600) -> bytes:
    """Return a figure as file content; identical figures yield identical bytes.

    ``pixels`` is the PNG width; images in SVG and PDF have 200 pixels per inch.
    """
    across = float(figure.get_size_inches()[0])
    about = {
        PictureFormat.PNG: ("Software",),
        PictureFormat.SVG: ("Date", "Creator", "Format", "Type"),
        PictureFormat.PDF: ("CreationDate", "Creator", "Producer"),
    }
    stream = io.BytesIO()
    with warnings.catch_warnings():
        # Names in a script that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(
            stream,
            format=format.value,
            dpi=pixels / across if format is PictureFormat.PNG else 200,
            metadata=dict.fromkeys(about[format]),
        )
    if format is not PictureFormat.SVG:
        return stream.getvalue()
    # No screen shows less than a hundredth of a point.
    return _PATH_DATA.sub(lambda found: _DECIMALS.sub(rb"\1", found[0]), stream.getvalue())


def colour(index: int) -> str:
    """Return the colour of component or joint ``index``."""
    return PALETTE[index % len(PALETTE)]


_FLIGHT_DASHES = ((), (4.5, 1.2, 1.2, 1.2), (2.0, 1.0), (6.0, 1.2, 1.2, 1.2, 1.2, 1.2))


def flight_dashes(number: int) -> tuple[float, ...]:
    """Return the dash pattern for one of several flights in a panel; the first line is solid."""
    return _FLIGHT_DASHES[number % len(_FLIGHT_DASHES)]


def draw_traces(
    axes: Axes, signal: Signal, colours: Sequence[str], dashes: tuple[float, ...] = ()
) -> None:
    """Draw every column of a signal; for a dense signal, the extremes in each time slice."""
    for index, tint in enumerate(colours if len(signal) else ()):
        part = Signal(signal.time, signal.values[:, [index]]).thinned(TRACE_TIME_SLICES)
        axes.plot(
            part.time,
            part.values[:, 0],
            color=tint,
            ls=(0, dashes) if dashes else "-",
            marker="o" if len(signal) < 3 else "",
            ms=4,
        )


def set_range(
    axes: Axes, values: Array, extra: Sequence[float] = (), axis: Literal["x", "y"] = "y"
) -> None:
    """Set an axis to the value range with a margin, including nearby values of ``extra``.

    The axis spans at least 0.1 if the values are constant, so that rounding errors are not
    magnified.
    """
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    constant = high - low < max(1e-6, 1e-6 * max(abs(low), abs(high)))
    least = 0.1 if constant else 0.0
    span = max(high - low, least)
    near = [x for x in extra if low - 0.2 * span <= x <= high + 0.2 * span]
    low, high = min([low, *near]), max([high, *near])
    middle, half = (low + high) / 2, max(high - low, least) / 2
    axes.set(**{f"{axis}lim": (middle - 1.12 * half, middle + 1.12 * half)})
    ticks = MaxNLocator(5 if axis == "y" else 4, steps=[1, 2, 2.5, 5, 10])
    (axes.yaxis if axis == "y" else axes.xaxis).set_major_locator(ticks)


def log_range(values: Array, decades: int) -> tuple[float, float]:
    """Return logarithmic axis limits: ``decades`` powers of ten up to the largest value."""
    largest = float(np.nanmax(values, initial=0.0))
    top = float(np.ceil(np.log10(largest))) if largest > 0 else -15.0
    return 10.0 ** (top - decades), 10.0**top


def set_time(axes: Axes, start: float, end: float) -> None:
    """Set the x axis to a time span in s."""
    if end - start < 1e-9:
        start, end = start - 0.5, end + 0.5
    axes.set_xlim(start, end)
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]))
    axes.set_xlabel("time (s)")


def end_labels(axes: Axes, labels: Sequence[tuple[float, str, str]]) -> None:
    """Write the labels (value, text, colour) to the right of the axes, at the heights of the values
    and without overlaps."""
    ordered = sorted(labels)
    to_axes = axes.transData - axes.transAxes
    wanted = np.clip([to_axes.transform((0.0, value))[1] for value, _, _ in ordered], 0.0, 1.0)
    height = axes.get_window_extent().height / axes.figure.dpi
    gap = min(inches(0.155) / height, 1.0 / max(len(ordered) - 1, 1))
    for at, (_, text, tint) in zip(_separate_labels(wanted, gap), ordered, strict=True):
        axes.annotate(
            text,
            (1.0, float(at)),
            (5, 0),
            xycoords="axes fraction",
            textcoords="offset points",
            va="center",
            color=tint,
            annotation_clip=False,
        )


def _separate_labels(wanted: Array, gap: float) -> Array:
    """Move ascending positions (n,) in 0..1 apart until neighbours keep a gap."""
    at = wanted.copy()
    for _ in range(200):
        lacking = gap - np.diff(at)
        push = np.maximum(lacking, 0.0) / 2
        if not (push > 1e-4).any():
            break
        at[:-1] -= push
        at[1:] += push
        at = np.clip(at, 0.0, 1.0)
    return at


def legend_entry(tint: str, label: str, dashes: tuple[float, ...] = ()) -> Line2D:
    """Return a legend entry."""
    line = Line2D([], [], color=tint, linewidth=1.2, label=label)
    if dashes:
        line.set_linestyle((0, dashes))
    return line


def legend_above(axes: Axes, keys: Sequence[Line2D]) -> None:
    """Add a legend above the axes, right-aligned."""
    if keys:
        legend = axes.legend(
            handles=keys,
            loc="lower right",
            bbox_to_anchor=(1.0, 0.99),
            ncols=len(keys),
            borderaxespad=0.1,
            handlelength=1.6,
            columnspacing=1.2,
        )
        figure = axes.figure
        assert isinstance(figure, Figure)
        fit_legend(legend, axes.bbox.x1 - inches(_LETTER_WIDTH) * figure.dpi)


def fit_legend(legend: Legend, room: float) -> None:
    """Reduce the font size of a legend if it is wider than ``room`` pixels."""
    share = room / legend.get_window_extent().width
    for text in legend.get_texts() if share < 1.0 else ():
        text.set_fontsize(share * float(text.get_fontsize()))


LIMIT = "limit (URDF)"
"""Name of a joint limit in legends."""


@dataclass(frozen=True)
class TraceGroup:
    """Traces with a common unit that share a panel.

    Attributes
    ----------
    signal, names, colours
        The traces, with their names and colours; by default, those of the palette in order.
    label, unit
        Axis label and unit.
    goals
        (start, end, trace, value) for each goal.
    limits
        (trace, value) for each limit.
    limit_name
        Name of the limits in the legend.
    window
        Lower and upper end of the axis if high peaks are clipped; None if all values are shown.
    decades
        Number of powers of ten shown below the largest value on a logarithmic axis; 0 if linear.
    rows
        Whether each trace has a separate row of height one, as for duty cycles from 0 to 1.
    beside
        The same traces from other flights; empty signals if a flight lacks them.
    """

    signal: Signal
    names: Sequence[str]
    label: str
    unit: str
    colours: Sequence[str] = ()
    goals: Sequence[tuple[float, float, int, float]] = ()
    limits: Sequence[tuple[int, float]] = ()
    limit_name: str = LIMIT
    window: tuple[float, float] | None = None
    decades: int = 0
    rows: bool = False
    beside: Sequence[Signal] = ()

    def __post_init__(self) -> None:
        if not self.colours:
            object.__setattr__(self, "colours", [colour(k) for k in range(len(self.names))])

    @property
    def signals(self) -> list[Signal]:
        """Traces from all flights that contain them."""
        return [each for each in (self.signal, *self.beside) if len(each)]

    @property
    def height(self) -> float:
        """Height of the panel, inches."""
        if self.rows:
            return 0.4 + 0.14 * len(self.names)
        return 1.7 if self.decades else 2.3

    @property
    def values(self) -> Array:
        """All values from all flights, without gaps."""
        found = np.concatenate([np.empty(0), *(each.values.ravel() for each in self.signals)])
        return found[~np.isnan(found)]

    def in_unit_of_angles(self) -> TraceGroup:
        """Return the traces in the selected angle unit: degrees instead of radians if requested."""
        if not _look.get().degrees or not self.unit.startswith("rad"):
            return self
        factor, unit = angle_unit()
        return replace(
            self,
            signal=Signal(self.signal.time, factor * self.signal.values),
            unit=unit + self.unit.removeprefix("rad"),
            goals=[(start, end, k, factor * value) for start, end, k, value in self.goals],
            limits=[(k, factor * value) for k, value in self.limits],
            window=self.window and (factor * self.window[0], factor * self.window[1]),
        )


@dataclass(frozen=True)
class ReportFigure:
    """A report figure, as a picture and, if it shows values over time, as chart data.

    Attributes
    ----------
    name, heading, caption
        Short name (the id on a page), heading, and caption.
    figure
        The picture.
    groups
        The traces of its panels over the whole flight; none if the figure does not show values over
        time.
    """

    name: str
    heading: str
    caption: str
    figure: Figure
    groups: Sequence[TraceGroup] = ()

    @cached_property
    def svg(self) -> bytes:
        """The picture as SVG."""
        return picture_of(self.figure, PictureFormat.SVG)
