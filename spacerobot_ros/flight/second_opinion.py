"""Comparison of a recorded flight with its re-simulation in another engine.

In each tick, the engine receives the external loads, and the joint rates (or efforts and wrench)
realised by the plant's actuators after limits and faults. The engine's states are compared with
those in the bag.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spacerobot_ros.model.description import Array
from spacerobot_ros.model.grasp import RobotMotion
from spacerobot_ros.model.rotations import attitude_errors
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.simulation.loads import PlantLoads
from spacerobot_ros.simulation.mujoco_model import import_mujoco
from spacerobot_ros.simulation.mujoco_plant import DEFAULT_INTEGRATION_STEP, MujocoPlant
from spacerobot_ros.simulation.plant import Plant, WrappedPlant

AGREEMENT_TOLERANCE = 1e-8
"""Maximum deviation at which an engine agrees with a flight, m or rad."""


@dataclass(frozen=True)
class EngineComparison:
    """The largest differences between a flight and its re-simulation in another engine.

    Attributes
    ----------
    engine
        Name and version of the engine.
    integrator
        The engine's integrator, with its maximum step.
    ticks
        Number of compared ticks.
    position, attitude, joints
        Largest differences in base position, m, base attitude, rad, and joint positions, m or rad.
    time
        Simulated time of the largest difference, s.
    stop_reason
        Reason why the engine stopped early; empty if the replay was completed.
    """

    engine: str
    integrator: str
    ticks: int
    position: float
    attitude: float
    joints: float
    time: float
    stop_reason: str = ""

    @property
    def agrees(self) -> bool:
        """Whether all differences are at most :data:`AGREEMENT_TOLERANCE`."""
        return max(self.position, self.attitude, self.joints) <= AGREEMENT_TOLERANCE


class EngineFlight:
    """Flies a robot in MuJoCo alongside a plant, tick by tick.

    Parameters
    ----------
    plant
        The plant in its initial state.
    period
        Duration of a tick, s.

    Raises
    ------
    SpaceRobotError
        MuJoCo is not installed, or does not support the robot.
    """

    def __init__(self, plant: PlantWithFaults, period: float) -> None:
        self._plant, self._period = plant, period
        dynamics: Plant = plant
        while isinstance(dynamics, WrappedPlant):
            dynamics = dynamics.plant
        self._effort_plant = dynamics if isinstance(dynamics, EffortPlant) else None
        actuation = "effort" if self._effort_plant is not None else "velocity"
        self._engine = MujocoPlant(plant.robot, period, actuation=actuation, contacts=False)
        self._engine.go_on(RobotMotion(plant.pose, plant.twist, plant.q, plant.qdot))
        self._loads = PlantLoads(plant.robot)
        self._engine.load(self._loads)
        self._stopped = plant.limit_counts["stroke"].copy()
        self._faults = plant.active
        self._first = plant.tick
        self._poses, self._shapes = [self._engine.pose.copy()], [self._engine.q.copy()]
        self._until = ""

    def fly_next_tick(self) -> None:
        """Simulate the tick that the plant has just completed."""
        if self._until:
            return
        plant, loads = self._effort_plant, self._plant.loads
        if loads is not None:
            self._loads.vector[:] = loads.last
        if plant is None:
            self._engine.step(self._plant.qdot)
        elif reason := self._unknown_force():
            self._until = f"{reason} at {self._plant.time:.9g} s, which the engine does not model"
            return
        else:
            self._engine.step(plant.effort, plant.wrench)
        self._poses.append(self._engine.pose.copy())
        self._shapes.append(self._engine.q.copy())

    def _unknown_force(self) -> str:
        """Return a clause about a force in the last tick that the commands lack; empty if none."""
        plant, before = self._plant, self._faults
        self._faults = plant.active
        names = plant.robot.joint_names
        stuck = [each.target for each in (*before, *plant.active) if each.kind == "joint_stuck"]
        if stuck:
            return f"joint '{stuck[0]}' is held"
        stopped = np.flatnonzero(plant.limit_counts["stroke"] > self._stopped)
        return f"joint '{names[int(stopped[0])]}' is at its stop" if stopped.size else ""

    def comparison(
        self, ticks: npt.NDArray[np.int64], poses: Array, shapes: Array
    ) -> EngineComparison:
        """Return the differences from the states in a bag.

        Parameters
        ----------
        ticks
            (N,) ticks of the states.
        poses, shapes
            (N, 7) poses of the base, and (N, n) joint positions.
        """
        rows = ticks - self._first
        known = (rows >= 0) & (rows < len(self._poses))
        rows = rows[known]
        own = np.array(self._poses)[rows]
        place = np.linalg.norm(own[:, :3] - poses[known, :3], axis=1)
        turn = np.linalg.norm(attitude_errors(own[:, 3:], poses[known, 3:]), axis=1)
        bend = np.abs(np.array(self._shapes)[rows] - shapes[known]).max(axis=1, initial=0.0)
        worst = int(np.argmax(np.maximum(np.maximum(place, turn), bend)))
        return EngineComparison(
            engine=f"MuJoCo {import_mujoco().__version__}",
            integrator=f"Runge-Kutta 4 with steps of at most {DEFAULT_INTEGRATION_STEP:g} s",
            ticks=len(rows) - 1,
            position=float(place.max()),
            attitude=float(turn.max()),
            joints=float(bend.max()),
            time=float(ticks[known][worst]) * self._period,
            stop_reason=self._until,
        )
