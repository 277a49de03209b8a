"""Figures over time as charts of a page: uPlot draws them, from numbers that are thinned out."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from spacerobot_ros.events import EventKind
from spacerobot_ros.report.events import mark_of
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.live import Live, own_file
from spacerobot_ros.report.plates import Group, Plate
from spacerobot_ros.report.signals import Signal, simplified

_MOST = 2000
_MOST_IN_SLICES = 5000
"""Samples of a chart that are kept, where those between lie on lines and where they do not."""

_UNSEEN = 5e-4
"""Of the extent of a trace, what a line may leave out."""

_MOST_EVENTS = 500


def charts_of(flight: Flight, plates: Sequence[Plate | str | None]) -> Live:
    """Return the charts of all figures that are over the time of a flight.

    Each figure that has some names them, by their numbers, in ``data-charts``
    (:func:`chart_numbers`).
    """
    groups = [group for plate in plates if isinstance(plate, Plate) for group in plate.groups]
    if not groups:
        return Live()
    charts = {
        "end": flight.end,
        "charts": [_chart(group) for group in groups],
        "events": _events(flight),
    }
    return Live(
        data={"charts": charts},
        programs=(own_file("vendor/uPlot.iife.min.js"), own_file("charts.js")),
        style=own_file("vendor/uPlot.min.css"),
        notices=(("uPlot", own_file("vendor/uPlot.LICENSE.txt")),),
    )


def _events(flight: Flight) -> list[dict[str, Any]]:
    """Return what happened; the last of several of one kind at once, which is seen, counts them."""
    found = []
    together: dict[tuple[float, EventKind], list[str]] = {}
    for each in sorted(flight.events, key=lambda each: each.time)[:_MOST_EVENTS]:
        sentences = together.setdefault((each.time, each.event.kind), [])
        text = f"{each.text} (+{len(sentences)})" if sentences else each.text
        sentences.append(each.event.sentence)
        said = {"time": each.time, "sentence": " ".join(sentences), "text": text}
        found.append({**said, **mark_of(each.event.kind)})
    return found


def chart_numbers(plates: Sequence[Plate | str | None]) -> dict[str, str]:
    """Return the numbers of the charts of each figure, by its name."""
    found, first = {}, 0
    for plate in plates:
        if isinstance(plate, Plate) and plate.groups:
            found[plate.name] = " ".join(str(first + k) for k in range(len(plate.groups)))
            first += len(plate.groups)
    return found


def _chart(group: Group) -> dict[str, Any]:
    signal = thinned(group.signal)
    values = signal.values
    if group.decades:
        largest = float(np.nanmax(values, initial=0.0))
        top = np.ceil(np.log10(largest)) if largest > 0 else -15.0
        # uPlot's own logarithmic axes go wrong with numbers as small as rounding errors.
        values = np.log10(np.maximum(values, 10.0 ** (top - group.decades)))
    if group.rows:
        values = values * 0.8 + np.arange(values.shape[1])[::-1]
    low, high = _extent(group)
    return {
        "label": group.label,
        "unit": group.unit,
        "names": list(group.names),
        "colours": list(group.colours),
        "time": _packed(signal.time, "<f8"),
        "values": [_packed(column, "<f4") for column in values.T],
        "goals": [list(map(float, goal)) for goal in group.goals],
        "limits": [[k, value] for k, value in group.limits if low < value < high],
        "window": group.window,
        "log": group.decades > 0,
        "rows": group.rows,
    }


def _extent(group: Group) -> tuple[float, float]:
    """Return where limits are near enough to be drawn."""
    goals = np.array([goal[3] for goal in group.goals])
    numbers = np.append(group.signal.values, goals)
    low, high = group.window or (float(np.min(numbers)), float(np.max(numbers)))
    span = max(high - low, 1e-6)
    return low - 0.2 * span, high + 0.2 * span


def thinned(signal: Signal) -> Signal:
    """Return fewer samples that look alike: those off the lines between others or, where these
    would be too many, the smallest and the largest of every trace in each slice of time.
    """
    if len(signal) <= _MOST:
        return signal
    extent = np.maximum(np.ptp(signal.values, axis=0), 1e-300)
    kept, off = simplified(Signal(signal.time, signal.values / (_UNSEEN * extent)), _MOST)
    if off > 1.0:
        slices = max(1, _MOST_IN_SLICES // (2 * signal.width + 1))
        edges = np.unique(np.linspace(0, len(signal), slices + 1).astype(int))
        parts = [edges[:-1], np.array([len(signal) - 1])]
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            part = signal.values[a:b]
            parts += [a + part.argmin(axis=0), a + part.argmax(axis=0)]
        kept = np.unique(np.concatenate(parts))
    return Signal(signal.time[kept], signal.values[kept])


def _packed(values: Any, kind: str) -> str:
    """Return numbers as the text of their bytes, little-endian."""
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()
