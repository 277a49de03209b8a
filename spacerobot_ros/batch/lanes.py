"""Blocks of flights: in the lanes of vector registers, or one flight per device thread.

A block's memory is one array (groups, rows, lanes); a row contains one value for each flight in a
group. On a device, all threads belong to one group. ``driver.hpp`` loops over the ticks and returns
commands that lanes cannot compute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, replace
from typing import Any

import numpy as np

from spacerobot_ros.batch.flights import (
    BatchResult,
    ControlledGoals,
    Counts,
    Flags,
    Flights,
    FollowedSchedule,
    HeldCommands,
    plant_of,
)
from spacerobot_ros.batch.native import BatchController, CompiledTick, Job, Program
from spacerobot_ros.batch.targets import Target, vector_unit
from spacerobot_ros.control.goal_monitor import Decision, GoalMonitor
from spacerobot_ros.control.reference import ReferenceProfile
from spacerobot_ros.control.state import ControlState
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.compilation import NoLibraryError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.model_functions import ModelFunctions
from spacerobot_ros.model.rotations import matrices_from_quaternions
from spacerobot_ros.simulation.effort_plant import FAILURES
from spacerobot_ros.times import SECOND

_MAX_BLOCK_GROUPS = 64
"""Largest number of lane groups in a block; more would not be faster."""

_CHUNK_TICKS = 2000
"""Number of ticks between checks for signals and for flights that continue."""

_PROGRAMS = {
    HeldCommands: Program.HELD,
    FollowedSchedule: Program.FOLLOWED,
    ControlledGoals: Program.CONTROLLED,
}


def fly_lanes(
    flights: Flights, target: Target | None = None, stopped: Callable[[], bool] = lambda: False
) -> BatchResult:
    """Fly many flights at once, one per SIMD lane or device thread.

    Every flight matches the plant's flight with the same values up to rounding (1e-12 in the
    benchmark flights). ``stopped`` is called every 2000 ticks; once it returns True, the result is
    incomplete.

    Raises
    ------
    SpaceRobotError
        There is no C++ compiler, or lanes do not support the controller.
    """
    target = target or vector_unit()
    model, p = symbolic_model_of(flights)
    try:
        tick = CompiledTick.of(flights, model, target)
    except NoLibraryError as reason:
        raise SpaceRobotError(f"Lanes need a C++ compiler: {reason}.") from reason
    fit = starts_accepted_by_plant(flights)
    result = replace(BatchResult.empty(flights), engine=target.engine)
    for row in np.flatnonzero(~fit).tolist():
        try:
            plant_of(flights, row)
        except SpaceRobotError as error:
            result.failures[row] = str(error)
    rows = np.flatnonzero(fit)
    each = 8 * (2 * tick.row_count + 100 * len(flights.report_ticks))
    if (table := flights.table).ndim == 3:
        each += 2 * table[0].nbytes
    size, lanes = target.block_bytes // each, target.lanes
    if not target.threads:
        size = min(_MAX_BLOCK_GROUPS, size // lanes) * lanes
    size = max(lanes, size)
    for first in range(0, len(rows), size):
        LaneBlock(flights, tick, model, p, rows[first : first + size], result).fly(stopped)
    return result


def symbolic_model_of(flights: Flights) -> tuple[ModelFunctions, Array]:
    """Return the robot model and its arguments ``p`` (N, ...), which are the masses of the
    flights."""
    inertial = flights.inertial
    if inertial is None:
        inertial = flights.robot.inertial.scaled(np.ones((len(flights), 1)))
    return flights.robot.symbolic_model(inertial)


def starts_accepted_by_plant(flights: Flights) -> Flags:
    """Return whether the plant accepts the start state of each flight, (N,)."""
    starts, robot = flights.initial_states, flights.robot
    fit = np.isfinite(starts.position).all(axis=1) & np.isfinite(starts.momenta).all(axis=1)
    fit &= np.isfinite(starts.qdot).all(axis=1)
    fit &= ((starts.q >= robot.lower) & (starts.q <= robot.upper)).all(axis=1)
    with np.errstate(invalid="ignore"):
        size = np.linalg.norm(starts.quaternion, axis=1)
        return np.asarray(fit & np.isfinite(size) & (size > 1e-6))


class LaneBlock:
    """Memory of the flights that occupy the lanes at the same time; surplus lanes are idle.

    The results of the flights and the messages of failed flights are written to ``result``.
    """

    def __init__(
        self,
        flights: Flights,
        tick: CompiledTick,
        model: ModelFunctions,
        p: Array,
        rows: Counts,
        result: BatchResult,
    ) -> None:
        self._flights, self._tick, self._model, self._flown = flights, tick, model, rows
        self._result, self._target, self._rows = result, tick.target, tick.rows
        program, self._controller = flights.program, None
        if tick.controller is not None and isinstance(program, ControlledGoals):
            self._controller = BatchController(program, tick.controller)
        self._lanes = len(rows) if tick.target.threads else tick.target.lanes
        self._groups = -(-len(rows) // self._lanes)
        surplus = np.repeat(rows[-1:], self._groups * self._lanes - len(rows))
        self._rows_of_lanes = np.concatenate([rows, surplus])
        self._memory = self._target.zeros((self._groups, tick.row_count, self._lanes))
        self._memory[:, self._rows["decided_state"]] = np.nan
        self._memory[:, self._rows["end_state"]] = np.nan
        self._write_rows("alive", 1.0)
        self._ended: dict[int, int] = {}
        """Ticks at which flights failed, by lane in the block."""
        self._profiles: dict[int, ReferenceProfile] = {}
        """Reference profiles of controlled flights, by lane in the block."""
        self._write_starts(p[rows])
        errors, controller = flights.sensors, self._controller
        if errors is not None:
            self._write_rows("joint_bias", errors.joint_bias[rows])
            self._write_rows("joint_noise", errors.noise[rows, 4:5])
        if controller is not None:
            self._write_rows("monitor", astuple(GoalMonitor())[1:])
            self._write_rows("decided", -1.0)
            self._write_rows("gains", controller.gains_argument(rows.tolist()))
            if errors is not None:
                bias = np.hstack([errors.pose_bias[rows], errors.joint_bias[rows]])
                self._write_rows("bias", bias)
                self._write_rows("sigma", errors.noise[rows])
        self._loops = len(rows) if self._target.threads else self._groups
        """Number of flights or groups whose ticks are counted separately."""
        arrays = self._target.arrays
        self._at = arrays.zeros(self._loops, np.int64)
        self._pending = arrays.zeros(self._loops, np.uint8)
        self._reports = self._target.zeros(
            (self._groups, len(flights.report_ticks), tick.report_width, self._lanes)
        )
        self._normals: Any = None
        """Sensor random numbers at the instants, in the order of :class:`.Sensors`."""
        if flights.sensors is not None:
            width = 12 + 2 * flights.robot.n
            self._normals = self._target.zeros((*self._reports.shape[:2], width, self._lanes))
        self._job, self._referenced = self._prepare_job()

    def _write_rows(self, name: str, values: Any, lanes: Counts | None = None) -> None:
        """Write the rows with a name, (lanes, size) or a number, for all flights or some lanes."""
        arrays = self._target.arrays
        if lanes is None and len(self._flown) == self._groups * self._lanes:
            part, each = self._memory[:, self._rows[name]], arrays.asarray(values)
            if each.ndim == 2:
                part[:] = each.reshape(self._groups, self._lanes, -1).swapaxes(1, 2)
            else:
                part[:] = each.reshape(-1, 1)
            return
        chosen = np.arange(len(self._flown)) if lanes is None else lanes
        group, lane = np.divmod(chosen[:, np.newaxis], self._lanes)
        rows = np.arange(self._tick.row_count)[self._rows[name]]
        at = (arrays.asarray(each) for each in (group, rows, lane))
        self._memory[tuple(at)] = arrays.asarray(values)

    def _read_rows(self, name: str) -> Array:
        part = np.swapaxes(self._target.to_numpy(self._memory[:, self._rows[name]]), 1, 2)
        return part.reshape(len(self._rows_of_lanes), -1)[: len(self._flown)]

    def _write_starts(self, p: Array, lanes: Counts | None = None) -> None:
        """Write masses ``p`` and initial states of all flights, or only of those in some lanes."""
        at = self._flown if lanes is None else self._flown[lanes]
        starts = self._flights.initial_states[at]
        self._write_rows("p", p, lanes)
        quaternion = starts.quaternion / np.linalg.norm(starts.quaternion, axis=1, keepdims=True)
        centers = self._model.function("center_of_mass", compile=False)(starts.q.T, p.T).full().T
        R = matrices_from_quaternions(quaternion)
        of_base = starts.position + np.einsum("nij,nj->ni", R, centers)
        is_given = starts.position_is_of_center_of_mass[:, np.newaxis]
        r_cm = np.where(is_given, starts.position, of_base)
        parts = [starts.q, quaternion]
        if self._flights.actuation == "velocity":
            self._write_rows("momenta", starts.momenta, lanes)
            self._write_rows("r_cm", r_cm, lanes)
        else:
            parts += [starts.qdot, starts.momenta, r_cm]
        self._write_rows("state", np.concatenate(parts, axis=1), lanes)

    def _prepare_job(self) -> tuple[Job, list[Any]]:
        """Return the driver's job, and the arrays that it points to."""
        flights, program, errors = self._flights, self._flights.program, self._flights.sensors
        commands, noisy = flights.table, False
        if commands.ndim == 3:  # (groups, ticks, width, lanes), as they differ.
            of_lanes = commands[self._rows_of_lanes]
            grouped = of_lanes.reshape(self._groups, self._lanes, *commands.shape[1:])
            commands = np.moveaxis(grouped, 1, 3)
        table = self._target.arrays.asarray(np.ascontiguousarray(commands))
        self._instants = self._target.arrays.asarray(np.array(flights.report_ticks, dtype=np.int64))
        each_table = table.ndim == 4
        arrays = {
            "memory": self._memory,
            "at": self._at,
            "pending": self._pending,
            "table": table,
            "instants": self._instants,
            "reports": self._reports,
        }
        if errors is not None:
            # Commands along schedules depend only on the errors of joints.
            of_joints = errors.noise[self._flown, 4].any() or errors.joint_bias[self._flown].any()
            noisy = isinstance(program, ControlledGoals) or bool(of_joints)
            seeds = errors.seeds[self._rows_of_lanes].astype(np.uint64)
            arrays |= {"seeds": self._target.arrays.asarray(seeds), "normals": self._normals}
        job = Job(
            groups=self._loops,
            period=flights.control_period,
            period_ns=round(flights.control_period * SECOND),
            program=_PROGRAMS[type(program)],
            table_ticks=table.shape[1] if each_table else table.shape[0],
            each_table=each_table,
            noisy=noisy,
            instant_count=len(flights.report_ticks),
            ends=isinstance(program, ControlledGoals) and program.ends_when_decided,
            **{name: self._target.address(array) for name, array in arrays.items()},
        )
        if isinstance(program, FollowedSchedule):
            job.gain = min(program.shape_gain, 1.0 / flights.control_period)
            job.deadband = program.deadband
        return job, list(arrays.values())

    def fly(self, stopped: Callable[[], bool]) -> None:
        """Fly the flights and write the results, unless stopped."""
        flights = self._flights
        # A zero-duration tick without a command reports the start.
        self._call("start_flights")
        self._memory[:, self._rows["h"]] = flights.control_period
        for begin in range(0, flights.ticks, _CHUNK_TICKS):
            if stopped():
                return
            alive = self._target.to_numpy(self._memory[:, self._rows["alive"]])
            if not alive.any():
                break
            if not begin:
                self._begin_control()
            self._fly_until(min(begin + _CHUNK_TICKS, flights.ticks))
        if self._controller is not None:
            self._call("end_flights")
        self._write_results()

    def _call(self, function: str) -> None:
        self._target.call(self._tick.driver, function, self._job)

    def _fly_until(self, tick: int) -> None:
        self._job.until = tick
        self._call("fly_until")
        while self._controller is not None and self._pending.any():
            self._command_outside_lanes()
            self._call("fly_until")
        if self._memory[:, self._rows["failure"]].any():
            reasons, ticks = self._read_rows("failure")[:, 0], self._read_rows("failed_at")[:, 0]
            for lane in np.flatnonzero(reasons).tolist():
                self._end_flight(lane, int(ticks[lane]), FAILURES[int(reasons[lane]) - 1])
            self._memory[:, self._rows["failure"]] = 0.0

    def _end_flight(self, lane: int, tick: int, message: str) -> None:
        self._write_rows("alive", 0.0, np.array([lane]))
        self._result.failures[int(self._flown[lane])] = message
        self._ended[lane] = tick

    def _begin_control(self) -> None:
        controller = self._controller
        if controller is None:
            return
        self._call("measure_starts")
        states = self._read_rows("measured")
        numbers = np.zeros_like(self._read_rows("profile"))
        most = np.zeros_like(self._read_rows("bounds"))
        for lane, (row, state) in enumerate(zip(self._flown.tolist(), states, strict=True)):
            try:
                profile, most[lane] = controller.begin_flight(row, ControlState.unstack(state))
            except SpaceRobotError as error:
                self._end_flight(lane, 0, str(error))
                continue
            self._profiles[lane] = profile
            numbers[lane] = controller.profile_argument(profile)
        self._write_rows("profile", numbers)
        self._write_rows("bounds", most)

    def _command_outside_lanes(self) -> None:
        controller, each = self._controller, 1 if self._target.threads else self._lanes
        assert controller is not None
        of_loops = np.arange(len(self._flown)) // each
        waiting = self._target.to_numpy(self._pending)[of_loops] != 0
        waiting &= (self._read_rows("exact") * self._read_rows("alive"))[:, 0] != 0.0
        ticks, states = self._target.to_numpy(self._at)[of_loops], self._read_rows("measured")
        for lane in np.flatnonzero(waiting).tolist():
            row, tick, state = int(self._flown[lane]), int(ticks[lane]), states[lane]
            try:
                command = controller.exact_command(
                    row, self._profiles[lane], tick, ControlState.unstack(state)
                )
            except SpaceRobotError as error:
                self._end_flight(lane, tick, str(error))
                continue
            self._write_rows("command", command, np.array([lane]))
            self._result.fallback_ticks[row] += 1

    def _reported(self, reports: Any) -> Array:
        """Return the values reported at instants (groups, instants, width, lanes) as (flights,
        instants, width)."""
        each = np.moveaxis(self._target.to_numpy(reports), 3, 1)
        return each.reshape(-1, *reports.shape[1:3])[: len(self._flown)]

    def _write_results(self) -> None:
        result, rows = self._result, self._flown
        reports = self._reported(self._reports)
        for lane, tick in self._ended.items():
            reports[lane, np.array(self._flights.report_ticks) > tick] = np.nan
        result.states[rows] = reports
        for name in ("peak_rate", "peak_effort", "peak_wrench", "lowest", "highest"):
            getattr(result, name)[rows] = self._read_rows(name)
        limits = self._read_rows("limits").astype(np.int64)
        for counts, part in zip(result.limited_ticks.values(), np.hsplit(limits, 2), strict=True):
            counts[rows] = part
        if self._controller is not None:
            self._write_decisions(self._controller)
        measured, errors = (result.pose[rows], result.q[rows]), self._flights.sensors
        if errors is not None:
            at, names = np.repeat(rows, result.pose.shape[1]), ("pose", "twist", "q", "qdot")
            states = [np.concatenate(getattr(result, name)[rows]) for name in names]
            normals = np.concatenate(self._reported(self._normals))
            pose, _, q, _ = errors[at].measure(normals, *states)
            measured = pose.reshape(measured[0].shape), q.reshape(measured[1].shape)
        result.measured_pose[rows], result.measured_q[rows] = measured

    def _write_decisions(self, controller: BatchController) -> None:
        result, rows = self._result, self._flown
        result.decision[rows] = self._read_rows("decision")[:, 0].astype(np.int64)
        result.decision_tick[rows] = self._read_rows("decided")[:, 0].astype(np.int64)
        result.momentum_drift[rows] = self._read_rows("drift")
        result.end_state[rows] = self._read_rows("end_state")
        result.end_tick[rows] = self._read_rows("ended")[:, 0].astype(np.int64)
        states = self._read_rows("decided_state")
        for lane in np.flatnonzero(result.decision[rows] != Decision.NONE).tolist():
            goal, state = self._profiles[lane].goal, ControlState.unstack(states[lane])
            distance = controller.controller.distance_between(state, goal)
            result.decision_distance[rows[lane]] = distance
