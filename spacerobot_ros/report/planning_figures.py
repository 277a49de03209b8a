"""Pictures for the commands ``analyze`` and ``plan``: curvature maps and workspaces of a robot, and
plans.

Curvature maps over the shape space are drawn as in figures 2 and 3 of paper 3, and figures 6 to 8
of paper 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Wedge

from spacerobot_ros.errors import shortened
from spacerobot_ros.flight.series import Signal, nearest_rotvec, rotvecs
from spacerobot_ros.flight.trials import PlanEvaluation, PlanningProblem
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.planning.analysis import Analysis, Workspaces
from spacerobot_ros.planning.core.controllability import curvature_matrices, curvatures
from spacerobot_ros.planning.methods.nominal_shape import JOINT_PLANES
from spacerobot_ros.planning.methods.square_path import PhasePlane, PlanarPhase, curvature_peaks
from spacerobot_ros.report.figures import (
    LINE_COLOUR,
    PALETTE,
    SECONDARY_COLOUR,
    TEXT_COLOUR,
    WIDTH,
    PictureFormat,
    TraceGroup,
    drawing,
    new_figure,
    panel,
    picture_of,
    room_for,
    sheet,
)
from spacerobot_ros.report.figures_over_time import draw_group

_FINE_GRID, _COARSE_GRID = 61, 37
"""Points per side of a map, for robots with up to three joints and for robots with more joints."""

_COLOUR_LEVELS = 16
_CONDITION_LEVELS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 20.0, 50.0, 100.0)
_MAX_CONDITION = 300.0
"""Larger condition numbers are drawn as this value: singular shapes lie between grid points."""

_MIN_LIMIT_DISTANCE = 0.25
"""Smallest distance between the centre of a square and the joint limits, rad."""

_SQUARE_COUNT = 60
_COLOUR_BAR_X = WIDTH - 0.86
"""Horizontal position of a colour bar, inches."""

_RING_STYLES: dict[str, dict[str, Any]] = {
    kind: {"facecolor": (tint, 0.25), "edgecolor": tint, "hatch": hatch, "lw": 0.6}
    for kind, tint, hatch in (
        ("path-independent", PALETTE[0], None),
        ("path-dependent", PALETTE[1], "///"),
    )
}


def draw_analysis(found: Analysis, format: PictureFormat = PictureFormat.PNG) -> bytes | None:
    """Return a picture of a robot's curvature maps; None if no loop rotates its base."""
    with drawing():
        if found.planar.controllable:
            figure = _planar_figure(found)
        elif found.nominal is not None:
            figure = _spatial_figure(found)
        else:
            return None
        return picture_of(figure, format)


# -- workspaces ---------------------------------------------------------------------------------


def draw_workspaces(found: Analysis, format: PictureFormat = PictureFormat.PNG) -> bytes:
    """Return a picture of the end-effector workspaces around the centre of mass."""
    with drawing():
        high, gap = 3.3, 0.75
        figure = new_figure(high + 1.35)
        for column, each in enumerate(found.workspaces):
            axes = panel(figure, 0.75 + column * (high + gap), 0.95, high, high)
            draw_rings(axes, each)
            axes.set_title("within joint limits" if each.within_limits else "joints turn freely")
            section = "" if each.dimensions == 2 else ", any section"
            axes.set_xlabel(f"'{each.link}' from the centre of mass (m){section}")
        kinds = [Patch(label=kind, **style) for kind, style in _RING_STYLES.items()]
        figure.axes[0].legend(handles=kinds, loc="upper left", bbox_to_anchor=(0.0, -0.16), ncols=2)
        return picture_of(figure, format)


def draw_rings(axes: Axes, workspaces: Workspaces) -> None:
    """Draw the path-dependent and the path-independent ranges of distances as rings around the
    centre of mass."""
    ranges = workspaces.path_independent, workspaces.path_dependent
    for kind, intervals in zip(_RING_STYLES, ranges, strict=True):
        for low, high in intervals:
            # A single distance is a thin ring.
            width = max(high - low, 1e-3 * workspaces.distance_range[1])
            axes.add_patch(Wedge((0.0, 0.0), high, 0.0, 360.0, width=width, **_RING_STYLES[kind]))
    far = 1.05 * workspaces.distance_range[1]
    axes.plot(0.0, 0.0, marker="+", color=TEXT_COLOUR, ms=8, mew=1.3, linestyle="none")
    axes.set(xlim=(-far, far), ylim=(-far, far), aspect="equal")


# -- planar robots ------------------------------------------------------------------------------


def _planar_figure(found: Analysis) -> Figure:
    """Draw H over the plane of two joints, and the phase of squares around its peak."""
    robot = found.robot
    i, j = sorted(robot.joint_names.index(name) for name in found.planar.joints)
    plane = PhasePlane(PlanarPhase(robot), found.shape, i, j)
    lower, upper = (bound[[i, j]] for bound in robot.description.shape_box)
    centre = curvature_peaks(plane, np.zeros(2), np.array([[lower, upper]]))[0]
    figure = new_figure(4.6)
    left = panel(figure, 0.75, 0.6, 3.55, 3.55)
    bar = panel(figure, 4.4, 0.6, 0.12, 3.55)
    x, y = (np.linspace(low, high, 121) for low, high in zip(lower, upper, strict=True))
    H = -plane.curvature(np.stack(np.meshgrid(x, y), axis=-1))
    norm = _symmetric_norm(np.abs(H).max())
    _draw_map(left, x, y, H, norm)
    left.plot(*centre, marker="+", color=TEXT_COLOUR, ms=9, mew=1.4)
    left.set_xlim(lower[0], upper[0])
    left.set_ylim(lower[1], upper[1])
    left.set_xlabel(f"{robot.joint_names[i]} (rad)")
    left.set_ylabel(f"{robot.joint_names[j]} (rad)")
    left.set_title("H: rotation per area of small clockwise loops (1/rad)")
    _draw_colour_bar(bar, norm, "RdBu_r", "H (1/rad)")
    right = panel(figure, 5.9, 0.6, WIDTH - 6.2, 3.55)

    def distance_to_limits(point: Array) -> float:
        return float(np.minimum(robot.upper[[i, j]] - point, point - robot.lower[[i, j]]).min())

    if distance_to_limits(centre) < _MIN_LIMIT_DISTANCE:
        # The peak is on a joint limit; squares require a peak away from the limits.
        quarter = (upper - lower) / 4
        inner = np.array([[lower + quarter, upper - quarter]])
        centre = curvature_peaks(plane, np.zeros(2), inner)[0]
    _draw_square_turns(right, plane, centre, 2 * distance_to_limits(centre))
    return figure


def _draw_square_turns(axes: Axes, plane: PhasePlane, centre: Array, room: float) -> None:
    """Draw the rotation due to a square around a centre against its side (paper 3, figure 3)."""
    sides = np.linspace(0.0, min(np.pi, room), _SQUARE_COUNT)
    turns = np.abs(plane.turns_by_squares(np.tile(centre, (_SQUARE_COUNT, 1)), sides))
    small = abs(float(plane.curvature(centre))) * sides**2
    axes.plot(sides, turns, color=PALETTE[0], label="round the best centre")
    label = "|H| z², small squares"
    axes.plot(sides, small, color=SECONDARY_COLOUR, dashes=(4, 3), lw=0.9, label=label)
    axes.set_xlabel("side z of the square (rad)")
    axes.set_title("base rotation by one square loop")
    axes.set_ylabel("turn (rad)")
    axes.set_xlim(0.0, None)
    axes.set_ylim(0.0, 1.35 * turns.max())
    axes.legend(loc="upper left")


# -- spatial robots -----------------------------------------------------------------------------


def _spatial_figure(found: Analysis) -> Figure:
    """Draw the entries of M unless all joints are prismatic, and the condition number of M."""
    assert found.nominal is not None
    joints = found.nominal.joints
    movable = found.robot.description.movable_joints
    sliding = all(movable[k].kind is JointKind.PRISMATIC for k in joints)
    rows = 1 if sliding else 4
    high, gap = (2.35, 0.75) if sliding else (1.95, 0.72)
    figure = new_figure(0.35 + rows * (high + gap) + (2.1 if sliding else 0.0))
    width, across = 2.2, 0.62
    maps = [_curvature_over_plane(found, pair) for pair in JOINT_PLANES]
    bottom = float(figure.get_size_inches()[1]) - 0.35
    for row, (pair, (x, y, K, _)) in enumerate(zip(JOINT_PLANES, maps, strict=True)):
        if sliding:
            break
        bottom -= high + (gap if row else 0.0)
        norm = _symmetric_norm(np.abs(K).max())
        for column, values in enumerate(K):
            axes = panel(figure, 0.7 + column * (width + across), bottom, width, high)
            _draw_map(axes, x, y, values, norm)
            _mark_shape(axes, found, pair)
            first, second = (_joint_symbol(pair, k) for k in (0, 1))
            axes.set_title(f"rotation about {'xyz'[column]} by loops of {first}, {second}")
        # A rotation in rad per area in the plane of the two joints.
        first, second = (movable[joints[k]].unit for k in pair)
        area = f"{first}²" if first == second else f"({first} {second})"
        bar = panel(figure, _COLOUR_BAR_X, bottom, 0.12, high)
        _draw_colour_bar(bar, norm, "RdBu_r", f"curvature K (rad/{area})")
    bottom -= high + (0.0 if sliding else gap)
    poor = BoundaryNorm(_CONDITION_LEVELS, 256, extend="max")
    for column, (pair, (x, y, _, condition)) in enumerate(zip(JOINT_PLANES, maps, strict=True)):
        axes = panel(figure, 0.7 + column * (width + across), bottom, width, high)
        axes.contourf(x, y, condition, _CONDITION_LEVELS, norm=poor, cmap="viridis_r", extend="max")
        _mark_shape(axes, found, pair)
        axes.set_title("condition number of M")
    bar = panel(figure, _COLOUR_BAR_X, bottom, 0.12, high)
    _draw_colour_bar(bar, poor, "viridis_r", "condition number of M (1)")
    if sliding:
        _draw_condition_shares(panel(figure, 0.7, 0.55, WIDTH - 1.0, 1.5), found.conditions)
    return figure


def _curvature_over_plane(
    found: Analysis, pair: tuple[int, int]
) -> tuple[Array, Array, Array, Array]:
    """Return grids x and y (P,), the curvature (3, P, P) of two of the three joints over their
    plane, and the condition number (P, P) of M there.
    """
    assert found.nominal is not None
    robot, joints = found.robot, found.nominal.joints
    i, j = (joints[k] for k in pair)
    count = _FINE_GRID if robot.n <= 3 else _COARSE_GRID
    lower, upper = robot.description.shape_box
    x, y = (np.linspace(lower[k], upper[k], count) for k in (i, j))
    shapes = np.tile(found.shape, (count * count, 1))
    shapes[:, i], shapes[:, j] = (grid.ravel() for grid in np.meshgrid(x, y))
    K = curvatures(robot, shapes)
    values = np.linalg.svd(curvature_matrices(K, joints), compute_uv=False)
    condition = values[:, 0] / np.maximum(values[:, 2], values[:, 0] / _MAX_CONDITION)
    grid = (count, count)
    return x, y, K[:, :, i, j].T.reshape(3, *grid), condition.reshape(grid)


def _mark_shape(axes: Axes, found: Analysis, pair: tuple[int, int]) -> None:
    """Mark the analysed shape, and label the axes with the joints of the plane."""
    assert found.nominal is not None
    i, j = (found.nominal.joints[k] for k in pair)
    axes.plot(found.shape[i], found.shape[j], marker="+", color=TEXT_COLOUR, ms=8, mew=1.3)
    for k, index, label in ((i, 0, axes.set_xlabel), (j, 1, axes.set_ylabel)):
        joint = found.robot.description.movable_joints[k]
        label(f"{_joint_symbol(pair, index)}: {joint.name} ({joint.unit})")


def _draw_condition_shares(axes: Axes, conditions: Array) -> None:
    finite = np.sort(conditions[np.isfinite(conditions)])
    share = np.arange(1, len(finite) + 1) / len(conditions)
    axes.step(finite, share, where="post", color=PALETTE[0])
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlim(1.0, None)
    axes.set_ylim(0.0, 1.05)
    axes.set_xlabel("condition number of the best three brackets (1)")
    shapes = f"share of {len(conditions)} shapes in the shape space"
    axes.set_title(f"{shapes} with at most this condition number")


# -- parts --------------------------------------------------------------------------------------


def _draw_map(axes: Axes, x: Array, y: Array, values: Array, norm: Normalize) -> None:
    levels = np.linspace(norm.vmin or 0.0, norm.vmax or 1.0, _COLOUR_LEVELS + 1)
    axes.contourf(x, y, values, levels, norm=norm, cmap="RdBu_r")
    kinds = (levels, SECONDARY_COLOUR, 0.35), (np.zeros(1), TEXT_COLOUR, 0.8)
    for lines, color, linewidth in kinds:
        # Matplotlib before 3.7 warns where there is nothing to draw.
        inside = lines[(values.min() < lines) & (lines < values.max())]
        if len(inside):
            axes.contour(x, y, values, inside, colors=color, linewidths=linewidth)
    axes.grid(False)
    axes.spines[:].set(visible=True, color=LINE_COLOUR)


def _symmetric_norm(peak: float) -> Normalize:
    return TwoSlopeNorm(0.0, -peak, peak)


def _draw_colour_bar(axes: Axes, norm: Any, colours: str, label: str) -> None:
    bar = axes.figure.colorbar(ScalarMappable(norm, colours), cax=axes, label=label)
    bar.outline.set_linewidth(0.0)
    axes.grid(False)


def _joint_symbol(pair: Sequence[int], index: int) -> str:
    return f"φ{'₁₂₃'[pair[index]]}"


# -- a plan -------------------------------------------------------------------------------------


def draw_plan(
    problem: PlanningProblem, trial: PlanEvaluation, format: PictureFormat = PictureFormat.PNG
) -> bytes:
    """Return a picture of a plan: joint positions and velocities, base path and goal."""
    with drawing():
        return picture_of(_plan_figure(problem, trial), format)


def _plan_figure(problem: PlanningProblem, trial: PlanEvaluation) -> Figure:
    robot, goal, path = problem.robot, problem.goal, trial.path
    ticks = problem.control_period * np.arange(len(trial.positions), dtype=np.float64)
    rates = np.diff(trial.positions, axis=0) / problem.control_period
    names = [shortened(name) for name in robot.joint_names]
    units = sorted({joint.unit for joint in robot.description.movable_joints})
    speeds = ", ".join(f"{unit}/s" for unit in units)
    # Held over a tick: steps.
    held = Signal(np.repeat(ticks, 2)[1:-1], np.repeat(rates, 2, axis=0))
    groups = [
        TraceGroup(Signal(ticks, trial.positions), names, "joints", ", ".join(units)),
        TraceGroup(held, names, "held velocities", speeds),
    ]
    turned = rotvecs(path.quaternion)
    wanted = nearest_rotvec(rotvec_from_quaternion(goal.quaternion), turned[-1])
    for part, label, unit, values, aim in (
        ("position", "base position", "m", path.position, goal.position),
        ("attitude", "rotation vector", "rad", turned, wanted),
    ):
        goals = [(0.0, float(path.time[-1]), k, x) for k, x in enumerate(aim) if part in goal.base]
        signal = Signal(path.time, values)
        groups.append(TraceGroup(signal, "xyz", label, unit, goals=goals))
    figure, rows = sheet([[1], [1], [1, 1]], [1.9, 1.9, 1.9], right=room_for(names))
    for axes, group in zip((axes for row in rows for axes in row), groups, strict=True):
        draw_group(axes, group, 0.0)
    rows[0][0].set_title(f"{trial.method}, {trial.duration:.6g} s")
    return figure
