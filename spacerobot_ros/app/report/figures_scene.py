"""Figures in space: the robot at the start and at the end, and the path of its base.

Each plate function returns a plate, or one sentence on why the bag has no such figure.
"""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from spacerobot_ros.app.report.figures import DASHES, NO_STATES
from spacerobot_ros.app.report.flight import Flight
from spacerobot_ros.app.report.render import Canvas, View
from spacerobot_ros.app.report.solids import Solids, base_outlines, robot_solids
from spacerobot_ros.app.report.style import (
    COLUMNS,
    INK,
    MUTED,
    PALETTE,
    Plate,
    key,
    legend_above,
    sheet,
    svg_of,
)
from spacerobot_ros.model.attitude import matrix_from_quaternion
from spacerobot_ros.model.description import Array, Pose

GHOST = PALETTE[3]
_VIEW = View()
PIXELS = 720
"""Across the picture of a robot."""

_PATH = PALETTE[0]
_PLAN = PALETTE[1]


def robot_plate(flight: Flight) -> Plate | str:
    """The robot as it was first and last, and the goal."""
    if flight.robot is None:
        return "The bag holds no robot description, so there is no picture of the robot."
    scenes = [solids_at(flight, index) for index in (0, -1)]
    if scenes[0] is None or scenes[1] is None:
        return "The bag does not hold base pose and joint positions for a picture of the robot."
    figure, (row, *_) = sheet([[1.0, 1.0]], [3.9], bottom=0.15, left=0.2)
    points = np.concatenate([scene.points() for scene in scenes if scene is not None])
    for axes, solids, title in zip(row, scenes, ("start", "end"), strict=True):
        assert solids is not None
        draw_robot(axes, solids, points)
        axes.set_title(title)
    legend_above(row[1], draw_goal_and_path(row[1], flight))
    caption = (
        "The robot at the first and at the last recorded state, from the shapes of its URDF; "
        "each moving link in the colour that its joint has in the figures above."
    )
    if flight.goal is not None:
        caption += " Dashed, the base link at the goal."
    if any(shape.kind == "mesh" for link in flight.robot.links for shape in link.shapes):
        caption += " Meshes are not drawn."
    return Plate("robot", "The robot", caption, svg_of(figure))


def solids_at(flight: Flight, index: int) -> Solids | None:
    """Return the robot at the first (0) or last (-1) state; None if the bag lacks one."""
    robot = flight.robot
    if robot is None or not len(flight.position):
        return None
    if not set(robot.joint_names) <= set(flight.joint_names):
        return None
    if robot.joint_names and not len(flight.shape):
        return None
    chosen = [flight.joint_names.index(name) for name in robot.joint_names]
    q = flight.shape.values[index, chosen] if chosen else np.empty(0)
    R = matrix_from_quaternion(flight.quaternion[index])
    return robot_solids(robot, q, Pose(R, flight.position.values[index]))


def draw_robot(axes: Axes, solids: Solids, points: Array) -> None:
    """Draw a robot to scale in axes that hold ``points`` (k, 3), with directions and a scale."""
    box = axes.get_window_extent()
    size = np.array([box.width, box.height])
    flat = _VIEW(points)
    middle = (flat.max(axis=0) + flat.min(axis=0)) / 2
    span = 1.06 * max(float((np.ptp(flat, axis=0) / size).max()), 1e-6) * size
    low, high = middle - span / 2, middle + span / 2
    canvas = Canvas(_VIEW, low, high, PIXELS)
    canvas.draw(solids.faces, solids.edges)
    axes.imshow(canvas.image(), extent=(low[0], high[0], low[1], high[1]), aspect="auto")
    axes.axis("off")
    across = float(span[0])
    corner = low + 0.07 * across
    for direction, name in zip(np.eye(3), "xyz", strict=True):
        tip = corner + 0.075 * across * _VIEW(direction)
        arrow = {"arrowstyle": "-|>", "color": MUTED, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip, corner, arrowprops=arrow)
        end = corner + 0.1 * across * _VIEW(direction)
        axes.text(end[0], end[1], name, color=MUTED, ha="center", va="center")
    length = _round_length(0.25 * across)
    x, y = low[0] + 0.99 * across, low[1] + 0.02 * across
    axes.plot([x - length, x], [y, y], color=MUTED, lw=1.6)
    axes.text(x - length / 2, y + 0.015 * across, f"{length:g} m", color=MUTED, ha="center")


def draw_goal_and_path(axes: Axes, flight: Flight) -> list[Line2D]:
    """Draw the ghost of the base at the goal and the path of the base; return legend entries."""
    keys = []
    path = flight.position.values
    limits = axes.axis()
    if float(np.ptp(path, axis=0).max()) > 0.0:
        flat = _VIEW(path)
        dense = len(path) > 2 * COLUMNS
        axes.plot(flat[:, 0], flat[:, 1], color=INK, lw=0.8, zorder=5, rasterized=dense)
        keys.append(key(INK, "path of the base"))
    if flight.goal is not None and flight.robot is not None:
        pose = Pose(matrix_from_quaternion(flight.goal.quaternion), flight.goal.position)
        for line in base_outlines(flight.robot, pose):
            flat = _VIEW(line)
            axes.plot(flat[:, 0], flat[:, 1], color=GHOST, lw=0.9, ls=(0, DASHES), zorder=6)
        keys.append(key(GHOST, "goal", DASHES))
    axes.axis(limits)
    return keys


def path_plate(flight: Flight) -> Plate | str:
    """The path of the base in three views."""
    if not len(flight.position):
        return NO_STATES
    path, goal = flight.position.values, flight.goal
    points = [path, *flight.planned] + ([goal.position[np.newaxis]] if goal is not None else [])
    everything = np.concatenate(points)
    middle = (everything.max(axis=0) + everything.min(axis=0)) / 2
    half = 0.56 * max(float(np.ptp(everything, axis=0).max()), 1e-6)
    figure, (row, *_) = sheet([[1.0, 1.0, 1.0]], [2.35])
    for axes, (i, j) in zip(row, ((0, 1), (0, 2), (1, 2)), strict=True):
        for planned in flight.planned:
            axes.plot(planned[:, i], planned[:, j], color=_PLAN, lw=1.3, ls=(0, DASHES), zorder=3)
        axes.plot(path[:, i], path[:, j], color=_PATH, lw=0.7, rasterized=len(path) > 2 * COLUMNS)
        axes.plot(*path[0, [i, j]], "o", color=INK, mfc="white", ms=6, zorder=4)
        axes.plot(*path[-1, [i, j]], "o", color=INK, ms=6, zorder=4)
        if goal is not None:
            axes.plot(*goal.position[[i, j]], "x", color=GHOST, ms=8, mew=2, zorder=5)
        axes.set_xlim(middle[i] - half, middle[i] + half)
        axes.set_ylim(middle[j] - half, middle[j] + half)
        axes.set_box_aspect(1.0)
        axes.locator_params(nbins=5)
        axes.set_xlabel(f"{'xyz'[i]} (m)")
        axes.set_ylabel(f"{'xyz'[j]} (m)")
    for axes, title in zip(row, ("from above", "from the front", "from the side"), strict=True):
        axes.set_title(title)
    caption = (
        "Path of the base origin in three views of the world frame, to one scale: open circle, "
    )
    caption += "start; full circle, end"
    caption += "; cross, goal" if goal is not None else ""
    caption += "; dashed, the path that the planner published" if flight.planned else ""
    caption += ". Every recorded state is drawn."
    return Plate("path", "Path of the base", caption, svg_of(figure))


def _round_length(longest: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(step * power for step in (1, 2, 5) if step * power <= longest * (1 + 1e-9))
