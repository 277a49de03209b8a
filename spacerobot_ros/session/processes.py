"""The stack with each node in a process of its own: as users run them, without ros2 launch."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import yaml
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.client import Client
from rclpy.experimental import EventsExecutor
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.robot_source import robot_of
from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.nodes.common.cdr import NANOSECONDS
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerStatistics
from spacerobot_ros.session.mission_client import MissionClient
from spacerobot_ros.session.scenario import COMMANDERS, Kill, Scenario
from spacerobot_ros.session.stack import Stack

_START = 60.0
"""Wall s within which every node must be there."""

_END = 10.0
"""Wall s that a node has to end after a signal before it is killed."""

_WITHOUT_SHARED_MEMORY = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
"""Fast DDS may go on writing into what a killed node has left behind, and not to its successor."""

_COMMANDS = ("joint_commands", "base_wrench", "joint_reference")
"""What commanders publish for every state: nothing of it may be missed."""

_SETTLING = 1.0
"""Wall s for the recorder to take in what was published before time stood still."""


class MultiProcessStack(Stack):
    """The processes of a scenario, and in this one the client of their mission.

    Parameters
    ----------
    scenario, bag
        As of every stack.
    plant_waits
        Whether the plant begins only with :meth:`start`, when all nodes are connected.

    Raises
    ------
    SpaceRobotError
        A node ended at its start; the sentence is the last that it wrote.
    """

    can_kill: ClassVar[bool] = True

    def __init__(self, scenario: Scenario, bag: Path | None, *, plant_waits: bool = True) -> None:
        super().__init__(scenario, bag)
        self._timeline = KillTimeline(scenario.kills)
        self._time_ns = 0
        self._clock_seen = math.inf
        self._folder = tempfile.TemporaryDirectory(prefix="spacerobot_")
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        names: Sequence[str] | None = None
        if scenario.goal.joint_positions is not None:
            robot = robot_of(scenario.plant)
            names = robot.joint_names if robot is not None else ()
            if robot is not None:
                scenario.require_shape_of(robot)
        self.client = MissionClient(
            scenario.commanders[0],
            scenario.config(scenario.commanders[0]).world_frame,
            lambda: self._time_ns,
            joint_names=None if names is None else lambda: names,
            end_effector=scenario.end_effector_goal is not None,
        )
        node = self.client.node
        node.create_subscription(Clock, "/clock", self._on_clock, 10)
        self._change_state = node.create_client(ChangeState, "plant/change_state")
        self._get_statistics = node.create_client(Trigger, "planner/statistics")
        self._statistics = PlannerStatistics()
        self.executor = EventsExecutor()
        self.executor.add_node(node)
        try:
            for name in self.names:
                self.launch(name, autostart=name != "plant" or not plant_waits)
            if plant_waits:
                self._transit(Transition.TRANSITION_CONFIGURE)
            self._wait_for(self._connected, "the nodes to find each other")
        except BaseException:
            self.close()
            raise

    def launch(self, name: str, **parameters: Any) -> None:
        """Start one node of the scenario, for the first time or again, with more parameters."""
        overrides: dict[str, Any] = self.scenario.checked_overrides(name)
        if name == "recorder":
            overrides["bag"] = str(self.bag)
            record = Path(self._folder.name, "scenario.json")
            records = self.scenario.records([other for other in self.names if other != name])
            record.write_text(json.dumps(records), "utf-8")
            overrides["describe"] = str(record)
        elif self.scenario.kills and name in COMMANDERS:
            overrides.setdefault("resume_file", str(Path(self._folder.name, f"{name}_goal.json")))
        overrides |= parameters
        overrides = {k: list(v) if isinstance(v, tuple) else v for k, v in overrides.items()}
        file = Path(self._folder.name, f"{name}.yaml")
        file.write_text(yaml.safe_dump({name: {"ros__parameters": overrides}}), "utf-8")
        with self._log_of(name).open("wb") as log:
            self.processes[name] = subprocess.Popen(
                [
                    *(sys.executable, "-W", "ignore::RuntimeWarning:runpy"),
                    *("-m", NODE_TYPES[name].__module__, "--ros-args", "-r", f"__node:={name}"),
                    *("--params-file", str(self.scenario.path), "--params-file", str(file)),
                ],
                env={**_WITHOUT_SHARED_MEMORY, **os.environ},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def _log_of(self, name: str) -> Path:
        """Return the file of what a node writes to its standard output and error."""
        return Path(self._folder.name, f"{name}.txt")

    def _last_line(self, name: str) -> str:
        # A crash ends with pages of loaded modules.
        text = self._log_of(name).read_text("utf-8", errors="replace").strip()
        lines = [line for line in text.splitlines() if not line.startswith("Extension mod")]
        return lines[-1] if lines else "it wrote nothing."

    @property
    def time_ns(self) -> int:
        """Simulated time that was last received, ns."""
        return self._time_ns

    @property
    def statistics(self) -> PlannerStatistics:
        """What the planner has done, once the flight is finished."""
        return self._statistics

    def start(self, goal: Goal | None) -> None:
        """Send the goal, if there is one, and let time run."""
        if goal is not None:
            self.client.send(goal, self.scenario.end_effector_goal)
        self._transit(Transition.TRANSITION_ACTIVATE)

    def finish(self) -> None:
        """Stop time, then end every node, the recorder, whose bag is completed, last.

        Raises
        ------
        SpaceRobotError
            A node did not end well.
        """
        if "plant" not in self._timeline.away:
            self._transit(Transition.TRANSITION_DEACTIVATE)
        end = time.monotonic() + _SETTLING
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
        if "planner" in self.names and "planner" not in self._timeline.away:
            answer = self._call(self._get_statistics, Trigger.Request(), "planner")
            self._statistics = PlannerStatistics.from_json(answer.message)
        for name in self.names:
            if name in self._timeline.away:
                continue
            code = self._end(name)
            if code != 0:
                raise SpaceRobotError(
                    f"Node '{name}' ended with code {code}: {self._last_line(name)}"
                )

    def close(self) -> None:
        """End what still runs."""
        for process in self.processes.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        self.executor.shutdown()
        self.client.node.destroy_node()
        self._folder.cleanup()

    def require_alive(self) -> None:
        """Raise the last line of a node that has ended.

        Raises
        ------
        SpaceRobotError
            There is one.
        """
        for name, process in self.processes.items():
            if process.poll() is not None and name not in self._timeline.away:
                raise SpaceRobotError(
                    f"Node '{name}' has ended (code {process.returncode}): {self._last_line(name)}"
                )

    def kill(self, name: str) -> None:
        """Have a node end as it would by a crash."""
        os.killpg(self.processes[name].pid, signal.SIGKILL)
        self.processes[name].wait()

    def _supervise(self) -> None:
        """Kill and start the nodes that the scenario names for this time; the others must run."""
        # A killed plant has no clock: the wall's goes on for it.
        factor = self.scenario.plant.real_time_factor
        since = factor * (time.monotonic() - self._clock_seen)
        killed, started = self._timeline.due(self._time_ns / NANOSECONDS + since)
        for name in killed:
            self.kill(name)
        for name in started:
            again = {"resume_bag": str(self.bag or ""), "autostart": True}
            self.launch(name, **(again if name == "plant" else {}))
        self.require_alive()

    def _end(self, name: str) -> int:
        process = self.processes[name]
        process.send_signal(signal.SIGINT)
        try:
            return process.wait(_END)
        except subprocess.TimeoutExpired:
            # The traceback that it then writes shows where it hangs.
            process.send_signal(signal.SIGABRT)
        try:
            return process.wait(1.0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return process.wait()

    def _on_clock(self, message: Clock) -> None:
        self._time_ns = message.clock.sec * NANOSECONDS + message.clock.nanosec
        self._clock_seen = time.monotonic()

    def _connected(self) -> bool:
        """Whether commanders and recorder receive plant and client, and the plant commands."""
        node = self.client.node
        listeners = 2 if self.bag is not None else 1
        return (
            self.client.is_connected(listeners)
            and node.count_subscribers("odom") >= len(self.names) - 1
            and all(
                node.count_subscribers(topic) >= listeners
                for topic in _COMMANDS
                if node.count_publishers(topic)
            )
        )

    def _transit(self, transition: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        if not self._call(self._change_state, request, "plant").success:
            raise SpaceRobotError(f"The plant refuses: {self._last_line('plant')}")

    def _call(self, service: Client, request: Any, name: str) -> Any:
        """Return what a node answers to a request."""
        self._wait_for(service.service_is_ready, f"the {name}")
        answer = service.call_async(request)
        self._wait_for(answer.done, f"the {name}'s answer")
        return answer.result()

    def _wait_for(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + _START
        while not condition():
            self.require_alive()
            if time.monotonic() > deadline:
                raise SpaceRobotError(f"Waited {_START:g} s for {what} in vain.")
            self.executor.spin_once(timeout_sec=0.05)


class KillTimeline:
    """Which node is to end and to start, as time goes on.

    Parameters
    ----------
    kills
        By time.
    """

    def __init__(self, kills: Sequence[Kill]) -> None:
        self._waiting = list(kills)
        self._away: list[Kill] = []

    def due(self, time: float) -> tuple[list[str], list[str]]:
        """Return the nodes to kill and those to start, by the simulated time in s."""
        killed = [kill for kill in self._waiting if kill.at <= time]
        started = [kill for kill in self._away if kill.until <= time]
        self._waiting = [kill for kill in self._waiting if kill.at > time]
        self._away = [kill for kill in self._away if kill.until > time] + killed
        return [kill.node for kill in killed], [kill.node for kill in started]

    @property
    def away(self) -> set[str]:
        """The nodes that were killed and are not started yet."""
        return {kill.node for kill in self._away}
