"""Plan, fly and plot in Python, without ROS."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import QUICK as QUICK_PLANS
from support.planner_loop import TICK, StubMethod, goal_at, robot_of
from support.sentences import assert_one_sentence

import spacerobot_ros
from spacerobot_ros import fly, load_scenario, plan, read_bag
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.errors import GoalError, ParameterError, PlanningError, RecordingError
from spacerobot_ros.flight.api import scenario_to_fly
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.flight.trials import (
    PlanEvaluation,
    PlanningProblem,
    random_goals,
    try_goals,
    try_method,
)
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitSchedule, Goal, PlanRequest
from spacerobot_ros.planning.api import end_effector_goals
from spacerobot_ros.planning.core.progress import report_progress
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState

QUICK = {"planner.lie_bracket.t1": 2.0, "planner.lie_bracket.cycle_period": 1.0}

EIGHT_LINES = """
from spacerobot_ros import fly, plan
schedule = plan("faults/stuck_slider", method="lie_bracket")
flight = fly("faults/stuck_slider", seed=3, parameters={"plant.faults": []})
figure = flight.plot()
table = flight.to_pandas()
print(schedule.duration, flight)
"""


@pytest.mark.slow
def test_plan_fly_and_plot_in_eight_lines_without_ros() -> None:
    """In a process of its own, which must not have loaded ROS."""
    assert len(EIGHT_LINES.strip().splitlines()) <= 8
    check = (
        "import sys; assert 'rclpy' not in sys.modules\n"
        "assert figure._repr_png_()[:4] == b'\\x89PNG'\n"
        "assert table.loc[flight.time[-1], 'position[slider_2]'] == flight.q[-1, 1]\n"
        "assert abs(flight.time[-1] - schedule.duration) < 1e-9\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", EIGHT_LINES + check], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "<Flight of stuck_slider by lie_bracket: reached after" in done.stdout


@pytest.mark.slow
def test_a_scenario_plans_with_its_own_limits() -> None:
    """The same goal of the robot alone is reached five times faster: its URDF allows for more."""
    scenario = load_scenario("sliding_masses")
    at, turned = scenario.goal.position, (0.5, -0.15, 0.1)
    own = plan(scenario)
    assert own.duration == plan("sliding_masses").duration == 39.45
    assert plan(scenario, position=at, rotvec=turned).duration == own.duration
    assert plan("sliding_masses", position=at, rotvec=turned).duration < 10.0
    assert fly(scenario).manoeuvre_time == own.duration


def test_goals_of_a_plan_are_given_as_those_of_a_flight_are() -> None:
    """A robot by its name, by its file and by its model; a pose, or parts of one."""
    name, at, turn = "sliding_masses", (0.01, 0.02, -0.01), (0.01, -0.02, 0.015)
    model = SpaceRobot.from_file(robot_file(name))
    quaternion = Rotation.from_rotvec(turn).as_quat()
    plans = [
        plan(name, position=at, rotvec=turn, method="lie_bracket"),
        plan(model, [*at, *quaternion], method="lie_bracket"),
        plan(robot_file(name), at, rotvec=turn, method="lie_bracket"),
        plan(model, Goal.checked(at, [0, 0, 0, 1]), rotvec=turn, method="lie_bracket"),
    ]
    for each in plans:
        np.testing.assert_allclose(each.positions, plans[0].positions, atol=1e-9)
        np.testing.assert_allclose(each.goal.quaternion, quaternion, atol=1e-15)
        np.testing.assert_array_equal(each.goal.position, at)
    shape = [0.1, 0.2, 0.3]
    shaped = plan(model, at, joint_positions=shape, method="lie_bracket")
    np.testing.assert_array_equal(shaped.goal.joint_positions, shape)
    flight = fly(model, at, rotvec=turn, method="lie_bracket", parameters=QUICK)
    assert flight.succeeded
    assert flight.goal is not None
    assert flight.goal.position.tolist() == list(at)
    np.testing.assert_allclose(flight.goal.quaternion, quaternion, atol=1e-15)


@pytest.mark.parametrize(
    ("place", "outcome"), [(np.nan, Outcome.REACHED), (0.0, Outcome.REACHED_PARTLY)]
)
def test_a_position_that_is_nan_is_not_asked_for(place: float, outcome: Outcome) -> None:
    """The base of an arm moves as it turns."""
    turn = Rotation.from_rotvec((0.05, -0.03, 0.04)).as_quat()
    flight = fly(load_scenario("arm_attitude"), [place] * 3 + [*turn], method="optimal")
    assert flight.outcome is outcome
    last = Rotation.from_quat(flight.pose[-1, 3:])
    assert (Rotation.from_quat(turn).inv() * last).magnitude() < 1e-6


@pytest.mark.parametrize(
    "given",
    [
        "x",
        "1 2 3",
        [np.nan] * 7,
        (0, 0, np.nan, 0, 0, 0, 1),
        {"x": 1},
        (1.0, 2.0),
        5,
        [[1, 2], [3]],
        (np.nan, 0, 0),
        (np.inf, 0, 0),
        object(),
    ],
)
def test_what_is_no_goal_is_refused_in_one_sentence(given: Any) -> None:
    scenario = load_scenario(Path("faults/stuck_slider"))
    for action in (
        lambda: fly(scenario, given),
        lambda: fly(scenario, rotvec=given),
        lambda: plan(scenario, given),
        lambda: plan(scenario, position=given),
        lambda: plan("planar_chain", given),
        lambda: plan("planar_chain", rotvec=given),
    ):
        with pytest.raises(GoalError) as refused:
            action()
        assert_one_sentence(str(refused.value))


def test_a_robot_alone_asks_for_a_goal_in_the_words_of_python() -> None:
    with pytest.raises(ParameterError, match=r"'dual_arm' has no goal.*rotvec=\(0, 0, 0\.1\)"):
        fly("dual_arm")


@pytest.mark.parametrize("parameters", ["planner.method", 3, ["planner.method"], {3: 1}])
def test_parameters_are_given_by_name(parameters: Any) -> None:
    with pytest.raises(ParameterError) as refused:
        fly("faults/stuck_slider", parameters=parameters)
    assert_one_sentence(str(refused.value))


def test_a_schedule_says_what_it_is_in_one_line() -> None:
    schedule = plan("faults/stuck_slider", method="lie_bracket")
    count, duration = len(schedule.positions) - 1, schedule.duration
    assert repr(schedule).startswith(
        f"<GaitSchedule by lie_bracket: {duration:g} s in {count} ticks of 0.05 s for 3 joints"
    )
    assert "\n" not in repr(schedule)


def test_seeds_repeat_a_flight_and_change_it() -> None:
    noise: dict[str, object] = {"plant.sensors.position_noise": 1e-3, "plant.faults": [], **QUICK}
    flights = [fly("faults/stuck_slider", seed=k, parameters=noise) for k in (1, 1, 2)]
    one, same, other = flights
    np.testing.assert_array_equal(one.pose, same.pose)
    assert not np.array_equal(
        one.quantities["measured_pose"][0], other.quantities["measured_pose"][0]
    )


@pytest.mark.slow
def test_an_animation_shows_every_frame(tmp_path: Path) -> None:
    flight = fly("faults/stuck_slider", parameters=QUICK)
    shown = flight.animate(seconds=1.0, frames=3)
    assert shown._repr_html_().count("data:image/png") == 3
    assert "show it in a notebook" in repr(shown)
    # Nothing is asked of a server, and every button has a sign.
    assert "http" not in shown._repr_html_().replace("http://www.w3.org", "")
    assert "fa-" not in shown._repr_html_()
    shown.save(tmp_path / "new" / "motion.html")
    assert shown.html in (tmp_path / "new" / "motion.html").read_text("utf-8")


def test_every_joint_of_a_plot_is_told_from_the_others() -> None:
    flight = fly("faults/stuck_slider", parameters=QUICK)
    robot = load_robot(robot_file("quadruped"))
    joints = Signal(flight.time, np.zeros((len(flight.time), 12)))
    series = {**flight.series, **dict.fromkeys(("q", "qdot", "effort"), joints)}
    names = tuple(robot.joint_names)
    panels = replace(flight, robot=robot, joint_names=names, series=series).plot().axes
    assert len(panels) > 2
    for panel in panels[2:]:
        looks = [(line.get_color(), line.get_linestyle()) for line in panel.get_lines()]
        assert len(set(looks)) == len(looks) == 12


def test_a_flight_is_saved_once_unless_it_may_replace_what_is_there(tmp_path: Path) -> None:
    flight = fly("faults/stuck_slider", parameters=QUICK)
    file = tmp_path / "Bäge mit Lücken" / "ein Flug.mcap"
    for array in flight.q, flight.pose, flight.time:
        with pytest.raises(ValueError, match="read-only"):  # A change would be saved, too.
            array += 1.0
    flight.save(file)
    before = file.read_bytes()
    with pytest.raises(RecordingError, match="File exists"):
        flight.save(str(file))
    assert file.read_bytes() == before
    flight.save(file, overwrite=True)
    np.testing.assert_array_equal(
        read_bag(file)["joint_states"].field("position"), flight.q, strict=True
    )


class _HalfLaw(TransposedJacobianLaw):
    """A law that is in no registry; ``thresholds`` are those of the laws that were built."""

    name = "half"
    thresholds: ClassVar[list[float]] = []

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self.thresholds.append(self.singular_value_threshold)


@pytest.mark.parametrize("lacking", [slice(6, None), slice(-6), slice(None)])
@pytest.mark.parametrize("late", [0.0, 2e-5])
def test_thrust_explains_the_momentum_in_a_recording_that_lacks_some(
    lacking: slice, late: float
) -> None:
    """A controller starts after the plant, or a recording ends; wall times differ a little."""
    flight = fly("coordinated_control", parameters={"coordinated_control.time_limit": 2.0})
    given = flight.signal("expected_momenta")
    recorded = Signal(given.time[lacking] + late, given.values[lacking])
    found = replace(flight, series={**flight.series, "expected_momenta": recorded})
    moved = np.linalg.norm(flight.momentum[:, :3] - flight.momentum[0, :3], axis=1).max()
    assert moved > 0.1
    assert np.all(found.momentum_drift < 1e-9)
    pushes = np.linalg.norm(np.diff(flight.momentum[:, :3], axis=0), axis=1)
    assert found.thrust_impulse == pytest.approx(pushes.sum(), rel=1e-6)


def test_a_flight_keeps_its_parameters_if_the_caller_changes_the_array() -> None:
    q = np.array([0.1, 0.0, 0.0])
    given = {"plant.initial_joint_positions": q, "plant.faults": []}
    flight = fly("faults/stuck_slider", parameters={**QUICK, **given})
    q[0] = 0.2
    again = flight.scenario.with_parameters({"plant.tick_rate": 10.0})
    assert again.plant.initial_joint_positions == (0.1, 0.0, 0.0)


def test_flights_bags_and_robots_are_pickled_after_use(tmp_path: Path) -> None:
    flight = fly("coordinated_control", parameters={"coordinated_control.time_limit": 0.05})
    summary = flight.summary()
    flight.save(tmp_path / "a.mcap")
    bag = read_bag(tmp_path / "a.mcap")
    tables = bag.to_pandas()
    same, again = pickle.loads(pickle.dumps((flight, bag)))
    np.testing.assert_equal(same.summary(), summary)
    assert repr(again) == repr(bag)
    assert all(again.to_pandas()[topic].equals(table) for topic, table in tables.items())
    robot = SpaceRobot.from_file(robot_file("planar_manipulator"))
    heavy = robot.with_inertial(replace(robot.inertial, masses=2 * robot.inertial.masses))
    for each in (robot, heavy):
        copied, q = pickle.loads(pickle.dumps(each)), [0.1] * each.n
        assert repr(copied) == repr(each)
        np.testing.assert_array_equal(copied.inertia_matrix(q), each.inertia_matrix(q))


@pytest.fixture
def _laws() -> Iterator[None]:
    """Leave the registry as it was."""
    before = dict(LAWS)
    yield
    LAWS.clear()
    LAWS.update(before)


@pytest.mark.usefixtures("_laws")
def test_a_flight_takes_a_law_that_is_in_no_registry() -> None:
    short = {"coordinated_control.time_limit": 0.05}
    for options in ({"singular_value_threshold": 0.25}, None):
        flight = fly("coordinated_control", law=_HalfLaw, law_options=options, parameters=short)
        assert flight.method == "half"
    assert _HalfLaw.thresholds == [0.25, 0.1]
    assert fly("coordinated_control", parameters=short).method == "transposed_jacobian"
    assert len(_HalfLaw.thresholds) == 2


@pytest.mark.usefixtures("_laws")
@pytest.mark.parametrize(
    ("scenario", "given", "words"),
    [
        ("sliding_masses", {"law": _HalfLaw}, ("'half'", "planner")),
        ("coordinated_control", {"law_options": {"a": 1}}, ("law=MyLaw",)),
        ("coordinated_control", {"law": "model_based"}, ("not a class", "method=")),
        ("coordinated_control", {"law": _HalfLaw, "law_options": {"a": 1}}, ("half", "'a'")),
    ],
)
def test_a_law_that_nothing_can_use_is_refused(
    scenario: str, given: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(ParameterError) as refused:
        fly(scenario, **given)
    assert_one_sentence(str(refused.value), *words)


def test_a_flight_takes_the_goals_that_a_plan_takes() -> None:
    at, hand = (0.25, -0.5, 0.125), (1.0, 2.0, 3.0)
    hands = end_effector_goals(hand, None, "hand")
    turn, pose = (0.0, 0.0, 0.5), (*at, 0.0, 0.0, 0.0, 1.0)
    scenarios = [
        scenario_to_fly("sliding_masses", position=at),
        scenario_to_fly("reach", hands=hands),
        scenario_to_fly("reach", position=at, hands=hands),
        scenario_to_fly("reach", rotvec=turn, hands=hands),
        scenario_to_fly("reach", pose, hands=hands),
    ]
    goals = [scenario.goal for scenario in scenarios]
    np.testing.assert_allclose(goals[0].position, at)
    for goal in goals[1:]:
        (aim,) = goal.end_effectors
        assert aim.link == "hand"
        np.testing.assert_allclose(aim.position, hand)
    assert [set(goal.base) for goal in goals[1:]] == [
        set(),
        {"position"},
        {"attitude"},
        {"position", "attitude"},
    ]


def test_the_package_names_what_it_offers() -> None:
    for name in spacerobot_ros.__all__:
        assert getattr(spacerobot_ros, name)


def test_a_plan_takes_the_parameters_that_a_flight_takes() -> None:
    given: dict[str, Any] = {"planner.lie_bracket.t1": 4.0}
    schedule = plan("faults/stuck_slider", method="lie_bracket", parameters=given)
    other = plan("faults/stuck_slider", method="lie_bracket")
    assert schedule.duration != other.duration
    flight = fly(
        "faults/stuck_slider", method="lie_bracket", parameters={**given, "plant.faults": []}
    )
    assert flight.schedules[0][1].duration == schedule.duration
    # A robot is then taken as a flight takes it, with the start of the plant.
    goal: dict[str, Any] = {"rotvec": (0.0, 0.0, 0.02), "method": "optimal"}
    start = {"plant.initial_joint_positions": [0.1, 0.2, 0.3, -0.1]}
    assert plan("surveyor", parameters=start, **goal).positions[0] == pytest.approx(
        start["plant.initial_joint_positions"]
    )
    words: dict[str, Any]
    for words, message in (
        ({"planer.x": 1}, "'planer.x' is not a parameter: write it as node.parameter"),
        ({}, "'surveyor' has no goal: give one"),
    ):
        with pytest.raises(ParameterError, match=message):
            plan("surveyor", parameters=words)


AWAY = goal_at(([0.05, -0.03, 0.02], [0.0, 0.0, 0.0]))


def problem(robot: str = "sliding_masses", **start: Any) -> PlanningProblem:
    config = configured(PlannerConfig, {**QUICK_PLANS, "position_tolerance": 1e-3})
    return PlanningProblem("a test", robot_of(robot), InitialState(**start), AWAY, config)


class Halves(StubMethod):
    """Goes half of the way with each schedule; ``enough`` of them reach the goal."""

    enough = 1000

    def plan(self, request: PlanRequest, *_: Any) -> GaitSchedule:
        self.partial = True
        self.overshoot = 1.0 if len(self.requests) + 1 >= self.enough else 0.0
        return replace(super().plan(request), remaining=2.5)


def test_partial_schedules_follow_each_other_until_the_goal_is_reached() -> None:
    method, seen = Halves(ticks=20), list[str]()
    with report_progress(lambda progress: seen.append(progress.message)):
        trial = try_method(problem(), "stub", method)
    assert seen == [f"piece {n}, {n} of about {n + 2.5} s" for n in range(1, 7)]
    # 0.0616 m halved six times is less than 1 mm.
    assert (len(trial.pieces), trial.reached) == (6, True)
    assert trial.error.distance == pytest.approx(0.03082207 / 32, rel=1e-5)
    assert trial.duration == pytest.approx(6 * 20 * TICK)
    assert trial.positions.shape == (121, 3)
    assert [request.correction for request in method.requests] == [False] + 5 * [True]
    assert method.requests[0].previous is None
    assert [r.previous for r in method.requests[1:]] == [*trial.pieces[:-1]]
    time = trial.path.time
    assert (time[0], time[-1]) == (0.0, pytest.approx(6.0))
    assert np.all(np.diff(time) >= 0)


def test_what_has_reached_the_goal_goes_no_further_though_it_is_partial() -> None:
    method = Halves(ticks=40)
    method.enough = 1
    trial = try_method(problem(), "stub", method)
    assert (len(trial.pieces), trial.reached) == (1, True)


def test_a_whole_schedule_is_the_last_one_though_it_misses() -> None:
    method = StubMethod(ticks=40)
    method.overshoot = 0.1
    trial = try_method(problem(), "stub", method)
    assert (len(trial.pieces), trial.reached) == (1, False)
    assert trial.error.distance == pytest.approx(0.1 * np.linalg.norm(AWAY.position), rel=1e-6)


@pytest.mark.parametrize(("robot", "axes"), [("sliding_masses", 3), ("planar_chain", 1)])
def test_random_goals_are_spread_evenly_over_a_ball_and_over_angles(robot: str, axes: int) -> None:
    at = problem(robot, position=(0.3, -0.2, 0.5))
    pose = at.plant().pose
    goals = random_goals(at, 600, 0.4, 0.7)
    offsets = np.array([goal.position for goal in goals]) - pose[:3]
    radii = np.linalg.norm(offsets, axis=1)
    assert radii.max() <= 0.4
    # Of the volume: the share within r is (r / 0.4)^3.
    shares = np.sort((radii / 0.4) ** 3)
    assert np.abs(shares - (np.arange(600) + 0.5) / 600).max() < 0.06
    assert np.abs(offsets.mean(axis=0)).max() < 0.04
    turns = Rotation.from_quat(pose[3:]).inv() * Rotation.from_quat([g.quaternion for g in goals])
    angles = turns.magnitude()
    assert angles.max() <= 0.7
    assert np.abs(np.sort(angles / 0.7) - (np.arange(600) + 0.5) / 600).max() < 0.06
    spread = np.linalg.svd(turns.as_rotvec(), compute_uv=False)
    assert np.count_nonzero(spread > 0.1 * spread[0]) == axes
    # To either side.
    assert np.abs(turns.as_rotvec().mean(axis=0)).max() < 0.04
    again = random_goals(at, 3, 0.4, 0.7)
    assert all(np.array_equal(a.position, b.position) for a, b in zip(goals, again, strict=False))
    for bounds in ((np.nan, 0.7), (0.4, np.inf), (-0.1, 0.7), (0.4, -0.7)):
        with pytest.raises(ParameterError, match="Random goals lie within"):
            random_goals(at, 3, *bounds)


def test_goals_are_counted_by_what_became_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are reached within 1e-5, whatever the tolerance of the planner is."""
    method = StubMethod(ticks=40)
    monkeypatch.setattr(PlanningProblem, "method", lambda self, name: method)
    far = Goal(np.array([2.0, 0.0, 0.0]), AWAY.quaternion)
    lines: list[str] = []

    def show(line: str) -> None:
        lines.append(line)
        method.overshoot = 1e-2

    results = try_goals(problem(), [AWAY, far, AWAY], ["stub"], show)
    first, refused, last = results["stub"]
    assert isinstance(first, PlanEvaluation)
    assert isinstance(last, PlanEvaluation)
    assert (first.reached, str(refused), last.reached) == (True, "It is too far.", False)
    assert first.duration == last.duration == pytest.approx(2.0)
    assert lines[0].startswith("goal 1, stub: 2 s, ")
    assert lines[1] == "goal 2, stub: It is too far."
    assert lines[2].endswith(f" rad and {1e-2 * np.linalg.norm(AWAY.position):.2g} m off")


def test_a_method_that_refuses_is_no_trial() -> None:
    method = StubMethod()
    method.refusing = True
    with pytest.raises(PlanningError, match="too far"):
        try_method(problem(), "stub", method)
