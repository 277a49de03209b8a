"""Flights without ROS beside the same flights through the nodes, as bags hold them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.oracles import PinocchioOracle

from spacerobot_ros import fly
from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.flight.reading import read_run
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.scenario import Scenario, load_scenario, scenario_or_robot
from spacerobot_ros.session.run import run_scenario

ROOT = Path(__file__).resolve().parents[2]

WHOLE = ("time", "pose", "twist", "q", "qdot", "effort", "momentum")

HEAVY = {
    *("servicer", "servicer_thrusters", "arm_attitude", "coordinated_control"),
    *("reach", "two_hands", "strut", "planar_chain", "gravity_gradient", "wheels", "capture"),
    "servicing",
}
"""Reference bags whose robot takes seconds to compile."""

REPLANNED = {"reach", "strut", "two_hands"}
"""Reference bags of goals whose plans are other ones today, which are as long or shorter."""

PULSED = "inspection"
"""Reference bag of on/off thrusters, whose pulses turn rounding into 1 mm: other processors differ
by as much as a waypoint moved by 1e-13 m."""

BAGS = [
    pytest.param(path, marks=pytest.mark.slow if path.stem in HEAVY else (), id=path.stem)
    for path in sorted((ROOT / "bags").glob("*.mcap"))
    if path.stem not in {*REPLANNED, PULSED}
]


def assert_same(flight: Flight, other: Flight, tolerance: float = 0.0) -> None:
    """Hold every number of two flights against each other."""
    for name in WHOLE:
        mine, its = getattr(flight, name), getattr(other, name)
        assert mine.shape == its.shape, name
        if name == "effort" and not its.any():
            continue  # The bag is of a plant that did not compute the efforts of servos.
        np.testing.assert_allclose(mine, its, rtol=tolerance, atol=tolerance, err_msg=name)
    assert {"pose_lost", *other.quantities} == {"pose_lost", *flight.quantities}
    for name, values in other.quantities.items():
        mine = flight.quantities[name]
        if name.startswith(("measured_pose", "measured_twist")):
            mine = mine[flight.quantities["pose_lost"][:, 0] == 0.0]  # Nothing was published.
        exact = 1e-12 if name == "propellant" else tolerance  # A sum, in another order.
        np.testing.assert_allclose(mine, values, rtol=exact, atol=exact, err_msg=name)
    for topic, sent in other.commands.items():
        mine = flight.commands[topic]
        # No state follows the last command: a node may have ended before it, or may have sent it
        # before its partner's last word had arrived.
        count = len(mine) - 1
        assert count <= len(sent) <= count + 1
        np.testing.assert_allclose(mine.time[:count], sent.time[:count], rtol=0, atol=1e-9)
        mine_values, its = mine.values[:count], sent.values[:count]
        np.testing.assert_allclose(mine_values, its, rtol=tolerance, atol=tolerance)
    assert flight.outcome is other.outcome
    assert flight.corrections == other.corrections
    # Statuses have no stamp: a recorder beside the nodes may have heard the next tick before one.
    tick = flight.time[1] - flight.time[0]
    assert flight.manoeuvre_time == pytest.approx(other.manoeuvre_time, abs=1.01 * tick)


@pytest.mark.parametrize("bag", BAGS)
def test_reference_bags_are_flown_again_without_ros(bag: Path) -> None:
    """They were flown through the nodes. Plans may differ in the last digits between machines."""
    flight, recorded = fly_scenario(read_run(bag).scenario), read_run(bag)
    assert len(recorded.time) > 25
    assert_same(flight, recorded, 1e-9)
    worlds = (str(each.get("world")) for each in read_bag(bag).metadata.values())
    assert not any(world.startswith('"/') for world in worlds), "a path of one machine"


def test_the_bag_of_pulses_is_flown_again_as_closely_as_pulses_allow() -> None:
    recorded = read_run(ROOT / "bags" / f"{PULSED}.mcap")
    flight = fly_scenario(recorded.scenario)
    np.testing.assert_array_equal(flight.time, recorded.time)
    np.testing.assert_allclose(flight.pose, recorded.pose, rtol=0, atol=3e-3)
    propellant = [each.quantities["propellant"][-1, 0] for each in (flight, recorded)]
    assert propellant[0] == pytest.approx(propellant[1], rel=5e-3)
    assert flight.outcome is recorded.outcome is Outcome.REACHED


BROKEN = ["plant.tick_rate=50", "coordinated_control.tick_rate=50"]
NOISY = ["plant.sensors.position_noise=0.001", "plant.sensors.joint_rate_noise=0.002"]
"""Faults of actuators and half a second without pose, which controllers and plant wait for."""

PUSHED = ["plant.disturbances=mass_2 force 0.1 0 -0.2 torque 0 0.01 0 in link at 3.1 until 3.3"]

BY_ROS = [
    pytest.param("faults/stuck_slider", [], Outcome.FAILED),
    pytest.param(
        "faults/broken_thrusters", [*BROKEN, *NOISY], Outcome.FAILED, marks=pytest.mark.slow
    ),
    pytest.param("faults/stuck_elbow", [], Outcome.REACHED, marks=pytest.mark.study),
    pytest.param("faults/late_poses", [], Outcome.REACHED, marks=pytest.mark.slow),
    pytest.param("faults/weak_motors", [], Outcome.REACHED, marks=pytest.mark.study),
    pytest.param("faults/wrong_masses", [], Outcome.REACHED, marks=pytest.mark.study),
    pytest.param("faults/noisy_sensors", [], Outcome.REACHED, marks=pytest.mark.study),
    pytest.param("planar_chain", [], Outcome.REACHED, marks=pytest.mark.slow),
    pytest.param("servicer", [], Outcome.REACHED, marks=pytest.mark.study),
    pytest.param("servicer_thrusters", [], Outcome.REACHED, marks=pytest.mark.slow),
    pytest.param("gravity_gradient", [], Outcome.REACHED, marks=pytest.mark.study),
    pytest.param("sliding_masses", PUSHED, Outcome.FAILED, marks=pytest.mark.slow),
]


@pytest.mark.usefixtures("own_domain")
@pytest.mark.parametrize(("name", "settings", "outcome"), BY_ROS)
def test_a_flight_is_the_one_through_the_nodes(
    name: str, settings: list[str], outcome: Outcome, tmp_path: Path
) -> None:
    """To the last bit: plans, corrections, lost poses, noise, faults, stuck joints."""
    scenario = load_scenario(name).with_settings(settings)
    run_scenario(scenario, tmp_path / "ros.mcap", nodes=True)
    through_ros, flight = read_run(tmp_path / "ros.mcap"), fly_scenario(scenario)
    assert flight.outcome is outcome
    assert_same(flight, through_ros)
    assert flight.sentence == through_ros.sentence
    # Events of different nodes are recorded in any order.
    told = sorted((event.kind, event.message) for event in flight.events if event.goal_id)
    assert told == sorted((e.kind, e.message) for e in through_ros.events if e.goal_id)


def chain(**settings: Any) -> Scenario:
    """Return a short flight of a planner and a controller."""
    scenario = load_scenario("planar_chain")
    for node in (*scenario.commanders, "plant"):
        scenario = scenario.with_overrides(node, {"tick_rate": 25.0})
    return scenario.with_overrides("plant", settings)


@pytest.mark.slow
def test_what_is_saved_is_verified_and_read_back(tmp_path: Path) -> None:
    links = {"end_effectors": ["segment_2", "base_link"]}
    flight = fly_scenario(chain(**{"sensors.joint_noise": 1e-7}, **links))
    flight.save(tmp_path / "saved.mcap")
    verified = verify_bag(tmp_path / "saved.mcap")
    assert verified.difference is None
    assert verified.ticks == len(flight.time) - 1
    assert {"/segment_2/pose", "/base_link/pose"} <= set(verified.topics)
    of_base = flight.signal("pose_of_base_link").values
    np.testing.assert_allclose(of_base[:, :3], flight.pose[:, :3], atol=1e-12)
    read = read_run(tmp_path / "saved.mcap")
    assert_same(flight, read)
    assert [e.message for e in read.events] == [e.message for e in flight.events]


HULL = """<link name="{name}">
  <inertial><origin xyz="0.02 0.01 -0.03"/><mass value="12"/>
    <inertia ixx="0.2" iyy="0.25" izz="0.3" ixy="0.01" ixz="0" iyz="0"/></inertial>
  <visual><geometry><box size="0.3 0.2 0.25"/></geometry></visual>
  <collision><geometry><box size="0.3 0.2 0.25"/></geometry></collision></link>"""
ARM = """<link name="arm"><inertial><origin xyz="0.1 0 0.02"/><mass value="1.5"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="elbow" type="revolute"><parent link="world"/><child link="arm"/>
    <origin xyz="0.2 0.05 0" rpy="0.1 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="5" velocity="1"/></joint>"""


@pytest.mark.parametrize(
    "links",
    [
        pytest.param(HULL.format(name="hull"), id="one link"),
        pytest.param(HULL.format(name="world") + ARM, id="a root called world"),
    ],
)
def test_robots_of_others_are_flown_saved_and_verified_by_both_engines(
    links: str, tmp_path: Path
) -> None:
    file, bag = tmp_path / "robot.urdf", tmp_path / "robot.mcap"
    file.write_text(f'<robot name="theirs">{links}</robot>')
    scenario = tmp_path / "flight.yaml"
    scenario.write_text(
        "scenario: {ros__parameters: {goal_position: [0.1, -0.05, 0.02],"
        " goal_rotvec: [0.1, 0.0, 0.2]}}\n"
        f"/**/plant: {{ros__parameters: {{robot: {file}, tick_rate: 20.0, actuation: effort}}}}\n"
        f"/**/coordinated_control: {{ros__parameters: {{robot: {file}, tick_rate: 20.0}}}}\n"
    )
    run = run_scenario(load_scenario(str(scenario)), bag)
    assert run.succeeded, run.message
    verified = verify_bag(bag, mujoco=True)
    assert verified.difference is None
    other = verified.second_opinion
    assert other is not None
    assert max(other.position, other.attitude, other.joints) < 1e-10


def test_the_bag_of_a_flight_has_what_nodes_publish_beside_states(tmp_path: Path) -> None:
    """Frames, markers, statuses and diagnostics, at their periods; the pose is lost for a while."""
    scenario = load_scenario("faults/stuck_slider").with_settings(
        ["plant.faults=[sensor_dropout odom at 0.45 until 0.75, sensor_noise position 0.01 at 1]"]
    )
    scenario = scenario.with_overrides("plant", {"marker_period": 0.5, "diagnostics_period": 1.0})
    flight = fly_scenario(scenario, longest=2.0)
    flight.save(tmp_path / "saved.mcap")
    bag = read_bag(tmp_path / "saved.mcap")
    tenths = [100_000_000 * k for k in range(21)]
    assert bag["/tf"].time_ns.tolist() == [each for each in tenths if not 0.4e9 < each < 0.8e9]
    of_robot, of_plan = [500_000_000 * k for k in range(5)], [0]
    assert sorted(bag["/markers"].time_ns.tolist()) == sorted([*of_robot, *of_plan])
    states = [message.values[0].value for _, message in bag["/plant/status"].messages()]
    assert (states[0], states[-1], set(states[1:-1])) == ("inactive", "inactive", {"running"})
    names = [status.name for _, array in bag["/diagnostics"].messages() for status in array.status]
    assert {"plant: momentum", "planner: states", "planner: goal"} <= set(names)
    assert names.count("plant: momentum") == 3
    covariances = bag["/odom"].table(["pose.covariance"], 36)[:, 0]
    assert set(covariances) == {0.0, 1e-4}
    reporters = {message.name for _, message in bag["/events"].messages()}
    assert reporters == {"/plant", "/planner"}
    assert {"/gait_schedule", "/planned_path", "/robot_description"} <= set(bag.topics)


def test_the_path_of_an_end_effector_is_in_the_bag_of_its_flight(tmp_path: Path) -> None:
    way = [[1.5, 0.7, 1.3], [1.3, 0.9, 0.8]]
    scenario = scenario_or_robot("three_joint_arm").with_overrides(
        "plant", {"initial_joint_positions": [0.4, -0.9, 1.1]}
    )
    scenario = scenario.with_end_effectors([EndEffectorGoal.along("", way)])
    fly_scenario(scenario, longest=0.1).save(tmp_path / "saved.mcap")
    ((_, message),) = read_bag(tmp_path / "saved.mcap")["/end_effector/path"].messages()
    places = [each.pose.position for each in message.poses]
    assert [[each.x, each.y, each.z] for each in places] == way
    assert not any(each.pose.orientation.w for each in message.poses)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        (["plant.time_mode=realtime"], "time_mode"),
        (["plant.resume_bag=some.mcap"], "resume_bag"),
        (["planner.resume_file=some.json"], "resume_file"),
        (["planner.output=commands"], "both command"),
    ],
)
def test_what_only_nodes_can_do_is_refused(settings: list[str], word: str) -> None:
    with pytest.raises(ParameterError, match=word):
        fly_scenario(load_scenario("planar_chain").with_settings(settings))


def test_a_flight_that_is_longer_than_allowed_is_interrupted() -> None:
    flight = fly_scenario(chain(), longest=2.0)
    assert flight.outcome is Outcome.INTERRUPTED
    assert flight.duration == 2.0
    assert flight.sentence == "Interrupted after 2 s of simulated time."
    ((began, schedule),) = flight.schedules
    assert schedule.duration > 2.0
    assert flight.manoeuvre_time == pytest.approx(2.0 - began / 1e9, abs=1e-9)


def test_a_plant_that_latches_ends_the_flight(tmp_path: Path) -> None:
    """Its sliders are slower than the planner believes: a command is refused, and latches."""
    text = (ROOT / "urdf" / "sliding_masses.urdf").read_text()
    slow = re.sub(r'velocity="[^"]*"', 'velocity="0.02"', text)
    (tmp_path / "slow.urdf").write_text(slow)
    scenario = load_scenario("faults/stuck_slider").with_settings(
        [f"plant.robot={tmp_path}/slow.urdf", "plant.beyond_limits=refuse", "plant.faults=[]",
         "plant.latched_faults=beyond_limits"]
    )  # fmt: skip
    flight = fly_scenario(scenario)
    assert flight.outcome is Outcome.ABORTED
    assert "exceeds the limits" in flight.sentence
    (time, topic, refusal), *_ = flight.refusals
    assert (topic, refusal.latches) == ("joint_commands", True)
    assert flight.duration == pytest.approx(time + 0.05)  # The tick goes by at rest.


# -- the laws of paper 3 begin at joint rates that are not zero (its property 3) -----------------

AT_REST = 1e-12
"""Largest angular momentum in Pinocchio, kg m^2/s; the robot's links turn with up to 20."""


@pytest.mark.slow
@pytest.mark.parametrize("rates", [(0.1, -0.06), (-0.2, 0.15)])
def test_the_chain_is_turned_from_moving_joints(rates: tuple[float, float]) -> None:
    scenario = load_scenario("planar_chain")
    moving = scenario.with_overrides("plant", {"initial_joint_velocities": list(rates)})
    flight = fly(moving)
    assert flight.robot is not None
    np.testing.assert_allclose(flight.qdot[0], rates, atol=1e-12)
    assert np.abs(flight.twist[0, 5]) > 0.005, "the base turns at the start"
    assert flight.succeeded
    error = flight.measures.error
    assert error is not None
    assert error.angle < 2e-4
    assert flight.measures.corrections == 0
    oracle = PinocchioOracle(flight.robot.urdf, flight.robot.joint_names)
    for k in range(0, len(flight.time), 100):
        oracle.place(flight.q[k], flight.pose[k, 3:], flight.pose[k, :3])
        velocities = oracle.joint_velocities(flight.qdot[k])
        velocities[:6] = flight.twist[k]
        L = oracle.momentum_matrix_W()[3:] @ velocities
        assert np.abs(L).max() < AT_REST
