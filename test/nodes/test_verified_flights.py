"""Bags of nodes: verified by flying again, and read with the parameters of ROS."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from geometry_msgs.msg import WrenchStamped
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from support.altered_bags import altered
from support.command_line import CliRunner, Result
from support.recorded_stack import Stack, has_parameters
from support.ros_harness import Harness, dumped
from support.sentences import assert_one_sentence

from spacerobot_ros import fly, load_scenario, read_bag
from spacerobot_ros.cli.main import main
from spacerobot_ros.flight.reading import open_flight_bag, read_flight
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.nodes import PlantNode, RecorderNode
from spacerobot_ros.parameters import values_of
from spacerobot_ros.resources import share_directory
from spacerobot_ros.scenario_files import read_sections

SLIDERS = ["slider_1", "slider_2", "slider_3"]
VELOCITY = {
    "robot": "sliding_masses",
    "tick_rate": 20.0,
    "linear_momentum": [0.1, 0.0, -0.2],
    "angular_momentum": [0.02, 0.05, -0.01],
}
EFFORT = {
    "robot": "planar_manipulator",
    "actuation": "effort",
    "tick_rate": 100.0,
    "initial_joint_positions": [0.3, -0.8],
    "initial_joint_velocities": [0.1, 0.2],
}
TICKS = 60

Answer = Callable[[int], Sequence[Any]]
"""What is published in answer to the state of a tick, stamps left out."""


class Flight:
    """A plant in lockstep, a recorder, and commands by a script."""

    def __init__(self, harness: Harness, bag: Path, plant: dict[str, Any], answer: Answer) -> None:
        self.harness, self.bag = harness, bag
        self.plant = harness.make(PlantNode, {**plant, "time_mode": "lockstep"}, autostart=False)
        assert self.plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
        self.probe = harness.probe({"/joint_states": JointState})
        self.probe.react["/joint_states"] = self._on_state
        self._publishers = {
            JointState: self.probe.create_publisher(JointState, "joint_commands", 100)
        }
        if plant.get("actuation") == "effort":
            self._publishers[WrenchStamped] = self.probe.create_publisher(
                WrenchStamped, "base_wrench", 100
            )
        self._answer = answer
        self.recorder = harness.make(RecorderNode, {"bag": str(bag)}, autostart=False)
        assert self.recorder.trigger_configure() is TransitionCallbackReturn.SUCCESS
        wanted = {"/odom", "/joint_states", "/joint_commands", "/clock", "/robot_description"}

        def scanned() -> bool:
            self.recorder.scan()
            return wanted <= self.recorder.topics

        harness.spin_until(scanned, "the recorder listens")
        harness.connect()
        self.recorder.trigger_activate()
        values = {"autostart": True, **values_of(self.plant.config)}
        texts = {name: json.dumps(value) for name, value in values.items()}
        self.recorder.describe("parameters/plant", texts)

    def fly(self, ticks: int = TICKS) -> Path:
        """Fly so many ticks and complete the bag."""

        def launch() -> None:
            self.probe.destroy_timer(timer)
            self.plant.trigger_activate()

        timer = self.probe.create_timer(0.001, launch)
        self.harness.spin_until(lambda: self.plant.tick >= ticks, f"{ticks} ticks")
        self.plant.trigger_deactivate()
        before = -1
        while before != self.recorder.messages_recorded:
            before = self.recorder.messages_recorded
            self.harness.spin_for(0.05)
        self.recorder.trigger_deactivate()
        self.recorder.trigger_cleanup()
        return self.bag

    def _on_state(self, state: JointState) -> None:
        stamp = state.header.stamp
        tick = round((stamp.sec + stamp.nanosec * 1e-9) * self.plant.config.tick_rate)
        for message in self._answer(tick):
            if not message.header.stamp.nanosec:
                message.header.stamp = stamp
            self._publishers[type(message)].publish(message)


def velocities(values: Sequence[float], names: Sequence[str] = SLIDERS) -> JointState:
    return JointState(name=list(names), velocity=[float(v) for v in values])


def sliding(tick: int) -> Sequence[Any]:
    """Smooth commands, and in between everything that a plant refuses."""
    t = tick / 20.0
    good = velocities([0.2 * math.sin(t), -0.1 * math.cos(2 * t), 0.05])
    if tick == 11:
        return [velocities([0.1, math.nan, 0.0]), good]
    if tick == 17:
        return [velocities([0.1], ["slider_9"])]
    if tick == 23:
        return [velocities([0.1, 0.2], ["slider_3", "slider_1"])]
    if tick == 29:
        stale = velocities([9.0, 9.0, 9.0])
        stale.header.stamp.nanosec = 50_000_000
        return [stale, good, velocities([0.9, 0.9, 0.9])]
    if tick == 31:
        return [velocities([0.1, 0.2], SLIDERS)]
    return [velocities([50.0, 0.0, 0.0]) if tick == 37 else good]


def arm(tick: int) -> Sequence[Any]:
    """Efforts and a wrench; refused ones have the motors brake."""
    t = tick / 100.0
    joints = JointState(
        name=["elbow", "shoulder"], effort=[3.0 * math.cos(9 * t), -2.0 * math.sin(5 * t)]
    )
    wrench = WrenchStamped()
    wrench.wrench.force.x, wrench.wrench.torque.z = 4.0, math.sin(3 * t)
    if 11 <= tick < 14:
        joints.effort = [math.inf, 0.0]
    if tick == 23:
        wrench.header.frame_id = "elsewhere"
    return [wrench, joints]


FLIGHTS: dict[str, tuple[dict[str, Any], Answer]] = {
    "velocity": (VELOCITY, sliding),
    "effort": (EFFORT, arm),
}


@pytest.mark.parametrize("kind", FLIGHTS)
def test_a_flight_with_refused_commands_is_verified(
    harness: Harness, tmp_path: Path, kind: str
) -> None:
    plant, answer = FLIGHTS[kind]
    bag = Flight(harness, tmp_path / "flown.mcap", plant, answer).fly()
    result = verify_bag(bag)
    assert result.difference is None
    assert result.ticks >= TICKS
    # Every tick has odom, joint states, momentum and base pose; with thrusters what is expected.
    assert result.messages >= 4 * TICKS
    assert result.largest < 1e-12


def test_faults_and_noise_are_flown_again(harness: Harness, tmp_path: Path) -> None:
    parameters = {
        **EFFORT,
        "faults": ["joint_stuck elbow at 0.2 until 0.4"],
        "sensors.joint_noise": 1e-3,
        "sensors.position_noise": 1e-2,
        "sensors.seed": 5,
    }
    bag = Flight(harness, tmp_path / "flown.mcap", parameters, arm).fly()
    result = verify_bag(bag)
    assert result.difference is None, str(result.difference)
    again = altered(bag, tmp_path / "b.mcap", parameters={"sensors.seed": "6"})
    difference = verify_bag(again).difference
    assert difference is not None
    assert (difference.time, difference.field) == (0.0, "position of shoulder")


REFERENCE_BAG = share_directory() / "bags" / "sliding_masses.mcap"
OF_ROS = {"use_sim_time", "start_type_description_service"}
QOS_OVERRIDE = "qos_overrides./clock.subscription.durability"


def told(*words: str | Path) -> Result:
    """Return what a command says."""
    return CliRunner().invoke(main, list(map(str, words)))


def test_bags_and_dumps_with_the_parameters_of_ros_are_read(
    harness: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a flight by nodes that the recorder does not compose."""
    monkeypatch.chdir(tmp_path)
    stack = Stack(harness, tmp_path / "flight.mcap")
    results = stack.planner.set_parameters([Parameter("use_sim_time", value=True)])
    assert all(result.successful for result in results)
    # As every subscription with qos_overriding_options does.
    stack.planner.declare_parameter(QOS_OVERRIDE, "volatile")
    stack.configure("/odom", "/planner/status", "/joint_commands", "/clock", "/goal_pose")
    stack.recorder.trigger_activate()
    stack.fly()

    def has_all() -> bool:
        stack.recorder.flush()
        return has_parameters(stack.bag, "plant", "planner")

    harness.spin_until(has_all, "the nodes' parameters")
    stack.stop()
    nodes = (stack.plant, stack.planner, stack.recorder)
    dump = tmp_path / "dump.yaml"
    dump.write_text("".join(yaml.safe_dump(dumped(node)) for node in nodes), "utf-8")
    metadata = stack.close_bag().metadata
    assert set(metadata["parameters/plant"]) >= {"robot", "autostart", *OF_ROS}
    assert set(metadata["parameters/planner"]) >= {QOS_OVERRIDE, *OF_ROS}
    for words in (
        ("report", stack.bag, "-o", "out.html"),
        ("figures", stack.bag, "--format", "png", "-o", "figures"),
        ("verify", stack.bag),
        ("export", stack.bag, "--format", "csv", "-o", "tables"),
    ):
        result = told(*words)
        assert result.exit_code == 0, (words, result.output)
    assert read_bag(stack.bag)["/odom"].field("pose.pose.position.x")[-1] == pytest.approx(
        0.05, abs=2e-3
    )
    scenario = read_flight(open_flight_bag(stack.bag)).scenario
    assert scenario.plant.tick_rate == 20.0
    assert (scenario.planner.method, scenario.planner.tick_rate) == ("lie_bracket", 20.0)

    sections = read_sections(dump)
    assert set(sections) == {"plant", "planner", "recorder"}
    assert sections["planner"]["use_sim_time"] is True
    assert sections["planner"][QOS_OVERRIDE] == "volatile"
    flight = fly(load_scenario(str(dump)), position=(0.05, 0.0, 0.0))
    assert flight.succeeded
    assert flight.scenario.planner.options["lie_bracket"].t1 == 2.0
    none = told("run", dump)
    assert none.exit_code == 2
    assert_one_sentence(none.stderr, "'dump' has no goal", "--goal-rpy-deg 0 0 10")
    text = dump.read_text("utf-8")
    dump.write_text(text.replace("tick_rate", "tick_rat"), "utf-8")
    misspelt = told("run", dump, "--goal", *["0.05", "0", "0", "0", "0", "0", "1"])
    assert misspelt.exit_code == 2
    assert_one_sentence(misspelt.stderr, "has no parameter 'tick_rat'")


@pytest.mark.parametrize(
    "command", ["report", pytest.param("figures", marks=pytest.mark.slow), "verify"]
)
def test_parameters_of_a_newer_version_stop_no_command(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does a gait method of one's own, whose module is not there."""
    monkeypatch.chdir(tmp_path)
    newer = {"tidal_lag": "0.5", "sensors.star_tracker": '["a"]', "tick_jitter": "null"}
    plant = altered(REFERENCE_BAG, tmp_path / "plant.mcap", parameters=newer)
    own = {"method": '"sampling"', "sampling.gain": "3.0"}
    bag = altered(plant, tmp_path / "newer.mcap", parameters=own, node="planner")
    result = told(command, bag)
    assert result.exit_code == 0, result.output
