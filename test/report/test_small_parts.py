"""Small parts of reports, each against numbers by hand."""

from __future__ import annotations

import base64
import math
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.flight import Signal
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.report import figures, scene
from spacerobot_ros.report.events import timed_events
from spacerobot_ros.report.figures import (
    draw_traces,
    drawing,
    largest_over_time,
    legend_above,
    room_for,
    scaled,
    set_range,
    set_time,
    sheet,
    short,
)
from spacerobot_ros.report.figures_over_time import (
    power_of_ten,
    range_without_peaks,
)
from spacerobot_ros.report.page import thin_out
from spacerobot_ros.report.signals import (
    Cycles,
    envelope,
    find_cycles,
    nearest_rotvec,
    rotvecs,
    simplified,
)
from spacerobot_ros.report.solids import Canvas, Edge, Face, View


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


# -- events and tables ----------------------------------------------------------------------------


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


# -- charts and key frames ------------------------------------------------------------------------


def numbers(text: str, kind: str) -> list[float]:
    return [float(x) for x in np.frombuffer(base64.b64decode(text), kind)]


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


def test_quaternions_of_a_clip_keep_their_sign() -> None:
    values = np.array([[0.0, 0, 0, 1.0], [0.0, 0, -0.6, -0.8], [0.0, 0, -0.8, -0.6], [0, 0, 1, 0]])
    made = scene.clip("/a", np.array([0.0, 0.123456, 1.0, 2.0]), {"quaternion": values})
    (track,) = made["clip"]["tracks"]
    assert track["values"] == [0, 0, 0, 1, 0, 0, 0.6, 0.8, 0, 0, 0.8, 0.6, 0, 0, 1, 0]
    assert track["times"] == [0.0, 0.1235, 1.0, 2.0]
    assert (track["name"], track["type"]) == (".quaternion", "quaternion")


def test_without_meshcat_there_is_no_3d_view(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "find_spec", lambda name: None)
    assert scene.viewer_script() is None
    made = scene.player_of(scene.Scene([], [], "caption"))
    assert made.markup == (
        '<p class="missing">The 3D view needs the Python package meshcat: pip install meshcat.</p>'
    )
    assert scene.player_of("No <robot>.").markup == '<p class="missing">No &lt;robot&gt;.</p>'
