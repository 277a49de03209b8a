"""The picture of a plan: joints, their velocities, and the base path that they cause."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.model.rotations import rotvec_from_quaternion, rotvecs_from_quaternions
from spacerobot_ros.report.style import (
    FAINT,
    PictureFormat,
    colour,
    drawing,
    picture_of,
    room_for,
    set_range,
    set_time,
    sheet,
)
from spacerobot_ros.simulation.trials import PlanEvaluation, Problem

_COMPONENTS = ("x", "y", "z")


def draw(
    problem: Problem, trial: PlanEvaluation, format: PictureFormat = PictureFormat.PNG
) -> bytes:
    """Return the picture of a plan and its goal."""
    with drawing():
        return picture_of(_figure(problem, trial), format)


def _figure(problem: Problem, trial: PlanEvaluation) -> Figure:
    robot, goal = problem.robot, problem.goal
    positions = trial.positions
    ticks = problem.control_period * np.arange(len(positions), dtype=np.float64)
    rates = np.diff(positions, axis=0) / problem.control_period
    path = trial.path
    turned = rotvecs_from_quaternions(path.quaternion)
    names = robot.joint_names
    figure, rows = sheet([[1], [1], [1, 1]], [1.9, 1.9, 1.9], right=room_for(names) + 0.35)
    joints, speeds, (place, attitude) = rows[0][0], rows[1][0], rows[2]
    kinds = {joint.kind is JointKind.PRISMATIC for joint in robot.description.movable_joints}
    units = [unit for unit, prismatic in (("m", True), ("rad", False)) if prismatic in kinds]
    title = f"{trial.method}, {trial.duration:.6g} s: joints ({', '.join(units)})"
    _panel(joints, title, ticks, positions, names)
    # Held over a tick: steps.
    held = np.repeat(rates, 2, axis=0)
    title = f"held joint velocities ({', '.join(f'{unit}/s' for unit in units)})"
    _panel(speeds, title, np.repeat(ticks, 2)[1:-1], held, names)
    for axes, what, values, wanted in (
        (place, "base position (m) and goal", path.position, goal.position),
        (
            attitude,
            "base attitude, rotation vector (rad), and goal",
            turned,
            rotvec_from_quaternion(goal.quaternion),
        ),
    ):
        _panel(axes, what, path.time, values, _COMPONENTS, wanted)
        axes.set_xlabel("time (s)")
    return figure


def _panel(
    axes: Axes,
    title: str,
    time: Array,
    values: Array,
    names: tuple[str, ...],
    wanted: Array | None = None,
) -> None:
    axes.set_title(title)
    set_range(axes, values, () if wanted is None else wanted.tolist())
    end = float(time[-1]) if len(time) else 0.0
    set_time(axes, 0.0, end)
    for index, name in enumerate(names):
        if wanted is not None:
            axes.axhline(wanted[index], color=colour(index), linewidth=0.8, linestyle=":")
        axes.plot(time, values[:, index], color=colour(index), label=name)
    axes.axhline(0.0, color=FAINT, linewidth=0.6, zorder=0.5)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
