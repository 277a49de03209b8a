"""Stacks that run until they are stopped, and goals sent to them from outside."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from rclpy.experimental import EventsExecutor
from rosgraph_msgs.msg import Clock

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.scenario import Scenario
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning import Goal
from spacerobot_ros.session.mission_client import MissionClient
from spacerobot_ros.session.run import make_stack, ros
from spacerobot_ros.termination import ended_on_request
from spacerobot_ros.times import stamp_to_ns

_DISCOVERY = 10.0
"""Wall s to wait for a commander that takes goals."""

_LATCHED = 1.0
"""Wall s to wait for the status of earlier goals, so that it does not pass for an answer."""

_LOOK_PERIOD = 0.1


class _Sentences:
    """Shows the sentences of the status that a client receives, each once."""

    def __init__(self, client: MissionClient, show: Callable[[str], None]) -> None:
        self._client, self._show, self._shown = client, show, ""

    def show(self) -> None:
        """Show the sentence of the last status if it is new."""
        if self._client.sentence != self._shown:
            self._shown = self._client.sentence
            with suppress(OSError):  # A closed terminal is no reason to drop the robot.
                self._show(self._shown)


def keep_up(
    scenario: Scenario,
    bag: Path | None,
    show: Callable[[str], None],
    *,
    processes: bool,
    namespace: str = "",
) -> Path | None:
    """Run the nodes of a scenario in real time until SIGINT, SIGTERM or SIGHUP; goals by topic.

    Returns the bag, whose name is another one where that was taken and ``when_exists`` is next.

    Raises
    ------
    SpaceRobotError
        A node cannot start, or has ended by itself.
    """
    with ros(private=False):
        stack = make_stack(scenario, bag, processes=processes, namespace=namespace)
        try:
            with ended_on_request(at_once=stack.interrupt) as stopped:
                stack.start(None)
                with suppress(OSError):
                    topic = f"{stack.namespace}/goal_pose" if stack.namespace else "goal_pose"
                    show(f"{scenario.name} is up; goals on '{topic}', Ctrl-C ends it.")
                sentences = _Sentences(stack.client, show)

                def look() -> bool:
                    sentences.show()
                    return stopped()

                stack.spin(look)
                stack.finish()
                return stack.bag
        finally:
            stack.close()


def send_goal(
    goal: Goal, show: Callable[[str], None], *, namespace: str, timeout: float
) -> Outcome:
    """Send one goal pose, show what becomes of it, and return how it ended.

    ``timeout`` is wall time in s, 0: for ever. A commander is looked for no longer than that, and
    for ten seconds at most.

    Raises
    ------
    SpaceRobotError
        No commander takes goals.
    """
    with ros(private=False):
        executor = EventsExecutor()
        clocks = {"own": 0, "global": 0}

        def on_clock(message: Clock, which: str) -> None:
            clocks[which] = stamp_to_ns(message.clock)

        clients = [
            MissionClient(
                decider,
                "",
                lambda: clocks["own"] or clocks["global"] or time.time_ns(),
                namespace=namespace,
                name=f"goal_{decider}",
                # Joint positions that were sent for an earlier goal are not those of this one.
                joint_names=tuple if decider == "planner" else None,
            )
            for decider in ("planner", "coordinated_control")
        ]
        # In a namespace the clock is that of its stack, where a remap has moved it there.
        node = clients[0].node
        for topic, which in {"/clock": "global", node.resolve_topic_name("clock"): "own"}.items():
            node.create_subscription(Clock, topic, partial(on_clock, which=which), 10)
        try:
            for each in clients:
                executor.add_node(each.node)
            client = _with_decider(clients, executor, min(timeout or _DISCOVERY, _DISCOVERY))
            with ended_on_request() as stopped:
                client.send(goal)
                began, sentences = time.monotonic(), _Sentences(client, show)

                def look() -> bool:
                    sentences.show()
                    late = timeout > 0 and time.monotonic() - began > timeout
                    return stopped() or late

                outcome = client.follow(executor, look, _LOOK_PERIOD)
                sentences.show()
                return outcome
        finally:
            for each in clients:
                each.node.destroy_node()
            executor.shutdown()


def _with_decider(
    clients: list[MissionClient], executor: EventsExecutor, patience: float
) -> MissionClient:
    """Return the client that listens to the planner, or to the controller if there is none."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.05)
        for client in clients:
            if client.is_connected() and client.has_decider():
                latest = time.monotonic() + _LATCHED
                while client.status is None and time.monotonic() < latest:
                    executor.spin_once(timeout_sec=0.05)
                # Its other readers may have been found in the meantime.
                while not client.is_connected() and time.monotonic() < deadline:
                    executor.spin_once(timeout_sec=0.05)
                return client
    raise SpaceRobotError(
        f"No commander takes goals on 'goal_pose' after {patience:g} s: start a planner or a "
        "controller, `spacerobot up SCENARIO`, in the same ROS domain and namespace."
    )
