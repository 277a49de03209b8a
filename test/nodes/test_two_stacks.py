"""Two stacks in one domain, each in a namespace with a clock and a bag of its own."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import State
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger
from support.planner_flight import goal_at, values_of
from support.recorded_stack import has_parameters
from support.ros_harness import Harness, Probe, nanoseconds

from spacerobot_ros.bag import RecordedRobot, read_bag
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.nodes import PlannerNode, PlantNode, RecorderNode
from spacerobot_ros.nodes.common.node import Endpoint, endpoints_of, topics_without_all_matches

# Plants whose time and shape tell them apart.
ROBOTS: dict[str, dict[str, Any]] = {
    "one": {"robot": "sliding_masses", "tick_rate": 20.0},
    "two": {"robot": "sliding_masses", "tick_rate": 8.0, "initial_position": [3.0, 0.0, 0.0]},
}


class NamedStack:
    """Plant, planner and recorder of one namespace, in lockstep."""

    def __init__(self, harness: Harness, name: str, bag: Path) -> None:
        self.harness, self.name = harness, name
        moved = ["-r", f"__ns:=/{name}", "-r", "/clock:=clock"] if name else []
        words = {"cli_args": ["--ros-args", *moved], "autostart": False}
        values = ROBOTS[name or "one"]
        robot = {key: values[key] for key in ("robot", "tick_rate")}
        lockstep = {**values, "time_mode": "lockstep", "marker_period": 0.0}
        self.plant = harness.make(PlantNode, lockstep, **words)
        quick = {"method": "lie_bracket", "lie_bracket.t1": 1.0, "lie_bracket.cycles": 2}
        tolerance = {"position_tolerance": 0.01, "attitude_tolerance": 0.01}
        self.planner = harness.make(PlannerNode, {**robot, **quick, **tolerance}, **words)
        self.recorder = harness.make(RecorderNode, {"bag": str(bag)}, **words)
        self.bag = bag
        self.probe: Probe = harness.probe({}, name="client", cli_args=words["cli_args"])
        self.probe.watch("planner/status", DiagnosticStatus, latched=True)
        self.goals = self.probe.create_publisher(PoseStamped, "goal_pose", 10)

    def start(self) -> None:
        for node in (self.plant, self.planner, self.recorder):
            node.require_transition(node.trigger_configure)
        topics = {"odom", "joint_states", "joint_commands", "momentum", "goal_pose"}
        wanted = {self.plant.resolve_topic_name(topic) for topic in ("/clock", *topics)}
        self.harness.spin_until(lambda: wanted <= self.recorder.topics, "the recorder's topics")
        self.harness.connect()
        for node in (self.recorder, self.planner):
            node.require_transition(node.trigger_activate)

    def fly(self) -> Callable[[], bool]:
        """Begin a flight to a goal 1 cm ahead; return whether it is decided."""
        x = ROBOTS[self.name or "one"].get("initial_position", [0.0])[0] + 0.01
        self.goals.publish(goal_at(([x, 0.0, 0.0], [0.0] * 3)))
        self.plant.require_transition(self.plant.trigger_activate)
        heard = self.probe.messages["planner/status"]
        return lambda: any(values_of(status)["state"] == "reached" for status in heard)

    def finish(self) -> None:
        def has_all() -> bool:
            self.recorder.scan()
            self.recorder.flush()
            return has_parameters(self.bag, "plant", "planner")

        self.plant.trigger_deactivate()
        self.harness.settle(self.probe)
        self.harness.spin_until(has_all, "the nodes' parameters")
        self.recorder.trigger_deactivate()
        self.recorder.trigger_cleanup()


@pytest.mark.slow
def test_two_stacks_side_by_side_have_each_a_bag_that_verifies(
    harness: Harness, tmp_path: Path
) -> None:
    stacks = [NamedStack(harness, name, tmp_path / f"{name}.mcap") for name in ROBOTS]
    outside = harness.probe({}).create_publisher(Float64, "/outside", 1)
    for stack in stacks:
        stack.start()
    decided = [stack.fly() for stack in stacks]
    harness.spin_until(lambda: all(each() for each in decided), "both goals", 60.0)
    outside.publish(Float64(data=1.0))
    for stack in stacks:
        stack.finish()
    for stack in stacks:
        bag = read_bag(stack.bag)
        others = {t for t in bag.topics if not t.startswith(f"/{stack.name}/")}
        assert others <= {"/diagnostics", "/tf", "/tf_static"}
        # One clock: it never jumps, and has the steps of its own plant.
        times = bag[f"/{stack.name}/clock"].time_ns
        period = round(1e9 / ROBOTS[stack.name]["tick_rate"])
        assert set(np.diff(times)) == {period}
        x = RecordedRobot(bag, f"/{stack.name}")["odom"].field("pose.pose.position.x")
        assert abs(float(x[0]) - ROBOTS[stack.name].get("initial_position", [0.0])[0]) < 1e-12
        result = verify_bag(stack.bag)
        assert result.difference is None
        assert result.ticks > 10


def test_a_recorder_of_no_namespace_keeps_to_its_own_clock(
    harness: Harness, tmp_path: Path
) -> None:
    stack = NamedStack(harness, "", tmp_path / "mine.mcap")
    strange = harness.probe({}, name="strange").create_publisher(Clock, "/two/clock", 10)
    stack.start()
    message = Clock()
    message.clock.sec = 1_000_000
    harness.matched(strange, 0).publish(message)
    decided = stack.fly()
    harness.spin_until(lambda: strange.publish(message) or decided(), "the goal", 60.0)
    stack.finish()
    bag = read_bag(stack.bag)
    assert "/two/clock" not in bag.topics
    stamps = np.array([nanoseconds(clock.clock) for _, clock in bag["/clock"].messages()])
    assert np.array_equal(stamps, bag["/clock"].time_ns)
    assert verify_bag(stack.bag).difference is None


@pytest.mark.parametrize("recorded", [True, False], ids=["recorded", "followed"])
def test_two_clocks_on_one_topic_are_reported(
    recorded: bool,
    harness: Harness,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Once, and not a plant that is started again while the middleware still lists the killed
    one."""
    monkeypatch.setattr("rclpy.impl.rcutils_logger.Throttle.should_log", lambda _: True)
    topics = {} if recorded else {"topics": "/a"}
    recorder = harness.make(RecorderNode, {"bag": str(tmp_path / "a.mcap"), **topics})
    recording = recorder.recording
    assert recording is not None
    publishers = harness.probe({}, name="clocks")
    killed, again = (publishers.create_publisher(Clock, "/clock", 10) for _ in range(2))
    for clock in (killed, again):
        harness.matched(clock)
    harness.spin_until(lambda: recorder.count_publishers("/clock") == 2)

    def tick(clock: Publisher, sec: int) -> None:
        message = Clock()
        message.clock.sec = sec
        clock.publish(message)
        harness.spin_until(lambda: recording.now_ns == sec * 10**9, f"the time {sec} s")

    for clock, seconds in ((killed, (100, 101, 102)), (again, (0, 1, 2))):
        for sec in seconds:
            tick(clock, sec)
    recorder.flush()
    assert "More than one" not in capfd.readouterr().err
    for sec in (103, 3, 104, 4):
        tick(killed if sec > 100 else again, sec)
    recorder.flush()
    recorder.flush()
    assert capfd.readouterr().err.count("More than one clock is published on '/clock'") == 1


def endpoints(published: dict[str, int], read: Iterable[tuple[str, int]]) -> list[Endpoint]:
    """A node's endpoints: matches by the topics that it publishes, and of each subscription."""
    writers = [Endpoint(topic, True, met) for topic, met in published.items()]
    return writers + [Endpoint(topic, False, met) for topic, met in read]


PLANT = endpoints({"/odom": 2, "/clock": 1}, [("/joint_commands", 1)])
PLANNER = endpoints({"/joint_commands": 2}, [("/odom", 1)])
RECORDER = endpoints({}, [("/odom", 1), ("/clock", 1), ("/joint_commands", 1)])


def test_all_have_met_or_the_topics_say_who_has_not() -> None:
    assert topics_without_all_matches([*PLANT, *PLANNER, *RECORDER]) == set()
    early = endpoints({"/odom": 1, "/clock": 1}, [("/joint_commands", 1)])
    assert topics_without_all_matches([*early, *PLANNER, *RECORDER]) == {"/odom"}, (
        "a publisher knows one reader"
    )
    deaf = endpoints({}, [("/odom", 1), ("/clock", 0), ("/joint_commands", 1)])
    assert topics_without_all_matches([*PLANT, *PLANNER, *deaf]) == {"/clock"}, (
        "a reader knows no publisher"
    )
    # Readers from elsewhere are no matter.
    more = endpoints({"/odom": 7, "/clock": 7}, [("/joint_commands", 1)])
    assert topics_without_all_matches([*more, *PLANNER, *RECORDER]) == set()
    # Two readers of one node are two.
    twice = endpoints({}, [("/clock", 1), ("/clock", 1)])
    assert topics_without_all_matches([*PLANT, *PLANNER, *RECORDER, *twice]) == {"/clock"}


@pytest.fixture
def plant(harness: Harness) -> PlantNode:
    return harness.make(PlantNode, {"robot": "sliding_masses", "autostart": False})


def test_a_node_answers_with_its_endpoints(harness: Harness, plant: PlantNode) -> None:
    plant.trigger_configure()
    probe = harness.probe({"odom": Odometry})
    harness.connect()
    client = probe.create_client(Trigger, "plant/connections")
    answer = json.loads(harness.call(client, Trigger.Request()).message)
    found = [Endpoint(*each) for each in answer]
    assert found == endpoints_of(plant)
    assert Endpoint("/odom", True, 1) in found
    assert Endpoint("/joint_commands", False, 0) in found
    assert not {"/rosout", "/parameter_events"} & {each.topic for each in found}
    probe.create_publisher(String, "fault_injection", 10)
    harness.connect()
    both = [*endpoints_of(plant), *endpoints_of(probe)]
    assert topics_without_all_matches(both) == set()


def test_a_node_that_was_shut_down_ends_without_another_transition(
    harness: Harness, plant: PlantNode
) -> None:
    plant.trigger_shutdown()
    plant.drain(harness.executor)
    plant.finalize()
    plant.finalize()
    assert plant.lifecycle_state == State.PRIMARY_STATE_FINALIZED


def test_a_plant_in_real_time_rests_before_its_process_ends(harness: Harness) -> None:
    plant = harness.make(PlantNode, {"robot": "sliding_masses", "tick_rate": 100.0})
    probe = harness.probe({"joint_states": JointState})
    commands = probe.create_publisher(JointState, "joint_commands", 10)
    harness.connect()
    names = list(plant.plant.robot.joint_names)

    def answer(state: JointState) -> None:
        message = JointState(name=names, velocity=[0.01] * len(names))
        message.header.stamp = state.header.stamp
        commands.publish(message)

    probe.react["joint_states"] = answer
    harness.spin_until(
        lambda: (
            probe.messages["joint_states"][-1:] and max(probe.last("joint_states").velocity) > 0
        ),
        "it moves",
    )
    plant.drain(harness.executor)
    np.testing.assert_array_equal(plant.plant.qdot, 0.0)
    harness.spin_until(lambda: max(probe.last("joint_states").velocity) == 0, "it is published")
    assert plant.is_active
