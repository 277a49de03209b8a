"""Re-simulates the plant with the commands in a bag, and compares the results with the published
states."""

from __future__ import annotations

import json
import math
import os
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.errors import CommandError, ParameterError, RecordingError, SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.reading import FlightBag, namespaces, recorded_actuation, recorded_target
from spacerobot_ros.flight.second_opinion import EngineComparison, EngineFlight
from spacerobot_ros.messages.readers import CommandReader, UnreadableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.capture import capture_values, target_parameters
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator, Refusal
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import StateField, state_topics

TOLERANCE = 1e-9
"""Accepted deviation: absolute for values below 1 (SI units), relative for larger values."""


_MAX_TICKS_PER_STATE, _MAX_SILENT_TICKS = 10, 20_000
"""Limits on the gaps between states, in ticks: a paused recorder leaves a gap, and stamps from
another source leave a larger gap."""

_COMPARED_FIRST = {"joint_states": 0, "odom": 1}
"""Ranks of topics to compare first: their differences explain differences in other topics."""


@dataclass(frozen=True)
class Difference:
    """A value in the bag that does not follow from the commands, or that has the largest deviation.

    Attributes
    ----------
    time
        Simulated time, s.
    topic, field
        Name of the number.
    recorded, expected
        The value in the bag, and the value in the re-simulation.
    remark
        Remark on the commands that cause the difference: a clause in parentheses, or an empty
        string.
    """

    time: float
    topic: str
    field: str
    recorded: float
    expected: float
    remark: str = ""

    def __str__(self) -> str:
        return (
            f"{self.topic} at {self.time:.9g} s: {self.field} is {self.recorded:.12g} in the bag "
            f"and {self.expected:.12g} according to the commands{self.remark}."
        )


@dataclass(frozen=True)
class Verification:
    """The result of a verification.

    Attributes
    ----------
    ticks, duration
        Number of re-simulated ticks, and their duration in s of simulated time.
    messages, topics
        Number of compared messages, and their topics.
    missing
        Message about states that are missing according to the message counts in the bag; empty if
        none are missing.
    second_opinion
        The differences from another engine under the same commands, if requested.
    largest, largest_at
        The largest deviation before the first difference, relative to max(1, expected value), and
        its location.
    difference
        The first difference, if any.
    """

    ticks: int
    duration: float
    messages: int
    largest: float
    largest_at: Difference | None
    difference: Difference | None
    topics: tuple[str, ...] = ()
    missing: str = ""
    second_opinion: EngineComparison | None = None


def verify_bag(
    path: str | os.PathLike[str], tolerance: float = TOLERANCE, *, mujoco: bool = False
) -> Verification:
    """Re-simulate a bag from its first state, and find the first difference.

    Parameters
    ----------
    path
        As for :func:`~spacerobot_ros.bag.read_bag`.
    tolerance
        Accepted deviation: absolute for values below 1 (SI units), relative for larger values.
    mujoco
        Whether MuJoCo also replays the commands realised by the plant's actuators.

    Raises
    ------
    RecordingError
        The bag does not exist, is damaged, or does not contain a lockstep flight.
    SpaceRobotError
        The robot or the plant parameters in the bag are invalid, or MuJoCo is not installed.
    """
    flight = _RecordedPlant.of(read_bag(path))
    published = _published_fields(flight)
    first = min(int(p.ticks.min()) for p in published)
    last = max(int(p.ticks.max()) for p in published)
    if first == last:
        raise RecordingError(
            f"The bag {flight.path} contains the states of only one tick: there is nothing to "
            f"verify."
        )
    states = sum({p.name: len(p.ticks) for p in published}.values())
    if first < 0 or last - first > _MAX_SILENT_TICKS + _MAX_TICKS_PER_STATE * states:
        raise RecordingError(
            f"The states in the bag {flight.path} are stamped {first * flight.config.period_ns}"
            f" to {last * flight.config.period_ns} ns, and there are {states} of them: a complete "
            "flight has a state in every tick."
        )
    resimulation = _resimulate(flight, published, first, last, mujoco=mujoco)
    efforts = (p.values.any() for p in published if p.field.quantity == "effort")
    if flight.config.actuation == "velocity" and not any(efforts):
        # An earlier version did not compute servo efforts, and published zeros.
        resimulation.states["effort"][:] = 0.0
    published = [p for p in published if p.is_determined_by(resimulation.states)]
    missing = _missing_states(resimulation, published)
    if first > 0:
        # The first state is an input: the commands before it are not in the bag.
        published = [p.after(first) for p in published]
    _require_no_reset(resimulation, published)
    return _compare(resimulation, published, tolerance, missing)


# -- the contents of the bag ------------------------------------------------------------------


RecordedCommand = Array | CommandError
"""The values of a command, or the reason why its message is malformed."""


@dataclass(frozen=True)
class _RecordedPlant:
    """The plant of a bag that was flown in lockstep.

    Parameters that an earlier version did not have are at their defaults. By tick, ``injections``
    are the injected faults and disturbances, and ``grasps`` the requested captures (true) and
    releases (false).
    """

    recorded: FlightBag
    config: PlantConfig
    robot: SpaceRobot
    injections: list[dict[int, list[str]]]
    grasps: dict[int, list[bool]]

    @classmethod
    def of(cls, bag: Bag) -> _RecordedPlant:
        """Read the plant from a bag, which must contain a lockstep flight of one plant."""
        recorded = _recorded_robot(bag)
        config = _plant_config(recorded)
        urdf = recorded.urdf
        if urdf is None:
            raise RecordingError(f"The bag {bag.path} contains no robot description.")
        description = parse_robot(urdf.decode(errors="replace"))
        names = recorded.joint_names
        if names != list(description.joint_names):
            # This check comes before the slow derivation of the robot's equations.
            raise RecordingError(
                f"The joint states in the bag {bag.path} have the joints {', '.join(names)}; its "
                f"robot has {', '.join(description.joint_names)}."
            )
        robot = SpaceRobot(config.assumed_robot(description))
        topics = ("fault_injection", "disturbance_injection")
        injections = [_injections(recorded, topic, config.period_ns) for topic in topics]
        return cls(recorded, config, robot, injections, _requested_grasps(recorded, config))

    def commands(self, source: CommandSource) -> dict[int, RecordedCommand]:
        """Return the first command of each tick; later commands and commands between ticks are
        stale."""
        commands: dict[int, RecordedCommand] = {}
        series = self.recorded.get(source.topic)
        if series is None:
            return commands
        prefix = self.config.prefix_for(self.robot.description)
        reader = CommandReader(source, self.robot, prefix)
        for raw in series.data:
            try:
                stamp_ns, command = reader.read(raw)
            except UnreadableError as error:
                raise RecordingError(f"A message on {series.topic}: {error}.") from error
            tick, rest = divmod(stamp_ns, self.config.period_ns)
            if not rest and tick not in commands:
                commands[tick] = command if isinstance(command, CommandError) else command.copy()
        return commands

    @property
    def path(self) -> Path:
        return self.recorded.path

    def format_time(self, tick: int) -> str:
        return f"{tick * self.config.period_ns / SECOND:.9g} s"


def _injections(recorded: FlightBag, topic: str, period_ns: int) -> dict[int, list[str]]:
    """Return the strings on a topic by tick; they have no stamp, so the log time is used."""
    by_tick: dict[int, list[str]] = {}
    for time_ns, message in recorded.messages(topic):
        by_tick.setdefault(time_ns // period_ns, []).append(message.data)
    return by_tick


def _requested_grasps(recorded: FlightBag, config: PlantConfig) -> dict[int, list[bool]]:
    """Return the captures (true) and releases (false) that were requested in each tick."""
    grasps: dict[int, list[bool]] = {}
    for _, event in recorded.events():
        captured = event.kind is EventKind.CAPTURED
        if event.time_s is None or not (captured or event.kind is EventKind.RELEASED):
            continue
        # The plant itself detects automatic captures.
        if not captured or capture_values(event.about).get("requested"):
            tick = round(event.time_s * SECOND / config.period_ns)
            grasps.setdefault(tick, []).append(captured)
    return grasps


def _recorded_robot(bag: Bag) -> FlightBag:
    candidates = [FlightBag(bag, name) for name in namespaces(bag)]
    found = [each for each in candidates if each.get("odom") and each.get("joint_states")]
    if len(found) != 1:
        names = ", ".join(each.namespace for each in found)
        plants = f"{len(found)} plants ({names})" if found else "no plant"
        raise RecordingError(
            f"The bag {bag.path} contains states of {plants}: verification needs one plant that "
            f"published odom and joint_states."
        )
    return found[0]


def _plant_config(recorded: FlightBag) -> PlantConfig:
    bag, texts = recorded.bag, recorded.metadata.get("parameters/plant")
    if texts is None:
        raise RecordingError(
            f"The bag {bag.path} has no plant parameters: bags recorded by 'spacerobot run' "
            f"contain them."
        )
    try:
        values = {name: json.loads(text) for name, text in texts.items()}
        if target := recorded_target(recorded):
            values |= target_parameters(target)
        config = configured(PlantConfig, values)
        if config.actuation == "auto":
            config = config.decided(recorded_actuation(recorded))
    except (ValueError, RecursionError, ParameterError) as error:
        reason = str(error).removesuffix(".")
        raise RecordingError(
            f"The plant's parameters in the bag {bag.path} cannot be used: {reason}."
        ) from error
    if config.time_mode != "lockstep":
        raise RecordingError(
            f"The bag {bag.path} was flown in real time and does not contain the command "
            "that the plant held in each tick: only lockstep flights can be verified."
        )
    return config


@dataclass(frozen=True)
class _PublishedField:
    """A field of a topic: ticks (N,) of the messages, values (N, m), and the name of each value."""

    topic: str
    name: str
    """Topic name with its namespace."""
    field: StateField
    ticks: NDArray[np.int64]
    values: Array
    labels: list[str]

    def after(self, tick: int) -> _PublishedField:
        """Omit the messages up to and including a tick; thruster on-times are counted from that
        tick."""
        kept = self.ticks > tick
        values = self.values[kept]
        if self.field.quantity == "thruster_on_time" and not kept.all():
            values -= self.values[~kept][-1]
        return replace(self, ticks=self.ticks[kept], values=values)

    def is_determined_by(self, states: dict[str, Array]) -> bool:
        """Whether a re-simulation contains the quantity, with the same size."""
        found = states.get(self.field.quantity)
        return found is not None and found.shape[1] == self.values.shape[1]

    def expected(self, states: dict[str, Array], rows: NDArray[np.int64]) -> Array:
        """Return the re-simulated values for each message, as an array of the same shape as the
        bag's values."""
        expected = states[self.field.quantity][rows]
        if self.field.quaternion is not None:
            q = slice(self.field.quaternion, self.field.quaternion + 4)
            opposite = np.sum(expected[:, q] * self.values[:, q], axis=1) < 0
            expected[opposite, q] *= -1.0
        return expected


def _published_fields(flight: _RecordedPlant) -> list[_PublishedField]:
    """Read the state topics; topics without a header get the stamps of the odometry."""
    recorded, period = flight.recorded, flight.config.period_ns
    published: list[_PublishedField] = []
    clock = recorded["odom"].stamp_ns
    topics = state_topics(flight.config.end_effectors)
    for topic in sorted(topics, key=lambda topic: _COMPARED_FIRST.get(topic.name, 2)):
        series = recorded.get(topic.name)
        if series is None:
            continue
        stamps = series.stamp_ns
        if not series.stamped and len(series) == len(clock):
            stamps = clock
        ticks = np.round(stamps / period).astype(np.int64)
        between = np.flatnonzero(ticks * period != stamps)
        if between.size:
            raise RecordingError(
                f"A message on {series.topic} of the bag {flight.path} is stamped "
                f"{stamps[between[0]] / SECOND:.9g} s, between the plant's ticks."
            )
        of_thrusters = topic.array_entries_of == "thrusters"
        names = recorded.names(topic.name) if of_thrusters else flight.robot.joint_names
        for each in topic.state:
            labels = each.labels(names)
            values = series.table(each.columns, len(labels))
            published.append(_PublishedField(topic.name, series.topic, each, ticks, values, labels))
    return published


def _missing_states(resimulation: _Resimulation, published: list[_PublishedField]) -> str:
    """Return a message about states that the bag lacks; empty for none."""
    recorded = resimulation.flight.recorded
    counts = recorded.metadata.get("recorder", {})
    texts = (counts.get(name, "") for name in ("messages", "messages_lost"))
    written, lost = (int(text) if text.isdecimal() else 0 for text in texts)
    held = recorded.bag.message_count()
    if resimulation.first == 0 and written > held:
        return f"its recorder wrote {written} messages, but it contains {held}."
    states = {int(t) for p in published if p.topic == "joint_states" for t in p.ticks}
    lacking = {tick for tick in resimulation.commanded_ticks if tick >= resimulation.first} - states
    if len(lacking) > lost:
        time = resimulation.flight.format_time(min(lacking))
        return f"it has commands for {len(lacking)} states that are missing, the first at {time}."
    return ""


def _initial_state(
    first: int, published: list[_PublishedField], flight: _RecordedPlant
) -> tuple[InitialState | None, Array]:
    """Return the first state in the bag, and its joint velocities (n,).

    At tick 0, the state is None (the parameters apply), and the velocities are zero.
    """
    if first == 0:
        return None, np.zeros(flight.robot.n)
    found = {p.field.quantity: p.values[p.ticks == first] for p in published}
    needed = ("measured_pose", "measured_q", "measured_qdot", "momentum")
    if not all(len(found.get(name, ())) for name in needed):
        raise RecordingError(
            f"The bag {flight.path} starts mid-flight, and its first state lacks odom, "
            f"joint_states or momentum."
        )
    pose, q, qdot, momentum = (found[name][0] for name in needed)
    q = np.clip(q, flight.robot.lower, flight.robot.upper)
    rates = qdot if flight.config.actuation == "effort" else None
    return InitialState.of_motion(pose, q, rates, momentum), qdot


# -- re-simulation ----------------------------------------------------------------------------


@dataclass
class _Resimulation:
    """A re-simulation of the commands.

    ``states`` are the quantities of the topics, (ticks + 1, size) each, from tick ``first`` to tick
    ``end``; ``stopped`` is the reason why the plant stopped there; ``latched`` is the tick in which
    a fault latched, after which nothing moved. ``commanded_ticks`` are the ticks with a command for
    the joints, ``refusals`` those with a rejected command, with its topic. ``engine`` is the engine
    that was run in parallel.
    """

    flight: _RecordedPlant
    first: int
    end: int
    states: dict[str, Array]
    commanded_ticks: frozenset[int]
    stopped: str = ""
    latched: int | None = None
    refusals: dict[int, tuple[str, Refusal]] = field(default_factory=dict)
    engine: EngineFlight | None = None


def _resimulate(
    flight: _RecordedPlant, published: list[_PublishedField], first: int, last: int, *, mujoco: bool
) -> _Resimulation:
    """Step the plant of a flight from tick ``first`` to tick ``last``, or as far as possible."""
    initial, rates = _initial_state(first, published, flight)
    plant = build_plant(flight.robot, flight.config, initial)
    state = ReportedState(plant, flight.config)
    commands = CommandValidator(plant, flight.config)
    if first and state.sensors.used:
        raise RecordingError(
            f"The bag {flight.path} starts mid-flight, so its sensor noise is unknown."
        )
    if first and plant.capturing is not None:
        raise RecordingError(
            f"The bag {flight.path} starts mid-flight, so it is unknown whether the target is held."
        )
    plant.start_at(first)
    if flight.config.actuation == "velocity":
        # Servo efforts follow from velocity changes.
        plant.qdot[:] = rates
        # Wheels without a later command keep their rates.
        joints = commands.sources[0]
        joints.command[joints.kept] = rates[joints.kept]
    recorded = [flight.commands(source) for source in commands.sources]
    states: dict[str, Array] = {}
    done = _Resimulation(flight, first, last, states, frozenset(recorded[0]))
    if mujoco and plant.capturing is not None:
        raise SpaceRobotError(
            f"The bag {flight.path} has a target, whose capture MuJoCo does not model: verify it "
            f"without the second engine."
        )
    if mujoco:
        done.engine = EngineFlight(plant, flight.config.period_ns / SECOND)
    for tick in range(first, last + 1):
        if state.update() or tick == first:
            # Sensor errors that begin in flight add the true states.
            for quantity, values in state.quantities.items():
                states.setdefault(quantity, np.full((last - first + 1, values.size), np.nan))
        for quantity, values in state.quantities.items():
            states[quantity][tick - first] = values
        if tick == last:
            break
        for inject, by_tick in zip((plant.inject, plant.disturb), flight.injections, strict=True):
            for text in by_tick.get(tick, ()):
                with suppress(ParameterError):
                    inject(text)  # A rejected line has no effect.
        if plant.capturing is not None:
            for captures in flight.grasps.get(tick, ()):
                with suppress(CommandError):  # A different capture shows in the states.
                    (plant.capturing.capture if captures else plant.capturing.release)()
        now = tick * flight.config.period_ns
        for source, commanded in zip(commands.sources, recorded, strict=True):
            if tick in commanded:
                refusal = commands.accept_or_refuse(source, now, commanded[tick], now)
                if refusal is not None:
                    done.refusals.setdefault(tick, (source.topic, refusal))
            elif not state.sensors.dropout:  # A state without a pose needs no answer.
                source.rest()
        if commands.fault and done.latched is None:
            done.latched = tick
        try:
            plant.step(*commands.begin_step())
        except SpaceRobotError as error:
            done.end, done.stopped = tick, str(error)
            break
        if done.engine is not None:
            done.engine.fly_next_tick()
    return done


def _second_opinion(
    resimulation: _Resimulation, published: list[_PublishedField]
) -> EngineComparison | None:
    """Return the engine's differences from the true states in the bag; None: no engine was run."""
    if resimulation.engine is None:
        return None
    found = {p.field.quantity: p for p in published}
    pose, q = (found.get(f"true_{name}", found[f"measured_{name}"]) for name in ("pose", "q"))
    ticks, rows, columns = np.intersect1d(pose.ticks, q.ticks, return_indices=True)
    return resimulation.engine.comparison(ticks, pose.values[rows], q.values[columns])


def _require_no_reset(resimulation: _Resimulation, published: list[_PublishedField]) -> None:
    """Reject a bag in which a state is published twice, the second time as the initial state."""
    joints = [p for p in published if p.topic == "joint_states" and p.values.shape[1]]
    if not joints:
        return
    ticks, back = joints[0].ticks, np.ones(len(joints[0].ticks), dtype=np.bool_)
    for p in joints:
        begun = p.expected(resimulation.states, np.zeros(len(ticks), dtype=np.int64))
        back &= np.all(np.isclose(p.values, begun, atol=TOLERANCE), axis=1)
    repeated = np.flatnonzero((np.diff(ticks) <= 0) & back[1:] & ~back[:-1])
    if repeated.size:
        time = resimulation.flight.format_time(ticks[repeated[0] + 1])
        raise RecordingError(
            f"In the bag {resimulation.flight.path} the plant was reset at {time}; only flights "
            "without a reset can be verified."
        )


# -- comparison -------------------------------------------------------------------------------


def _compare(
    done: _Resimulation, published: list[_PublishedField], tolerance: float, missing: str
) -> Verification:
    compared = [(p, *_deviation(p, done)) for p in published]
    difference, end = None, math.inf
    for p, expected, deviation in compared:
        # Not "greater": NaN is a difference.
        wrong = ~(deviation <= tolerance)
        rows = np.flatnonzero(wrong.any(axis=1))
        if rows.size and p.ticks[rows].min() < end:
            row = int(rows[np.argmin(p.ticks[rows])])
            end, column = int(p.ticks[row]), int(np.flatnonzero(wrong[row])[0])
            difference = _difference_at(done, p, expected, row, column, _command_remark(done, end))
    largest, largest_at = 0.0, None
    for p, expected, deviation in compared:
        counted = np.where((p.ticks < end)[:, np.newaxis], deviation, 0.0)
        if counted.size and counted.max() > largest:
            row, column = map(int, np.unravel_index(int(counted.argmax()), counted.shape))
            largest = float(counted.max())
            largest_at = _difference_at(done, p, expected, row, column)
    ticks = done.end - done.first
    return Verification(
        ticks=ticks,
        duration=ticks * done.flight.config.period_ns / SECOND,
        messages=sum({p.name: len(p.ticks) for p in published}.values()),
        topics=tuple(dict.fromkeys(p.name for p in published)),
        largest=largest,
        largest_at=largest_at,
        difference=difference,
        missing=missing,
        second_opinion=_second_opinion(done, published),
    )


def _deviation(p: _PublishedField, done: _Resimulation) -> tuple[Array, Array]:
    """Return the expected values and the deviations, both in the shape of the bag's values."""
    expected = p.expected(done.states, np.minimum(p.ticks, done.end) - done.first)
    deviation = np.abs(p.values - expected) / np.maximum(1.0, np.abs(expected))
    deviation[p.ticks > done.end] = np.nan
    return expected, deviation


def _difference_at(
    done: _Resimulation,
    p: _PublishedField,
    expected: Array,
    row: int,
    column: int,
    remark: str = "",
) -> Difference:
    return Difference(
        float(p.ticks[row] * done.flight.config.period_ns / SECOND),
        p.name,
        p.labels[column],
        float(p.values[row, column]),
        float(expected[row, column]),
        remark,
    )


def _command_remark(done: _Resimulation, tick: int) -> str:
    """Return a clause on why the commands of a tick had no effect; empty if they had one."""
    flight, before = done.flight, tick - 1
    if tick > done.end:
        return f" (its plant had stopped: {done.stopped.rstrip('.')})"
    if done.latched is not None and tick > done.latched:
        time = flight.format_time(done.latched)
        return f" (a fault latched at {time}; rearming is not recorded)"
    if before in done.refusals:
        topic, refusal = done.refusals[before]
        name = f"{flight.recorded.namespace}/{topic}"
        stamp = flight.format_time(before)
        return f" (the command on {name} stamped {stamp} is rejected: {refusal.clause})"
    if tick > done.first and before not in done.commanded_ticks:
        name = f"{flight.recorded.namespace}/joint_commands"
        return f" (no message on {name} is stamped {flight.format_time(before)})"
    return ""
