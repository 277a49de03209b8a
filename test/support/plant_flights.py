"""Flights of a batch flown one by one in the plant: the reference for SIMD lanes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spacerobot_ros.batch.flights import (
    NOISES,
    BatchResult,
    ControlledGoals,
    Flights,
    FollowedSchedule,
    HeldCommands,
    SensorErrors,
    plant_of,
    split_command,
    state_of,
)
from spacerobot_ros.batch.native import BatchController
from spacerobot_ros.control.goal_monitor import Decision, GoalMonitor
from spacerobot_ros.control.state import ControlState, Reference
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import momentum_change
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.goal import Goal
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.tracker import ScheduleFollower
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.config import PlantConfig, SensorConfig
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.sensors import Sensors
from spacerobot_ros.times import SECOND

_Commands = Callable[[int, Plant | Sensors], Sequence[Array]]
"""Function that returns the commands of a flight for a tick and a measured state."""


def fly_one_by_one(flights: Flights) -> BatchResult:
    """Fly the flights in the plant, tick by tick."""
    result = BatchResult.empty(flights)
    controller: BatchController | None = None
    for row in range(len(flights)):
        try:
            if controller is None and isinstance(flights.program, ControlledGoals):
                controller = BatchController.of(flights)
            _fly_row(flights, row, result, controller)
        except SpaceRobotError as error:
            result.failures[row] = str(error)
    return result


def _fly_row(
    flights: Flights, row: int, result: BatchResult, controller: BatchController | None
) -> None:
    plant, period = plant_of(flights, row), flights.control_period
    errors = SensorConfig() if flights.sensors is None else sensor_config(flights.sensors, row)
    config = PlantConfig(actuation=flights.actuation, tick_rate=1 / period, sensors=errors)
    sensors = Sensors(PlantWithFaults(plant, config), config)
    ends = False  # Whether the flight ends at the tick of the decision about its goal.
    match flights.program:
        case FollowedSchedule() as program:
            command = _schedule_commands(flights, program, row)
        case HeldCommands():
            command = _held_commands(flights, row)
        case ControlledGoals(ends_when_decided=ends):
            assert controller is not None
            command = _controlled_commands(controller, row, result)
    instants = {tick: column for column, tick in enumerate(flights.report_ticks)}
    # Thrust does not explain the rest of the momenta.
    momenta, drift = plant.momentum[:6] - plant.expected_momenta, np.zeros(2)
    try:
        for tick in range(flights.ticks + 1):
            sensors.measure()
            measured = sensors if sensors.used else plant
            if tick in instants:
                column = instants[tick]
                result.states[row, column] = state_of(plant)
                result.measured_pose[row, column] = measured.pose
                result.measured_q[row, column] = measured.q
            decided = result.decision[row] != Decision.NONE
            if tick == flights.ticks or (ends and decided):
                result.end_tick[row] = tick
                break
            commands = command(tick, measured)
            plant.step(*commands)
            _update_peaks(plant, commands, result, row)
            if controller is not None:
                now = plant.momentum[:6] - plant.expected_momenta
                drift = np.maximum(drift, momentum_change(now, momenta))
        if controller is not None:
            result.end_state[row] = state_of(plant)
            result.momentum_drift[row] = drift
    finally:
        for name, counts in plant.limit_counts.items():
            result.limited_ticks[name][row] = counts


def sensor_config(errors: SensorErrors, row: int) -> SensorConfig:
    """Return the errors of one flight as the configuration of a plant's sensors."""
    return SensorConfig(
        **dict(zip(NOISES, errors.noise[row].tolist(), strict=True)),
        position_bias=tuple(errors.pose_bias[row, :3].tolist()),
        attitude_bias=tuple(errors.pose_bias[row, 3:].tolist()),
        joint_bias=tuple(errors.joint_bias[row].tolist()),
        seed=int(errors.seeds[row]),
    )


def _table_of(flights: Flights, row: int) -> Array:
    table = flights.table
    return table if table.ndim == 2 else np.asarray(table[row])


def _held_commands(flights: Flights, row: int) -> _Commands:
    """Return the commands of a table, zero after its end."""
    table = _table_of(flights, row)

    def command(tick: int, measured: Plant | Sensors) -> Sequence[Array]:
        held = table[tick] if tick < len(table) else np.zeros(table.shape[1])
        return split_command(flights, held)

    return command


def _schedule_commands(flights: Flights, program: FollowedSchedule, row: int) -> _Commands:
    goal = Goal(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    path = BasePath(np.zeros(1), goal.position[None], goal.quaternion[None])
    names, period = flights.robot.joint_names, flights.control_period
    schedule = GaitSchedule("", names, period, _table_of(flights, row), path, goal)
    follower = ScheduleFollower(schedule, 0, program.shape_gain, program.deadband)
    period_ns = round(period * SECOND)
    position, velocity = np.zeros(flights.robot.n), np.zeros(flights.robot.n)

    def command(tick: int, measured: Plant | Sensors) -> Sequence[Array]:
        follower.command(tick * period_ns, measured.q, position, velocity)
        return [velocity]

    return command


def _controlled_commands(controller: BatchController, row: int, result: BatchResult) -> _Commands:
    monitor, bounds, goal = GoalMonitor(), np.zeros(0), Reference()

    def command(tick: int, measured: Plant | Sensors) -> Sequence[Array]:
        nonlocal bounds, goal
        pose, twist = measured.pose, measured.twist
        parts = pose[:3], pose[3:], twist[:3], twist[3:], measured.q, measured.qdot
        state = ControlState(*(part.copy() for part in parts))
        if tick == 0:
            profile, bounds = controller.begin_flight(row, state)
            goal = profile.goal
        control, time = controller.controller, controller.time_of_tick(tick)
        realised = control.command(time, state, state.q, state.qdot).realised
        assert control.reference_ends is not None
        found = monitor.decide(
            time,
            control.reference_at_rest(time),
            control.reference_ends,
            control.errors(),
            control.joint_rate_limits.largest_rate_share(state.qdot),
            control.law.largest_error_share(bounds),
            controller.program.config.for_robot(control.law.robot.description),
        )
        decision = Decision(int(found))
        if decision is not Decision.NONE and result.decision[row] == Decision.NONE:
            result.decision[row], result.decision_tick[row] = decision, tick
            result.decision_distance[row] = control.distance_between(state, goal)
        return [realised.tau, realised.wrench_B]

    return command


def _update_peaks(plant: Plant, commands: Sequence[Array], result: BatchResult, row: int) -> None:
    for name, value in (("peak_rate", plant.qdot), ("peak_effort", plant.effort)):
        peak = getattr(result, name)[row]
        np.maximum(peak, np.abs(value), out=peak)
    np.minimum(result.lowest[row], plant.q, out=result.lowest[row])
    np.maximum(result.highest[row], plant.q, out=result.highest[row])
    if len(commands) > 1:
        sizes = np.linalg.norm(commands[1].reshape(2, 3), axis=1)
        np.maximum(result.peak_wrench[row], sizes, out=result.peak_wrench[row])
