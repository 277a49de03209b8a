"""The viewer's view of a stack, from messages that are handed to it, at wall times of the test."""

from __future__ import annotations

import math
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.model import load_robot
from spacerobot_ros.nodes.viewer import listener as listening
from spacerobot_ros.nodes.viewer.listener import Listener
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer.state import StackState

ROBOT = load_robot(robot_file("free_flyer"))
NAMES = ROBOT.joint_names
TURNED = [0.5, -0.1, 0.7, 0.5]
"""A quaternion of norm one."""


class Streams:
    """Streams whose last messages the test puts in; publication times are in wall ns."""

    def __init__(self) -> None:
        self.waiting: dict[str, list[tuple[int, Any]]] = defaultdict(list)

    def latest(self, node: object, kind: type[Any], topic: str) -> Any:
        stream = SimpleNamespace(sent_ns=0)

        def take() -> Any:
            if not self.waiting[topic]:
                return None
            stream.sent_ns, message = self.waiting[topic].pop(0)
            assert isinstance(message, kind)
            return message

        stream.take = take
        return stream

    def put(self, topic: str, message: Any, sent_ns: int = 0) -> None:
        self.waiting[topic].append((sent_ns, message))


class Viewed:
    """A listener, the callbacks of its node, and its wall time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *silent_after: float) -> None:
        self.now, self.streams, self.reported = 1000.0, Streams(), list[tuple[str, str]]()
        wall = SimpleNamespace(monotonic=lambda: self.now, time_ns=lambda: 77)
        monkeypatch.setattr(listening, "time", wall)
        monkeypatch.setattr(listening, "LatestMessage", self.streams.latest)
        self.heard: dict[str, Any] = {}

        def create(kind: type[Any], topic: str, callback: Any, qos: object) -> None:
            self.heard[topic] = callback

        node: Any = SimpleNamespace(create_subscription=create)
        report = lambda *words: self.reported.append(words)  # noqa: E731
        self.listener = Listener(node, node, "world", report, *silent_after)
        self.listener.use(ROBOT)

    def look(self, seconds: float = 0.0) -> StackState:
        self.now += seconds
        return self.listener.state()

    def beat(self, name: str, pulse: str = "active", role: str = "commander") -> None:
        self.heard["heartbeat"](DiagnosticStatus(name=name, message=pulse, hardware_id=role))

    def report(self, topic: str, status: Any, name: str) -> None:
        pairs = status.to_values().items()
        values = [KeyValue(key=key, value=value) for key, value in pairs]
        text = getattr(status, "message", "")
        self.heard[topic](DiagnosticStatus(name=name, message=text, values=values))


@pytest.fixture
def viewed(monkeypatch: pytest.MonkeyPatch) -> Viewed:
    return Viewed(monkeypatch)


def pose_of(x: float, y: float, z: float) -> Pose:
    turn = Quaternion(**dict(zip("xyzw", TURNED, strict=True)))
    return Pose(position=Point(x=x, y=y, z=z), orientation=turn)


def joints(order: list[int], sec: int = 3, **changed: Any) -> JointState:
    """Return joint states whose entry of the joint i is i + 0.1, 0.2, 0.3, in an order."""
    values: dict[str, Any] = {
        "name": [NAMES[i] for i in order],
        "position": [i + 0.1 for i in order],
        "velocity": [i + 0.2 for i in order],
        "effort": [i + 0.3 for i in order],
    }
    message = JointState(**(values | changed))
    message.header.stamp.sec, message.header.stamp.nanosec = sec, 250_000_000
    return message


def test_a_state_is_shown_once_pose_and_joints_are_there(viewed: Viewed) -> None:
    assert viewed.listener.time_ns() == 77
    n = len(NAMES)
    odom = Odometry()
    odom.pose.pose = pose_of(1.0, 2.0, 3.0)
    viewed.streams.put("odom", odom)
    assert viewed.look().measured is None
    order = list(reversed(range(n)))
    viewed.streams.put("joint_states", joints(order))
    state = viewed.look(0.5)
    assert state.measured is not None
    assert state.measured.time_s == 3.25
    assert viewed.listener.time_ns() == 3_250_000_000
    assert state.measured.pose.tolist() == [1.0, 2.0, 3.0, *TURNED]
    for values, first in zip(
        (state.measured.q, state.measured.qdot, state.measured.effort), (0.1, 0.2, 0.3), strict=True
    ):
        assert values == pytest.approx(first + np.arange(n)), "in the order of the description"
    assert state.age_s == 0.0
    assert viewed.look(0.25).age_s == 0.25
    # Half a state is a new one.
    odom.pose.pose = pose_of(4.0, 2.0, 3.0)
    viewed.streams.put("odom", odom)
    state = viewed.look()
    assert state.measured is not None
    assert (state.age_s, state.measured.pose[0], state.measured.time_s) == (0.0, 4.0, 3.25)
    odom.pose.pose = pose_of(math.nan, 2.0, 3.0)
    viewed.streams.put("odom", odom)
    state = viewed.look()
    assert state.measured is not None
    assert state.measured.pose[0] == 4.0
    viewed.listener.use(ROBOT)
    state = viewed.look()
    assert state.measured is None
    assert state.age_s == math.inf


@pytest.mark.parametrize(
    ("changed", "shown"),
    [
        ({"velocity": []}, (0.1, None, 0.3)),
        ({"effort": [math.nan] + [1.0] * (len(NAMES) - 1)}, (0.1, 0.2, "nan")),
        ({"position": [math.inf] * len(NAMES)}, None),
        ({"position": [0.5]}, None),
        ({"name": ["another", *NAMES[1:]]}, None),
    ],
)
def test_joint_states_that_lack_values_are_shown_as_far_as_they_go(
    viewed: Viewed, changed: dict[str, Any], shown: tuple[Any, ...] | None
) -> None:
    odom = Odometry()
    odom.pose.pose = pose_of(1.0, 2.0, 3.0)
    viewed.streams.put("odom", odom)
    viewed.streams.put("joint_states", joints(list(range(len(NAMES))), **changed))
    measured = viewed.look().measured
    if shown is None:
        assert measured is None
        return
    assert measured is not None
    numbers = np.arange(len(NAMES))
    wanted = {None: 0.0 * numbers, "nan": np.minimum(numbers, 1.0)}
    for values, first in zip((measured.q, measured.qdot, measured.effort), shown, strict=True):
        expected = wanted[first] if first in wanted else first + numbers
        assert values == pytest.approx(expected)


def test_other_streams_are_shown_as_they_come(viewed: Viewed) -> None:
    state = viewed.look()
    assert (state.tool, state.firing, state.momenta, state.planned_path) == (None,) * 4
    viewed.streams.put("end_effector_pose", PoseStamped(pose=pose_of(0.1, 0.2, 0.3)))
    viewed.streams.put("thrusters", JointState(name=["a", "b"], velocity=[0.25, 1.0]))
    state = viewed.look()
    assert state.tool is not None
    assert state.tool.tolist() == [0.1, 0.2, 0.3, *TURNED]
    assert state.firing is not None
    assert (state.firing.names, state.firing.duty.tolist()) == (("a", "b"), [0.25, 1.0])
    viewed.streams.put("thrusters", JointState(name=["a", "b"], velocity=[0.5]))
    state = viewed.look()
    assert state.firing is not None
    assert state.firing.duty.tolist() == [0.25, 1.0]


def test_the_target_is_where_its_odometry_says(viewed: Viewed) -> None:
    assert viewed.look().target is None
    odom = Odometry()
    odom.pose.pose.position = Point(x=1.5, y=-0.25, z=0.75)
    odom.pose.pose.orientation = Quaternion(x=0.5, y=-0.1, z=0.7, w=0.5)
    viewed.streams.put("target/odom", odom)
    target = viewed.look().target
    assert target is not None
    assert target.tolist() == [1.5, -0.25, 0.75, *TURNED]
    viewed.listener.use(ROBOT)
    assert viewed.look().target is None


def test_momenta_without_expected_ones_are_shown(viewed: Viewed) -> None:
    for broken in ([1.0] * 6, [1.0] * 6 + [math.nan]):
        viewed.streams.put("momentum", Float64MultiArray(data=broken))
        assert viewed.look().momenta is None
    viewed.streams.put("momentum", Float64MultiArray(data=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.5]))
    momenta = viewed.look().momenta
    assert momenta is not None
    assert (momenta.actual.tolist(), momenta.energy) == ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 7.5)
    assert momenta.expected is None


MS = 1_000_000


@pytest.mark.parametrize(
    ("sent", "shown"),
    [
        # Of one tick: right after the momenta, and 3 times as late and 0.2 ms more at most.
        ([(100.0, 100.5)], 0),
        ([(100.0, 100.5), (200.0, 201.6)], 1),
        ([(100.0, 100.5), (200.0, 201.8)], 0),
        # Those of an earlier tick are waited for, and given up after a second.
        ([(100.0, 100.5), (200.0, 199.0)], 0),
        ([(100.0, 100.5), (1200.0, 101.0)], None),
        ([(100.0, 100.5), (1100.0, 101.0)], 0),
    ],
)
def test_momenta_are_shown_with_the_expected_ones_of_their_tick(
    viewed: Viewed, sent: list[tuple[float, float]], shown: int | None
) -> None:
    for number, (actual, expected) in enumerate(sent):
        data = [float(number)] * 7
        viewed.streams.put("momentum", Float64MultiArray(data=data), round(actual * MS))
        data = [number + 0.5] * 6
        viewed.streams.put("momentum_expected", Float64MultiArray(data=data), round(expected * MS))
        momenta = viewed.look().momenta
    assert momenta is not None
    if shown is None:
        assert (momenta.actual[0], momenta.expected) == (float(len(sent) - 1), None)
    else:
        assert momenta.expected is not None
        assert (momenta.actual[0], momenta.expected.tolist()) == (shown, [shown + 0.5] * 6)


def test_statuses_are_read_by_the_kind_of_their_node(viewed: Viewed) -> None:
    pose = (0.5, 0.25, 0.125, *TURNED)
    planner = PlannerStatus(PlannerState.PLANNING, "A plan is made.", goal=pose)
    controller = ControllerStatus(ControllerState.TRACKING, "The goal is approached.")
    plant = PlantStatus(PlantState.RUNNING, "A command is in force.")
    replay = ReplayStatus(1.0, 2.0, paused=True, ended=False, rate=1.5)
    for name, status in (
        ("planner", planner),
        ("controller", controller),
        ("plant", plant),
        ("replay", replay),
    ):
        viewed.report(f"{name}/status", status, f"/{name}")
        viewed.heard[f"{name}/status"](DiagnosticStatus(name="/other", message="of another kind"))
    state = viewed.look()
    assert (state.planner, state.controller) == (planner, controller)
    assert (state.plant, state.replay) == (plant, replay)
    assert viewed.reported == [(n, f"/{n}") for n in ("planner", "controller", "plant", "replay")]
    goal = state.goals["base"]
    assert (*goal.position, *goal.quaternion) == pytest.approx(pose)
    assert state.absent == frozenset()


def test_goals_of_anyone_are_shown_until_one_is_refused(viewed: Viewed) -> None:
    for topic, x in (("goal_pose", 0.5), ("end_effector/goal_pose", 1.5)):
        message = PoseStamped(pose=pose_of(x, 2.0, 3.0))
        message.header.frame_id = "world"
        viewed.heard[topic](message)
    goals = viewed.look().goals
    assert {part: goal.position[0] for part, goal in goals.items()} == {
        "base": 0.5,
        "end_effector": 1.5,
    }
    message.header.frame_id = "elsewhere"
    viewed.heard["goal_pose"](message)
    assert list(viewed.look().goals) == ["end_effector"]


@pytest.mark.parametrize("planned_meanwhile", [False, True])
@pytest.mark.parametrize("who", ["planner", "controller"])
def test_a_goal_that_is_refused_in_flight_leaves_the_one_that_is_pursued(
    who: str, planned_meanwhile: bool, viewed: Viewed
) -> None:
    kind: Any = PlannerStatus if who == "planner" else ControllerStatus
    states: Any = PlannerState if who == "planner" else ControllerState
    flies = states.EXECUTING if who == "planner" else states.TRACKING
    given = {"ends_at_s": 9.0}

    def send(x: float, goal_id: str, state: Any, words: str) -> None:
        message = PoseStamped(pose=pose_of(x, 0.0, 0.0))
        message.header.frame_id = "world"
        viewed.heard["goal_pose"](message)
        viewed.report(f"{who}/status", kind(state, words, goal_id, **given), "/it")

    send(0.5, "1.0", flies, "Flying.")
    for x, goal_id in ((9.0, "2.0"), (8.0, "3.0")):
        if planned_meanwhile and who == "planner":
            viewed.report("planner/status", kind(states.PLANNING, "Planning.", goal_id), "/it")
        send(x, goal_id, states.REFUSED, f"{x} m is too far.")
        shown = getattr(viewed.look(), who)
        assert (shown.state, shown.goal_id, shown.ends_at_s) == (flies, "1.0", 9.0)
        assert shown.message == f"Flying. A later goal is refused: {x} m is too far."
        assert viewed.look().goals["base"].position[0] == 0.5
    viewed.report(f"{who}/status", kind(states.REACHED, "There.", "1.0"), "/it")
    send(7.0, "4.0", states.REFUSED, "Too far.")
    shown = getattr(viewed.look(), who)
    assert (shown.state, shown.message) == (states.REFUSED, "Too far.")


def test_goals_that_are_refused_one_after_the_other_leave_the_one_that_is_pursued(
    viewed: Viewed,
) -> None:
    """Both are sent before the first refusal comes."""

    def send(x: float) -> None:
        message = PoseStamped(pose=pose_of(x, 0.0, 0.0))
        message.header.frame_id = "world"
        viewed.heard["goal_pose"](message)

    def report(state: ControllerState, goal_id: str) -> None:
        status = ControllerStatus(state, "So it is.", goal_id)
        viewed.report("controller/status", status, "/it")

    send(0.5)
    report(ControllerState.TRACKING, "1.0")
    send(9.0)
    send(8.0)
    report(ControllerState.TRACKING, "1.0")
    for refused in ("2.0", "3.0"):
        report(ControllerState.REFUSED, refused)
        assert viewed.look().goals["base"].position[0] == 0.5


def test_goals_of_links_are_those_of_the_planner(viewed: Viewed) -> None:
    pose, place = (0.5, 0.25, 0.125, *TURNED), (4.0, -2.0, 1.0)

    def tell(**goals: Any) -> dict[str, Goal]:
        viewed.report("planner/status", PlannerStatus(PlannerState.PLANNING, **goals), "/planner")
        return dict(viewed.look().goals)

    tool = PoseStamped(pose=pose_of(7.0, 8.0, 9.0))
    viewed.heard["end_effector/goal_pose"](tool)
    assert set(tell(goal=pose)) == {"base", "end_effector"}
    goals = tell(end_effector_goals={"left": pose, "right": place})
    assert set(goals) == {"end_effector", "left", "right"}, "the base is free"
    aims = [goals[link].end_effectors[0] for link in ("left", "right")]
    assert [aim.values for aim in aims] == [pytest.approx(pose), place]
    assert all(not goals[link].base for link in ("left", "right"))
    assert tell() == goals, "a status without a goal"
    assert set(tell(end_effector_goals={"left": (1.0, 2.0)})) == set(goals), "no goal"
    both = tell(goal=pose, end_effector_goals={"right": pose})
    assert set(both) == {"base", "end_effector", "right"}
    assert set(tell(goal=pose)) == {"base", "end_effector"}


@pytest.mark.parametrize(
    ("count", "places"),
    [
        (1, [0]),
        (3, [0, 1, 2]),
        (1999, [*range(1999)]),
        (2000, [*range(0, 1999, 2), 1999]),
        (3001, [*range(0, 3000, 3), 3000]),
    ],
)
def test_a_long_planned_path_is_thinned_and_keeps_its_ends(
    viewed: Viewed, count: int, places: list[int]
) -> None:
    poses = [
        PoseStamped(pose=Pose(position=Point(x=float(k), y=2.0, z=-3.0))) for k in range(count)
    ]
    viewed.heard["planned_path"](Path(poses=poses))
    path = viewed.look().planned_path
    assert path is not None
    assert path.tolist() == [[k, 2.0, -3.0] for k in places]
    poses[-1].pose.position.y = math.inf
    viewed.heard["planned_path"](Path(poses=poses))
    assert viewed.look().planned_path is None


def schedule(sec: int, *order: int) -> JointTrajectory:
    """Return a schedule from ``sec`` on for 4 s; joint i moves from i to i + 4 in two steps."""
    message = JointTrajectory(joint_names=[NAMES[i] for i in order])
    message.header.stamp.sec = sec
    for time in (0, 2, 4):
        point = JointTrajectoryPoint(positions=[float(i + time) for i in order])
        point.time_from_start.sec = time
        message.points.append(point)
    return message


def planned(sec: int, *times: float) -> Path:
    """Return a path from ``sec`` on, whose poses are at times after that, at x = 10 time."""
    poses = []
    for time in times:
        pose = PoseStamped(pose=pose_of(10.0 * time, 1.0, 2.0))
        pose.header.stamp.sec = sec + int(time)
        pose.header.stamp.nanosec = round(1e9 * (time % 1))
        poses.append(pose)
    message = Path(poses=poses)
    message.header.stamp.sec = sec
    return message


@pytest.mark.parametrize("path_first", [True, False])
def test_path_and_schedule_of_one_plan_are_its_motion(viewed: Viewed, path_first: bool) -> None:
    order = range(len(NAMES))
    messages = [
        ("planned_path", planned(7, 0.0, 1.5, 4.0)),
        ("gait_schedule", schedule(7, *reversed(order))),
    ]
    for topic, message in messages if path_first else reversed(messages):
        assert viewed.look().planned_motion is None
        viewed.heard[topic](message)
    motion = viewed.look().planned_motion
    assert motion is not None
    np.testing.assert_allclose(motion[:, 0], [0.0, 15.0, 40.0])
    np.testing.assert_allclose(motion[:, 3:7], [TURNED] * 3)
    np.testing.assert_allclose(motion[:, 7:], [[i + t for i in order] for t in (0, 1.5, 4)])
    # The robot may come after both.
    viewed.listener.use(ROBOT)
    assert viewed.look().planned_motion is not None
    viewed.heard["gait_schedule"](schedule(8, *order))
    assert viewed.look().planned_motion is None, "it is of another plan"
    viewed.heard["planned_path"](planned(8, *np.linspace(0.0, 4.0, 801)))
    motion = viewed.look().planned_motion
    assert motion is not None
    assert len(motion) <= 201
    np.testing.assert_allclose(motion[-1, 7:], [i + 4.0 for i in order])


@pytest.mark.parametrize("fault", ["joints", "points", "empty", "pose"])
def test_a_plan_that_does_not_fit_has_no_motion(viewed: Viewed, fault: str) -> None:
    path, plan = planned(7, 0.0, 4.0), schedule(7, *range(len(NAMES)))
    match fault:
        case "joints":
            plan = schedule(7, 0)
        case "points":
            plan.points[1].positions = [1.0]
        case "empty":
            plan.points = []
        case "pose":
            path.poses[0].pose.orientation = Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)
    viewed.heard["gait_schedule"](plan)
    viewed.heard["planned_path"](path)
    assert viewed.look().planned_motion is None


def test_nodes_fall_silent_and_are_hidden_after_a_minute(viewed: Viewed) -> None:
    viewed.report("planner/status", PlannerStatus(PlannerState.IDLE), "/planner")
    poses = [PoseStamped(pose=pose_of(1.0, 2.0, 3.0))]
    viewed.heard["planned_path"](Path(poses=poses))
    viewed.beat("/planner")
    viewed.beat("/other_package", "resting")
    assert viewed.look(1.5).silent == {}
    state = viewed.look(0.25)
    assert dict(state.silent) == {"/planner": 1.75}
    assert state.absent == {"planner"}
    for _ in range(58):
        state = viewed.look(1.0)
    state = viewed.look(0.25)
    assert (state.silent, state.planner is None) == ({"/planner": 60.0}, False)
    state = viewed.look(0.25)
    assert (state.silent, state.planner, state.planned_path) == ({}, None, None)
    viewed.beat("/planner")
    state = viewed.look()
    assert state.planner is not None
    assert state.planned_path is not None


@pytest.mark.parametrize(
    ("silent_after", "silent"), [(0.5, {"/planner": 0.75}), (4.0, {}), (0, {})]
)
def test_nodes_fall_silent_after_the_time_that_is_given(
    silent_after: float, silent: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    viewed = Viewed(monkeypatch, silent_after)
    viewed.beat("/planner")
    assert viewed.look(0.75).silent == silent
    viewed.beat("/planner")
    for _ in range(30):
        state = viewed.look(1.0)
    assert bool(state.silent) == bool(silent_after)


def test_a_viewer_that_stood_still_excuses_the_nodes(viewed: Viewed) -> None:
    viewed.beat("/planner")
    viewed.look(1.0)
    assert viewed.look(1.5).silent == {"/planner": 2.5}, "1.5 s is no gap"
    viewed.beat("/planner")
    assert viewed.look(1.75).silent == {}
    assert viewed.look(1.25).silent == {}
    assert viewed.look(0.5).silent == {"/planner": 1.75}


def test_nodes_that_ended_in_order_are_inactive_and_busy_ones_are_awaited(viewed: Viewed) -> None:
    viewed.report("controller/status", ControllerStatus(ControllerState.HOLDING), "/arm")
    viewed.beat("/arm", "inactive")
    viewed.beat("/viewer", "inactive", "")
    state = viewed.look()
    assert (state.inactive, state.busy) == (("/arm",), False)
    assert state.absent == {"controller"}
    viewed.beat("/plant", "busy", "plant")
    assert not viewed.look().busy
    viewed.beat("/arm", "busy")
    for _ in range(70):
        state = viewed.look(1.0)
    assert (state.busy, state.silent, state.inactive) == (True, {}, ())
    assert state.controller is not None


def test_reports_of_a_replay_are_hidden_when_a_plant_runs_after_its_end(viewed: Viewed) -> None:
    status = ReplayStatus(1.0, 2.0, paused=True, ended=False, rate=1.0)
    viewed.report("replay/status", status, "/replay")
    viewed.report("planner/status", PlannerStatus(PlannerState.IDLE), "/recorded_planner")
    viewed.report("controller/status", ControllerStatus(ControllerState.HOLDING), "/arm")
    viewed.beat("/arm")
    viewed.beat("/replay", role="replay")
    viewed.beat("/replay", "inactive", "replay")
    state = viewed.look()
    assert (state.replay, state.planner is None) == (status, False), "no plant runs"
    viewed.beat("/plant", "inactive", "plant")
    assert viewed.look().replay == status
    viewed.beat("/plant", "active", "plant")
    state = viewed.look()
    assert (state.replay, state.planner) == (None, None)
    assert state.controller is not None
    viewed.beat("/replay", role="replay")
    state = viewed.look()
    assert (state.replay, state.planner is None) == (status, False)
