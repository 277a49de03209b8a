"""What the thrusters of a plant do, as messages."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

from spacerobot_ros.nodes.common.cdr import MessageTemplate, stamp_bytes
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.simulation.thrusters import ThrusterPlant

PROPELLANT = "propellant_kg"
"""Key of the propellant used, in the diagnostics."""


class ThrusterTopics:
    """Publishes ``base_wrench_realised`` and ``thrusters``, and describes them in the diagnostics.

    ``thrusters`` has the thrusters for joints: the position is for how long each was on since the
    beginning (s), the velocity for what part of the last tick, the effort its mean force in it (N).
    """

    def __init__(self, node: FlightNode, thrusters: ThrusterPlant) -> None:
        self._node, self._thrusters = node, thrusters
        wrench_message = WrenchStamped()
        wrench_message.header.frame_id = thrusters.robot.base_link
        wrench = MessageTemplate(wrench_message)
        wrench.feed("wrench.force.x", thrusters.wrench)
        names = list(thrusters.table.names)
        zeros = [0.0] * len(names)
        states_message = JointState(name=names, position=zeros, velocity=zeros, effort=zeros)
        states_message.header.frame_id = thrusters.robot.base_link
        states = MessageTemplate(states_message)
        states.feed("position", thrusters.on_time)
        states.feed("velocity", thrusters.duty)
        states.feed("effort", thrusters.thrust)
        self._streams = [
            (node.send_raw(kind, topic), template)
            for kind, topic, template in (
                (WrenchStamped, "base_wrench_realised", wrench),
                (JointState, "thrusters", states),
            )
        ]
        self._missing = thrusters.missing
        self._unmet_reported = 0
        if self._missing:
            node.get_logger().warning(f"The thrusters cannot give {self._missing}.")

    def publish(self, time_ns: int) -> None:
        """Publish what they did in the tick that ended at ``time_ns``."""
        stamp = stamp_bytes(time_ns)
        for stream, template in self._streams:
            stream.take(template.serialised(stamp))

    def status(self) -> DiagnosticStatus:
        """Return what they used and what they could not do; a warning where that is new."""
        thrusters = self._thrusters
        unmet, self._unmet_reported = (
            thrusters.unmet_ticks > self._unmet_reported,
            thrusters.unmet_ticks,
        )
        messages = [f"they cannot give {self._missing}"] if self._missing else []
        if unmet:
            messages.append("the wanted wrench is beyond them")
        force, torque = np.linalg.norm(thrusters.unmet[:3]), np.linalg.norm(thrusters.unmet[3:])
        values = {
            PROPELLANT: f"{thrusters.propellant:.9g}",
            "pulses": int(thrusters.pulses.sum()),
            "unmet_ticks": thrusters.unmet_ticks,
            "unmet_force_N": f"{force:.6g}",
            "unmet_torque_Nm": f"{torque:.6g}",
            **{
                f"pulses.{name}": count
                for name, count in zip(thrusters.table.names, thrusters.pulses, strict=True)
            },
        }
        return DiagnosticStatus(
            level=DiagnosticStatus.WARN if messages else DiagnosticStatus.OK,
            name=f"{self._node.get_fully_qualified_name()}: thrusters",
            message="; ".join(messages) or "the wanted wrench is given",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
