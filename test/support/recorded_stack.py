"""A recorder beside a plant and a planner, and its bag read with nothing of this package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from mcap.reader import make_reader
from rcl_interfaces.msg import Log
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.serialization import deserialize_message
from support.altered_bags import message_class
from support.planner_flight import PLANNER, goal_at, values_of
from support.ros_harness import Harness, Probe

from spacerobot_ros.nodes import PlannerNode, PlantNode, RecorderNode

PLANT = {
    "robot": "sliding_masses",
    "time_mode": "lockstep",
    "tick_rate": 20.0,
    "marker_period": 0.5,
    "diagnostics_period": 0.5,
}
LATCHED_TOPICS = (
    "/robot_description", "/gait_schedule", "/planned_path", "/planner/status", "/plant/status",
)  # fmt: skip
STREAMS = (
    "/clock", "/odom", "/base_pose", "/joint_states", "/joint_commands", "/momentum", "/markers",
    "/diagnostics", "/goal_pose", "/events",
)  # fmt: skip

WRITTEN_BY_THE_RECORDER = ("/tf", "/tf_static")
"""Nobody publishes them where tf2_msgs is not installed."""


def has_parameters(bag: Path, *nodes: str) -> bool:
    """Whether a file that is being written has the parameters of nodes; records are as they are."""
    written = bag.read_bytes()
    return all(f"parameters/{node}".encode() in written for node in nodes)


class BagContent:
    """A bag, read with nothing of this package."""

    def __init__(self, path: Path) -> None:
        self.by_topic: dict[str, list[tuple[int, Any]]] = {}
        """When messages were written, ns, and what they say."""
        self.count = 0
        with path.open("rb") as file:
            reader = make_reader(file)
            for schema, channel, record in reader.iter_messages(log_time_order=False):
                assert schema is not None
                self.count += 1
                if channel.topic in WRITTEN_BY_THE_RECORDER:
                    continue
                message = deserialize_message(record.data, message_class(schema.name))
                self.by_topic.setdefault(channel.topic, []).append((record.log_time, message))
            self.metadata = {m.name: dict(m.metadata) for m in reader.iter_metadata()}

    def __getitem__(self, topic: str) -> list[Any]:
        return [message for _, message in self.by_topic.get(topic, [])]


class Stack:
    """A plant, a planner, a recorder and a probe that listens to whatever is recorded."""

    def __init__(self, harness: Harness, bag: Path, **recorder: Any) -> None:
        self.harness, self.bag = harness, bag
        self.plant = harness.make(PlantNode, PLANT, autostart=False)
        self.planner = harness.make(PlannerNode, PLANNER, autostart=False)
        self.probe: Probe = harness.probe({"/rosout": Log})
        self.goals = self.probe.create_publisher(PoseStamped, "goal_pose", 10)
        for node in (self.plant, self.planner):
            assert node.trigger_configure() is TransitionCallbackReturn.SUCCESS
        self.recorder = harness.make(RecorderNode, {"bag": str(bag), **recorder}, autostart=False)

    def configure(self, *topics: str) -> None:
        """Open the bag, and wait until these are listened to by the recorder and by the probe."""
        assert self.recorder.trigger_configure() is TransitionCallbackReturn.SUCCESS
        self.await_topics(*topics)
        types = dict(self.probe.get_topic_names_and_types())
        for topic in self.recorder.topics:
            latched = topic in LATCHED_TOPICS
            self.probe.watch(topic, message_class(types[topic][0]), latched=latched)
        self.harness.connect()
        recording = self.recorder.recording
        assert recording is not None
        # A matched subscription has not yet received what its publisher sent before.
        if "/plant/status" in self.recorder.topics:
            self.harness.spin_until(
                lambda: any(recording.latched.values()) and self.probe.count("/plant/status") > 0,
                "recorder and probe receive the plant's status",
            )

    def await_topics(self, *topics: str) -> None:
        self.harness.spin_until(
            lambda: set(topics) <= self.recorder.topics, f"subscriptions of {topics}"
        )

    def fly(self, x: float = 0.05) -> None:
        """Fly to a goal, and let everything arrive that is on its way."""
        if not self.planner.is_active:
            assert self.planner.trigger_activate() is TransitionCallbackReturn.SUCCESS
        self.goals.publish(goal_at(([x, 0.0, 0.0], [0.0] * 3)))
        if not self.plant.is_active:
            assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS
        heard = self.probe.count("/planner/status")
        self.harness.spin_until(
            lambda: any(
                values_of(status)["state"] in ("reached", "failed", "refused")
                for status in self.probe.messages["/planner/status"][heard:]
            ),
            "the goal is decided",
        )
        assert "reached" in self.probe.last("/planner/status").message

    def stop(self) -> None:
        """Stop time, and let everything arrive that is on its way."""
        self.plant.trigger_deactivate()
        self.harness.settle(self.probe)

    def close_bag(self) -> BagContent:
        if self.recorder.is_active:
            self.recorder.trigger_deactivate()
        assert self.recorder.trigger_cleanup() is TransitionCallbackReturn.SUCCESS
        return BagContent(self.bag)
