"""Nodes from this package and custom nodes in one executor, for pytest tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy.typing as npt
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes import NODE_TYPES, FlightNode, RecorderNode
from spacerobot_ros.nodes.common.node import endpoints_of, topics_without_all_matches
from spacerobot_ros.nodes.common.process import free_domain, use_loopback_discovery
from spacerobot_ros.planning import Goal
from spacerobot_ros.resources import suggestion
from spacerobot_ros.scenario import COMMANDERS, NO_GOAL, scenario_or_robot
from spacerobot_ros.scenario_files import changed_goal
from spacerobot_ros.session.mission_client import MissionClient

__all__ = ["Arrival", "Stack"]


class Arrival(NamedTuple):
    """The result of a goal: its outcome, and the commander's message."""

    outcome: Outcome
    message: str

    @property
    def reached(self) -> bool:
        """Whether the goal was reached within tolerance."""
        return self.outcome is Outcome.REACHED


class Stack:
    """Context manager for nodes in one executor, in lockstep, in a separate ROS domain.

    The plant starts at the first goal, or with :meth:`start`, once all nodes are connected.
    Simulated time advances while the nodes spin.

    Parameters
    ----------
    robot
        Robot or scenario (a name or a file) that configures the nodes.
    nodes
        Names of this package's nodes, and functions or classes that take an rclpy context and
        return a custom node. By default, the plant and the commanders of the scenario.
    parameters
        Further parameters by node: ``{"planner": {"method": "lie_bracket"}}``.
    timeout
        Maximum wall time to wait, s.

    Attributes
    ----------
    nodes
        The nodes by name. ``executor``, ``context`` and ``domain`` are shared by all nodes.
    """

    def __init__(
        self,
        robot: str,
        nodes: Sequence[str | Callable[[rclpy.Context], Node]] | None = None,
        parameters: Mapping[str, Mapping[str, Any]] = {},
        timeout: float = 60.0,
    ) -> None:
        scenario = scenario_or_robot(robot).with_overrides("plant", {"time_mode": "lockstep"})
        # Until the plant reports its time mode, a commander would let time run during a first plan.
        for name in COMMANDERS:
            scenario = scenario.with_overrides(name, {"plan_in_background": False})
        nodes = ("plant", *scenario.commanders) if nodes is None else nodes
        for name, values in parameters.items():
            if name not in nodes:
                raise SpaceRobotError(
                    f"'parameters' names node '{name}', which is not in 'nodes'."
                    f"{suggestion(name, [each for each in nodes if isinstance(each, str)])}"
                )
            scenario = scenario.with_overrides(name, values)
        self._world, self._timeout, self._sent = scenario.plant.world_frame, timeout, 0
        self.nodes: dict[str, Node] = {}
        with ExitStack() as closing:
            self.domain = closing.enter_context(free_domain())
            use_loopback_discovery()
            self.context = rclpy.Context()
            rclpy.init(args=[], context=self.context, domain_id=self.domain)
            closing.callback(rclpy.try_shutdown, context=self.context)
            self.executor = EventsExecutor(context=self.context)
            closing.callback(self.executor.shutdown)
            for each in nodes:
                if not isinstance(each, str):
                    node = self._own(each)
                elif each in NODE_TYPES:
                    given = scenario.parameters(each).items()
                    overrides = [Parameter(key, value=value) for key, value in given]
                    options = {"parameter_overrides": overrides, "context": self.context}
                    node = NODE_TYPES[each](each, autostart=False, **options)
                else:
                    raise SpaceRobotError(
                        f"This package has no node '{each}'.{suggestion(each, NODE_TYPES)} "
                        f"Its nodes are {', '.join(NODE_TYPES)}."
                    )
                closing.callback(node.destroy_node)
                if node.get_name() in self.nodes:
                    raise SpaceRobotError(
                        f"Two of the nodes are named '{node.get_name()}': rename one of them."
                    )
                self.nodes[node.get_name()] = node
                self.executor.add_node(node)
            for node in self._flight_nodes:
                node.require_transition(node.trigger_configure)
            recorder = self.nodes.get("recorder")
            self._recorder = recorder if isinstance(recorder, RecorderNode) else None
            if self._recorder is not None:
                named = [each for each in nodes if isinstance(each, str)]
                for title, values in scenario.records(named).items():
                    if title != "scenario":  # Its goal is not the one to be flown.
                        self._recorder.describe(title, values)
            closing.callback(self._finalize)
            self.close = closing.pop_all().close

    def _own(self, make: Callable[[rclpy.Context], Node]) -> Node:
        node = make(self.context)
        name = getattr(make, "__name__", repr(make))
        if not isinstance(node, Node):
            raise SpaceRobotError(f"'{name}' returned {node!r}: let it return its rclpy node.")
        if node.context is not self.context:
            node.destroy_node()
            raise SpaceRobotError(
                f"The node that '{name}' returned is in another rclpy context: create it with "
                "the context that the function is given."
            )
        return node

    def _finalize(self) -> None:
        """Shut this package's nodes down, the recorder last, which completes its bag."""
        for node in sorted(self._flight_nodes, key=lambda node: node.get_name() == "recorder"):
            node.drain(self.executor)
            node.finalize()

    def __enter__(self) -> Stack:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def start(self) -> None:
        """Activate the nodes without a goal, for nodes of your own that send goals."""
        self._connect(self.nodes.values())
        for node in self._inactive:
            node.require_transition(node.trigger_activate)

    def fly_to(
        self,
        goal: Goal | npt.ArrayLike | None = None,
        *,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        rotvec: npt.ArrayLike | None = None,
    ) -> Arrival:
        """Send a goal and spin until the planner or, without a planner, the controller completes
        it.

        ``goal`` is a goal as for :func:`.fly`. ``x``, ``y``, ``z`` (m, each 0 by default) and
        ``rotvec`` (rad) override its position and attitude. If neither position nor attitude is
        given, the position is 0; otherwise, anything is accepted for the other. Raises
        :class:`.SpaceRobotError` if a node fails or the time limit expires.
        """
        moved = not x is y is z is None
        place = [x or 0.0, y or 0.0, z or 0.0] if moved or goal is rotvec is None else None
        goal = changed_goal(NO_GOAL, goal, place, rotvec)
        controls = "coordinated_control" in self.nodes and "planner" not in self.nodes
        self._sent += 1
        client = MissionClient(
            "coordinated_control" if controls else "planner",
            self._world,
            lambda: getattr(self.nodes.get("plant"), "time_ns", 0) + self._sent,
            goal,
            name=f"mission_client_{self._sent}",
            context=self.context,
        )
        self.executor.add_node(client.node)

        def launch() -> None:
            """Activate nodes that are not active, and send the goal, once."""
            for node in self._inactive:
                if node.get_name() == "plant":
                    # Topics have no common order: the plant starts once the goal is known.
                    if client.goal_id is None:
                        client.send(goal)
                    if client.decider in self.nodes and not client.message:
                        return
                node.require_transition(node.trigger_activate)
            if client.goal_id is None:
                client.send(goal)
            timer.cancel()

        try:
            self._connect([*self.nodes.values(), client.node])
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            timer = client.node.create_timer(1e-3, launch, clock=clock)
            self.spin_until(
                lambda: client.outcome is not None,
                lambda: (
                    "The goal has no outcome: "
                    f"{client.message or 'No planner or controller has reported on it.'} "
                ),
            )
            return Arrival(client.outcome or Outcome.INTERRUPTED, client.message)
        finally:
            self.executor.remove_node(client.node)
            client.node.destroy_node()

    def spin_until(
        self, condition: Callable[[], bool], pending: Callable[[], str] = lambda: ""
    ) -> None:
        """Spin until a condition is true; raises SpaceRobotError on failure or timeout.

        ``pending`` returns the first sentence of the error after a timeout.
        """
        end = time.monotonic() + self._timeout
        while not condition():
            for node in self._flight_nodes:
                if node.fault is not None:
                    raise node.fault
            if time.monotonic() > end:
                raise SpaceRobotError(
                    f"{pending()}This took more than {self._timeout:g} s of wall time."
                )
            self.executor.spin_once(timeout_sec=0.05)

    def _connect(self, nodes: Collection[Node]) -> None:
        def apart() -> str:
            if self._recorder is not None:
                self._recorder.scan()
            ends = [end for node in nodes for end in endpoints_of(node)]
            return ", ".join(sorted(topics_without_all_matches(ends)))

        self.spin_until(
            lambda: not apart(),
            lambda: f"Publishers and subscriptions differ in their quality of service: {apart()}. ",
        )

    @property
    def _inactive(self) -> list[FlightNode]:
        """The nodes of this package that are not active, the plant last."""
        inactive = [node for node in self._flight_nodes if not node.is_active]
        return sorted(inactive, key=lambda node: node.get_name() == "plant")

    @property
    def _flight_nodes(self) -> list[FlightNode]:
        return [node for node in self.nodes.values() if isinstance(node, FlightNode)]
