"""Flies the plant of a bag again, under the commands in the bag, and compares what it publishes."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.reader import read_bag
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.building import build_plant
from spacerobot_ros.verification.recorded_flight import (
    RecordedFlight,
    read_flight,
    usable_parameters,
)
from spacerobot_ros.verification.resimulation import Reflight, fly_again
from spacerobot_ros.verification.state_topics import StateTopic, state_topics

TOLERANCE = 1e-9
"""Deviation that is no difference, absolute below 1 (SI units) and relative above."""

_SECOND = 1e9
_DEFAULT_END_EFFECTOR = "end_effector"


@dataclass(frozen=True)
class Difference:
    """A number in the bag that is not what the commands make of it, or the largest deviation."""

    time: float
    topic: str
    field: str
    recorded: float
    expected: float
    remark: str = ""

    def __str__(self) -> str:
        return (
            f"{self.topic} at {self.time:.9g} s: {self.field} is {self.recorded:.12g} in the bag "
            f"and {self.expected:.12g} by its commands{self.remark}."
        )


@dataclass(frozen=True)
class Verification:
    """What comes of a bag: ticks flown again, messages compared, the first difference if any.

    `largest` is the largest deviation before that difference, as a share of the tolerance's scale.
    """

    ticks: int
    duration: float
    messages: int
    largest: float
    largest_at: Difference | None
    difference: Difference | None


@dataclass(frozen=True)
class _Published:
    """The messages of one topic: ticks (N,), numbers (N, m)."""

    topic: StateTopic
    name: str
    ticks: NDArray[np.int64]
    values: NDArray[np.float64]

    def after(self, tick: int) -> _Published:
        """Leave out what came until then."""
        kept = self.ticks > tick
        return replace(self, ticks=self.ticks[kept], values=self.values[kept])


def verify_bag(path: str | os.PathLike[str], tolerance: float = TOLERANCE) -> Verification:
    """Fly a bag again from its first state, and look for the first difference.

    Args:
        path: as for `read_bag`.
        tolerance: deviation that is no difference, absolute below 1 and relative above.

    Returns:
        What came of it.

    Raises:
        RecordingError: there is no such bag, it is damaged, or it holds no flight in lockstep.
        SpaceRobotError: its robot or its plant's parameters are refused.
    """
    flight = read_flight(read_bag(path))
    link = _end_effector(flight)
    names = flight.robot.link_names
    published = _published(flight, names[link] if link is not None else "")
    first = min(int(p.ticks.min()) for p in published)
    last = max(int(p.ticks.max()) for p in published)
    initial = _initial(first, published, flight)
    with usable_parameters(flight.bag):
        plant = build_plant(flight.robot, flight.values, initial)
    if first > 0:
        # What the flight begins from is given, and what moved it there is not in the bag.
        published = [p.after(first) for p in published]
    again = fly_again(flight, plant, link, first, last)
    _require_no_reset(flight, published, again)
    return _Comparison(flight, published, again, tolerance).result()


def _end_effector(flight: RecordedFlight) -> int | None:
    links = list(flight.robot.link_names)
    name = flight.values.get("end_effector_frame") or _DEFAULT_END_EFFECTOR
    return links.index(name) if name in links else None


def _published(flight: RecordedFlight, end_effector: str) -> list[_Published]:
    """Read the state topics; the plant stamps those without a header like its odometry."""
    bag, period = flight.bag, flight.period_ns
    published: list[_Published] = []
    clock = bag[f"{flight.prefix}/odom"].stamp_ns
    for topic in state_topics(flight.robot.joint_names, end_effector):
        name = f"{flight.prefix}/{topic.name}"
        if bag.topics.get(name) != topic.type_name or not bag.message_count(name):
            continue
        series = bag[name]
        stamps = series.stamp_ns
        if not series.stamped and len(series) == len(clock):
            stamps = clock
        ticks = np.round(stamps / period).astype(np.int64)
        between = np.flatnonzero(ticks * period != stamps)
        if between.size:
            raise RecordingError(
                f"A message on {name} of the bag {bag.path} is stamped "
                f"{stamps[between[0]] / _SECOND:.9g} s, between the ticks of the plant in it."
            )
        if topic.name == "joint_states":
            _require_joints(flight, next(series.messages())[1].name)
        published.append(_Published(topic, name, ticks, topic.recorded(series)))
    return published


def _require_joints(flight: RecordedFlight, names: list[str]) -> None:
    if list(names) != list(flight.robot.joint_names):
        raise RecordingError(
            f"The joint states in the bag {flight.bag.path} are of {', '.join(names)}; its robot "
            f"has {', '.join(flight.robot.joint_names)}."
        )


def _initial(
    first: int, published: list[_Published], flight: RecordedFlight
) -> InitialState | None:
    """Return the first state in the bag; None, for the parameters, if it is the very first."""
    if first == 0:
        return None
    parts = {p.topic.name: p.values[p.ticks == first] for p in published}
    needed = ("odom", "joint_states", "momentum")
    if not all(len(parts.get(name, ())) for name in needed):
        raise RecordingError(
            f"The bag {flight.bag.path} begins in mid-flight, and its first state lacks odom, "
            "joint_states or momentum."
        )
    n, joints = flight.robot.n, parts["joint_states"][0]
    return InitialState(
        position=parts["odom"][0][:3],
        quaternion=parts["odom"][0][3:7],
        joint_positions=np.clip(joints[:n], flight.robot.lower, flight.robot.upper),
        joint_velocities=joints[n : 2 * n] if flight.values["actuation"] == "effort" else None,
        linear_momentum=parts["momentum"][0][:3],
        angular_momentum=parts["momentum"][0][3:6],
    )


def _require_no_reset(flight: RecordedFlight, published: list[_Published], again: Reflight) -> None:
    """Refuse a bag in which a state is published a second time, and is the initial one again."""
    for p in published:
        if p.topic.name != "joint_states" or not p.values.shape[1]:
            continue
        begun = np.concatenate([again.states[part][0] for part in p.topic.parts])
        back = np.isclose(p.values, begun, atol=TOLERANCE).all(axis=1)
        repeated = np.flatnonzero((np.diff(p.ticks) <= 0) & back[1:] & ~back[:-1])
        if repeated.size:
            time = p.ticks[repeated[0] + 1] * flight.period_ns / _SECOND
            raise RecordingError(
                f"In the bag {flight.bag.path} the plant was reset at {time:.9g} s; only flights "
                "without a reset can be verified."
            )


class _Comparison:
    """The published states beside those of the flight by the recorded commands."""

    def __init__(
        self,
        flight: RecordedFlight,
        published: list[_Published],
        again: Reflight,
        tolerance: float,
    ) -> None:
        self._flight, self._again, self._tolerance = flight, again, tolerance
        self._pairs = [(p, *self._deviation(p)) for p in published]

    def result(self) -> Verification:
        """Find the first difference and, before it, the largest deviation."""
        difference = self._first_difference()
        period = self._flight.period_ns
        end = np.inf if difference is None else round(difference.time * _SECOND / period)
        largest, largest_at = 0.0, None
        for p, expected, deviation in self._pairs:
            before = p.ticks < end
            counted = np.where(before[:, np.newaxis], deviation, 0.0)
            if counted.size and counted.max() > largest:
                row, column = map(int, np.unravel_index(int(counted.argmax()), counted.shape))
                largest = float(counted.max())
                largest_at = self._at(p, expected, row, column)
        return Verification(
            ticks=self._again.end - self._again.first,
            duration=(self._again.end - self._again.first) * period / _SECOND,
            messages=sum(len(p.ticks) for p, _, _ in self._pairs),
            largest=largest,
            largest_at=largest_at,
            difference=difference,
        )

    def _deviation(self, p: _Published) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what is expected, and how far from it the bag is, both shaped as its values."""
        rows = np.minimum(p.ticks, self._again.end) - self._again.first
        expected = np.hstack([self._again.states[part][rows] for part in p.topic.parts])
        if p.topic.quaternion is not None:
            q = slice(p.topic.quaternion, p.topic.quaternion + 4)
            opposite = np.sum(expected[:, q] * p.values[:, q], axis=1) < 0
            expected[opposite, q] *= -1.0
        deviation = np.abs(p.values - expected) / np.maximum(1.0, np.abs(expected))
        deviation[p.ticks > self._again.end] = np.nan
        return expected, deviation

    def _first_difference(self) -> Difference | None:
        found: tuple[int, Difference] | None = None
        for p, expected, deviation in self._pairs:
            # Not "greater": what is no number is a difference.
            wrong = ~(deviation <= self._tolerance)
            rows = np.flatnonzero(wrong.any(axis=1))
            if not rows.size:
                continue
            row = int(rows[np.argmin(p.ticks[rows])])
            tick = int(p.ticks[row])
            if found is None or tick < found[0]:
                column = int(np.flatnonzero(wrong[row])[0])
                found = tick, self._at(p, expected, row, column, self._remark(tick))
        return found[1] if found else None

    def _at(
        self,
        p: _Published,
        expected: NDArray[np.float64],
        row: int,
        column: int,
        remark: str = "",
    ) -> Difference:
        return Difference(
            float(p.ticks[row] * self._flight.period_ns / _SECOND),
            p.name,
            p.topic.labels[column],
            float(p.values[row, column]),
            float(expected[row, column]),
            remark,
        )

    def _remark(self, tick: int) -> str:
        """Say what is known of the commands that led to a tick, beside their numbers."""
        again = self._again
        if tick > again.end:
            return f" (its plant had stopped: {again.stopped.rstrip('.')})"
        if again.latched is not None and tick > again.latched:
            time = f"{again.latched * self._flight.period_ns / _SECOND:.9g} s"
            return f" (a fault latched at {time}; rearming is not in a bag)"
        before = tick - 1
        time = f"{before * self._flight.period_ns / _SECOND:.9g} s"
        for channel in self._flight.channels:
            command = channel.commands.get(before)
            if command is not None and command.refusal:
                return f" (that on {channel.topic} stamped {time} is refused: {command.refusal})"
        first = self._flight.channels[0]
        if tick > again.first and before not in first.commands:
            return f" (no message on {first.topic} is stamped {time})"
        return ""
