"""Commanders without ROS: a host that records what they do, and states of a robot at rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from spacerobot_ros.commanding.commander import Commander
from spacerobot_ros.commanding.fly_to import GoalErrors, Progress
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.commanding.host import ArrayDecoder, StateArrays
from spacerobot_ros.commanding.plant_state import Stamped
from spacerobot_ros.errors import CommandError
from spacerobot_ros.events import Event
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured, declared
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY

TICK = 50_000_000
GOAL = Goal.checked([0.05, -0.03, 0.02], [0.0, 0.0, 0.0, 1.0])


class Host:
    """Records in order whatever a commander does."""

    def __init__(self) -> None:
        self.commands: list[int] = []
        self.statuses: list[Status] = []
        self.events: list[Event] = []
        self.lines: list[tuple[str, str]] = []
        self.starts: list[Any] = []
        self.publishers = {"odom"}
        self.waiting: tuple[list[Stamped], list[Stamped]] = ([], [])
        self.process_statuses: Callable[[], None] = lambda: None
        """What waits on plant/status, which is processed before waiting states."""

    def send_command(self, stamp_ns: int) -> None:
        self.commands.append(stamp_ns // TICK)

    def publish_status(self, status: Status) -> None:
        self.statuses.append(status)

    def report_event(self, event: Event) -> None:
        self.events.append(event)

    def publish_plan(self, path: Any, stamp_ns: int, schedule: Any = None) -> None:
        self.starts.append(path if schedule is None else schedule)

    def log(self, level: str, message: str) -> None:
        self.lines.append((level, message))

    def has_publisher(self, topic: str) -> bool:
        return topic in self.publishers

    def waiting_states(self) -> tuple[list[Stamped], list[Stamped]]:
        process, self.process_statuses = self.process_statuses, lambda: None
        process()
        waiting, self.waiting = self.waiting, ([], [])
        return waiting

    @property
    def states(self) -> list[str]:
        return [status.state.value for status in self.statuses]


class OneRobotDecoder(ArrayDecoder):
    """Refuses joints of another number, and odom that is no pose."""

    def __init__(self, n: int) -> None:
        self._n = n

    def check_robot(self, joints: StateArrays) -> None:
        if len(joints.q) != self._n:
            raise CommandError("joint 'wing' is unknown")

    def decode_base(self, odom: StateArrays) -> tuple[Any, Any]:
        if odom.pose is None:
            raise CommandError("its bytes are not a Odometry")
        return super().decode_base(odom)


def config(kind: Any, **settings: Any) -> Any:
    defaults = {each.name: each.default for each in declared(kind)}
    return configured(kind, {**defaults, "tick_rate": 20.0, **settings})


class Rig:
    """A commander, its host, a wall clock that the test moves, and states of a robot at rest."""

    def __init__(
        self, make: Callable[..., Commander], settings: Any, n: int, **others: Any
    ) -> None:
        self.wall, self.n, self.host = 10.0, n, Host()
        self.commander: Any = make(settings, self.host, clock=lambda: self.wall, **others)

    def message(self, tick: int, *, n: int | None = None, posed: bool = True) -> StateArrays:
        joints = np.zeros(self.n if n is None else n)
        pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]) if posed else None
        return StateArrays(tick * TICK, joints, joints, pose, np.zeros(6))

    def stamped(self, tick: int, **about: Any) -> Stamped:
        return Stamped(tick * TICK, self.message(tick, **about))

    def odom(self, tick: int, **about: Any) -> None:
        self.commander.receive_odom(*self.stamped(tick, **about))

    def joints(self, tick: int, **about: Any) -> None:
        self.commander.receive_joints(*self.stamped(tick, **about))

    def state(self, tick: int) -> None:
        self.odom(tick)
        self.joints(tick)

    def goal(self, sec: int = 7, goal: Goal = GOAL) -> Any:
        return self.commander.receive_goal(BASE_GOAL_KEY, sec, 0, lambda: goal)

    def use(self, robot: SpaceRobot) -> None:
        self.commander.use_robot(robot, OneRobotDecoder(self.n))


def active(make: Callable[..., Commander], settings: Any, robot: SpaceRobot, **others: Any) -> Rig:
    """Return a commander that knows its robot and is active."""
    rig = Rig(make, settings, robot.n, **others)
    rig.use(robot)
    rig.commander.activate()
    return rig


class TrajectoryServer:
    """Keeps what it is asked, and is there or not."""

    def __init__(self) -> None:
        self.present = True
        self.sent: list[tuple[int, Any]] = []
        self.cancelled: list[int] = []

    def is_available(self) -> bool:
        return self.present

    def send(self, number: int, start: Any) -> None:
        self.sent.append((number, start))

    def cancel(self, number: int) -> None:
        self.cancelled.append(number)


class Client:
    """Keeps what a client is told."""

    def __init__(self) -> None:
        self.told: list[Progress] = []
        self.results: list[tuple[Status, GoalErrors]] = []

    def feedback(self, progress: Progress) -> None:
        self.told.append(progress)

    def end(self, status: Status, errors: GoalErrors) -> None:
        self.results.append((status, errors))

    @property
    def end_of(self) -> tuple[str, str]:
        ((status, _),) = self.results
        return status.state.value, status.message


METHOD = {
    "method": "lie_bracket",
    "lie_bracket.t1": 2.0,
    "lie_bracket.n1": 1,
    "plan_in_background": False,
}
