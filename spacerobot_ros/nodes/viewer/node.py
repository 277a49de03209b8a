"""The viewer node: it shows a stack on a page, and does to the stack what users of the page do."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import Log as RosoutLog
from rcl_interfaces.msg import ParameterEvent
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, String
from std_srvs.srv import SetBool, Trigger

from spacerobot_ros.control.thrusters import ThrusterTable, find_thrusters
from spacerobot_ros.errors import SpaceRobotError, printable
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.messages.statuses import read_status
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.nodes.common.node import EVENTS, LATCHED, STREAM, FlightNode
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.nodes.common.remote_parameters import RemoteParameters
from spacerobot_ros.nodes.viewer.listener import Listener
from spacerobot_ros.planning import Goal, RobotState
from spacerobot_ros.planning.execution.goal_file import GoalIds
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.simulation.faults import Targets
from spacerobot_ros.simulation.status import PlantState
from spacerobot_ros.times import LATEST_NS, SECOND
from spacerobot_ros.viewer.config import ViewerConfig
from spacerobot_ros.viewer.page import Page
from spacerobot_ros.viewer.port import (
    Action,
    Fly,
    Inject,
    Measured,
    Notice,
    Part,
    Request,
    Seek,
    StackState,
)
from spacerobot_ros.viewer.reachability import Check, GoalChecker, Question, Verdict
from spacerobot_ros.viewer.server import (
    is_loopback,
    require_viser,
    start_server,
    stop_server,
    url_of,
)

ANNOUNCEMENT = "viewer      "
"""What comes before the address of the page on standard output."""

_ROSOUT = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
_WARNING = 30
"""Level of rcl_interfaces/Log from which on its lines are shown."""

_TOPICS: Mapping[Part, str] = {"base": "goal_pose", "end_effector": "end_effector/goal_pose"}

_SERVICES: Mapping[Request, tuple[tuple[str, ...], str, bool | None]] = {
    Request.ABORT: (("planner", "controller"), "abort", None),
    Request.STOP: (("plant",), "abort", None),
    Request.REARM: (("plant",), "rearm", None),
    Request.RESET: (("plant",), "reset", None),
    Request.PAUSE: (("plant",), "pause", True),
    Request.RESUME: (("plant",), "pause", False),
    Request.PLAY: (("replay",), "pause", False),
    Request.HOLD: (("replay",), "pause", True),
}
"""Whose service a request calls, which one, and what it is told (None: it is a trigger)."""

_ASKED = ("plant", "planner", "controller")
"""Whose parameters are of use."""

_END_EFFECTOR = "end_effector_frame"

_LONGEST_MEETING = 4.0
"""Wall s that a goal waits for commanders that are known and not met yet."""

_LONGEST_ANSWER = 5.0
"""Wall s after which a commander that has a goal has said so."""

_MICROSECOND_NS = 1000
_FLAG_NS = 1_000_000


class ViewerNode(FlightNode):
    """Serves a page on which the robot is watched and steered.

    It subscribes and publishes like any other tool: it works with nodes in other processes, that
    begin before or after it, and with their successors. Opening the page moves nothing.
    """

    Config: ClassVar = ViewerConfig
    config: ViewerConfig

    def __init__(self, name: str = "viewer", **kwargs: Any) -> None:
        self._server: Any = None
        self._streams: Node | None = None
        self._checker = GoalChecker()
        super().__init__(name, **kwargs)

    # -- life -----------------------------------------------------------------------------------

    def configure(self) -> None:
        """Start the page and subscribe."""
        config = self.config
        require_viser()
        self._server = start_server(config.host, config.port)
        self.url = url_of(self._server)
        if not is_loopback(config.host):
            self.get_logger().warning(
                f"The page is served at '{config.host}': whoever reaches this machine there can "
                "steer the robot."
            )
        self._page = Page(self._server, config)
        self._page.show_robot(None)
        self._robot: RobotDescription | None = None
        self._urdf = ""
        self._full_names: dict[str, str] = {}
        self._callers: dict[tuple[str, type[Any]], Client] = {}
        self._remote_values: dict[str, dict[str, str]] = {}
        self._asking: dict[str, RemoteParameters] = {}
        self._to_ask_again: set[str] = set()
        self._planner_state: PlannerState | None = None
        self._sent = 0
        self._to_send: tuple[Mapping[Part, Goal], float] | None = None
        self._unanswered: tuple[str, float] | None = None
        # Nobody spins this one: its messages wait until the page is drawn.
        self._streams = rclpy.create_node(
            f"_{self.get_name()}_streams",
            namespace=self.get_namespace(),
            context=self.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._listener = Listener(self._streams, self, config.world_frame, self._on_status)
        self.create_subscription(String, "robot_description", self._on_description, LATCHED)
        self.create_subscription(DiagnosticStatus, "events", self._on_event, EVENTS)
        self.create_subscription(RosoutLog, "/rosout", self._on_log, _ROSOUT)
        self.create_subscription(ParameterEvent, "/parameter_events", self._on_change, STREAM)
        self._goal_topics = {
            part: self.create_publisher(PoseStamped, topic, STREAM)
            for part, topic in _TOPICS.items()
        }
        self._shape_topic = self.create_publisher(JointState, "goal_joint_states", STREAM)
        self._fault_topic = self.create_publisher(String, "fault_injection", STREAM)
        self._seek_topic = self.create_publisher(Float64, "replay/seek", STREAM)

    def activate(self) -> None:
        """Draw the page again and again, and say on standard output where it is."""
        print(f"{ANNOUNCEMENT}{self.url}", flush=True)
        self._timer = self.create_timer(
            1.0 / self.config.update_rate, self._draw, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def start_sentence(self) -> str:
        """Return where the page is."""
        return f"Draws the page at {self.url} {self.config.update_rate:g} times a second."

    def deactivate(self) -> None:
        """Draw no more; the page stays as it is."""
        self.destroy_timer(self._timer)

    def cleanup(self) -> None:
        """Close the page."""
        self._checker.close()
        for asking in getattr(self, "_asking", {}).values():
            asking.close()
        server, self._server = self._server, None
        if server is not None:
            stop_server(server)
        streams, self._streams = self._streams, None
        if streams is not None:
            streams.destroy_node()

    def destroy_node(self) -> None:
        """Close the page, whatever state the node is in."""
        self.cleanup()
        super().destroy_node()

    def report_event(self, event: Event) -> None:
        """Report nothing: a spectator is no part of a flight, nor of its record."""

    # -- drawing --------------------------------------------------------------------------------

    def _draw(self) -> None:
        now, state = time.monotonic(), self._listener.state()
        self._look_for_parameters()
        for action in self._page.update(state, now):
            self._carry_out(action, state)
        planner = None if "planner" in state.absent else state.planner
        planner_state = None if planner is None else planner.state
        if planner_state is not self._planner_state:
            self._planner_state = planner_state
            if planner_state not in (PlannerState.PLANNING, PlannerState.EXECUTING):
                self._page.touch_goal(now)  # The robot is elsewhere, or nobody plans.
        self._send_goals(state, now)
        self._check_goal(state, now)

    def _check_goal(self, state: StackState, now: float) -> None:
        if self._page.goal_moves:
            self._checker.cancel()
        goals = self._page.goals_to_check(now)
        if goals is not None:
            question, why_not = self._question(state, goals)
            if question is None:
                self._checker.cancel()
                self._page.show_check(Check(Verdict.UNCHECKED, why_not))
            else:
                self._checker.ask(question)
        check = self._checker.look()
        if check is not None:
            self._page.show_check(check)

    def _question(
        self, state: StackState, goals: Mapping[Part, Goal]
    ) -> tuple[Question | None, str]:
        """Return what is to be planned, or None and why not."""
        if not self.config.check_goals:
            return None, "Parameter 'check_goals' is false."
        measured, goal = state.measured, goals["base"]
        if measured is None or self._robot is None:
            return None, "No state has come yet."
        if state.planner is None:
            return self._question_of_arm(measured, goals)
        if "planner" in state.absent:
            return None, "The planner is not there now."
        if state.planner.state is PlannerState.PLANNING:
            return None, "The planner plans."
        parameters = self._remote_values.get("planner")
        if parameters is None:
            return None, "The planner's parameters are not known yet."
        momenta = np.zeros(6) if state.momenta is None else state.momenta.actual
        robot_state = RobotState(
            measured.pose[:3], measured.pose[3:], measured.q, momenta[:3], momenta[3:]
        )
        return Question(self._urdf, parameters, robot_state, goal), ""

    def _question_of_arm(
        self, measured: Measured, goals: Mapping[Part, Goal]
    ) -> tuple[Question | None, str]:
        """Return whether the arm can be as a controller is to bring it, or None and why not."""
        assert self._robot is not None
        tool = goals.get("end_effector")
        if tool is None:
            return None, "No planner is there: a controller flies the base to any pose."
        named = json.loads(self._remote_values.get("controller", {}).get(_END_EFFECTOR, '""'))
        link = self._robot.end_effector(named)
        if link not in self._robot.frames:
            return None, "The end-effector is no link of the robot."
        state = RobotState(measured.pose[:3], measured.pose[3:], measured.q)
        return Question(self._urdf, {}, state, goals["base"], tool, link), ""

    # -- what the stack says --------------------------------------------------------------------

    def _on_description(self, message: String) -> None:
        if message.data == self._urdf:
            return
        self._urdf = message.data
        self._checker.cancel()  # What it would answer is of another robot.
        self._to_send = None
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
        self._show_plant()

    def _on_status(self, key: str, name: str) -> None:
        if self._full_names.get(key) == name:
            return
        self._full_names[key] = name
        # Services are found some seconds after their clients are made.
        for keys, service, data in _SERVICES.values():
            if key in keys:
                self._client(Trigger if data is None else SetBool, f"{name}/{service}")
        if key in _ASKED:
            self._ask(key)

    def _on_event(self, received: DiagnosticStatus) -> None:
        message = read_status(received)
        try:
            event = Event.from_values(message.values, message.message, message.level)
        except SpaceRobotError:
            return
        self._page.note(Notice(event.message, event.level, event.time_s, message.name))
        if event.kind in (EventKind.ACTIVATED, EventKind.NODE_BACK):
            for key, name in self._full_names.items():
                if name == message.name and key in _ASKED:
                    self._ask(key)

    def _on_log(self, message: RosoutLog) -> None:
        # The topic is the same in all namespaces, and loggers have dots for slashes.
        own = self.get_namespace().strip("/").replace("/", ".")
        if own and not message.name.startswith(f"{own}."):
            return  # Of another stack.
        if message.level >= _WARNING and message.name != self.get_logger().name:
            level = 1 if message.level == _WARNING else 2
            self._note(printable(message.msg), level, printable(message.name))

    def _on_change(self, message: ParameterEvent) -> None:
        for key in _ASKED:
            if self._full_names.get(key) == message.node and key in self._remote_values:
                self._ask(key)

    def _ask(self, key: str) -> None:
        """Ask a node for its parameters; once more where that is being done."""
        name, before = self._full_names[key], self._asking.get(key)
        if before is not None and before.name == name:
            # The question before is still open: an answer that nobody takes would block that node.
            self._to_ask_again.add(key)
            return
        if before is not None:
            before.close()
        self._asking[key] = RemoteParameters(self, name)

    def _look_for_parameters(self) -> None:
        for key, asking in tuple(self._asking.items()):
            if not asking.look():
                continue
            del self._asking[key]
            if asking.values is None or key in self._to_ask_again:
                # A node that does not answer, but has reported a status, is there and busy.
                self._to_ask_again.discard(key)
                self._ask(key)
            if asking.values is None:
                continue
            if asking.values == self._remote_values.get(key):
                continue
            self._remote_values[key] = asking.values
            if key == "plant":
                self._show_plant()
            else:
                self._page.touch_goal(time.monotonic())

    def _show_plant(self) -> None:
        """Offer the faults of the plant, and show its thrusters."""
        values = self._remote_values.get("plant")
        if self._robot is None or values is None:
            self._page.offer_faults(Targets())
            return
        effort = json.loads(values.get("actuation", '""')) == "effort"
        table = self._table(json.loads(values.get("thrusters", '""')))
        nozzles = () if table is None else table.names
        self._page.show_thrusters(table)
        self._page.offer_faults(Targets(self._robot.joint_names, effort, nozzles))

    def _table(self, source: str) -> ThrusterTable | None:
        if not source or self._robot is None:
            return None
        try:
            return find_thrusters(source, self._robot)
        except SpaceRobotError as error:
            self._note(str(error), 1)
            return None

    def _note(self, sentence: str, level: int = 0, source: str = "") -> None:
        self._page.note(Notice(sentence, level, None, source))

    # -- what users want ------------------------------------------------------------------------

    def _carry_out(self, action: Action, state: StackState) -> None:
        match action:
            case Fly(goals):
                self._to_send = goals, time.monotonic() + _LONGEST_MEETING
            case Inject(text):
                self._fault_topic.publish(String(data=text))
                self._note(f"Sent to the plant: {text}", source="page")
            case Seek(seconds):
                self._seek_topic.publish(Float64(data=float(seconds)))
            case Request():
                self._request(action)

    def _send_goals(self, state: StackState, now: float) -> None:
        """Send what is to be sent once its readers are met, and notice where nobody answers."""
        if self._to_send is not None:
            goals, until = self._to_send
            topics = [self._shape_topic, *(self._goal_topics[part] for part in goals)]
            # A commander that has just begun is known before it can be reached.
            met = all(
                topic.get_subscription_count() >= self.count_subscribers(topic.topic_name)
                for topic in topics
            )
            if met or now >= until:
                self._to_send = None
                self._send(goals)
        if self._unanswered is not None:
            goal_id, until = self._unanswered
            statuses = (state.planner, state.controller)
            if any(status is not None and status.goal_id == goal_id for status in statuses):
                self._unanswered = None
            elif state.busy or (
                # Commanders answer with the next state.
                state.plant is not None and state.plant.state is PlantState.PAUSED
            ):
                self._unanswered = goal_id, now + _LONGEST_ANSWER
            elif now >= until:
                self._unanswered = None
                self._note("Nobody has answered the goal: send it again.", 2, "page")

    def _send(self, goals: Mapping[Part, Goal]) -> None:
        # No other goal has this stamp, by which statuses name it: other viewers may send one now.
        self._sent += 1
        flag = time.time_ns() // _MICROSECOND_NS * _MICROSECOND_NS % _FLAG_NS
        time_ns = self._listener.time_ns() + flag + self._sent % 1000
        sec, nanosec = divmod(min(time_ns, LATEST_NS), SECOND)
        self._send_shape(goals["base"])
        for part, goal in goals.items():
            message = PoseStamped()
            message.header.frame_id = self.config.world_frame
            message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
            p, o = message.pose.position, message.pose.orientation
            p.x, p.y, p.z = goal.position.tolist()
            o.x, o.y, o.z, o.w = goal.quaternion.tolist()
            self._goal_topics[part].publish(message)
        readers = self._goal_topics["base"].get_subscription_count()
        # One of them is this node's own.
        if readers <= 1:
            self._note("Nobody takes the goal: no planner and no controller is there.", 2, "page")
        else:
            self._note("The goal is sent.", source="page")
            goal_id = GoalIds().of(sec, nanosec)
            self._unanswered = goal_id, time.monotonic() + _LONGEST_ANSWER
        if self._checker.cancel():
            self._page.show_check(Check(Verdict.UNCHECKED, "It was sent before it was checked."))

    def _send_shape(self, goal: Goal) -> None:
        """Have the goal that follows end in its joint positions, or in any if it has none.

        Planners keep those of earlier goals, which others may have sent before there was a viewer.
        """
        shape, names = goal.joint_positions, () if self._robot is None else self._robot.joint_names
        wanted = JointState() if shape is None else JointState(name=names, position=shape.tolist())
        self._shape_topic.publish(wanted)

    def _request(self, request: Request) -> None:
        """Call the service of everybody that has it."""
        keys, service, data = _SERVICES[request]
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
            self._note(f"No {whose} answers '{service}' now.", 2, "page")

    def _client(self, kind: type[Any], name: str) -> Client:
        key = (name, kind)
        if key not in self._callers:
            self._callers[key] = self.create_client(kind, name)
        return self._callers[key]

    def _on_answer(self, name: str, future: Any) -> None:
        with suppress(Exception):  # A service that has gone.
            answer = future.result()
            self._note(answer.message, 0 if answer.success else 2, name)


def main() -> None:
    """Serve the page until SIGINT or SIGTERM."""
    sys.exit(run_node(ViewerNode))


if __name__ == "__main__":
    main()
