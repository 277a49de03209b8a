"""Stacks that random actions are tried on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from support.oracles import Array

from spacerobot_ros.model import SpaceRobot

_ROOT = Path(__file__).parents[3]

PLANNER, CONTROLLER = "planner", "coordinated_control"

# Loops that are closed over joint motors want their commands in time: not much faster than life.
_WALL: dict[str, Any] = {"time_mode": "realtime", "real_time_factor": 1.0, "command_timeout": 1.0}


@dataclass(frozen=True)
class Setup:
    """A robot, the nodes that fly it, and how goals for it are drawn.

    Attributes
    ----------
    robot
        Its name.
    plant, planner, controller
        Parameters of the nodes; no planner or controller where they are empty.
    real_time
        Parameters of the plant in real time, beside the others.
    reach, turn
        Goals are up to this far from where the base is, m and rad, component by component.
    shapes
        (n,) how far from zero the joints are in a shape that is asked for; empty: none is.
    tip
        Whether there are goals for the end-effector.
    twists
        Whether the end-effector is moved by twists.
    nozzles
        Names of thrusters that may fail.
    patience
        Simulated time within which a goal is decided, s.
    """

    robot: str
    plant: Mapping[str, Any]
    planner: Mapping[str, Any] = field(default_factory=dict)
    controller: Mapping[str, Any] = field(default_factory=dict)
    real_time: Mapping[str, Any] = field(default_factory=lambda: _WALL)
    reach: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shapes: tuple[float, ...] = ()
    tip: bool = False
    twists: bool = False
    nozzles: tuple[str, ...] = ()
    patience: float = 120.0

    @property
    def urdf(self) -> str:
        """Text of the robot's URDF."""
        return (_ROOT / "urdf" / f"{self.robot}.urdf").read_text(encoding="utf-8")

    @property
    def model(self) -> SpaceRobot:
        """The robot, for its names and limits."""
        return SpaceRobot.from_urdf(self.urdf)

    @property
    def commanders(self) -> tuple[str, ...]:
        """Names of the nodes that command the plant."""
        planner, controller = bool(self.planner), bool(self.controller)
        return (PLANNER,) * planner + (CONTROLLER,) * controller

    @property
    def decider(self) -> str:
        """The node that decides what becomes of goals for the base."""
        return self.commanders[0]

    @property
    def servos(self) -> bool:
        """Whether joint velocities are commanded."""
        return self.plant.get("actuation", "velocity") == "velocity"

    @property
    def period_ns(self) -> int:
        """Duration of a tick, ns."""
        return round(1e9 / self.plant["tick_rate"])

    @property
    def home(self) -> Array:
        """Shape (n,) that the robot begins with."""
        return np.asarray(self.plant.get("initial_joint_positions", [0.0] * self.model.n))


def _of(scenario: str, node: str, **changes: Any) -> dict[str, Any]:
    text = (_ROOT / "config" / f"{scenario}.yaml").read_text(encoding="utf-8")
    return {**yaml.safe_load(text)[f"/**/{node}"]["ros__parameters"], **changes}


def _controls(
    scenario: str, position: float, attitude: float, longest: float, **changes: Any
) -> dict[str, Any]:
    tolerances = {"position_tolerance": position, "attitude_tolerance": attitude}
    changes |= {"tick_rate": 50.0, "settle_time": 0.2, "time_limit": longest, **tolerances}
    return _of(scenario, CONTROLLER, **changes)


_QUIET = {"marker_period": 0.0, "diagnostics_period": 0.5, "base_pose_period": 0.0}

# The least inertia of the wrist is 0.012 kg m^2, and commands are held for 0.02 s, in real time now
# and then for twice as long: the gains of the scenarios, which are for 0.01 s, would be unstable.
_WRIST: dict[str, Any] = {
    "gains.end_effector_position.kp": 50.0,
    "gains.end_effector_position.kd": 60.0,
    "gains.end_effector_attitude.kp": 0.4,
    "gains.end_effector_attitude.kd": 0.4,
}

# Half of the paper's gains, which are for 0.01 s, likewise.
_HALF: dict[str, Any] = {
    f"gains.{group}.{name}": gain
    for group in ("base_position", "base_attitude", "end_effector_position")
    for name, gain in (("kp", 15.0), ("kd", 30.0))
}

SETUPS: dict[str, Setup] = {
    # Slides of 2 s in one swing and turns in cycles of 1 s, instead of the paper's 4900 s.
    "sliding_masses": Setup(
        robot="sliding_masses",
        plant={"robot": "sliding_masses", "tick_rate": 20.0, **_QUIET},
        planner={
            "robot": "sliding_masses",
            "tick_rate": 20.0,
            "method": "lie_bracket",
            "lie_bracket.t1": 2.0,
            "lie_bracket.n1": 1,
            "lie_bracket.cycle_period": 1.0,
        },
        real_time={**_WALL, "real_time_factor": 15.0, "command_timeout": 8.0},
        reach=(0.03, 0.03, 0.03),
        turn=(0.004, 0.004, 0.004),
    ),
    "sliding_masses_optimal": Setup(
        robot="sliding_masses",
        plant=_of("sliding_masses", "plant", **_QUIET),
        planner=_of("sliding_masses", "planner"),
        real_time={**_WALL, "real_time_factor": 15.0, "command_timeout": 8.0},
        reach=(0.1, 0.1, 0.1),
        turn=(0.1, 0.1, 0.1),
    ),
    # Loops turn its base, and its hand follows twists.
    "three_joint_arm": Setup(
        robot="three_joint_arm",
        plant=_of("arm_attitude", "plant", **_QUIET),
        planner=_of(
            "arm_attitude",
            "planner",
            **{"area_loop.k": 1.0, "twist_timeout": 0.5},
            attitude_tolerance=0.005,
        ),
        real_time={**_WALL, "real_time_factor": 5.0, "command_timeout": 4.0},
        turn=(0.02, 0.02, 0.02),
        twists=True,
        patience=250.0,
    ),
    # The paper's path in a quarter of its time.
    "planar_chain": Setup(
        robot="planar_chain",
        plant=_of("planar_chain", "plant", **_QUIET, tick_rate=50.0),
        planner=_of(
            "planar_chain",
            "planner",
            **{f"square_path.t{k}": t for k, t in enumerate((2.0, 3.0, 5.0, 6.0), 1)},
            tick_rate=50.0,
            attitude_tolerance=0.01,
            joint_tolerance=0.01,
        ),
        controller=_of("planar_chain", "coordinated_control", tick_rate=50.0),
        real_time={**_WALL, "real_time_factor": 2.0},
        turn=(0.0, 0.0, 0.3),
        shapes=(0.5, 0.5),
    ),
    "planar_manipulator": Setup(
        robot="planar_manipulator",
        plant=_of("coordinated_control", "plant", **_QUIET, tick_rate=50.0),
        controller=_controls("coordinated_control", 0.005, 0.01, 30.0, **_HALF),
        reach=(0.1, 0.1, 0.0),
        turn=(0.0, 0.0, 0.1),
        tip=True,
    ),
    # It begins with momentum: a base that drifts where nothing thrusts.
    "servicer": Setup(
        robot="servicer",
        plant=_of(
            "servicer",
            "plant",
            **_QUIET,
            tick_rate=50.0,
            linear_momentum=[4.0, -2.0, 3.0],
            angular_momentum=[1.0, 2.0, -1.0],
        ),
        controller=_controls("servicer", 0.005, 0.01, 100.0, **_WRIST),
        reach=(0.05, 0.05, 0.05),
        turn=(0.05, 0.05, 0.05),
        tip=True,
        patience=150.0,
    ),
    "servicer_thrusters": Setup(
        robot="servicer",
        plant=_of("servicer_thrusters", "plant", **_QUIET, tick_rate=50.0),
        controller=_controls("servicer_thrusters", 0.01, 0.02, 100.0, profile="quintic", **_WRIST),
        reach=(0.05, 0.05, 0.05),
        turn=(0.05, 0.05, 0.05),
        tip=True,
        nozzles=("plus_x_1", "plus_x_4"),
        patience=150.0,
    ),
    # Reaction wheels that spin from the beginning, and a target that drifts by.
    "wheels_and_target": Setup(
        robot="tender",
        plant=_of(
            "wheels",
            "plant",
            **_QUIET,
            **{"target.robot": str(_ROOT / "config/targets/block.urdf")},
            **{"target.position": [6.0, 3.0, 2.0], "target.velocity": [-0.01, 0.0, 0.0]},
        ),
        controller=_of(
            "wheels",
            "coordinated_control",
            settle_time=0.2,
            position_tolerance=0.01,
            attitude_tolerance=0.01,
            time_limit=100.0,
        ),
        reach=(0.05, 0.05, 0.05),
        turn=(0.05, 0.05, 0.05),
        tip=True,
        patience=150.0,
    ),
}
"""By name."""
