"""Schedules flown in the plant under velocity actuation, piece by piece, as the planner does it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from support.planners import Planner

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.plant import InitialState
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

STEP = 0.05
"""Integration step of plant and prediction, s: slow motions, and Runge-Kutta 4."""


@dataclass(frozen=True)
class Flight:
    """The pieces that were flown, and the pose (7,) and shape (n,) of the plant after each."""

    pieces: list[GaitSchedule]
    poses: list[Array]
    shapes: list[Array]

    def left(self, goal: Goal) -> Array:
        """Return the rotation vectors (pieces, 3) from the attitude after a piece to the goal."""
        attitudes = Rotation.from_quat(np.array(self.poses)[:, 3:])
        return np.asarray((attitudes.inv() * Rotation.from_quat(goal.quaternion)).as_rotvec())


def plant_at(
    robot: SpaceRobot, q: npt.ArrayLike, period: float, attitude: Rotation | None = None
) -> VelocityPlant:
    quaternion = (attitude or Rotation.identity()).as_quat()
    initial = InitialState(quaternion=quaternion, joint_positions=np.asarray(q, dtype=float))
    return VelocityPlant(robot, period, initial, STEP)


def measured(plant: VelocityPlant | PlantWithFaults) -> RobotState:
    return RobotState(plant.pose[:3].copy(), plant.pose[3:].copy(), plant.q.copy())


def fly(
    method: Planner,
    plant: VelocityPlant,
    goal: Goal,
    *,
    watch: Callable[[GaitSchedule], None] | None = None,
) -> Flight:
    """Fly to the goal: a partial schedule is followed by the next from where the plant is then."""
    flight = Flight([], [], [])
    for _ in range(1000):
        schedule = method.plan(measured(plant), goal, correction=bool(flight.pieces))
        if watch is not None:
            watch(schedule)
        for rates in schedule.velocities:
            plant.step(rates)
        # A joint at the end of its stroke is limited by rounding; more would be seen here.
        np.testing.assert_allclose(plant.q, schedule.positions[-1], atol=1e-9)
        flight.pieces.append(schedule)
        flight.poses.append(plant.pose.copy())
        flight.shapes.append(plant.q.copy())
        if not schedule.partial:
            break
    return flight
