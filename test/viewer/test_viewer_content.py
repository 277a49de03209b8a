"""What the page says: texts, colors and numbers, and which of them users may send on."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.collision import LinkPair
from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.errors import ParameterError, shortened
from spacerobot_ros.model import load_robot
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import quaternion_multiply
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Tolerance
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.clearance import ClearanceStatus
from spacerobot_ros.simulation.faults import FaultTargets
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer import content
from spacerobot_ros.viewer.content import RecentItems
from spacerobot_ros.viewer.goal_editor import move_along
from spacerobot_ros.viewer.reachability import GoalCheck, Verdict
from spacerobot_ros.viewer.state import Measured, Notice, StackState

HERE = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
STATE = StackState(Measured(4.0, HERE, np.zeros(3), np.zeros(3), np.zeros(3)), age_s=0.1)


def quaternion_of(rpy: Any) -> np.ndarray:
    return Rotation.from_euler("xyz", np.asarray(rpy)).as_quat()


def test_silence_is_said() -> None:
    assert "No state received yet" in content.silence_message(StackState())
    assert content.silence_message(STATE) == ""
    assert content.silence_message(replace(STATE, age_s=5.9)) == "No state for 5 s."
    paused = PlantStatus(PlantState.PAUSED, "Time stands still.")
    assert content.silence_message(replace(STATE, age_s=5.9, plant=paused)) == ""
    held = ReplayStatus(1.0, 2.0, state="paused", rate=1.0)
    assert content.silence_message(replace(STATE, age_s=5.9, replay=held)) == ""
    assert content.silence_message(StackState(replay=held)) == "", "it has not begun"
    plays = replace(held, state="playing")
    assert content.silence_message(replace(STATE, age_s=5.9, replay=plays)) == "No state for 5 s."
    head = content.status_html(replace(STATE, silent={"/planner": 3.2}))
    assert "Node &#x27;/planner&#x27; has been silent for 3 s." in head
    assert "Node &#x27;/plant&#x27; is not active." in content.status_html(
        replace(STATE, inactive=("/plant",))
    )
    assert "robot_description" not in content.status_html(STATE)
    assert "no valid robot_description" in content.status_html(STATE, described=False)


def test_a_latched_robot_is_said_to_drift() -> None:
    latched = PlantStatus(PlantState.LATCHED, "Off: a fuse.", "abort", "a fuse")
    assert STATE.measured is not None
    drifts = replace(STATE.measured, twist=np.array([3e-3, 0.0, -4e-3, 0.0, 0.12, 0.05]))
    for measured, speeds in (
        (STATE.measured, "0 m/s and 0 rad/s"),
        (drifts, "5 mm/s and 0.13 rad/s"),
    ):
        head = content.status_html(replace(STATE, measured=measured, plant=latched))
        assert f"The base drifts at {speeds}. Press Rearm." in head


def test_time_to_go_is_of_the_schedule_that_is_flown() -> None:
    executing = PlannerStatus(PlannerState.EXECUTING, manoeuvre_time_s=8.0, ends_at_s=10.0)
    flying = replace(STATE, planner=executing)
    assert content.time_to_go(flying) == pytest.approx(6.0)
    assert content.progress(flying) == pytest.approx(0.25)
    assert "6.0 s to go" in content.status_html(flying)
    # Of a manoeuvre in pieces, that of all pieces.
    piece = replace(flying, planner=replace(executing, remaining_s=24.0))
    assert content.time_to_go(piece) == pytest.approx(30.0)
    assert content.progress(piece) == pytest.approx(1 - 30 / 32)
    assert content.time_to_go(STATE) is None
    assert content.progress(STATE) is None
    reached = replace(STATE, planner=replace(executing, state=PlannerState.REACHED))
    assert content.time_to_go(reached) is None
    lost = replace(flying, absent=frozenset({"planner"}))
    assert content.time_to_go(lost) is None, "nobody flies it any more"
    assert "opacity" in content.status_html(lost)
    assert "opacity" not in content.status_html(replace(flying, absent=frozenset({"controller"})))
    late = replace(STATE, planner=replace(executing, ends_at_s=3.0))
    assert content.time_to_go(late) == 0.0
    assert content.progress(late) == 1.0
    assert ", settling" in content.status_html(late)


def test_what_nodes_say_is_no_html() -> None:
    evil = "<img src=x onerror=alert(1)>"
    state = replace(
        STATE,
        plant=PlantStatus(PlantState.LATCHED, evil, faults=(evil,), disturbances=(evil,)),
        planner=PlannerStatus(PlannerState.REFUSED, evil),
        controller=ControllerStatus(ControllerState.STOPPED, evil),
        silent={evil: 3.0},
    )
    texts = [
        content.status_html(state),
        content.faults_html((evil,)),
        content.hint_html(evil),
        content.check_html(GoalCheck(Verdict.REFUSED, evil)),
        content.log_html([Notice(evil, 2, 1.0, evil)]),
    ]
    robot = load_robot(robot_file("three_joint_arm"))
    urdf = robot.urdf.replace(robot.joint_names[0], "a&lt;b&gt;c")
    assert "&lt;img" in texts[0]
    assert f"Fault: {escape(evil)}" in texts[0]
    assert f"Disturbance: {escape(evil)}" in texts[0]
    assert all("<img" not in text for text in texts)
    zeros = np.zeros(3)
    table = content.joints_html(parse_robot(urdf), zeros, zeros, zeros)
    assert "a&lt;b&gt;c" in table
    assert "a<b>c" not in table


def test_joints_stand_beside_their_limits() -> None:
    robot = load_robot(robot_file("sliding_masses"))
    lower, upper = robot.limits("lower"), robot.limits("upper")
    middle = (lower + upper) / 2
    rows = content.joints_html(robot, middle, np.zeros(3), np.zeros(3)).split("<tr>")[2:]
    assert [name in row for name, row in zip(robot.joint_names, rows, strict=True)] == [True] * 3
    assert all("left:50%" in row for row in rows)
    near = upper - 0.01 * (upper - lower)
    assert content.joints_html(robot, near, np.zeros(3), np.zeros(3)).count("left:99%") == 3
    beyond = content.joints_html(robot, upper + 1.0, np.zeros(3), np.zeros(3))
    assert beyond.count("left:100%;") == 3
    assert beyond.count("#d23c3c") == 3
    tiny = np.full(3, -1e-9)
    assert "-0.0" not in content.joints_html(robot, tiny, tiny, tiny), "zero has no sign"


def test_rates_and_efforts_stand_beside_their_own_limits() -> None:
    robot = load_robot(robot_file("surveyor"))
    rates, efforts = robot.limits("velocity"), robot.limits("effort")
    assert not set(rates) & set(efforts)
    n = len(robot.joint_names)
    at, qdot, effort = np.zeros(n), np.linspace(0.01, 0.02, n), np.linspace(-1.0, -7.0, n)
    rows = content.joints_html(robot, at, qdot, effort).split("<tr>")
    titles = re.findall("<th>(.*?)</th>", rows[1])
    for k, row in enumerate(rows[2:]):
        cells = dict(zip(titles, re.findall("<td>(.*?)</td>", row), strict=True))
        assert cells["rate"] == f"{qdot[k]:.2f}/{rates[k]:g} rad/s"
        assert cells["effort"] == f"{effort[k]:.2f}/{efforts[k]:g} N m"


def test_errors_are_to_the_goal() -> None:
    robot = load_robot(robot_file("three_joint_arm"))
    kinematics = ForwardKinematics(robot)

    def errors(state: StackState) -> dict[str, tuple[float, ...]]:
        return content.goal_errors(state, kinematics)

    assert errors(STATE) == {}
    turned = quaternion_of((0.0, 0.0, 0.5))
    goal = Goal(np.array([1.0, 2.0, 5.0]), turned)
    state = replace(STATE, goals={"base": goal})
    assert errors(state) == {"base": pytest.approx((2.0, 0.5))}
    assert errors(replace(state, measured=None)) == {}
    # That of a controller's end-effector too, whatever the reference is that it follows to it.
    tool = Goal(np.array([4.0, 6.0, 3.0]), quaternion_of((0.0, 0.2, 0.0)))
    flying = replace(STATE, tool=HERE, goals={"end_effector": tool})
    assert errors(flying) == {"end_effector": pytest.approx((5.0, 0.2))}
    assert errors(replace(flying, tool=None)) == {}


def test_errors_of_links_are_those_of_their_measured_poses() -> None:
    robot = load_robot(robot_file("three_joint_arm"))
    kinematics, link = ForwardKinematics(robot), robot.links[-1].name
    at = kinematics.link_in_world(link, HERE, np.zeros(3))
    off, aside = np.array([0.0, 0.3, 0.4]), quaternion_of((0.25, 0.0, 0.0))
    pose = EndEffectorGoal(link, at[:3] + off, quaternion_multiply(at[3:], aside))
    goals = {link: Goal.of_end_effectors([pose])}
    state = replace(STATE, goals=goals, planner=PlannerStatus(PlannerState.EXECUTING, "Flies."))
    errors = content.goal_errors(state, kinematics)
    assert errors[link] == pytest.approx((0.5, 0.25))
    head = content.status_html(state, errors)
    assert f"{link} is 0.5 m and 0.25 rad from its goal." in head
    place = replace(state, goals={link: Goal.of_end_effectors([replace(pose, quaternion=None)])})
    errors = content.goal_errors(place, kinematics)
    assert errors[link] == pytest.approx((0.5,))
    assert f"{link} is 0.5 m from its goal." in content.status_html(place, errors)
    assert "from its goal" not in content.status_html(place)
    base = replace(state, goals={"base": Goal(HERE[:3], HERE[3:])})
    errors, limits = content.goal_errors(base, kinematics), Tolerance(0.001, 0.002)
    head = content.status_html(base, errors, limits)
    assert "base is 0 m and 0 rad from its goal (tolerance 1 mm, 2 mrad)." in head
    flown = PlannerStatus(PlannerState.EXECUTING, not_controlled=("position",))
    head = content.status_html(replace(base, planner=flown), errors, limits)
    free = "base is 0 m (not controlled) and 0 rad from its goal (tolerance 2 mrad)."
    assert free in head
    # Its message has the numbers once the planner has decided.
    done = replace(base, planner=PlannerStatus(PlannerState.REACHED, "It is there."))
    assert "from its goal" not in content.status_html(done, errors)
    unknown = {"hand": Goal.of_end_effectors([replace(pose, link="hand")])}
    assert content.goal_errors(replace(state, goals=unknown), kinematics) == {}
    assert content.goal_errors(replace(state, measured=None), kinematics) == {}


def test_the_plan_that_is_flown_tells_where_the_robot_ends() -> None:
    turned = quaternion_of((0.0, 0.0, 0.5))
    goal = Goal(np.array([4.0, 5.0, 6.0]), turned)
    motion = np.column_stack([np.tile(HERE, (2, 1)), [[0.0, 0.0, 0.0], [0.1, -0.2, 0.3]]])
    motion[1, :3] = [1.5, 2.5, 3.5]
    flying = replace(
        STATE,
        goals={"base": goal},
        planned_motion=motion,
        planner=PlannerStatus(PlannerState.EXECUTING, not_controlled=("position",)),
    )
    check = content.flown_check(flying)
    assert check is not None
    assert (check.verdict, check.source is motion) == (Verdict.PARTLY, True)
    assert check.message.endswith("Not controlled: position.")
    assert "partly reachable" in content.check_html(check)
    # The attitude, which later pieces bring to the goal, and the position as it is predicted.
    assert check.base is not None
    np.testing.assert_allclose(check.base, [1.5, 2.5, 3.5, *turned])
    np.testing.assert_allclose(motion[1, 3:7], HERE[3:])
    assert check.shape is not None
    np.testing.assert_array_equal(check.shape, [0.1, -0.2, 0.3])
    whole = content.flown_check(replace(flying, planner=PlannerStatus(PlannerState.EXECUTING)))
    assert whole is not None
    assert whole.verdict is Verdict.REACHABLE
    assert whole.base is not None
    np.testing.assert_allclose(whole.base, [*goal.position, *turned])
    free = content.flown_check(replace(flying, goals={}))
    assert free is not None
    assert free.base is not None
    np.testing.assert_allclose(free.base, motion[1, :7])
    for still in (
        replace(flying, planner=PlannerStatus(PlannerState.REACHED)),
        replace(flying, planned_motion=None),
        replace(flying, absent=frozenset({"planner"})),
        replace(flying, planner=None),
    ):
        assert content.flown_check(still) is None


def test_what_a_controller_does_not_control_is_said_beside_its_number() -> None:
    def head(*labels: str) -> str:
        report = CommandReport(
            "model_based", False, 1.0, 0.0, 0.0, 0.0, 0.0, dict.fromkeys(labels, 0.0)
        )
        control = ControllerStatus(ControllerState.TRACKING, command=report)
        goals = {name: Goal(HERE[:3], HERE[3:]) for name in ("base", "end_effector")}
        distances = dict.fromkeys(goals, (0.25, 0.5))
        state = replace(STATE, controller=control, goals=goals)
        return content.status_html(state, distances, Tolerance(0.01, 0.02))

    turned = "0.25 m (not controlled) and 0.5 rad from its goal (tolerance 20 mrad)"
    both = "0.25 m and 0.5 rad from its goal (tolerance 10 mm, 20 mrad)"
    neither = "0.25 m (not controlled) and 0.5 rad (not controlled) from its goal."
    assert f"base is {turned}." in head("base.rz", "joint.elbow")
    assert f"end_effector is {neither}" in head("base.rz", "joint.elbow")
    assert f"base is {both}." in head("base.y", "base.rx", "end_effector.x")
    placed = "0.25 m and 0.5 rad (not controlled) from its goal (tolerance 10 mm)"
    assert f"end_effector is {placed}." in head("base.y", "base.rx", "end_effector.x")


def controlled(**report: Any) -> StackState:
    command = CommandReport("model_based", False, 1.0, 0.0, 0.0, 0.0, 0.0, **report)
    return replace(STATE, controller=ControllerStatus(ControllerState.TRACKING, command=command))


def test_the_momentum_budget_is_that_of_the_controller() -> None:
    parts = {"wheels": 1.25, "sum": 3.0, "arm": 0.5, "base": 2.0006}
    shares = {"fast": -0.8, "full": 0.98, "slow": 0.79}
    state = controlled(momentum=parts, wheels=shares)
    assert list(content.momentum_budget(state).items()) == [
        ("base", 2.0006),
        ("arm", 0.5),
        ("wheels", 1.25),
        ("sum", 3.0),
    ]
    text = content.momentum_html(state)
    rows = [re.findall("<td>(.*?)</td>", row) for row in text.split("<tr>")[1:]]
    assert rows[:4] == [
        ["base", "2.001 N m s", ""],
        ["arm", "0.500 N m s", ""],
        ["wheels", "1.250 N m s", ""],
        ["sum", "3.000 N m s", ""],
    ]
    assert [row[1] for row in rows[4:]] == ["-80 %", "98 %", "79 %"]
    assert [row[0] for row in rows[4:]] == [f'<span title="{n}">{n}</span>' for n in shares]
    places, colours = ("left:10%", "left:99%", "left:90%"), ("#c98a00", "#d23c3c", "#2a9d5c")
    for row, place, tint in zip(rows[4:], places, colours, strict=True):
        assert place in row[2]
        assert tint in row[2]
    assert "dumped" not in text
    dumping = controlled(momentum=parts, wheels=shares, dumping=True)
    (line,) = re.findall(
        "<[^<]*>The wheel momentum is being dumped.", content.momentum_html(dumping)
    )
    assert "#c98a00" in line, "a warning"


def test_without_a_momentum_budget_there_is_no_panel() -> None:
    parts = dict.fromkeys(("base", "arm", "wheels", "sum"), 1.0)
    lost = replace(controlled(momentum=parts), absent=frozenset({"controller"}))
    incomplete = controlled(momentum={"base": 1.0, "sum": 1.0})
    silent = replace(STATE, controller=ControllerStatus(ControllerState.HOLDING))
    for state in (STATE, silent, lost, incomplete, controlled()):
        assert content.momentum_budget(state) == {}
        assert content.momentum_html(state) == ""
    evil = controlled(momentum=parts, wheels={"<b>": 0.1})
    assert "<b>x" not in content.momentum_html(evil)
    assert "&lt;b&gt;" in content.momentum_html(evil)


def test_faults_are_written_for_the_plant() -> None:
    targets = FaultTargets(("elbow",), wrench=False)
    line = content.fault_line("joint_slow", "elbow", 0.5, 10.0, 2.5, targets)
    assert line == "joint_slow elbow 0.5 until 12.5"
    assert content.fault_line("joint_stuck", "elbow", 9.0, 0.0, 2.5, targets) == "joint_stuck elbow"
    for kind, target, value, lasts in (
        ("joint_slow", "elbow", 2.0, 0.0),
        ("joint_slow", "elbow", math.nan, 0.0),
        ("joint_slow", "knee", 0.5, 0.0),
        ("-", "-", 0.5, 0.0),
        ("joint_stuck", "elbow", 0.0, math.nan),
        ("joint_stuck", "elbow", 0.0, -1.0),
    ):
        with pytest.raises(ParameterError):
            content.fault_line(kind, target, value, lasts, 2.5, targets)


def test_history_keeps_the_last_minutes_and_forgets_a_time_that_comes_again() -> None:
    recent: RecentItems[float] = RecentItems(span_s=100.0, most=50)
    assert recent.span is None
    for k in range(1000):
        recent.add(0.5 * k, 0.5 * k)
    assert len(recent.items) <= 50
    assert recent.items[-1] == 499.5
    assert recent.span == (recent.items[0], 499.5)
    assert recent.items[0] >= 399.5
    assert np.all(np.diff(recent.items) > 0)
    recent.add(450.0, -1.0)
    assert recent.span == (recent.items[0], 450.0)
    assert recent.items[-1] == -1.0
    assert np.all(np.diff(recent.items[:-1]) > 0)


def test_a_path_is_as_long_as_the_flight_with_as_many_points_as_are_drawn() -> None:
    path: RecentItems[float] = RecentItems(span_s=math.inf, most=100)
    for k in range(10_000):
        path.add(float(k), 0.005 * k)
    assert 50 <= len(path.items) <= 101
    assert (path.items[0], path.items[-1]) == (0.0, 0.005 * 9999)
    gaps = np.diff(path.items)[:-1]
    assert gaps.max() < 2.2 * gaps.min(), "thinned evenly"
    assert max(path.until(100.0)) <= 0.5 < path.items[len(path.until(100.0))]
    path.add(100.0, -1.0)
    assert path.items[-1] == -1.0
    assert path.items[-2] < 0.5


def test_a_goal_that_is_carried_along_stays_where_it_is_beside_the_base() -> None:
    quarter = quaternion_of((0.0, 0.0, math.pi / 2))
    before = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    after = np.concatenate([[5.0, 5.0, 5.0], quarter])
    tool = np.array([3.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
    moved = move_along(tool, before, after)
    np.testing.assert_allclose(moved[:3], [5.0, 7.0, 5.5], atol=1e-12)
    np.testing.assert_allclose(moved[3:], quarter, atol=1e-12)


def test_long_names_of_joints_have_room() -> None:
    assert shortened("shoulder_yaw") == "shoulder_yaw"
    long = [f"the_very_long_name_of_the_shoulder_joint_{number}" for number in range(12)]
    short = [shortened(name) for name in long]
    assert max(map(len, short)) == 21
    assert len(set(short)) == 12, "they are told apart by their ends"
    robot = load_robot(robot_file("three_joint_arm"))
    urdf = robot.urdf.replace(f'"{robot.joint_names[0]}"', f'"{long[0]}"')
    table = content.joints_html(parse_robot(urdf), *np.zeros((3, 3)))
    assert f'title="{long[0]}">{short[0]}<' in table


def test_a_small_clearance_and_its_links_are_shown() -> None:
    links = LinkPair("left <arm>", "right")
    apart = content.status_html(replace(STATE, clearance=ClearanceStatus(0.0123, links, 4.0)))
    assert escape("Links 'left <arm>' and 'right' are 12.3 mm apart.") in apart
    assert "#d23c3c" not in apart
    deep = content.status_html(replace(STATE, clearance=ClearanceStatus(-0.2, links, 4.0)))
    assert f'#d23c3c);font-weight:600;margin:2px 0">{escape("Links")}' in deep
    assert escape("and 'right' touch, 0.2 m deep.") in deep
    far = content.status_html(replace(STATE, clearance=ClearanceStatus(0.06, links, 4.0)))
    assert "apart" not in far, "it is no news"
    gone = replace(STATE, clearance=ClearanceStatus(0.01, links, 4.0), absent=frozenset({"plant"}))
    assert 'opacity:.75"><div style="margin:2px 0">Links' in content.status_html(gone)


def test_a_goal_reached_but_for_a_part_is_amber() -> None:
    reached = PlannerStatus(PlannerState.REACHED, "There.")
    green = content.status_html(replace(STATE, planner=reached))
    assert 'color:var(--ok-color,#2a9d5c);font-weight:600">reached</span> There.' in green
    partly = replace(reached, not_controlled=("position",))
    amber = content.status_html(replace(STATE, planner=partly))
    assert 'color:var(--warn-color,#c98a00);font-weight:600">reached</span> There.' in amber
    flying = replace(partly, state=PlannerState.EXECUTING)
    assert 'color:var(--ok-color,#2a9d5c);font-weight:600">executing</span>' in content.status_html(
        replace(STATE, planner=flying)
    )
