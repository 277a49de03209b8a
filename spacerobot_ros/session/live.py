"""Robots that run until they are told to stop, and goals sent to them from outside."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.node import spin_until
from spacerobot_ros.planning import Goal
from spacerobot_ros.session.mission_client import Operator
from spacerobot_ros.session.processes import ProcessStack
from spacerobot_ros.session.run import ros, stop_on_signals
from spacerobot_ros.session.scenario import Scenario
from spacerobot_ros.session.stack import FlightStack

_DISCOVERY = 10.0
"""Wall s to wait for somebody who takes goals."""

_LATCHED = 1.0
"""Wall s to wait for what was said of earlier goals, so that it is not taken for an answer."""

_LOOK_PERIOD = 0.1


def keep_up(
    scenario: Scenario, bag: Path | None, show: Callable[[str], None], *, processes: bool
) -> None:
    """Run the nodes of a scenario in real time until SIGINT or SIGTERM; goals come by topic.

    Raises
    ------
    SpaceRobotError
        A node cannot start, or has ended by itself.
    """
    with ros(private=False), stop_on_signals() as stopped:
        make = ProcessStack if processes else FlightStack
        stack = make(scenario, bag)
        try:
            stack.start(None)
            show(f"{scenario.name} is up; goals on 'goal_pose', Ctrl-C ends it.")
            said = ""

            def look() -> bool:
                nonlocal said
                if stack.operator.sentence != said:
                    said = stack.operator.sentence
                    show(said)
                return stopped()

            stack.spin(look)
            stack.finish()
        finally:
            stack.close()


def send_goal(
    goal: Goal, show: Callable[[str], None], *, namespace: str, timeout: float
) -> tuple[str, str]:
    """Send one goal pose and follow the status until it is decided.

    Returns the last state (``reached``, ``failed``, ``refused``, ``aborted``, ``interrupted``) and
    its sentence. ``timeout`` is wall time in s, 0: for ever.

    Raises
    ------
    SpaceRobotError
        Nobody takes goals.
    """
    with ros(private=False), stop_on_signals() as stopped:
        executor = EventsExecutor()
        operators = {
            decider: Operator(decider, "", namespace=namespace, name=f"goal_{decider}")
            for decider in ("planner", "coordinated_control")
        }
        try:
            for each in operators.values():
                executor.add_node(each.node)
            operator = _whoever_decides(operators, executor)
            operator.send(goal)
            began, said = time.monotonic(), ""

            def look() -> None:
                nonlocal said
                if operator.sentence != said:
                    said = operator.sentence
                    show(said)
                late = timeout > 0 and time.monotonic() - began > timeout
                if (stopped() or late) and not operator.done.done():
                    operator.done.set_result("interrupted")

            steady = Clock(clock_type=ClockType.STEADY_TIME)
            operator.node.create_timer(_LOOK_PERIOD, look, clock=steady)
            spin_until(executor, operator.done)
            if operator.sentence != said:
                show(operator.sentence)
            return str(operator.done.result()), operator.sentence
        finally:
            for each in operators.values():
                each.node.destroy_node()
            executor.shutdown()


def _whoever_decides(operators: dict[str, Operator], executor: EventsExecutor) -> Operator:
    """Return the operator that listens to the planner, or to the controller if there is none."""
    deadline = time.monotonic() + _DISCOVERY
    while time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.05)
        for operator in operators.values():
            if operator.heard() and operator.answers():
                patience = time.monotonic() + _LATCHED
                while not operator.status and time.monotonic() < patience:
                    executor.spin_once(timeout_sec=0.05)
                return operator
    raise SpaceRobotError(
        f"Nobody has taken goals on 'goal_pose' for {_DISCOVERY:g} s: start a planner or a "
        "controller, `spacerobot up SCENARIO`, in the same ROS domain and namespace."
    )
