"""States and diagnostics of a plant as messages."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.messages.builders import (
    STATIC_TRANSFORMS,
    TRANSFORMS,
    RobotTransforms,
    state_message,
)
from spacerobot_ros.messages.readers import MessageTemplate
from spacerobot_ros.messages.statuses import StatusRecord
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Pose, RobotDescription
from spacerobot_ros.model.kinematics import LinkPlacement
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.nodes.common.messages import (
    diagnostic_name,
    diagnostic_status,
    message_class,
    set_pose,
    shape_marker,
    transform_class,
)
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, FlightNode
from spacerobot_ros.nodes.common.streams import RawOutput
from spacerobot_ros.simulation.actuators import PlantWithFaults, ThrusterPlant, thrusters_in
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator, Refusal
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.time_modes import RealTime
from spacerobot_ros.times import SECOND, set_stamp, stamp_bytes
from spacerobot_ros.topics import TOPICS, Topic, pose_topic

if TYPE_CHECKING:
    from spacerobot_ros.simulation.clearance import ClearanceMonitor

PROPELLANT_KEY = "propellant_kg"
"""Diagnostics key of the propellant used."""

_MOMENTUM_ROUNDING = 1e-9
"""Largest momentum change by rounding, divided by the mass, m/s and m^2/s."""

_LOG_PERIOD = 5.0
"""Wall time between two log lines of one kind, s."""

_RESTING_SHARE = 0.01
"""Share of its effort limit that a joint which rests on its stop may push."""

_MILLISECONDS = 1e3

_OK, _WARN, _ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class PlantReport:
    """Writes logs and diagnostics of one plant.

    A level is a warning when its counters have moved since the last diagnostics.

    Parameters
    ----------
    node
        The plant's node.
    plant, commands
        Sources of the report.
    real_time
        Clock of a plant in real time; None in lockstep.
    """

    def __init__(
        self,
        node: Node,
        plant: PlantWithFaults,
        commands: CommandValidator,
        real_time: RealTime | None,
    ) -> None:
        self._node, self._real_time = node, real_time
        self.observe(commands, plant)
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        self._command_timeouts = 0
        self._last_refusal = ""
        self._reported = self._counters()
        self._unmet_reported = 0
        if self._thrusters is not None and self._thrusters.missing:
            node.get_logger().warning(f"The thrusters cannot give {self._thrusters.missing}.")

    def observe(self, commands: CommandValidator, plant: PlantWithFaults) -> None:
        """Report on these from now on."""
        self._commands, self._plant, self._thrusters = commands, plant, thrusters_in(plant)

    def refused(self, source: CommandSource, refusal: Refusal) -> None:
        """Log a refused command, which its validator has counted."""
        self._last_refusal = f"A command on '{source.topic}' was refused: {refusal.clause}."
        self._node.get_logger().warning(self._last_refusal, throttle_duration_sec=_LOG_PERIOD)
        if refusal.latches:
            self.latched()

    def latched(self) -> None:
        """Log that a fault is latched."""
        self._node.get_logger().error(
            f"A fault is latched: {self._commands.fault}. Nothing moves until '~/rearm' is called."
        )

    def timed_out(self, source: CommandSource, timeout: float) -> None:
        """Log that a commander's commands have ceased."""
        self._command_timeouts += 1
        self._node.get_logger().warning(
            f"No command on '{source.topic}' for {timeout:g} s: its actuators are brought to rest.",
            throttle_duration_sec=_LOG_PERIOD,
        )

    def limited(self) -> None:
        """Log that joints were held back in the last step, unless they merely rest on a stop."""
        plant, texts = self._plant, []
        resting = np.zeros(plant.robot.n, dtype=np.bool_)
        if plant.takes_wrench:
            limit = plant.robot.effort_limit
            weak = np.where(np.isfinite(limit), _RESTING_SHARE * limit, 0.0)
            resting = np.abs(plant.effort) <= weak
        for what, counts in plant.limit_counts.items():
            held_back = (counts > 0) & ~(resting if what == "stroke" else False)
            names = [plant.robot.joint_names[i] for i in np.flatnonzero(held_back)]
            if names:
                texts.append(f"{what} of {', '.join(names)}")
        if not texts:
            return
        self._node.get_logger().warning(
            f"Limits of the URDF held joints back so far: {'; '.join(texts)}.",
            throttle_duration_sec=_LOG_PERIOD,
        )

    def publish(self, time_ns: int) -> None:
        """Publish the diagnostics."""
        before, self._reported = self._reported, self._counters()
        refused, limited = (now != then for now, then in zip(self._reported, before, strict=True))
        array = DiagnosticArray()
        set_stamp(array.header.stamp, time_ns)
        array.status = [
            self._command_status(refused=refused),
            self._actuator_status(limited=limited),
            self._margin_status(),
            self._momentum_status(),
            self._fault_status(),
        ]
        if self._thrusters is not None:
            array.status.append(self._thruster_status(self._thrusters))
        if self._real_time is not None:
            array.status.append(timing_status(self._name("timing"), self._real_time))
        for status in array.status:
            status.hardware_id = self._plant.robot.description.name
        self._publisher.publish(array)

    def _name(self, part: str) -> str:
        return diagnostic_name(self._node.get_fully_qualified_name(), part)

    @property
    def _ticks_lost(self) -> int:
        return self._real_time.ticks_lost if self._real_time is not None else 0

    def _counters(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the counters that determine the levels of command and actuator diagnostics."""
        limits = self._plant.limit_counts.values()
        return (
            (self._commands.counts.total(), self._command_timeouts, self._ticks_lost),
            tuple(int(n) for counts in limits for n in counts),
        )

    def _command_status(self, *, refused: bool) -> DiagnosticStatus:
        commands = self._commands
        level, message = _WARN if refused else _OK, "commands arrive"
        if not commands.in_force:
            message = "no command is in force"
        if commands.fault:
            level = _ERROR
            message = f"Nothing moves until '~/rearm' is called: {commands.fault}."
        elif refused and self._last_refusal:
            message = self._last_refusal
        return diagnostic_status(
            self._name("commands"),
            level,
            message,
            {
                "refused": commands.counts.total(),
                **{f"refused.{reason.value}": n for reason, n in commands.counts.items()},
                "latched_fault": commands.fault,
                "timeouts": self._command_timeouts,
                "deadlines_missed": self._ticks_lost,
            },
        )

    def _actuator_status(self, *, limited: bool) -> DiagnosticStatus:
        return diagnostic_status(
            self._name("actuators"),
            _WARN if limited else _OK,
            "limits of the URDF hold joints back" if limited else "within limits",
            {
                f"{what}_limited.{joint}": count
                for what, counts in self._plant.limit_counts.items()
                for joint, count in zip(self._plant.robot.joint_names, counts, strict=True)
            },
        )

    def _margin_status(self) -> DiagnosticStatus:
        robot, q = self._plant.robot, self._plant.q
        margins = np.minimum(q - robot.lower, robot.upper - q)
        return diagnostic_status(
            self._name("strokes"),
            _OK,
            "how far each joint is from the nearer of its limits, m or rad",
            {
                joint: f"{margin:.6g}"
                for joint, margin in zip(robot.joint_names, margins, strict=True)
            },
        )

    def _momentum_status(self) -> DiagnosticStatus:
        plant = self._plant
        change = plant.momentum[:6] - plant.expected_momenta
        linear, angular = np.linalg.norm(change[:3]), np.linalg.norm(change[3:])
        # The threshold exceeds rounding errors of bodies that move at up to 1 m/s.
        leaks = max(linear, angular) > _MOMENTUM_ROUNDING * plant.robot.total_mass
        return diagnostic_status(
            self._name("momentum"),
            _ERROR if leaks else _OK,
            "momentum changes that no thruster accounts for"
            if leaks
            else "momentum is accounted for",
            {
                "linear_change": f"{linear:.3e}",
                "angular_change": f"{angular:.3e}",
                "kinetic_energy_J": f"{plant.momentum[6]:.6e}",
            },
        )

    def _fault_status(self) -> DiagnosticStatus:
        active = [str(each) for each in self._plant.injected]
        faults, disturbances = (
            [str(each) for each in given]
            for given in (self._plant.active, self._plant.disturbances)
        )
        return diagnostic_status(
            self._name("faults"),
            _WARN if active else _OK,
            f"injected: {'; '.join(active)}" if active else "no fault is injected",
            {f"fault_{i}": fault for i, fault in enumerate(faults, 1)}
            | {f"disturbance_{i}": each for i, each in enumerate(disturbances, 1)},
        )

    def _thruster_status(self, thrusters: ThrusterPlant) -> DiagnosticStatus:
        """Return propellant, pulses and unmet wrenches; a warning for new unmet wrenches."""
        unmet = thrusters.unmet_ticks > self._unmet_reported
        self._unmet_reported = thrusters.unmet_ticks
        sentences = [f"they cannot give {thrusters.missing}"] if thrusters.missing else []
        if unmet:
            sentences.append("the wanted wrench is beyond them")
        force, torque = np.linalg.norm(thrusters.unmet[:3]), np.linalg.norm(thrusters.unmet[3:])
        return diagnostic_status(
            self._name("thrusters"),
            _WARN if sentences else _OK,
            "; ".join(sentences) or "the wanted wrench is given",
            {
                PROPELLANT_KEY: f"{thrusters.propellant:.9g}",
                "pulses": int(thrusters.pulses.sum()),
                "unmet_ticks": thrusters.unmet_ticks,
                "unmet_force_N": f"{force:.6g}",
                "unmet_torque_Nm": f"{torque:.6g}",
                **{
                    f"pulses.{name}": count
                    for name, count in zip(thrusters.table.names, thrusters.pulses, strict=True)
                },
            },
        )


def timing_status(name: str, real_time: RealTime) -> DiagnosticStatus:
    """Return the delays of the plant's ticks and of its commander's answers as diagnostics."""
    timing = real_time.report()
    return diagnostic_status(
        name,
        _WARN if timing.worse else _OK,
        "deadlines were missed" if timing.worse else "in time",
        {
            "tick_rate_Hz": f"{timing.tick_rate:.6g}",
            "ticks": timing.ticks,
            "ticks_late": timing.ticks_late,
            "worst_tick_ms": f"{timing.worst_tick * _MILLISECONDS:.3f}",
            "commands": timing.commands,
            "commands_late": timing.commands_late,
            "worst_command_ms": f"{timing.worst_command * _MILLISECONDS:.3f}",
            "command_age_s": f"{timing.command_age:.6g}",
        },
    )


MARKER_ARRAY_TYPE = "visualization_msgs/msg/MarkerArray"

_TARGET = "target/odom"

_LONGEST_WAIT = 0.5
"""Longest wait for readers, wall s."""


class StatePublisher:
    """Publishes the state topics that the table of topics lists for a plant.

    Parameters
    ----------
    node
        The node that owns the publishers.
    robot
        The robot whose state is published.
    state
        The reported quantities.
    config
        Configuration of the plant: the names of the frames.
    """

    def __init__(
        self, node: FlightNode, robot: SpaceRobot, state: ReportedState, config: PlantConfig
    ) -> None:
        self._node, self._robot, self._state, self._config = node, robot, state, config
        self._world = config.world_frame
        self._base = config.frame_prefix + robot.base_link
        self._outputs: dict[str, RawOutput] = {}
        self._readers: frozenset[bytes] = frozenset()
        self._matched = 0
        self._description = node.create_publisher(String, "robot_description", LATCHED)
        self._target_description: Any = None
        if state.target is not None:
            self._target_description = node.create_publisher(
                String, "target/robot_description", LATCHED
            )
        self.rebuild()

    def observe(self, state: ReportedState) -> None:
        """Publish another state from now on."""
        self._state = state
        self.rebuild()

    def rebuild(self) -> None:
        """Create the messages of the quantities that the state has now."""
        clock = TOPICS["/clock"]
        streams = [
            (topic, self._output(topic), self._template(topic))
            for topic in (clock, *self._state.topics)
        ]
        self._all = [(output, template) for _, output, template in streams]
        self._every_tick = [
            (output, template) for topic, output, template in streams if topic.every_tick
        ]
        poses = {"odom", *(pose_topic(name).name for name in self._config.end_effectors)}
        self._of_measured_pose = [template for topic, _, template in streams if topic.name in poses]
        self._of_target = [template for topic, _, template in streams if topic.name == _TARGET]

    def publish_description(self) -> None:
        """Publish the URDFs of robot and target."""
        self._description.publish(String(data=self._robot.description.urdf))
        if self._state.target is not None:
            self._target_description.publish(String(data=self._state.target.urdf))

    def publish(self, time_ns: int, *, all_topics: bool) -> None:
        """Publish the state, stamped ``time_ns``.

        ``all_topics``: those too that are not published in every tick.
        """
        lost = self._of_measured_pose if self._state.sensors.dropout else []
        if self._state.misses_target:
            lost = [*lost, *self._of_target]
        stamp = stamp_bytes(time_ns)
        for output, template in self._all if all_topics else self._every_tick:
            if template not in lost:
                output.take(template.serialised(stamp))

    def has_new_readers(self) -> bool:
        """Whether the state has a subscriber that it did not have at the last call.

        The check takes 1 ms. A subscription that is replaced by another leaves their number; one
        that is known of may be matched later.
        """
        outputs = self._outputs.values()
        readers = frozenset(
            bytes(reader.endpoint_gid)
            for output in outputs
            for reader in self._node.get_subscriptions_info_by_topic(output.topic)
        )
        matched = sum(output.readers() for output in outputs)
        new = bool(readers - self._readers) or matched > self._matched
        self._readers, self._matched = readers, matched
        return new

    def await_readers(self) -> None:
        """Wait until all readers have received the states, or the time limit is over."""
        end = time.monotonic() + _LONGEST_WAIT
        for output in self._outputs.values():
            if not output.readers():
                continue
            left = max(0.0, end - time.monotonic())
            if not output.await_readers(Duration(seconds=left)):
                return

    def _output(self, topic: Topic) -> RawOutput:
        if topic.name not in self._outputs:
            self._outputs[topic.name] = self._node.send_raw(message_class(topic.type), topic.name)
        return self._outputs[topic.name]

    def _template(self, topic: Topic) -> MessageTemplate:
        """Return the message of a topic, fed with the quantities that it carries."""
        names = self._state.names(topic)
        target = self._state.target
        prototype = state_message(
            topic, names, self._world, self._base, "" if target is None else target.base_link
        )
        template = MessageTemplate(topic.type, prototype)
        if topic.name == "odom" and self._state.sensors.used:
            template.feed("pose.covariance", self._state.sensors.pose_covariance)
            template.feed("twist.covariance", self._state.sensors.twist_covariance)
        for field in topic.state:
            values = self._state.quantities[field.quantity]
            if values.size:
                template.feed(field.columns[0], values)
        return template


class TransformPublisher:
    """Publishes the measured frames of a robot on /tf, and its fixed frames on /tf_static.

    Without the package ``tf2_msgs`` nothing is published; bags have the transforms anyway.
    """

    def __init__(
        self, node: FlightNode, robot: SpaceRobot, state: ReportedState, config: PlantConfig
    ) -> None:
        self._state, self._kind = state, transform_class()
        if self._kind is None or not config.tf_period:
            self.publishes = False
            return
        self.publishes = True
        self._frames = RobotTransforms(
            robot.description, config.world_frame, config.frame_prefix, links=config.tf_links
        )
        self._stream = node.send_raw(self._kind, TRANSFORMS)
        self._static: RawOutput | None = None
        if self._frames.static_message(0) is not None:
            self._static = node.send_raw(self._kind, STATIC_TRANSFORMS, LATCHED)

    def observe(self, state: ReportedState) -> None:
        """Publish the frames of another state from now on."""
        self._state = state

    def publish_static(self, time_ns: int) -> None:
        """Publish the transforms of fixed links."""
        if self._static is not None:
            self._static.take(self._frames.static_message(time_ns) or b"")

    def publish(self, time_ns: int) -> None:
        """Publish the transforms of the last reported state, if it has a pose."""
        if not self._state.sensors.dropout:
            quantities = self._state.quantities
            self._stream.take(
                self._frames.message(time_ns, quantities["measured_pose"], quantities["measured_q"])
            )


class ClearancePublisher:
    """Publishes the smallest distance between links, and reports their contacts.

    Parameters
    ----------
    node
        The plant's node.
    plant
        The plant.
    monitor
        Measures the distances.
    stream
        The topic; None: a new one.
    """

    def __init__(
        self,
        node: FlightNode,
        plant: Plant,
        monitor: ClearanceMonitor,
        stream: RawOutput | None = None,
    ) -> None:
        self._node, self._plant, self._monitor = node, plant, monitor
        self._name = node.get_fully_qualified_name()
        self._stream = stream or node.send_raw(DiagnosticStatus, "clearance")

    @classmethod
    def of(
        cls,
        node: FlightNode,
        plant: Plant,
        described: RobotDescription,
        before: ClearancePublisher | None = None,
        *,
        has_contact_forces: bool = False,
    ) -> ClearancePublisher | None:
        """Return the publisher of a plant among obstacles; None where no links could touch.

        ``before`` is the publisher among the obstacles so far, whose topic goes on;
        ``has_contact_forces`` is that of :class:`.ClearanceMonitor`.
        """
        # Not every plant measures distances.
        from spacerobot_ros.simulation.clearance import ClearanceMonitor

        links, so_far = tuple(plant.robot.link_names), None if before is None else before._monitor
        monitor = ClearanceMonitor.of(
            described, links, so_far, has_contact_forces=has_contact_forces
        )
        if monitor is None:
            return None
        return cls(node, plant, monitor, None if before is None else before._stream)

    def observe(self, plant: Plant) -> None:
        """Measure another plant of the same robot from now on."""
        self._plant = plant

    def publish(self, time_ns: int) -> None:
        """Publish the present clearance, and events of contacts that have begun or ended."""
        plant = self._plant
        status, events = self._monitor.measure(
            plant.link_R, plant.link_r, plant.pose, time_ns / SECOND
        )
        record = StatusRecord(self._name, status.level, status.message, status.to_values())
        self._stream.take(record.encoded())
        for event in events:
            self._node.report_event(event)
            if event.level:
                self._node.get_logger().error(event.message)
            else:
                self._node.get_logger().info(event.message)


class LinkMarkers:
    """Publishes all visuals of a robot and of its target as one marker array in the world frame.

    With poses in the world frame a viewer needs no transforms.
    """

    def __init__(self, node: FlightNode, plant: PlantWithFaults, world_frame: str) -> None:
        self._plant, self._world_frame = plant, world_frame
        self._stream = node.send_raw(MarkerArray, "markers")
        self._drawn: set[tuple[str, int]] = set()
        """Namespaces and numbers of all markers so far."""
        self.use_obstacles(plant.robot.description.world)

    def observe(self, plant: PlantWithFaults) -> None:
        """Draw another plant of the same robot from now on."""
        self._plant = plant

    def use_obstacles(self, world: RobotDescription | None) -> None:
        """Draw other obstacles from now on; None: none."""
        plant, world_frame = self._plant, self._world_frame
        self._poses: list[tuple[int, Pose]] = []
        markers: list[Marker] = []
        for index, link in enumerate(plant.robot.description.links):
            for shape in link.shapes:
                markers.append(shape_marker(shape, world_frame, link.name, len(markers)))
                self._poses.append((index, shape.pose))
        self._of_target: list[Pose] = []
        """Poses of the visuals of the target in the frame of its root link."""
        if plant.capturing is not None:
            target = plant.capturing.target.description
            for link in target.links:
                for shape in link.shapes:
                    markers.append(shape_marker(shape, world_frame, link.name, len(markers)))
                    self._of_target.append(target.frames[link.name][1] @ shape.pose)
        if world is not None:
            for link in world.links:
                for shape in link.shapes or link.collisions:
                    marker = shape_marker(shape, world_frame, link.name, len(markers))
                    at = world.frames[link.name][1] @ shape.pose
                    set_pose(marker.pose, at.r, quaternion_from_matrix(at.R))
                    markers.append(marker)
        present = {(marker.ns, marker.id) for marker in markers}
        for ns, number in sorted(self._drawn - present):
            markers.append(Marker(ns=ns, id=number, action=Marker.DELETE))
        self._drawn |= present
        self._template = MessageTemplate(
            MARKER_ARRAY_TYPE, serialize_message(MarkerArray(markers=markers))
        )
        self._targets = [
            self._template.floats(f"markers[{i}].pose.position.x", 7)
            for i in range(len(self._poses) + len(self._of_target))
        ]
        self._placement = LinkPlacement(len(plant.robot.description.links), self._poses)

    def publish(self, time_ns: int) -> None:
        """Publish the markers of all visuals at their present poses."""
        if not self._targets:
            return
        plant = self._plant
        count = len(self._poses)
        self._placement.update(plant.pose, plant.link_R, plant.link_r)
        for placed, target in zip(self._placement.poses, self._targets[:count], strict=True):
            target[:] = placed
        if plant.capturing is not None:
            of_target = plant.capturing.target_pose
            at = Pose(matrix_from_quaternion(of_target[3:]), of_target[:3])
            for pose, target in zip(self._of_target, self._targets[count:], strict=True):
                shape = at @ pose
                target[:3], target[3:] = shape.r, quaternion_from_matrix(shape.R)
        self._stream.take(self._template.serialised(stamp_bytes(time_ns)))
