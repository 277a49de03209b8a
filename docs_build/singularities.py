"""Paper 4's two remarks on singularities, computed and drawn for ``docs/theory/singularities.md``.

``make figures`` draws the picture again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_multiply
from spacerobot_ros.planning import GaitSchedule, Goal, PlanRequest, RobotState, Tolerance, plan
from spacerobot_ros.planning.analysis import workspaces
from spacerobot_ros.planning.core.goal import EndEffectorGoal, end_effector_pose
from spacerobot_ros.planning.methods.registry import method_options
from spacerobot_ros.planning.methods.resolved_rate import JointPath, ResolvedRateGait
from spacerobot_ros.report.figures import (
    PALETTE,
    SECONDARY_COLOUR,
    TEXT_COLOUR,
    PictureFormat,
    drawing,
    new_figure,
    panel,
    picture_of,
)
from spacerobot_ros.report.planning_figures import draw_rings
from spacerobot_ros.resources import robot_file

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "gallery_singularities.png"

LINK = "end_effector"
GOAL = np.array([1.5, 1.5, 0.0])
"""Point B of the paper, m."""

_START = np.radians([21.0, -58.0, 60.3])
_PERIOD = 0.01


class Example:
    """Paper 4's robot at its start, with the centre of mass of the system at the origin."""

    def __init__(self) -> None:
        theta, *q = _START
        self.robot = SpaceRobot.from_file(robot_file("planar_manipulator"))
        quaternion = np.array([0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2)])
        position = -matrix_from_quaternion(quaternion) @ self.robot.center_of_mass(q)
        self.start = RobotState(position, quaternion, np.array(q))

    def path(self) -> JointPath:
        """Return the path of the joints on the straight line to B, base free."""
        options = method_options(ResolvedRateGait.name, {})
        method = ResolvedRateGait(self.robot, _PERIOD, _PERIOD, options)
        goal = Goal.of_end_effectors([EndEffectorGoal(LINK, GOAL)])
        return method.path(PlanRequest(self.start, goal, Tolerance(1e-6, 1e-6)))

    def optimal(self, clearance: float = 0.0) -> GaitSchedule:
        """Return the fastest motion to B, base free, 2 rad/s and 4 rad/s^2 at most."""
        return plan(
            self.robot,
            end_effector_position=GOAL,
            start=self.start,
            method="optimal",
            control_period=_PERIOD,
            cache=0,
            max_acceleration=(4.0, 4.0),
            clearance=clearance,
        )

    def hand(self, state: RobotState) -> Array:
        """Return where the end-effector is (3,)."""
        return end_effector_pose(self.robot, LINK, state.position, state.quaternion, state.q)[0]

    def free(self, q: Array, turn: Array) -> RobotState:
        """Return the robot with a shape and a turn (4,) of its base since the start."""
        quaternion = quaternion_multiply(self.start.quaternion, turn)
        position = -matrix_from_quaternion(quaternion) @ self.robot.center_of_mass(q)
        return RobotState(position, quaternion, q)

    def det_of_generalised_jacobian(self, q: Array) -> float:
        """Return det J* in the plane."""
        return float(np.linalg.det(self.robot.generalised_jacobian(LINK, q)[:2]))

    def fixed_at_goal(self) -> tuple[Array, float]:
        """Return the shape (2,) that reaches B with the spacecraft fixed, and det J there."""
        q = self.start.q.copy()
        R_BW = matrix_from_quaternion(self.start.quaternion).T
        wanted = R_BW @ (GOAL - self.start.position)
        for _ in range(50):
            J = self._fixed_jacobian(q)
            q = q + np.linalg.solve(J, (wanted - self.robot.link_pose(LINK, q)[1])[:2])
        return q, float(np.linalg.det(self._fixed_jacobian(q)))

    def _fixed_jacobian(self, q: Array) -> Array:
        """Return the Jacobian (2, 2) of the arm on a fixed base, by central differences."""
        h = 1e-5
        ends = [
            [self.robot.link_pose(LINK, q + sign * step)[1][:2] for sign in (1, -1)]
            for step in h * np.eye(2)
        ]
        return np.column_stack([(up - down) / (2 * h) for up, down in ends])


def singularity_figures() -> dict[str, str]:
    """Return the numbers of the page by key, with the digits that are shown."""
    example = Example()
    path, start = example.path(), example.hand(example.start)
    there = example.free(path.shapes[-1], path.turns[-1])
    line = float(np.linalg.norm(GOAL - start))
    turned, det = example.fixed_at_goal()
    free = workspaces(example.robot, LINK)[0]
    theta = np.degrees(2 * np.arctan2(there.quaternion[2], there.quaternion[3]))
    values = {
        "start": _numbers(start[:2], 6),
        "det_at_start": f"{abs(example.det_of_generalised_jacobian(example.start.q)):.6f}",
        "length": f"{line:.6f}",
        "singular_after": f"{path.path_fractions[-1] * line:.6f}",
        "singular_attitude": f"{theta:.4f}",
        "singular_shape": _numbers(np.degrees(there.q), 4),
        "singular_place": _numbers(example.hand(there)[:2], 6),
        "optimal": f"{example.optimal().notes['solution_time']:.2f}",
        "optimal_with_clearance": f"{example.optimal(0.01).notes['solution_time']:.2f}",
        "fixed_shape": _numbers(np.degrees(turned), 4),
        "fixed_det": f"{abs(det):.4f}",
        "path_dependent": _intervals(free.path_dependent),
        "path_independent": _intervals(free.path_independent),
    }
    return {f"singularities.{key}": text for key, text in values.items()}


def _numbers(values: Array, digits: int) -> str:
    return "(" + ", ".join(f"{x:.{digits}f}" for x in values) + ")"


def _intervals(ends: tuple[tuple[float, float], ...]) -> str:
    return ", ".join(f"{low:.5f} to {high:.5f}" for low, high in ends)


# -- the picture --------------------------------------------------------------------------------


def draw() -> bytes:
    """Return the two cases side by side: spacecraft fixed, and base free."""
    example = Example()
    with drawing():
        figure = new_figure(4.6)
        left, right = (panel(figure, 0.75 + 4.05 * k, 1.0, 3.3, 3.3) for k in (0, 1))
        _draw_fixed(left, example)
        _draw_free(right, example)
        for axes in (left, right):
            axes.set(xlim=(-1.2, 2.6), ylim=(-1.4, 2.4), aspect="equal", xlabel="x (m)")
            axes.plot(*GOAL[:2], marker="x", color=TEXT_COLOUR, ms=7, mew=1.5, linestyle="none")
            for name, place in (("B", GOAL), ("A", example.hand(example.start))):
                at = float(place[0]), float(place[1])
                axes.annotate(name, at, (5, 5), textcoords="offset points")
        left.set_ylabel("y (m)")
        right.legend(loc="upper left", bbox_to_anchor=(-1.22, -0.16), ncols=3)
        return picture_of(figure, PictureFormat.PNG)


def _draw_fixed(axes: Axes, example: Example) -> None:
    q, det = example.fixed_at_goal()
    _draw_robot(axes, example, example.start, SECONDARY_COLOUR)
    at_goal = RobotState(example.start.position, example.start.quaternion, q)
    _draw_robot(axes, example, at_goal, TEXT_COLOUR)
    ends = np.array([example.hand(example.start), GOAL])
    axes.plot(ends[:, 0], ends[:, 1], color=PALETTE[2], lw=1.4)
    axes.set_title(f"spacecraft fixed: |det J| = {abs(det):.4f} m² at B")


def _draw_free(axes: Axes, example: Example) -> None:
    draw_rings(axes, workspaces(example.robot, LINK)[0])
    path = example.path()
    there = example.free(path.shapes[-1], path.turns[-1])
    _draw_robot(axes, example, example.start, SECONDARY_COLOUR)
    _draw_robot(axes, example, there, TEXT_COLOUR)
    start, stop = example.hand(example.start), example.hand(there)
    followed, rest = np.array([start, stop]), np.array([stop, GOAL])
    axes.plot(followed[:, 0], followed[:, 1], color=PALETTE[2], lw=1.4, label="straight line")
    axes.plot(*rest[:, :2].T, color=PALETTE[2], lw=1.2, ls=":", label="beyond the singularity")
    schedule = example.optimal()
    poses = zip(schedule.path.position, schedule.path.quaternion, schedule.positions, strict=True)
    way = np.array([example.hand(RobotState(*pose)) for pose in poses])
    axes.plot(way[:, 0], way[:, 1], color=PALETTE[3], lw=1.4, label="optimal")
    axes.plot(*stop[:2], marker="o", color=PALETTE[2], ms=5)
    axes.set_title("base free: det J* = 0 on the line to B")


def _draw_robot(axes: Axes, example: Example, state: RobotState, color: str) -> None:
    """Draw the spacecraft, a square of 1 m, and the arm as lines."""
    R = matrix_from_quaternion(state.quaternion)
    corners = 0.5 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    outline = state.position + corners @ R.T
    axes.plot(outline[:, 0], outline[:, 1], color=color, lw=1.0)
    links = [example.robot.link_pose(name, state.q)[1] for name in ("link_1", "link_2", LINK)]
    arm = state.position + np.array(links) @ R.T
    axes.plot(arm[:, 0], arm[:, 1], color=color, lw=1.8, marker="o", ms=3)


if __name__ == "__main__":
    PICTURE.write_bytes(draw())
