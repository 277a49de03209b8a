"""What a person reads in a report, word for word, of flights written by hand.

No figure is drawn: tables and page are made of what the bag holds.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from sensor_msgs.msg import JointState
from support.flight_bags import Story, cyclic_shapes, tell
from support.html_page import Page, present
from support.made_bags import array, joint_states, made_bag, odometry, pose, stamped, status

from spacerobot_ros.bag import read_bag
from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.series import Commands, Signal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.report.figures import ReportFigure
from spacerobot_ros.report.figures_over_time import (
    attitude_group,
    position_figure,
    position_group,
    sensors_figure,
    shape_groups,
    thrusters_figure,
)
from spacerobot_ros.report.figures_space import cycles_figure
from spacerobot_ros.report.flight import FlightReport, joint_unit, pose_errors, read_report
from spacerobot_ros.report.page_parts import PagePart, tiles
from spacerobot_ros.report.tables import (
    different_goals,
    headline,
    joint_table,
    published_table,
    result_table,
    runs_table,
)
from spacerobot_ros.report.writing import page
from spacerobot_ros.resources import share_directory
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario

NAMES = ["slide", "turn"]
STILL = (0.0,) * 6
HALF = math.sin(0.1), math.cos(0.1)
"""Of a quaternion that turns by 0.2 rad."""

URDF = """<robot name="tester">
<link name="base"><inertial><mass value="10"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<link name="a"><inertial><mass value="2.5"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<link name="b"><inertial><mass value="1.25"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="a"/>
<axis xyz="1 0 0"/><limit lower="-1.5" upper="2.5" velocity="0.8" effort="5"/></joint>
<joint name="turn" type="continuous"><parent link="a"/><child link="b"/>
<axis xyz="0 1 0"/><limit velocity="3.2" effort="7"/></joint>
</robot>"""

GOAL = (1.0, 2.0, 3.0, 0.0, -math.sin(0.05), 0.0, math.cos(0.05))
"""Turned by -0.1 rad about y."""


def planner(state: PlannerState, time: float, sentence: str = "", **more: Any) -> Any:
    more.setdefault("goal_id", "5.000000000")
    return "planner/status", PlannerStatus(state, sentence, **more), time


def controller(state: ControllerState, time: float, *errors: str, goal_id: str = "") -> Any:
    command = CommandReport("a_law", False, 1.0, 0.0, 0.0, 0.0, 0.0, dict.fromkeys(errors, 0.1))
    status = ControllerStatus(state, "A sentence.", goal_id, command if errors else None)
    return "controller/status", status, time


NOTES: dict[str, Any] = {"zf": [1.23456, 2.0]}
FLOWN = (
    planner(PlannerState.EXECUTING, 5.0, method="lie_bracket", notes=NOTES),
    planner(PlannerState.EXECUTING, 6.0, method="lie_bracket", notes={"zf": [9.0, 9.0]}),
    planner(PlannerState.REACHED, 6.5, "The goal is reached."),
)


def flight(path: Path, statuses: Any = FLOWN, **options: Any) -> FlightReport:
    """Write four states 0.5 s apart from 5 s on; the base ends 0.3 rad and (0.3, 0, -0.4) m off.

    Joints go from (0.125, -0.5) to (-0.625, 1.75), their largest rates are 0.2 and -0.4; momenta
    swing by 5 and 6 times 4e-9 and come back.
    """
    metadata = options.pop("metadata", {})
    urdf, name = options.pop("urdf", URDF), options.pop("name", "flight.mcap")
    goals, more = options.pop("goals", (GOAL,)), options.pop("more", lambda say, time, k: None)
    names = options.pop("names", NAMES)
    assert not options
    with made_bag(path / name) as (bag, say):
        for key, values in metadata.items():
            bag.add_metadata(key, values)
        if urdf:
            bag.add_attachment("robot_description.urdf", urdf.encode(), "application/xml", 0)
        for n, goal in enumerate(goals):
            say("/goal_pose", pose(5.0 + n, *goal), 5.0 + n)
        for topic, told, time in statuses:
            say(f"/{topic}", status(told.to_values(), told.message), time)
        for k in range(4):
            time, last = 5.0 + 0.5 * k, k == 3
            swing = (0.0, 3e-9, -4e-9, 0.0)[k]
            turn = (0.0, HALF[0], 0.0, HALF[1]) if last else (0.0, 0.0, 0.0, 1.0)
            say("/odom", odometry(time, 0.7, 2.0, 3.4 * last, *turn, *STILL), time)
            rates = [(0.0, 0.0), (0.2, -0.4), (0.1, 0.3), (-0.1, 0.0)][k]
            shape = [0.125 - 0.25 * k, 0.75 * k - 0.5]
            say("/joint_states", joint_states(time, names, shape, list(rates)), time)
            say("/momentum", array(1 + 3 * swing, 4 * swing, 0, 0, 0, 2 - 6 * swing, 0.5), time)
            more(say, time, k)
    return read_report(path / name)


def rows_of(found: FlightReport) -> dict[str, str]:
    return {row[0]: row[1] for row in result_table(found).rows}


# -- tables -----------------------------------------------------------------------------------


def test_the_numbers_on_top(tmp_path: Path) -> None:
    assert headline(flight(tmp_path)) == [
        ("Position error", "0.5 m", ""),
        ("Attitude error", "0.3 rad", "17.2°"),
        ("Manoeuvre", "1.5 s", "2 schedules in the whole flight"),
        ("Momentum drift", "2e-08 kg m/s", "angular 2.4e-08 kg m²/s"),
        ("Recorded", "3 ticks", "1.5 s, ticks of 0.5 s"),
    ]


def test_cards_of_tolerances_thrusters_and_propellant(tmp_path: Path) -> None:
    tolerances = {"position_tolerance": "0.02", "attitude_tolerance": "0.06"}
    found = flight(tmp_path, metadata={"parameters/planner": tolerances})
    wrench = Commands(np.array([0.5]), np.array([[0.0, 0.0, 0.0, 0.0, 0.25, 0.0]]))
    used = Signal(np.array([0.0, 1.0]), np.array([[0.0], [0.01234]]))
    thrusting = replace(
        found, commands={"base_wrench": wrench}, series={**found.series, "propellant": used}
    )
    cards = {label: (value, note) for label, value, note in headline(thrusting)}
    assert cards["Position error"] == ("0.5 m", "tolerance 20 mm")
    assert cards["Attitude error"] == ("0.3 rad", "17.2°; tolerance 60 mrad")
    drift = "2e-08 kg m/s", "angular 2.4e-08 kg m²/s"
    assert cards["Momentum not explained by thrusters"] == drift
    assert "Momentum drift" not in cards
    assert cards["Propellant"] == ("12.3 g", "")


def test_traces_break_and_totals_begin_anew_at_a_reset(tmp_path: Path) -> None:
    def more(say: Any, time: float, k: int) -> None:
        if k == 2:
            event = Event(EventKind.RESET, "It is back.", time_s=time)
            say("/events", status(event.to_values(None), event.message), time)

    found = flight(tmp_path, more=more)
    assert found.resets == [1.0]
    period = found.control_period
    times = np.array([0.0, 0.5, 1.5])
    commands = {"base_wrench": Commands(times, np.outer([1.0, 1.0, 2.0], [0, 1, 0, 0, 0, 0]))}
    assert replace(found, commands=commands).thrust_impulse == pytest.approx(2.0 * period)
    figure = present(position_figure(found))
    (group,) = figure.groups
    at = np.flatnonzero(np.isnan(group.signal.values).all(axis=1))
    assert group.signal.time[at].tolist() == [1.5]
    assert np.isfinite(group.values).all()


def test_a_goal_that_is_reached_but_for_a_part_is_not_called_reached(tmp_path: Path) -> None:
    statuses = [
        planner(PlannerState.EXECUTING, 5.0, method="area_loop"),
        planner(PlannerState.REACHED, 6.5, "Done.", not_controlled=("position",)),
    ]
    text = page(flight(tmp_path, statuses), PagePart(""), [])
    assert (
        '<p class="outcome reached partly"><b>Reached, except for the position</b>'
        "Done. Not controlled: position.</p>"
    ) in text


def test_the_numbers_of_the_run(tmp_path: Path) -> None:
    assert result_table(flight(tmp_path)).rows == [
        ("Goal position", "(1.00000, 2.00000, 3.00000) m"),
        ("Goal attitude", "rotation vector (0.00000, -0.10000, 0.00000) rad, 5.730° in total"),
        ("Final position", "(0.70000, 2.00000, 3.40000) m"),
        ("Final attitude", "rotation vector (0.00000, 0.20000, 0.00000) rad, 11.459° in total"),
    ]


def test_a_position_that_is_not_controlled_is_called_so(tmp_path: Path) -> None:
    statuses = [planner(PlannerState.EXECUTING, 5.0, method="area_loop")]
    found = flight(tmp_path, statuses)
    cards = headline(found)
    assert cards[0] == ("Position error", "not controlled", "0.5 m from the goal")
    assert cards[1] == ("Attitude error", "0.3 rad", "17.2°")
    assert rows_of(found)["Goal position"] == "(1.00000, 2.00000, 3.00000) m"
    assert position_group(found).goals == []
    assert len(attitude_group(found).goals) == 3


@pytest.mark.parametrize("order", [1, -1])
def test_the_joints_beside_their_limits(tmp_path: Path, order: int) -> None:
    names = NAMES[::order]
    table = present(joint_table(flight(tmp_path, names=names)))
    assert table.head == (
        *("Joint", "Type", "Unit", "Start", "Final"),
        *("Limits", "Peak velocity", "Limit", "Used"),
    )
    moves = [("0.12500", "-0.62500"), ("-0.50000", "1.75000")]
    peaks = [0.2, 0.4]
    rows = {
        "slide": ("prismatic", "m", "-1.5 to 2.5", "0.8 m/s", 0.8),
        "turn": ("continuous", "rad", "–", "3.2 rad/s", 3.2),
    }
    for row, name, move, peak in zip(table.rows, names, moves, peaks, strict=True):
        kind, unit, limits, limit, most = rows[name]
        share = f"{100 * peak / most:.1f} %"
        assert row == (name, kind, unit, *move, limits, f"{peak:.5f} {unit}/s", limit, share)


def test_joints_without_a_description_have_no_limits(tmp_path: Path) -> None:
    found = flight(tmp_path, urdf="")
    table = present(joint_table(found))
    assert table.rows[0] == (
        *("slide", "–", "m or rad", "0.12500", "-0.62500"),
        *("–", "0.20000 m or rad/s", "–", "–"),
    )
    assert joint_unit(found, "slide") == "m or rad"


PRINTED: list[dict[str, Any]] = [
    {"quantity": "zf", "printed": [1.2346], "note": "a note"},
    {"quantity": "peak_joint_velocities", "printed": [0.25, 0.5], "note": ""},
    {"quantity": "final_joint_positions", "printed": [1.0, 2.0], "note": ""},
    {"quantity": "final_attitude_rotvec_rad", "printed": [0.1, 0.2, 0.3], "note": ""},
    {"quantity": "final_position_m", "printed": [0.125, 2.0, 3.5], "note": ""},
    {"quantity": "position_error_m", "printed": [0.51], "note": ""},
    {"quantity": "attitude_error_rad", "printed": [0.0312], "note": ""},
    {"quantity": "manoeuvre_time_s", "printed": [2.0], "note": ""},
    {"quantity": "unknown", "printed": [1e-7], "note": ""},
]


def test_published_figures_have_as_many_decimals_as_were_printed(tmp_path: Path) -> None:
    scenario = {"name": "test", "published": json.dumps(PRINTED)}
    table = present(published_table(flight(tmp_path, metadata={"scenario": scenario})))
    assert table.rows == [
        # The rest of what the first schedule has, with the most decimals.
        ("zf", "1.2346", "1.2346, 2.0000", "planner", "a note"),
        ("peak_joint_velocities", "0.25, 0.5", "0.20, 0.4", "flight", ""),
        ("final_joint_positions", "1, 2", "-1, 2", "flight", ""),
        ("final_attitude_rotvec_rad", "0.1, 0.2, 0.3", "0.0, 0.2, 0.0", "flight", ""),
        ("final_position_m", "0.125, 2, 3.5", "0.700, 2, 3.4", "flight", ""),
        ("position_error_m", "0.51", "0.50", "flight", ""),
        ("attitude_error_rad", "0.0312", "0.3000", "flight", ""),
        ("manoeuvre_time_s", "2", "2", "flight", ""),
        ("unknown", "0", "–", "", ""),
    ]
    assert published_table(flight(tmp_path, name="other.mcap")) is None


def test_flights_side_by_side(tmp_path: Path) -> None:
    others = [flight(tmp_path), flight(tmp_path, (), name="bare.mcap", goals=())]
    table = runs_table(others)
    assert table.head == ("Flight", "flight", "bare")
    drift = "2e-08 kg m/s"
    assert table.rows == [
        ("Outcome", "Reached", "Interrupted"),
        ("Position error", "0.5 m", "–"),
        ("Attitude error", "0.3 rad", "–"),
        ("Manoeuvre", "1.5 s", "–"),
        ("Momentum drift", drift, drift),
        ("Recorded", "3 ticks", "3 ticks"),
    ]


def test_laws_side_by_side_have_their_peaks_and_impulses(tmp_path: Path) -> None:
    """Against the messages of the bags."""
    scenario, laws = load_scenario("coordinated_control"), ("transposed_jacobian", "model_based")
    for law in laws:
        of_law = scenario.with_method(law).with_settings(("coordinated_control.time_limit=3",))
        run_scenario(of_law, tmp_path / f"{law}.mcap")
    table = runs_table([read_report(tmp_path / f"{law}.mcap") for law in laws])
    assert table.head == ("Flight", *laws)
    rows = {name: values for name, *values in table.rows}
    assert rows["Outcome"] == ["Failed"] * 2
    for k, law in enumerate(laws):
        bag = read_bag(tmp_path / f"{law}.mcap")
        force, torque = (
            np.linalg.norm([bag["/base_wrench"].field(f"wrench.{part}.{x}") for x in "xyz"], axis=0)
            for part in ("force", "torque")
        )
        effort = np.abs(bag["/joint_commands"].field("effort"))
        for name, unit, truth in (
            ("Peak thruster force", "N", force.max()),
            ("Peak thruster torque", "N m", torque.max()),
            ("Peak joint torque", "N m", effort.max()),
            ("Thrust impulse", "N s", 0.01 * force.sum()),
        ):
            number, _, shown = rows[name][k].partition(" ")
            assert shown == unit
            assert float(number) == pytest.approx(truth, rel=0.01), name
        assert rows["Clearance"][k].endswith(" m")


def test_what_rounds_to_zero_has_no_sign(tmp_path: Path) -> None:
    (row,) = (
        row
        for row in result_table(flight(tmp_path, goals=((-1e-9, 0.0, -0.0, *GOAL[3:]),))).rows
        if row[0] == "Goal position"
    )
    assert row[1] == "(0.00000, 0.00000, 0.00000) m"


# -- which goal, and how long -----------------------------------------------------------------


def test_the_time_is_that_of_the_schedules_for_the_last_goal(tmp_path: Path) -> None:
    first, second = (0.0, 0.0, 1.0, *GOAL[3:]), GOAL
    statuses = [
        planner(PlannerState.EXECUTING, 5.0, method="optimal", goal=first, goal_id="5.000000000"),
        planner(PlannerState.EXECUTING, 5.25, method="optimal", goal=second, goal_id="6.000000000"),
        planner(PlannerState.EXECUTING, 5.75, method="auto", goal=second, goal_id="6.000000000"),
        planner(PlannerState.FAILED, 6.25, "Missed.", goal=second, goal_id="6.000000000"),
    ]
    found = flight(tmp_path, statuses, goals=(first, second))
    assert found.time_flown == 1.0
    assert found.flown_method == "optimal"
    assert present(found.base_goal).position.tolist() == [1.0, 2.0, 3.0]
    spans = [(t.start, t.end, t.goal.position[2]) for t in found.targets]
    assert spans == [(0.0, 0.25, 1.0), (0.25, 0.75, 3.0), (0.75, 1.5, 3.0)]
    goals = position_group(found).goals
    assert goals[:3] == [(0.0, 0.25, 0, 0.0), (0.0, 0.25, 1, 0.0), (0.0, 0.25, 2, 1.0)]
    # Without its last status it lasts to the end of the recording.
    cut = flight(tmp_path, statuses[:3], goals=(first, second), name="cut.mcap")
    assert cut.time_flown == 1.25


def test_the_time_is_what_the_planner_counts_and_the_time_to_the_end_is_beside_it(
    tmp_path: Path,
) -> None:
    """Between two schedules, a robot in real time waits for the plan."""
    statuses = [
        planner(PlannerState.EXECUTING, 5.0, method="a", manoeuvre_time_s=0.25, ends_at_s=5.25),
        planner(PlannerState.EXECUTING, 6.25, method="b", manoeuvre_time_s=0.5, ends_at_s=6.5),
        planner(PlannerState.REACHED, 6.5, manoeuvre_time_s=0.5, ends_at_s=6.5),
    ]
    found = flight(tmp_path, statuses)
    assert found.time_flown == 0.5
    tiles = {label: (value, note) for label, value, note in headline(found)}
    notes = "2 schedules in the whole flight; 1.5 s from the first schedule to the end"
    assert tiles["Manoeuvre"] == ("0.5 s", notes)


def test_a_flight_that_was_cut_off_has_not_flown_the_rest_of_its_schedule(tmp_path: Path) -> None:
    """Ctrl-C 0.5 s after the second of two schedules began, of which 39 s were left."""
    first: dict[str, Any] = {"method": "a", "duration_s": 0.5, "manoeuvre_time_s": 0.5}
    first["ends_at_s"] = 5.5
    second = {**first, "duration_s": 39.5, "manoeuvre_time_s": 40.0, "ends_at_s": 45.5}
    statuses = [
        planner(PlannerState.EXECUTING, 5.0, **first),
        planner(PlannerState.PLANNING, 5.5, manoeuvre_time_s=0.5, ends_at_s=5.5),
        planner(PlannerState.EXECUTING, 6.0, **second),
    ]
    found = flight(tmp_path, statuses)
    assert found.end == 1.5
    assert found.time_flown == 1.0
    # In the middle of planning nothing is left of the first.
    found = flight(tmp_path, statuses[:2], name="planning.mcap")
    assert found.time_flown == 0.5
    one_schedule = "1.5 s from the first schedule to the end"
    assert ("Manoeuvre", "0.5 s", one_schedule) in headline(found)
    # And what was flown to its end counts in full.
    reached = planner(PlannerState.REACHED, 6.5, manoeuvre_time_s=40.0, ends_at_s=45.5)
    found = flight(tmp_path, [*statuses, reached], name="reached.mcap")
    assert found.time_flown == 40.0


def test_a_goal_that_is_refused_in_flight_is_not_the_one_flown_to(tmp_path: Path) -> None:
    other = (9.0, 9.0, 9.0, *GOAL[3:])
    statuses = [
        planner(PlannerState.EXECUTING, 5.0, method="lie_bracket"),
        planner(PlannerState.REFUSED, 6.0, "Too far.", goal_id="6.000000000"),
    ]
    found = flight(tmp_path, statuses, goals=(GOAL, other))
    assert present(found.base_goal).position.tolist() == [1.0, 2.0, 3.0]
    assert "Goal position" in [row[0] for row in result_table(found).rows]
    # Where nothing was flown, the goal was refused, and is said to be.
    found = flight(tmp_path, statuses[1:], goals=(GOAL, other), name="refused.mcap")
    rows = rows_of(found)
    assert rows["Goal position (refused)"] == "(9.00000, 9.00000, 9.00000) m"
    assert "Goal attitude (refused)" in rows


def test_a_controller_and_the_components_that_it_controls(tmp_path: Path) -> None:
    def more(say: Any, time: float, k: int) -> None:
        say("/end_effector_pose", pose(time, 1.0 + k, 2.0, 3.0, 0.0, 0.0, *HALF), time)
        if k == 0:
            say("/end_effector/goal_pose", pose(time, 4.0, 2.0, 2.5, 0.0, 0.0, 0.0, 1.0), time)

    labels = ("base.x", "base.rz", "end_effector.y")
    statuses = [
        controller(ControllerState.HOLDING, 5.0, *labels),
        controller(ControllerState.TRACKING, 5.25, *labels, goal_id="5.000000000"),
        controller(ControllerState.TRACKING, 5.5, *labels, goal_id="5.000000000"),
        controller(ControllerState.REACHED, 6.25, *labels, goal_id="5.000000000"),
    ]
    found = flight(tmp_path, statuses, more=more)
    assert found.flown_method == "a_law"
    assert found.controls("base") == [0, 5]
    assert found.controls("end_effector") == [1]
    assert found.time_flown == 1.0
    rows = rows_of(found)
    assert rows["End-effector goal"] == "(4.00000, 2.00000, 2.50000) m"
    assert rows["End-effector, final"] == "(4.00000, 2.00000, 3.00000) m"
    assert ("End-effector error", "0.5 m", "") in headline(found)

    def aside(say: Any, time: float, k: int) -> None:
        if k == 0:
            say("/end_effector/goal_pose", pose(time, 4.5, 2.0, 2.5, 0.0, 0.0, 0.0, 1.0), time)

    other = flight(tmp_path, statuses, more=aside, name="aside.mcap")
    goals = "(4.00000, 2.00000, 2.50000) m", "(4.50000, 2.00000, 2.50000) m"
    assert different_goals([found, other]) == [("of end_effector", *goals)]
    turned = [
        controller(status.state, time, "end_effector.rx", goal_id=status.goal_id)
        for _, status, time in statuses
    ]
    found = flight(tmp_path, turned, more=more, name="turned.mcap")
    assert ("End-effector error", "0.5 m", "0.2 rad") in headline(found)
    assert rows_of(found)["End-effector goal"].endswith(" rad, 0.000° in total")
    assert rows_of(found)["End-effector, final"].endswith(" rad, 11.459° in total")
    # The base is not under control: its goal, if there is one, is nobody's.
    assert "Goal attitude" not in rows_of(found)


# -- what is drawn ----------------------------------------------------------------------------


def test_errors_are_goal_minus_measured_in_the_world(tmp_path: Path) -> None:
    found = flight(tmp_path)
    base = found.signal("pose")
    errors = pose_errors(base, found.targets)
    np.testing.assert_allclose(errors.values[0], [0.3, 0.0, 3.0, 0.0, -0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(errors.values[-1], [0.3, 0.0, -0.4, 0.0, -0.3, 0.0], atol=1e-12)
    np.testing.assert_array_equal(errors.time, [0.0, 0.5, 1.0, 1.0, 1.5])


def test_where_sensors_err_the_numbers_are_true_and_the_measured_ones_beside_them(
    tmp_path: Path,
) -> None:
    def more(say: Any, time: float, k: int) -> None:
        if k:  # They begin to err after the first state.
            true = (0.95, 2.0, 3.4 * (k == 3), 0.0, 0.0, HALF[0], HALF[1])
            say("/odom_true", odometry(time, *true, *STILL), time)
            shape = [0.125 - 0.25 * k, 0.75 * k - 0.4]
            say("/joint_states_true", joint_states(time, NAMES, shape, [0.0, 0.6]), time)

    found = flight(tmp_path, more=more)
    np.testing.assert_array_equal(found.pose[:, 0], [0.7, 0.95, 0.95, 0.95])
    np.testing.assert_allclose(found.q[:, 1], [-0.5, 0.35, 1.1, 1.85])
    assert found.qdot[:, 1].tolist() == [0.0, 0.6, 0.6, 0.6]
    assert present(found.error).distance == pytest.approx(math.hypot(0.05, 0.4))
    top = {label: (value, note) for label, value, note in headline(found)}
    assert top["Position error"] == ("0.403 m", "measured: 0.5 m")
    assert top["Attitude error"][1].endswith("; measured: 0.3 rad")
    figure = present(sensors_figure(found))
    position, attitude, turn = figure.groups
    np.testing.assert_allclose(position.signal.values, [[-0.25, 0, 0]] * 3, atol=1e-15)
    np.testing.assert_allclose(position.signal.time, [0.5, 1.0, 1.5])
    np.testing.assert_allclose(attitude.signal.values[0], [0, 0, -0.2], atol=1e-12)
    assert list(turn.names) == ["turn"], "the slider's sensor does not err"
    np.testing.assert_allclose(turn.signal.values, [[-0.1]] * 3)
    # Without such sensors all is as before.
    plain = flight(tmp_path, name="plain.mcap")
    assert sensors_figure(plain) is None
    assert not any("measured" in note for _, _, note in headline(plain))


def test_an_attitude_error_is_along_axes_of_the_world(tmp_path: Path) -> None:
    """A base turned by 90 deg about z, whose goal is turned by 0.1 rad more about the world's x."""
    c = math.sqrt(0.5)
    s, k = math.sin(0.05), math.cos(0.05)
    # (s, 0, 0, k) times (0, 0, c, c), by hand.
    goal = (0.0, 0.0, 0.0, s * c, -s * c, k * c, k * c)

    def more(say: Any, time: float, n: int) -> None:
        say("/end_effector_pose", pose(time, 0.0, 0.0, 0.0, 0.0, 0.0, c, c), time)
        if n == 0:
            say("/end_effector/goal_pose", pose(time, *goal), time)

    found = flight(tmp_path, more=more)
    errors = pose_errors(found.tool, found.tool_targets)
    np.testing.assert_allclose(errors.values[-1], [0, 0, 0, 0.1, 0, 0], atol=1e-12)


def test_joints_of_one_unit_share_a_panel_with_their_limits(tmp_path: Path) -> None:
    groups = shape_groups(flight(tmp_path))
    assert [(group.unit, list(group.names)) for group in groups] == [
        ("m", ["slide"]),
        ("rad", ["turn"]),
    ]
    assert groups[0].limits == [(0, -1.5), (0, 2.5)]
    np.testing.assert_allclose(groups[1].signal.values[:, 0], [-0.5, 0.25, 1.0, 1.75])


@pytest.mark.parametrize("urdf", [URDF, ""])
def test_efforts_are_those_of_the_joints_by_their_names(tmp_path: Path, urdf: str) -> None:
    """Without parameters, as other recorders write bags, and under efforts."""

    def more(say: Any, time: float, k: int) -> None:
        command = JointState(name=NAMES[::-1], effort=[2.0 * k, 1.0 * k])
        say("/joint_commands", stamped(command, time), time)

    for word, metadata in (
        ("none", {}),
        ("effort", {"parameters/plant": {"actuation": '"effort"'}}),
        ("velocity", {"parameters/plant": {"actuation": '"velocity"'}}),
    ):
        found = flight(tmp_path, more=more, urdf=urdf, metadata=metadata, name=f"{word}.mcap")
        last = found.efforts.values[-1:].tolist()
        assert last == ([] if word == "velocity" else [[3.0, 6.0]]), word
    # Joints without states are those of the description.
    with made_bag(tmp_path / "stateless.mcap") as (bag, say):
        if urdf:
            bag.add_attachment("robot_description.urdf", urdf.encode(), "application/xml", 0)
        for k in range(4):
            say("/odom", odometry(float(k), *GOAL, *STILL), float(k))
            more(say, float(k), k)
    efforts = read_report(tmp_path / "stateless.mcap").efforts
    assert efforts.values[-1].tolist() == ([3.0, 6.0] if urdf else [])


# -- the page ---------------------------------------------------------------------------------


def test_what_the_page_says_of_a_flight(tmp_path: Path) -> None:
    metadata = {
        "scenario": {"name": "a_scenario", "description": "What it is."},
        "spacerobot": {"version": "1.2.3"},
        "parameters/plant": {"tick_rate": "20.0"},
        "other": {"hidden": "nobody"},
    }
    found = flight(tmp_path, metadata=metadata)
    text = page(
        found, PagePart("<p>player</p>"), [ReportFigure("a", "Heading", "Caption.", Figure())]
    )
    content = Page(text)
    for words in (
        "a_scenario",
        "What it is.",
        "method lie_bracket",
        "robot tester: 2 joints, 13.75 kg",
        "ReachedThe goal is reached.",
        "Position error0.5 m",
        "Attitude error0.3 rad17.2°",
        "Figure 1. Heading. Caption.",
        "tick_rate20.0",
        f"Created from flight.mcap alone; flight.mcap has {found.bag.message_count} messages, "
        "recorded by spacerobot_ros 1.2.3.",
    ):
        assert words in content.text, words
    assert found.bag.message_count == 1 + 3 + 4 * 3
    assert "nobody" not in content.text
    assert "<title>a_scenario, lie_bracket, tester</title>" in text
    stopped = planner(PlannerState.ABORTED, 6.5, "Aborted: this node was deactivated.")
    ended = flight(tmp_path, (FLOWN[0], stopped), name="ended.mcap")
    assert "<b>Aborted</b>This node was deactivated." in page(ended, PagePart(""), [])
    cut = flight(tmp_path, FLOWN[:2], name="cut.mcap")
    assert "The recording ends before the outcome is known." in page(cut, PagePart(""), [])


def test_whatever_a_bag_holds_is_text_on_the_page(tmp_path: Path) -> None:
    def odd(n: int) -> str:
        return f"<i title='{n}'>&amp;\"{n}"

    escaped = {"<": "&lt;", ">": "&gt;", "&": "&amp;", '"': "&quot;"}
    urdf = URDF
    for n, name in ((1, "tester"), (2, "slide")):
        text = "".join(escaped.get(letter, letter) for letter in odd(n))
        urdf = urdf.replace(f'name="{name}"', f'name="{text}"')
    published = [{"quantity": odd(3), "printed": [1.0], "note": odd(4)}]
    metadata = {
        "scenario": {"name": odd(5), "description": odd(6), "published": json.dumps(published)},
        "spacerobot": {"version": odd(7)},
        f"parameters/{odd(8)}": {odd(9): odd(10)},
    }
    statuses = [
        planner(PlannerState.EXECUTING, 5.0, method=odd(11)),
        planner(PlannerState.REACHED, 6.0, odd(12)),
    ]
    found = flight(
        tmp_path, statuses, metadata=metadata, urdf=urdf, names=[odd(2), "turn"], name="<i>13&.mcap"
    )
    figures: list[ReportFigure | str] = [ReportFigure("a", odd(14), odd(15), Figure()), odd(16)]
    text = page(found, PagePart(""), figures, [found]) + tiles([(odd(17), odd(18), odd(19))])
    content = Page(text)
    assert "i" not in {tag for tag, _, _ in content.attributes}
    values = [value for *_, value in content.attributes]
    read = content.text + " ".join(values)
    for n in (*range(1, 13), *range(14, 20)):
        assert odd(n) in read, n
    assert "<i>13&.mcap" in content.text
    assert odd(14) in values, "the picture's other text"


# -- thrusters, and parts without measurements ------------------------------------------------


def test_propellant_is_what_the_plant_counted() -> None:
    bag = read_bag(share_directory() / "bags" / "servicer_thrusters.mcap")
    found = read_report(bag.path)
    counted = {
        time_ns / 1e9: float(pair.value)
        for time_ns, message in bag["diagnostics"].messages()
        for status in message.status
        for pair in status.values
        if pair.key == "propellant_kg"
    }
    assert max(counted.values()) > 5e-3
    propellant = found.series["propellant"]
    for time, value in counted.items():
        used = np.interp(time, propellant.time, propellant.values[:, 0])
        assert used == pytest.approx(value, rel=1e-6, abs=1e-9)
    # All thrusters of this robot push with 10 N: the impulse is that times how long they were on.
    on = bag["thrusters"].field("position")
    figure = present(thrusters_figure(found))
    impulse = next(each.signal for each in figure.groups if each.label == "impulse given")
    assert impulse.values[-1, 0] == pytest.approx(10.0 * float((on[-1] - on[0]).sum()))
    figure = present(thrusters_figure(found))
    fired = int((on[-1] > on[0]).sum())
    assert [len(group.names) for group in figure.groups] == [fired, 1, 1]
    assert f"{24 - fired} of 24 thrusters were never on" in figure.caption


@pytest.fixture(scope="module")
def looping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tell(tmp_path_factory.mktemp("looping") / "a.mcap", Story(cyclic_shapes()))


def test_a_flight_that_was_not_measured_at_its_end_is_drawn(looping: Path) -> None:
    whole = read_report(looping)
    early = whole.signal("pose").between(0.0, 0.5 * whole.end)
    cut = replace(whole, series={**whole.series, "pose": early})
    figure = present(position_figure(cut))
    assert figure.groups[0].signal.time[-1] < present(whole.cycles).last(3)[0]


@pytest.mark.parametrize(
    ("reports", "repeats"),
    [
        ([PlannerStatus(PlannerState.EXECUTING, "", method="lie_bracket")], True),
        ([PlannerStatus(PlannerState.EXECUTING, "", method="square_path")], True),
        ([PlannerStatus(PlannerState.EXECUTING, "", method="area_loop")], True),
        ([PlannerStatus(PlannerState.EXECUTING, "", method="optimal")], False),
        ([PlannerStatus(PlannerState.EXECUTING, "", method="resolved_rate")], False),
        ([PlannerStatus(PlannerState.EXECUTING, "", method="own_method")], True),
        ([ControllerStatus(ControllerState.TRACKING)], False),
        ([], True),
    ],
)
def test_cycles_are_those_of_a_method_that_repeats_them(
    reports: list[PlannerStatus | ControllerStatus], repeats: bool, looping: Path
) -> None:
    found = read_report(looping)
    vars(found)["timed_statuses"] = [(0.1, each) for each in reports]
    assert found.repeats_cycles is repeats
    assert (found.cycles is not None) is repeats
    assert (cycles_figure(found) is not None) is repeats
