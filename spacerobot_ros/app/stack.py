"""Plant, planner and recorder in one process and one executor."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from spacerobot_ros.app.scenario import NODES, Scenario
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.nodes import (
    CoordinatedControlNode,
    FlightNode,
    PlannerNode,
    PlantNode,
    RecorderNode,
)
from spacerobot_ros.nodes.flight_node import LATCHED, STREAM, spin_until
from spacerobot_ros.nodes.recorder import parameters_of
from spacerobot_ros.planning import Goal

_CLASSES: dict[str, type[FlightNode]] = {
    "plant": PlantNode,
    "planner": PlannerNode,
    "coordinated_control": CoordinatedControlNode,
    "recorder": RecorderNode,
}
_DISCOVERY_TIMEOUT = 10.0
_LOOK_PERIOD = 0.2
_STATUS = {"planner": "planner/status", "coordinated_control": "controller/status"}
_ENDED = ("reached", "failed", "refused", "aborted")


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
        self.scenario = scenario
        self.executor = EventsExecutor(context=context) if context else EventsExecutor()
        self.done = rclpy.task.Future(executor=None)
        self.status: dict[str, str] = {}
        self.sentence = ""
        self.gait: dict[str, str] = {}
        """What the planner said of its first schedule for the present goal."""
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
            self.operator = rclpy.create_node("operator", context=context)
            self._nodes.append(self.operator)
            self._goal_topic = self.operator.create_publisher(PoseStamped, "goal_pose", STREAM)
            if scenario.goal.joint_positions is not None:
                self._shape_topic = self.operator.create_publisher(
                    JointState, "goal_joint_states", STREAM
                )
            if scenario.end_effector_goal is not None:
                self._end_effector_topic = self.operator.create_publisher(
                    PoseStamped, "end_effector/goal_pose", STREAM
                )
            # Whoever plans decides; a controller alone decides for itself.
            decider = _STATUS[scenario.commanders[0]]
            self.operator.create_subscription(DiagnosticStatus, decider, self._on_status, LATCHED)
            for name in wanted:
                if name != "recorder":
                    nodes[name].require(nodes[name].trigger_configure)
            if self.recorder is not None:
                # Last, when every topic has its publisher.
                self.recorder.require(self.recorder.trigger_configure)
                self._describe(wanted, nodes)
            for node in self._nodes:
                self.executor.add_node(node)
            self._connect()
        except BaseException:
            self.close()
            raise

    def start(self, goal: Goal) -> None:
        """Activate everything and send the goal; the plant's first state is planned from.

        It happens at the next spin, inside a callback: what is published from a callback is
        delivered in the order of publication, what is published between spins is not.
        """

        def launch() -> None:
            self.operator.destroy_timer(timer)
            if self.recorder is not None:
                self.recorder.trigger_activate()
            for node in reversed(self.commanders):
                node.trigger_activate()
            self.send(goal, self.scenario.end_effector_goal)
            self.plant.trigger_activate()

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.operator.create_timer(0.001, launch, clock=steady)

    def send(self, goal: Goal, end_effector: Goal | None = None) -> None:
        """Publish goal poses of the base and, where there is one, of the end-effector."""
        if goal.joint_positions is not None:
            names = self.plant.plant.robot.joint_names
            self._shape_topic.publish(
                JointState(name=list(names), position=goal.joint_positions.tolist())
            )
        self._goal_topic.publish(self._pose(goal))
        if end_effector is not None:
            self._end_effector_topic.publish(self._pose(end_effector))

    def _pose(self, goal: Goal) -> PoseStamped:
        message = PoseStamped()
        message.header.frame_id = str(self.commanders[0].parameters["world_frame"])
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = goal.position.tolist()
        o.x, o.y, o.z, o.w = goal.quaternion.tolist()
        return message

    def spin(self, look: Callable[[], bool]) -> None:
        """Run until the goal is decided, or until ``look``, called five times a second, is true.

        A busy events executor does not heed the time limit of a spin: the look is a timer's.
        """

        def on_look() -> None:
            if look() and not self.done.done():
                self.plant.trigger_deactivate()
                self.done.set_result("stopped")

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.operator.create_timer(_LOOK_PERIOD, on_look, clock=steady)
        spin_until(self.executor, self.done)
        self.operator.destroy_timer(timer)

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
        quiet = 0
        while quiet < 20:
            before = self.recorder.messages_recorded
            self.executor.spin_once(timeout_sec=0.001)
            quiet = quiet + 1 if self.recorder.messages_recorded == before else 0
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
        known = {spec.name for spec in _CLASSES[name].SPECS}
        unknown = [key for key in overrides if key not in known]
        if unknown:
            raise ParameterError(f"Node '{name}' has no parameter '{unknown[0]}'.")
        arguments = ["--ros-args", "--params-file", str(self.scenario.path)]
        try:
            node = _CLASSES[name](
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
        goal = self.scenario.goal
        self.recorder.describe(
            "scenario",
            {
                "name": self.scenario.name,
                "description": self.scenario.description,
                "goal_position": " ".join(repr(x) for x in goal.position.tolist()),
                "goal_orientation": " ".join(repr(x) for x in goal.quaternion.tolist()),
                **self._end_effector_record(),
                "published": json.dumps([asdict(row) for row in self.scenario.published]),
            },
        )
        for name in names:
            if name != "recorder":
                self.recorder.describe(f"parameters/{name}", parameters_of(nodes[name]))

    def _end_effector_record(self) -> dict[str, str]:
        goal = self.scenario.end_effector_goal
        if goal is None:
            return {}
        return {
            "end_effector_goal_position": " ".join(repr(x) for x in goal.position.tolist()),
            "end_effector_goal_orientation": " ".join(repr(x) for x in goal.quaternion.tolist()),
        }

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
        if self.operator.count_publishers("odom") > 1:
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

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = {pair.key: pair.value for pair in message.values}
        self.sentence = message.message
        if self.status.get("state") == "executing" and not self.gait:
            self.gait = dict(self.status)
        if self.status.get("state") in _ENDED and not self.done.done():
            # Here and not when the spin returns: the run ends at the same tick every time.
            self.plant.trigger_deactivate()
            self.done.set_result(self.status["state"])
