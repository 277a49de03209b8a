"""The viewer node between a page and a stack, which are stand-ins; it is drawn when the test says.

The page in a browser has tests of its own in ``test/viewer``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import Log as RosoutLog
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, String

from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model import load_robot
from spacerobot_ros.nodes import ViewerNode
from spacerobot_ros.nodes.viewer import node as viewer
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.faults import FaultTargets
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer.reachability import Verdict
from spacerobot_ros.viewer.state import (
    FlyAction,
    InjectAction,
    Measured,
    Part,
    Request,
    SeekAction,
    StackState,
)

ROBOT = load_robot(robot_file("servicer"))
GOAL = Goal.checked([1.0, -2.0, 3.0], [0.5, -0.1, 0.7, 0.5])
HAND = Goal.checked([4.0, 5.0, 6.0], [0.1, 0.7, -0.5, 0.5])


@dataclass
class Publisher:
    """A publisher of a topic with one reader in the stack besides this node's own."""

    topic_name: str
    sent: list[Any] = field(default_factory=list)
    matched: int = 2

    def publish(self, message: Any) -> None:
        self.sent.append(message)

    def get_subscription_count(self) -> int:
        return self.matched


class Viewer(ViewerNode):
    """A viewer whose topics, services and wall time are in the hands of the test."""

    def __init__(self, **options: Any) -> None:
        self.sent: dict[str, Publisher] = {}
        self.called: list[tuple[str, Any]] = []
        self.absent: set[str] = set()
        self.answers: list[Callable[[Any], None]] = []
        super().__init__(**options)

    def create_publisher(self, msg_type: Any, topic: str, *args: Any, **kwargs: Any) -> Any:
        if msg_type not in (PoseStamped, JointState, String, Float64):
            return super().create_publisher(msg_type, topic, *args, **kwargs)
        return self.sent.setdefault(topic, Publisher(topic))

    def count_subscribers(self, topic_name: str) -> int:
        return 2

    def create_client(self, kind: type[Any], srv_name: str, *args: Any, **options: Any) -> Any:
        def call(request: Any) -> Any:
            self.called.append((srv_name, getattr(request, "data", None)))
            return SimpleNamespace(add_done_callback=self.answers.append)

        ready = lambda: srv_name not in self.absent  # noqa: E731
        return SimpleNamespace(service_is_ready=ready, call_async=call)


class Stand:
    """A viewer, its page and its wall time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, context: rclpy.Context) -> None:
        self.now, self.state = 1000.0, StackState()
        self.actions: list[Any] = []
        self.notes: list[tuple[str, int, str]] = []
        self.shown: list[Any] = []
        self.checks: list[tuple[Verdict, str]] = []
        self.cancelled = 0
        self.asked: list[Any] = []
        self.requests: list[Any] = []
        self.touched: list[float] = []
        self.at_rest: Any = None
        self.checking = False
        self.offered: list[tuple[str, ...]] = []
        self.editor: Any = SimpleNamespace(
            offer_end_effectors=self.offered.append,
            moving=False,
            touch=self.touched.append,
            settled_goals=lambda now: self.at_rest,
            show_check=lambda check: self.checks.append((check.verdict, check.message)),
            shows_sent_goal=False,
            note_sent=lambda: setattr(self.editor, "shows_sent_goal", True),
        )
        page = SimpleNamespace(
            editor=self.editor,
            faults=SimpleNamespace(offer=lambda targets: self.shown.append(targets)),
            show_robot=lambda robot: self.shown.append(robot),
            show_thrusters=lambda table: self.shown.append(table and table.names),
            show_tolerance=lambda tolerance: None,
            note=lambda notice: self.notes.append((notice.message, notice.level, notice.source)),
            end=lambda: self.shown.append("end"),
            update=lambda state, now: [self.actions.pop()] if self.actions else [],
        )
        checker = SimpleNamespace(
            ask=self.asked.append, cancel=self.cancel, latest_answer=lambda: None, close=bool
        )
        listener = SimpleNamespace(
            state=lambda: self.state, time_ns=lambda: 2_000_000_000, forget_state=bool, use=bool
        )

        def listen(streams: Any, node: Any, frame: str, on_status: Any, silent: float) -> Any:
            self.on_status, self.silent_after = on_status, silent
            return listener

        def ask(node: Any, name: str) -> Any:
            request = SimpleNamespace(name=name, values=None, over=False, closed=False)
            request.look = lambda: request.over
            request.close = lambda: setattr(request, "closed", True)
            self.requests.append(request)
            return request

        wall = SimpleNamespace(monotonic=lambda: self.now, time_ns=lambda: 123_456_789)
        for name, part in {
            "time": wall,
            "start_server": lambda host, port: SimpleNamespace(),
            "stop_server": lambda server: None,
            "url_of": lambda server: "http://localhost:8080",
            "Page": lambda server, config: page,
            "GoalChecker": lambda: checker,
            "Listener": listen,
            "RemoteParameters": ask,
        }.items():
            monkeypatch.setattr(viewer, name, part)
        given = {"update_rate": 1.0, "world_frame": "w", "watchdog_timeout": 4.5}
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        self.node = Viewer(context=context, parameter_overrides=overrides)

    def cancel(self) -> bool:
        self.cancelled += 1
        return self.checking

    def hear(self, topic: str, message: Any) -> None:
        """Hand over a message as its subscription would."""
        topic = self.node.resolve_topic_name(topic)
        (found,) = (each for each in self.node.subscriptions if each.topic_name == topic)
        found.callback(message)

    def draw(self, *actions: Any, after: float = 0.0) -> None:
        """Draw the page once for each action, and once."""
        self.now += after
        for action in actions:
            self.actions.append(action)
            self.node._draw()
        self.node._draw()

    def event(self, kind: EventKind, name: str, message: str, level: int = 0) -> None:
        event = Event(kind, message, level, 4.5)
        values = [KeyValue(key=k, value=v) for k, v in event.to_values(None).items()]
        status = DiagnosticStatus(name=name, message=message, values=values, level=bytes([level]))
        self.hear("events", status)


@pytest.fixture
def stand(monkeypatch: pytest.MonkeyPatch, ros_context: rclpy.Context) -> Iterator[Stand]:
    stand = Stand(monkeypatch, ros_context)
    yield stand
    stand.node.destroy_node()


def test_nodes_are_silent_after_as_long_as_the_parameter_says(stand: Stand) -> None:
    assert stand.silent_after == 4.5


@pytest.mark.parametrize(
    ("request_", "called"),
    [
        (Request.ABORT, [("/p/abort", None), ("/c/abort", None)]),
        (Request.STOP, [("/x/abort", None)]),
        (Request.REARM, [("/x/rearm", None)]),
        (Request.RESET, [("/x/reset", None)]),
        (Request.PAUSE, [("/x/pause", True)]),
        (Request.RESUME, [("/x/pause", False)]),
        (Request.PLAY, [("/r/pause", False)]),
        (Request.HOLD, [("/r/pause", True)]),
    ],
)
def test_buttons_call_services_of_the_nodes_that_offer_them(
    stand: Stand, request_: Request, called: list[tuple[str, Any]]
) -> None:
    nodes = {"planner": "/p", "controller": "/c", "plant": "/x", "replay": "/r"}
    stand.draw(request_)
    assert stand.node.called == []
    for key, name in nodes.items():
        stand.on_status(key, name)
    stand.draw(request_)
    assert stand.node.called == called
    absent, service = called[0][0], called[0][0].rpartition("/")[2]
    stand.node.absent.add(absent)
    stand.draw(request_)
    assert stand.node.called == called + called[1:]
    unavailable = [
        note for note in stand.notes if f"offers the service '{service}' now." in note[0]
    ]
    assert len(unavailable) == (1 if called[1:] else 2)
    assert all(note[1:] == (2, "page") for note in unavailable)
    for success in (True, False):
        answer = SimpleNamespace(message="The answer.", success=success)
        stand.node.answers[0](SimpleNamespace(result=lambda answer=answer: answer))
        name = called[0][0].rpartition("/")[0]
        assert stand.notes[-1] == ("The answer.", 0 if success else 2, name)


def test_faults_and_times_of_a_replay_are_sent(stand: Stand) -> None:
    stand.draw(InjectAction("stuck arm_1"), SeekAction(12.5))
    assert [each.data for each in stand.node.sent["fault_injection"].sent] == ["stuck arm_1"]
    assert [each.data for each in stand.node.sent["replay/seek"].sent] == [12.5]
    assert stand.notes == [("Sent to the plant: stuck arm_1", 0, "page")]


def test_goals_of_one_request_have_one_stamp_and_all_requests_different_ones(
    stand: Stand,
) -> None:
    goals: dict[Part, Goal] = {"base": GOAL, "end_effector": HAND}
    stand.checking = True
    stand.draw(FlyAction(goals))
    sent = stand.node.sent
    stamps = []
    for topic, goal in (("goal_pose", GOAL), ("end_effector/goal_pose", HAND)):
        (message,) = sent[topic].sent
        assert message.header.frame_id == "w"
        place = message.pose.position
        assert [place.x, place.y, place.z] == goal.position.tolist()
        stamps.append((message.header.stamp.sec, message.header.stamp.nanosec))
    # The simulated time, with the microseconds of the wall time and a number.
    assert stamps == [(2, 456_001)] * 2
    assert sent["goal_joint_states"].sent == [JointState()]
    assert stand.notes == [("Goal sent.", 0, "page")]
    assert stand.checks == [(Verdict.UNCHECKED, "It was sent before it was checked.")]
    stand.checking = False
    shape = replace(GOAL, joint_positions=np.array([0.25] * len(ROBOT.joint_names)))
    stand.hear("robot_description", String(data=ROBOT.urdf))
    stand.draw(FlyAction({"base": shape}))
    assert sent["goal_pose"].sent[-1].header.stamp.nanosec == 456_002
    assert sent["goal_joint_states"].sent[-1].name == list(ROBOT.joint_names)
    assert len(sent["end_effector/goal_pose"].sent) == 1
    assert len(stand.checks) == 1


def test_goals_of_links_are_offered_and_sent_as_the_planner_takes_them(stand: Stand) -> None:
    def learn(**parameters: Any) -> None:
        stand.requests[-1].values = {k: json.dumps(v) for k, v in parameters.items()}
        stand.requests[-1].over = True
        stand.draw()

    robot = load_robot(robot_file("dual_arm"))
    links = ["left_link_7", "nobody", robot.base_link, "right_link_7"]
    stand.hear("robot_description", String(data=robot.urdf))
    stand.on_status("planner", "/p")
    learn(end_effectors=links, output="reference")
    assert stand.offered[-1] == ("left_link_7", "right_link_7")
    assert len(stand.touched) == 1, "the goal is checked with them"
    left = EndEffectorGoal("left_link_7", np.array([1.0, 2.0, 4.0]), GOAL.quaternion)
    right = EndEffectorGoal("right_link_7", np.array([-0.5, 0.25, 8.0]))
    shape = np.linspace(0.1, 0.7, 14)
    hands = {aim.link: Goal.of_end_effectors([aim], joint_positions=shape) for aim in (left, right)}
    stand.draw(FlyAction(hands))
    sent = stand.node.sent
    assert sent["goal_pose"].sent == [], "the base is free"
    messages = [sent[f"{link}/goal_pose"].sent[0] for link in hands]
    assert [message.header.stamp for message in messages] == [messages[0].header.stamp] * 2
    numbers = [
        [
            *(getattr(m.pose.position, x) for x in "xyz"),
            *(getattr(m.pose.orientation, x) for x in "xyzw"),
        ]
        for m in messages
    ]
    assert numbers == [[1.0, 2.0, 4.0, *GOAL.quaternion], [-0.5, 0.25, 8.0, 0.0, 0.0, 0.0, 0.0]]
    (named,) = sent["goal_joint_states"].sent
    assert named.position.tolist() == shape.tolist()
    assert stand.notes[-1] == ("Goal sent.", 0, "page")
    # This node does not hear these topics: one subscription is another node's.
    sent["left_link_7/goal_pose"].matched = 0
    sent["right_link_7/goal_pose"].matched = 1
    stand.node.count_subscribers = lambda topic_name: 0  # type: ignore[method-assign]
    stand.draw(FlyAction(hands))
    assert stand.notes[-1] == ("Goal sent.", 0, "page")
    sent["right_link_7/goal_pose"].matched = 0
    stand.draw(FlyAction(hands))
    assert stand.notes[-1][0].startswith("No planner or controller takes the goal")
    # Another robot, and a planner of another kind.
    stand.hear("robot_description", String(data=ROBOT.urdf))
    assert list(stand.offered[-1]) == []
    stand.on_status("planner", "/q")
    learn(end_effectors=[], output="commands")
    assert list(stand.offered[-1]) == ["end_effector"]


@pytest.mark.parametrize(("unmatched", "seconds"), [(True, 4.0), (False, 0.0)])
def test_a_goal_waits_for_subscribers_that_are_known_but_not_matched(
    stand: Stand, unmatched: bool, seconds: float
) -> None:
    stand.node.sent["goal_joint_states"].matched = 1 if unmatched else 2
    stand.draw(FlyAction({"base": GOAL}))
    if unmatched:
        stand.draw(after=3.75)
        assert stand.node.sent["goal_pose"].sent == []
        stand.draw(after=0.25)
    assert len(stand.node.sent["goal_pose"].sent) == 1


def test_a_goal_that_nobody_takes_or_answers_is_reported(stand: Stand) -> None:
    stand.node.sent["goal_pose"].matched = 1
    stand.node.count_subscribers = lambda topic_name: 1  # type: ignore[method-assign]
    stand.draw(FlyAction({"base": GOAL}))
    nobody = ("No planner or controller takes the goal: none is running.", 2, "page")
    assert stand.notes == [nobody]
    stand.draw(after=60.0)
    assert stand.notes == [nobody]
    stand.node.sent["goal_pose"].matched = 2
    stand.draw(FlyAction({"base": GOAL}))
    stand.draw(after=4.75)
    assert len(stand.notes) == 2
    stand.draw(after=0.25)
    late = ("No planner or controller has answered the goal: send it again.", 2, "page")
    assert stand.notes[2:] == [late]
    stand.draw(FlyAction({"base": GOAL}))
    stand.state = StackState(planner=PlannerStatus(PlannerState.PLANNING, goal_id="2.000456003"))
    stand.draw()
    stand.draw(after=60.0)
    assert stand.notes[3:] == [("Goal sent.", 0, "page")]


def test_goals_are_checked_when_the_page_rests(stand: Stand) -> None:
    stand.at_rest = {"base": GOAL}
    stand.draw()
    assert stand.checks == [(Verdict.UNCHECKED, "No state received yet.")]
    stand.hear("robot_description", String(data=ROBOT.urdf))
    n = len(ROBOT.joint_names)
    stand.state = StackState(measured=Measured(1.0, np.eye(7)[6], *np.zeros((3, n))))
    before = stand.cancelled
    stand.draw()
    assert stand.checks[-1][1].startswith("No planner is running")
    assert stand.cancelled == before + 1
    stand.state = replace(stand.state, planner=PlannerStatus(PlannerState.IDLE))
    stand.on_status("planner", "/p")
    stand.requests[-1].values, stand.requests[-1].over = {"method": '"auto"'}, True
    stand.draw()
    assert [question.goal for question in stand.asked] == [GOAL]
    assert stand.cancelled == before + 1
    stand.editor.moving, stand.at_rest = True, None
    stand.draw()
    assert stand.cancelled == before + 2


def test_the_goal_is_checked_again_when_the_robot_may_have_moved(stand: Stand) -> None:
    touched = []
    for state in (*PlannerState, None):
        status = None if state is None else PlannerStatus(state)
        stand.state = StackState(planner=status)
        before = len(stand.touched)
        stand.draw()
        stand.draw()
        touched.append(len(stand.touched) - before)
    wanted = [
        state not in (PlannerState.PLANNING, PlannerState.EXECUTING) for state in PlannerState
    ]
    assert touched == [*map(int, wanted), 1], "once, at a change"
    stand.state = StackState(
        planner=PlannerStatus(PlannerState.IDLE), absent=frozenset({"planner"})
    )
    stand.draw()
    assert len(stand.touched) == sum(touched), "it is as if there were none"


def test_parameters_are_read_again_when_they_change_or_their_node_comes_back(
    stand: Stand,
) -> None:
    stand.hear("robot_description", String(data=ROBOT.urdf))
    assert isinstance(stand.shown[-1], FaultTargets)
    assert stand.shown[-1] == FaultTargets()
    stand.on_status("plant", "/x")
    stand.on_status("plant", "/x")
    assert [each.name for each in stand.requests] == ["/x"]
    stand.event(EventKind.ACTIVATED, "/x", "It runs.")
    assert len(stand.requests) == 1, "the first is still open"
    first = stand.requests[0]
    first.values, first.over = {"actuation": '"velocity"'}, True
    stand.draw()
    assert stand.shown[-2:] == [None, FaultTargets(ROBOT.joint_names, False, ())]
    assert len(stand.requests) == 2, "it was asked for meanwhile"
    again = stand.requests[1]
    again.values, again.over = {"actuation": '"effort"', "thrusters": '"urdf"'}, True
    stand.draw()
    names, offered = stand.shown[-2:]
    assert len(names) > 1
    assert offered == FaultTargets(ROBOT.joint_names, True, names)
    for node in ("/other", "/x"):
        stand.hear("/parameter_events", ParameterEvent(node=node))
    assert len(stand.requests) == 3
    stand.requests[2].over = True  # It has not answered: it is busy.
    stand.draw()
    assert len(stand.requests) == 4
    stand.on_status("plant", "/y")
    assert stand.requests[3].closed
    assert stand.requests[4].name == "/y"
    stand.requests[4].values, stand.requests[4].over = {"thrusters": '"missing.yaml"'}, True
    stand.draw()
    assert stand.shown[-2:] == [None, FaultTargets(ROBOT.joint_names, False, ())]
    assert stand.notes[-1][1:] == (1, "")
    assert "missing.yaml" in stand.notes[-1][0]


def test_events_and_warnings_are_in_the_log(stand: Stand) -> None:
    stand.event(EventKind.RUNNING, "/recorder", "The bag is complete.", 1)
    stand.hear("events", DiagnosticStatus(name="/other", message="no event"))
    own = stand.node.get_logger().name
    for level, name, text in (
        (20, "planner", "tells"),
        (30, "planner", "warns\x07"),
        (40, "planner", "errs"),
        (40, own, "errs"),
    ):
        stand.hear("/rosout", RosoutLog(level=level, name=name, msg=text))
    assert stand.notes == [
        ("The bag is complete.", 1, "/recorder"),
        ("warns\N{REPLACEMENT CHARACTER}", 1, "planner"),
        ("errs", 2, "planner"),
    ]


def test_a_description_that_is_no_robot_is_in_the_log_and_shows_none(stand: Stand) -> None:
    assert stand.shown == [None]
    stand.hear("robot_description", String(data=ROBOT.urdf))
    assert stand.shown[1].name == ROBOT.name
    drawn = len(stand.shown)
    stand.hear("robot_description", String(data=ROBOT.urdf))
    assert len(stand.shown) == drawn, "it is no other one"
    stand.node.get_logger().set_level(50)
    stand.hear("robot_description", String(data="<robot/>"))
    ((text, level, source),) = stand.notes
    assert text.startswith("robot_description: ")
    assert (level, source) == (2, "")
    assert stand.shown[drawn] is None
    stand.node.get_logger().set_level(0)


def test_a_paused_plant_and_a_busy_planner_are_given_their_time(stand: Stand) -> None:
    stand.draw(FlyAction({"base": GOAL}))
    paused = PlantStatus(PlantState.PAUSED, "Time stands still.")
    for state in (StackState(busy=True), StackState(plant=paused)):
        stand.state = state
        stand.draw(after=30.0)
    stand.state = StackState()
    stand.draw(after=4.75)
    assert [note[0] for note in stand.notes] == ["Goal sent."]
    stand.draw(after=0.25)
    assert len(stand.notes) == 2


def test_a_viewer_that_ends_says_so_on_its_page(stand: Stand) -> None:
    stand.node.cleanup()
    assert stand.shown[-1] == "end"
