"""Plants under held joint velocities: random robots with the engine that watches them, sliders."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from support.oracles import PinocchioOracle
from support.random_robots import random_robot_urdf

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.simulation import InitialState, VelocityPlant

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf"
TICK = 0.05
RATE, STROKE = 2.0, 3.0  # of the joints of random robots


@cache
def robot_of(urdf: str) -> SpaceRobot:
    """Return the model of a robot, built once: that takes longer than a flight."""
    return SpaceRobot.from_urdf(urdf)


class Case:
    """A random robot in a random state, and the engine that watches it."""

    def __init__(self, seed: int, *, momentum: bool) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.urdf = random_robot_urdf(rng, int(rng.integers(3, 7)))
        self.robot = robot_of(self.urdf)
        self.oracle = PinocchioOracle(self.urdf, self.robot.joint_names)
        n = self.robot.n
        quaternion = rng.normal(size=4)
        self.initial = InitialState(
            position=rng.uniform(-2.0, 2.0, 3),
            quaternion=quaternion / np.linalg.norm(quaternion),
            # Not far from the ends of the strokes.
            joint_positions=rng.uniform(2.0, 2.9, n) * rng.choice([-1.0, 1.0], n),
            linear_momentum=rng.normal(size=3) if momentum else np.zeros(3),
            angular_momentum=rng.normal(size=3) if momentum else np.zeros(3),
        )

    def plant(self, **options: Any) -> VelocityPlant:
        return VelocityPlant(self.robot, TICK, self.initial, **options)

    def command(self) -> Array:
        """Return random rates, many of them more than a joint can do."""
        return self.rng.uniform(-1.3 * RATE, 1.3 * RATE, self.robot.n)

    def body_momenta(self, plant: VelocityPlant) -> tuple[Array, Array]:
        """Return linear and angular momentum of every body (L, 3), world, the latter about the
        system's centre of mass.
        """
        oracle = self.oracle
        oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
        u = oracle.base_velocities(plant.twist) + oracle.joint_velocities(plant.qdot)
        pin.forwardKinematics(oracle.model, oracle.data, oracle.q, u)
        r_cm = oracle.center_of_mass_W()
        linear, angular = [], []
        for index in range(1, oracle.model.njoints):
            own = oracle.model.inertias[index] * oracle.data.v[index]
            about_origin = oracle.data.oMi[index].act(own)
            linear.append(np.array(about_origin.linear))
            angular.append(about_origin.angular - np.cross(r_cm, about_origin.linear))
        return np.array(linear), np.array(angular)


def sliding_masses(**initial: Any) -> VelocityPlant:
    """Return three sliders of 0.7 m/s and 2.5 m either way."""
    robot = robot_of((URDF / "sliding_masses.urdf").read_text("utf-8"))
    return VelocityPlant(robot, TICK, InitialState(**initial))
