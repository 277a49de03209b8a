"""Flights with nodes, to the goal of a scenario or until stopped, and goals for running stacks."""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rclpy.experimental import EventsExecutor
from rclpy.logging import get_logger_effective_level, set_logger_level
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.reading import open_flight_bag, read_flown
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.process import start_ros, use_loopback_discovery
from spacerobot_ros.planning import Goal
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.session.mission_client import MissionClient
from spacerobot_ros.session.processes import MultiProcessStack, checked_namespace
from spacerobot_ros.termination import graceful_shutdown
from spacerobot_ros.times import SECOND, stamp_to_ns
from spacerobot_ros.topics import SERVICE_BY_REQUEST, Request


@contextmanager
def ros() -> Iterator[None]:
    """Initialise rclpy without signal handlers; by default, discover nodes on this machine only.

    Raises
    ------
    SpaceRobotError
        ROS does not start: an environment variable is invalid.
    """
    use_loopback_discovery()
    level = get_logger_effective_level("")
    try:
        start_ros(["--ros-args", "--log-level", "WARN"])
        yield
    finally:
        rclpy.try_shutdown()
        # The level is global: it would also apply to nodes created after the run.
        set_logger_level("", level)


def fly_by_nodes(
    scenario: Scenario, bag: Path, progress: Callable[[float, float], None], longest: float
) -> dict[str, Any]:
    """Fly a scenario with one process per node; return the result that ``--json`` writes.

    For the parameters, see :func:`~spacerobot_ros.session.run.run_scenario`. The flight is checked
    five times per second of wall time.

    Raises
    ------
    SpaceRobotError
        A parameter or the robot is invalid, or the bag cannot be recorded.
    """
    with ros(), closing(MultiProcessStack(scenario, bag)) as stack, graceful_shutdown() as stopped:
        stack.start(scenario.goal, stopped)
        began = time.perf_counter()

        def look() -> bool:
            progress(stack.time_ns / SECOND, stack.client.ends_at)
            return stopped() or stack.time_ns / SECOND >= longest

        stack.spin(look)
        wall_time = time.perf_counter() - began
        stack.finish()
        client, opened = stack.client, open_flight_bag(stack.bag or bag)
        flight = read_flown(opened, scenario)
        outcome, message = client.outcome or Outcome.INTERRUPTED, client.message
        if outcome is Outcome.INTERRUPTED:
            message = f"Interrupted after {flight.duration:.6g} s of simulated time."
        flight = replace(
            flight,
            outcome=outcome,
            message=message,
            status=client.status,
            gait=client.gait,
            plan_time=stack.statistics.plan_time_s,
            wall_time=wall_time,
        )
        recorded = {"messages_recorded": opened.message_count, "bag": str(opened.path)}
        return {**flight.summary(), **recorded}


_LONGEST_DISCOVERY = 10.0  # wall s

_LONGEST_SILENCE = 1.0
"""Wall time, s, without a commander after which the user is told what is awaited."""

_LONGEST_STATUS_WAIT = 1.0
"""Wall time, s, to wait for the status of earlier goals before a new goal is sent."""

_LONGEST_RECORDER_WAIT = 1.0
"""Wall time, s, to wait until recorders have subscribed to the goal topics."""

_LONGEST_VERDICT = 2.0
"""Wall time, s, in which the verdict on a goal arrives after its commander has none."""

_CHECK_PERIOD = 0.1

_NUMBER = re.compile(r"(< )?\d[\d.]* [mµ]?(m|rad)( or [mµ]?rad)?\b")
"""A continually changing quantity in a status message."""


class _StatusPrinter:
    """Prints a status message if it differs from the previous one in more than its quantities."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show, self._shown = show, ""

    def __call__(self, message: str) -> None:
        told = _NUMBER.sub("", message)
        if told and told != self._shown:
            self._shown = told
            with suppress(OSError):  # A closed terminal must not stop the robot.
                self._show(message)


def run_until_stopped(
    scenario: Scenario,
    bag: Path | None,
    show: Callable[[str], None],
    *,
    namespace: str = "",
    restarts: int = 0,
    supervise: Callable[[], None] = lambda: None,
) -> Path | None:
    """Run a scenario's nodes in real time until SIGINT, SIGTERM or SIGHUP; goals arrive on topics.

    If the planner or the controller dies, it is restarted, at most ``restarts`` times per minute.
    ``supervise`` is called five times per second.

    Returns the bag path, with a new name if the name was in use and ``when_exists`` is ``next``.

    Raises
    ------
    SpaceRobotError
        A node cannot start, or has ended unexpectedly.
    """
    with (
        ros(),
        closing(MultiProcessStack(scenario, bag, namespace, restarts=restarts, show=show)) as stack,
        graceful_shutdown() as stopped,
    ):
        stack.start(None)
        with suppress(OSError):
            topic = f"{stack.namespace}/goal_pose" if stack.namespace else "goal_pose"
            show(f"{scenario.name} is up. Send goals on '{topic}'; Ctrl-C ends it.")
        stack.client.on_message = _StatusPrinter(show)
        stack.client.on_message(stack.client.message)

        def look() -> bool:
            supervise()
            return stopped()

        stack.spin(look)
        stack.finish()
        return stack.bag


def send_goal(
    goal: Goal, show: Callable[[str], None], *, namespace: str, timeout: float
) -> Outcome:
    """Send one goal pose, show its statuses, and return its outcome.

    ``timeout`` is a wall time in s, also for the search for a commander; 0 means no limit, and ten
    seconds for the search.

    Raises
    ------
    SpaceRobotError
        No commander accepts goals, the commander was started again or has ended, or the namespace
        is not a valid ROS namespace.
    """
    namespace = checked_namespace(namespace)
    with ros():
        executor = EventsExecutor()
        clocks = {"own": 0, "global": 0}
        # Goals with the same stamp would be one goal, and other senders have read the same clock.
        offset = secrets.randbelow(SECOND // 1000)

        def on_clock(message: Clock, which: str) -> None:
            clocks[which] = stamp_to_ns(message.clock)

        clients = [
            MissionClient(
                decider,
                "",
                lambda: (clocks["own"] or clocks["global"] or time.time_ns()) + offset,
                goal,
                namespace=namespace,
                name=f"goal_{decider}",
                # An empty message resets the joint positions that an earlier goal required.
                joint_names=() if decider == "planner" else None,
            )
            for decider in ("planner", "coordinated_control")
        ]
        # In a namespace, the stack may have its own clock, through a remapping.
        node = clients[0].node
        for topic, which in {"/clock": "global", node.resolve_topic_name("clock"): "own"}.items():
            node.create_subscription(Clock, topic, partial(on_clock, which=which), 10)
        try:
            for each in clients:
                executor.add_node(each.node)
            client = _find_goal_commander(clients, executor, timeout or _LONGEST_DISCOVERY, show)
            with graceful_shutdown() as stopped:
                client.on_message = _StatusPrinter(show)
                client.send(goal)
                began = kept = time.monotonic()

                def look() -> bool:
                    nonlocal kept
                    now, lost = time.monotonic(), client.lost
                    kept = kept if lost else now
                    if now - kept > _LONGEST_VERDICT:
                        raise SpaceRobotError(lost)
                    return stopped() or 0 < timeout < now - began

                return client.follow(executor, look, _CHECK_PERIOD)
        finally:
            for each in clients:
                each.node.destroy_node()
            executor.shutdown()


def send_request(request: Request, show: Callable[[str], None], *, namespace: str) -> bool:
    """Call the services of a request, show the responses, and return whether all succeeded.

    Raises
    ------
    SpaceRobotError
        No node offers the service or responds, or the namespace is not a valid ROS namespace.
    """
    namespace = checked_namespace(namespace)
    keys, service, value = SERVICE_BY_REQUEST[request]
    kind = Trigger if value is None else SetBool
    call = Trigger.Request() if value is None else SetBool.Request(data=value)
    nodes = ["coordinated_control" if key == "controller" else key for key in keys]
    offered = " or ".join(f"'{node}/{service}'" for node in nodes)
    with ros():
        client = rclpy.create_node("request", namespace=namespace)
        executor = EventsExecutor()
        executor.add_node(client)
        try:
            services = [client.create_client(kind, f"{node}/{service}") for node in nodes]
            deadline = time.monotonic() + _LONGEST_DISCOVERY
            while not all(each.service_is_ready() for each in services):
                executor.spin_once(timeout_sec=0.05)
                if any(each.service_is_ready() for each in services):
                    # A second node, if any, is discovered at about the same time.
                    deadline = min(deadline, time.monotonic() + _LONGEST_STATUS_WAIT)
                if time.monotonic() > deadline:
                    break
            ready = [each for each in services if each.service_is_ready()]
            if not ready:
                raise SpaceRobotError(
                    f"No node offered {offered} within {_LONGEST_DISCOVERY:g} s: start a stack, "
                    "`spacerobot up SCENARIO`, in the same ROS domain and namespace."
                )
            succeeded = True
            for future in [each.call_async(call) for each in ready]:
                executor.spin_until_future_complete(future, timeout_sec=_LONGEST_DISCOVERY)
                if not future.done():
                    raise SpaceRobotError(
                        f"No response from {offered} within {_LONGEST_DISCOVERY:g} s."
                    )
                show(future.result().message)
                succeeded = succeeded and future.result().success
            return succeeded
        finally:
            client.destroy_node()
            executor.shutdown()


def _find_goal_commander(
    clients: list[MissionClient],
    executor: EventsExecutor,
    patience: float,
    show: Callable[[str], None],
) -> MissionClient:
    """Return the client that listens to the planner, or to the controller if there is none."""
    aims, resolved = clients[0].goal_topics, clients[0].node.resolve_topic_name
    topics = " and ".join(f"'{resolved(topic)}'" for topic in aims)
    began = time.monotonic()
    deadline, silent = began + patience, True
    while (now := time.monotonic()) < deadline:
        executor.spin_once(timeout_sec=0.05)
        if silent and now > began + _LONGEST_SILENCE:
            silent = False
            show(f"Waiting for a planner or a controller on {topics}, up to {patience:g} s.")
        for client in clients:
            if not (client.is_connected() and client.has_goal_commander()):
                if client.knows_commander():
                    break  # A planner is being connected; its controller follows references.
                continue
            latest = time.monotonic() + _LONGEST_STATUS_WAIT
            while client.status is None and time.monotonic() < latest:
                executor.spin_once(timeout_sec=0.05)
            # Other subscribers may have been discovered in the meantime.
            while not client.is_connected() and time.monotonic() < deadline:
                executor.spin_once(timeout_sec=0.05)
            latest = time.monotonic() + _LONGEST_RECORDER_WAIT
            while client.has_late_recorder() and time.monotonic() < latest:
                executor.spin_once(timeout_sec=0.05)
            _await_active(client, executor, deadline)
            return client
    listed = "; other links are named in the planner's parameter end_effectors or the controller's "
    listed = f"{listed}end_effector_frame" if aims[1:] else ""
    raise SpaceRobotError(
        f"No commander accepted goals on {topics} within {patience:g} s: start a planner or a "
        f"controller, `spacerobot up SCENARIO`, in the same ROS domain and namespace{listed}."
    )


def _await_active(client: MissionClient, executor: EventsExecutor, deadline: float) -> None:
    """Wait until a commander that is a managed node is active; before that, it rejects goals."""
    service = client.node.create_client(GetState, f"{client.decider}/get_state")
    while time.monotonic() < deadline and service.service_is_ready():
        answer = service.call_async(GetState.Request())
        executor.spin_until_future_complete(answer, timeout_sec=_LONGEST_STATUS_WAIT)
        state = answer.result()
        if state is not None and state.current_state.id == State.PRIMARY_STATE_ACTIVE:
            return
        time.sleep(_CHECK_PERIOD)
