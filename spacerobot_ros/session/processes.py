"""A stack with one process per node, as if users had started the nodes without ros2 launch."""

from __future__ import annotations

import json
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.client import Client
from rclpy.exceptions import InvalidNamespaceException
from rclpy.experimental import EventsExecutor
from rclpy.publisher import Publisher
from rclpy.validate_namespace import validate_namespace
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from spacerobot_ros.bag import free_name
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.measures import Outcome
from spacerobot_ros.messages.diagnostics import StatusRecord
from spacerobot_ros.model.shared_parameters import robot_of
from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.nodes.common.node import (
    STREAM,
    Endpoint,
    endpoints_of,
    topics_without_all_matches,
)
from spacerobot_ros.nodes.common.watchdog import HEARTBEAT_QOS, TOPIC, HeartbeatState, Role
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import POSE
from spacerobot_ros.planning.execution.status import PlannerStatistics
from spacerobot_ros.scenario import COMMANDERS, Kill, Scenario
from spacerobot_ros.session.child import NodeProcess, last_error
from spacerobot_ros.session.mission_client import MissionClient
from spacerobot_ros.termination import end_child
from spacerobot_ros.times import SECOND, stamp_to_ns
from spacerobot_ros.topics import TOPICS_NOT_RECORDED

_LONGEST_START = 60.0  # wall s

_LONGEST_END = 10.0
"""Wall time, s, after a signal at which a node that is still running is killed."""

_LONGEST_RECORDING_DELAY = 1.0
"""Wall time, s, in which the recorder receives the last messages from the plant."""

_LONGEST_ANSWER_AFTER_INTERRUPT = 0.5  # wall s
_CONNECTION_CHECK_PERIOD = 0.05  # wall s


def checked_namespace(name: str) -> str:
    """Return a namespace in ROS form, with a leading slash, or an empty string for no namespace.

    Raises
    ------
    ParameterError
        The name is not a valid ROS name.
    """
    namespace = f"/{name.strip('/')}" if name.strip("/") else ""
    try:
        validate_namespace(namespace or "/")
    except InvalidNamespaceException as error:
        raise ParameterError(f"The namespace '{name}' is not valid in ROS: {error}.") from error
    return namespace


class MultiProcessStack:
    """A scenario's node processes, and the mission client in this process.

    The node processes end with this process, even if it is killed. In lockstep, all runs are
    identical: the flight does not start until all nodes are connected, and the goal arrives before
    the first state.

    Parameters
    ----------
    scenario
        The scenario to run.
    bag
        File to record into; None records nothing.
    namespace
        Namespace of all nodes and topics, including the clock and the frames; empty: no namespace.
    restarts
        Maximum number of restarts per minute of a planner or controller that has died; the
        restarted node continues with its goal.
    show
        Function that shows the user a line about each restart.

    Raises
    ------
    ParameterError
        A parameter or the namespace is invalid, or the scenario kills nodes in lockstep.
    SpaceRobotError
        A node ended during startup (the message is the last error that it reported), or another
        stack is active in this ROS domain and namespace.
    """

    def __init__(
        self,
        scenario: Scenario,
        bag: Path | None,
        namespace: str = "",
        *,
        restarts: int = 0,
        show: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.namespace = checked_namespace(namespace)
        goal = scenario.goal
        if scenario.kills and scenario.lockstep:
            raise ParameterError(
                f"The scenario '{scenario.name}' kills nodes during the flight: fly it with "
                "--nodes and --realtime."
            )
        if goal.end_effectors and goal.base not in (frozenset(), POSE):
            raise ParameterError(
                "End-effector goals need the whole base pose or none: give --goal, or omit the "
                "base attitude."
            )
        self.scenario = scenario
        self.when_exists = scenario.parameters("recorder").get("when_exists", "refuse")
        """Reaction to an existing bag with this name; the default is an error."""
        self.bag = free_name(bag) if bag is not None and self.when_exists == "next" else bag
        recorder = () if bag is None else ("recorder",)
        self.names = ("plant", *scenario.commanders, *recorder)
        """Node names, in start order."""
        for name in self.names:
            scenario.config(name)  # Invalid parameters are refused before any node runs.
        self._restarts, self._show = restarts, show
        self._timeline = KillTimeline(scenario.kills)
        self.time_ns = 0
        """Last received simulated time, ns."""
        self._clock_seen = math.inf
        self._folder = tempfile.TemporaryDirectory(prefix="spacerobot_")
        self._processes: dict[str, NodeProcess] = {}
        names: Sequence[str] | None = None
        if goal.joint_positions is not None:
            robot = robot_of(scenario.plant)
            names = robot.joint_names if robot is not None else ()
            if robot is not None:
                scenario.require_shape_of(robot)
        # A planner decides about goals; without a planner, the controller does.
        decider = scenario.commanders[0]
        self.client = MissionClient(
            decider,
            scenario.config(decider).world_frame,
            lambda: self.time_ns,
            goal,
            scenario.end_effector_goal,
            joint_names=names,
            namespace=self.namespace,
        )
        node = self.client.node
        self._events: Publisher | None = None
        if restarts:
            self._events = node.create_publisher(DiagnosticStatus, "events", STREAM)
        node.create_subscription(Clock, f"{self.namespace}/clock", self._on_clock, 10)
        self._active_elsewhere = ""
        """Name of a node that was active before this stack was started."""
        self._heartbeats = node.create_subscription(
            DiagnosticStatus, TOPIC, self._on_heartbeat, HEARTBEAT_QOS
        )
        self._change_state = {
            name: node.create_client(ChangeState, f"{name}/change_state") for name in self.names
        }
        self._get_connections = {
            name: node.create_client(Trigger, f"{name}/connections") for name in self.names
        }
        self._get_statistics = node.create_client(Trigger, "planner/statistics")
        self.statistics = PlannerStatistics()
        """The planner's statistics, once the flight is finished."""
        self.executor = EventsExecutor()
        self.executor.add_node(node)
        try:
            for name in self.names:
                self.launch(name, autostart=False)
            # All nodes are configured at once, because building models takes long.
            self._change_states(Transition.TRANSITION_CONFIGURE, self.names)
            self._wait_for(self._connected, "the nodes to discover each other")
        except BaseException:
            self.close()
            raise

    def launch(self, name: str, **parameters: Any) -> None:
        """Start or restart one node of the scenario, with additional parameters."""
        overrides: dict[str, Any] = dict(self.scenario.parameters(name))
        if name in COMMANDERS and self.scenario.lockstep:
            overrides["plan_in_background"] = False  # Set before the plant reports lockstep.
        if name == "recorder":
            overrides |= {"bag": str(self.bag), "when_exists": self.when_exists}
            record = self._path("scenario.json")
            records = self.scenario.records([other for other in self.names if other != name])
            record.write_text(json.dumps(records), "utf-8")
            overrides["describe"] = str(record)
        elif (self.scenario.kills or self._restarts) and name in COMMANDERS:
            overrides.setdefault("resume_file", str(self._path(f"{name}_goal.json")))
        if name == self.scenario.commanders[0] and self.scenario.lockstep:
            overrides["stop_when_decided"] = True
        module, folder = NODE_TYPES[name].__module__, self._path()
        process = NodeProcess(name, module, folder, self.namespace, self._restarts)
        process = self._processes.setdefault(name, process)
        process.start({**overrides, **parameters})

    def _path(self, name: str = "") -> Path:
        return Path(self._folder.name, name)

    def start(self, goal: Goal | None, stopped: Callable[[], bool] = lambda: False) -> None:
        """Activate all nodes and send the goal, if any; the plant starts last. Return early if
        ``stopped`` returns true."""
        self.client.node.destroy_subscription(self._heartbeats)
        for name in reversed(self.names[1:]):
            if stopped():
                return
            self._change_states(Transition.TRANSITION_ACTIVATE, [name])
        if goal is not None and not stopped():
            self.client.send(goal, self.scenario.end_effector_goal)
            self.client.await_delivery()
        if not stopped():
            self._change_states(Transition.TRANSITION_ACTIVATE, ["plant"])

    def spin(self, look: Callable[[], bool]) -> None:
        """Run until the goal has ended, or until ``look``, called five times per second, returns
        true.

        Raises
        ------
        SpaceRobotError
            A node has ended unexpectedly, or a commander with a goal has failed; the bag is
            complete.
        """

        def on_look() -> bool:
            self._supervise()
            failures = self.client.failures
            for name in self.scenario.commanders if self.client.goal_id else ():
                if name in failures:
                    raise SpaceRobotError(failures[name])
            return look()

        try:
            self.client.follow(self.executor, on_look)
            if self.client.outcome is Outcome.ABORTED:
                on_look()  # A commander that fails aborts its goal.
        except SpaceRobotError:
            with suppress(SpaceRobotError):
                self.finish()
            raise

    def finish(self) -> None:
        """Stop simulated time, then end all nodes; the recorder ends last and completes the bag.

        An interrupted real-time flight ends with the joints at rest.

        Raises
        ------
        SpaceRobotError
            A node ended with an error.
        """
        interrupted = self.client.outcome is Outcome.INTERRUPTED
        present = [name for name in self.names if name not in self._timeline.away]
        if "plant" in present and not (interrupted and not self.scenario.lockstep):
            self._change_states(Transition.TRANSITION_DEACTIVATE, ["plant"])
        self._spin_for(0.0 if interrupted else _LONGEST_RECORDING_DELAY)
        if "planner" in present:
            services = {"planner": self._get_statistics}
            patience = _LONGEST_ANSWER_AFTER_INTERRUPT if interrupted else _LONGEST_START
            with suppress(_ServiceTimeoutError):  # The statistics of a busy planner stay unknown.
                answer = self._call_services(services, Trigger.Request(), patience)["planner"]
                self.statistics = PlannerStatistics.from_json(answer.message)
        processes = [self._processes[name] for name in present]
        for last in (False, True):
            group = [each for each in processes if (each.name == "recorder") is last]
            for each in group:
                each.child.send_signal(signal.SIGINT)
            for each in group:
                # SIGABRT makes a hanging node print a traceback.
                end_child(each.child, {0: _LONGEST_END, signal.SIGABRT: 1.0})
        for each in processes:
            if each.exit_code != 0:
                raise SpaceRobotError(each.end_message)

    def close(self) -> None:
        """End all node processes that are still running."""
        left = [each for each in self._processes.values() if each.exit_code is None]
        for process in left:
            process.child.send_signal(signal.SIGTERM)
        end = time.monotonic() + _LONGEST_ANSWER_AFTER_INTERRUPT
        for process in left:
            end_child(process.child, {0: max(0.0, end - time.monotonic())})
        self.executor.shutdown()
        self.client.node.destroy_node()
        self._folder.cleanup()

    def require_alive(self) -> None:
        """If a node has ended, raise an error with the reason.

        Raises
        ------
        SpaceRobotError
            A node has ended, or another stack was active before this one.
        """
        if self._active_elsewhere:
            domain = os.environ.get("ROS_DOMAIN_ID") or "0"
            raise SpaceRobotError(
                f"Node '{self._active_elsewhere}' already runs in ROS domain {domain}: end its "
                "stack, or set ROS_DOMAIN_ID to another number."
            )
        for name, process in self._processes.items():
            if process.exit_code is not None and name not in self._timeline.away:
                raise SpaceRobotError(f"{process.end_message}{process.restart_note}")

    def _supervise(self) -> None:
        """Kill and start the nodes that the scenario names for this time, and restart commanders
        that have died; the others must run."""
        # Without a plant there is no clock, so wall time advances the schedule.
        factor = self.scenario.plant.real_time_factor
        since = factor * (time.monotonic() - self._clock_seen)
        killed, started = self._timeline.due(self.time_ns / SECOND + since)
        for name in killed:
            end_child(self._processes[name].child, {})
        for name in started:
            again = {"resume_bag": str(self.bag or ""), "autostart": True}
            self.launch(name, **(again if name == "plant" else {}))
        for name in self.scenario.commanders:
            process = self._processes[name]
            if name in self._timeline.away or not process.may_restart():
                continue
            message = f"{process.end_message} It is restarted."
            self.launch(name, autostart=True)
            with suppress(OSError):  # A closed terminal must not stop the robot.
                self._show(message)
            if self._events is not None:
                at = self.time_ns / SECOND
                event = Event(EventKind.NODE_RESTARTED, message, 1, at, about={"node": name})
                values = event.to_values(time.time())
                record = StatusRecord(self.client.node.get_name(), event.level, message, values)
                self._events.publish(record.encoded())
        self.require_alive()

    def _on_heartbeat(self, message: DiagnosticStatus) -> None:
        # Nodes of this stack send heartbeats once they are active, not before. A user's viewers and
        # recorders only listen.
        acts = message.hardware_id in _ACTING_ROLES
        if acts and message.message != HeartbeatState.INACTIVE.value:
            self._active_elsewhere = message.name

    def _on_clock(self, message: Clock) -> None:
        self.time_ns = stamp_to_ns(message.clock)
        self._clock_seen = time.monotonic()

    def _connected(self) -> bool:
        """Ask every node for its connections; return whether all are matched and recorded."""
        answers = self._call_services(self._get_connections, Trigger.Request())
        nodes = {
            name: [Endpoint(*each) for each in json.loads(answer.message)]
            for name, answer in answers.items()
        }
        self._spin_for(_CONNECTION_CHECK_PERIOD)
        nodes["client"] = endpoints_of(self.client.node)
        if topics_without_all_matches([end for node in nodes.values() for end in node]):
            return False
        recorder = nodes.pop("recorder", None)
        if recorder is None:
            return True
        published = {end.topic for node in nodes.values() for end in node if end.publishes}
        chosen = self.scenario.config("recorder").topics.split()
        if chosen:
            published &= {self.client.node.resolve_topic_name(topic) for topic in chosen}
        else:
            published = {topic for topic in published if not topic.endswith(TOPICS_NOT_RECORDED)}
        return published <= {end.topic for end in recorder if not end.publishes}

    def _change_states(self, transition: int, names: Sequence[str]) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        services = {name: self._change_state[name] for name in names}
        answers = self._call_services(services, request)
        for name, answer in answers.items():
            if not answer.success:
                error = last_error(self._processes[name].log)
                raise SpaceRobotError(f"The {name} refuses: {error}")

    def _call_services(
        self, services: Mapping[str, Client], request: Any, patience: float = _LONGEST_START
    ) -> dict[str, Any]:
        """Send a request to each node as soon as it is discovered, and return the answers."""
        names = ", ".join(services)
        answers: dict[str, Any] = {}

        def sent() -> bool:
            for name, service in services.items():
                if name not in answers and service.service_is_ready():
                    answers[name] = service.call_async(request)
            return len(answers) == len(services)

        self._wait_for(sent, f"the {names}", patience)
        what = f"a response from the {names}"
        self._wait_for(lambda: all(each.done() for each in answers.values()), what, patience)
        return {name: answer.result() for name, answer in answers.items()}

    def _spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def _wait_for(
        self, condition: Callable[[], bool], what: str, patience: float = _LONGEST_START
    ) -> None:
        deadline = time.monotonic() + patience
        while not condition():
            self.require_alive()
            if time.monotonic() > deadline:
                raise _ServiceTimeoutError(f"Timed out after {patience:g} s waiting for {what}.")
            self.executor.spin_once(timeout_sec=0.02)


_ACTING_ROLES = (Role.PLANT.value, Role.COMMANDER.value, Role.REPLAY.value)
"""Roles of nodes that must not share a domain with those of another stack."""


class _ServiceTimeoutError(SpaceRobotError):
    """A node has not answered in time."""


class KillTimeline:
    """Schedule for killing and restarting nodes.

    Parameters
    ----------
    kills
        Ordered by time.
    """

    def __init__(self, kills: Sequence[Kill]) -> None:
        self._kills, self._time = kills, -math.inf

    def due(self, time: float) -> tuple[list[str], list[str]]:
        """Return the nodes to be killed and the nodes to be started by a simulated time, s."""
        # An estimated time may be corrected downwards.
        before, self._time = self._time, max(time, self._time)
        killed = [kill.node for kill in self._kills if before < kill.at <= self._time]
        return killed, [kill.node for kill in self._kills if before < kill.until <= self._time]

    @property
    def away(self) -> set[str]:
        """Names of the nodes that were killed and have not been restarted yet."""
        return {kill.node for kill in self._kills if kill.at <= self._time < kill.until}
