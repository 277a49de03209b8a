"""What the picture report is made with: arithmetic on time series, and the drawing of solids."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.flight_bags import TICK, cyclic_shapes, rates_of

from spacerobot_ros.flight.flight import Signal
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.report.figures_space import _choose_instants, _signed_area
from spacerobot_ros.report.signals import Cycles, envelope, find_cycles, rotvecs
from spacerobot_ros.report.solids import Canvas, Edge, Face, View


def test_what_is_behind_is_hidden() -> None:
    view = View()
    right, up = view.paper_axes

    def square(nearness: float, half: float, fill: tuple[float, float, float]) -> Face:
        corners = [x * right + y * up for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        return Face(
            half * np.array(corners) + nearness * view.viewing_direction,
            view.viewing_direction,
            fill,
        )

    near, far = square(1.0, 0.5, (1.0, 0.0, 0.0)), square(0.0, 1.0, (0.0, 0.0, 1.0))
    backwards = Face(
        near.corners + view.viewing_direction, -view.viewing_direction, (0.0, 1.0, 0.0)
    )
    behind = Edge(np.array([-right, right]) * 0.9, np.empty((0, 2, 3)), (0.0, 0.0, 0.0))
    canvas = Canvas(view, np.full(2, -2.0), np.full(2, 2.0), 80)
    canvas.draw([near, far, backwards], [behind])
    image = canvas.image()
    assert image.shape == (80, 80, 4)
    assert image[40, 40, 0] > 0.5
    assert image[40, 40, 2] == 0.0
    far_blue = image[25, 25, 2]
    assert far_blue > 0.5
    assert image[39:41, 24, 2].min() < 0.7 * far_blue  # The edge is before the far square.
    assert not image[5:15].any()


def test_rotation_vectors_are_continuous_beyond_half_turns() -> None:
    angle = np.concatenate([np.linspace(0, 9, 400), np.linspace(9, -9, 800)])
    expected = angle[:, np.newaxis] * np.array([0.6, 0.0, -0.8])
    quaternions = np.array([quaternion_from_rotvec(r) for r in expected])
    quaternions[::7] *= -1  # The same attitudes.
    np.testing.assert_allclose(rotvecs(quaternions), expected, atol=1e-12)


def test_envelopes_hold_every_sample() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(997, 1))
    time, low, high = envelope(Signal(np.arange(997.0), values), 0, 50)
    assert (time[0], time[-1]) == (0.0, 996.0)
    assert (low.min(), high.max()) == (values.min(), values.max())
    for k, value in enumerate(values[:, 0]):
        place = min(k * 50 // 996, 49)
        assert low[place] <= value <= high[place] or low[place - 1] <= value <= high[place - 1]


def ticks(values: Array) -> Signal:
    return Signal(np.linspace(0.0, TICK * (len(values) - 1), len(values)), values)


def test_cycles_are_found_where_there_are_some() -> None:
    shapes = cyclic_shapes(slide=100, cycles=40, period=60)
    cycles = find_cycles(ticks(rates_of(shapes)))
    assert cycles is not None
    assert cycles.period == pytest.approx(60 * TICK)
    assert cycles.start == pytest.approx(99 * TICK, abs=1.5 * TICK)
    assert cycles.count == 40
    ramp = np.linspace(0, 1, 500)[:, np.newaxis] ** 2
    assert find_cycles(ticks(ramp)) is None
    noise = np.random.default_rng(2).normal(size=(2000, 3))
    assert find_cycles(ticks(noise)) is None
    assert find_cycles(ticks(np.empty((0, 3)))) is None


def test_whole_cycles_are_counted_and_the_last_are_at_the_end() -> None:
    # A sample is missing at the end of a cycle now and then.
    for end, count in ((8.0, 3), (7.95, 3), (7.5, 2), (9.5, 3)):
        assert Cycles(2.0, end, 2.0).count == count
    assert Cycles(2.0, 20.0, 2.0).last(3) == (14.0, 20.0)


def test_change_is_since_the_first_sample_of_a_window() -> None:
    values = np.array([[1.0, -2.0], [4.0, 3.0], [7.0, 5.0]])
    part = Signal(np.array([0.0, 1.0, 2.0]), values).between(1.0, 2.0).relative_to_first()
    np.testing.assert_array_equal(part.values, [[0.0, 0.0], [3.0, 2.0]])
    np.testing.assert_array_equal(part.time, [1.0, 2.0])


def test_the_robot_is_drawn_at_six_instants_though_it_rests_at_the_end() -> None:
    def flight(joints: Array) -> Any:
        still = Signal(np.linspace(0.0, 1.0, len(joints)), np.zeros((len(joints), 3)))
        return SimpleNamespace(position=still, attitude=still, joints=joints, cycles=None)

    moving = np.arange(101.0)[:, np.newaxis] * [0.5, -0.25, 0.125]
    rest = np.repeat(moving[-1:], 40, axis=0)
    found = _choose_instants(flight(np.vstack([moving, rest])))
    np.testing.assert_allclose(found, [0, 20, 40, 60, 80, 140], atol=1)
    assert _choose_instants(flight(rest)) == [39]


def test_areas_are_positive_counter_clockwise() -> None:
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0], [0.0, 3.0]])
    assert _signed_area(square[:, 0], square[:, 1]) == pytest.approx(6.0)
    assert _signed_area(square[::-1, 0], square[::-1, 1]) == pytest.approx(-6.0)
