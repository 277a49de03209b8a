"""Plant states and diagnostics as messages."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from std_msgs.msg import String

from spacerobot_ros.messages.builders import (
    STATIC_TRANSFORMS,
    TRANSFORMS,
    RobotTransforms,
    state_message,
)
from spacerobot_ros.messages.diagnostics import PlantDiagnostics, StatusRecord, encode_diagnostics
from spacerobot_ros.messages.readers import MessageTemplate
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.nodes.common.messages import TRANSFORM_CLASS, interface_class, message_class
from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.simulation.commands import NO_STAMP, CommandSource, Reason, Refusal
from spacerobot_ros.simulation.status import latched_text
from spacerobot_ros.simulation.time_modes import RealTime
from spacerobot_ros.times import SECOND, stamp_bytes
from spacerobot_ros.topics import TOPICS, Topic, pose_topic

if TYPE_CHECKING:
    from spacerobot_ros.nodes.plant.node import PlantNode
    from spacerobot_ros.simulation.clearance import ClearanceMonitor

_LOG_PERIOD = 5.0  # wall s, between log lines of one kind

_RESTING_SHARE = 0.01
"""Maximum effort of a joint resting on its stop, as a fraction of its effort limit."""


class PlantReport:
    """Writes logs and diagnostics of one plant."""

    def __init__(self, node: PlantNode, real_time: RealTime | None) -> None:
        self._node, name = node, node.get_fully_qualified_name()
        self._diagnostics = PlantDiagnostics(name, node.plant, node.commands, real_time)
        self._stream = node.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        thrusters = node.plant.thrusters
        missing = "" if thrusters is None else thrusters.modulator.missing
        if missing:
            node.get_logger().warning(f"The thrusters cannot produce {missing}.")

    def observe_plant(self) -> None:
        """Report on the current plant of the node from now on."""
        self._diagnostics.observe(self._node.commands, self._node.plant)

    def refused(self, source: CommandSource, refusal: Refusal) -> None:
        """Log a rejected command, which its validator has counted."""
        sentence = self._diagnostics.note_refusal(source, refusal)
        if refusal.reason is Reason.STALE and source.stamp_ns == NO_STAMP:
            # A commander that has just started answers a state from before it was ready.
            self._node.get_logger().info(sentence, throttle_duration_sec=_LOG_PERIOD)
        elif refusal.reason is not Reason.LATCHED:  # Logged when the fault was latched.
            self._node.get_logger().warning(sentence, throttle_duration_sec=_LOG_PERIOD)
        if refusal.latches:
            self.latched()

    def latched(self) -> None:
        """Log that a fault is latched."""
        self._node.get_logger().error(f"{latched_text(self._node.commands.fault)}.")

    def timed_out(self, source: CommandSource, timeout: float) -> None:
        """Log that the commands from a commander have stopped."""
        self._diagnostics.command_timeouts += 1
        self._node.get_logger().warning(
            f"No command on '{source.topic}' for {timeout:g} s: the actuators are brought to rest.",
            throttle_duration_sec=_LOG_PERIOD,
        )

    def limited(self) -> None:
        """Log that limits restricted joints in the last step, except joints that merely rest
        against a stop.
        """
        plant, texts = self._node.plant, []
        resting = np.zeros(plant.robot.n, dtype=np.bool_)
        if plant.takes_wrench:
            limit = plant.robot.effort_limit
            weak = np.where(np.isfinite(limit), _RESTING_SHARE * limit, 0.0)
            resting = np.abs(plant.effort) <= weak
        for what, counts in plant.limit_counts.items():
            held_back = (counts > 0) & (~resting if what == "stroke" else True)
            names = [plant.robot.joint_names[i] for i in np.flatnonzero(held_back)]
            if names:
                texts.append(f"{what} of {', '.join(names)}")
        if not texts:
            return
        self._node.get_logger().warning(
            f"URDF limits have restricted joints: {'; '.join(texts)}.",
            throttle_duration_sec=_LOG_PERIOD,
        )

    def publish(self, time_ns: int) -> None:
        """Publish the diagnostics."""
        self._stream.publish(encode_diagnostics(self._diagnostics.records(), time_ns))


_TARGET = "target/odom"

_LONGEST_WAIT = 0.5  # wall s, for readers


class StatePublisher:
    """Publishes the state topics that the topic table lists for a plant."""

    def __init__(self, node: PlantNode) -> None:
        self._node, robot = node, node.plant.robot
        self._base = node.config.prefix_for(robot.description) + robot.base_link
        self._outputs: dict[str, Publisher] = {}
        self._readers: frozenset[bytes] = frozenset()
        self._matched = 0
        self._description = node.create_publisher(String, "robot_description", LATCHED)
        self._target_description: Any = None
        if node.reported.target is not None:
            self._target_description = node.create_publisher(
                String, "target/robot_description", LATCHED
            )
        self.rebuild()

    def rebuild(self) -> None:
        """Create the messages for the quantities that the state of the plant now contains."""
        topics = TOPICS["/clock"], *self._node.reported.topics
        for topic in topics:
            if topic.name not in self._outputs:
                self._outputs[topic.name] = self._node.create_publisher(
                    message_class(topic.type), topic.name, STREAM
                )
        streams = [(each, self._outputs[each.name], self._template(each)) for each in topics]
        self._all = [(output, template) for _, output, template in streams]
        self._every_tick = [
            (output, template) for topic, output, template in streams if topic.every_tick
        ]
        links = self._node.config.end_effectors
        poses = {"odom", *(pose_topic(name).name for name in links)}
        self._of_measured_pose = [template for topic, _, template in streams if topic.name in poses]
        self._of_target = [template for topic, _, template in streams if topic.name == _TARGET]

    def publish_description(self) -> None:
        """Publish the robot and target URDFs."""
        self._description.publish(String(data=self._node.plant.robot.description.urdf))
        if (target := self._node.reported.target) is not None:
            self._target_description.publish(String(data=target.urdf))

    def publish(self, time_ns: int, *, all_topics: bool) -> None:
        """Publish the state, stamped ``time_ns``.

        ``all_topics`` includes the topics that are not published in every tick.
        """
        state = self._node.reported
        lost = self._of_measured_pose if state.sensors.dropout else []
        if state.misses_target:
            lost = [*lost, *self._of_target]
        stamp = stamp_bytes(time_ns)
        for output, template in self._all if all_topics else self._every_tick:
            if template not in lost:
                output.publish(template.serialised(stamp))

    def has_new_readers(self) -> bool:
        """Whether the state has gained a subscriber since the last call.

        The check takes 1 ms. If one subscription replaces another, the number of subscriptions
        stays the same; a discovered subscription may be matched later.
        """
        outputs = self._outputs.values()
        readers = frozenset(
            bytes(reader.endpoint_gid)
            for output in outputs
            for reader in self._node.get_subscriptions_info_by_topic(output.topic_name)
        )
        matched = sum(output.get_subscription_count() for output in outputs)
        new = bool(readers - self._readers) or matched > self._matched
        self._readers, self._matched = readers, matched
        return new

    def await_readers(self) -> None:
        """Wait until all readers have received the states, or the time limit has passed."""
        end = time.monotonic() + _LONGEST_WAIT
        for output in self._outputs.values():
            if not output.get_subscription_count():
                continue
            left = max(0.0, end - time.monotonic())
            if not output.wait_for_all_acked(Duration(seconds=left)):
                return

    def _template(self, topic: Topic) -> MessageTemplate:
        state, world = self._node.reported, self._node.config.world_frame
        target = "" if state.target is None else state.target.base_link
        prototype = state_message(topic, state.names(topic), world, self._base, target)
        template = MessageTemplate(topic.type, prototype)
        if topic.name == "odom" and state.sensors.used:
            template.feed("pose.covariance", state.sensors.pose_covariance)
            template.feed("twist.covariance", state.sensors.twist_covariance)
        for field in topic.state:
            values = state.quantities[field.quantity]
            if values.size:
                template.feed(field.columns[0], values)
        return template


class TransformPublisher:
    """Publishes the measured frames of a robot on /tf, and the fixed frames on /tf_static.

    If the package ``tf2_msgs`` is missing, nothing is published; bags nevertheless contain
    the transforms.
    """

    def __init__(self, node: PlantNode) -> None:
        self._node, self._kind = node, interface_class(*TRANSFORM_CLASS)
        robot, config = node.plant.robot.description, node.config
        self.publishes = self._kind is not None and config.tf_period > 0
        if not self.publishes:
            return
        self._frames = RobotTransforms(
            robot, config.world_frame, config.prefix_for(robot), links=config.tf_links
        )
        self._stream = node.create_publisher(self._kind, TRANSFORMS, STREAM)
        self._static: Publisher | None = None
        if self._frames.static_message(0) is not None:
            self._static = node.create_publisher(self._kind, STATIC_TRANSFORMS, LATCHED)

    def publish_static(self, time_ns: int) -> None:
        """Publish the transforms of fixed links."""
        if self._static is not None:
            self._static.publish(self._frames.static_message(time_ns) or b"")

    def publish(self, time_ns: int) -> None:
        """Publish the transforms of the last reported state, if it has a pose."""
        if not self._node.reported.sensors.dropout:
            quantities = self._node.reported.quantities
            self._stream.publish(
                self._frames.message(time_ns, quantities["measured_pose"], quantities["measured_q"])
            )


class ClearancePublisher:
    """Publishes the smallest distance between links, and reports their contacts."""

    def __init__(self, node: PlantNode) -> None:
        self._node = node
        self._monitor: ClearanceMonitor | None = None
        self._stream: Publisher | None = None
        """Created once links could touch."""
        has_forces = node.config.engine == "mujoco"
        self.use(node.plant.robot.description, has_contact_forces=has_forces)

    def use(self, described: RobotDescription, *, has_contact_forces: bool = False) -> bool:
        """Measure distances between links and to obstacles from now on; return whether links could
        touch. For ``has_contact_forces``, see :class:`.ClearanceMonitor`."""
        # Not every plant measures distances.
        from spacerobot_ros.simulation.clearance import ClearanceMonitor

        plant = self._node.plant
        self._monitor = ClearanceMonitor.of(
            described,
            tuple(plant.robot.link_names),
            self._monitor,
            capturing=plant.capturing,
            has_contact_forces=has_contact_forces,
        )
        if self._monitor is not None and self._stream is None:
            self._stream = self._node.create_publisher(DiagnosticStatus, "clearance", STREAM)
        return self._monitor is not None

    def look(self, time_ns: int, *, publishes: bool) -> tuple[str, ...] | None:
        """Report contacts that have begun or ended; return the current contacts, or None if they
        are unchanged.

        If ``publishes`` is true, also publish the current clearance.
        """
        if self._monitor is None or self._stream is None:
            return None
        node, plant = self._node, self._node.plant
        status, events = self._monitor.measure(
            plant.link_R, plant.link_r, plant.pose, time_ns / SECOND
        )
        if publishes:
            record = StatusRecord.of(node.get_fully_qualified_name(), status)
            self._stream.publish(record.encoded())
        for event in events:
            node.report_event(event)
            if event.level:
                node.get_logger().error(event.message)
            else:
                node.get_logger().info(event.message)
        return self._monitor.contacts if events else None
