"""Flights one after the other in the package's own plant: what the batch is held against."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from spacerobot_ros.batch.controlling import BatchController
from spacerobot_ros.batch.flights import (
    BatchResult,
    Controlled,
    Decision,
    Flights,
    FollowedSchedule,
    HeldCommands,
)
from spacerobot_ros.control.executive import LOST_STATES
from spacerobot_ros.control.state import ControlState
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.goal import Goal
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.tracker import ScheduleFollower
from spacerobot_ros.simulation.actuators import PLANTS, FaultyPlant, ThrusterPlant
from spacerobot_ros.simulation.config import SensorConfig
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.sensors import Sensors
from spacerobot_ros.times import SECOND


def fly_one_by_one(flights: Flights, rows: Iterable[int] | None = None) -> BatchResult:
    """Fly the flights of some rows (all, unless given) in the plant, tick by tick.

    The rows that are not flown are NaN or zero.
    """
    result = BatchResult.empty(flights)
    failures: dict[int, str] = {}
    controller: BatchController | None = None
    for row in range(len(flights)) if rows is None else rows:
        try:
            if controller is None and isinstance(flights.program, Controlled):
                controller = BatchController.of(flights)
            _fly(flights, row, result, controller)
        except SpaceRobotError as error:
            failures[row] = str(error)
    return replace(result, engine="scalar", failures=failures)


def _fly(
    flights: Flights, row: int, result: BatchResult, controller: BatchController | None
) -> None:
    plant = plant_of(flights, row)
    thrusters = None
    if flights.thrusters is not None:
        plant = thrusters = ThrusterPlant(plant, flights.control_period, flights.thrusters)
    config = SensorConfig() if flights.sensors is None else flights.sensors.config(row)
    faulty = FaultyPlant(plant, (), flights.control_period, wrench=flights.actuation == "effort")
    sensors = Sensors(faulty, config, flights.control_period)
    control = None if controller is None else _Control(controller, row, result, plant)
    commands: _Commands | _Control = control or _Commands(flights, row)
    last = flights.ticks
    wanted = iter(flights.instants)
    next_instant, column = next(wanted), 0
    try:
        for tick in range(flights.ticks + 1):
            sensors.measure()
            if tick == next_instant:
                _report(plant, sensors, result, row, column)
                column += 1
                next_instant = next(wanted, -1)
            if tick == last:
                result.end_tick[row] = tick
                break
            commanded = commands.at(tick, sensors if sensors.used else plant)
            plant.step(*commanded)
            _account(plant, commanded, flights.control_period, result, row)
            if control is not None:
                control.watch_momenta()
                if control.ends:
                    last = tick + 1
        if control is not None:
            result.end_state[row] = control.truth
        if thrusters is not None:
            result.propellant[row] = thrusters.propellant
    finally:
        for name, counts in plant.limit_counts.items():
            result.limited[name][row] = counts


def plant_of(flights: Flights, row: int) -> Plant:
    """Return the plant of one flight at its start."""
    kind = PLANTS[flights.actuation]
    return kind.plant(
        flights.robot_of(row),
        flights.control_period,
        flights.starts.initial_state(row),
        flights.integration_step or kind.integration_step,
    )


class _Commands:
    """What is commanded in one flight, tick by tick."""

    def __init__(self, flights: Flights, row: int) -> None:
        n, program = flights.robot.n, flights.program
        self._velocity, self._position = np.zeros(n), np.zeros(n)
        self._nothing: list[Array] = [np.zeros(n)]
        self._follower: ScheduleFollower | None = None
        match program:
            case FollowedSchedule():
                self._follower = ScheduleFollower(
                    _schedule(flights, _of_row(program.positions, row)),
                    *(0, program.shape_gain, program.deadband),
                )
                self._period_ns = round(flights.control_period * SECOND)
            case HeldCommands():
                self._held: list[Array] = [_of_row(program.joints, row)]
                if program.wrench is not None:
                    self._held.append(_of_row(program.wrench, row))
                    self._nothing.append(np.zeros(6))

    def at(self, tick: int, measured: Plant | Sensors) -> list[Array]:
        """Return the commands of a tick for what is measured."""
        if self._follower is not None:
            stamp = tick * self._period_ns
            self._follower.command(stamp, measured.q, self._position, self._velocity)
            return [self._velocity]
        return [
            held[tick] if tick < len(held) else nothing
            for held, nothing in zip(self._held, self._nothing, strict=True)
        ]


class _Control:
    """What a controller commands in one flight, tick by tick, and what becomes of its goal."""

    def __init__(
        self, controller: BatchController, row: int, result: BatchResult, plant: Plant
    ) -> None:
        self._controller, self._row, self._result, self._plant = controller, row, result, plant
        self._since: int | None = None
        self._bounds: Array = np.zeros(0)
        self._wild = [0, 0]
        self._first = self._unexplained()
        result.momentum_drift[row] = 0.0

    @property
    def truth(self) -> Array:
        """The state of the plant as results have it."""
        plant = self._plant
        return np.concatenate([plant.q, plant.qdot, plant.pose, plant.twist, plant.momentum])

    @property
    def ends(self) -> bool:
        """Whether the flight ends after the last command."""
        decided = self._result.decision[self._row] != Decision.NONE
        return self._controller.until_decided and bool(decided)

    def at(self, tick: int, measured: Plant | Sensors) -> list[Array]:
        """Return efforts and wrench of a tick for what is measured."""
        pose, twist = measured.pose, measured.twist
        parts = pose[:3], pose[3:], twist[:3], twist[3:], measured.q, measured.qdot
        state = ControlState(*(part.copy() for part in parts))
        controller, result, row = self._controller, self._result, self._row
        if tick == 0:
            _, self._bounds = controller.begin(row, state)
        commands = controller.command(tick, state)
        if not controller.reached(tick):
            self._since = None
        elif self._since is None:
            self._since = tick
        settled = self._since is not None and controller.settled(self._since, tick)
        if settled and np.isnan(result.reached_time[row]):
            result.reached_time[row] = controller.time(tick)
            result.reached_state[row] = self.truth
        self._decide(tick, settled, state.qdot)
        return commands

    def _decide(self, tick: int, settled: bool, qdot: Array) -> None:
        controller, result, row = self._controller, self._result, self._row
        wild = controller.wild(qdot, self._bounds)
        self._wild = [n + 1 if now else 0 for n, now in zip(self._wild, wild, strict=True)]
        decision = Decision.NONE
        if max(self._wild) >= LOST_STATES:
            decision = Decision.LOST
        elif settled:
            decision = Decision.REACHED
        elif 0 <= controller.last_tick <= tick:
            decision = Decision.FAILED
        if decision is not Decision.NONE and result.decision[row] == Decision.NONE:
            result.decision[row], result.decided_tick[row] = decision, tick
            result.decided_errors[row] = controller.errors()

    def watch_momenta(self) -> None:
        """Take the changes of momenta that thrust does not explain."""
        change = (self._unexplained() - self._first).reshape(2, 3)
        drift = self._result.momentum_drift[self._row]
        np.maximum(drift, np.linalg.norm(change, axis=1), out=drift)

    def _unexplained(self) -> Array:
        return np.asarray(self._plant.momentum[:6] - self._plant.expected_momenta)


def _schedule(flights: Flights, positions: Array) -> GaitSchedule:
    pose = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    path = BasePath(np.zeros(1), pose[0][None], pose[1][None])
    names = flights.robot.joint_names
    return GaitSchedule("", names, flights.control_period, positions, path, Goal(*pose))


def _of_row(array: Array, row: int) -> Array:
    return array if array.ndim == 2 else np.asarray(array[row])


def _report(plant: Plant, sensors: Sensors, result: BatchResult, row: int, column: int) -> None:
    measured: Any = sensors if sensors.used else plant
    for name, value in (
        ("pose", plant.pose),
        ("twist", plant.twist),
        ("q", plant.q),
        ("qdot", plant.qdot),
        ("momentum", plant.momentum),
        ("measured_pose", measured.pose),
        ("measured_q", measured.q),
    ):
        getattr(result, name)[row, column] = value


def _account(
    plant: Plant, commanded: list[Array], control_period: float, result: BatchResult, row: int
) -> None:
    """Take the peaks and integrals of a tick."""
    for name, value in (("peak_rate", plant.qdot), ("peak_effort", plant.effort)):
        peak = getattr(result, name)[row]
        np.maximum(peak, np.abs(value), out=peak)
    np.minimum(result.lowest[row], plant.q, out=result.lowest[row])
    np.maximum(result.highest[row], plant.q, out=result.highest[row])
    if len(commanded) > 1:
        sizes = np.linalg.norm(commanded[1].reshape(2, 3), axis=1)
        np.maximum(result.peak_wrench[row], sizes, out=result.peak_wrench[row])
        result.impulse[row] += control_period * sizes
