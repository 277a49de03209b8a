"""Stacks, which run the nodes of a scenario: base class, and stack in one process."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidNamespaceException
from rclpy.experimental import EventsExecutor
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.validate_namespace import validate_namespace

from spacerobot_ros.bag import free_name
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes import (
    NODE_TYPES,
    FlightNode,
    PlannerNode,
    PlantNode,
    RecorderNode,
)
from spacerobot_ros.nodes.common.direct_delivery import DirectDelivery
from spacerobot_ros.nodes.common.streams import MatchedEndpoints, topics_without_all_matches
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import POSE
from spacerobot_ros.planning.execution.status import PlannerStatistics
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.session.mission_client import MissionClient
from spacerobot_ros.topics import GLOBAL_TOPICS, TOPICS_NOT_RECORDED

_DISCOVERY_TIMEOUT = 10.0


def namespace_arguments(namespace: str) -> list[str]:
    """Return the ROS arguments that put a node, its clock and its frames into a namespace."""
    if not namespace:
        return []
    moved = [word for topic in GLOBAL_TOPICS for word in ("-r", f"{topic}:={topic[1:]}")]
    return ["-r", f"__ns:={namespace}", *moved]


def checked_namespace(name: str) -> str:
    """Return a namespace as ROS writes it, with a slash before it; empty for none.

    Raises
    ------
    ParameterError
        ROS takes no such name.
    """
    namespace = f"/{name.strip('/')}" if name.strip("/") else ""
    try:
        validate_namespace(namespace or "/")
    except InvalidNamespaceException as error:
        raise ParameterError(f"The namespace '{name}' is not valid in ROS: {error}.") from error
    return namespace


class Stack(ABC):
    """The running nodes of a scenario, and the client of their mission.

    Parameters
    ----------
    scenario
        The scenario to run.
    bag
        File to record into; None records nothing.
    namespace
        Of all nodes and topics, the clock and the frames among them; empty for none.

    Raises
    ------
    ParameterError
        A parameter or the namespace is refused, or the scenario kills nodes and this stack cannot.
    """

    can_kill: ClassVar[bool] = False
    """Whether nodes may be killed and started again in flight."""

    client: MissionClient
    executor: EventsExecutor

    def __init__(self, scenario: Scenario, bag: Path | None, namespace: str = "") -> None:
        self.namespace = checked_namespace(namespace)
        if scenario.kills and (not self.can_kill or scenario.lockstep):
            raise ParameterError(
                f"The scenario '{scenario.name}' kills nodes on the way: fly it with --processes "
                "and --realtime."
            )
        goal = scenario.goal
        if goal.end_effectors and goal.base not in (frozenset(), POSE):
            raise ParameterError(
                "Goals of end-effectors are sent with the whole pose of the base or with none: "
                "give --goal, or leave the attitude of the base out."
            )
        self.scenario = scenario
        self.when_exists = scenario.parameters("recorder").get("when_exists", "refuse")
        """Reaction to an existing bag of this name; by default it is refused."""
        self.bag = free_name(bag) if bag is not None and self.when_exists == "next" else bag
        recorder = () if bag is None else ("recorder",)
        self.names = ("plant", *scenario.commanders, *recorder)
        """Names of the nodes, in the order of their start."""
        for name in self.names:
            scenario.config(name)  # Invalid parameters are refused before any node runs.

    def _make_client(self, joint_names: Callable[[], Sequence[str]] | None, **options: Any) -> None:
        """Make the client of the mission; ``options`` are those of :class:`MissionClient`."""
        # A planner decides goals; without one the controller does.
        decider = self.scenario.commanders[0]
        self.client = MissionClient(
            decider,
            self.scenario.config(decider).world_frame,
            lambda: self.time_ns,
            joint_names=joint_names,
            end_effectors=self.scenario.end_effectors,
            paths=self.scenario.goal.links_with_paths,
            namespace=self.namespace,
            **options,
        )

    @property
    @abstractmethod
    def time_ns(self) -> int:
        """Simulated time, ns."""

    @property
    @abstractmethod
    def statistics(self) -> PlannerStatistics:
        """Plans and commands of the planner, once the flight is finished."""

    @abstractmethod
    def start(self, goal: Goal | None) -> None:
        """Send the goal, if given, and start simulated time."""

    def parameters(self, name: str) -> dict[str, Any]:
        """Return the parameters of a node of the scenario."""
        values: dict[str, Any] = self.scenario.parameters(name)
        if name == "planner" and self.scenario.lockstep:
            values["plan_in_background"] = False  # Known before the plant says so.
        return values

    def spin(self, look: Callable[[], bool]) -> None:
        """Run until the goal is decided, or until ``look``, called five times a second, is true.

        Raises
        ------
        SpaceRobotError
            A node has ended by itself, or a commander with a goal has failed; the bag is complete.
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

    def interrupt(self) -> None:  # noqa: B027
        """Cancel long computations; called when the process must end."""

    def _supervise(self) -> None:  # noqa: B027
        """Check the nodes; called five times a second."""

    @abstractmethod
    def finish(self) -> None:
        """Stop time, record messages still on their way, and complete the bag.

        Raises
        ------
        SpaceRobotError
            A node did not end well, or the bag could not be completed.
        """

    @abstractmethod
    def close(self) -> None:
        """End all nodes that still run; a second call does nothing."""

    def _all_connected(
        self, nodes: Mapping[str, MatchedEndpoints], recorded: Iterable[str]
    ) -> bool:
        """Whether nodes and client are connected, and all topics to record are in ``recorded``."""
        client = MatchedEndpoints.of(self.client.node)
        if topics_without_all_matches([*nodes.values(), client]):
            return False
        if self.bag is None:
            return True
        senders = [client, *(node for name, node in nodes.items() if name != "recorder")]
        published = {topic for sender in senders for topic, _ in sender.publishers}
        chosen = self.scenario.config("recorder").topics.split()
        if chosen:
            published &= {self.client.node.resolve_topic_name(topic) for topic in chosen}
        else:
            published = {topic for topic in published if not topic.endswith(TOPICS_NOT_RECORDED)}
        return published <= set(recorded)


class InProcessStack(Stack):
    """A stack in one executor, in which runs are repeatable to the last message.

    Everything is connected before anything is published: nodes are configured, their endpoints
    matched, the recorder and the commanders activated, the goal sent, and the plant activated last.

    Parameters
    ----------
    scenario, bag, namespace
        As of every stack.
    context
        rclpy context to live in; None is the default one.
    direct
        Whether states and commands are handed over directly in lockstep
        (:class:`~spacerobot_ros.nodes.common.direct_delivery.DirectDelivery`).

    Raises
    ------
    SpaceRobotError
        A parameter or the robot is refused.
    """

    def __init__(
        self,
        scenario: Scenario,
        bag: Path | None,
        namespace: str = "",
        *,
        context: rclpy.Context | None = None,
        direct: bool = True,
    ) -> None:
        super().__init__(scenario, bag, namespace)
        self.executor = EventsExecutor(context=context) if context else EventsExecutor()
        self._nodes: list[Node] = []
        try:
            nodes = {name: self._make(name, context) for name in self.names}
            self.plant: PlantNode = nodes["plant"]
            self._commanders: list[FlightNode] = [nodes[name] for name in scenario.commanders]
            self._planner: PlannerNode | None = nodes.get("planner")
            self._recorder: RecorderNode | None = nodes.get("recorder")
            for node in self._commanders:
                # Warnings of nodes are in their status, which is shown anyway.
                node.get_logger().set_level(LoggingSeverity.ERROR)
            shaped = scenario.goal.joint_positions is not None
            self._make_client(
                (lambda: self.plant.plant.robot.joint_names) if shaped else None,
                # In lockstep the run ends in this callback, so that it ends at the same tick every
                # time.
                on_end=self.plant.trigger_deactivate if scenario.lockstep else lambda: None,
                context=context,
            )
            self._nodes.append(self.client.node)
            running = {name: node for name, node in nodes.items() if name != "recorder"}
            for node in running.values():
                node.require_transition(node.trigger_configure)
            if self._recorder is not None:
                # The recorder comes last, when every topic has its publisher.
                self._recorder.watch(running.values())
                self._recorder.require_transition(self._recorder.trigger_configure)
                for title, values in scenario.records(list(running)).items():
                    self._recorder.describe(title, values)
            for node in self._nodes:
                self.executor.add_node(node)
            self._connect()
            self.delivery = DirectDelivery(self.executor, self._nodes, self.client.node)
            if direct and scenario.lockstep:
                self.delivery.begin()
        except BaseException:
            self.close()
            raise

    @property
    def time_ns(self) -> int:
        """Simulated time, ns."""
        return self.plant.time_ns

    @property
    def statistics(self) -> PlannerStatistics:
        """Plans and commands of the planner so far."""
        return PlannerStatistics() if self._planner is None else self._planner.statistics

    def start(self, goal: Goal | None) -> None:
        """Activate everything and send the goal, if any; the plant's first state is planned from.

        It happens at the next spin, inside a callback: only messages that are published from
        callbacks are delivered in the order of publication.

        Raises
        ------
        GoalError
            The shape of the goal is of another robot.
        """
        if goal is not None:
            self.scenario.require_shape_of(self.plant.plant.robot)

        def launch() -> None:
            self.client.node.destroy_timer(timer)
            if self._recorder is not None:
                self._recorder.trigger_activate()
            for node in reversed(self._commanders):
                node.trigger_activate()
            if goal is not None:
                self.client.send(goal, self.scenario.end_effector_goal)
            self.plant.trigger_activate()

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.client.node.create_timer(0.001, launch, clock=steady)

    def _supervise(self) -> None:
        """Detect a failed commander, even if it lacked the memory to publish an event."""
        for node in self._commanders:
            if node.fault is not None:
                raise node.fault

    def interrupt(self) -> None:
        """Cancel the plan that is being made."""
        if self._planner is not None:
            self._planner.interrupt()

    def finish(self) -> None:
        """Stop the plant, record messages still on their way, and complete the bag."""
        if self.plant.is_active:
            if self.client.outcome is Outcome.INTERRUPTED:
                self.plant.drain(self.executor)
            self.plant.trigger_deactivate()
        for node in self._commanders:
            if node.is_active:
                node.trigger_deactivate()
        if self._recorder is None:
            return
        # In one process all published messages have arrived already.
        self._recorder.drain(self.executor, quiet=0.1)
        self._recorder.trigger_deactivate()
        self._recorder.trigger_cleanup()
        if self._recorder.failure or self._recorder.fault:
            raise self._recorder.failure or self._recorder.fault  # type: ignore[misc]

    def close(self) -> None:
        """Destroy the nodes."""
        for node in self._nodes:
            # A logger outlives its node: the next one of its name in this process is not quiet.
            node.get_logger().set_level(LoggingSeverity.UNSET)
            if isinstance(node, RecorderNode):
                node.cleanup()
            node.destroy_node()
        self._nodes.clear()
        self.executor.shutdown()

    def _make(self, name: str, context: rclpy.Context | None) -> FlightNode:
        overrides = self.parameters(name)
        if name == "recorder":
            overrides |= {"bag": str(self.bag), "when_exists": self.when_exists}
        try:
            node = NODE_TYPES[name](
                name,
                autostart=False,
                context=context,
                use_global_arguments=False,
                cli_args=["--ros-args", *namespace_arguments(self.namespace)],
                parameter_overrides=[
                    Parameter(key, value=list(value) if isinstance(value, tuple) else value)
                    for key, value in overrides.items()
                ],
            )
        except SpaceRobotError as error:
            raise ParameterError(f"Node '{name}': {error}") from error
        node.events_have_wall_time = not self.scenario.lockstep
        self._nodes.append(node)
        return node

    def _connect(self) -> None:
        """Wait until every subscription in this process is matched with its publisher."""
        deadline = time.monotonic() + _DISCOVERY_TIMEOUT
        while not self._connected():
            if time.monotonic() > deadline:
                raise SpaceRobotError(
                    f"The nodes did not find each other within {_DISCOVERY_TIMEOUT:g} s; "
                    "is the loopback interface up, and ROS_DOMAIN_ID between 0 and 101?"
                )
            self.executor.spin_once(timeout_sec=0.01)
            if self._recorder is not None:
                self._recorder.scan()
        if self.client.node.count_publishers("odom") > 1:
            raise SpaceRobotError(
                "Another plant already publishes 'odom' in this ROS domain; "
                "set ROS_DOMAIN_ID to a number of its own for this run."
            )

    def _connected(self) -> bool:
        nodes = {
            node.get_name(): MatchedEndpoints.of(node)
            for node in self._nodes
            if node is not self.client.node
        }
        return self._all_connected(nodes, self._recorder.topics if self._recorder else ())
