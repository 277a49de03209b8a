"""Plant, planner and recorder in one process and one executor."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.nodes import (
    NODE_TYPES,
    CoordinatedControlNode,
    FlightNode,
    PlannerNode,
    PlantNode,
    RecorderNode,
)
from spacerobot_ros.nodes.common.node import spin_until
from spacerobot_ros.nodes.recorder import parameters_of
from spacerobot_ros.parameters import declared
from spacerobot_ros.planning import Goal
from spacerobot_ros.session.description import scenario_record
from spacerobot_ros.session.kills import NEEDS_PROCESSES
from spacerobot_ros.session.mission_client import Operator
from spacerobot_ros.session.scenario import NODES, Scenario

_DISCOVERY_TIMEOUT = 10.0
_LOOK_PERIOD = 0.2


class FlightStack:
    """The nodes of a scenario, composed so that a run is repeatable to the last message.

    Everything is connected before anything is published: nodes are configured, their endpoints
    matched, the recorder and the planner activated, the goal sent, and the plant activated last.

    Parameters
    ----------
    scenario
        What to compose.
    bag
        File to record into; None records nothing.
    context
        rclpy context to live in; None is the default one.

    Raises
    ------
    SpaceRobotError
        A parameter or the robot is refused.
    """

    def __init__(
        self, scenario: Scenario, bag: Path | None, context: rclpy.Context | None = None
    ) -> None:
        if scenario.kills:
            raise ParameterError(NEEDS_PROCESSES.format(scenario.name))
        self.scenario = scenario
        self.executor = EventsExecutor(context=context) if context else EventsExecutor()
        self._nodes: list[Node] = []
        overrides = {name: dict(scenario.overrides.get(name, {})) for name in NODES}
        overrides["plant"].setdefault("time_mode", "lockstep")
        if bag is not None:
            overrides["recorder"]["bag"] = str(bag)
        wanted = ["plant", *scenario.commanders, *(["recorder"] if bag is not None else [])]
        try:
            nodes = {name: self._make(name, overrides[name], context) for name in wanted}
            self.plant: PlantNode = nodes["plant"]
            self.commanders: list[FlightNode] = [nodes[name] for name in scenario.commanders]
            self.planner: PlannerNode | None = nodes.get("planner")
            self.controller: CoordinatedControlNode | None = nodes.get("coordinated_control")
            self.recorder: RecorderNode | None = nodes.get("recorder")
            for node in self.commanders:
                # Their warnings are their status, which whoever runs the stack is told anyway.
                node.get_logger().set_level(LoggingSeverity.ERROR)
            shaped = scenario.goal.joint_positions is not None
            self.operator = Operator(
                # Whoever plans decides; a controller alone decides for itself.
                scenario.commanders[0],
                str(self.commanders[0].parameters["world_frame"]),
                joint_names=(lambda: self.plant.plant.robot.joint_names) if shaped else None,
                end_effector=scenario.end_effector_goal is not None,
                on_end=self.plant.trigger_deactivate,
                context=context,
            )
            self._nodes.append(self.operator.node)
            for name in wanted:
                if name != "recorder":
                    nodes[name].require(nodes[name].trigger_configure)
            if self.recorder is not None:
                # Last, when every topic has its publisher.
                self.recorder.watch(node for name, node in nodes.items() if name != "recorder")
                self.recorder.require(self.recorder.trigger_configure)
                self._describe(wanted, nodes)
            for node in self._nodes:
                self.executor.add_node(node)
            self._connect()
        except BaseException:
            self.close()
            raise

    @property
    def time_ns(self) -> int:
        """Simulated time, ns."""
        return self.plant.time_ns

    @property
    def plan_time(self) -> float:
        """Wall time that planning took, s."""
        return self.planner.statistics.plan_time_s if self.planner is not None else 0.0

    def start(self, goal: Goal | None) -> None:
        """Activate everything and send the goal, if any; the plant's first state is planned from.

        It happens at the next spin, inside a callback: what is published from a callback is
        delivered in the order of publication, what is published between spins is not.
        """

        def launch() -> None:
            self.operator.node.destroy_timer(timer)
            if self.recorder is not None:
                self.recorder.trigger_activate()
            for node in reversed(self.commanders):
                node.trigger_activate()
            if goal is not None:
                self.operator.send(goal, self.scenario.end_effector_goal)
            self.plant.trigger_activate()

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.operator.node.create_timer(0.001, launch, clock=steady)

    def spin(self, look: Callable[[], bool]) -> None:
        """Run until the goal is decided, or until ``look``, called five times a second, is true.

        A busy events executor does not heed the time limit of a spin: the look is a timer's.
        """

        def on_look() -> None:
            if look() and not self.operator.done.done():
                self.plant.trigger_deactivate()
                self.operator.done.set_result("stopped")

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.operator.node.create_timer(_LOOK_PERIOD, on_look, clock=steady)
        spin_until(self.executor, self.operator.done)
        self.operator.node.destroy_timer(timer)

    def finish(self) -> None:
        """Stop the plant, record what is still on its way, and complete the bag.

        Raises
        ------
        SpaceRobotError
            The bag could not be completed.
        """
        if self.plant.is_active:
            self.plant.trigger_deactivate()
        for node in self.commanders:
            node.trigger_deactivate()
        if self.recorder is None:
            return
        # In one process what is published is there.
        self.recorder.drain(self.executor, quiet=0.02)
        self.recorder.trigger_deactivate()
        self.recorder.trigger_cleanup()
        if self.recorder.failure or self.recorder.fault:
            raise self.recorder.failure or self.recorder.fault  # type: ignore[misc]

    def close(self) -> None:
        """Destroy the nodes; safe to call twice and after a failed construction."""
        for node in self._nodes:
            if isinstance(node, RecorderNode):
                node.cleanup()
            node.destroy_node()
        self._nodes.clear()
        self.executor.shutdown()

    # -- composition --------------------------------------------------------------------------

    def _make(
        self, name: str, overrides: Mapping[str, Any], context: rclpy.Context | None
    ) -> FlightNode:
        try:
            parameters = [Parameter(key, value=value) for key, value in overrides.items()]
        except (TypeError, ValueError) as error:
            raise ParameterError(f"A parameter of node '{name}' is refused: {error}.") from error
        known = {spec.name for spec in declared(NODE_TYPES[name].Config)}
        unknown = [key for key in overrides if key not in known]
        if unknown:
            raise ParameterError(f"Node '{name}' has no parameter '{unknown[0]}'.")
        arguments = ["--ros-args", "--params-file", str(self.scenario.path)]
        try:
            node = NODE_TYPES[name](
                name,
                autostart=False,
                context=context,
                cli_args=arguments,
                use_global_arguments=False,
                parameter_overrides=parameters,
            )
        except SpaceRobotError as error:
            raise ParameterError(f"Node '{name}': {error}") from error
        self._nodes.append(node)
        return node

    def _describe(self, names: list[str], nodes: Mapping[str, FlightNode]) -> None:
        assert self.recorder is not None
        self.recorder.describe("scenario", scenario_record(self.scenario))
        for name in names:
            if name != "recorder":
                self.recorder.describe(f"parameters/{name}", parameters_of(nodes[name]))

    def _connect(self) -> None:
        """Wait until every subscription in this process has met its publisher."""
        deadline = time.monotonic() + _DISCOVERY_TIMEOUT
        while not self._connected():
            if time.monotonic() > deadline:
                raise SpaceRobotError(
                    f"The nodes did not find each other within {_DISCOVERY_TIMEOUT:g} s; "
                    "is the loopback interface up, and ROS_DOMAIN_ID between 0 and 101?"
                )
            self.executor.spin_once(timeout_sec=0.01)
            if self.recorder is not None:
                self.recorder.scan()
        if self.operator.node.count_publishers("odom") > 1:
            raise SpaceRobotError(
                "Another plant already publishes 'odom' in this ROS domain; "
                "set ROS_DOMAIN_ID to a number of its own for this run."
            )

    def _connected(self) -> bool:
        ours = [p for node in self._nodes for p in node.publishers if node is not self.recorder]
        topics = {p.topic_name for p in ours} - {"/rosout", "/parameter_events"}
        if self.recorder is not None and not topics <= self.recorder.topics:
            return False
        wanted: dict[str, int] = {}
        for node in self._nodes:
            for subscription in node.subscriptions:
                wanted[subscription.topic_name] = wanted.get(subscription.topic_name, 0) + 1
        return all(
            publisher.get_subscription_count() >= wanted.get(publisher.topic_name, 0)
            for publisher in ours
            if publisher.topic_name in topics
        )
