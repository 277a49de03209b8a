"""A recorder beside a plant and a planner, and its bag read with nothing of this package."""

from __future__ import annotations

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from mcap.reader import make_reader
from rcl_interfaces.msg import Log
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.serialization import deserialize_message
from support.planner_flight import PLANNER
from support.ros_harness import Harness, Probe

from spacerobot_ros.nodes import PlannerNode, PlantNode, RecorderNode
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.parameters import values_of

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


def parameters_of(node: FlightNode) -> dict[str, str]:
    """Return a node's parameters as JSON texts by name, for a bag's metadata."""
    values = {"autostart": True, **values_of(node.config)}
    return {name: json.dumps(value) for name, value in values.items()}


def has_parameters(bag: Path, *nodes: str) -> bool:
    """Whether a file that is being written has the parameters of nodes; records are as they are."""
    written = bag.read_bytes()
    return all(f"parameters/{node}".encode() in written for node in nodes)


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


@dataclass(frozen=True)
class Recorded:
    """One message of a bag: when it was written, ns, and what it says."""

    log_ns: int
    message: Any


class BagContent:
    """A bag, read with nothing of this package."""

    def __init__(self, path: Path) -> None:
        self.by_topic: dict[str, list[Recorded]] = {}
        self.log_times: list[int] = []
        with path.open("rb") as file:
            reader = make_reader(file)
            for schema, channel, record in reader.iter_messages(log_time_order=False):
                assert schema is not None
                self.log_times.append(record.log_time)
                if channel.topic in WRITTEN_BY_THE_RECORDER:
                    continue
                message = deserialize_message(record.data, message_class(schema.name))
                entry = Recorded(record.log_time, message)
                self.by_topic.setdefault(channel.topic, []).append(entry)
            self.metadata = {m.name: dict(m.metadata) for m in reader.iter_metadata()}
            self.attachments = {a.name: (a.media_type, a.data) for a in reader.iter_attachments()}

    def __getitem__(self, topic: str) -> list[Any]:
        return [entry.message for entry in self.by_topic.get(topic, [])]

    @property
    def count(self) -> int:
        return len(self.log_times)


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
        goal = PoseStamped()
        goal.header.frame_id = "world"
        goal.pose.position.x, goal.pose.orientation.w = x, 1.0
        self.goals.publish(goal)
        if not self.plant.is_active:
            assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS
        heard = self.probe.count("/planner/status")
        self.harness.spin_until(
            lambda: any(
                value.value in ("reached", "failed", "refused")
                for status in self.probe.messages["/planner/status"][heard:]
                for value in status.values
                if value.key == "state"
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
