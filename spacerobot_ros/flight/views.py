"""Views of a flight: a figure and an animation. matplotlib is loaded here."""

from __future__ import annotations

import io
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.files import write_output
from spacerobot_ros.flight.data import FlightData
from spacerobot_ros.flight.series import nearest_rotvec, rotvecs
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import rotvec_from_quaternion

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_DASHES = ("-", "--", "-.", ":")
_ROBOT_COLOUR, _GOAL_COLOUR = "#1f2328", "#CC79A7"
_MAX_FRAMES = 1000


class Picture(Figure):
    """A matplotlib figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=100, bbox_inches="tight")
        return stream.getvalue()


class Animation:
    """An HTML animation that notebooks display; :meth:`save` writes it as a page.

    Attributes
    ----------
    html
        The content that a notebook shows.
    """

    def __init__(self, html: str) -> None:
        self.html = html

    def _repr_html_(self) -> str:
        return self.html

    def __repr__(self) -> str:
        size = len(self.html) / 1e6
        return f"<Animation, {size:.1f} MB of HTML: show it in a notebook or call save(PATH)>"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the animation as a stand-alone page; an existing file is replaced.

        Raises
        ------
        SpaceRobotError
            The file cannot be written.
        """
        write_output(Path(path), f'<!DOCTYPE html>\n<meta charset="utf-8">\n{self.html}\n')


def figure(flight: FlightData) -> Picture:
    """Draw the base pose and its goal, the joints, and their efforts or rates."""
    thrust = flight.has_thrust
    rows = 4 + thrust
    made = Picture(figsize=(8.0, 1.9 * rows + 0.6), layout="constrained")
    FigureCanvasAgg(made)
    panels = made.subplots(rows, 1, sharex=True)
    time, goal = flight.time, flight.goal
    attitude, place, target = rotvecs(flight.pose[:, 3:]), None, None
    if goal is not None and goal.base:
        place = goal.position
        target = nearest_rotvec(rotvec_from_quaternion(goal.quaternion), attitude[-1])
    _plot_lines(panels[0], time, flight.pose[:, :3], "xyz", "position, m", place)
    _plot_lines(panels[1], time, attitude, "xyz", "rotation vector, rad", target)
    names = flight.joint_names
    _plot_lines(panels[2], time, flight.q, names, "joints, m or rad")
    driven, label = flight.qdot, "joint rates, 1/s"
    if flight.scenario.plant.actuation == "effort":
        driven, label = flight.effort, "joint efforts, N or N m"
    _plot_lines(panels[3], time, driven, names, label)
    if thrust:
        wrench = flight.wrench
        norms: Array = np.linalg.norm(wrench.values.reshape(-1, 2, 3), axis=2)
        _plot_lines(panels[4], wrench.time, norms, ("force, N", "torque, N m"), "thrust")
    panels[-1].set_xlabel("time, s")
    made.suptitle(f"{flight.scenario.name}, {flight.method}: {flight.message}", fontsize=10)
    return made


def _plot_lines(
    axes: Any, time: Array, values: Array, names: Any, label: str, goal: Array | None = None
) -> None:
    for i, name in enumerate(names):
        colour, dashes = _COLOURS[i % len(_COLOURS)], _DASHES[i // len(_COLOURS) % len(_DASHES)]
        axes.plot(time, values[:, i], color=colour, label=name, linewidth=1.3, linestyle=dashes)
        if goal is not None:
            axes.axhline(goal[i], color=colour, linestyle=":", linewidth=1.0)
    axes.set_ylabel(label, fontsize=9)
    axes.grid(visible=True, color="#e9ebee")
    if len(names):
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def animation(flight: FlightData, seconds: float, frames: int) -> Animation:
    """Draw the robot in motion, with its joints as points and the links between them as lines."""
    from matplotlib.animation import FuncAnimation

    if not isinstance(frames, int) or not 1 <= frames <= _MAX_FRAMES:
        raise ParameterError(f"An animation must have 1 to {_MAX_FRAMES} frames, not {frames!r}.")
    if not (isinstance(seconds, int | float) and 0 < seconds < math.inf):
        raise ParameterError(f"An animation must last more than 0 s, not {seconds!r}.")
    rows = np.unique(np.linspace(0, len(flight.time) - 1, frames).round().astype(int))
    robot = flight.required_robot()
    shapes, links = _skeleton(robot, flight.pose[rows], flight.q[rows])
    ghost = np.zeros((0, 3))
    if flight.goal is not None and flight.goal.base:
        goal = np.concatenate([flight.goal.position, flight.goal.quaternion])
        ghost = _skeleton(robot, goal[None], flight.q[-1:])[0][0]
    made = Figure(figsize=(5.6, 5.0), dpi=72)
    FigureCanvasAgg(made)
    axes = made.add_subplot(projection="3d")
    everything = np.concatenate([shapes.reshape(-1, 3), ghost])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    half = max(float(np.ptp(everything, axis=0).max()) / 2, 0.1)
    for name, at in zip("xyz", middle, strict=True):
        axes.set(**{f"{name}lim": (at - half, at + half), f"{name}label": f"{name}, m"})
    for a, b in links if len(ghost) else ():
        axes.plot(*ghost[[a, b]].T, color=_GOAL_COLOUR, alpha=0.35, linewidth=3)
    axes.plot(*flight.pose[:, :3].T, color="#8a919c", linewidth=0.8)
    lines = [axes.plot([], [], [], color=_ROBOT_COLOUR, linewidth=2.5)[0] for _ in links]
    (dots,) = axes.plot([], [], [], "o", color=_COLOURS[0], markersize=4)

    def draw(k: int) -> list[Any]:
        points = shapes[k]
        for line, (a, b) in zip(lines, links, strict=True):
            line.set_data_3d(*points[[a, b]].T)
        dots.set_data_3d(*points.T)
        axes.set_title(f"{flight.time[rows[k]]:.2f} s", fontsize=10)
        return [*lines, dots]

    interval = 1000.0 * seconds / len(rows)
    moving = FuncAnimation(made, draw, frames=len(rows), interval=interval)
    return Animation(_without_remote_icons(str(moving.to_jshtml(default_mode="loop"))))


_ICONS = {
    "minus": "−",
    "fast-backward": "⏮",
    "step-backward": "⏴",
    "play fa-flip-horizontal": "◀",
    "pause": "⏸",
    "play": "▶",
    "step-forward": "⏵",
    "fast-forward": "⏭",
    "plus": "+",
}


def _without_remote_icons(html: str) -> str:
    """Return matplotlib's page with characters in place of icons from a server."""
    html = re.sub(r"<link\b[^>]*>", "", html)
    return re.sub(
        r'<i class="fa fa-([^"]*)"></i>', lambda found: _ICONS.get(found[1], found[1]), html
    )


def _skeleton(
    robot: RobotDescription, poses: Array, q: Array
) -> tuple[Array, list[tuple[int, int]]]:
    """Return the origins of the link frames, then the centres of mass, (K, 2 L, 3) in the world,
    m, and the pairs that the drawn links connect."""
    kinematics, coms = ForwardKinematics(robot), {x.name: x.inertia.com for x in robot.links}
    names, count = kinematics.links, len(kinematics.links)
    # From a link's frame to its centre of mass, and from its parent's centre of mass to it.
    links = [(i, count + i) for i in range(count)]
    links += [(count + names.index(j.parent), names.index(j.child)) for j in robot.joints]
    R_WL, r_WL = kinematics.poses_in_world(poses, q)
    centers = r_WL + np.einsum("klij,lj->kli", R_WL, np.array([coms[name] for name in names]))
    return np.concatenate([r_WL, centers], axis=1), links
