"""What a bag says of one flight of a plant: its parameters, its robot, and what commanded it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.reader import Bag
from spacerobot_ros.errors import CommandError, RecordingError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.simulation.building import PLANTS, period_ns

JOINT_STATE = "sensor_msgs/msg/JointState"
ODOMETRY = "nav_msgs/msg/Odometry"
_WRENCH = "geometry_msgs/msg/WrenchStamped"
_STRING = "std_msgs/msg/String"
_SECOND = 10**9
_TICK_RATES = (1e-3, 1e5)
"""What a plant flies at, Hz."""


@dataclass(frozen=True)
class Command:
    """What one channel of the plant was told for a tick; a refused command is a tick at rest.

    `latches` tells whether its refusal was a fault after which nothing moves.
    """

    values: NDArray[np.float64]
    refusal: str = ""
    latches: bool = False


@dataclass(frozen=True)
class Channel:
    """A command topic of the plant: its full name, how many numbers it takes, command by tick."""

    topic: str
    size: int
    commands: dict[int, Command]


@dataclass(frozen=True)
class RecordedFlight:
    """A flight in lockstep, as a bag holds it.

    `prefix` is the namespace of its topics, `values` are the plant's parameters, `channels` its
    command topics in the order of the arguments of its step, `injections` the faults that were
    injected in each tick.
    """

    bag: Bag
    prefix: str
    values: dict[str, Any]
    robot: SpaceRobot
    channels: list[Channel]
    injections: dict[int, list[str]]

    @property
    def period_ns(self) -> int:
        """Duration of a tick in nanoseconds."""
        return period_ns(self.values["tick_rate"])


@contextmanager
def usable_parameters(bag: Bag) -> Iterator[None]:
    """Say in one sentence that what the plant's parameters of a bag hold is of no use.

    Raises:
        RecordingError: they have other types or lengths than a plant takes.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise RecordingError(
            f"The plant's parameters in the bag {bag.path} cannot be used: {error!r}."
        ) from error


def read_flight(bag: Bag) -> RecordedFlight:
    """Read all that a re-simulation needs.

    Raises:
        RecordingError: the bag holds no flight of one plant in lockstep, or is damaged.
        RobotDescriptionError: its URDF is refused.
    """
    prefix = _prefix(bag)
    values = _parameters(bag, prefix)
    robot = SpaceRobot.from_urdf(_urdf(bag, prefix))
    quantity = values["actuation"]  # Both are named by the field of a command that they obey.
    limits = {"velocity": robot.velocity_limit, "effort": robot.effort_limit}[quantity]

    def joint_values(message: Any) -> NDArray[np.float64]:
        return _in_order(message.name, getattr(message, quantity), robot.joint_names)

    def wrench_values(message: Any) -> NDArray[np.float64]:
        return _wrench(message, robot.base_link)

    with usable_parameters(bag):
        judge = _Judge(bag, values)
    channels = [judge.channel(f"{prefix}/joint_commands", JOINT_STATE, limits, joint_values)]
    if PLANTS[quantity].thrusters:
        free = np.full(6, np.inf)
        channels.append(judge.channel(f"{prefix}/base_wrench", _WRENCH, free, wrench_values))
    return RecordedFlight(bag, prefix, values, robot, channels, _injections(bag, prefix, values))


def _prefix(bag: Bag) -> str:
    prefixes = [
        topic.removesuffix("/odom")
        for topic, kind in bag.topics.items()
        if topic.endswith("/odom")
        and kind == ODOMETRY
        and bag.message_count(topic)
        and bag.topics.get(f"{topic.removesuffix('/odom')}/joint_states") == JOINT_STATE
    ]
    if len(prefixes) != 1:
        found = f"{len(prefixes)} plants ({', '.join(prefixes)})" if prefixes else "no plant"
        raise RecordingError(
            f"The bag {bag.path} holds the states of {found}: to verify it takes one that "
            "published odom and joint_states."
        )
    return prefixes[0]


def _parameters(bag: Bag, prefix: str) -> dict[str, Any]:
    texts = bag.metadata.get(f"parameters{prefix}/plant") or bag.metadata.get("parameters/plant")
    if texts is None:
        raise RecordingError(
            f"The bag {bag.path} does not say what its plant was: bags of 'spacerobot run' hold "
            "the plant's parameters."
        )
    try:
        values = {name: json.loads(text) for name, text in texts.items()}
        mode, known = values["time_mode"], values["actuation"] in PLANTS
        possible = _TICK_RATES[0] <= values["tick_rate"] <= _TICK_RATES[1]
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"The plant's parameters in the bag {bag.path} cannot be read: {error}."
        ) from error
    if mode != "lockstep":
        raise RecordingError(
            f"The bag {bag.path} was flown in real time, where nothing records which command the "
            "plant held in which tick: only flights in lockstep can be verified."
        )
    if not (known and possible):
        raise RecordingError(
            f"The bag {bag.path} names a plant that this version does not have: actuation "
            f"{values['actuation']!r} at {values['tick_rate']!r} Hz."
        )
    return values


def _urdf(bag: Bag, prefix: str) -> str:
    topic = f"{prefix}/robot_description"
    attached = bag.attachments.get(f"{topic.strip('/').replace('/', '.')}.urdf")
    if attached is not None:
        return attached.decode(errors="replace")
    if topic in bag.topics and bag.message_count(topic):
        return str(next(bag.messages(topic))[1].data)
    raise RecordingError(f"The bag {bag.path} holds no description of its robot.")


def _injections(bag: Bag, prefix: str, values: dict[str, Any]) -> dict[int, list[str]]:
    """Read the faults by the tick in which they came: their log time, for they have no stamp."""
    topic = f"{prefix}/fault_injection"
    injections: dict[int, list[str]] = {}
    messages = bag.messages(topic) if bag.topics.get(topic) == _STRING else ()
    for time_ns, message in messages:
        injections.setdefault(time_ns // period_ns(values["tick_rate"]), []).append(message.data)
    return injections


class _Judge:
    """Takes and refuses commands as the plant with these parameters did."""

    def __init__(self, bag: Bag, values: dict[str, Any]) -> None:
        self._bag = bag
        self._tick_ns = period_ns(values["tick_rate"])
        self._clips = values.get("beyond_limits", "clip") == "clip"
        self._latching = values.get("latched_faults", "").split()

    def channel(
        self,
        topic: str,
        type_name: str,
        limits: NDArray[np.float64],
        read: Callable[[Any], NDArray[np.float64]],
    ) -> Channel:
        """Take the first command of each tick; later ones, and those between ticks, are stale."""
        commands: dict[int, Command] = {}
        messages = self._bag.messages(topic) if self._bag.topics.get(topic) == type_name else ()
        for _, message in messages:
            stamp = message.header.stamp
            tick, rest = divmod(stamp.sec * _SECOND + stamp.nanosec, self._tick_ns)
            if not rest and tick not in commands:
                commands[tick] = self._command(message, limits, read)
        return Channel(topic, len(limits), commands)

    def _command(
        self,
        message: Any,
        limits: NDArray[np.float64],
        read: Callable[[Any], NDArray[np.float64]],
    ) -> Command:
        reason = ""
        try:
            values = read(message)
        except CommandError as error:
            values, reason, refusal = np.zeros(len(limits)), "malformed", str(error)
        else:
            if not math.isfinite(sum(values.tolist())):
                reason, refusal = "not_finite", f"a value is not finite: {values.tolist()}"
            elif not self._clips and np.any(np.abs(values) > limits):
                reason, refusal = "beyond_limits", f"{values.tolist()} is beyond the limits"
        return Command(values, refusal, reason in self._latching) if reason else Command(values)


def _in_order(names: Sequence[str], given: Any, joints: Sequence[str]) -> NDArray[np.float64]:
    """Put values by joint name into the order of the robot's; joints that are not named rest."""
    unknown = [name for name in names if name not in joints]
    if unknown:
        raise CommandError(f"joint '{unknown[0]}' is unknown")
    if len(set(names)) != len(names):
        raise CommandError("a joint is named twice")
    if len(given) != len(names):
        raise CommandError(f"{len(names)} joint(s) are named but {len(given)} value(s) given")
    values = np.zeros(len(joints))
    values[[joints.index(name) for name in names]] = given
    return values


def _wrench(message: Any, base_link: str) -> NDArray[np.float64]:
    if message.header.frame_id not in ("", base_link):
        raise CommandError(f"the wrench is in frame '{message.header.frame_id}'")
    force, torque = message.wrench.force, message.wrench.torque
    return np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
