"""The viewer node: converts topics to the page's state, and user actions to topics and services."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, ClassVar

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import Log as RosoutLog
from rcl_interfaces.msg import ParameterEvent
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, String
from std_srvs.srv import SetBool, Trigger

from spacerobot_ros.errors import SpaceRobotError, printable
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.messages.builders import goal_message
from spacerobot_ros.messages.diagnostics import read_status
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, RobotDescription
from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.model.urdf import obstacles_from_topic, parse_robot
from spacerobot_ros.nodes.common.messages import LatchedSubscription, shape_message
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, FlightNode
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.nodes.common.ros_parameters import RemoteParameters
from spacerobot_ros.nodes.viewer.listener import Listener
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, GoalIds
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.simulation.faults import FaultTargets
from spacerobot_ros.simulation.status import PlantState
from spacerobot_ros.times import LATEST_NS, SECOND
from spacerobot_ros.topics import SERVICE_BY_REQUEST, Request, link_topic
from spacerobot_ros.viewer import content
from spacerobot_ros.viewer.page import Page
from spacerobot_ros.viewer.reachability import (
    GoalCheck,
    GoalChecker,
    GoalQuestion,
    Verdict,
    goal_tolerance,
    make_question,
    planned_links,
)
from spacerobot_ros.viewer.server import (
    ViewerConfig,
    is_loopback,
    require_viser,
    start_server,
    stop_server,
    url_of,
)
from spacerobot_ros.viewer.state import (
    Action,
    FlyAction,
    InjectAction,
    Notice,
    Part,
    SeekAction,
    StackState,
)

ANNOUNCEMENT = "viewer      "
"""Text before the page address on standard output."""

_LEAST_SHOWN_LOG_LEVEL = 30

_PARTS_WITH_RECEIVED_GOALS = (BASE_GOAL_KEY, DEFAULT_END_EFFECTOR)

_NODES_WITH_PARAMETERS = ("plant", "planner", "controller")

_LONGEST_MATCHING_WAIT = 4.0  # wall s
_LONGEST_GOAL_ANSWER_WAIT = 5.0  # wall s
_RESTART_NOTICE_TIME = 60.0  # wall s
_MICROSECOND_NS = 1000
_MILLISECOND_NS = 1_000_000


class ViewerNode(FlightNode):
    """Serves the page that shows and steers the robot.

    The node subscribes and publishes like any other tool: it works with nodes in other processes,
    whether they start before or after it, and with restarted nodes. Opening the page does not move
    the robot.
    """

    Config: ClassVar = ViewerConfig
    config: ViewerConfig

    def __init__(self, name: str = "viewer", **kwargs: Any) -> None:
        self._server: Any = None
        self._streams: Node | None = None
        self._checker = GoalChecker()
        super().__init__(name, **kwargs)

    # -- life cycle -----------------------------------------------------------------------------

    def configure(self) -> None:
        """Start the page and subscribe."""
        config = self.config
        require_viser()
        self._server = start_server(config.host, config.port, config.title)
        self.url = url_of(self._server)
        if not is_loopback(config.host):
            self.get_logger().warning(
                f"The page is served at '{config.host}': anyone who can reach this address "
                "can steer the robot."
            )
        self._page = Page(self._server, config)
        self._robot: RobotDescription | None = None
        self._urdf = ""
        self._full_names: dict[str, str] = {}
        self._clients_by_name: dict[tuple[str, type[Any]], Client] = {}
        self._remote_values: dict[str, dict[str, str]] = {}
        self._requests: dict[str, RemoteParameters] = {}
        self._requests_to_repeat: set[str] = set()
        self._planner_state: PlannerState | None = None
        self._sent = 0
        self._goals_to_send: tuple[Mapping[Part, Goal], float] | None = None
        self._unanswered_goal: tuple[str, float] | None = None
        # This node is not spun: its messages wait until the page is drawn.
        self._streams = rclpy.create_node(
            f"_{self.get_name()}_streams",
            namespace=self.get_namespace(),
            context=self.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._listener = Listener(
            self._streams, self, config.world_frame, self._on_status, config.watchdog_timeout
        )
        self._descriptions = LatchedSubscription(
            self, String, "robot_description", self._on_description
        )
        for topic in ("target/robot_description", "obstacles"):
            self.create_subscription(String, topic, partial(self._on_urdf, topic), LATCHED)
        self.create_subscription(DiagnosticStatus, "events", self._on_event, STREAM)
        self.create_subscription(RosoutLog, "/rosout", self._on_log, STREAM)
        self.create_subscription(
            ParameterEvent, "/parameter_events", self._on_parameter_change, STREAM
        )
        self._goal_topics: dict[Part, Publisher] = {}
        self._add_goal_topics(_PARTS_WITH_RECEIVED_GOALS)
        self._shape_topic = self.create_publisher(JointState, "goal_joint_states", STREAM)
        self._fault_topic = self.create_publisher(String, "fault_injection", STREAM)
        self._seek_topic = self.create_publisher(Float64, "replay/seek", STREAM)

    def activate(self) -> None:
        """Start drawing the page, and print its address on standard output."""
        print(f"{ANNOUNCEMENT}{self.url}", flush=True)
        self._timer = self.create_timer(
            1.0 / self.config.update_rate, self._draw, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def start_message(self) -> str:
        """Return the page address."""
        return f"Serves the page at {self.url}, drawn {self.config.update_rate:g} times a second."

    def deactivate(self) -> None:
        """Stop updating the page; its content is kept."""
        self.destroy_timer(self._timer)

    def cleanup(self) -> None:
        """Close the page."""
        self._checker.close()
        for request in getattr(self, "_requests", {}).values():
            request.close()
        server, self._server = self._server, None
        if server is not None:
            if (page := getattr(self, "_page", None)) is not None:
                page.end()
            stop_server(server)
        streams, self._streams = self._streams, None
        if streams is not None:
            streams.destroy_node()

    def destroy_node(self) -> None:
        """Close the page, whatever the state of the node."""
        self.cleanup()
        super().destroy_node()

    def report_event(self, event: Event) -> None:
        """Publish no event, because the viewer is not part of the recorded flight."""

    def _add_goal_topics(self, parts: Iterable[Part]) -> None:
        for part in parts:
            if part not in self._goal_topics:
                topic = "goal_pose" if part == BASE_GOAL_KEY else link_topic(part, "goal_pose")
                self._goal_topics[part] = self.create_publisher(PoseStamped, topic, STREAM)

    # -- drawing --------------------------------------------------------------------------------

    def _draw(self) -> None:
        self._descriptions.renew()
        now, state = time.monotonic(), self._listener.state()
        self._take_parameters()
        for action in self._page.update(state, now):
            self._carry_out(action)
        planner = None if "planner" in state.absent else state.planner
        planner_state = None if planner is None else planner.state
        if planner_state is not self._planner_state:
            self._planner_state = planner_state
            if planner_state not in (PlannerState.PLANNING, PlannerState.EXECUTING):
                self._page.editor.touch(now)  # The robot has moved, or no planner runs.
        self._send_goals(state, now)
        self._check_goal(state, now)

    def _check_goal(self, state: StackState, now: float) -> None:
        editor = self._page.editor
        if editor.moving:
            self._checker.cancel()
        flown = content.flown_check(state) if editor.shows_sent_goal else None
        if flown is not None:
            # The plan being executed determines the robot's final state.
            self._checker.cancel()
            editor.settled_goals(now)
            if editor.check.source is not flown.source:
                editor.show_check(flown)
            return
        goals = editor.settled_goals(now)
        if goals is not None:
            question: GoalQuestion | str = "Parameter 'check_goals' is false."
            if self.config.check_goals:
                question = make_question(state, goals, self._robot, self._remote_values)
            if isinstance(question, GoalQuestion):
                self._checker.ask(question)
            else:
                self._checker.cancel()
                editor.show_check(GoalCheck(Verdict.UNCHECKED, question))
        check = self._checker.latest_answer()
        if check is not None and not editor.moving:
            editor.show_check(check)

    # -- messages of the stack ------------------------------------------------------------------

    def _on_description(self, message: String) -> None:
        if message.data == self._urdf:
            return
        self._urdf = message.data
        self._checker.cancel()  # The goal check is for another robot.
        self._goals_to_send = None
        try:
            self._robot = parse_robot(message.data)
        except SpaceRobotError as error:
            self._robot = None
            self._note(f"robot_description: {error}", 2)
            self.get_logger().error(f"robot_description: {error}")
        if self._robot is None:
            self._listener.forget_state()
        else:
            self._listener.use(self._robot)
        self._page.show_robot(self._robot)
        self._offer_end_effectors()
        self._show_plant()

    def _on_urdf(self, topic: str, message: String) -> None:
        """Show the target or the obstacles in a message."""
        try:
            if topic == "obstacles":
                self._page.show_obstacles(obstacles_from_topic(message.data))
            else:
                self._page.show_target(parse_robot(message.data))
        except SpaceRobotError as error:
            self._note(f"{topic}: {error}", 2)

    def _on_status(self, key: str, name: str) -> None:
        if self._full_names.get(key) == name:
            return
        self._full_names[key] = name
        # Discovery of a service takes some seconds after its client is created.
        for keys, service, data in SERVICE_BY_REQUEST.values():
            if key in keys:
                self._client(Trigger if data is None else SetBool, f"{name}/{service}")
        if key in _NODES_WITH_PARAMETERS:
            self._request_parameters(key)

    def _on_event(self, received: DiagnosticStatus) -> None:
        message = read_status(received)
        try:
            event = Event.from_values(message.values, message.message, message.level)
        except SpaceRobotError:
            return
        notice = Notice(event.message, event.level, event.time_s, message.name)
        if event.kind is EventKind.NODE_RESTARTED:
            self._page.announce(notice, _RESTART_NOTICE_TIME)
        elif event.kind in (EventKind.GOAL_ACCEPTED, EventKind.GOAL_REFUSED):
            self._page.announce(notice)
            self._unanswered_goal = None
        else:
            self._page.note(notice)
        if event.kind in (EventKind.ACTIVATED, EventKind.NODE_BACK):
            for key, name in self._full_names.items():
                if name == message.name and key in _NODES_WITH_PARAMETERS:
                    self._request_parameters(key)

    def _on_log(self, message: RosoutLog) -> None:
        # The topic is the same in all namespaces; logger names have dots instead of slashes.
        own = self.get_namespace().strip("/").replace("/", ".")
        if own and not message.name.startswith(f"{own}."):
            return  # The log line is from another stack.
        if message.level >= _LEAST_SHOWN_LOG_LEVEL and message.name != self.get_logger().name:
            level = 1 if message.level == _LEAST_SHOWN_LOG_LEVEL else 2
            self._note(printable(message.msg), level, printable(message.name))

    def _on_parameter_change(self, message: ParameterEvent) -> None:
        for key in _NODES_WITH_PARAMETERS:
            if self._full_names.get(key) == message.node and key in self._remote_values:
                self._request_parameters(key)

    def _request_parameters(self, key: str) -> None:
        """Request the parameters of a node; again after a request in progress."""
        name, before = self._full_names[key], self._requests.get(key)
        if before is not None and before.name == name:
            # The earlier request is still open; an unread answer would block the node.
            self._requests_to_repeat.add(key)
            return
        if before is not None:
            before.close()
        self._requests[key] = RemoteParameters(self, name)

    def _take_parameters(self) -> None:
        for key, request in tuple(self._requests.items()):
            if not request.look():
                continue
            del self._requests[key]
            if request.values is None or key in self._requests_to_repeat:
                # A node that has reported a status but does not answer is busy.
                self._requests_to_repeat.discard(key)
                self._request_parameters(key)
            if request.values is None:
                continue
            if request.values == self._remote_values.get(key):
                continue
            self._remote_values[key] = request.values
            if key == "plant":
                self._show_plant()
                continue
            if key == "planner":
                self._offer_end_effectors()
            known = self._remote_values
            parameters = known.get("planner", known.get("controller"))
            self._page.tolerance = goal_tolerance(parameters, self._robot)
            self._page.editor.touch(time.monotonic())

    def _offer_end_effectors(self) -> None:
        links = planned_links(self._remote_values.get("planner"), self._robot)
        self._add_goal_topics(links)
        self._page.editor.offer_end_effectors(links)

    def _show_plant(self) -> None:
        values = self._remote_values.get("plant")
        if self._robot is None or values is None:
            self._page.faults.offer(FaultTargets())
            return
        takes_wrench = json.loads(values.get("actuation", '""')) in ("auto", "effort")
        source, table = json.loads(values.get("thrusters", '""')), None
        try:
            table = find_thrusters(source, self._robot) if source else None
        except SpaceRobotError as error:
            self._note(str(error), 1)
        nozzles = () if table is None else table.names
        self._page.show_thrusters(table)
        self._page.faults.offer(FaultTargets(self._robot.joint_names, takes_wrench, nozzles))

    def _note(self, message: str, level: int = 0, source: str = "") -> None:
        self._page.note(Notice(message, level, None, source))

    def _answer(self, message: str, level: int = 0, source: str = "page") -> None:
        self._page.announce(Notice(message, level, None, source))

    # -- actions of users -----------------------------------------------------------------------

    def _carry_out(self, action: Action) -> None:
        match action:
            case FlyAction(goals):
                self._goals_to_send = goals, time.monotonic() + _LONGEST_MATCHING_WAIT
            case InjectAction(text):
                self._fault_topic.publish(String(data=text))
                self._answer(f"Sent to the plant: {text}")
            case SeekAction(seconds):
                self._seek_topic.publish(Float64(data=float(seconds)))
            case Request():
                self._call_service(action)

    def _send_goals(self, state: StackState, now: float) -> None:
        """Send pending goals once their subscribers are matched; report goals without an answer."""
        if self._goals_to_send is not None:
            goals, until = self._goals_to_send
            topics = [self._shape_topic, *(self._goal_topics[part] for part in goals)]
            # A node that has just started is discovered before its subscriptions are matched.
            met = self._count_readers(goals) > 0 and all(
                topic.get_subscription_count() >= self.count_subscribers(topic.topic_name)
                for topic in topics
            )
            if met or now >= until:
                self._goals_to_send = None
                self._send(goals)
        if self._unanswered_goal is not None:
            goal_id, until = self._unanswered_goal
            statuses = (state.planner, state.controller)
            if any(status is not None and status.goal_id == goal_id for status in statuses):
                self._unanswered_goal = None
            elif state.busy or (
                # Planner and controller answer with the next state.
                state.plant is not None and state.plant.state is PlantState.PAUSED
            ):
                self._unanswered_goal = goal_id, now + _LONGEST_GOAL_ANSWER_WAIT
            elif now >= until:
                self._unanswered_goal = None
                self._answer(
                    "No planner or controller has responded to the goal: send it again.", 2
                )

    def _count_readers(self, goals: Mapping[Part, Goal]) -> int:
        """Return the maximum number of planners and controllers that receive a goal."""
        # If this node also receives the goal, one of the subscriptions is its own.
        return max(
            self._goal_topics[part].get_subscription_count() - (part in _PARTS_WITH_RECEIVED_GOALS)
            for part in goals
        )

    def _send(self, goals: Mapping[Part, Goal]) -> None:
        # Statuses name a goal by its stamp, which is therefore unique among all viewers.
        self._sent += 1
        flag = time.time_ns() // _MICROSECOND_NS * _MICROSECOND_NS % _MILLISECOND_NS
        time_ns = self._listener.time_ns() + flag + self._sent % 1000
        # An empty message resets the joint positions that another goal may have required.
        names = () if self._robot is None else self._robot.joint_names
        self._shape_topic.publish(shape_message(next(iter(goals.values())), names))
        for part, goal in goals.items():
            aim = goal.end_effectors[0].as_goal() if goal.end_effectors else goal
            self._goal_topics[part].publish(goal_message(aim, self.config.world_frame, time_ns))
        if not self._count_readers(goals):
            self._answer(
                "The goal was not received, because no planner or controller is running.", 2
            )
        else:
            self._answer("Goal sent.")
            goal_id = GoalIds().of(*divmod(min(time_ns, LATEST_NS), SECOND))
            self._unanswered_goal = goal_id, time.monotonic() + _LONGEST_GOAL_ANSWER_WAIT
        editor = self._page.editor
        editor.note_sent()
        if self._checker.cancel() and not editor.moving:
            editor.show_check(
                GoalCheck(Verdict.UNCHECKED, "The goal was sent before it was checked.")
            )

    def _call_service(self, request: Request) -> None:
        keys, service, data = SERVICE_BY_REQUEST[request]
        called = False
        for key in keys:
            name = self._full_names.get(key)
            if name is None:
                continue
            kind: type[Any] = Trigger if data is None else SetBool
            client = self._client(kind, f"{name}/{service}")
            if not client.service_is_ready():
                continue
            called = True
            call = Trigger.Request() if data is None else SetBool.Request(data=data)
            client.call_async(call).add_done_callback(
                lambda future, name=name: self._on_answer(name, future)
            )
        if not called:
            whose = " or ".join(keys)
            self._answer(f"No {whose} offers the service '{service}' now.", 2)

    def _client(self, kind: type[Any], name: str) -> Client:
        key = (name, kind)
        if key not in self._clients_by_name:
            self._clients_by_name[key] = self.create_client(kind, name)
        return self._clients_by_name[key]

    def _on_answer(self, name: str, future: Any) -> None:
        with suppress(Exception):  # The service no longer exists.
            answer = future.result()
            self._answer(answer.message, 0 if answer.success else 2, name)


main = partial(run_node, ViewerNode)
"""Serve the page until SIGINT or SIGTERM."""

if __name__ == "__main__":
    sys.exit(main())
