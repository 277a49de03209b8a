"""What each loop of a gait did to the attitude: the pose where the shape has come round."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.planning import PoseError
from spacerobot_ros.report.figures import DASHES, power_of_ten
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.signals import Indices, Signal
from spacerobot_ros.report.style import (
    MUTED,
    PALETTE,
    Plate,
    end_labels,
    key,
    legend_above,
    set_range,
    sheet,
    svg_of,
)

_BACK = 0.02
"""A shape this near to where the loops begin, in their extent, has come round."""

_FEWEST = 4
_DECADE = 10.0


def cycles_plate(flight: Flight) -> Plate | None:
    """Attitude, and the angle left to the goal, at the end of each loop in shape space.

    None where the shape does not come round again and again.
    """
    if not len(flight.shape) or len(flight.attitude) != len(flight.shape):
        return None
    ends = returns(flight.shape)
    if len(ends) < _FEWEST:
        return None
    number = np.arange(len(ends))
    attitude = flight.attitude.values[ends]
    goal = flight.goal
    figure, panels = sheet([[1.0], [1.0]] if goal else [[1.0]], [2.0, 1.3] if goal else [2.0])
    above = panels[0][0]
    dots = "." if len(ends) <= 60 else ""
    wanted = flight.goal_rotvec(goal) if goal is not None else np.empty(0)
    set_range(above, np.concatenate([attitude.ravel(), wanted]))
    for i in range(3):
        above.plot(number, attitude[:, i], color=PALETTE[i], marker=dots)
    for i, value in enumerate(wanted):
        above.axhline(value, color=PALETTE[i], ls=(0, DASHES), lw=1.2, zorder=1.8)
    if goal is not None:
        legend_above(above, [key(MUTED, "goal", DASHES)])
    above.set_ylabel("rotation vector (rad)")
    end_labels(above, list(zip(attitude[-1].tolist(), "xyz", PALETTE[:3], strict=True)))
    caption = (
        f"Attitude of the base link at the {len(ends)} instants at which the shape is back where "
        "its loops begin, number 0 before the first of them"
    )
    if goal is not None:
        below = panels[1][0]
        poses = zip(flight.position.values[ends], flight.quaternion[ends], strict=True)
        left = np.array([PoseError.between(r, q, goal).angle for r, q in poses])
        below.plot(number, left, color=PALETTE[0], marker=dots)
        below.set_ylabel("angle left (rad)")
        caption += "; dashed, the goal. Below, the angle left to the goal"
        if left.min() > 0 and left.max() > _DECADE * left.min():
            below.set_yscale("log")
            below.minorticks_off()
            below.yaxis.set_major_formatter(lambda value, _: power_of_ten(value))
            caption += ", on a logarithmic axis"
        else:
            set_range(below, np.append(left, 0.0))
    for axes in (row[0] for row in panels):
        axes.set_xlim(0, len(ends) - 1)
    panels[-1][0].set_xlabel("cycle")
    return Plate("cycles", "Attitude cycle by cycle", f"{caption}.", svg_of(figure))


def returns(shape: Signal) -> Indices:
    """Return the samples at which the shape is back where its loops begin and end, the last shape.

    A stay there counts once, with its last sample; a stay at the very end with its first.
    """
    values = shape.values
    moving = np.flatnonzero((np.abs(np.diff(values, axis=0)) > 0).any(axis=1))
    if not len(moving):
        return np.empty(0, np.int64)
    end = int(moving[-1]) + 1
    extent = np.ptp(values[end // 2 : end + 1], axis=0)
    used = extent > 1e-3 * extent.max(initial=0.0)
    off = np.abs(values[: end + 1, used] - values[end, used]) / extent[used]
    distance = off.max(axis=1)
    near = np.flatnonzero(distance < _BACK)
    runs = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    nearest = [int(run[np.argmin(distance[run])]) for run in runs[:-1]]
    return np.array([*nearest, end], np.int64)
