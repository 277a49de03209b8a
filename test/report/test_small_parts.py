"""Small parts of reports, each against numbers by hand."""

from __future__ import annotations

import base64
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from support.made_flights import made_flight

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.flight import Signal
from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.report import figures, figures_space, page, scene, solids
from spacerobot_ros.report.events import _MARKS, FlightEvent, draw_events, timed_events
from spacerobot_ros.report.figures import (
    TraceGroup,
    draw_traces,
    drawing,
    end_labels,
    largest_over_time,
    legend_above,
    new_figure,
    panel,
    room_for,
    scaled,
    set_range,
    set_time,
    sheet,
    short,
)
from spacerobot_ros.report.figures_over_time import (
    _match_times,
    draw_whole_flight,
    power_of_ten,
    range_without_peaks,
    time_figure,
)
from spacerobot_ros.report.page import charts_of, thin_out
from spacerobot_ros.report.signals import (
    Cycles,
    _farthest_sample,
    _period_in_samples,
    envelope,
    find_cycles,
    nearest_rotvec,
    rotvecs,
    simplified,
)
from spacerobot_ros.report.solids import Canvas, Edge, Face, View
from spacerobot_ros.report.tables import _count_decimals, _format_attitude, _recorded_text


def axes_of(low: float = 0.0, high: float = 1.0) -> Axes:
    """Return axes 4 inches high and 2.5 wide."""
    figure = Figure(figsize=(5.0, 8.0), dpi=100)
    axes = figure.add_axes((0.25, 0.25, 0.5, 0.5))
    axes.set_ylim(low, high)
    return axes


def signal_of(*columns: Any, step: float = 0.25) -> Signal:
    values = np.column_stack([np.asarray(column, dtype=float) for column in columns])
    return Signal(step * np.arange(len(values), dtype=np.float64), values)


# -- axes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "extra", "least", "bounds"),
    [
        ([1.0, 3.0], (), 0.0, (2 - 1.12, 2 + 1.12)),
        ([1.0, math.nan, math.inf, 3.0], (), 0.0, (2 - 1.12, 2 + 1.12)),
        ([1.0, 3.0], (), 4.0, (2 - 2.24, 2 + 2.24)),
        # Limits a fifth of the range away are in sight, and farther ones are not.
        ([1.0, 3.0], (0.6, 3.4), 0.0, (2 - 1.12 * 1.4, 2 + 1.12 * 1.4)),
        ([1.0, 3.0], (0.59, 3.41), 0.0, (2 - 1.12, 2 + 1.12)),
        ([5.0, 5.0], (), 0.0, (5 - 0.056, 5 + 0.056)),
        ([5.0, 5.0], (), 0.5, (5 - 0.28, 5 + 0.28)),
        ([2e6, 2e6 + 1.0], (), 0.0, (2e6 + 0.5 - 0.56, 2e6 + 0.5 + 0.56)),
        ([0.0, 2e-6], (), 0.0, (1e-6 - 1.12e-6, 1e-6 + 1.12e-6)),
        ([0.0, 0.9e-6], (), 0.0, (0.45e-6 - 0.056, 0.45e-6 + 0.056)),
        ([], (), 0.0, (-0.056, 0.056)),
    ],
)
def test_the_range_of_an_axis(
    values: list[float], extra: tuple[float, ...], least: float, bounds: tuple[float, float]
) -> None:
    axes = axes_of()
    set_range(axes, np.array(values), extra, least)
    assert axes.get_ylim() == pytest.approx(bounds, rel=1e-12)


@pytest.mark.parametrize(
    ("span", "bounds"), [((1.0, 4.0), (1.0, 4.0)), ((2.0, 2.0), (1.5, 2.5)), ((0, 1e-9), (0, 1e-9))]
)
def test_the_time_of_an_axis(span: tuple[float, float], bounds: tuple[float, float]) -> None:
    axes = axes_of()
    set_time(axes, *span, label=False)
    assert axes.get_xlim() == pytest.approx(bounds)
    assert axes.get_xlabel() == ""
    set_time(axes, *span)
    assert axes.get_xlabel() == "time (s)"


def test_labels_at_the_ends_of_traces_keep_apart() -> None:
    axes = axes_of(10.0, 20.0)
    end_labels(axes, [(15.0, "b", "#111111"), (15.0, "c", "#222222"), (40.0, "d", "#333333")])
    places = {text.get_text(): text.xy[1] for text in axes.texts}  # type: ignore[attr-defined]
    gap = 0.155 / 4.0
    assert places["d"] == 1.0
    assert places["b"] == pytest.approx(0.5 - gap / 2, abs=2e-4)
    assert places["c"] == pytest.approx(0.5 + gap / 2, abs=2e-4)
    assert [text.get_color() for text in axes.texts] == ["#111111", "#222222", "#333333"]
    np.testing.assert_allclose(
        figures._separate_labels(np.array([0.0, 0.0, 0.5]), 0.25), [0.0, 0.25, 0.5], atol=2e-3
    )
    low = Figure(figsize=(5.0, 0.2)).add_axes((0.0, 0.0, 1.0, 1.0))
    end_labels(low, [(0.5, str(k), "#111111") for k in range(3)])
    heights = [text.xy[1] for text in low.texts]  # type: ignore[attr-defined]
    assert heights == pytest.approx([0.0, 0.5, 1.0], abs=2e-3)


@pytest.mark.parametrize(
    ("unit", "largest", "expected"),
    [
        ("m", 0.05, (1.0, "m")),
        ("m", 0.049, (1e3, "mm")),
        ("rad", 5e-5, (1e3, "mrad")),
        ("rad", 4.9e-5, (1e6, "µrad")),
        ("m", 0.0, (1.0, "m")),
        ("N", 1e-3, (1.0, "N")),
    ],
)
def test_units_suit_their_values(unit: str, largest: float, expected: tuple[float, str]) -> None:
    assert scaled(unit, largest) == expected


def test_names_are_cut_in_their_middle() -> None:
    name = "abcdefghijklmnopqrstuvw"
    assert short(name[:22]) == name[:22]
    assert short(name) == "abcdefghij…mnopqrstuvw"
    assert room_for(["a", "abcd"]) == pytest.approx(0.45)
    assert room_for([]) == 0.15
    assert [figures.colour(k) for k in (0, 9, 10)] == ["#0072B2", "#44AA99", "#0072B2"]
    assert [power_of_ten(x) for x in (1e-15, 1e3, 1.0, 2e-7)] == ["10⁻¹⁵", "10³", "10⁰", "10⁻⁷"]


def test_a_sheet_has_rows_of_panels() -> None:
    with drawing(10.0):
        figure, rows = sheet([[1.0], [2.0, 1.0]], [2.0, 1.0], left=1.0, right=0.5, lane=0.25)
        width, height = figure.get_size_inches()
        # Above, rows, gap with a lane, below with a lane.
        assert (width, height) == pytest.approx((10.0, 0.3 + 3.0 + 0.87 + 0.75))
        found = [each.get_position().bounds for row in rows for each in row]
        inches = np.array(found) * [width, height, width, height]
        across = 10.0 - 1.5 - 1.4
        np.testing.assert_allclose(
            inches,
            [
                [1.0, 2.62, 8.5, 2.0],
                [1.0, 0.75, across * 2 / 3, 1.0],
                [1.0 + across * 2 / 3 + 1.4, 0.75, across / 3, 1.0],
            ],
        )
    with drawing(2.0), pytest.raises(SpaceRobotError) as refused:
        sheet([[1.0]], [1.0], left=1.0, right=1.0)
    assert str(refused.value) == (
        "Letters of 8.5 points leave no room for panels in a figure 50.8 mm wide."
    )
    for width, left in ((5.99, 0.95), (6.0, 0.72)):
        with drawing(width):
            _, ((axes,),) = sheet([[1.0]], [1.0])
            assert axes.get_position().x0 * width == pytest.approx(left)
    with drawing(5.99):
        _, ((axes,),) = sheet([[1.0]], [1.0], left=0.5)
        assert axes.get_position().x0 * 5.99 == pytest.approx(0.5)


def test_a_larger_font_makes_a_larger_sheet(tmp_path: Any) -> None:
    style = tmp_path / "own.mplstyle"
    style.write_text("font.size: 17\n")
    with drawing(12.0, own=style):
        assert figures.inches(0.5) == 1.0
        assert not figures.narrow()
        figure, _ = sheet([[1.0]], [2.0])
        assert figure.get_size_inches()[1] == pytest.approx(2 * (0.3 + 2.0 + 0.5))
    with drawing(11.9, own=style):
        assert figures.narrow()
    assert figures.inches(0.5) == 0.5
    for size in (3.0, 30.0):
        style.write_text(f"font.size: {size}\n")
        with drawing(own=style):
            assert mpl.rcParams["font.size"] == size
    for size in (2.9, 30.1):
        style.write_text(f"font.size: {size}\n")
        with pytest.raises(SpaceRobotError, match="3 to 30 points"), drawing(own=style):
            pass


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_samples_are_marked(count: int) -> None:
    axes = axes_of()
    assert not draw_traces(axes, signal_of([0.25, 0.5, 0.75][:count]), ["#112233"], factor=2.0)
    line: Any = axes.lines[0]
    assert len(axes.lines) == 1
    assert line.get_marker() == ("o" if count < 3 else "")
    np.testing.assert_array_equal(line.get_ydata(), [0.5, 1.0, 1.5][:count])
    assert line.get_markersize() == 4
    assert not draw_traces(axes, Signal.empty(1), ["#112233"])
    assert len(axes.lines) == 1


def test_a_dense_trace_is_a_band_and_a_smooth_one_a_line() -> None:
    """In twenty slices, the fewest."""
    axes = axes_of()
    signal = signal_of(np.tile([0.0, 1.0, 0.25, 0.75], 50), np.linspace(0, 1, 200))
    assert draw_traces(axes, signal, ["#0000ff", "#ff0000"], 1e-3, 2.0)
    assert not draw_traces(axes_of(), signal, ["#0000ff", "#ff0000"], 0.5, 2.0)
    band: Any = axes.collections[0]
    assert len(axes.collections) == 1
    np.testing.assert_allclose(band.get_facecolor(), [[0.0, 0.0, 1.0, 0.3]])
    np.testing.assert_allclose(band.get_edgecolor(), [[0.0, 0.0, 1.0, 1.0]])
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (0.0, 2.0)
    line: Any = axes.lines[0]
    assert len(axes.lines) == 1
    assert line.get_color() == "#ff0000"
    assert len(np.asarray(line.get_xdata())) <= 65
    assert len(band.get_paths()[0].vertices) == 2 * 20 + 3


def test_a_trace_is_simplified_to_what_can_be_seen() -> None:
    ramp = np.linspace(0.0, 1.0, 1001)
    kink = ramp.copy()
    kink[505] += 4.9e-4
    for values, seen in ((kink, False), (kink + 2e-5 * (ramp == ramp[505]), True)):
        axes = axes_of()
        draw_traces(axes, signal_of(values), ["#000000"])
        times: Any = axes.lines[0].get_xdata()
        assert (0.25 * 505 in times) is seen
        assert len(times) < 80


def test_the_largest_values_of_a_dense_column() -> None:
    few = signal_of(np.zeros(480), np.arange(480))
    time, values = largest_over_time(few, 1)
    assert time is few.time
    np.testing.assert_array_equal(values, np.arange(480))
    time, values = largest_over_time(signal_of(np.zeros(481), np.arange(481)), 1)
    assert len(time) == len(values) == 240
    np.testing.assert_array_equal(values, np.arange(2, 481, 2))


def test_a_key_stands_above_its_axes() -> None:
    axes = axes_of()
    legend_above(axes, [])
    assert axes.get_legend() is None
    entry = figures.legend_entry("#123456", "name")
    dashed = figures.legend_entry("#123456", "other", (2.0, 1.0))
    assert (entry.get_linestyle(), dashed.get_linestyle()) == ("-", "--")
    assert (entry.get_color(), entry.get_linewidth(), entry.get_label()) == ("#123456", 1.2, "name")
    legend_above(axes, [entry, dashed])
    assert axes.get_legend() is not None


def test_goals_limits_and_peaks_of_a_group() -> None:
    """Two limits of one value are one line; limits out of sight are left out."""
    flight: Any = SimpleNamespace(executing=[(0.5, None)], end=3.0)
    signal = signal_of([0.0, 1.0, 0.5], [1.0, 0.0, 0.25])
    group = TraceGroup(signal, ["a", "b"], "label", "m", ["#0000ff", "#ff0000"])
    axes = axes_of()
    limits = [(0, 1.125), (1, 1.125), (1, -0.125), (0, 9.0)]
    assert not draw_whole_flight(axes, flight, replace(group, limits=limits))
    levels = {line.get_ydata()[0]: line.get_color() for line in axes.lines[:2]}  # type: ignore[index]
    assert levels == {1.125: figures.SECONDARY_COLOUR, -0.125: "#ff0000"}
    assert len(axes.lines) == 4
    assert axes.get_ylabel() == "label (m)"
    assert axes.get_xlim() == (0.0, 3.0)
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["limit (URDF)"]
    axes = axes_of()
    draw_whole_flight(axes, flight, replace(group, window=(0.0, 0.5)))
    assert axes.get_title("left") == "peaks of 1 m are beyond the axis"
    assert axes.get_ylim() == pytest.approx((0.25 - 0.28, 0.25 + 0.28))
    axes = axes_of()
    draw_whole_flight(axes, flight, replace(group, window=(0.0, 0.5), limits=[(0, 0.5)]))
    assert axes.get_title("right") == "peaks of 1 m are beyond the axis"


def test_duty_cycles_have_rows() -> None:
    """A value holds from the sample before; dense ones are the largest in each slice."""
    flight: Any = SimpleNamespace(timed_events=(), cycles=None, end=10.0)
    for count, dense in ((1920, False), (1921, True)):
        values = np.zeros((count, 2))
        values[100, 0] = 1.0
        signal = Signal(np.linspace(0, 10, count), values)
        group = TraceGroup(signal, ["a", "b"], "thrusters", "share", ["#0000ff", "#ff0000"])
        with drawing():
            found = time_figure(flight, "name", "Heading", "Caption", [replace(group, rows=True)])
        assert isinstance(found, figures.ReportFigure)
        (axes,) = found.figure.axes
        assert ("Where a trace has more samples" in found.caption) is dense
        assert axes.get_ylim() == (-0.2, 2)
        assert axes.get_yticks().tolist() == [1.4, 0.4]
        assert [each.get_text() for each in axes.get_yticklabels()] == ["a", "b"]
        assert axes.get_title("left") == "thrusters (share)"
        first, second = list[Any](axes.collections)
        heights = np.concatenate([path.vertices[:, 1] for path in first.get_paths()])
        assert (heights.min(), heights.max()) == (1.0, 1.8)
        assert not second.get_paths() or not len(second.get_paths()[0].vertices)
        assert found.figure.get_size_inches()[1] == pytest.approx(0.3 + 0.68 + 0.5)


@pytest.mark.parametrize(
    ("peak", "window"),
    [(2.9, None), (3.1, (-0.3, 1.3)), (1e4 + 1, None), (9.9e3, (-0.3, 1.3)), (-1.9, None)],
)
def test_peaks_beyond_a_range(peak: float, window: tuple[float, float] | None) -> None:
    values = np.tile([0.0, 1.0], 200)
    values[7] = peak
    found = range_without_peaks(signal_of(values))
    if window is None:
        assert found is None
    else:
        assert found == pytest.approx((0.0, 1.3))
    assert range_without_peaks(Signal.empty(2)) is None


def test_measured_times_are_matched_within_a_nanosecond() -> None:
    true = signal_of([5.0, 6.0, 7.0], step=1.0)
    time = np.array([-1.0, 0.0, 1.0 + 9e-10, 1.0 + 2e-9, 2.0 - 9e-10, 3.0])
    found, at = _match_times(Signal(time, np.arange(6.0)[:, np.newaxis]), true)
    assert found.values[:, 0].tolist() == [1.0, 2.0, 4.0]
    assert at.tolist() == [0, 1, 2]
    none, at = _match_times(signal_of([1.0]), Signal.empty(1))
    assert (len(none), len(at), none.width) == (0, 0, 1)


# -- time series ----------------------------------------------------------------------------------


def test_an_envelope_by_hand() -> None:
    signal = signal_of(np.zeros(7), [1.0, 5.0, 2.0, 0.0, 3.0, 4.0, 9.0])
    time, low, high = envelope(signal, 1, 3)
    # Slices are connected: each reaches to the first sample of the next.
    np.testing.assert_array_equal(low, [1.0, 0.0, 3.0])
    np.testing.assert_array_equal(high, [5.0, 3.0, 9.0])
    np.testing.assert_array_equal(time, [0.0, 0.75, 1.5])


def test_a_line_is_simplified_by_its_worst_samples() -> None:
    # Every twentieth sample is kept anyhow.
    ramp = np.zeros(1281)
    ramp[[305, 709, 1011]] = 1.5, -4.0, 2.5
    kept, off = simplified(signal_of(ramp), 65)
    assert (len(kept), off) == (65, 4.0)
    kept, off = simplified(signal_of(ramp), 66)
    assert set(kept.tolist()) - set(range(0, 1281, 20)) == {709}
    one, off = simplified(signal_of([1.0]), 5)
    assert (one.tolist(), off) == ([0], 0.0)
    two, off = simplified(signal_of([1.0, 2.0]), 5)
    assert (two.tolist(), off) == ([0, 1], 0.0)


def test_a_line_is_simplified_whose_time_begins_again() -> None:
    """A plant was killed and started again."""
    time = np.tile(0.05 * np.arange(300.0), 2)
    values = 50.0 * np.random.default_rng(4).random((600, 1))
    kept, off = simplified(Signal(time, values), 200)
    assert len(kept) == 200
    assert (np.diff(kept) > 0).all()
    assert 1.0 < off < np.inf
    kept, off = simplified(Signal(time, np.zeros((600, 1))), 200)
    assert (len(kept), off) == (65, 0.0)


def test_a_sample_counts_by_its_distance_from_the_line_in_time() -> None:
    time = np.array([0.0, 1.0, 10.0])
    motion = Signal(time, np.array([[0.0, 0.0], [2.0, -3.0], [10.0, 0.0]]))
    assert _farthest_sample(motion, 0, 2) == (-3.0, 0, 2, 1)
    assert _farthest_sample(motion, 0, 1) == (0.0, 0, 1, 0)
    still = Signal(np.zeros(3), motion.values)
    assert _farthest_sample(still, 0, 2) == (-3.0, 0, 2, 1)


@pytest.mark.parametrize(
    ("turn", "near", "expected"),
    [
        (1.0, 1.0, 1.0),
        (1.0, 1.0 + 2 * math.pi, 1.0 + 2 * math.pi),
        (1.0, -5.0, 1.0 - 2 * math.pi),
        (1.0, 4.1, 1.0),
        (1.0, 4.2, 1.0 + 2 * math.pi),
        (0.0, 9.0, 0.0),
    ],
)
def test_the_nearest_rotation_vector(turn: float, near: float, expected: float) -> None:
    axis = np.array([0.6, 0.0, -0.8])
    found = nearest_rotvec(turn * axis, near * axis + [0.0, 5.0, 0.0])
    np.testing.assert_allclose(found, expected * axis, atol=1e-12)


def test_attitudes_of_no_large_turn_stay_as_they_are() -> None:
    given = np.outer([0.0, 1.0, 3.1], [0.0, 0.6, 0.8])
    found = rotvecs(np.array([quaternion_from_rotvec(each) for each in given]))
    np.testing.assert_allclose(found, given, atol=1e-12)


def looped(cycles: int, period: int, before: int = 0, after: int = 0) -> Signal:
    """Return rates of two joints that are zero, then equal cycles, then zero."""
    phase = 2 * np.pi * np.arange(cycles * period) / period
    loops = np.column_stack([np.sin(phase), 0.5 * np.cos(2 * phase)])
    values = np.vstack([np.zeros((before, 2)), loops, np.zeros((after, 2))])
    return Signal(0.25 * np.arange(len(values), dtype=np.float64), values)


@pytest.mark.parametrize(
    ("cycles", "period", "before", "after", "found"),
    [
        (14, 10, 0, 0, (0.0, 34.75, 2.5)),
        (12, 10, 0, 0, (0.0, 29.75, 2.5)),
        (11, 10, 0, 0, None),
        (14, 10, 0, 9, (0.0, 35.0, 2.5)),
        (14, 10, 30, 0, (7.5, 42.25, 2.5)),
        (3, 4, 0, 0, None),
    ],
)
def test_equal_cycles_are_twelve_at_least(
    cycles: int,
    period: int,
    before: int,
    after: int,
    found: tuple[float, float, float] | None,
) -> None:
    cycle = find_cycles(looped(cycles, period, before, after))
    if found is None:
        assert cycle is None
        return
    assert cycle is not None
    assert (cycle.start, cycle.end) == pytest.approx(found[:2], abs=0.26)
    assert cycle.period == pytest.approx(found[2])


def test_cycles_that_differ_by_a_tenth_of_the_peak_are_equal() -> None:
    for more, equal in ((0.09, True), (0.12, False)):
        rates = looped(16, 10)
        values = rates.values.copy()
        values[82, 0] += more
        cycle = find_cycles(Signal(rates.time, values))
        assert (cycle is not None) is equal
    # The same with one joint that rests, and in any unit.
    wide = np.column_stack([1e-3 * rates.values, np.zeros(len(rates))])
    assert find_cycles(Signal(rates.time, wide)) is not None


def test_the_period_in_samples() -> None:
    phase = 2 * np.pi * np.arange(240) / 12
    values = np.column_stack([np.sin(phase), 0.25 * np.sin(2 * phase)])
    assert _period_in_samples(values) == 12
    assert _period_in_samples(np.ones((60, 1))) is None
    assert _period_in_samples(np.random.default_rng(3).normal(size=(90, 2))) is None


def test_the_last_cycles() -> None:
    cycles = Cycles(1.0, 10.0, 1.5)
    assert (cycles.count, cycles.last(2)) == (6, (7.0, 10.0))


# -- solids ---------------------------------------------------------------------------------------

ABOVE = View(-90.0, 90.0)
"""From above: x to the right, y upwards."""
RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def square(x: float, y: float, z: float, size: float, fill: tuple[float, float, float]) -> Face:
    corners = np.array([[x, y, z], [x + size, y, z], [x + size, y + size, z], [x, y + size, z]])
    return Face(corners, np.array([0.0, 0.0, 1.0]), fill)


def test_views() -> None:
    np.testing.assert_allclose(ABOVE.paper_axes, [[1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(ABOVE.viewing_direction, [0, 0, 1], atol=1e-12)
    ahead = View(0.0, 0.0)
    np.testing.assert_allclose(ahead.paper_axes, [[0, 1, 0], [0, 0, 1]], atol=1e-12)
    a, e = np.radians([-58.0, 24.0])
    expected = [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
    np.testing.assert_allclose(View().viewing_direction, expected)
    light = np.array([0.35, -0.1, 1.9])
    face = square(0, 0, 0, 1, (1.0, 0.5, 0.25))
    shade = 0.72 + 0.28 * 1.9 / np.linalg.norm(light)
    np.testing.assert_allclose(ABOVE.shade(face), shade * np.array([1.0, 0.5, 0.25]))
    below = replace(face, normal=-face.normal)
    np.testing.assert_allclose(ABOVE.shade(below), 0.72 * np.array([1.0, 0.5, 0.25]))


def drawn(faces: list[Face], edges: list[Edge] | None = None) -> Array:
    """Return a picture of 8 by 4 pixels from (0, 0) to (8, 4), its lowest row first."""
    canvas = Canvas(ABOVE, np.zeros(2), np.array([8.0, 4.0]), 8)
    canvas.draw(faces, edges or [])
    image = canvas.image()
    assert image.shape == (4, 8, 4)
    return np.asarray(image[::-1], float)


def test_a_face_covers_its_pixels() -> None:
    image = drawn([square(1.0, 1.0, 0.0, 2.0, RED)])
    expected = np.zeros((4, 8), bool)
    expected[1:3, 1:3] = True
    np.testing.assert_array_equal(image[..., 3] > 0, expected)
    assert set(np.unique(image[..., 3])) == {0.0, 1.0}
    shade = float(ABOVE.shade(square(0, 0, 0, 1, RED))[0])
    np.testing.assert_allclose(image[1, 1, :3], [shade, 0.0, 0.0], rtol=1e-6)
    # Half a pixel is half transparent, and keeps its colour.
    half = drawn([square(1.5, 1.0, 0.0, 1.0, RED)])
    np.testing.assert_allclose(half[1, 1], [shade, 0.0, 0.0, 0.5], rtol=1e-6)
    np.testing.assert_allclose(half[1, 2], [shade, 0.0, 0.0, 0.5], rtol=1e-6)


def test_faces_beyond_the_picture_are_cut_off() -> None:
    image = drawn([square(-3.0, -3.0, 0.0, 5.0, RED), square(7.0, 3.0, 0.0, 9.0, BLUE)])
    covered = image[..., 3] > 0
    expected = np.zeros((4, 8), bool)
    expected[:2, :2] = expected[3, 7] = True
    np.testing.assert_array_equal(covered, expected)
    assert not drawn([square(9.0, 9.0, 0.0, 1.0, RED)]).any()
    away = replace(square(1, 1, 0, 2, RED), normal=np.array([0.0, 0.0, -1.0]))
    assert not drawn([away]).any()


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_face_hides_the_other(order: int) -> None:
    low, high = square(0.0, 0.0, 1.0, 4.0, RED), square(2.0, 0.0, 1.5, 2.0, BLUE)
    image = drawn([low, high][::order])
    assert (image[1, 1, 0] > 0, image[1, 1, 2] > 0) == (True, False)
    assert (image[1, 2, 0] > 0, image[1, 2, 2] > 0) == (False, True)


def test_a_sloping_face_hides_by_its_depth_at_each_place() -> None:
    """It rises along x through a level one, which it hides from the middle on."""
    corners = np.array([[0.0, 0, -2.0], [8.0, 0, 2.0], [8.0, 4.0, 2.0], [0.0, 4.0, -2.0]])
    slope = Face(corners, np.array([-0.5, 0.0, 1.0]) / math.hypot(0.5, 1.0), RED)
    for faces in ([slope, square(0.0, 0.0, 0.0, 8.0, BLUE)], [square(0, 0, 0, 8, BLUE), slope]):
        image = drawn(faces)
        assert (image[:, :4, 2] > 0).all()
        assert (image[:, 4:, 0] > 0).all()


def test_edges_are_three_fine_pixels_wide_and_hidden_behind_faces() -> None:
    line = np.array([[1.1, 2.1, 0.0], [5.1, 2.1, 0.0]])
    image = drawn([], [Edge(line, np.empty((0, 2, 3)), BLUE)])
    rows, columns = np.nonzero(image[..., 3] > 0)
    assert (set(rows.tolist()), columns.min(), columns.max()) == ({1, 2}, 0, 5)
    assert image[2, 3, 3] == 1.0
    assert image[1, 3, 3] == 0.5
    cover = square(0.0, 0.0, 10.0, 8.0, RED)
    hidden = drawn([cover], [Edge(line, np.empty((0, 2, 3)), BLUE)])
    assert not hidden[..., 2].any()
    # An edge lies in its own face, and is drawn over it.
    same = square(0.0, 0.0, 0.0, 8.0, RED)
    assert drawn([same], [Edge(line, np.empty((0, 2, 3)), BLUE)])[2, 3, 2] == 1.0
    up, down = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]
    for normals, seen in (([up, down], True), ([down, up], True), ([down, down], False)):
        edge = Edge(line, np.array([normals]), BLUE)
        assert drawn([], [edge]).any() == seen


def test_a_base_without_visuals_is_a_cross() -> None:
    pose = Pose(np.array([[0.0, -1, 0], [1.0, 0, 0], [0, 0, 1.0]]), np.array([1.0, 2.0, 3.0]))
    lines = solids._cross_lines(pose)
    np.testing.assert_allclose(lines[0], [[1.0, 1.9, 3.0], [1.0, 2.1, 3.0]])
    np.testing.assert_allclose(lines[1], [[1.1, 2.0, 3.0], [0.9, 2.0, 3.0]])
    np.testing.assert_allclose(lines[2], [[1.0, 2.0, 2.9], [1.0, 2.0, 3.1]])
    assert [solids.body_color(k) for k in (0, 1, 2)] == ["#c4c9d2", "#0072B2", "#D55E00"]


@pytest.mark.parametrize(
    ("longest", "length"), [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (0.0499, 0.02), (70.0, 50.0)]
)
def test_lengths_of_scale_bars_are_round(longest: float, length: float) -> None:
    assert figures_space._round_length(longest) == pytest.approx(length)


# -- events and tables ----------------------------------------------------------------------------


def event(time: float, kind: EventKind = EventKind.CORRECTION, **about: str) -> FlightEvent:
    return FlightEvent(time, "/planner", Event(kind, f"At {time:g} s.", about=about))


@pytest.mark.parametrize(
    ("count", "folded", "more"), [(20, False, 0), (21, True, 0), (200, True, 0), (201, True, 1)]
)
def test_tables_of_many_events_are_folded_and_cut(count: int, folded: bool, more: int) -> None:
    text = "".join(page._events_html([event(float(count - k)) for k in range(count)]))
    assert ("<details>" in text) is folded
    assert (f"<summary>{count} events</summary>" in text) is folded
    assert (f'<p class="facts">{more} more are in the bag.</p>' in text) is (more > 0)
    assert text.count("<tr>") == 1 + min(count, 200)
    assert text.index("At 1 s.") < text.index("At 2 s.")
    assert page._events_html([]) == []


def test_events_of_charts_are_the_first_five_hundred() -> None:
    events = [event(k / 4) for k in range(502)][::-1]
    found = page._chart_events(SimpleNamespace(timed_events=events))  # type: ignore[arg-type]
    assert len(found) == 500
    assert (found[0]["time"], found[-1]["time"]) == (0.0, 499 / 4)
    twice = [event(1.0), event(1.0), event(1.0, EventKind.LATCHED)]
    found = page._chart_events(SimpleNamespace(timed_events=twice))  # type: ignore[arg-type]
    assert [each["text"] for each in found] == ["correction", "correction (+1)", "latched"]
    assert found[1]["sentence"] == "At 1 s. At 1 s."
    assert [each["strong"] for each in found] == [False, False, True]


def test_times_of_events_are_stamps_or_log_times() -> None:
    def made(time_s: float | None, kind: EventKind = EventKind.LATCHED) -> Event:
        return Event(kind, ".", time_s=time_s)

    events = [
        (2_000_000_000, "/a", made(7.0)),
        (3_000_000_000, "/b", made(None)),
        (4_000_000_000, "/c", made(math.nan)),
        (5_000_000_000, "/d", made(1e13)),
        (6_000_000_000, "/e", made(8.0, EventKind.CONFIGURED)),
    ]
    found = timed_events(events, 1.5, stamped=True)
    assert [(each.node, each.time) for each in found] == [("/a", 5.5), ("/b", 1.5)]
    found = timed_events(events, 1.5, stamped=False)
    assert [each.time for each in found] == [0.5, 1.5, 2.5, 3.5]


@pytest.mark.parametrize(("kinds", "size"), [(8, 7.0), (9, 5.5)])
def test_the_key_of_events_is_smaller_where_there_are_many(kinds: int, size: float) -> None:
    shown = [event(0.5, kind) for kind in list(_MARKS)[:kinds]]
    for width, columns in ((9.6, kinds), (4.0, 4)):
        with drawing(width):
            figure = new_figure(4.0)
            axes = panel(figure, 0.0, 2.0, width, 1.0)
            draw_events(axes, [*shown, event(1.5), event(-0.5)])
            lane = figure.axes[1]
            legend = lane.get_legend()
            assert legend is not None
            assert legend._ncols == columns  # type: ignore[attr-defined]
            assert {text.get_fontsize() for text in legend.get_texts()} == {size}
            assert len(legend.get_texts()) == kinds
            bounds = np.array(lane.get_position().bounds) * [width, 4.0, width, 4.0]
            np.testing.assert_allclose(bounds, [0.0, 2.0 - 0.44 - 0.24, width, 0.24])


def test_texts_of_tables() -> None:
    assert [_count_decimals(x) for x in (1.0, 1.25, 1e-7, 30.5)] == [0, 2, 0, 1]
    assert _format_attitude([0.0, -0.3, 0.4]) == (
        "rotation vector (0.00000, -0.30000, 0.40000) rad, 28.648° in all"
    )
    one: Any = SimpleNamespace(position=signal_of([1.0]))
    assert _recorded_text(one) == "1 state"
    two: Any = SimpleNamespace(position=signal_of([1.0, 2.0]), tick=0.25)
    assert _recorded_text(two) == "0.25 s, 1 ticks of 0.25 s"


# -- charts and key frames ------------------------------------------------------------------------


def numbers(text: str, kind: str) -> list[float]:
    return [float(x) for x in np.frombuffer(base64.b64decode(text), kind)]


def test_charts_of_groups() -> None:
    flight: Any = SimpleNamespace(end=1.0, timed_events=[])
    signal = signal_of([0.0, 1e-3, 100.0], [1.0, 2.0, 0.0])
    group = TraceGroup(signal, ["a", "b"], "label", "m", ["#0", "#1"], goals=[(0.0, 1.0, 1, 50.0)])
    limits = [(0, -19.0), (1, -21.0), (0, 119.0), (1, 121.0)]

    def chart(**given: Any) -> dict[str, Any]:
        drawn = figures.ReportFigure("n", "h", "c", Figure(), [replace(group, **given)])
        content = charts_of(flight, ["missing", drawn, None]).data["charts"]
        assert (content["end"], content["events"]) == (1.0, [])
        (made,) = content["charts"]
        return dict(made)

    plain = chart(limits=limits)
    assert numbers(plain["time"], "<f8") == [0.0, 0.25, 0.5]
    assert [numbers(each, "<f4") for each in plain["values"]] == [
        pytest.approx([0.0, 1e-3, 100.0]),
        [1.0, 2.0, 0.0],
    ]
    assert plain["goals"] == [[0.0, 1.0, 1.0, 50.0]]
    assert plain["limits"] == [[0, -19.0], [0, 119.0]]
    assert (plain["log"], plain["rows"], plain["window"]) == (False, False, None)
    windowed = chart(limits=[(0, 1.19), (0, 1.21), (0, -0.19)], window=(0.0, 1.0))
    assert windowed["limits"] == [[0, 1.19], [0, -0.19]]
    decades = chart(decades=4)
    assert decades["log"] is True
    assert numbers(decades["values"][0], "<f4") == [-2.0, -2.0, 2.0]
    rows = chart(rows=True)
    assert numbers(rows["values"][1], "<f4") == pytest.approx([0.8, 1.6, 0.0])
    assert numbers(rows["values"][0], "<f4") == pytest.approx([1.0, 1.0008, 81.0])
    zero = chart(signal=signal_of([0.0, 0.0]), decades=4)
    assert numbers(zero["values"][0], "<f4") == [-19.0, -19.0]
    assert charts_of(flight, ["missing", None]).data == {}


def test_short_signals_are_not_thinned_out() -> None:
    signal = signal_of(np.sin(np.arange(2001.0)))
    few = Signal(signal.time[:2000], signal.values[:2000])
    assert thin_out(few) is few
    line = Signal(signal.time, signal.time[:, np.newaxis])
    assert len(thin_out(line)) < 80
    # Of noise the extremes of every slice are kept, and its ends.
    noise = np.random.default_rng(1).normal(size=(9001, 2))
    thin = thin_out(Signal(np.arange(9001.0), noise))
    assert 3000 < len(thin) <= 5001
    assert (thin.time[0], thin.time[-1]) == (0.0, 9000.0)
    np.testing.assert_array_equal(thin.values.max(axis=0), noise.max(axis=0))


def test_key_frames_of_many_cycles_are_at_one_phase() -> None:
    time = 0.25 * np.arange(4 * 700 + 41, dtype=np.float64)
    motion = Signal(time, np.column_stack([100 * np.sin(2 * np.pi * time), time]))
    cycles = Cycles(5.0, 705.0, 1.0)
    frames = scene.key_frames(motion, cycles)
    # 694 cycles between the first three and the last three, in 300 instants at most.
    assert frames.every == 3
    shown = time[frames.indices]
    between = shown[(shown > 8.0) & (shown < 702.0)]
    assert set(np.mod(between - 8.0, 3.0)) <= {0.0}
    assert shown[0] == 0.0
    assert shown[-1] == time[-1]
    few = Cycles(5.0, 11.0, 1.0)
    assert scene.key_frames(motion, few).every == 0
    assert scene.key_frames(motion, Cycles(5.0, 12.0, 1.0)).every == 1
    assert scene.key_frames(motion, None).every == 0


def test_paths_in_space_have_few_points() -> None:
    flight = made_flight("controlled")
    points = np.column_stack([np.arange(8003.0)] * 3)
    still = np.zeros((5, 7))
    position = Signal(np.arange(8003.0), points)
    changed = replace(flight)
    vars(changed).update(position=position, tool=Signal(np.arange(5.0), still))
    (command,) = scene._path_commands(changed)
    assert command["path"] == "/flight/path of the base"
    values = command["object"]["geometries"][0]["data"]["attributes"]["position"]["array"]
    assert values[::3] == [*range(0, 8002, 2), 8002]
    vars(changed)["tool"] = Signal(np.arange(5.0), still + np.arange(5.0)[:, np.newaxis])
    assert [each["path"] for each in scene._path_commands(changed)] == [
        "/flight/path of the base",
        "/flight/path of the end-effector",
    ]
    one = replace(flight)
    vars(one).update(position=signal_of([1.0], [2.0], [3.0]), tool=Signal.empty(7))
    assert scene._path_commands(one) == []


def test_the_grid_is_on_whole_multiples() -> None:
    lines = scene._grid_commands(np.array([0.3, -0.2, 5.0]), 1.0, 0.5, flat=False)
    xs = sorted({float(x) for x in lines[:, 0]})
    assert (xs[0], xs[-1]) == (-1.0, 2.0)
    ys = sorted({float(y) for y in lines[:, 1]})
    assert (ys[0], ys[-1]) == (-1.5, 1.5)
    assert len(lines) == 2 * (7 + 7)
    assert set(lines[:, 2]) == {4.2}
    flat = scene._grid_commands(np.array([0.3, -0.2, 5.0]), 1.0, 0.5, flat=True)
    assert set(flat[:, 2]) == {5.0}


def test_quaternions_of_a_clip_keep_their_sign() -> None:
    values = np.array([[0.0, 0, 0, 1.0], [0.0, 0, -0.6, -0.8], [0.0, 0, -0.8, -0.6], [0, 0, 1, 0]])
    made = scene.clip("/a", np.array([0.0, 0.123456, 1.0, 2.0]), {"quaternion": values})
    (track,) = made["clip"]["tracks"]
    assert track["values"] == [0, 0, 0, 1, 0, 0, 0.6, 0.8, 0, 0, 0.8, 0.6, 0, 0, 1, 0]
    assert track["times"] == [0.0, 0.1235, 1.0, 2.0]
    assert (track["name"], track["type"]) == (".quaternion", "quaternion")


def test_a_mesh_of_many_corners_has_longer_indices() -> None:
    for count, kind in ((65535, "Uint16Array"), (65536, "Uint32Array")):
        mesh: Any = SimpleNamespace(vertices=np.zeros((count, 3)), faces=np.array([[0, 1, 2]]))
        assert scene._mesh_geometry(mesh)["data"]["index"] == {"type": kind, "array": [0, 1, 2]}


def test_without_meshcat_there_is_no_3d_view(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "find_spec", lambda name: None)
    assert scene.viewer_script() is None
    made = scene.player_of(scene.Scene([], [], "caption"))
    assert made.markup == (
        '<p class="missing">The 3D view needs the Python package meshcat: pip install meshcat.</p>'
    )
    assert scene.player_of("No <robot>.").markup == '<p class="missing">No &lt;robot&gt;.</p>'


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize(
    "sizes", [(1.0, 1.0, 1.0), (0.1, 0.2, 1.9), (1.8, 0.1, 0.3), (0.2, 1.7, 0.05)]
)
def test_the_whole_scene_is_in_the_picture_and_fills_it(
    sizes: tuple[float, float, float], flat: bool
) -> None:
    """By the projection that graphics libraries use, for the narrowest picture."""
    points = np.random.default_rng(4).uniform(-0.5, 0.5, (60, 3)) * sizes
    eye = scene._camera_position(points, flat)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (points - eye) @ np.column_stack([right, np.cross(right, forward), forward])
    half = np.tan(np.radians(30.0) / 2)
    x, y = seen[:, 0] / (1.3 * half * seen[:, 2]), seen[:, 1] / (half * seen[:, 2])
    largest = max(np.abs(x).max(), np.abs(y).max())
    assert 0.8 < largest < 1.0
