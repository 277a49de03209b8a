"""Steps the plant of a recorded flight again, under the commands that were recorded."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.errors import ParameterError, RecordingError, SpaceRobotError
from spacerobot_ros.simulation.brakes import JointBrakes
from spacerobot_ros.simulation.faults_plant import FaultyPlant
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.sensors import SensorModel, Sensors
from spacerobot_ros.verification.recorded_flight import RecordedFlight, usable_parameters
from spacerobot_ros.verification.state_topics import snapshot

_SECOND = 1e9


@dataclass(frozen=True)
class Reflight:
    """What came of the commands.

    `states` are the parts of the state, shape (ticks + 1, size), from tick `first` to tick `end`;
    `stopped` says why the plant went no further, `latched` of which tick the command latched a
    fault, after which nothing moved.
    """

    first: int
    end: int
    states: dict[str, NDArray[np.float64]]
    stopped: str = ""
    latched: int | None = None


def fly_again(
    flight: RecordedFlight, plant: FaultyPlant, link: int | None, first: int, last: int
) -> Reflight:
    """Step a plant, in its state at tick `first`, to tick `last` or as far as it goes.

    Args:
        flight: the commands.
        plant: what to step.
        link: number of the link whose pose is published, if one is.
        first: the tick of the plant's present state.
        last: the last tick wanted.

    Raises:
        RecordingError: the sensors err, and the first state is not the very first one, or their
            parameters are refused.
    """
    sensors = _sensors(flight, plant)
    if first and sensors.used:
        raise RecordingError(
            f"The bag {flight.bag.path} begins in mid-flight, where the noise of its sensors is "
            "not known."
        )
    plant.tick = first
    states = {
        part: np.empty((last - first + 1, values.size))
        for part, values in snapshot(plant, sensors, link).items()
    }
    rest = _rest(flight, plant)
    in_force: list[NDArray[np.float64] | None] = [None] * len(rest)
    latched: int | None = None
    for tick in range(first, last + 1):
        sensors.measure()
        for part, values in snapshot(plant, sensors, link).items():
            states[part][tick - first] = values
        if tick == last:
            break
        for text in flight.injections.get(tick, ()):
            with suppress(ParameterError):
                plant.inject(text)  # One that is refused changes nothing.
        given = [channel.commands.get(tick) for channel in flight.channels]
        if latched is None and any(command is not None and command.latches for command in given):
            latched = tick
        for channel, command in enumerate(given):
            if command is not None:
                in_force[channel] = None if command.refusal else command.values
            elif not sensors.dropout:  # To a lost pose nobody need answer.
                in_force[channel] = None
        try:
            plant.step(
                *(
                    values if values is not None and latched is None else at_rest()
                    for values, at_rest in zip(in_force, rest, strict=True)
                )
            )
        except SpaceRobotError as error:
            return Reflight(first, tick, states, str(error), latched)
    return Reflight(first, last, states, latched=latched)


def _sensors(flight: RecordedFlight, plant: FaultyPlant) -> Sensors:
    known = "sensors.seed" in flight.values  # Or else they were perfect.
    with usable_parameters(flight.bag):
        model = SensorModel.of(flight.values) if known else SensorModel()
        return Sensors(plant, model, flight.period_ns / _SECOND)


def _rest(flight: RecordedFlight, plant: Plant) -> list[Callable[[], NDArray[np.float64]]]:
    """Return what each channel of the plant does without a command that it takes."""
    zeros = [np.zeros(channel.size) for channel in flight.channels]
    rest: list[Callable[[], NDArray[np.float64]]] = [lambda zero=zero: zero for zero in zeros]  # type: ignore[misc]
    if flight.values["actuation"] == "effort":
        # Velocity servos stop at once; motors are told how.
        rest[0] = JointBrakes(plant, flight.period_ns / _SECOND).efforts
    return rest
