"""The planner's clients of FollowJointTrajectory, with a stand-in for rclpy's client."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from support.planner_loop import NEAR, TICK, StubMethod, goal_at
from support.ros_harness import Harness

from spacerobot_ros.commanding.trajectory_output import TrajectoryEnd, TrajectoryOutput
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import PlannerNode
from spacerobot_ros.nodes.common import trajectory_clients
from spacerobot_ros.nodes.common.fly_to import action_class
from spacerobot_ros.nodes.common.trajectory_clients import TrajectoryClients
from spacerobot_ros.planning import PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.execution.status import ScheduleStart


class Future:
    """An answer that comes when a test says so."""

    def __init__(self) -> None:
        self._callbacks: list[Callable[[Any], None]] = []

    def add_done_callback(self, callback: Callable[[Any], None]) -> None:
        self._callbacks.append(callback)

    def give(self, value: Any) -> None:
        for callback in self._callbacks:
            callback(SimpleNamespace(result=lambda: value))


class Handle:
    """An answer of the server to a goal."""

    def __init__(self, *, accepted: bool = True) -> None:
        self.accepted, self.cancels, self.result = accepted, 0, Future()

    def cancel_goal_async(self) -> None:
        self.cancels += 1

    def get_result_async(self) -> Future:
        return self.result

    def end(self, status: int, code: int = 0, text: str = "") -> None:
        result = SimpleNamespace(error_code=code, error_string=text)
        self.result.give(SimpleNamespace(status=status, result=result))


class Client:
    """rclpy's client of an action."""

    def __init__(self, node: Any, kind: Any, name: str) -> None:
        self.name, self.ready, self.destroyed = name, True, False
        self.sent: list[tuple[Any, Future]] = []

    def server_is_ready(self) -> bool:
        return self.ready

    def send_goal_async(self, goal: Any) -> Future:
        self.sent.append((goal, Future()))
        return self.sent[-1][1]

    def destroy(self) -> None:
        self.destroyed = True


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = SimpleNamespace(Goal=lambda **fields: SimpleNamespace(**fields))
    monkeypatch.setattr(trajectory_clients, "action_class", lambda package, name: kind)
    monkeypatch.setattr(trajectory_clients, "ActionClient", Client)


def start() -> ScheduleStart:
    method = StubMethod(ticks=3)
    state = RobotState(np.zeros(3), np.array([0.0, 0, 0, 1]), np.array([0.1, -0.2, 0.3]))
    return ScheduleStart(
        method.plan(PlanRequest(state, goal_at(NEAR), Tolerance(1e-3, 1e-3))), 250_000_000
    )


@pytest.fixture
def ends() -> list[TrajectoryEnd]:
    return []


@pytest.fixture
def clients(stand_in: None) -> TrajectoryClients:
    return TrajectoryClients(SimpleNamespace(resolve_topic_name=lambda name: f"/ns/{name}"))


@pytest.fixture
def output(clients: TrajectoryClients, ends: list[TrajectoryEnd]) -> TrajectoryOutput:
    return clients.connect("arm/follow", ends.append)


@pytest.fixture
def client(clients: TrajectoryClients, output: TrajectoryOutput) -> Any:
    (client,) = clients._clients.values()
    return client


def test_a_schedule_is_a_trajectory_of_positions_that_begins_at_once(
    output: TrajectoryOutput, client: Any, ends: list[TrajectoryEnd]
) -> None:
    given = start()
    output.start(given)
    ((goal, answer),) = client.sent
    message, schedule = goal.trajectory, given.schedule
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 0)
    assert tuple(message.joint_names) == tuple(schedule.joint_names)
    assert [list(each.positions) for each in message.points] == schedule.positions.tolist()
    times = [each.time_from_start.nanosec for each in message.points]
    assert times == [round(k * TICK * 1e9) for k in range(4)]
    assert all(not each.velocities for each in message.points)
    handle = Handle()
    answer.give(handle)
    handle.end(GoalStatus.STATUS_SUCCEEDED)
    assert ends == [TrajectoryEnd()]
    assert client.name == "arm/follow"


def test_answers_of_the_server_end_the_schedule(
    output: TrajectoryOutput, client: Any, ends: list[TrajectoryEnd]
) -> None:
    for status, words, final in (
        (GoalStatus.STATUS_ABORTED, "PATH_TOLERANCE_VIOLATED: off", False),
        (GoalStatus.STATUS_CANCELED, "another client", True),
        (GoalStatus.STATUS_UNKNOWN, "PATH_TOLERANCE_VIOLATED", False),
    ):
        output.start(start())
        handle = Handle()
        client.sent[-1][1].give(handle)
        handle.end(status, -4, "off")
        assert words in ends[-1].message
        assert ends[-1].final is final
    output.start(start())
    client.sent[-1][1].give(Handle(accepted=False))
    assert ends[-1] == TrajectoryEnd(
        "the action '/ns/arm/follow' has rejected the trajectory", True
    )
    client.ready = False
    output.start(start())
    assert ends[-1].message == "no server of the action '/ns/arm/follow' is there"
    assert len(ends) == 5


def test_a_schedule_is_cancelled_now_or_when_it_is_accepted(
    output: TrajectoryOutput, client: Any
) -> None:
    connection = output._server
    handles = [Handle(), Handle()]
    connection.send(1, start())
    connection.cancel(1)
    client.sent[0][1].give(handles[0])
    assert handles[0].cancels == 1
    connection.send(2, start())
    client.sent[1][1].give(handles[1])
    assert handles[1].cancels == 0
    connection.cancel(2)
    assert handles[1].cancels == 1


def test_the_clients_of_a_node_are_there_until_it_is_destroyed(
    clients: TrajectoryClients, output: TrajectoryOutput, client: Any, ends: list[TrajectoryEnd]
) -> None:
    output.start(start())
    later: list[TrajectoryEnd] = []
    again = clients.connect("arm/follow", later.append)
    assert list(clients._clients) == ["arm/follow"]
    handles = [Handle(), Handle()]
    again.start(start())
    for (_, answer), handle in zip(client.sent, handles, strict=True):
        answer.give(handle)
    handles[0].end(GoalStatus.STATUS_ABORTED, -4)  # An answer to the first output alone.
    assert later == []
    assert len(ends) == 1
    handles[1].end(GoalStatus.STATUS_SUCCEEDED)
    assert later == [TrajectoryEnd()]
    clients.connect("leg/follow", later.append)
    both = list(clients._clients.values())
    assert [each.name for each in both] == ["arm/follow", "leg/follow"]
    clients.destroy()
    assert all(each.destroyed for each in both)
    assert not clients._clients


@pytest.mark.usefixtures("stand_in")
def test_a_planner_sends_schedules_in_place_of_commands(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters = {"robot": "sliding_masses", "output": "trajectory", "trajectory_action": "a/b"}
    planner = harness.make(PlannerNode, parameters)
    clients = planner._trajectories
    (client,) = clients._clients.values()
    assert client.name == "a/b"
    first = planner.commander.trajectories
    assert planner.count_publishers("joint_commands") == 0
    assert planner.config.goal_links == ("end_effector",)
    lines: list[str] = []
    for node in (planner, harness.make(PlannerNode, {"robot": "sliding_masses"}, name="other")):
        monkeypatch.setattr(node, "log", lambda level, line: lines.append(f"{level}: {line}"))
        node.trigger_deactivate()
    (told,) = [line for line in lines if line.startswith("info: ")]  # The other's.
    assert told == "info: 0 commands were published."
    planner.trigger_cleanup()
    # An executor may hold an answer for the client.
    assert not client.destroyed
    planner.trigger_configure()
    assert list(clients._clients.values()) == [client]
    assert planner.commander.trajectories is not first
    harness.remove(planner)
    assert client.destroyed


def test_without_the_package_of_the_action_the_planner_says_so(harness: Harness) -> None:
    if action_class("control_msgs", "FollowJointTrajectory") is not None:
        pytest.skip("control_msgs is installed")
    with pytest.raises(SpaceRobotError, match="needs the package control_msgs: install it"):
        harness.make(PlannerNode, {"robot": "sliding_masses", "output": "trajectory"})
