"""What the viewer node tells the page of the stack, and what the page tells the node to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.simulation.status import PlantStatus


@dataclass(frozen=True)
class Measured:
    """The last state of the robot.

    Attributes
    ----------
    time_s
        Simulated time, s.
    pose
        (7,) of the base link in the world: m, quaternion (x, y, z, w).
    q, qdot, effort
        (n,) of the joints in the order of the description, m or rad, /s, N or N m.
    """

    time_s: float
    pose: Array
    q: Array
    qdot: Array
    effort: Array


@dataclass(frozen=True)
class Momenta:
    """Total momenta in the world: linear (kg m/s) over angular (kg m^2/s).

    Attributes
    ----------
    actual
        (6,) summed over the bodies.
    expected
        (6,) what they should be; None: those of the beginning.
    energy
        Kinetic energy, J.
    """

    actual: Array
    expected: Array | None
    energy: float


@dataclass(frozen=True)
class Firing:
    """What the thrusters do: their ``names``, and for what part of the last tick each was on."""

    names: tuple[str, ...]
    duty: Array


Part = Literal["base", "end_effector"]
"""What a goal is for."""


@dataclass(frozen=True)
class StackState:
    """Everything that is known of the stack at one look; None: not known, or not there.

    Attributes
    ----------
    measured, age_s
        The last state, and for how many wall s no state has come; infinite before the first.
    tool
        (7,) pose of the end-effector in the world.
    momenta, firing
        As the plant reports them.
    plant, planner, controller, replay
        The last status of each, None where there is no such node.
    planned_path
        (k, 3) positions of the base that the planner predicts, m.
    goals
        What was last sent by anybody, by part.
    silent
        Nodes whose heartbeats have ended, by name, and for how many wall s.
    inactive
        Nodes that were deactivated or have ended in order, by name.
    absent
        Which of ``plant``, ``planner``, ``controller``, ``replay`` are of such nodes: what they
        reported is no longer so.
    busy
        Whether a commander plans or compiles, and answers when that is done.
    """

    measured: Measured | None = None
    tool: Array | None = None
    age_s: float = float("inf")
    momenta: Momenta | None = None
    firing: Firing | None = None
    plant: PlantStatus | None = None
    planner: PlannerStatus | None = None
    controller: ControllerStatus | None = None
    replay: ReplayStatus | None = None
    planned_path: Array | None = None
    goals: Mapping[Part, Goal] = field(default_factory=dict)
    silent: Mapping[str, float] = field(default_factory=dict)
    inactive: tuple[str, ...] = ()
    absent: frozenset[str] = frozenset()
    busy: bool = False


@dataclass(frozen=True)
class Notice:
    """A line of the log: ``level`` 0 OK, 1 WARN, 2 ERROR; ``time_s`` simulated, if known, s."""

    sentence: str
    level: int = 0
    time_s: float | None = None
    source: str = ""


class Request(Enum):
    """What services of the stack are asked for."""

    ABORT = "abort"
    """The commanders give up their goals; the joints brake."""
    STOP = "stop"
    """The plant brings everything to rest and latches, until it is rearmed."""
    REARM = "rearm"
    PAUSE = "pause"
    RESUME = "resume"
    RESET = "reset"
    PLAY = "play"
    """Of a replay."""
    HOLD = "hold"
    """A replay stands still."""


@dataclass(frozen=True)
class Fly:
    """Send goals for the parts that have one, with one stamp."""

    goals: Mapping[Part, Goal]


@dataclass(frozen=True)
class Inject:
    """Give the plant faults, a line each, or ``clear``."""

    text: str


@dataclass(frozen=True)
class Seek:
    """Go to a time of the replay, s from its beginning."""

    seconds: float


Action = Request | Fly | Inject | Seek
"""What a user of the page wants."""
