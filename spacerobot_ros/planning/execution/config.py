"""Planner parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, RobotDescription
from spacerobot_ros.model.shared_parameters import DEFAULT_POSITION_TOLERANCE, CommanderConfig
from spacerobot_ros.model.urdf import with_srdf
from spacerobot_ros.parameters import nonnegative, parameter, registered
from spacerobot_ros.planning.core.clearance import DEFAULT_CLEARANCE
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.registry import METHODS
from spacerobot_ros.topics import require_own_topics

_BACKGROUND_REPLAN_PERIOD = 2.0
"""Default ``replan_period`` if planning runs in the background, s."""


@dataclass(frozen=True)
class PlannerConfig(CommanderConfig):
    """Parameters for planning, schedule tracking, and corrections."""

    method: str = parameter("auto", "gait method", choices=METHODS)
    integration_step: float = parameter(0.01, "longest prediction step", "s", minimum=1e-06)
    end_effectors: tuple[str, ...] = parameter(
        (),
        "links that accept goals on NAME/goal_pose and paths on NAME/path, in addition to the "
        "link end_effector",
        texts=True,
    )
    output: str = parameter(
        "commands",
        "joint_commands (velocities) for the plant, joint_reference for a controller, or "
        "schedules for a robot's FollowJointTrajectory server",
        choices=("commands", "reference", "trajectory"),
    )
    trajectory_action: str = parameter(
        "joint_trajectory_controller/follow_joint_trajectory",
        "name of the FollowJointTrajectory action to which schedules are sent if `output` is "
        "trajectory",
    )
    clearance: float = nonnegative(
        DEFAULT_CLEARANCE,
        "smallest distance in plans between links not connected by a joint; 0 disables collision "
        "checks",
        "m",
        maximum=1000.0,
    )
    srdf: str = parameter(
        "", "SRDF file with link pairs excluded from checks; '': NAME.srdf next to the URDF"
    )
    max_corrections: int = nonnegative(
        3, "largest number of plans after the first", maximum=1000, read_only=False
    )
    abort_time: float = parameter(
        1.0,
        "duration of braking along the planned path, after ~/abort or for another goal",
        "s",
        minimum=0.01,
        maximum=1000.0,
    )
    twist_timeout: float = parameter(
        0.5,
        "timeout, in simulated time, of twists on NAME/twist, after which the joints brake",
        "s",
        minimum=0.001,
        maximum=1000.0,
    )
    takeover_time: float = nonnegative(
        1.0,
        "time along the current schedule before a plan for another goal takes over in motion, if "
        "the method supports it; 0: the joints brake first",
        "s",
        maximum=1000.0,
    )
    replan_period: float = parameter(
        -1.0,
        "period at which the remaining motion is replanned without a stop, if the method supports "
        "it; 0: never, -1: 2 s with plan_in_background, else never",
        "s",
        minimum=-1.0,
        maximum=1e6,
    )
    drift_position: float = nonnegative(
        0.0, "base tracking error beyond which the remaining motion is replanned; 0: never", "m"
    )
    drift_attitude: float = nonnegative(0.0, "likewise", "rad")
    shape_gain: float = nonnegative(
        2.0, "feedback gain for joint positions while tracking", "1/s", maximum=1000.0
    )
    shape_deadband: float = nonnegative(
        0.0,
        "joint position errors up to this value are treated as noise and not fed back",
        "m or rad",
    )
    averaging: int = parameter(
        1,
        "number of measured states at rest that are averaged for planning and evaluation",
        minimum=1,
        maximum=1000000.0,
    )
    rest_tolerance: float = nonnegative(
        0.0, "measured rates up to this value count as rest; 0: none", "m/s or rad/s"
    )
    stuck_ticks: int = nonnegative(
        40,
        "ticks of commanded motion after which a joint that does not follow is considered stuck; "
        "0: never",
        maximum=1000000.0,
    )
    options: Mapping[str, Any] = registered(METHODS)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_own_topics(tuple(dict.fromkeys(self.end_effectors)))

    def described(self, robot: RobotDescription) -> RobotDescription:
        """Return the robot with the pairs disabled in the SRDF, and with the obstacles."""
        robot = super().described(robot)
        return with_srdf(robot, self.srdf) if self.srdf else robot

    @property
    def goal_links(self) -> tuple[str, ...]:
        """Names of the links that accept goals.

        If a controller moves the robot, it handles the end-effector goals.
        """
        default = [DEFAULT_END_EFFECTOR] if self.output != "reference" else []
        return tuple(dict.fromkeys((*default, *self.end_effectors)))

    @property
    def replanning(self) -> float:
        """Time after which the remaining motion is replanned, s; 0: never."""
        if self.replan_period >= 0:
            return self.replan_period
        return _BACKGROUND_REPLAN_PERIOD if self.plan_in_background else 0.0

    @property
    def method_options(self) -> Mapping[str, Any]:
        """Method options by name; defaults depend on the output.

        If the output is a controller reference, efforts are reserved for feedback.
        """
        optimal = self.options.get(OptimalGait.name, OptimalGait.Options())
        if self.output != "reference" or optimal.effort_limits != 0:
            return self.options
        return {**self.options, OptimalGait.name: replace(optimal, effort_limits=1)}

    @property
    def tolerance(self) -> Tolerance:
        """Largest errors at which a goal counts as reached."""
        position = self.position_tolerance or DEFAULT_POSITION_TOLERANCE
        return Tolerance(position, self.attitude_tolerance, self.joint_tolerance)
