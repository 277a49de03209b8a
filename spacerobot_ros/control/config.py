"""Parameters of coordinated control."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spacerobot_ros.control.approach import ApproachOptions
from spacerobot_ros.control.detumbling import DetumbleOptions
from spacerobot_ros.control.laws.law import Gains
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.outputs import OutputDistance
from spacerobot_ros.control.reference import PLANNED_PROFILE, PROFILES
from spacerobot_ros.control.wheels import WheelOptions
from spacerobot_ros.errors import counted
from spacerobot_ros.model.shared_parameters import CommanderConfig
from spacerobot_ros.parameters import group, nonnegative, parameter, registered
from spacerobot_ros.planning.methods.thrust.problem import ThrustOptions


@dataclass(frozen=True)
class ErrorMargin:
    """Margin beyond twice the goal distance at which growing errors abort the goal."""

    position: float = nonnegative(
        1.0,
        "abort if a position error exceeds twice the goal distance by more than this; 0: never",
        "m",
    )
    attitude: float = nonnegative(
        1.0,
        "abort if an attitude error exceeds twice the goal angle by more than this; 0: never",
        "rad",
    )

    def as_distances(self) -> OutputDistance:
        """Return the margins; margins given as 0, and joint margins, are infinite."""
        return OutputDistance(self.position or math.inf, self.attitude or math.inf, math.inf)


def waypoints_refusal(count: int) -> str:
    """Return the message for a goal whose waypoints need a planned motion."""
    return (
        f"The goal has {counted(count, 'waypoint')}, which only a planned motion passes: set "
        "profile to planned."
    )


@dataclass(frozen=True)
class ControllerConfig(CommanderConfig):
    """Parameters of a controller: outputs, law, limits, and goal criteria."""

    law: str = parameter("transposed_jacobian", "control law", choices=LAWS)
    end_effector_frame: str = parameter("", "end-effector link; '': 'end_effector', if it exists")
    base_outputs: str = parameter(
        "",
        "base axes used as outputs: x y z rx ry rz; if all three output parameters are '': "
        "chosen from the robot",
    )
    end_effector_outputs: str = parameter("", "end-effector axes used as outputs")
    joint_outputs: str = parameter("", "joints that are outputs")
    profile: str = parameter(
        "quintic",
        "profile of goal references; planned: within the available thrust, around obstacles",
        choices=(*PROFILES, PLANNED_PROFILE),
    )
    plan: ThrustOptions = group(ThrustOptions())
    motion: MotionLimits = group(MotionLimits())
    use_thrusters: bool = parameter(
        True,
        "whether the base has thrusters; if false, only reaction wheels rotate it, and its "
        "position is not controlled",
    )
    max_force: float = nonnegative(0.0, "largest thruster force; 0: no limit", "N")
    max_torque: float = nonnegative(0.0, "largest thruster torque; 0: no limit", "N m")
    joint_rates: float = nonnegative(
        1.0, "joint rate limit, as a fraction of the URDF limits; 0: no limit", maximum=1000.0
    )
    estimation_time: float = nonnegative(
        1.0, "longest time for which the base state is estimated while odom is missing", "s"
    )
    reference_timeout: float = nonnegative(
        1.0,
        "longest time for which states wait for a silent publisher of joint_reference or "
        "base_reference (simulated time; in lockstep, wall time); 0: forever",
        "s",
    )
    settle_time: float = nonnegative(
        1.0, "time for which all errors must stay within the tolerances", "s", read_only=False
    )
    time_limit: float = nonnegative(
        0.0,
        "time after which an unreached goal fails; 0: 300 s after the end of its reference",
        "s",
    )
    wheels: WheelOptions = group(WheelOptions())
    error_margin: ErrorMargin = group(ErrorMargin())
    status_period: float = parameter(
        1.0, "simulated time between status messages", "s", minimum=0.01
    )
    tasks: str = parameter(
        "",
        "tasks to carry out before a goal, in this order, separated by spaces: 'approach' "
        "(approach the target until it is captured), 'detumble' (detumble the robot that holds "
        "it); '': none",
    )
    target: ApproachOptions = group(ApproachOptions())
    detumble: DetumbleOptions = group(DetumbleOptions())
    gains: Gains = group(Gains())
    options: Mapping[str, Any] = registered(LAWS)

    @property
    def plans(self) -> bool:
        """Whether references to goals are planned within the available thrust."""
        return self.profile == PLANNED_PROFILE

    @property
    def tolerances(self) -> OutputDistance:
        """Tolerances of all kinds of outputs, m and rad."""
        return OutputDistance(
            self.position_tolerance, self.attitude_tolerance, self.joint_tolerance
        )
