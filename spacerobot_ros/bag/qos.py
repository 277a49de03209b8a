"""Quality of service of a recorded topic, in the words rosbag2 writes into a bag."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import yaml

from spacerobot_ros.bag.errors import RecordingError

INFINITE_NS = 2**63 - 1
"""A duration without end, in nanoseconds (`RMW_DURATION_INFINITE`)."""

_POLICIES = {
    "history": ("keep_last", "keep_all", "system_default", "unknown"),
    "reliability": ("reliable", "best_effort", "system_default", "best_available", "unknown"),
    "durability": ("volatile", "transient_local", "system_default", "best_available", "unknown"),
    "liveliness": ("automatic", "manual_by_topic", "system_default", "best_available", "unknown"),
}

# Before Jazzy rosbag2 wrote the numbers of rmw's enumerations.
_NUMBERS = {
    "history": {0: "system_default", 1: "keep_last", 2: "keep_all"},
    "reliability": {0: "system_default", 1: "reliable", 2: "best_effort"},
    "durability": {0: "system_default", 1: "transient_local", 2: "volatile"},
    "liveliness": {0: "system_default", 1: "automatic", 3: "manual_by_topic"},
}
_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")


@dataclass(frozen=True)
class QosProfile:
    """The quality of service that a topic's publisher offers.

    The policies are the lower-case words of rmw (`rmw_qos_*_policy_to_str`). `ros2 bag play` knows
    no other ones, and nor does this class.

    Args:
        history: `keep_last`, `keep_all`, `system_default` or `unknown`.
        depth: how many messages `keep_last` keeps.
        reliability: `reliable`, `best_effort`, `system_default`, `best_available` or `unknown`.
        durability: `volatile`, `transient_local` (latched), or as above.
        deadline_ns: longest time between two messages, in nanoseconds.
        lifespan_ns: how long a message is worth delivering, in nanoseconds.
        liveliness: `automatic`, `manual_by_topic`, or as above.
        liveliness_lease_duration_ns: how long a silent publisher counts as alive, in nanoseconds.
        avoid_ros_namespace_conventions: whether the topic is a bare DDS topic.

    Raises:
        RecordingError: a policy is not one of its words.
    """

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = "automatic"
    liveliness_lease_duration_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for policy, words in _POLICIES.items():
            word = getattr(self, policy)
            if word not in words:
                raise RecordingError(f"The QoS {policy} {word!r} is not one of {', '.join(words)}.")

    @classmethod
    def from_yaml(cls, text: str) -> list[QosProfile]:
        """Read the value of a channel's `offered_qos_profiles`, in words or in numbers.

        Args:
            text: YAML of a list with one profile for each publisher; empty for none.

        Returns:
            The profiles. What one does not say is as in `QosProfile()`.

        Raises:
            RecordingError: the text is not such a list.
        """
        try:
            entries = yaml.safe_load(text) or []
            return [cls(**_arguments(entry)) for entry in entries]
        except (yaml.YAMLError, TypeError, ValueError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise RecordingError(f"A QoS profile of the bag cannot be read: {reason}.") from error

    def to_yaml(self) -> str:
        """Give the YAML of a list with this profile in it, as rosbag2 dumps it.

        Returns:
            The value of a channel's `offered_qos_profiles`, without a final newline.
        """
        return "\n".join(
            (
                f"- history: {self.history}",
                f"  depth: {self.depth}",
                f"  reliability: {self.reliability}",
                f"  durability: {self.durability}",
                *_duration("deadline", self.deadline_ns),
                *_duration("lifespan", self.lifespan_ns),
                f"  liveliness: {self.liveliness}",
                *_duration("liveliness_lease_duration", self.liveliness_lease_duration_ns),
                "  avoid_ros_namespace_conventions: "
                + ("true" if self.avoid_ros_namespace_conventions else "false"),
            )
        )


LATCHED = QosProfile(depth=1, durability="transient_local")
"""Reliable, transient local, depth 1: a late subscriber gets the last message."""


def _duration(name: str, nanoseconds: int) -> tuple[str, str, str]:
    seconds, rest = divmod(nanoseconds, 10**9)
    return f"  {name}:", f"    sec: {seconds}", f"    nsec: {rest}"


def _arguments(entry: dict[str, Any]) -> dict[str, Any]:
    """Turn one entry of the YAML into the arguments of a profile."""
    arguments: dict[str, Any] = {}
    for name, value in entry.items():
        if name in _DURATIONS:
            nanoseconds = int(value["sec"]) * 10**9 + int(value["nsec"])
            arguments[f"{name}_ns"] = min(nanoseconds, INFINITE_NS)
        elif name in _POLICIES:
            arguments[name] = _NUMBERS[name].get(value, "unknown") if _is_number(value) else value
        elif name in {field.name for field in fields(QosProfile)}:
            arguments[name] = value
    return arguments


def _is_number(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
