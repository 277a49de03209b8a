"""Every number of error that the project shows, against one from the bag by other libraries.

The bag is read by ``mcap`` and ``mcap-ros2-support``, rotations are scipy's: distance is the
Euclidean norm, angle the rotation angle, from the last true pose of the base to its goal.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.command_line import spacerobot
from support.html_page import Page, present
from support.slow import some_fast

from spacerobot_ros import fly, read_run
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.reading import open_flight_bag, read_flight
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.measures import Outcome, metrics_of_each
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.page_parts import PagePart
from spacerobot_ros.report.writing import page
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session import run
from spacerobot_ros.session.run import RunResult
from spacerobot_ros.viewer.content import goal_errors, status_html
from spacerobot_ros.viewer.state import StackState

pytest.importorskip("mcap_ros2")

ROOT = Path(__file__).parents[2]
BAGS = ROOT / "bags"


def _vector(message: Any) -> np.ndarray:
    position, turn = message.position, message.orientation
    return np.array(
        [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w], dtype=float
    )


def decoded(bag: Path, *topics: str) -> Iterator[tuple[str, Any]]:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with bag.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics):
            yield channel.topic, message


def apart(pose: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    """Return the distance, m, and the angle, rad, between two poses (7,)."""
    turn = Rotation.from_quat(pose[3:]).inv() * Rotation.from_quat(goal[3:])
    return float(np.linalg.norm(goal[:3] - pose[:3])), float(turn.magnitude())


def errors_in(bag: Path) -> tuple[float, float]:
    """Return distance, m, and angle, rad, of the base at the end of a bag with one goal."""
    first: dict[str, np.ndarray] = {}
    last: dict[str, np.ndarray] = {}
    for topic, message in decoded(bag, "/odom", "/odom_true", "/goal_pose"):
        last[topic] = _vector(message.pose if topic == "/goal_pose" else message.pose.pose)
        first.setdefault(topic, last[topic])
    goal, pose = last["/goal_pose"], last.get("/odom_true", last["/odom"])
    goal = np.where(np.isnan(goal), first["/odom"], goal)  # NaN: as at the start.
    return apart(pose, goal)


HAND = ("/end_effector_pose", "/end_effector/goal_pose")


def end_effector_errors_in(bag: Path) -> tuple[float, float] | None:
    """Return distance, m, and angle, rad, of a controller's end-effector from its goal at the end
    of a bag; None: it has no such goal.
    """
    last = {topic: _vector(message.pose) for topic, message in decoded(bag, *HAND)}
    return apart(*(last[topic] for topic in HAND)) if len(last) == 2 else None


def shape_error_in(bag: Path) -> np.ndarray:
    """Return the errors of the joints (n,) at the end of a bag with one shape to end in."""
    topics = ("/joint_states", "/joint_states_true", "/goal_joint_states")
    last = {
        topic: dict(zip(message.name, message.position, strict=True))
        for topic, message in decoded(bag, *topics)
    }
    shape = last.get("/joint_states_true", last["/joint_states"])
    return np.array([value - shape[name] for name, value in last["/goal_joint_states"].items()])


def texts_of(page: str) -> list[str]:
    """Return the texts of a page, in their order."""
    # A number with an exponent is an element of its own, and no end of the text.
    return Page(re.sub(r'<span class="unbroken">([^<]*)</span>', r"\1", page)).texts


def shown(text: str, pattern: str) -> float:
    """Return the one number of a text in the place of ``#`` in a pattern, in m, rad or deg.

    One that is said to be less than a millionth is 0.
    """
    found = re.search(pattern.replace("# ", r"(< )?([-+.\de]+) ([mµ]?)"), text)
    assert found is not None, (pattern, text)
    return 0.0 if found[1] else float(found[2]) * {"": 1.0, "m": 1e-3, "µ": 1e-6}[found[3]]


def printed_lines(summary: dict[str, Any]) -> list[str]:
    """Return what the command prints of a flight that comes to this summary."""
    result = RunResult(summary | {"plan_time_s": 0.0, "wall_time_s": 1.0})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "run_scenario", lambda *_, **__: result)
        return spacerobot("run", "sliding_masses", code=None).stdout.splitlines()


def assert_all_say(bag: Path, flight: Flight, *, position_counts: bool) -> None:
    """Compare what terminal, JSON, report, live page, campaign and ``repr`` say with the truth."""
    off, turned_off = errors_in(bag)

    def same(distance: float, angle: float, digits: int) -> None:
        slack = 0.51 * 10 ** (1 - digits)
        # An angle near zero is the difference of numbers near one.
        least = 1e-6 if digits == 3 else 1e-12
        assert distance == pytest.approx(off, rel=slack, abs=least)
        assert angle == pytest.approx(turned_off, rel=slack, abs=max(least, 1e-8))

    summary = flight.summary() | {"bag": str(bag), "messages_recorded": 0}
    same(summary["position_error_m"], summary["attitude_error_rad"], 9)
    assert ("position" in summary["not_controlled"]) is not position_counts

    lines = printed_lines(summary)
    position, attitude = (next(x for x in lines if x.startswith(y)) for y in ("posi", "atti"))
    same(shown(position, r"m, # m from the goal"), shown(attitude, r"rad, # rad ="), 3)
    degrees = shown(attitude, r"= # deg from")
    assert degrees == pytest.approx(math.degrees(turned_off), rel=0.006, abs=6e-4)
    assert ("(not controlled)" in position) is not position_counts

    left = repr(flight)
    same(shown(left, r", # m"), shown(left, r"and # rad from the goal"), 3)

    robot = flight.required_robot()
    (metrics,) = metrics_of_each([flight.measured(clearance=False)], robot)
    same(metrics["position_error_m"], metrics["attitude_error_rad"], 9)

    report = read_report(bag)
    texts = texts_of(page(report, PagePart(""), []))
    cards = texts[texts.index("Position error") :], texts[texts.index("Attitude error") :]
    near, turned = (" ".join(x.strip() for x in card[:5]) for card in cards)
    same(shown(near, r" # m\b"), shown(turned, r" # rad"), 3)
    assert ("not controlled" in near) is not position_counts
    tables = [texts[len(texts) - texts[::-1].index(name) :] for name in ("Position error",)]
    tables += [texts[len(texts) - texts[::-1].index("Attitude error") :]]
    in_table = [" ".join(x.strip() for x in table[:3]) for table in tables]
    same(shown(in_table[0], r"(?:^| )# m"), shown(in_table[1], r"(?:^| )# rad"), 3)

    verdict = next(text for text in texts if text == flight.verdict.sentence)
    assert lines[0].endswith(verdict)
    if flight.outcome is not Outcome.ABORTED:
        assert bool(re.search(r"[mµ]?m and [^,]* [mµ]?rad from", verdict)) is position_counts
        distance = shown(verdict, "(?:: |is )# m") if position_counts else off
        same(distance, shown(verdict, "# rad"), 3)

    distance, angle = goal_errors(state_of(flight), ForwardKinematics(robot))["base"]
    same(distance, angle, 9)
    head = live_head(flight, bag)
    line = next(text for text in head if text.startswith("base is "))
    same(shown(line, r"base is # m"), shown(line, r"and # rad"), 3)
    assert ("m (not controlled)" in line) is not position_counts
    if position_counts:
        assert shown(line, r"\(tolerance # m") == pytest.approx(flight.tolerance("position"))
    assert shown(line, r"tolerance.* # rad\)") == pytest.approx(flight.tolerance("attitude"))


def assert_all_say_of_the_end_effector(bag: Path, flight: Flight) -> None:
    """Compare the errors of a controller's end-effector likewise."""
    found = present(end_effector_errors_in(bag))
    distance, angle = found
    summary = flight.summary() | {"bag": str(bag), "messages_recorded": 0}
    assert summary["end_effector_position_error_m"] == pytest.approx(distance, rel=1e-9)
    (metrics,) = metrics_of_each([flight.measured(clearance=False)], flight.required_robot())
    assert metrics["end_effector_position_error_m"] == pytest.approx(distance, rel=1e-9)
    report = read_report(bag)
    texts = texts_of(page(report, PagePart(""), []))
    card = " ".join(texts[texts.index("End-effector error") :][:3])
    lines = printed_lines(summary)
    printed = next(line for line in lines if line.startswith("end-effector"))
    live = next(x for x in live_head(flight, bag) if x.startswith("end_effector is "))
    numbers = (
        shown(card, r"error # m"),
        shown(printed, r"\) m, # m"),
        shown(live, r"end_effector is # m"),
    )
    assert numbers == pytest.approx((distance,) * 3, rel=6e-3)
    if flight.turns_end_effector:
        assert summary["end_effector_attitude_error_rad"] == pytest.approx(angle, rel=1e-9)
        turns = (shown(card, r" # rad;"), shown(printed, r"and # rad"), shown(live, r"and # rad"))
        assert turns == pytest.approx((angle,) * 3, rel=6e-3)
    else:
        assert "end_effector_attitude_error_rad" not in summary
        assert "rad" not in card
        assert "rad" not in printed
        assert shown(live, r"# rad \(not controlled\) from its goal") == pytest.approx(
            angle, rel=6e-3
        )


def live_head(flight: Flight, bag: Path) -> list[str]:
    """Return the lines of the live page at the end of a flight, while its goal is pursued."""
    state = state_of(flight)
    last = {topic: _vector(message.pose) for topic, message in decoded(bag, *HAND)}
    tool, goal = (last.get(topic) for topic in HAND)
    state = replace(state, tool=tool)
    if goal is not None:
        goals = {**state.goals, "end_effector": Goal(goal[:3], goal[3:])}
        state = replace(state, goals=goals)
    if isinstance(flight.status, PlannerStatus):
        # Planners of earlier versions, and of their bags, did not name the parts.
        left_out = flight.not_controlled
        flying = replace(flight.status, state=PlannerState.EXECUTING, not_controlled=left_out)
        state = replace(state, planner=flying)
    else:
        state = replace(state, controller=flight.status)
    position, attitude = flight.tolerance("position"), flight.tolerance("attitude")
    assert position is not None
    assert attitude is not None
    errors = goal_errors(state, ForwardKinematics(flight.required_robot()))
    return texts_of(status_html(state, errors, Tolerance(position, attitude)))


def state_of(flight: Flight) -> StackState:
    """Return the state of a stack at the end of a flight, as the live page has it."""
    from spacerobot_ros.viewer.state import Measured

    assert flight.goal is not None
    last = {name: flight.signal(name).values[-1] for name in ("pose", "q", "qdot", "effort")}
    measured = Measured(float(flight.time[-1]), **last)
    return replace(StackState(), measured=measured, goals={"base": flight.goal})


@pytest.mark.parametrize(
    ("name", "position_counts"), [("servicer_thrusters", True), ("planar_chain", False)]
)
def test_errors_of_recorded_flights(name: str, position_counts: bool) -> None:
    bag = BAGS / f"{name}.mcap"
    flight = read_flight(open_flight_bag(bag))
    assert_all_say(bag, flight, position_counts=position_counts)
    if name == "servicer_thrusters":
        assert flight.turns_end_effector
        assert_all_say_of_the_end_effector(bag, flight)
    # The report reads the goals in the messages, the terminal that of the scenario.
    assert flight.verdict.sentence == read_run(bag).verdict.sentence
    if name == "planar_chain":
        error = np.abs(shape_error_in(bag)).max()
        assert error < 1e-6
        assert " and < 1 µm or µrad at the joints from the goal" in flight.verdict.sentence


def test_a_goal_of_the_end_effector_alone_is_judged_by_its_error(tmp_path: Path) -> None:
    bag, goal = tmp_path / "far.mcap", np.array([9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    short = {"coordinated_control.time_limit": 40.0}
    flight = fly("servicer", end_effector_pose=goal, parameters=short)
    flight.save(bag)
    read = read_flight(open_flight_bag(bag))
    assert read.verdict == flight.verdict
    hand = read.signal("end_effector_pose").values[-1]
    numbers = [shown(read.verdict.sentence, f"# {unit}") for unit in ("m and", "rad from the goal")]
    assert numbers == pytest.approx(apart(hand, goal), rel=6e-3)


def test_a_goal_that_only_the_measured_pose_reaches_is_not_called_reached(tmp_path: Path) -> None:
    """The position is measured 0.1 m off; its tolerance is 0.001 m."""
    flight, bag = fly("faults/biased_pose"), tmp_path / "biased.mcap"
    assert (flight.succeeded, flight.succeeded_by_measurement) == (False, True)
    flight.save(bag)
    assert errors_in(bag)[0] == pytest.approx(0.1, abs=1e-3)
    read = read_flight(open_flight_bag(bag))
    for each in (flight, read):
        assert not each.verdict.complete
        assert each.verdict.word == "Reached according to the measured pose"
    assert_all_say(bag, read, position_counts=True)
    report = page(read_report(bag), PagePart(""), [])
    outcome = "<b>Reached according to the measured pose</b>"
    assert f'<p class="outcome reached partly">{outcome}' in report
    command = spacerobot("run", "faults/biased_pose", "--bag", f"{bag}.again", code=1)
    assert command.stderr == ""
    assert command.stdout.splitlines()[0].endswith(f": {flight.verdict.sentence}")
    # With sensors that do not err the same goal is reached.
    believed = fly(load_scenario("faults/biased_pose").with_overrides("plant", {"faults": [""]}))
    assert (believed.verdict.word, believed.verdict.complete) == ("Reached", True)


def test_a_robot_that_is_moved_after_its_goal_is_elsewhere() -> None:
    """As by a reset: the last state is the first one again."""
    flight = read_run(BAGS / "sliding_masses.mcap")
    assert flight.goal is not None
    pose, goal = flight.signal("pose"), [*flight.goal.position, *flight.goal.quaternion]
    back = Signal(np.append(pose.time, pose.time[-1] + 1), np.vstack([pose.values, pose.values[0]]))
    moved = replace(flight, series={**flight.series, "pose": back}).verdict.sentence
    reached, elsewhere = moved.split(" At the end of the flight, the robot is elsewhere: ")
    assert reached == flight.message
    distance, _ = apart(pose.values[0], np.array(goal))
    assert shown(elsewhere, "# m and") == pytest.approx(distance, rel=6e-3)


DRAWS = """
campaign:
  scenario: {scenario}
  flights: 3
  seed: 7
  set: {settings}
  disperse: {disperse}
  criteria: {{attitude_error_rad: {{max: {limit}}}}}
"""


TOO_WEAK = {
    "coordinated_control.error_margin.position": 0.01,
    "coordinated_control.max_force": 1.0,
    "plant.disturbances": ["base_link force -30 0 20 torque 0 0 -3"],
}
"""Settings of thrusters that are too weak for a load, and lose control of the base."""


MASSES = "{mass.*: {norm: {loc: 1.0, scale: 0.02}}}"
PLACE = "{goal.position.x: {uniform: [-0.01, 0.01]}}"
CAMPAIGNS = [
    ("servicer_thrusters", PLACE, "flights"),
    ("servicer", MASSES, "lanes"),
    ("planar_chain", MASSES, "flights"),
    ("faults/wrong_masses", PLACE, "flights"),
    ("aborted", MASSES, "flights"),
]


@pytest.mark.parametrize(("name", "disperse", "engine"), some_fast(CAMPAIGNS, slow=CAMPAIGNS[2:]))
def test_errors_of_campaigns(name: str, disperse: str, engine: str, tmp_path: Path) -> None:
    """Rows as pandas reads them, the page and the terminal, against the bags of the same draws."""
    pandas = pytest.importorskip("pandas")
    aborted = name == "aborted"
    scenario = "coordinated_control" if aborted else name
    settings = json.dumps(TOO_WEAK if aborted else {})

    def text(limit: float) -> str:
        given = {"scenario": scenario, "settings": settings, "disperse": disperse}
        return DRAWS.format(**given, limit=limit)

    file, folder = tmp_path / "draws.yaml", tmp_path / "draws"
    file.write_text(text(1.0))
    spacerobot("campaign", file, "--out", folder, "--workers", "0")
    rows = pandas.read_parquet(folder / "flights").sort_values("flight")
    assert rows["flight"].tolist() == [0, 1, 2]
    assert set(rows["engine"]) == {engine}
    truths = {"position_error_m": list[float](), "attitude_error_rad": list[float]()}
    hands = {f"end_effector_{each}": list[float]() for each in truths}
    for number in range(3):
        bag = tmp_path / f"{number}.mcap"
        spacerobot("campaign", "rerun", folder, number, "--bag", bag)
        for each, value in zip(truths.values(), errors_in(bag), strict=True):
            each.append(value)
        hand = end_effector_errors_in(bag) or (math.nan, math.nan)
        for each, value in zip(hands.values(), hand, strict=True):
            each.append(value)
    if aborted:  # The law leaves the attitude of the end-effector alone.
        hands["end_effector_attitude_error_rad"] = [math.nan] * 3
    if name == "planar_chain":
        del truths["position_error_m"]  # Its goal has no position.
    for column, values in (truths | hands).items():
        assert rows[column].tolist() == pytest.approx(values, rel=1e-6, abs=1e-9, nan_ok=True)
    assert set(rows["outcome"]) == {"aborted" if aborted else "reached"}
    if name == "faults/wrong_masses":
        assert (rows["corrections"] > 0).all()

    # Between the middle and the largest of three: two of them meet it.
    middle, largest = sorted(truths["attitude_error_rad"])[1:]
    limit = (middle + largest) / 2
    file.write_text(text(limit))
    asked = tmp_path / "asked"
    printed = spacerobot("campaign", file, "--out", asked, "--workers", "0").stdout
    required = next(line for line in printed.splitlines() if line.startswith("required"))
    assert "66.67 % (2 of 3" in required
    passed = 0 if aborted else 2
    success = next(line for line in printed.splitlines() if line.startswith("success"))
    assert f"({passed} of 3;" in success
    tables = Page((asked / "report.html").read_text()).tables
    head, *shown_rows = tables["percentiles"]
    cells = {row[0]: dict(zip(head, row, strict=True)) for row in shown_rows}
    for column, values in truths.items():
        shown_there = cells[column]
        for label, value in (("minimum", min(values)), ("maximum", max(values))):
            assert float(shown_there[label]) == pytest.approx(value, rel=6e-4, abs=1e-8)
    head, *shown_rows = tables["worst"]
    for row in shown_rows:
        at = dict(zip(head, row, strict=True))
        for column, values in truths.items():
            value = values[int(at["flight"])]
            assert float(at[column]) == pytest.approx(value, rel=6e-4, abs=1e-8)


@pytest.mark.slow
def test_errors_of_a_flight_with_corrections(tmp_path: Path) -> None:
    flight, bag = fly("faults/wrong_masses"), tmp_path / "corrected.mcap"
    assert flight.corrections > 0
    flight.save(bag)
    assert_all_say(bag, read_flight(open_flight_bag(bag)), position_counts=True)


@pytest.mark.slow
def test_errors_of_a_flight_that_is_aborted(tmp_path: Path) -> None:
    flight, bag = fly("coordinated_control", parameters=TOO_WEAK), tmp_path / "aborted.mcap"
    assert flight.outcome is Outcome.ABORTED
    flight.save(bag)
    read = read_flight(open_flight_bag(bag))
    assert_all_say(bag, read, position_counts=True)
    assert_all_say_of_the_end_effector(bag, read)
