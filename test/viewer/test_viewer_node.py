"""The viewer node beside a plant and without one: what it shows, sends, and gives up."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from html import unescape
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log as RosoutLog
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from support.made_bags import status
from support.page_elements import Element, Server
from support.ros_harness import LATCHED, Harness, Probe

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import load_robot
from spacerobot_ros.nodes import ViewerNode
from spacerobot_ros.nodes.common.watchdog import HeartbeatState, Role
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer.reachability import GoalCheck, GoalChecker, GoalQuestion, Verdict
from spacerobot_ros.viewer.state import Measured

ROBOT = load_robot(robot_file("sliding_masses"))
URDF, SLIDERS = ROBOT.urdf, ROBOT.joint_names
GOAL = Goal.checked([1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
HERE = Measured(0.0, np.eye(7)[6], *np.zeros((3, 3)))
ARM = load_robot(robot_file("three_joint_arm"))


class Clock:
    """The time of a viewer in the place of the module's: ``ahead`` of it, or at rest there."""

    def __init__(self, *, runs: bool) -> None:
        self.runs, self.ahead = runs, 0.0

    def monotonic(self) -> float:
        return self.ahead + self.runs * time.monotonic()

    def time_ns(self) -> int:
        return time.time_ns()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock(runs=True)
    for module in ("node", "listener"):
        monkeypatch.setattr(f"spacerobot_ros.nodes.viewer.{module}.time", clock)
    return clock


class Served(Server):
    """The server of a page that no browser shows."""

    def __init__(self, host: str, port: int, _title: str) -> None:
        super().__init__()
        self.get_host, self.get_port = lambda: host, lambda: port
        self.drawn = 0
        """How often the page was drawn."""

    def atomic(self) -> Any:
        self.drawn += 1
        return super().atomic()

    def stop(self) -> None:
        pass


class Stack:
    """A probe that says what a plant and its replay say, and hears what the viewer sends."""

    def __init__(self, harness: Harness, **parameters: Any) -> None:
        self.harness = harness
        topics = {"/goal_pose": PoseStamped, "/fault_injection": String, "/replay/seek": Float64}
        self.probe: Probe = harness.probe(topics, name="stack")
        self.called: list[str] = []
        for kind, name in (
            (Trigger, "/robot/abort"),
            (Trigger, "/robot/rearm"),
            (Trigger, "/robot/reset"),
            (SetBool, "/robot/pause"),
        ):
            self.probe.create_service(kind, name, self._answer(name))
        create = self.probe.create_publisher
        self.description = create(String, "/robot_description", LATCHED)
        self.status = create(DiagnosticStatus, "/plant/status", LATCHED)
        self.odom = create(Odometry, "/odom", 10)
        self.joints = create(JointState, "/joint_states", 10)
        self.momentum = create(Float64MultiArray, "/momentum", 10)
        self.viewer, self.page = viewer_of(harness, **{"update_rate": 60.0, **parameters})
        self.gui, self.scene = self.page.gui, self.page.scene
        harness.connect()

    def _answer(self, name: str) -> Any:
        def answer(request: Any, response: Any) -> Any:
            data = getattr(request, "data", None)
            self.called.append(name if data is None else f"{name} {data}")
            response.success, response.message = True, f"Done: {name}."
            return response

        return answer

    def describe(self, urdf: str = URDF) -> None:
        self.description.publish(String(data=urdf))
        self.report(PlantState.RUNNING, "A command is active.")

    def report(self, state: PlantState, message: str) -> None:
        plant = PlantStatus(state, message)
        self.status.publish(status(plant.to_values(), message, "/robot"))

    def move(self, x: float, names: Sequence[str] = SLIDERS) -> bool:
        odom = Odometry()
        odom.pose.pose.position.x = x
        odom.pose.pose.orientation.w = 1.0
        self.odom.publish(odom)
        zeros = [0.0] * len(names)
        self.joints.publish(
            JointState(name=list(names), position=zeros, velocity=zeros, effort=zeros)
        )
        return False

    def node(self, path: str) -> Element | None:
        """Return what is drawn at a path, if it is."""
        return next((each for each in self.scene.elements if each.name == path), None)

    @property
    def robot(self) -> Element | None:
        return self.node("/robot")

    @property
    def at(self) -> float:
        """Where the robot is drawn, along x in m."""
        return math.nan if self.robot is None else float(self.robot.position[0])

    @property
    def placed(self) -> bool:
        """Whether the page shows a goal."""
        return self.node("/goal") is not None

    def said(self) -> str:
        return said_on(self.page)

    def until(self, predicate: Any, what: str) -> None:
        self.harness.spin_until(predicate, what)

    def draw(self) -> None:
        """Wait until the page has been drawn anew, with what has come until now."""
        before = self.page.drawn
        self.until(lambda: self.page.drawn > before + 1, "the page is drawn")

    def press(self, label: str, value: Any = None) -> None:
        """Press a button of the page, or set a field."""
        self.gui.named(label).use(self.page, value)

    def choose(self, label: str) -> None:
        """Press one of the buttons of a group."""
        groups = (each for each in self.gui.elements if each.kind == "add_button_group")
        (group,) = (each for each in groups if label in each.options)
        group.use(self.page, label)

    def drag(self, pose: np.ndarray) -> None:
        """Move the gizmo of the base as a browser does."""
        gizmo = self.scene.named("/goal")
        gizmo.position, gizmo.wxyz = pose[:3], pose[[6, 3, 4, 5]]
        gizmo.use(self.page)


def viewer_of(
    harness: Harness, *, namespace: str = "", **parameters: Any
) -> tuple[ViewerNode, Served]:
    """Return a viewer and the server of its page."""
    served: list[Served] = []

    def serve(*given: Any) -> Served:
        served.append(Served(*given))
        return served[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spacerobot_ros.nodes.viewer.node.start_server", serve)
        viewer = harness.make(ViewerNode, {"port": 0, **parameters}, namespace=namespace)
    return viewer, served[0]


def said_on(page: Server) -> str:
    found = (each.content for each in page.gui.elements if each.kind == "add_html")
    return unescape(" | ".join(found))


def test_a_viewer_shows_the_stack_and_sends_what_its_users_want(harness: Harness) -> None:
    stack = Stack(harness)
    stack.until(lambda: "No state received yet" in stack.said(), "the page says so")
    stack.press("Fly")
    stack.until(lambda: "no goal to send" in stack.said(), "nothing is sent")
    stack.describe()
    stack.until(lambda: stack.robot is not None, "the robot")

    def drawn() -> Element:
        assert stack.robot is not None
        return stack.robot

    def moved() -> bool:
        stack.move(0.25)
        return bool(stack.placed and drawn().visible)

    stack.until(moved, "the robot is where it is")
    assert drawn().position[0] == 0.25
    stack.until(lambda: "running" in stack.said(), "its status")
    assert stack.probe.count("/goal_pose") == 0, "opening the page sends nothing"
    # A goal by the gizmo, one by the fields, and none that is no pose.
    stack.drag(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    stack.press("Fly")
    stack.until(lambda: stack.probe.count("/goal_pose") == 1, "a goal")
    p = stack.probe.last("/goal_pose").pose.position
    assert (p.x, p.y, p.z) == (1.0, 2.0, 3.0)
    stack.drag(np.array([np.nan, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    stack.press("Goal (m)", (float("nan"), 0.0, 0.0))
    stack.until(lambda: "is not finite" in stack.said(), "a refusal")
    assert stack.gui.named("Goal (m)").value == (1.0, 2.0, 3.0)
    stack.press("Goal (m)", (0.5, 0.0, 0.0))
    stack.press("Fly")
    stack.until(lambda: stack.probe.count("/goal_pose") == 2, "another goal")
    assert stack.probe.last("/goal_pose").pose.position.x == 0.5
    stamps = [m.header.stamp for m in stack.probe.messages["/goal_pose"]]
    assert len({(each.sec, each.nanosec) for each in stamps}) == 2, "statuses name them by it"
    # Services and faults.
    for label, service in (
        ("Stop all", "/robot/abort"),
        ("Rearm", "/robot/rearm"),
        ("Reset", "/robot/reset"),
    ):
        stack.choose(label)
        stack.until(lambda service=service: service in stack.called, service)
    for label in ("Pause", "Resume"):
        stack.choose(label)
    stack.until(lambda: len(stack.called) == 5, "both")
    assert stack.called[3:] == ["/robot/pause True", "/robot/pause False"]
    stack.until(lambda: "Done: /robot/pause." in stack.said(), "its answer")
    stack.choose("Abort goal")
    stack.until(
        lambda: "No planner or controller offers the service 'abort' now." in stack.said(), "nobody"
    )
    stack.press("Clear faults")
    stack.until(lambda: stack.probe.count("/fault_injection") == 1, "clear")
    assert stack.probe.last("/fault_injection").data == "clear"
    stack.press("Inject")
    stack.until(lambda: "The fault '- -' is refused" in stack.said(), "no fault is known yet")


def test_the_page_is_as_its_parameters_say(harness: Harness) -> None:
    stack = Stack(
        harness, port=4321, update_rate=40.0, dark=True, world_frame="orbit", check_goals=False
    )
    assert stack.viewer.url == "http://127.0.0.1:4321/"
    assert [theme["dark_mode"] for theme in stack.gui.themes] == [True]
    assert "drawn 40 times a second" in stack.viewer.start_message()
    assert 25_000_000 in {timer.timer_period_ns for timer in stack.viewer.timers}
    stack.describe()
    stack.until(lambda: stack.move(0.25) or stack.placed, "a goal is shown")
    stack.drag(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    stack.press("Fly")
    stack.until(lambda: stack.probe.count("/goal_pose") == 1, "a goal")
    assert stack.probe.last("/goal_pose").header.frame_id == "orbit"
    stack.until(lambda: "check_goals" in stack.said(), "why it is not checked")


def test_a_goal_has_the_joint_positions_that_the_page_shows(harness: Harness) -> None:
    stack = Stack(harness)
    shapes: list[JointState] = []
    stack.probe.create_subscription(JointState, "/goal_joint_states", shapes.append, 10)
    planner = stack.probe.create_publisher(DiagnosticStatus, "/planner/status", LATCHED)
    idle = PlannerStatus(PlannerState.IDLE, "Waiting for a goal pose.")
    planner.publish(status(idle.to_values(), idle.message, "/planner"))
    harness.connect()
    stack.describe()
    ends, fields = stack.gui.named("Final joint positions"), stack.gui.named("At the end")

    def fly(count: int) -> None:
        stack.press("Fly")
        stack.until(lambda: stack.probe.count("/goal_pose") == count, "a goal")

    stack.until(lambda: stack.move(0.0) or ends.visible, "a planner is there")
    stack.until(lambda: stack.move(0.0) or stack.placed, "a goal is shown")
    # Somebody may have had an earlier goal end in joint positions, which the page does not show.
    fly(1)
    stack.until(lambda: len(shapes) == 1, "any")
    assert list(shapes[0].name) == []
    ends.use(stack.page, True)
    stack.until(lambda: fields.visible, "the fields")
    (second,) = (each for each in stack.gui.elements if each.shown.get("hint") == SLIDERS[1])
    second.use(stack.page, -0.25)
    fly(2)
    stack.until(lambda: len(shapes) == 2, "its shape")
    assert list(shapes[1].name) == list(SLIDERS)
    assert list(shapes[1].position) == [0.0, -0.25, 0.0]
    ends.use(stack.page, False)
    stack.until(lambda: not fields.visible, "no fields")
    fly(3)
    stack.until(lambda: len(shapes) == 3, "any again")
    assert list(shapes[2].name) == []


@pytest.mark.slow
def test_a_viewer_survives_what_is_wrong(clock: Clock, harness: Harness) -> None:
    stack = Stack(harness)
    stack.describe("<robot name='broken'><link")
    stack.until(lambda: "robot_description:" in stack.said(), "a refusal")
    assert stack.robot is None
    stack.describe()
    stack.until(lambda: stack.robot is not None, "the robot")
    stack.until(lambda: stack.move(0.1) or stack.placed, "its state")
    # Numbers and messages that are none.
    strange = Odometry()
    strange.pose.pose.position.x = float("nan")
    stack.odom.publish(strange)
    stack.odom.publish(Odometry())  # No attitude.
    stack.joints.publish(JointState(name=["other"], position=[1.0]))
    stack.joints.publish(JointState(name=list(SLIDERS), position=[float("inf")] * 3))
    stack.momentum.publish(Float64MultiArray(data=[1.0]))
    stack.momentum.publish(Float64MultiArray(data=[float("nan")] * 7))
    stack.status.publish(DiagnosticStatus(name="/robot"))
    stack.until(lambda: stack.move(0.2) or stack.at == 0.2, "the next state")
    # Another robot comes in its place; its joints are others.
    before = stack.robot
    stack.describe(ARM.urdf)
    stack.until(lambda: stack.robot not in (before, None), "another robot")
    assert not stack.placed
    stack.until(lambda: stack.move(0.3, ARM.joint_names) or stack.placed, "its state")
    stack.drag(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    # Time goes by.
    clock.ahead += 5.0
    stack.until(lambda: "No state for 5 s." in stack.said(), "silence is said")
    stack.until(
        lambda: stack.move(0.4, ARM.joint_names) or "No state" not in stack.said(), "and its end"
    )
    assert stack.viewer.is_active


def test_a_foreign_robot_goes_with_its_plant(clock: Clock, harness: Harness) -> None:
    stack = Stack(harness)
    stack.describe()
    stack.until(lambda: stack.robot is not None, "the robot")
    own = stack.robot
    stranger = harness.probe({}, name="stranger")
    described = stranger.create_publisher(String, "/robot_description", LATCHED)
    told = stranger.create_publisher(DiagnosticStatus, "/plant/status", LATCHED)
    harness.matched(described)
    harness.matched(told)
    described.publish(String(data=ARM.urdf))
    stack.until(lambda: stack.robot not in (own, None), "the foreign robot")
    ended = PlantStatus(PlantState.INACTIVE, "It has ended.")
    told.publish(status(ended.to_values(), ended.message, "/stranger"))
    stack.until(lambda: "It has ended." in stack.said(), "its status")
    foreign = stack.robot
    harness.remove(stranger)
    stack.until(lambda: stack.robot not in (foreign, None), "the own robot again")
    stack.until(lambda: "A command is active." in stack.said(), "its plant's status")
    stack.until(lambda: stack.move(0.1) or stack.placed, "its state")


def test_a_replay_has_a_time_line(harness: Harness) -> None:
    stack = Stack(harness)
    told = stack.probe.create_publisher(DiagnosticStatus, "/replay/status", LATCHED)
    harness.matched(told)

    def tell(position: float) -> bool:
        replay = ReplayStatus(position, 20.0, state="playing", rate=1.0)
        told.publish(status(replay.to_values(), name="/replay"))
        return False

    slider = stack.gui.named("Time (s)")
    stack.until(lambda: tell(4.0) or slider.value == 4.0, "where it is")
    assert (slider.min, slider.max) == (0.0, 20.0)
    folders = (each for each in stack.gui.elements if each.kind == "add_folder")
    assert [each.visible for each in folders if each.label == "Replay"] == [True]
    hidden = [not stack.gui.named(label).visible for label in ("Fly", "Inject", "Value")]
    assert all(hidden), "a recording takes no goals and no faults"
    texts = (each for each in stack.gui.elements if each.kind == "add_html" and each.visible)
    assert any("A recording does not accept goals." in each.content for each in texts)
    slider.use(stack.page, 7.5)
    stack.until(lambda: stack.probe.count("/replay/seek") == 1, "the jump")
    assert stack.probe.last("/replay/seek").data == 7.5
    tell(4.1)
    harness.settle(stack.probe)
    assert slider.value == 7.5, "it does not fight the user's hand"
    stack.choose("Hold")
    stack.until(
        lambda: "No replay offers the service 'pause' now." in stack.said(), "nobody is there"
    )


def test_the_parameters_of_a_plant_decide_on_its_faults(harness: Harness) -> None:
    plant = harness.add(Node("robot", context=harness.context))
    plant.declare_parameter("actuation", "effort")
    plant.declare_parameter("thrusters", "")
    stack = Stack(harness)
    stack.describe()
    fault, value = stack.gui.named("Fault"), stack.gui.named("Value")
    stack.until(lambda: "thruster_off" in fault.options, "faults of the plant")
    assert "nozzle_open" not in fault.options
    plant.set_parameters([Parameter("thrusters", value="none.yaml")])
    stack.until(lambda: "none.yaml" in stack.said(), "what is wrong with it")
    fault.use(stack.page, "joint_slow")
    stack.until(lambda: value.visible, "its factor")
    value.value = float("nan")
    stack.press("Inject")
    stack.until(lambda: "not a finite number" in stack.said(), "a refusal")
    value.value = 0.5
    stack.press("Inject")
    stack.until(lambda: stack.probe.count("/fault_injection") == 1, "a fault")
    assert stack.probe.last("/fault_injection").data.split()[0] == "joint_slow"


def test_an_address_that_others_reach_is_warned_of_and_a_wrong_one_is_refused(
    harness: Harness, capfd: pytest.CaptureFixture[str]
) -> None:
    def node(host: str) -> ViewerNode:
        overrides = [Parameter("host", value=host), Parameter("port", value=0)]
        return ViewerNode(context=harness.context, parameter_overrides=overrides)

    with pytest.raises(SpaceRobotError, match=r"no\.such\.host\.invalid"):
        node("no.such.host.invalid")
    harness.add(node("0.0.0.0"))
    said = capfd.readouterr()
    assert "anyone who can reach this address can steer the robot" in said.err
    assert said.out.startswith("viewer      http://127.0.0.1:")


def test_a_robot_that_changes_after_a_check_is_shown(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    cancelled: list[bool] = []
    answers = [GoalCheck(Verdict.REACHABLE, "Reachable in 1 s.", shape=np.zeros(3))]

    class Checker(GoalChecker):
        """Answers what the test says, and asks no process."""

        def ask(self, question: GoalQuestion) -> None:
            pass

        def cancel(self) -> bool:
            cancelled.append(True)
            return False

        def latest_answer(self) -> GoalCheck | None:
            return answers[0] if answers else None

    monkeypatch.setattr("spacerobot_ros.nodes.viewer.node.GoalChecker", Checker)
    stack = Stack(harness)
    stack.describe()
    stack.until(lambda: stack.move(0.1) or "Reachable in 1 s." in stack.said(), "a check")
    # A plan for the robot of before is not to be answered any more.
    answers.clear()
    cancelled.clear()
    servicer = load_robot(robot_file("servicer"))
    stack.describe(servicer.urdf)
    stack.until(lambda: not stack.placed, "its scene is empty")
    assert cancelled
    stack.until(lambda: stack.move(0.3, servicer.joint_names) or stack.placed, "its state")
    stack.until(lambda: stack.move(0.4, servicer.joint_names) or stack.at == 0.4, "and the next")
    assert stack.viewer.is_active


def test_the_log_has_the_warnings_of_its_own_stack(harness: Harness) -> None:
    pages = [viewer_of(harness, namespace=namespace)[1] for namespace in ("/a/b", "")]
    probe = harness.probe({})
    log = harness.matched(probe.create_publisher(RosoutLog, "/rosout", 10), 2)
    for name in ("a.b.planner", "a.bc.planner", "other.planner"):
        log.publish(RosoutLog(level=30, name=name, msg=f"{name} warns."))
    harness.spin_until(lambda: "other.planner warns." in said_on(pages[1]), "the last warning")
    harness.spin_until(lambda: "a.b.planner warns." in said_on(pages[0]), "that of its stack")
    logs = [re.findall(r"\S+(?= warns\.)", said_on(page).replace(">", " ")) for page in pages]
    assert logs == [["a.b.planner"], ["other.planner", "a.bc.planner", "a.b.planner"]]


def test_a_commander_that_is_busy_is_waited_for(clock: Clock, harness: Harness) -> None:
    stack = Stack(harness)
    heart = stack.probe.create_publisher(DiagnosticStatus, "/heartbeat", 20)
    harness.connect()
    stack.describe()
    stack.until(lambda: stack.move(0.0) or stack.placed, "a goal is shown")
    stack.press("Fly")
    stack.until(lambda: "Goal sent." in stack.said(), "it is sent")

    def beat(pulse: HeartbeatState) -> None:
        role = Role.COMMANDER.value
        heart.publish(DiagnosticStatus(name="/x", message=pulse.value, hardware_id=role))
        harness.settle(stack.probe)

    def is_missed(seconds: float) -> bool:
        """Whether an answer is missed after a time."""
        clock.ahead += seconds
        stack.draw()
        clock.ahead += 0.5  # The log is drawn twice a second.
        stack.draw()
        return "responded to the goal: send it again." in stack.said()

    beat(HeartbeatState.BUSY)
    stack.draw()
    assert not is_missed(30.0)
    beat(HeartbeatState.ACTIVE)
    stack.report(PlantState.PAUSED, "Time stands still.")
    stack.until(lambda: "Time stands still." in stack.said(), "it is paused")
    assert not is_missed(5.5)
    assert not is_missed(5.5)
    stack.report(PlantState.RUNNING, "It goes on.")
    stack.until(lambda: "It goes on." in stack.said(), "it runs")
    assert not is_missed(0.0), "it may just have planned"
    assert is_missed(6.0)
