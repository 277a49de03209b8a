"""The parameters of coordinated control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spacerobot_ros.control.laws.law import Gains
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.reference import PROFILES
from spacerobot_ros.model.robot_source import BelievedRobotConfig
from spacerobot_ros.parameters import group, parameter, registered


@dataclass(frozen=True)
class ControllerConfig(BelievedRobotConfig):
    """What a controller controls, by which law, and when a goal is reached."""

    law: str = parameter("transposed_jacobian", "control law", choices=tuple(LAWS))
    tick_rate: float = parameter(
        100.0, "commands a second; the plant's", unit="Hz", minimum=0.001, maximum=100000.0
    )
    world_frame: str = parameter("world", "frame that goals must be given in")
    end_effector_frame: str = parameter("", "link that is controlled; '': 'end_effector', if any")
    base_outputs: str = parameter("", "axes of the base: x y z rx ry rz; '': by the robot")
    end_effector_outputs: str = parameter("", "axes of the end-effector; '': by the robot")
    joint_outputs: str = parameter("", "joints that are outputs; '': by the robot")
    profile: str = parameter("step", "how references move to goals", choices=tuple(PROFILES))
    motion: MotionLimits = group(MotionLimits())
    max_force: float = parameter(0.0, "of the thrusters; 0: no limit", unit="N", minimum=0.0)
    max_torque: float = parameter(0.0, "of the thrusters; 0: no limit", unit="N m", minimum=0.0)
    estimation_time: float = parameter(
        1.0, "without odom the base is estimated this long", unit="s", minimum=0.0
    )
    position_tolerance: float = parameter(
        0.001, "a goal is met within", unit="m", minimum=0.0, read_only=False
    )
    attitude_tolerance: float = parameter(
        0.001, "a goal is met within", unit="rad", minimum=0.0, read_only=False
    )
    joint_tolerance: float = parameter(
        0.001, "a goal is met within", unit="m or rad", minimum=0.0, read_only=False
    )
    settle_time: float = parameter(1.0, "... for this long", unit="s", minimum=0.0, read_only=False)
    time_limit: float = parameter(
        0.0, "a goal not met after this long has failed; 0: never", unit="s", minimum=0.0
    )
    status_period: float = parameter(
        1.0, "simulated time between status messages", unit="s", minimum=0.01
    )
    resume_file: str = parameter("", "keeps the present goals for one that starts again; '': none")
    gains: Gains = group(Gains())
    options: Mapping[str, Any] = registered(LAWS)

    @property
    def control_period(self) -> float:
        """Time between two commands, a whole number of nanoseconds, s."""
        return round(1e9 / self.tick_rate) / 1e9
