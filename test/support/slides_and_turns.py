"""Gaits of sliding masses, and where they end by another integration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from planning.sliding_robots import SlidingRobot, random_sliding_robot
from scipy.spatial.transform import Rotation
from support.planners import Planner, planner_of

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState, Tolerance

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf" / "sliding_masses.urdf"
PERIOD = 0.05
TIGHT = Tolerance(1e-5, 1e-5)


def planner(robot: SlidingRobot, tolerance: Tolerance = TIGHT, **options: Any) -> Planner:
    """Return the method for a robot, with a short slide and short cycles unless given."""
    chosen = {"t1": 5.0, "n1": 1, "cycle_period": 1.0, **options}
    model = SpaceRobot.from_urdf(robot.urdf)
    return planner_of("lie_bracket", model, PERIOD, tolerance, **chosen)


def state_at(position: npt.ArrayLike, attitude: Rotation, shape: npt.ArrayLike) -> RobotState:
    return RobotState(
        np.asarray(position, dtype=float), attitude.as_quat(), np.asarray(shape, dtype=float)
    )


def origin(n: int = 3) -> RobotState:
    return state_at(np.zeros(3), Rotation.identity(), np.zeros(n))


def goal_at(position: npt.ArrayLike, attitude: Rotation) -> Goal:
    return Goal.checked(position, attitude.as_quat())


def pose_for_shape(robot: SlidingRobot, state: RobotState, z_f: Array, turn: Rotation) -> Goal:
    """Return the pose after a turn (in B) in which the robot has the shape ``z_f``: eq. (9) solved
    for the pose.
    """
    start = Rotation.from_quat(state.quaternion)
    end = start * turn
    r_cm = state.position + start.apply(robot.center_of_mass(state.q))
    return goal_at(r_cm - end.apply(robot.center_of_mass(z_f)), end)


def misses(goal: Goal, position: Array, attitude: Rotation) -> tuple[float, float]:
    """Return the distances of a pose from a goal, m and rad."""
    left = (attitude.inv() * Rotation.from_quat(goal.quaternion)).magnitude()
    return float(np.linalg.norm(position - goal.position)), float(left)


def note(schedule: GaitSchedule, name: str) -> Array:
    """Return a named result of the method as numbers."""
    return np.array(schedule.notes[name], dtype=float)


def knots(schedule: GaitSchedule) -> list[int]:
    """Return the ticks of the predicted path."""
    ticks = schedule.path.time / schedule.control_period
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)
    return [int(k) for k in np.round(ticks)]


def check_prediction(
    robot: SlidingRobot, state: RobotState, schedule: GaitSchedule, accuracy: float = 1e-9
) -> tuple[Array, Rotation]:
    """Check the predicted path at all its knots, and return the integrated end pose."""
    start = Rotation.from_quat(state.quaternion)
    attitudes = robot.attitudes(schedule.positions, PERIOD, start)
    positions = robot.positions(schedule.positions, attitudes, state.position)
    at = knots(schedule)
    assert (at[0], at[-1]) == (0, schedule.ticks)
    np.testing.assert_allclose(schedule.path.position, positions[at], rtol=0, atol=accuracy)
    for quaternion, k in zip(schedule.path.quaternion, at, strict=True):
        assert (Rotation.from_quat(quaternion).inv() * attitudes[k]).magnitude() < accuracy
    return positions[-1], attitudes[-1]


def random_case(sliders: int, seed: int) -> tuple[SlidingRobot, RobotState, Goal, Array]:
    """Return a robot anywhere in any shape, a goal that a shape reaches, and that shape."""
    rng = np.random.default_rng(100 * sliders + seed)
    robot = random_sliding_robot(rng, sliders)
    shape = rng.uniform(-1.0, 1.0, sliders)
    attitude = Rotation.from_rotvec(rng.normal(size=3))
    state = state_at(rng.normal(size=3), attitude, shape)
    z_f = shape + rng.uniform(-0.6, 0.6, sliders)
    turn = Rotation.from_rotvec(rng.uniform(-0.15, 0.15, 3))
    return robot, state, pose_for_shape(robot, state, z_f, turn), z_f
