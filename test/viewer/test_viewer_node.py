"""The viewer node beside a plant and without one: what it shows, sends, and gives up."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log as RosoutLog
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
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
from spacerobot_ros.viewer.reachability import GoalCheck, Verdict, make_question
from spacerobot_ros.viewer.state import Measured, StackState

URDF = load_robot(robot_file("sliding_masses")).urdf
GOAL = Goal.checked([1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
HERE = Measured(0.0, np.eye(7)[6], *np.zeros((3, 3)))
ARM = load_robot(robot_file("three_joint_arm"))


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
        overrides = {"port": 0, "update_rate": 60.0, **parameters}
        self.viewer = harness.add(
            ViewerNode(
                context=harness.context,
                parameter_overrides=[Parameter(k, value=v) for k, v in overrides.items()],
            )
        )
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
        plant = PlantStatus(PlantState.RUNNING, "A command is active.")
        values = [KeyValue(key=k, value=v) for k, v in plant.to_values().items()]
        self.status.publish(DiagnosticStatus(name="/robot", values=values, message=plant.message))

    def move(self, x: float, names: tuple[str, ...]) -> bool:
        odom = Odometry()
        odom.pose.pose.position.x = x
        odom.pose.pose.orientation.w = 1.0
        self.odom.publish(odom)
        zeros = [0.0] * len(names)
        self.joints.publish(
            JointState(name=list(names), position=zeros, velocity=zeros, effort=zeros)
        )
        return False

    @property
    def page(self) -> Any:
        return self.viewer._page

    def head(self) -> str:
        return str(self.page._status.content)

    def log(self) -> str:
        return " | ".join(notice.message for notice in self.page._log._notices)

    def until(self, predicate: Any, what: str) -> None:
        self.harness.spin_until(predicate, what)

    def press(self, handle: Any, value: str | float | None = None) -> None:
        """Do what a click in a browser does: call what waits for it, in the page's loop."""
        if value is not None:
            handle._impl.value = value
        event = type("Event", (), {"target": handle, "client": object(), "client_id": 0})()
        for callback in handle._impl.update_cb:
            asyncio.run_coroutine_threadsafe(
                callback(event), self.viewer._server.get_event_loop()
            ).result(10)

    def drag(self, pose: np.ndarray) -> None:
        """Move the gizmo of the base as a browser does."""
        gizmo = self.page.editor._gizmos["/goal"]
        target = type("Target", (), {"position": pose[:3], "wxyz": pose[[6, 3, 4, 5]]})()
        event = type("Event", (), {"target": target, "phase": "update", "client": object()})()
        for callback in gizmo._impl_aux.update_cb:
            asyncio.run_coroutine_threadsafe(
                callback(event), self.viewer._server.get_event_loop()
            ).result(10)


def names_of(urdf_robot: Any) -> tuple[str, ...]:
    return tuple(urdf_robot.joint_names)


def test_a_viewer_shows_the_stack_and_sends_what_its_users_want(harness: Harness) -> None:
    stack = Stack(harness)
    page = stack.page
    stack.until(lambda: "No state received yet" in stack.head(), "the page says so")
    stack.press(page._buttons._fly)
    stack.until(lambda: "no goal to send" in stack.log(), "nothing is sent")
    stack.describe()
    stack.until(lambda: page._drawing is not None, "the robot")
    names = names_of(load_robot(robot_file("sliding_masses")))

    def moved() -> bool:
        stack.move(0.25, names)
        return bool(page.editor.placed and page._drawing.base.visible)

    stack.until(moved, "the robot is where it is")
    assert page._drawing.base.position[0] == 0.25
    stack.until(lambda: "running" in stack.head(), "its status")
    assert stack.probe.count("/goal_pose") == 0, "opening the page sends nothing"
    # A goal by the gizmo, one by the fields, and none that is no pose.
    stack.drag(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    stack.press(page._buttons._fly)
    stack.until(lambda: stack.probe.count("/goal_pose") == 1, "a goal")
    p = stack.probe.last("/goal_pose").pose.position
    assert (p.x, p.y, p.z) == (1.0, 2.0, 3.0)
    stack.drag(np.array([np.nan, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    page.editor._position._impl.value = (float("nan"), 0.0, 0.0)
    stack.press(page.editor._position)
    stack.until(lambda: "is not finite" in stack.log(), "a refusal")
    assert page.editor._position.value == (1.0, 2.0, 3.0)
    page.editor._position._impl.value = (0.5, 0.0, 0.0)
    stack.press(page.editor._position)
    stack.press(page._buttons._fly)
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
        stack.press(page._buttons._plant, label)
        stack.until(lambda service=service: service in stack.called, service)
    for label in ("Pause", "Resume"):
        stack.press(page._buttons._time, label)
    stack.until(lambda: len(stack.called) == 5, "both")
    assert stack.called[3:] == ["/robot/pause True", "/robot/pause False"]
    stack.until(lambda: "Done: /robot/pause." in stack.log(), "its answer")
    stack.press(page._buttons._goal, "Abort goal")
    stack.until(
        lambda: "No planner or controller offers the service 'abort' now." in stack.log(), "nobody"
    )
    stack.press(page.faults._clear)
    stack.until(lambda: stack.probe.count("/fault_injection") == 1, "clear")
    assert stack.probe.last("/fault_injection").data == "clear"
    stack.press(page.faults._inject)
    stack.until(lambda: "The fault '- -' is refused" in stack.log(), "no fault is known yet")


def test_the_page_is_as_its_parameters_say(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    themes: list[bool] = []
    monkeypatch.setattr(
        viser.GuiApi, "configure_theme", lambda _, dark_mode, **__: themes.append(dark_mode)
    )
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    stack = Stack(
        harness, port=port, update_rate=40.0, dark=True, world_frame="orbit", check_goals=False
    )
    assert stack.viewer.url == f"http://127.0.0.1:{port}/"
    assert themes == [True]
    assert "drawn 40 times a second" in stack.viewer.start_message()
    assert 25_000_000 in {timer.timer_period_ns for timer in stack.viewer.timers}
    page, names = stack.page, names_of(load_robot(robot_file("sliding_masses")))
    stack.describe()
    stack.until(lambda: stack.move(0.25, names) or page.editor.placed, "a goal is shown")
    stack.drag(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    stack.press(page._buttons._fly)
    stack.until(lambda: stack.probe.count("/goal_pose") == 1, "a goal")
    assert stack.probe.last("/goal_pose").header.frame_id == "orbit"
    stack.until(lambda: "check_goals" in page.editor._verdict.content, "why it is not checked")


def test_a_goal_has_the_joint_positions_that_the_page_shows(harness: Harness) -> None:
    stack = Stack(harness)
    names = names_of(load_robot(robot_file("sliding_masses")))
    shapes: list[JointState] = []
    stack.probe.create_subscription(JointState, "/goal_joint_states", shapes.append, 10)
    planner = stack.probe.create_publisher(DiagnosticStatus, "/planner/status", LATCHED)
    status = PlannerStatus(PlannerState.IDLE, "Waiting for a goal pose.")
    values = [KeyValue(key=k, value=v) for k, v in status.to_values().items()]
    planner.publish(DiagnosticStatus(name="/planner", values=values, message=status.message))
    harness.connect()
    stack.describe()
    final = stack.page.editor._final

    def fly(count: int) -> None:
        stack.press(stack.page._buttons._fly)
        stack.until(lambda: stack.probe.count("/goal_pose") == count, "a goal")

    stack.until(lambda: stack.move(0.0, names) or final._enabled.visible, "a planner is there")
    stack.until(lambda: stack.move(0.0, names) or stack.page.editor.placed, "a goal is shown")
    # Somebody may have had an earlier goal end in joint positions, which the page does not show.
    fly(1)
    stack.until(lambda: len(shapes) == 1, "any")
    assert list(shapes[0].name) == []
    stack.press(final._enabled, True)
    stack.until(lambda: final._folder.visible, "the fields")
    stack.press(final._fields[1], -0.25)
    fly(2)
    stack.until(lambda: len(shapes) == 2, "its shape")
    assert list(shapes[1].name) == list(names)
    assert list(shapes[1].position) == [0.0, -0.25, 0.0]
    stack.press(final._enabled, False)
    stack.until(lambda: not final._folder.visible, "no fields")
    fly(3)
    stack.until(lambda: len(shapes) == 3, "any again")
    assert list(shapes[2].name) == []


@pytest.mark.slow
def test_a_viewer_survives_what_is_wrong(harness: Harness) -> None:
    stack = Stack(harness)
    page = stack.page
    stack.describe("<robot name='broken'><link")
    stack.until(lambda: "robot_description:" in stack.log(), "a refusal")
    assert page._drawing is None
    sliders = names_of(load_robot(robot_file("sliding_masses")))
    stack.describe()
    stack.until(lambda: page._drawing is not None, "the robot")
    stack.until(lambda: stack.move(0.1, sliders) or page.editor.placed, "its state")
    # Numbers and messages that are none.
    strange = Odometry()
    strange.pose.pose.position.x = float("nan")
    stack.odom.publish(strange)
    stack.odom.publish(Odometry())  # No attitude.
    stack.joints.publish(JointState(name=["other"], position=[1.0]))
    stack.joints.publish(JointState(name=list(sliders), position=[float("inf")] * 3))
    stack.momentum.publish(Float64MultiArray(data=[1.0]))
    stack.momentum.publish(Float64MultiArray(data=[float("nan")] * 7))
    stack.status.publish(DiagnosticStatus(name="/robot"))
    stack.until(lambda: stack.move(0.2, sliders) or page._last.pose[0] == 0.2, "the next state")
    # Another robot comes in its place; its joints are others.
    before = page._drawing
    stack.describe(ARM.urdf)
    stack.until(lambda: page._drawing is not before, "another robot")
    assert not page.editor.placed
    arm = names_of(ARM)
    stack.until(lambda: stack.move(0.3, arm) or page.editor.placed, "its state")
    stack.drag(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    # Time goes by.
    stack.viewer._listener._came_at -= 5.0
    stack.until(lambda: "No state for 5 s." in stack.head(), "silence is said")
    stack.until(lambda: stack.move(0.4, arm) or "No state" not in stack.head(), "and its end")
    assert stack.viewer.is_active


def test_a_replay_has_a_time_line(harness: Harness) -> None:
    stack = Stack(harness)
    page = stack.page
    status = stack.probe.create_publisher(DiagnosticStatus, "/replay/status", LATCHED)
    harness.matched(status)

    def tell(position: float) -> bool:
        replay = ReplayStatus(position, 20.0, paused=False, ended=False, rate=1.0)
        values = [KeyValue(key=k, value=v) for k, v in replay.to_values().items()]
        status.publish(DiagnosticStatus(name="/replay", values=values))
        return False

    stack.until(lambda: tell(4.0) or page._time_line._slider is not None, "the time line")
    line = page._time_line
    stack.until(lambda: line._slider.value == 4.0, "where it is")
    assert (line._slider.min, line._slider.max) == (0.0, 20.0)
    assert line._folder.visible
    assert not page._buttons._fly.visible, "a recording takes no goals"
    assert page.editor._none_taken.visible
    assert not any(h.visible for h in (page.faults._inject, page.faults._value))
    stack.press(line._slider, 7.5)
    stack.until(lambda: stack.probe.count("/replay/seek") == 1, "the jump")
    assert stack.probe.last("/replay/seek").data == 7.5
    tell(4.1)
    harness.settle(stack.probe)
    assert line._slider.value == 7.5, "it does not fight the user's hand"
    stack.press(line._buttons, "Hold")
    stack.until(
        lambda: "No replay offers the service 'pause' now." in stack.log(), "nobody is there"
    )


def test_the_parameters_of_a_plant_decide_on_its_faults(harness: Harness) -> None:
    stack = Stack(harness)
    stack.describe()
    stack.until(lambda: stack.page._drawing is not None, "the robot")
    values = {"actuation": json.dumps("effort"), "thrusters": json.dumps("")}
    stack.viewer._remote_values["plant"] = values
    stack.viewer._show_plant()
    kinds = stack.page.faults._kind.options
    assert "thruster_off" in kinds
    assert "nozzle_open" not in kinds
    stack.viewer._remote_values["plant"] = {**values, "thrusters": json.dumps("none.yaml")}
    stack.viewer._show_plant()
    stack.until(lambda: "none.yaml" in stack.log(), "what is wrong with it")
    stack.page.faults._kind._impl.value = "joint_slow"
    stack.press(stack.page.faults._kind)
    stack.until(lambda: stack.page.faults._value.visible, "its factor")
    stack.page.faults._value._impl.value = float("nan")
    stack.press(stack.page.faults._inject)
    stack.until(lambda: "not a finite number" in stack.log(), "a refusal")
    stack.page.faults._value._impl.value = 0.5
    stack.press(stack.page.faults._inject)
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
    stack = Stack(harness)
    page, sliders = stack.page, names_of(load_robot(robot_file("sliding_masses")))
    stack.describe()
    stack.until(lambda: stack.move(0.1, sliders) or page.editor.placed, "a goal")
    page.editor.show_check(GoalCheck(Verdict.REACHABLE, "Reachable in 1 s.", shape=np.zeros(3)))
    # A plan for the robot of before is not to be answered any more.
    cancelled: list[bool] = []

    def cancel() -> bool:
        cancelled.append(True)
        return False

    monkeypatch.setattr(stack.viewer._checker, "cancel", cancel)
    stack.describe(load_robot(robot_file("servicer")).urdf)
    servicer = names_of(load_robot(robot_file("servicer")))
    stack.until(lambda: not page.editor.placed, "its scene is empty")
    assert cancelled
    stack.until(lambda: stack.move(0.3, servicer) or page.editor.placed, "its state")
    stack.until(lambda: stack.move(0.4, servicer) or page._last.pose[0] == 0.4, "and the next")
    assert stack.viewer.is_active


def test_nodes_that_are_gone_are_shown_no_longer(harness: Harness) -> None:
    stack = Stack(harness)
    listener = stack.viewer._listener
    create = stack.probe.create_publisher
    planner = create(DiagnosticStatus, "/planner/status", LATCHED)
    replay = create(DiagnosticStatus, "/replay/status", LATCHED)
    heart = create(DiagnosticStatus, "/heartbeat", 20)
    harness.connect()
    stack.describe()
    stack.until(lambda: stack.viewer._robot is not None, "a robot")

    def beat(name: str, pulse: HeartbeatState, role: Role | None) -> None:
        hardware = "" if role is None else role.value
        heart.publish(DiagnosticStatus(name=name, message=pulse.value, hardware_id=hardware))

    def pass_time(seconds: float) -> None:
        """Have the last heartbeats be so much older."""
        listener._beats = {n: replace(b, at=b.at - seconds) for n, b in listener._beats.items()}

    def look() -> StackState:
        harness.settle(stack.probe)
        return listener.state()

    idle = PlannerStatus(PlannerState.IDLE)
    values = [KeyValue(key=k, value=v) for k, v in idle.to_values().items()]
    planner.publish(DiagnosticStatus(name="/planner", values=values))
    stack.until(lambda: listener.state().planner is not None, "a planner")
    beat("/planner", HeartbeatState.ACTIVE, Role.COMMANDER)
    beat("/other_viewer", HeartbeatState.INACTIVE, None)
    assert "/planner" not in look().silent
    assert look().inactive == (), "viewers come and go"
    pass_time(10.0)
    assert look().silent["/planner"] >= 10.0
    assert look().absent == {"planner"}
    seen = replace(look(), measured=HERE)
    answer = make_question(seen, {"base": GOAL}, load_robot(robot_file("sliding_masses")), {})
    assert answer == "The planner is offline."
    assert look().planner == idle, "it may come back"
    pass_time(60.0)
    assert look().planner is None
    assert "/planner" not in look().silent
    beat("/planner", HeartbeatState.ACTIVE, Role.COMMANDER)
    assert look().planner == idle, "it had only stood still"
    assert look().absent == frozenset()
    beat("/planner", HeartbeatState.INACTIVE, Role.COMMANDER)
    assert look().inactive == ("/planner",)
    assert look().absent == {"planner"}
    beat("/planner", HeartbeatState.BUSY, Role.COMMANDER)
    pass_time(1000.0)
    assert look().planner == idle, "it plans"
    beat("/planner", HeartbeatState.ACTIVE, Role.COMMANDER)
    look()
    listener._last_call -= 1000.0
    pass_time(1000.0)
    assert look().planner == idle, "the viewer had stood still"

    # A replay shows what nodes reported that are not there; then a plant begins.
    status = ReplayStatus(1.0, 2.0, paused=True, ended=False, rate=1.0)
    values = [KeyValue(key=k, value=v) for k, v in status.to_values().items()]
    replay.publish(DiagnosticStatus(name="/replay", values=values))
    stack.until(lambda: listener.state().replay is not None, "a replay")
    beat("/replay", HeartbeatState.ACTIVE, Role.REPLAY)
    beat("/live_plant", HeartbeatState.ACTIVE, Role.PLANT)
    assert look().replay == status
    assert look().plant is not None
    beat("/replay", HeartbeatState.INACTIVE, Role.REPLAY)
    assert look().replay is None
    assert look().plant is None, "it was recorded"
    assert look().planner == idle
    beat("/replay", HeartbeatState.ACTIVE, Role.REPLAY)
    assert look().replay == status


def test_the_log_has_the_warnings_of_its_own_stack(harness: Harness) -> None:
    viewers = [
        harness.add(
            ViewerNode(
                context=harness.context,
                namespace=namespace,
                parameter_overrides=[Parameter("port", value=0)],
            )
        )
        for namespace in ("/a/b", "")
    ]
    for viewer in viewers:
        for name in ("a.b.planner", "a.bc.planner", "other.planner"):
            viewer._on_log(RosoutLog(level=30, name=name, msg=f"{name} warns."))
    logs = [[notice.source for notice in each._page._log._notices] for each in viewers]
    assert logs == [["a.b.planner"], ["other.planner", "a.bc.planner", "a.b.planner"]]


def test_a_commander_that_is_busy_is_waited_for(harness: Harness) -> None:
    stack = Stack(harness)
    viewer, state = stack.viewer, StackState()
    viewer._unanswered_goal = "7.000000001", 100.0
    viewer._send_goals(replace(state, busy=True), 99.0)
    viewer._send_goals(replace(state, busy=True), 130.0)
    paused = PlantStatus(PlantState.PAUSED, "Time stands still.")
    viewer._send_goals(replace(state, plant=paused), 131.0)
    viewer._send_goals(replace(state, plant=paused), 136.5)
    viewer._send_goals(state, 137.0)
    assert "answered" not in stack.log(), "it may just have planned"
    viewer._send_goals(state, 142.0)
    assert "No planner or controller has responded to the goal: send it again." in stack.log()
    # Heartbeats of a plant that is busy are of no commander.
    heart = stack.probe.create_publisher(DiagnosticStatus, "/heartbeat", 20)
    harness.connect()
    for role in (Role.PLANT, Role.COMMANDER):
        beat = DiagnosticStatus(
            name="/x", message=HeartbeatState.BUSY.value, hardware_id=role.value
        )
        heart.publish(beat)
        harness.settle(stack.probe)
        assert viewer._listener.state().busy is (role is Role.COMMANDER)


def test_momenta_are_compared_with_those_of_their_tick(harness: Harness) -> None:
    stack = Stack(harness)
    listener: Any = stack.viewer._listener
    expected = stack.probe.create_publisher(Float64MultiArray, "/momentum_expected", 10)
    harness.connect()
    sent: dict[str, list[tuple[int, float]]] = {"momentum": [], "expected": []}

    class Topic:
        """Gives the messages that a test has put in, at the time that it says they were sent."""

        def __init__(self, name: str) -> None:
            self.name, self.sent_ns = name, 0

        def take(self) -> Float64MultiArray | None:
            if not sent[self.name]:
                return None
            self.sent_ns, value = sent[self.name].pop(0)
            return Float64MultiArray(data=[value] * 7)

    stack.momentum.publish(Float64MultiArray(data=[0.5] * 7))
    expected.publish(Float64MultiArray(data=[0.5] * 6))
    harness.settle(stack.probe)
    before = time.time_ns()
    listener.state()
    assert 0 < before - listener._expected.sent_ns < 60 * 10**9, "when they were published"
    assert listener._expected.sent_ns > listener._momentum.sent_ns
    listener._momentum, listener._expected = Topic("momentum"), Topic("expected")

    def pair() -> tuple[float, float | None]:
        momenta = listener.state().momenta
        assert momenta is not None
        should_be = momenta.expected
        return float(momenta.actual[0]), None if should_be is None else float(should_be[0])

    sent |= {"momentum": [(1000, 1.0)], "expected": [(1001, 1.0)]}
    assert pair() == (1.0, 1.0)
    # The next tick is published while this one is taken: its second part comes in time, or not.
    sent |= {"momentum": [(2000, 2.0)], "expected": [(1002, 1.0), (2001, 2.0)]}
    assert pair() == (2.0, 2.0)
    sent |= {"momentum": [(3000, 3.0)], "expected": []}
    assert pair() == (2.0, 2.0)
    sent |= {"momentum": [(4000, 4.0)], "expected": [(4001, 4.0)]}
    assert pair() == (4.0, 4.0)
    # Or the first part is not delivered yet when the second is: ticks are milliseconds apart.
    sent |= {"momentum": [(10_005_000, 5.0)], "expected": [(20_005_001, 6.0)]}
    assert pair() == (4.0, 4.0)
    sent |= {"momentum": [(20_005_000, 6.0)]}
    assert pair() == (6.0, 6.0)
    # Another plant has no thrusters: nothing is expected of its momenta.
    sent |= {"momentum": [(10**10, 5.0)]}
    assert pair() == (5.0, None)
