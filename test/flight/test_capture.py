"""Flights that capture: the scenario, the servicing arm, held bodies, and momentum budgets."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import Array

from spacerobot_ros.bag import read_bag
from spacerobot_ros.bag.salvage import salvage_bag
from spacerobot_ros.control.wheels import BUDGET_PARTS
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.captures import held_bodies, momentum_budget_over_time, payload_estimates
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.flight.reading import namespaces, read_run
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.inertial_parameters import INERTIA_ENTRIES
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.payload_estimation import PAYLOAD_PARAMETERS
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.tables import headline
from spacerobot_ros.scenario import load_scenario

BAGS = Path(__file__).parents[2] / "bags"
TOPICS = ("/target/odom", "/momentum_expected", "/odom", "/joint_states")


def parameters_of(body: Inertia) -> Array:
    """Return the parameters (10,) of a body, in the order of PAYLOAD_PARAMETERS."""
    com, mass = body.com, body.mass
    about = body.about_com + mass * (com @ com * np.eye(3) - np.outer(com, com))
    six = (about[i, j] for i, j in INERTIA_ENTRIES)
    return np.array([mass, *(mass * com), *six])


def released(flight: Flight, time_s: float) -> Flight:
    event = Event(EventKind.RELEASED, "The target is released.", 0, time_s)
    return replace(flight, events=(*flight.events, event))


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly_scenario(load_scenario("capture"))


@pytest.fixture(scope="module")
def bag(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("capture") / "capture.mcap"
    flight.save(path)
    return path


def test_the_block_is_captured_at_once_and_brought_to_rest(flight: Flight) -> None:
    """Figures by Pinocchio."""
    assert flight.succeeded
    assert [each.kind for each in flight.events if each.time_s == 0.0] == [
        EventKind.RUNNING,
        EventKind.GOAL_ACCEPTED,
        EventKind.CAPTURED,
    ]
    capture = flight.summary()["capture"]
    assert (capture["time_s"], capture["captured"], capture["requested"]) == (0.0, True, False)
    np.testing.assert_allclose(capture["joint_rates_radps"], [-0.0362457, 0.0809148], atol=5e-8)
    np.testing.assert_allclose(capture["impulse_Ns"][:2], [-0.110519, -0.065737], atol=5e-7)
    assert capture["energy_lost_J"] == pytest.approx(0.0048564, abs=5e-8)
    assert capture["total_momentum_residual"] < 1e-12
    # Thrusters have taken the momentum of the block away.
    assert np.abs(flight.momentum[1, :6]).max() > 0.2
    assert np.abs(flight.momentum[-1, :6]).max() < 0.02
    assert flight.momentum_drift.max() < 1e-14
    assert flight.target is not None
    assert flight.target.name == "block"


def test_a_capture_is_measured(flight: Flight, bag: Path) -> None:
    """The block is caught at once, 0.3 m from its centre, and there is no detumbling."""
    measures = flight.measures.capture
    assert (measures["captured"], measures["placed"]) == (1.0, 1.0)
    assert measures["capture_time_s"] == 0.0
    assert measures["capture_impulse_Ns"] == pytest.approx(math.hypot(0.110519, 0.065737), abs=1e-6)
    assert measures["capture_angular_impulse_Nms"] == pytest.approx(0.035296, abs=1e-6)
    worst = np.abs(flight.capture["joint_impulses_Nms"]).max()
    assert measures["capture_joint_impulse"] == worst > 0.0
    # By the published poses: the grapple frame is 0.3 m from the block's centre.
    hand, block = flight.signal("end_effector_pose").values[0], flight.signal("target_pose")
    frame = block.values[0, :3] + Rotation.from_quat(block.values[0, 3:]).apply([-0.3, 0.0, 0.0])
    assert measures["capture_distance_m"] == pytest.approx(
        np.linalg.norm(frame - hand[:3]), abs=1e-12
    )
    assert measures["capture_distance_m"] < 0.01
    assert not measures.keys() & {"detumbling_time_s", "detumbling_bound_s"}
    assert read_run(bag).measures.capture == pytest.approx(measures, rel=1e-12)


def test_without_a_capture_the_nearest_distance_is_measured(flight: Flight) -> None:
    """The end-effector does not come nearer than at the beginning, and the truth is measured."""
    missed = replace(flight, events=flight.events[:2], series=dict(flight.series))
    measures = missed.measures.capture
    assert (measures["captured"], measures["placed"]) == (0.0, 0.0)
    assert not measures.keys() & {"capture_time_s", "capture_impulse_Ns"}
    nearest = measures["capture_distance_m"]
    assert nearest <= flight.measures.capture["capture_distance_m"]
    shifted = flight.signal("target_pose").values + np.array([0.0, 0.0, 0.7, 0, 0, 0, 0])
    series = {**flight.series, "true_target_pose": Signal(flight.time, shifted)}
    apart = replace(missed, series=series).measures.capture["capture_distance_m"]
    assert apart == pytest.approx(math.hypot(0.7, nearest), abs=1e-6)
    let_go = released(flight, 0.5).measures.capture
    assert (let_go["captured"], let_go["placed"]) == (1.0, 0.0)


def test_measured_targets_are_read_back_and_verified(tmp_path: Path) -> None:
    """With the truth beside them, and gaps where nothing was measured."""
    errors = {"position_noise": 0.004, "delay": 0.03, "loss": 0.25, "rate": 34.0}
    values = {f"target.sensors.{name}": value for name, value in errors.items()}
    scenario = load_scenario("capture").with_overrides("plant", values)
    flown = fly_scenario(scenario, longest=0.4)
    lost = flown.quantities["target_lost"][:, 0]
    assert 0.6 < lost.mean() < 0.95
    flown.save(tmp_path / "noisy.mcap")
    recorded = read_run(tmp_path / "noisy.mcap")
    seen, true = recorded.signal("target_pose"), recorded.signal("true_target_pose")
    np.testing.assert_array_equal(seen.values, flown.signal("target_pose").values[lost == 0.0])
    np.testing.assert_array_equal(true.values, flown.signal("true_target_pose").values)
    assert len(true.time) == len(flown.time) > len(seen.time) > 3
    assert verify_bag(tmp_path / "noisy.mcap").difference is None


def test_the_bag_of_a_capture_verifies_and_reads_as_it_was_flown(flight: Flight, bag: Path) -> None:
    found = verify_bag(bag)
    assert found.difference is None
    assert found.largest == 0.0
    assert set(TOPICS) <= set(found.topics)
    assert namespaces(read_bag(bag)) == [""]
    read = read_run(bag)
    assert read.capture == flight.capture
    np.testing.assert_array_equal(
        read.signal("target_pose").values, flight.signal("target_pose").values
    )
    assert read.target is not None
    assert read.target.base_link == "block"


def test_a_bag_that_was_cut_after_the_capture_is_salvaged_and_verifies(bag: Path) -> None:
    cut = bag.with_name("cut.mcap")
    shutil.copy(bag, cut)
    with cut.open("r+b") as file:
        file.truncate(int(bag.stat().st_size * 0.9))
    found = verify_bag(salvage_bag(cut).path)
    assert found.difference is None
    assert "/target/odom" in found.topics


def test_a_target_that_moved_otherwise_is_found(flight: Flight, bag: Path) -> None:
    pose = flight.signal("target_pose")
    values = pose.values.copy()
    values[100:, 1] += 1e-6
    series = {**flight.series, "target_pose": Signal(pose.time, values)}
    path = bag.with_name("moved.mcap")
    replace(flight, series=series).save(path)
    difference = verify_bag(path).difference
    assert difference is not None
    assert (difference.topic, difference.time) == ("/target/odom", 1.0)
    assert difference.field == "pose.pose.position.y"


def test_mujoco_does_not_capture(bag: Path) -> None:
    with pytest.raises(SpaceRobotError) as error:
        verify_bag(bag, mujoco=True)
    assert str(error.value) == (
        f"The bag {bag} has a target, whose capture MuJoCo does not model: verify it without the "
        "second engine."
    )


def test_a_block_that_passes_is_missed() -> None:
    flight = fly_scenario(load_scenario("faults/missed_capture"))
    summary = flight.summary()
    capture = summary["capture"]
    assert (capture["captured"], capture["distance_limit_m"]) == (False, 0.02)
    # As the file of the scenario says.
    assert capture["nearest_m"] == pytest.approx(0.04, abs=1e-5)
    assert (summary["succeeded"], summary["succeeded_by_measurement"]) == (False, True)
    assert summary["verdict"].startswith("The goal is reached, but the target is not captured: ")
    assert EventKind.CAPTURED not in {each.kind for each in flight.events}
    # It drifts past the end-effector.
    x = flight.signal("target_pose").values[:, 0]
    hand = flight.signal("end_effector_pose").values[:, 0]
    assert x[0] - 0.3 > hand[0]
    assert x[-1] - 0.3 < hand[-1]
    np.testing.assert_allclose(flight.momentum[:, :6], 0.0, atol=1e-6)


# -- A planar arm approaches a block, captures it, comes to rest and carries it, in few ----------


def test_a_planar_arm_fetches_a_block() -> None:
    target = {
        "tick_rate": 5.0,
        "integration_step": 0.1,
        "clearance_period": 0.0,
        "target.position": (2.2, -0.1, 0.0),
        "target.velocity": (0.004, -0.003, 0.0),
        "target.angular_velocity": (0.0, 0.0, 0.02),
        "capture.speed": 0.02,
    }
    control = {
        "tick_rate": 5.0,
        "tasks": "approach detumble",
        "target.standoff": (-0.1, 0.0, 0.0),
        "target.standoff_time": 0.5,
        # The arm grasps obliquely, past a corner of the block.
        "target.clearance": 0.0,
        "detumble.grapple_torque_limit": 0.5,
        "max_torque": 2.0,
        "max_force": 5.0,
        "gains.base_position.kp": 0.5,
        "gains.base_position.kd": 1.4,
        "gains.base_attitude.kp": 1.0,
        "gains.base_attitude.kd": 2.0,
        "gains.end_effector_position.kp": 4.0,
        "gains.end_effector_position.kd": 4.0,
        "settle_time": 0.5,
        "position_tolerance": 0.1,
        "attitude_tolerance": 0.1,
    }
    scenario = load_scenario("capture").with_overrides("plant", target)
    flight = fly_scenario(scenario.with_overrides("coordinated_control", control), longest=120.0)
    assert flight.succeeded, flight.message
    kinds = [each.kind for each in flight.events]
    assert kinds[-4:] == [
        EventKind.CAPTURED,
        EventKind.DETUMBLE_STARTED,
        EventKind.DETUMBLED,
        EventKind.GOAL_REACHED,
    ]
    detumbling = flight.summary()["detumbling"]
    assert detumbling == {"time_s": flight.events[-2].time_s, **detumbling}
    assert detumbling["largest_torque_Nm"] == 2.0
    assert 0.0 < detumbling["shortest_s"] < detumbling["took_s"] < 30.0
    assert detumbling["grasp_torque_Nm"] <= 0.5 + 1e-9
    summed, expected = flight.momentum[:, :6], flight.signal("expected_momenta").values
    assert np.abs(summed - expected).max() < 1e-11
    assert np.abs(expected).max() > 0.05


# -- held bodies, and the momentum budget over time, of a recorded flight ------------------------


@pytest.fixture(scope="module")
def capture() -> Flight:
    return read_run(BAGS / "capture.mcap")


def norms(values: Array) -> Array:
    return np.linalg.norm(values, axis=1)


def test_the_held_body_is_where_the_target_is_seen(capture: Flight) -> None:
    (held,) = held_bodies(capture)
    assert (held.start, held.end, held.payload.link) == (0.0, math.inf, "end_effector")
    assert held.payload.inertia.mass == 10.0
    # Its centre at the end of the flight, by the recorded pose of the target and by the arm.
    kinematics = ForwardKinematics(capture.required_robot())
    R_BL, r_BL = kinematics.link_poses(capture.q[-1:])
    link = list(kinematics.links).index("end_effector")
    turn, base = Rotation.from_quat(capture.pose[-1, 3:]), capture.pose[-1, :3]
    center = base + turn.apply(r_BL[0, link] + R_BL[0, link] @ held.payload.inertia.com)
    assert capture.target is not None
    seen, own = capture.signal("target_pose").values[-1], capture.target.bodies[0].inertia.com
    np.testing.assert_allclose(
        center, seen[:3] + Rotation.from_quat(seen[3:]).apply(own), atol=1e-9
    )
    assert float(np.linalg.norm(held.payload.inertia.com)) > 0.1


def test_each_capture_has_its_release(capture: Flight) -> None:
    twice = released(capture, 0.5)
    again = next(e for e in capture.events if e.kind is EventKind.CAPTURED)
    twice = released(replace(twice, events=(*twice.events, replace(again, time_s=1.0))), 1.5)
    assert [(each.start, each.end) for each in held_bodies(twice)] == [(0.0, 0.5), (1.0, 1.5)]
    assert held_bodies(replace(capture, robot=None)) == ()
    none = Signal(np.empty(0), np.empty((0, 7)))
    assert held_bodies(replace(capture, series={**capture.series, "target_pose": none})) == ()
    assert held_bodies(replace(capture, events=())) == ()


def test_the_parts_add_up_to_the_recorded_momentum_of_robot_and_held_body(capture: Flight) -> None:
    budget = momentum_budget_over_time(capture, 40)
    assert len(budget) == 40
    assert (budget.time[0], budget.time[-1]) == (capture.time[0], capture.time[-1])
    rows = np.searchsorted(capture.time, budget.time)
    recorded = norms(capture.momentum[rows, 3:6])
    assert recorded[1:].max() > 5e-3
    # The first state is that of the capture, before the impact.
    np.testing.assert_allclose(budget.values[1:, 3], recorded[1:], atol=1e-12)
    assert budget.values[0, 3] == 0.0
    assert not budget.values[:, 2].any(), "there are no wheels"
    assert (budget.values[:, 3] <= budget.values[:, :3].sum(axis=1) + 1e-12).all()
    # A robot without the body has another momentum.
    alone = momentum_budget_over_time(released(capture, 1.0), 40)
    later = budget.time > 1.0
    assert np.array_equal(alone.values[~later], budget.values[~later])
    assert np.abs(alone.values[later, 3] - recorded[later]).max() > 1e-3


def test_wheels_base_and_arm_add_up_to_the_recorded_momentum() -> None:
    flight = read_run(BAGS / "wheels.mcap")
    budget = momentum_budget_over_time(flight, 25)
    rows = np.searchsorted(flight.time, budget.time)
    np.testing.assert_allclose(budget.values[:, 3], norms(flight.momentum[rows, 3:6]), atol=1e-11)
    # Wheels alone: each spins at its own rate, and the base turns slowly.
    robot = flight.required_robot()
    spinning = [list(flight.joint_names).index(name) for name in robot.wheel_names]
    bodies = {b.joint.name: b for b in robot.bodies if b.joint is not None}
    axes = np.array(
        [bodies[n].origin.R @ bodies[n].joint.axis for n in robot.wheel_names]  # type: ignore[union-attr]
    )
    moments = np.array(
        [
            bodies[n].joint.axis @ bodies[n].inertia.about_com @ bodies[n].joint.axis  # type: ignore[union-attr]
            for n in robot.wheel_names
        ]
    )
    rates = flight.qdot[rows][:, spinning] + flight.twist[rows, 3:] @ axes.T
    np.testing.assert_allclose(budget.values[:, 2], norms((moments * rates) @ axes), atol=1e-12)
    assert budget.values[:, 2].max() > 0.1
    assert BUDGET_PARTS == ("base", "arm", "wheels", "sum")


def test_a_flight_without_a_robot_or_its_joints_has_no_budget(capture: Flight) -> None:
    assert len(momentum_budget_over_time(replace(capture, robot=None), 10)) == 0
    others = replace(capture, joint_names=("a", "b"))
    empty = momentum_budget_over_time(others, 10)
    assert (len(empty), empty.width) == (0, 4)


def test_a_budget_is_of_the_states_in_which_base_and_joints_are_known(capture: Flight) -> None:
    q, qdot = (capture.signal(name) for name in ("q", "qdot"))
    backward = {
        name: Signal(each.time[3:9], each.values[3:9, ::-1])
        for name, each in (("q", q), ("qdot", qdot))
    }
    flight = replace(
        capture, series={**capture.series, **backward}, joint_names=capture.joint_names[::-1]
    )
    found, whole = (momentum_budget_over_time(each, 10_000) for each in (flight, capture))
    assert np.array_equal(found.time, q.time[3:9])
    np.testing.assert_allclose(found.values, whole.values[3:9], rtol=1e-12)
    assert np.array_equal(momentum_budget_over_time(flight, 2).time, q.time[[3, 8]])


def test_a_planar_flight_determines_seven_parameters_of_the_block(capture: Flight) -> None:
    """Thrusters fire all the time: their impulse is part of the balance."""
    (found,) = payload_estimates(capture, 80)
    assert found.undetermined == ("Ixx", "Iyy", "Ixy")
    shown, true = ~np.isnan(found.parameters), true_parameters(capture)
    # Normal equations square what rounding does, and it differs between processors.
    np.testing.assert_allclose(found.parameters[shown], true[shown], atol=1e-4)
    # Without the thrust it would be another body.
    still = {**capture.commands, "base_wrench": replace(capture.commands["base_wrench"])}
    still["base_wrench"] = replace(
        still["base_wrench"], values=np.zeros_like(capture.commands["base_wrench"].values)
    )
    (other,) = payload_estimates(replace(capture, commands=still), 80)
    assert abs(other.parameters[0] - 10.0) > 1.0


def true_parameters(flight: Flight) -> Array:
    (held,) = held_bodies(flight)
    return parameters_of(held.payload.inertia)


@pytest.fixture(scope="module")
def servicing() -> Flight:
    return read_run(BAGS / "servicing.mcap")


def noisy(flight: Flight, size: float, seed: int = 4) -> Flight:
    """The flight with white noise of measured velocities, and a hundredth of it of positions."""
    rng = np.random.default_rng(seed)
    noise = {"pose": size / 100, "twist": size, "q": size / 100, "qdot": size}
    measured = {
        f"measured_{name}": Signal(
            flight.signal(name).time,
            flight.signal(name).values + s * rng.normal(size=flight.signal(name).values.shape),
        )
        for name, s in noise.items()
    }
    return replace(flight, series={**flight.series, **measured})


def test_a_satellite_with_unequal_moments_is_estimated_from_its_flight(servicing: Flight) -> None:
    """Its thrusters fire on and off, and its wheels turn."""
    (found,) = payload_estimates(servicing, 90)
    assert found.undetermined == ()
    (held,) = held_bodies(servicing)
    true = parameters_of(held.payload.inertia)
    assert len(set(np.round(true, 3))) == 10
    np.testing.assert_allclose(found.parameters, true, rtol=1e-3, atol=0.03)
    assert found.payload is not None
    assert found.payload.link == held.payload.link


def test_the_mass_follows_from_a_flight_without_noise(servicing: Flight) -> None:
    """Impulses of the thrust are known to what turns and accelerations in a tick do to them."""
    (found,) = payload_estimates(servicing)
    assert found.parameters[0] == pytest.approx(200.0, abs=1e-6)


@pytest.mark.parametrize("seeds", [8, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("size", [0.0, 1e-11, 1e-8, 1e-6])
def test_deviations_are_those_of_the_errors(servicing: Flight, size: float, seeds: int) -> None:
    """Without noise, where it is like the error of the impulses, and where it is larger."""
    true, errors = true_parameters(servicing), []
    for seed in range(seeds if size else 1):
        (found,) = payload_estimates(noisy(servicing, size, seed) if size else servicing)
        assert not found.corrected
        errors.append((found.parameters - true) / found.deviations)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_an_estimate_from_noisy_sensors_knows_its_errors(servicing: Flight) -> None:
    true = true_parameters(servicing)
    (found,) = payload_estimates(noisy(servicing, 1e-6), 240)
    assert found.undetermined == ()
    error = np.abs(found.parameters - true)
    assert 1e-4 < found.deviations[0] < 0.02
    assert (error < 3.5 * found.deviations).all()
    (coarse,) = payload_estimates(noisy(servicing, 1e-4), 240)
    assert set(coarse.undetermined) >= {"Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"}


def test_a_short_flight_with_noise_shows_nothing(capture: Flight) -> None:
    (found,) = payload_estimates(noisy(capture, 1e-5), 200)
    assert found.undetermined == PAYLOAD_PARAMETERS


def test_loads_from_outside_are_not_taken_for_a_body(capture: Flight) -> None:
    loaded = Event(EventKind.DISTURBANCE, "A wrench acts.", 1, 0.5)
    scenario = capture.scenario
    windy = scenario.with_overrides("plant", {"disturbances": ("wrench spacecraft 1 0 0 0 0 0",)})
    orbit = scenario.with_overrides("plant", {"orbit.mean_motion": 1e-3})
    for flight in (
        replace(capture, events=(*capture.events, loaded)),
        replace(capture, scenario=windy),
        replace(capture, scenario=orbit),
    ):
        with pytest.raises(SpaceRobotError) as error:
            payload_estimates(flight)
        assert str(error.value) == (
            "The parameters of the held body are not estimated: external loads (disturbances, an "
            "orbit or a table) acted on the robot, and their impulse is unknown; use a flight "
            "without such loads."
        )
    assert payload_estimates(replace(capture, robot=None)) == ()
    assert payload_estimates(replace(capture, events=(loaded,))) == ()


def test_a_goal_without_its_automatic_capture_is_not_complete(capture: Flight) -> None:
    assert (capture.verdict.word, capture.verdict.complete) == ("Reached", True)
    missed = replace(capture, events=())
    assert missed.verdict.word == "Reached, but the target is not captured"
    assert not missed.verdict.complete
    # A target that is captured on request alone may be left where it is.
    by_hand = capture.scenario.with_overrides("plant", {"capture.mode": "manual"})
    assert replace(missed, scenario=by_hand).verdict.complete


def test_a_report_has_a_card_of_the_capture() -> None:
    report = read_report(BAGS / "capture.mcap")
    cards = {label: (value, note) for label, value, note in headline(report)}
    value, note = cards["Target captured"]
    (time,) = [each.time_s for each in report.events if each.kind is EventKind.CAPTURED]
    assert value == f"at {time:.4g} s"
    assert note == "< 1 µm from the grapple"
    report = replace(report, events=())
    assert ("Target captured", "no") in {card[:2] for card in headline(report)}
    without = read_report(BAGS / "servicer.mcap")
    assert "Target captured" not in {label for label, _, _ in headline(without)}
