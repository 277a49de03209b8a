"""Page interface: the displayed state of the stack, and user actions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import (
    BASE_GOAL_KEY,
    IdentifiedGoal,
    decode_goal,
    encode_goal,
)
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.simulation.clearance import ClearanceStatus
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.topics import Request


@dataclass(frozen=True)
class Measured:
    """The last measured state of the robot.

    Attributes
    ----------
    time_s
        Simulated time, s.
    pose
        (7,) base link pose in the world: m, quaternion (x, y, z, w).
    q, qdot, effort
        (n,) joint positions (m or rad), rates (m/s or rad/s) and efforts (N or N m), in robot
        description order.
    twist
        (6,) linear and angular velocity of the base link, in its own frame, m/s and rad/s.
    """

    time_s: float
    pose: Array
    q: Array
    qdot: Array
    effort: Array
    twist: Array = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True)
class Momenta:
    """Total momenta in the world: linear (kg m/s), then angular (kg m^2/s).

    Attributes
    ----------
    actual
        (6,) summed over the bodies.
    expected
        (6,) momenta expected from thrust and other external forces; None: they are constant.
    """

    actual: Array
    expected: Array | None


@dataclass(frozen=True)
class Firing:
    """Thruster activity: ``names``, and the on-time of each thruster as a fraction of the last
    tick, 0 to 1."""

    names: tuple[str, ...]
    duty: Array


Part = str
"""The robot part to which a goal applies: ``base``, a link name, or ``end_effector``,
also for a controller's end-effector.
"""


def goals_to_text(goal: Goal, of_controller: Goal | None = None) -> str:
    """Return goals as JSON; ``of_controller`` is the goal of a controller's end-effector."""
    goals: dict[Part, Goal] = {
        aim.link: Goal.of_end_effectors([aim], joint_positions=goal.joint_positions)
        for aim in goal.end_effectors
    }
    if goal.base:
        goals[BASE_GOAL_KEY] = replace(goal, end_effectors=())
    if of_controller is not None:
        goals[DEFAULT_END_EFFECTOR] = of_controller
    return json.dumps({part: encode_goal(IdentifiedGoal(each)) for part, each in goals.items()})


def goals_from_text(text: str) -> dict[Part, Goal]:
    """Return the goals by robot part from a :func:`goals_to_text` string; empty if the string is
    empty.
    """
    return {part: decode_goal(entry) for part, entry in json.loads(text or "{}").items()}


@dataclass(frozen=True)
class StackState:
    """The state of the stack at one time; None means unknown, or that there is no such node.

    Attributes
    ----------
    measured, age_s
        The last state, and the wall time, s, since its arrival; infinite before the first state.
    tool
        (7,) end-effector pose in the world.
    target
        (7,) pose of the target's root link in the world.
    momenta, firing, clearance
        As reported by the plant.
    plant, planner, controller, replay
        The last status of each node; None if there is no such node.
    planned_path
        (k, 3) base positions predicted by the planner, m.
    planned_motion
        (k, 7 + n) base poses and joint positions along the planned path;
        Also None if the planner has not published a schedule that starts together with the path.
    goals
        The last goal sent by any client, by robot part. A planner's link goal names the link in
        ``end_effectors``; a goal for a controller's end-effector is only a pose.
    silent
        Wall time, s, since the last heartbeat of each silent node, by name.
    inactive
        Names of nodes that were deactivated or shut down.
    absent
        The statuses (``plant``, ``planner``, ``controller``, ``replay``) whose nodes are silent or
        inactive, so the statuses may be outdated.
    busy
        Whether a planner or controller is planning or compiling, which delays the response of that
        node.
    """

    measured: Measured | None = None
    tool: Array | None = None
    target: Array | None = None
    age_s: float = float("inf")
    momenta: Momenta | None = None
    firing: Firing | None = None
    clearance: ClearanceStatus | None = None
    plant: PlantStatus | None = None
    planner: PlannerStatus | None = None
    controller: ControllerStatus | None = None
    replay: ReplayStatus | None = None
    planned_path: Array | None = None
    planned_motion: Array | None = None
    goals: Mapping[Part, Goal] = field(default_factory=dict)
    silent: Mapping[str, float] = field(default_factory=dict)
    inactive: tuple[str, ...] = ()
    absent: frozenset[str] = frozenset()
    busy: bool = False


@dataclass(frozen=True)
class Notice:
    """A log line: ``level`` is 0 (OK), 1 (WARN) or 2 (ERROR); ``time_s`` is the simulated
    time, s, if known."""

    message: str
    level: int = 0
    time_s: float | None = None
    source: str = ""


@dataclass(frozen=True)
class FlyAction:
    """Send goals, by robot part, all with the same stamp."""

    goals: Mapping[Part, Goal]


@dataclass(frozen=True)
class InjectAction:
    """Send fault descriptions to the plant, one per line, or ``clear``."""

    text: str


@dataclass(frozen=True)
class SeekAction:
    """Continue the replay from a given time, s, after its start."""

    seconds: float


Action = Request | FlyAction | InjectAction | SeekAction
"""A user action."""
