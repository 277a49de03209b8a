"""The table, the figure and the animation of a flight whose arrays are made up."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.animation
import numpy as np
import pytest
from matplotlib.colors import to_hex
from scipy.spatial.transform import Rotation

from spacerobot_ros import fly, read_bag, read_run
from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.errors import ParameterError, RecordingError
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.series import Commands, SentGoal, Signal, goal_at_end
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import load_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario

ROOT = Path(__file__).parents[2]
ROBOT = load_robot(robot_file("servicer"))
N = len(ROBOT.joint_names)
TURN = Rotation.from_rotvec([0.3, -0.2, 0.1])
GOAL = Goal.checked([0.5, -0.25, 1.0], TURN.as_quat())
HAND = Goal.checked([1.0, 2.0, 3.0], Rotation.from_rotvec([0.0, 0.0, 0.5]).as_quat())


def made_flight(name: str = "servicer_thrusters", **changed: Any) -> Flight:
    """Return a flight of three states; no two numbers in it are equal."""
    rng = np.random.default_rng(5)
    time = np.array([0.5, 1.0, 1.75])
    turns = Rotation.from_rotvec(np.outer([0.1, 0.4, 0.9], [0.1, 0.2, 0.3]))
    arrays = {
        "pose": np.hstack([rng.normal(size=(3, 3)), turns.as_quat()]),
        "twist": rng.normal(size=(3, 6)),
        "q": rng.uniform(-1.0, 1.0, (3, N)),
        "qdot": rng.normal(size=(3, N)),
        "effort": rng.normal(size=(3, N)),
        "momentum": rng.normal(size=(3, 7)),
        "measured_pose": rng.normal(size=(3, 7)),
        "measured_twist": rng.normal(size=(3, 6)),
        "measured_q": rng.normal(size=(3, N)),
        "measured_qdot": rng.normal(size=(3, N)),
        "end_effector_pose": rng.normal(size=(3, 7)),
        "thruster_duty": rng.uniform(size=(3, 4)),
        "thruster_on_time": rng.uniform(size=(3, 4)),
        "thruster_force": rng.uniform(size=(3, 4)),
        "propellant": np.array([[0.0], [0.25], [0.625]]),
        "pose_lost": np.array([[0.0], [1.0], [0.0]]),
    }
    series = {name: Signal(time, values) for name, values in arrays.items()}
    late = Signal(time[1:], rng.normal(size=(2, 6)))
    wrench = Commands(np.array([0.5, 1.0]), np.array([[3.0, 0, 4, 0, 5, 12], [0, 0, 1, 2, 0, 0]]))
    parts: dict[str, Any] = {
        "scenario": load_scenario(name),
        "robot": ROBOT,
        "joint_names": tuple(ROBOT.joint_names),
        "series": {**series, "expected_momenta": late},
        "commands": {"base_wrench": wrench},
        "statuses": (),
        "events": (),
        "outcome": Outcome.REACHED,
        "message": "The goal is reached.",
        "goal": GOAL,
        "end_effector_goal": HAND,
        "wall_time": 0.25,
        "plan_time": 2.5,
    }
    return Flight(**(parts | changed))


FLIGHT = made_flight()


POSE = [f"position.{axis}" for axis in "xyz"] + [f"orientation.{axis}" for axis in "xyzw"]
TWIST = [f"{kind}.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
MOMENTUM = [f"{kind}_{axis}" for kind in ("linear", "angular") for axis in "xyz"]


def state_columns(before: str) -> dict[str, list[str]]:
    """Return the columns of odom and joint_states by quantity, with the words before them."""
    joints = ROBOT.joint_names
    prefix = f"{before}." if before else ""
    quantity = f"{before}_" if before else ""
    return {
        f"{quantity}pose": [f"{prefix}pose.pose.{word}" for word in POSE],
        f"{quantity}twist": [f"{prefix}twist.twist.{word}" for word in TWIST],
        f"{quantity}q": [f"{prefix}position[{joint}]" for joint in joints],
        f"{quantity}qdot": [f"{prefix}velocity[{joint}]" for joint in joints],
    }


def test_a_table_names_every_number_and_has_a_row_a_state() -> None:
    table = FLIGHT.to_pandas()
    assert table.index.name == "time"
    assert table.index.tolist() == [0.5, 1.0, 1.75]
    wanted: dict[str, list[str]] = {
        **state_columns(""),
        **state_columns("measured"),
        "effort": [f"effort[{joint}]" for joint in ROBOT.joint_names],
        "momentum": [f"momentum.data[{word}]" for word in (*MOMENTUM, "kinetic_energy")],
        "end_effector_pose": [f"end_effector_pose.pose.{word}" for word in POSE],
        # The robot has 24 thrusters and the flight four, which have no names.
        "thruster_duty": [f"thrusters.velocity[{i}]" for i in range(4)],
        "thruster_on_time": [f"thrusters.position[{i}]" for i in range(4)],
        "thruster_force": [f"thrusters.effort[{i}]" for i in range(4)],
        "propellant": ["propellant"],
        "pose_lost": ["pose_lost"],
    }
    of_joints = [f"measured.effort[{joint}]" for joint in ROBOT.joint_names]
    names = [name for each in wanted.values() for name in each]
    assert sorted(table.columns) == sorted([*names, *of_joints]), "a row for every state only"
    for quantity, columns in wanted.items():
        for k, name in enumerate(columns):
            assert table[name].tolist() == FLIGHT.signal(quantity).values[:, k].tolist()


@pytest.mark.parametrize("scenario", ["coordinated_control", "faults/noisy_sensors"])
def test_a_flight_and_its_bag_have_one_name_and_unit_for_one_number(
    scenario: str, tmp_path: Path
) -> None:
    flight = fly(scenario)
    flight.save(tmp_path / "flight.mcap")
    bag = read_bag(tmp_path / "flight.mcap")
    truth = "_true" if "odom_true" in bag else ""
    places = {f"odom{truth}": "", f"joint_states{truth}": "", "momentum": "momentum."}
    if truth:
        places |= {"odom": "measured.", "joint_states": "measured."}
    table, dataset = flight.to_pandas(euler=True), flight.to_xarray(euler=True)
    units, seen = table.attrs["units"], set()
    for topic, prefix in places.items():
        recorded, arrays = bag.to_pandas(topic, euler=True), bag.to_xarray(topic, euler=True)
        own = [str(name) for name in recorded if f"{prefix}{name}" in table]
        seen |= {prefix + name for name in own}
        rows = recorded.index
        for name in own:
            np.testing.assert_array_equal(recorded[name], table.loc[rows, prefix + name])
            assert recorded.attrs["units"][name] == units[prefix + name]
        for array in arrays.data_vars:
            if f"{prefix}{array}" in dataset:
                assert dataset[f"{prefix}{array}"].attrs == arrays[array].attrs
                assert dataset[f"{prefix}{array}"].shape[1:] == arrays[array].shape[1:]
    joint, kind = flight.joint_names[0], "pose.pose.yaw"
    assert {f"position[{joint}]", f"velocity[{joint}]", f"effort[{joint}]", kind} <= seen
    assert units[kind] == "rad"
    assert {name for name in table.columns if name.startswith(("pose.", "twist."))} <= seen


@pytest.mark.parametrize("pushed", [True, False])
@pytest.mark.parametrize("name", ["servicer_thrusters", "sliding_masses"])
def test_a_figure_has_a_panel_for_each_quantity(name: str, pushed: bool) -> None:
    commands = FLIGHT.commands if pushed else {}
    made = made_flight(name, commands=commands).plot()
    efforts = load_scenario(name).plant.actuation == "effort"
    joints = ["joint efforts, N or N m"] if efforts else ["joint rates, 1/s"]
    labels = ["position, m", "rotation vector, rad", "joints, m or rad", *joints]
    labels += ["thrust"] * pushed
    assert [panel.get_ylabel() for panel in made.axes] == labels
    assert [panel.get_xlabel() for panel in made.axes] == [""] * (len(labels) - 1) + ["time, s"]
    method = "optimal" if name == "sliding_masses" else load_scenario(name).controller.law
    assert made.get_suptitle() == f"{name}, {method}: The goal is reached."
    rotvecs = Rotation.from_quat(FLIGHT.pose[:, 3:]).as_rotvec()
    shown = [FLIGHT.pose[:, :3], rotvecs, FLIGHT.q, FLIGHT.effort if efforts else FLIGHT.qdot]
    goals = [GOAL.position, TURN.as_rotvec()]
    for number, (panel, values) in enumerate(zip(made.axes, shown, strict=False)):
        drawn = [line for line in panel.get_lines() if len(line.get_xdata()) == 3]
        assert [line.get_label() for line in drawn] == (list("xyz"), list(ROBOT.joint_names))[
            number > 1
        ]
        for line, column in zip(drawn, values.T, strict=True):
            assert line.get_xdata().tolist() == [0.5, 1.0, 1.75]
            np.testing.assert_allclose(line.get_ydata(), column, atol=1e-12)
        levels = [line for line in panel.get_lines() if len(line.get_xdata()) == 2]
        if number < 2:
            assert [line.get_ydata()[0] for line in levels] == pytest.approx(list(goals[number]))
            colours = [[to_hex(line.get_color()) for line in each] for each in (drawn, levels)]
            assert colours[0] == colours[1]
        else:
            assert levels == []
    if pushed:
        force, torque = made.axes[4].get_lines()
        assert force.get_xdata().tolist() == [0.5, 1.0]
        assert (force.get_label(), torque.get_label()) == ("force, N", "torque, N m")
        assert force.get_ydata().tolist() == [5.0, 1.0]
        assert torque.get_ydata().tolist() == [13.0, 2.0]


def test_attitudes_are_drawn_without_jumps_and_a_flight_without_a_goal_without_levels() -> None:
    vectors = np.outer([2.9, 3.1, 3.3], [0.6, 0.0, -0.8])
    turns = Rotation.from_rotvec(vectors).as_quat()
    poses = Signal(FLIGHT.time, np.hstack([FLIGHT.pose[:, :3], turns]))
    for goal in (None, Goal.checked(GOAL.position, turns[2])):
        flight = made_flight(goal=goal, series={**FLIGHT.series, "pose": poses}, commands={})
        lines = [line.get_ydata() for line in flight.plot().axes[1].get_lines()]
        drawn = [line for line in lines if len(line) == 3]
        np.testing.assert_allclose(np.transpose(drawn), vectors, atol=1e-12)
        # The goal is where the attitude ends.
        levels = [line[0] for line in lines if len(line) == 2]
        assert levels == pytest.approx([] if goal is None else vectors[2])


class Film:
    """Stands for matplotlib's animation; its pictures are drawn when the test asks."""

    def __init__(self, figure: Any, draw: Any, *, frames: int, interval: float) -> None:
        self.axes, self.draw, self.frames = figure.axes[0], draw, frames
        self.interval, self.html = interval, ""

    def to_jshtml(self, *, default_mode: str) -> str:
        assert default_mode == "loop"
        return (
            '<link rel="x"\nhref="y">A<i class="fa fa-pause"></i><i class="fa fa-own"></i>'
            '<i class="fa fa-play fa-flip-horizontal"></i>'
        )


@pytest.fixture
def films(monkeypatch: pytest.MonkeyPatch) -> list[Film]:
    made: list[Film] = []

    def make(*args: Any, **options: Any) -> Film:
        made.append(Film(*args, **options))
        return made[-1]

    monkeypatch.setattr(matplotlib.animation, "FuncAnimation", make)
    return made


def skeleton(flight: Flight, row: int, pose: np.ndarray) -> dict[str, tuple[Any, Any]]:
    """Return the origin and the centre of mass of each link in the world, from the URDF's tree."""
    shape = dict(zip(ROBOT.joint_names, flight.q[row].tolist(), strict=True))
    frames = ROBOT.with_locked(shape).frames
    r_WB, R_WB = pose[:3], Rotation.from_quat(pose[3:]).as_matrix()
    found = {}
    for link in ROBOT.links:
        _, in_base = frames[link.name]
        com = in_base.r + in_base.R @ link.inertia.com
        found[link.name] = (r_WB + R_WB @ in_base.r, r_WB + R_WB @ com)
    return found


def test_an_animation_shows_links_between_joints_and_centres_of_mass(films: list[Film]) -> None:
    shown = FLIGHT.animate(seconds=2.0, frames=3)
    (film,) = films
    assert film.frames == 3
    assert film.interval == pytest.approx(2000.0 / 3)
    assert shown.html == "A⏸own◀"
    assert repr(shown).startswith("<Animation, 0.0 MB of HTML")
    origins = {name for joint in ROBOT.joints for name in (joint.parent, joint.child)}
    every = []
    for k in range(3):
        drawn = film.draw(k)
        assert film.axes.get_title() == ("0.50 s", "1.00 s", "1.75 s")[k]
        points = skeleton(FLIGHT, k, FLIGHT.pose[k])
        ends = [points[name] for name in points if name in origins]
        ends += [(points[j.parent][1], points[j.child][0]) for j in ROBOT.joints]
        wanted = sorted(np.round(np.ravel(end), 6).tolist() for end in ends)
        lines = [np.transpose(line.get_data_3d()) for line in drawn[:-1]]
        found = sorted(np.round(np.ravel(line), 6).tolist() for line in lines)
        np.testing.assert_allclose(found, wanted, atol=2e-6)
        dots = np.transpose(drawn[-1].get_data_3d())
        assert len(dots) == 2 * len(lines) - 2 * len(ROBOT.joints)
        every.append(dots)
    goal = skeleton(FLIGHT, -1, np.concatenate([GOAL.position, GOAL.quaternion]))
    every.append(np.array([each for pair in goal.values() for each in pair]))
    low, high = np.vstack(every).min(axis=0), np.vstack(every).max(axis=0)
    limits = np.array([film.axes.get_xlim(), film.axes.get_ylim(), film.axes.get_zlim()])
    np.testing.assert_allclose(limits.mean(axis=1), (low + high) / 2)
    np.testing.assert_allclose(np.ptp(limits, axis=1), np.ptp([low, high], axis=0).max())
    labels = (film.axes.get_xlabel(), film.axes.get_ylabel(), film.axes.get_zlabel())
    assert labels == ("x, m", "y, m", "z, m")
    path = [line for line in film.axes.get_lines() if len(line.get_data_3d()[0]) == 3]
    np.testing.assert_array_equal(np.transpose(path[0].get_data_3d()), FLIGHT.pose[:, :3])


def test_pictures_of_an_animation_are_spread_over_the_flight(films: list[Film]) -> None:
    replace(FLIGHT, goal=None).animate(seconds=1, frames=2)
    FLIGHT.animate(seconds=1.0, frames=1000)
    FLIGHT.animate(frames=1)
    assert [film.frames for film in films] == [2, 3, 1]
    assert [film.interval for film in films] == pytest.approx([500.0, 1000.0 / 3, 8000.0])
    films[0].draw(1)
    assert films[0].axes.get_title() == "1.75 s"
    wrongs: list[dict[str, Any]] = [{"frames": 1001}, {"frames": 0}, {"frames": 2.5}]
    wrongs += [{"seconds": math.inf}, {"seconds": math.nan}, {"seconds": 0}]
    for wrong in wrongs:
        with pytest.raises(ParameterError, match="An animation"):
            FLIGHT.animate(**wrong)
    with pytest.raises(RecordingError) as refused:
        replace(FLIGHT, robot=None).animate()
    named = "The flight of 'servicer_thrusters' has no description of its robot."
    assert str(refused.value) == named


def test_columns_have_units_in_tables_and_datasets() -> None:
    table, dataset = FLIGHT.to_pandas(), FLIGHT.to_xarray()
    units = table.attrs["units"]
    joint = ROBOT.joint_names[0]
    assert list(units) == list(table.columns)
    expected = {
        **{"pose.pose.position.x": "m", "pose.pose.orientation.w": "1"},
        **{"twist.twist.angular.z": "rad/s", "twist.twist.linear.x": "m/s"},
        **{"momentum.data[linear_z]": "kg m/s", "momentum.data[angular_x]": "kg m^2/s"},
        **{"momentum.data[kinetic_energy]": "J", "propellant": "kg", "pose_lost": ""},
        **{f"position[{joint}]": "rad", f"velocity[{joint}]": "rad/s", f"effort[{joint}]": "N m"},
        **{f"measured.position[{joint}]": "rad", "measured.twist.twist.angular.x": "rad/s"},
        "end_effector_pose.pose.position.z": "m",
    }
    assert {name: units[name] for name in expected} == expected
    assert dataset.time.attrs == {"units": "s"}
    assert dataset["position"].sel(joint=joint).values.tolist() == FLIGHT.q[:, 0].tolist()
    assert dataset["position"].attrs == {"units": "rad"}
    assert dataset["momentum.data"].attrs["units"][-1] == "J"
    np.testing.assert_array_equal(dataset["pose.pose.position.y"], FLIGHT.pose[:, 1])
    for made in (table, dataset):
        assert made.attrs["scenario"] == "servicer_thrusters"
        assert made.attrs["message"] == "The goal is reached."


def test_thrusters_have_the_names_of_the_urdf() -> None:
    flight = read_run(ROOT / "bags" / "servicer_thrusters.mcap")
    bag = read_bag(ROOT / "bags" / "servicer_thrusters.mcap")
    found = [name for name in flight.to_pandas() if name.startswith("thrusters.")]
    recorded = bag.to_pandas("thrusters")
    assert found == [f"thrusters.{name}" for name in recorded if "[" in name]
    units = flight.to_pandas().attrs["units"]
    assert {units[name] for name in found} == {"s", "1", "N"}


def test_euler_angles_are_turns_about_fixed_axes_on_request() -> None:
    assert not any(name.endswith(".roll") for name in FLIGHT.to_pandas().columns)
    table = FLIGHT.to_pandas(euler=True)
    for part in ("pose.pose", "measured.pose.pose", "end_effector_pose.pose"):
        found = table[[f"{part}.{word}" for word in ("roll", "pitch", "yaw")]].to_numpy()
        quaternions = table[[f"{part}.orientation.{axis}" for axis in "xyzw"]].to_numpy()
        np.testing.assert_allclose(
            found, Rotation.from_quat(quaternions).as_euler("xyz"), atol=1e-12
        )
    assert table.attrs["units"]["measured.pose.pose.pitch"] == "rad"
    assert "pose.pose.yaw" in FLIGHT.to_xarray(euler=True)


def test_a_flight_says_how_it_ended_in_one_line() -> None:
    off = Offset(FLIGHT)
    assert repr(FLIGHT) == (
        f"<Flight of servicer_thrusters by {FLIGHT.method}: reached after 1.25 s (2 ticks, "
        f"0 corrections), {off.distance:.3g} m and {off.angle:.3g} rad from the goal. "
        f"{FLIGHT.verdict.sentence}>"
    )
    assert repr(made_flight(goal=None, end_effector_goal=None)).endswith(
        "0 corrections). The goal is reached.>"
    )


def test_errors_over_time_are_those_of_every_pose() -> None:
    gaps = np.linalg.norm(FLIGHT.pose[:, :3] - GOAL.position, axis=1)
    turns = (Rotation.from_quat(FLIGHT.pose[:, 3:]).inv() * TURN).magnitude()
    np.testing.assert_allclose(FLIGHT.errors, np.column_stack([gaps, turns]), atol=1e-12)
    off = Offset(FLIGHT)
    assert FLIGHT.errors[-1] == pytest.approx([off.distance, off.angle])
    assert made_flight(goal=None, end_effector_goal=None).errors.shape == (0, 2)


class Offset:
    """The error of a flight's last pose to :data:`GOAL`."""

    def __init__(self, flight: Flight) -> None:
        self.distance = float(np.linalg.norm(flight.pose[-1, :3] - GOAL.position))
        self.angle = (Rotation.from_quat(flight.pose[-1, 3:]).inv() * TURN).magnitude()


def test_a_summary_has_the_measures_by_their_names() -> None:
    gait = PlannerStatus(
        PlannerState.EXECUTING, method="area_loop", duration_s=7.5, notes={"loops": 3}
    )
    last = replace(gait, corrections=2, manoeuvre_time_s=6.5)
    flight = made_flight(gait=gait, status=last)
    found, off = flight.summary(), Offset(flight)
    # What thrusters explain is known from the second state on.
    left = flight.momentum[1:, :6] - flight.signal("expected_momenta").values
    drift = np.linalg.norm((left - left[0]).reshape(2, 2, 3), axis=2)
    linear, angular = drift.max(axis=0).tolist()
    end = flight.quantities["end_effector_pose"][-1, :3]
    rotvec = Rotation.from_quat(flight.pose[-1, 3:]).as_rotvec()
    assert found.pop("final_attitude_rotvec_rad") == pytest.approx(rotvec.tolist())
    assert found.pop("peak_joint_velocities") == np.abs(flight.qdot).max(axis=0).tolist()
    numbers = {name: found.pop(name) for name in list(found) if isinstance(found[name], float)}
    assert numbers == pytest.approx(
        {
            "position_error_m": off.distance,
            "attitude_error_rad": off.angle,
            "position_tolerance_m": 0.0005,
            "attitude_tolerance_rad": 0.001,
            "sim_time_s": 1.25,
            "manoeuvre_time_s": 6.5,
            "plan_time_s": 2.5,
            "wall_time_s": 0.25,
            "ticks_per_s": 8.0,
            "real_time_factor": 5.0,
            "momentum_drift": max(linear, angular),
            "linear_momentum_drift": linear,
            "angular_momentum_drift": angular,
            "end_effector_position_error_m": float(np.linalg.norm(end - HAND.position)),
            "propellant_kg": 0.625,
        }
    )
    assert found == {
        "scenario": "servicer_thrusters",
        "method": "area_loop",
        "goal": [*GOAL.position.tolist(), *GOAL.quaternion.tolist()],
        "final_position_m": flight.pose[-1, :3].tolist(),
        "final_joint_positions": flight.q[-1].tolist(),
        "joint_names": list(ROBOT.joint_names),
        "wheel_names": [],
        "ticks": 2,
        "corrections": 2,
        "gait": {"duration_s": 7.5, "loops": 3},
        "not_controlled": ["position"],
        "has_thrust": True,
        "state": "reached",
        "message": "The goal is reached.",
        "verdict": flight.verdict.sentence,
        "succeeded": False,
        "succeeded_by_measurement": True,
        "end_effector_final_position_m": end.tolist(),
    }
    instant = made_flight(wall_time=0.0).summary()
    assert (instant["ticks_per_s"], instant["real_time_factor"]) == (math.inf, math.inf)


def flown_by(*labels: str, goal: Goal = GOAL) -> Flight:
    report = CommandReport("law", False, 1.0, 0.0, 0.0, 0.0, 0.0, dict.fromkeys(labels, 0.25))
    status = ControllerStatus(ControllerState.REACHED, command=report)
    return made_flight(status=status, goal=goal)


def test_a_controller_controls_its_outputs() -> None:
    shaped = replace(GOAL, joint_positions=np.zeros(N))
    assert flown_by("base.y", "base.rz", "joint.a", goal=shaped).not_controlled == ()
    assert flown_by("base.rz", "end_effector.x").not_controlled == ("position",)
    assert flown_by("base.z", goal=shaped).not_controlled == ("attitude", "shape")
    assert flown_by("joint.a").not_controlled == ("position", "attitude")
    assert made_flight(goal=None, end_effector_goal=None).not_controlled == ()
    off = Offset(turned := flown_by("base.rz"))
    assert f", {off.distance:.3g} m (not controlled) and {off.angle:.3g} rad from" in repr(turned)
    assert turned.summary()["not_controlled"] == ["position"]


def test_a_planner_names_what_it_does_not_control_and_bags_of_before_show_it() -> None:
    def planned(**about: Any) -> Flight:
        status = PlannerStatus(PlannerState.REACHED, method="optimal", **about)
        return made_flight("sliding_masses", status=status, gait=status)

    assert planned(not_controlled=("attitude",)).not_controlled == ("attitude",)
    tolerance = planned().tolerance("position")
    assert tolerance is not None
    assert planned(position_error_m=0.99 * tolerance).not_controlled == ()
    assert planned(position_error_m=1.01 * tolerance).not_controlled == ("position",)
    looped = PlannerStatus(PlannerState.EXECUTING, method="area_loop")
    assert made_flight("sliding_masses", gait=looped).not_controlled == ("position",)


def test_a_tolerance_is_the_commanders() -> None:
    assert FLIGHT.tolerance("position") == 0.0005
    assert FLIGHT.tolerance("attitude") == 0.001
    planned = load_scenario("sliding_masses").with_overrides(
        "planner", {"attitude_tolerance": 0.07}
    )
    assert made_flight(scenario=planned).tolerance("attitude") == 0.07
    bare = replace(load_scenario("servicer"), in_file={}, overrides={})
    assert made_flight(scenario=bare).tolerance("position") is None


def test_thrust_is_a_wrench_that_is_not_zero() -> None:
    assert FLIGHT.has_thrust
    assert not made_flight(commands={}).has_thrust
    idle = Commands(np.array([0.5]), np.zeros((1, 6)))
    assert not made_flight(commands={"base_wrench": idle}).has_thrust


def test_a_summary_has_the_turn_of_an_end_effector_that_a_controller_turns() -> None:
    assert "end_effector_attitude_error_rad" not in flown_by("end_effector.x").summary()
    flight = flown_by("end_effector.rx")
    turn = Rotation.from_quat(flight.quantities["end_effector_pose"][-1, 3:])
    wanted = (turn.inv() * Rotation.from_quat(HAND.quaternion)).magnitude()
    assert flight.summary()["end_effector_attitude_error_rad"] == pytest.approx(wanted)


def test_errors_of_named_end_effectors_are_those_of_their_links() -> None:
    """Of two the farther one counts; one without an attitude has no angle."""
    links = [link.name for link in ROBOT.links][-2:]
    points = skeleton(FLIGHT, -1, FLIGHT.pose[-1])
    near = points[links[0]][0] + [0.0, 0.3, -0.4]
    far = points[links[1]][0] + [2.0, 0.0, 0.0]
    hands = (EndEffectorGoal(links[0], near, HAND.quaternion), EndEffectorGoal(links[1], far, None))
    goal = replace(GOAL, end_effectors=hands, base=frozenset())
    flight = made_flight(goal=goal)
    errors = flight.end_effector_errors
    assert errors[links[0]].position == pytest.approx([0.0, 0.3, -0.4])
    shape = dict(zip(ROBOT.joint_names, FLIGHT.q[-1].tolist(), strict=True))
    R_WE = Rotation.from_quat(FLIGHT.pose[-1, 3:]) * Rotation.from_matrix(
        ROBOT.with_locked(shape).frames[links[0]][1].R
    )
    angle = (R_WE.inv() * Rotation.from_quat(HAND.quaternion)).magnitude()
    assert errors[links[0]].angle == pytest.approx(angle)
    assert errors[links[1]].distance == pytest.approx(2.0)
    assert errors[links[1]].angle == 0.0
    assert flight.error is None
    worst = flight.end_effector_error
    assert worst is not None
    assert worst.position.tolist() == errors[links[1]].position.tolist()
    summary = flight.summary()
    assert summary["goal"] is None
    assert (summary["position_error_m"], summary["attitude_error_rad"]) == (None, None)
    assert summary["end_effectors"][links[1]]["position_error_m"] == pytest.approx(2.0)
    assert summary["end_effectors"][links[0]]["attitude_error_rad"] == pytest.approx(angle)
    assert summary["end_effectors"][links[1]]["attitude_error_rad"] is None
    assert "end_effector_final_position_m" not in summary


def test_a_part_of_a_signal_includes_its_ends() -> None:
    signal = Signal(np.array([0.0, 0.1, 0.2, 0.3]), np.arange(8.0).reshape(4, 2))
    part = signal.between(0.1, 0.2 + 1e-12)
    assert (len(part), part.width, part.time.tolist()) == (2, 2, [0.1, 0.2])
    flight = made_flight(series={})
    sizes = {"pose": 7, "momentum": 7, "end_effector_pose": 7, "measured_pose": 7, "q": N}
    sizes |= {"twist": 6, "measured_twist": 6, "expected_momenta": 6, "effort": N}
    for name, size in sizes.items():
        assert flight.signal(name).values.shape == (0, size)
    assert (flight.duration, flight.manoeuvre_time, flight.propellant) == (0.0, 0.0, None)
    assert flight.error is None


@pytest.mark.parametrize(
    ("statuses", "x"),
    [
        ([], 3.0),
        ([(PlannerState.IDLE, "", ())], 3.0),
        ([(PlannerState.EXECUTING, "b", ())], 2.0),
        ([(PlannerState.REACHED, "b", ()), (PlannerState.PLANNING, "c", ())], 2.0),
        # An id that was not sent is of a goal that the status names itself.
        ([(PlannerState.EXECUTING, "d", (7.0, 0, 0, 0, 0, 0, 1))], 7.0),
        ([(PlannerState.FAILED, "d", ())], 3.0),
        # Bags of version 0.1 have no ids; the sent goal has more digits.
        ([(PlannerState.ABORTED, "", (1.0 + 9e-8, 0, 0, 0, 0, 0, 1))], 1.0),
        ([(PlannerState.ABORTED, "", (1.0 + 3e-7, 0, 0, 0, 0, 0, 1))], 1.0 + 3e-7),
        ([(PlannerState.ABORTED, "", (1.0, 0, 0, 0, 0, 3e-7, 1))], 1.0),
    ],
)
def test_the_goal_at_the_end_is_the_last_one_flown_to(statuses: list[Any], x: float) -> None:
    sent = [
        SentGoal(k + 0.5, Goal.checked([k + 1.0, 0, 0], [0, 0, 0, 1]), name)
        for k, name in enumerate("abc")
    ]
    given = [PlannerStatus(state, goal_id=name, goal=goal) for state, name, goal in statuses]
    goal = goal_at_end(given, sent)
    assert goal is not None
    assert goal.position[0] == x
    attitude = statuses[-1][2][3:] if statuses and statuses[-1][2] else (0, 0, 0, 1)
    assert goal.quaternion[2] == pytest.approx(attitude[2], abs=1e-12)
    assert goal_at_end(given, ()) is None or statuses
