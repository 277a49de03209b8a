"""Parameters that several nodes have in common."""

from __future__ import annotations

from dataclasses import dataclass

from spacerobot_ros.model.robot_source import BelievedRobotConfig
from spacerobot_ros.parameters import parameter
from spacerobot_ros.times import SECOND


@dataclass(frozen=True)
class WatchdogConfig:
    """When a node that another one depends on counts as silent."""

    watchdog_timeout: float = parameter(
        0.8,
        "wall time without a heartbeat after which a node that this one depends on is silent; 0: "
        "never",
        unit="s",
        minimum=0.0,
    )


@dataclass(frozen=True)
class CommanderConfig(WatchdogConfig, BelievedRobotConfig):
    """What the nodes that command a plant have in common: rate, goals, tolerances."""

    tick_rate: float = parameter(
        20.0,
        "commands a second; that of the plant",
        unit="Hz",
        minimum=0.001,
        maximum=100000.0,
    )
    world_frame: str = parameter(
        "world", "frame that goals are in, if they name no other that is known"
    )
    state_reliability: str = parameter(
        "auto",
        "how odom and joint_states are subscribed: best_effort receives from every publisher, "
        "reliable loses no message of a reliable publisher; auto: reliable, until one offers less",
        choices=("auto", "reliable", "best_effort"),
    )
    diagnostics_period: float = parameter(
        1.0,
        "simulated time between diagnostics; 0: ignored states only. Outside of a run in one "
        "process also once a second of wall time",
        unit="s",
        minimum=0.0,
    )
    position_tolerance: float = parameter(
        0.001,
        "largest position error at a goal that is reached",
        unit="m",
        minimum=0.0,
        read_only=False,
    )
    attitude_tolerance: float = parameter(
        0.001,
        "largest attitude error at a goal that is reached",
        unit="rad",
        minimum=0.0,
        read_only=False,
    )
    joint_tolerance: float = parameter(
        0.001,
        "largest error of a joint at a goal that is reached",
        unit="m or rad",
        minimum=0.0,
        read_only=False,
    )
    resume_file: str = parameter(
        "", "file of the present goals, from which a node that is restarted resumes; '': none"
    )
    stop_when_decided: bool = parameter(
        False, "answer no states once a goal is decided: a lockstep plant stays at that tick"
    )
    watchdog_action: str = parameter(
        "report", "what a silent plant leads to beside a report", choices=("report", "abort")
    )

    @property
    def control_period(self) -> float:
        """How long a command is held, a whole number of nanoseconds, s."""
        return round(SECOND / self.tick_rate) / SECOND
