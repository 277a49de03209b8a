"""The viewer's view of a stack, from messages on its topics."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from time import time_ns
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.ros_harness import LATCHED, Harness
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from viewer.test_viewer_node import Clock, Stack, said_on, viewer_of

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.model import load_robot
from spacerobot_ros.nodes.common.watchdog import HeartbeatState, Role
from spacerobot_ros.nodes.viewer import listener
from spacerobot_ros.nodes.viewer.listener import LatestMessage, Listener
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer.reachability import make_question
from spacerobot_ros.viewer.state import Measured, StackState

ROBOT = load_robot(robot_file("free_flyer"))
NAMES = ROBOT.joint_names
TURNED = [0.5, -0.1, 0.7, 0.5]
"""A quaternion of norm one."""


class Viewed:
    """A listener of a node, and a stack whose messages it hears."""

    def __init__(self, harness: Harness) -> None:
        self.harness, self.reported = harness, list[tuple[str, str]]()
        streams = Node("streams", context=harness.context)
        node = harness.add(Node("viewer", context=harness.context))
        self.stack = harness.probe({})
        self.publishers: dict[str, Any] = {}

        def report(key: str, name: str) -> None:
            self.reported.append((key, name))

        self.listener = Listener(streams, node, "world", report)
        self.listener.use(ROBOT)
        self.close = streams.destroy_node

    def say(self, topic: str, message: Any) -> None:
        """Publish a message, and wait until it has been delivered."""
        if topic not in self.publishers:
            self.publishers[topic] = self.stack.create_publisher(type(message), topic, LATCHED)
            self.stack.watch(topic, type(message))
            # The listener's reader, and the probe's.
            self.harness.matched(self.publishers[topic], 2)
        heard = self.stack.count(topic)
        self.publishers[topic].publish(message)
        self.harness.spin_until(lambda: self.stack.count(topic) > heard, "it is delivered")
        for _ in range(5):
            self.harness.executor.spin_once(timeout_sec=0.001)

    def look(self) -> StackState:
        return self.listener.state()

    def report(self, topic: str, status: Any, name: str) -> None:
        pairs = status.to_values().items()
        values = [KeyValue(key=key, value=value) for key, value in pairs]
        text = getattr(status, "message", "")
        self.say(topic, DiagnosticStatus(name=name, message=text, values=values))


@pytest.fixture
def viewed(harness: Harness) -> Iterator[Viewed]:
    viewed = Viewed(harness)
    yield viewed
    viewed.close()


def pose_of(x: float, y: float, z: float) -> Pose:
    turn = Quaternion(**dict(zip("xyzw", TURNED, strict=True)))
    return Pose(position=Point(x=x, y=y, z=z), orientation=turn)


def odom_at(x: float, y: float, z: float) -> Odometry:
    odom = Odometry()
    odom.pose.pose = pose_of(x, y, z)
    return odom


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
    n = len(NAMES)
    viewed.say("odom", odom_at(1.0, 2.0, 3.0))
    assert viewed.look().measured is None
    order = list(reversed(range(n)))
    viewed.say("joint_states", joints(order))
    state = viewed.look()
    assert state.measured is not None
    assert state.measured.time_s == 3.25
    assert viewed.listener.time_ns() == 3_250_000_000
    assert state.measured.pose.tolist() == [1.0, 2.0, 3.0, *TURNED]
    for values, first in zip(
        (state.measured.q, state.measured.qdot, state.measured.effort), (0.1, 0.2, 0.3), strict=True
    ):
        assert values == pytest.approx(first + np.arange(n)), "in the order of the description"
    assert viewed.look().age_s > state.age_s == 0.0
    # Half a state is a new one.
    viewed.say("odom", odom_at(4.0, 2.0, 3.0))
    state = viewed.look()
    assert state.measured is not None
    assert (state.age_s, state.measured.pose[0], state.measured.time_s) == (0.0, 4.0, 3.25)
    viewed.say("odom", odom_at(math.nan, 2.0, 3.0))
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
    viewed.say("odom", odom_at(1.0, 2.0, 3.0))
    viewed.say("joint_states", joints(list(range(len(NAMES))), **changed))
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
    viewed.say("end_effector_pose", PoseStamped(pose=pose_of(0.1, 0.2, 0.3)))
    viewed.say("thrusters", JointState(name=["a", "b"], velocity=[0.25, 1.0]))
    state = viewed.look()
    assert state.tool is not None
    assert state.tool.tolist() == [0.1, 0.2, 0.3, *TURNED]
    assert state.firing is not None
    assert (state.firing.names, state.firing.duty.tolist()) == (("a", "b"), [0.25, 1.0])
    viewed.say("thrusters", JointState(name=["a", "b"], velocity=[0.5]))
    state = viewed.look()
    assert state.firing is not None
    assert state.firing.duty.tolist() == [0.25, 1.0]
    viewed.say("target/odom", odom_at(1.5, -0.25, 0.75))
    target = viewed.look().target
    assert target is not None
    assert target.tolist() == [1.5, -0.25, 0.75, *TURNED]


def test_statuses_are_read_by_the_kind_of_their_node(viewed: Viewed) -> None:
    pose = (0.5, 0.25, 0.125, *TURNED)
    statuses = {
        "planner": PlannerStatus(PlannerState.PLANNING, "A plan is made.", goal=pose),
        "controller": ControllerStatus(ControllerState.TRACKING, "The goal is approached."),
        "plant": PlantStatus(PlantState.RUNNING, "A command is active."),
        "replay": ReplayStatus(1.0, 2.0, state="paused", rate=1.5),
    }
    for name, status in statuses.items():
        viewed.report(f"{name}/status", status, f"/{name}")
        viewed.say(f"{name}/status", DiagnosticStatus(name="/other", message="of another kind"))
    state = viewed.look()
    assert {name: getattr(state, name) for name in statuses} == statuses
    assert viewed.reported == [(name, f"/{name}") for name in statuses]
    goal = state.goals["base"]
    assert (*goal.position, *goal.quaternion) == pytest.approx(pose)
    assert state.absent == frozenset()


def test_goals_of_anyone_are_shown_until_one_is_refused(viewed: Viewed) -> None:
    for topic, x in (("goal_pose", 0.5), ("end_effector/goal_pose", 1.5)):
        message = PoseStamped(pose=pose_of(x, 2.0, 3.0))
        message.header.frame_id = "world"
        viewed.say(topic, message)
    goals = viewed.look().goals
    assert {part: goal.position[0] for part, goal in goals.items()} == {
        "base": 0.5,
        "end_effector": 1.5,
    }
    path = Path(poses=[PoseStamped(pose=pose_of(x, 2.0, 3.0)) for x in (0.1, 0.7)])
    path.header.frame_id = "world"
    viewed.say("goal_path", path)
    assert viewed.look().goals["base"].position[0] == 0.7
    message.header.frame_id = "elsewhere"
    viewed.say("goal_pose", message)
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
        viewed.say("goal_pose", message)
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
    assert viewed.look().goals == {}, "nothing flies to it: it is no error"


def test_goals_of_links_are_those_of_the_planner(viewed: Viewed) -> None:
    pose, place = (0.5, 0.25, 0.125, *TURNED), (4.0, -2.0, 1.0)

    def tell(**goals: Any) -> dict[str, Goal]:
        viewed.report("planner/status", PlannerStatus(PlannerState.PLANNING, **goals), "/planner")
        return dict(viewed.look().goals)

    tool = PoseStamped(pose=pose_of(7.0, 8.0, 9.0))
    viewed.say("end_effector/goal_pose", tool)
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


@pytest.mark.parametrize(("count", "places"), [(3, [0, 1, 2]), (2000, [*range(0, 1999, 2), 1999])])
def test_a_long_planned_path_is_thinned_and_keeps_its_ends(
    viewed: Viewed, count: int, places: list[int]
) -> None:
    poses = [
        PoseStamped(pose=Pose(position=Point(x=float(k), y=2.0, z=-3.0))) for k in range(count)
    ]
    viewed.say("planned_path", Path(poses=poses))
    path = viewed.look().planned_path
    assert path is not None
    assert path.tolist() == [[k, 2.0, -3.0] for k in places]
    poses[-1].pose.position.y = math.inf
    viewed.say("planned_path", Path(poses=poses))
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
        viewed.say(topic, message)
    motion = viewed.look().planned_motion
    assert motion is not None
    np.testing.assert_allclose(motion[:, 0], [0.0, 15.0, 40.0])
    np.testing.assert_allclose(motion[:, 3:7], [TURNED] * 3)
    np.testing.assert_allclose(motion[:, 7:], [[i + t for i in order] for t in (0, 1.5, 4)])
    # The robot may come after both.
    viewed.listener.use(ROBOT)
    assert viewed.look().planned_motion is not None
    viewed.say("gait_schedule", schedule(8, *order))
    assert viewed.look().planned_motion is None, "it is of another plan"
    viewed.say("planned_path", planned(8, *np.linspace(0.0, 4.0, 801)))
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
    viewed.say("gait_schedule", plan)
    viewed.say("planned_path", path)
    assert viewed.look().planned_motion is None


@pytest.mark.parametrize(("timeout", "is_silent"), [(0.25, True), (60.0, False)])
def test_a_node_is_silent_after_the_time_that_is_given(
    harness: Harness, timeout: float, is_silent: bool
) -> None:
    _, page = viewer_of(harness, watchdog_timeout=timeout)
    probe = harness.probe({"heartbeat": DiagnosticStatus})
    beats = harness.matched(probe.create_publisher(DiagnosticStatus, "heartbeat", 10), 2)
    beats.publish(DiagnosticStatus(name="/planner", message="active", hardware_id="commander"))
    if is_silent:
        harness.spin_until(lambda: "/planner" in said_on(page), "it is said to be silent")
        return
    harness.spin_until(lambda: probe.count("heartbeat"), "the heartbeat is heard")
    harness.spin_for(2.0)  # Longer than by default.
    assert "/planner" not in said_on(page)


def test_a_goal_that_nobody_takes_is_reported(harness: Harness) -> None:
    stack = Stack(harness)
    names = tuple(load_robot(robot_file("sliding_masses")).joint_names)
    stack.describe()
    stack.until(lambda: stack.move(0.25, names) or stack.placed, "a goal is shown")
    harness.remove(stack.probe)
    stack.press("Fly")
    stack.until(lambda: "The goal was not received" in stack.said(), "it says so")


# -- nodes that are gone --------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Return the time of listeners, which stands still until a test lets it go on."""
    clock = Clock(runs=False)
    monkeypatch.setattr(listener, "time", clock)
    return clock


def beat(viewed: Viewed, name: str, pulse: HeartbeatState, role: Role | None) -> None:
    hardware = "" if role is None else role.value
    viewed.say("heartbeat", DiagnosticStatus(name=name, message=pulse.value, hardware_id=hardware))


def test_nodes_that_are_gone_are_shown_no_longer(clock: Clock, viewed: Viewed) -> None:
    look = viewed.look

    def pass_time(seconds: int) -> None:
        for _ in range(seconds):
            clock.ahead += 1.0
            look()

    viewed.report("plant/status", PlantStatus(PlantState.RUNNING, "A command."), "/robot")
    idle = PlannerStatus(PlannerState.IDLE)
    viewed.report("planner/status", idle, "/planner")
    assert look().planner is not None
    beat(viewed, "/planner", HeartbeatState.ACTIVE, Role.COMMANDER)
    beat(viewed, "/other_viewer", HeartbeatState.INACTIVE, None)
    assert "/planner" not in look().silent
    assert look().inactive == (), "viewers come and go"
    pass_time(10)
    assert look().silent["/planner"] == 10.0
    assert look().absent == {"planner"}
    seen = replace(look(), measured=Measured(0.0, np.eye(7)[6], *np.zeros((3, 3))))
    goal = Goal.checked([1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    answer = make_question(seen, {"base": goal}, load_robot(robot_file("sliding_masses")), {})
    assert answer == "The planner is offline."
    assert look().planner == idle, "it may come back"
    pass_time(51)
    assert look().planner is None
    assert "/planner" not in look().silent
    beat(viewed, "/planner", HeartbeatState.ACTIVE, Role.COMMANDER)
    assert look().planner == idle, "it had only stood still"
    assert look().absent == frozenset()
    beat(viewed, "/planner", HeartbeatState.INACTIVE, Role.COMMANDER)
    assert look().inactive == ("/planner",)
    assert look().absent == {"planner"}
    beat(viewed, "/planner", HeartbeatState.BUSY, Role.COMMANDER)
    pass_time(100)
    assert look().planner == idle, "it plans"
    beat(viewed, "/planner", HeartbeatState.ACTIVE, Role.COMMANDER)
    look()
    clock.ahead += 1000.0
    assert look().planner == idle, "the viewer had stood still"


def test_a_replay_shows_what_nodes_reported_until_a_plant_begins(
    clock: Clock, viewed: Viewed
) -> None:
    look = viewed.look
    viewed.report("plant/status", PlantStatus(PlantState.RUNNING, "A command."), "/robot")
    idle = PlannerStatus(PlannerState.IDLE)
    viewed.report("planner/status", idle, "/planner")
    beat(viewed, "/planner", HeartbeatState.ACTIVE, Role.COMMANDER)
    status = ReplayStatus(1.0, 2.0, state="paused", rate=1.0)
    viewed.report("replay/status", status, "/replay")
    beat(viewed, "/replay", HeartbeatState.ACTIVE, Role.REPLAY)
    beat(viewed, "/live_plant", HeartbeatState.ACTIVE, Role.PLANT)
    assert look().replay == status
    assert look().plant is not None
    beat(viewed, "/replay", HeartbeatState.INACTIVE, Role.REPLAY)
    assert look().replay is None
    assert look().plant is None, "it was recorded"
    assert look().planner == idle
    beat(viewed, "/replay", HeartbeatState.ACTIVE, Role.REPLAY)
    assert look().replay == status


def test_a_commander_is_busy_and_not_a_plant(viewed: Viewed) -> None:
    for role in (Role.PLANT, Role.COMMANDER):
        beat(viewed, "/x", HeartbeatState.BUSY, role)
        assert viewed.look().busy is (role is Role.COMMANDER)


# -- momenta --------------------------------------------------------------------------------------

Sent = dict[str, list[tuple[int, float]]]


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> Sent:
    """Return what listeners take from topics: times, ns, and numbers."""
    sent: Sent = {}

    class Topic(LatestMessage[Any]):
        def __init__(self, _node: Node, _kind: Any, topic: str) -> None:
            self.topic, self.sent_ns = topic, 0

        def take(self) -> Float64MultiArray | None:
            if not sent.get(self.topic):
                return None
            self.sent_ns, value = sent[self.topic].pop(0)
            return Float64MultiArray(data=[value] * 7)

    monkeypatch.setattr(listener, "LatestMessage", Topic)
    return sent


def test_a_message_is_taken_with_the_time_of_its_publication(harness: Harness) -> None:
    streams = Node("streams", context=harness.context)
    newest = LatestMessage(streams, Float64MultiArray, "momentum")
    publisher = harness.matched(
        harness.probe({}).create_publisher(Float64MultiArray, "momentum", 9)
    )
    before = time_ns()
    publisher.publish(Float64MultiArray(data=[0.5]))
    harness.spin_until(lambda: newest.take() is not None, "it is taken")
    assert abs(newest.sent_ns - before) < 60 * 10**9
    streams.destroy_node()


def test_momenta_are_compared_with_those_of_their_tick(sent: Sent, viewed: Viewed) -> None:
    def pair() -> tuple[float, float | None]:
        momenta = viewed.look().momenta
        assert momenta is not None
        should_be = momenta.expected
        return float(momenta.actual[0]), None if should_be is None else float(should_be[0])

    sent |= {"momentum": [(1000, 1.0)], "momentum_expected": [(1001, 1.0)]}
    assert pair() == (1.0, 1.0)
    # The next tick is published while this one is taken: its second part comes in time, or not.
    sent |= {"momentum": [(2000, 2.0)], "momentum_expected": [(1002, 1.0), (2001, 2.0)]}
    assert pair() == (2.0, 2.0)
    sent |= {"momentum": [(3000, 3.0)], "momentum_expected": []}
    assert pair() == (2.0, 2.0)
    sent |= {"momentum": [(4000, 4.0)], "momentum_expected": [(4001, 4.0)]}
    assert pair() == (4.0, 4.0)
    # Or the first part is not delivered yet when the second is: ticks are milliseconds apart.
    sent |= {"momentum": [(10_005_000, 5.0)], "momentum_expected": [(20_005_001, 6.0)]}
    assert pair() == (4.0, 4.0)
    sent |= {"momentum": [(20_005_000, 6.0)]}
    assert pair() == (6.0, 6.0)
    # Another plant has no thrusters: nothing is expected of its momenta.
    sent |= {"momentum": [(10**10, 5.0)]}
    assert pair() == (5.0, None)
