"""Figures in space: the robot at several instants, paths, and loops in shape space."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from spacerobot_ros.errors import shortened
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import PoseError
from spacerobot_ros.report.figures import (
    BASE_COLOUR,
    GHOST_COLOUR,
    HAND_COLOUR,
    PALETTE,
    PLANNED_COLOUR,
    SECONDARY_COLOUR,
    TRACE_TIME_SLICES,
    ReportFigure,
    TraceGroup,
    angle_unit,
    colour,
    legend_above,
    legend_entry,
    narrow,
    room_for,
    set_range,
    sheet,
)
from spacerobot_ros.report.figures_over_time import DASHES, ONE_STATE_TEXT, draw_group, error_group
from spacerobot_ros.report.flight import FlightReport, joint_unit, labels_of
from spacerobot_ros.report.scene import (
    MAX_MESH_FACES,
    Canvas,
    PlacedSolid,
    View,
    bodies_of,
    corner_points,
    goal_of_base,
    is_flat,
    obstacles_of,
    outlines,
    placed_solids,
)

PIXELS = 420
"""Width of a robot picture, pixels."""
_MAX_SHOWN_POSES = 6
_FOOT_SHARE = 0.1
"""Fraction of a robot picture's height that is reserved for the scale bar."""

_NEAR = 2.0
"""Largest total extent, as a multiple of the robot's extent, at which the goal or the obstacles are
still fully shown.
"""


def configurations_figure(flight: FlightReport) -> ReportFigure | str:
    """The robot at several instants from the first state to the last, and the goal."""
    if flight.hidden_links_text:
        return flight.hidden_links_text
    indices = _choose_instants(flight)
    bodies = bodies_of(flight, indices, MAX_MESH_FACES)
    scenes = [placed_solids(bodies, instant) for instant in range(len(indices))]
    around = placed_solids(obstacles_of(flight), 0)
    across = min(len(indices), 2 if narrow() else 3)
    height = 2.0 if narrow() else 2.9 if across > 2 else 3.9
    figure, places = _panels(len(indices), across, height, bottom=0.15, left=0.2, gap=0.42)
    points = np.concatenate([corner_points(scene) for scene in scenes])
    view = view_of(flight)
    if (goal := goal_of_base(flight, MAX_MESH_FACES)) is not None:
        points = with_near(points, np.concatenate(outlines(goal)), view)
    points = with_near(points, corner_points(around), view)
    for axes, scene, index in zip(places, scenes, indices, strict=True):
        draw_robot(axes, [*scene, *around], points, view)
        axes.set_title(f"t = {flight.time[index]:.5g} s")
    keys = draw_goal_and_path(places[-1], flight, view)
    if not narrow():
        legend_above(places[-1], keys)
    caption = (
        "The robot at several instants from the first to the last recorded state, at the same "
        "scale, with its URDF geometry. Each moving link has the color of its joint in the other "
        "figures."
    )
    if flight.target is not None:
        caption += " The target is drawn at its actual pose, whether it is free or held."
    if flight.obstacles:
        caption += " Obstacles are drawn with the geometry used to measure distances."
    if flight.base_goal is not None:
        caption += " In the last picture, the base link at its goal is drawn with dashed lines."
    caption += flight.missing_meshes
    return ReportFigure("configurations", "Configurations", caption, figure)


def with_near(points: Array, more: Array, view: View) -> Array:
    """Return points (k, 3) on a robot and on nearby objects, m."""
    both = np.concatenate([points, more])
    shown = np.ptp(view(both), axis=0).max() < _NEAR * np.ptp(view(points), axis=0).max()
    return both if shown else points


def view_of(flight: FlightReport) -> View:
    """Return the viewing direction: from above if the flight is planar."""
    return View(-90.0, 90.0) if is_flat(flight) else View()


def _choose_instants(flight: FlightReport) -> list[int]:
    """Return up to six recorded states with about equal motion in between.

    If a gait ends with equal cycles, three states are before the cycles, and three are at the same
    phase of the cycles.
    """
    time, cycles = flight.time, flight.cycles
    if cycles is not None and cycles.start > 0.0:
        places = [0.0, 0.5 * cycles.start, cycles.start]
        places += [cycles.start + cycles.period * (cycles.count * k // 3) for k in (1, 2, 3)]
        found = np.searchsorted(time, np.array(places) - 1e-9)
        return _indices_ending_at(len(time) - 1, found)
    moved = np.column_stack([flight.pose[:, :3], flight.attitude.values, flight.joints])
    extent = np.maximum(np.ptp(moved, axis=0), 1e-3)
    steps = np.linalg.norm(np.diff(moved, axis=0) / extent, axis=1)
    progress = np.append(0.0, np.cumsum(steps))
    wanted = np.linspace(0.0, progress[-1], _MAX_SHOWN_POSES) if progress[-1] > 0 else np.zeros(1)
    return _indices_ending_at(len(time) - 1, np.searchsorted(progress, wanted))


def _indices_ending_at(last: int, found: NDArray[np.int64]) -> list[int]:
    """Return unique indices; the last one is replaced by that of the last recorded state."""
    return np.unique([*np.minimum(found[:-1], last), last]).tolist()


def draw_robot(axes: Axes, solids: Sequence[PlacedSolid], points: Array, view: View) -> None:
    """Draw a robot to scale in axes around ``points`` (k, 3), with a triad and a scale bar."""
    box = axes.get_window_extent()
    size = np.array([box.width, box.height])
    flat = view(points)
    middle = (flat.max(axis=0) + flat.min(axis=0)) / 2
    drawn = size * (1.0, 1.0 - _FOOT_SHARE)
    span = 1.06 * max(float((np.ptp(flat, axis=0) / drawn).max()), 1e-6) * size
    middle[1] -= _FOOT_SHARE / 2 * span[1]
    low, high = middle - span / 2, middle + span / 2
    canvas = Canvas(view, low, high, PIXELS)
    canvas.draw(solids)
    axes.imshow(canvas.image(), extent=(low[0], high[0], low[1], high[1]), aspect="auto")
    axes.axis("off")
    across = float(span[0])
    corner = low + 0.08 * across
    arrow = {"arrowstyle": "-|>", "color": SECONDARY_COLOUR, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    for direction, name in zip(np.eye(3), "xyz", strict=True):
        if float(np.linalg.norm(view(direction))) < 0.1:
            continue
        tip = corner + 0.1 * across * view(direction)
        axes.annotate("", tip, corner, arrowprops=arrow)
        end = corner + 0.135 * across * view(direction)
        axes.text(end[0], end[1], name, color=SECONDARY_COLOUR, ha="center", va="center")
    length = _round_length(0.25 * across)
    x, y = low[0] + 0.99 * across, low[1] + 0.02 * across
    axes.plot([x - length, x], [y, y], color=SECONDARY_COLOUR, lw=1.6)
    axes.text(
        x - length / 2, y + 0.015 * across, f"{length:g} m", color=SECONDARY_COLOUR, ha="center"
    )


def draw_goal_and_path(axes: Axes, flight: FlightReport, view: View) -> list[Line2D]:
    """Draw the base at the goal as a ghost, and the base path; return legend entries."""
    keys = []
    path = flight.pose[:, :3]
    limits = axes.axis()
    if float(np.ptp(path, axis=0).max()) > 0.0:
        flat = view(Signal(flight.time, path).broken_at(flight.resets).values)
        dense = len(path) > 2 * TRACE_TIME_SLICES
        axes.plot(flat[:, 0], flat[:, 1], color=BASE_COLOUR, lw=0.8, zorder=5, rasterized=dense)
        keys.append(legend_entry(BASE_COLOUR, "path of the base"))
    if (goal := goal_of_base(flight, MAX_MESH_FACES)) is not None:
        for line in outlines(goal):
            flat = view(line)
            axes.plot(flat[:, 0], flat[:, 1], color=GHOST_COLOUR, lw=0.9, ls=(0, DASHES), zorder=6)
        keys.append(legend_entry(GHOST_COLOUR, "goal", DASHES))
    axes.axis(limits)
    return keys


def _round_length(longest: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most ``longest``."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(step * power for step in (1, 2, 5) if step * power <= longest * (1 + 1e-9))


_LINK_COLOURS = (HAND_COLOUR, PALETTE[1], *PALETTE[5:])

_FLIGHT_COLOURS = (BASE_COLOUR, PALETTE[1], *PALETTE[5:])
"""Colours of compared flights; the first colour is for the reported flight."""


def path_figure(flight: FlightReport, beside: Sequence[FlightReport] = ()) -> ReportFigure | str:
    """The base path in three views, with the end-effector path and the paths of other flights."""
    if not len(flight.time):
        return flight.no_poses_text
    if len(flight.time) < 2 and not beside:
        return ONE_STATE_TEXT
    goals = []
    if flight.base_goal is not None and flight.position_counts:
        goals.append(flight.base_goal.position)
    goals += [sent.goal.position for sent in flight.tool_goals[-1:]]
    goals += [goal.position for goal in flight.link_goals.values()]
    # Compared with an arm's reach, the path of a base without thrust would be a dot.
    shows_tool = len(flight.tool) > 0 and len(flight.tool_goals) > 0
    flown = [flight, *(other for other in beside if len(other.time))]
    names, tints = labels_of(flown) if beside else ["base"], itertools.cycle(_FLIGHT_COLOURS)
    poses = [each.signal("pose").broken_at(each.resets) for each in flown]
    drawn = list(zip(names, tints, poses, strict=False))
    if shows_tool:
        drawn.append(("end-effector", HAND_COLOUR, flight.tool.broken_at(flight.resets)))
    for (link, pose), tint in zip(
        flight.link_poses.items(), itertools.cycle(_LINK_COLOURS), strict=False
    ):
        drawn.append((shortened(link), tint, pose.broken_at(flight.resets)))
    keys = [legend_entry(tint, name) for name, tint, _ in drawn]
    paths = [(each.values[:, :3], tint) for _, tint, each in drawn]
    if flight.planned:
        keys.append(legend_entry(PLANNED_COLOUR, "planned", DASHES))
    everything = np.concatenate(
        [path for path, _ in paths] + flight.planned + [goal[np.newaxis] for goal in goals]
    )
    everything = everything[~np.isnan(everything).any(axis=1)]
    middle = (everything.max(axis=0) + everything.min(axis=0)) / 2
    half = 0.56 * max(float(np.ptp(everything, axis=0).max()), 1e-6)
    views = {"from above": (0, 1)}
    if float(np.ptp(everything[:, 2])) >= 1e-9:
        views |= {"from the front": (0, 2), "from the side": (1, 2)}
    count = len(views)
    figure, places = _square_panels(count, count, 2.6, 2.35 if count > 1 else 4.2)
    for axes, (title, (i, j)) in zip(places, views.items(), strict=True):
        for path, tint in paths:
            dense = len(path) > 2 * TRACE_TIME_SLICES
            axes.plot(path[:, i], path[:, j], color=tint, lw=0.9, rasterized=dense)
            axes.plot(*path[0, [i, j]], "o", color=tint, mfc="white", ms=5, zorder=4)
            axes.plot(*path[-1, [i, j]], "o", color=tint, ms=5, zorder=4)
        for plan in flight.planned:
            axes.plot(
                plan[:, i], plan[:, j], color=PLANNED_COLOUR, lw=1.3, ls=(0, DASHES), zorder=3
            )
        for goal in goals:
            axes.plot(*goal[[i, j]], "x", color=GHOST_COLOUR, ms=8, mew=2, zorder=5)
        axes.set_xlim(middle[i] - half, middle[i] + half)
        axes.set_ylim(middle[j] - half, middle[j] + half)
        axes.set_box_aspect(1.0)
        axes.locator_params(nbins=5)
        axes.set_xlabel(f"{'xyz'[i]} (m)")
        axes.set_ylabel(f"{'xyz'[j]} (m)")
        axes.set_title(title)
    if len(keys) > 1:
        places[0].legend(handles=keys, loc="best", handlelength=1.6)
    caption = (
        "Path of the base origin"
        + (" and of the end-effector" if shows_tool else "")
        + (" and of links with goals" if flight.link_poses else "")
        + f" in the world frame{', three views at the same scale' if len(views) > 1 else ''}; "
        "open circle: start; filled circle: end"
        + ("; cross: goal" if goals else "")
        + ("; dashed: planned base path" if flight.planned else "")
        + ". All recorded states are drawn."
    )
    return ReportFigure("path", "Paths", caption, figure)


def _panels(count: int, across: int, height: float, **sizes: float) -> tuple[Figure, list[Axes]]:
    """Return ``count`` panels with a height in inches, ``across`` per row."""
    rows = [[1.0] * across for _ in range(0, count, across)]
    figure, panels = sheet(rows, [height] * len(rows), **sizes)
    places = [axes for row in panels for axes in row]
    for axes in places[count:]:
        axes.set_visible(False)
    return figure, places[:count]


def _square_panels(
    count: int, across: int, stacked: float, beside: float
) -> tuple[Figure, list[Axes]]:
    """Return panels that are stacked in a narrow figure, else in a row; heights in inches."""
    if narrow():
        return _panels(count, 1, stacked, gap=0.75)
    return _panels(count, across, beside)


_LOOP_JOINTS, _SHOWN_CYCLES = 3, 3


def loops_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Joint positions plotted against each other, for pairs of the first three joints; None without
    joints, which the joint position figure reports."""
    columns = flight.shape_columns[:_LOOP_JOINTS]
    names = [flight.joint_names[i] for i in columns]
    if not names and flight.robot is not None:
        return None
    if len(names) < 2:
        return "A loop in shape space requires at least two joints."
    if not len(flight.q):
        return flight.no_joints_text
    if len(flight.q) < 2:
        return ONE_STATE_TEXT
    pairs = list(itertools.combinations(range(len(names)), 2))
    cycles = flight.cycles
    joint_units = [joint_unit(flight, name) for name in names]
    factor, angle = angle_unit()
    scale = [factor if unit == "rad" else 1.0 for unit in joint_units]
    joint_units = [angle if unit == "rad" else unit for unit in joint_units]
    part = Signal(flight.signal("q").time, flight.q[:, columns] * scale)
    if cycles is not None:
        part = part.between(*cycles.last(_SHOWN_CYCLES))
    part = part.broken_at(flight.resets)
    across, high = (2, 3.4) if len(pairs) == 1 else (_LOOP_JOINTS, 2.35)
    figure, places = _square_panels(len(pairs), across, 2.0, high)
    for axes, (i, j) in zip(places, pairs, strict=True):
        x, y = part.values[:, i], part.values[:, j]
        axes.plot(x, y, color=colour(0), rasterized=len(part) > 4 * TRACE_TIME_SLICES)
        axes.plot(x[:1], y[:1], "o", color=colour(0), mfc="white", ms=5, zorder=4)
        axes.plot(x[-1:], y[-1:], "o", color=colour(0), ms=2.5, zorder=4)
        set_range(axes, y)
        set_range(axes, x, axis="x")
        units = [joint_units[k] for k in (i, j)]
        axes.set_xlabel(f"{names[i]} ({units[0]})")
        axes.set_ylabel(f"{names[j]} ({units[1]})")
        if cycles is not None:
            last = part.between(cycles.end - cycles.period, cycles.end).values
            # Inside a closed curve, positive if it runs counter-clockwise.
            a, b = last[:, i], last[:, j]
            area = (a @ np.roll(b, -1) - b @ np.roll(a, -1)) / 2
            factors = [f"({unit})" if " " in unit else unit for unit in units]
            unit = f"{factors[0]}²" if factors[0] == factors[1] else " ".join(factors)
            axes.set_title(f"area {area:+.4g} {unit}")
            _draw_direction(axes, x, y)
    heading = "Path in shape space"
    caption = "Joint positions in pairs; a circle marks the first shape, and a dot the last shape."
    if cycles is not None:
        heading = "Loops in shape space"
        caption = (
            f"The last {_SHOWN_CYCLES} of {cycles.count} cycles in shape space. Each begins and "
            "ends at the circle and, to first order, displaces the base in proportion to the areas "
            "it encloses: the labels state the areas of one cycle, which are positive if "
            "counter-clockwise."
        )
    if len(flight.shape_columns) > _LOOP_JOINTS:
        caption += f" The first three of {len(flight.shape_columns)} joints are shown."
    return ReportFigure("loops", heading, caption, figure)


def _draw_direction(axes: Axes, x: Array, y: Array) -> None:
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    steps = np.hypot(np.diff(x) / (high - low)[0], np.diff(y) / (high - low)[1])
    k = int(np.argmax(steps))
    arrow = {"arrowstyle": "-|>", "color": colour(0), "mutation_scale": 12}
    axes.annotate("", (x[k + 1], y[k + 1]), (x[k], y[k]), arrowprops=arrow)


_CLOSED_LOOP_DISTANCE = 0.02
"""Distance from the first shape at which a loop is considered closed, as a fraction of the loop
size."""

_MIN_LOOPS = 4


def cycles_figure(flight: FlightReport) -> ReportFigure | None:
    """Attitude, and remaining angle to the goal, at the end of each loop in shape space.

    None if no method repeats cycles, or if the joints do not return to one shape several times.
    """
    if not flight.repeats_cycles or not len(flight.q) or len(flight.attitude) != len(flight.q):
        return None
    ends = loop_ends(flight.signal("q"))
    if len(ends) < _MIN_LOOPS:
        return None
    number, goal = np.arange(float(len(ends))), flight.base_goal
    rotvec = [] if goal is None else flight.goal_rotvec(goal).tolist()
    goals = [(0.0, float(number[-1]), i, x) for i, x in enumerate(rotvec)]
    attitude = Signal(number, flight.attitude.values[ends])
    groups = [TraceGroup(attitude, "xyz", "rotation vector", "rad", goals=goals)]
    caption = (
        f"Base link attitude at the {len(ends)} instants at which the joints return to the start "
        "of a loop; number 0 is the attitude before the first loop"
    )
    if goal is not None:
        poses = zip(flight.pose[ends, :3], flight.pose[ends, 3:], strict=True)
        left = Signal(number, np.array([[PoseError.between(r, q, goal).angle] for r, q in poses]))
        groups.append(error_group(flight, left, "attitude", "base", PALETTE[0]))
        caption += "; dashed: goal. Below: remaining angle to the goal, on a logarithmic axis"
    groups = [group.in_unit_of_angles() for group in groups]
    right = room_for([name for group in groups for name in group.names])
    figure, panels = sheet([[1.0]] * len(groups), [each.height for each in groups], right=right)
    for (axes,), group in zip(panels, groups, strict=True):
        draw_group(axes, group, 0.0)
        axes.locator_params(axis="x", integer=True)
        axes.set_xlabel("number of the cycle")
    return ReportFigure("cycles", "Attitude cycle by cycle", f"{caption}.", figure)


def loop_ends(shape: Signal) -> NDArray[np.int64]:
    """Return the samples at which the joints return to their final shape, closing a loop.

    If the joints stop there, the last sample at rest is returned; at the end of the flight, the
    first sample at rest is returned.
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
    near = np.flatnonzero(distance < _CLOSED_LOOP_DISTANCE)
    runs = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    nearest = [int(run[np.argmin(distance[run])]) for run in runs[:-1]]
    return np.array([*nearest, end], np.int64)
