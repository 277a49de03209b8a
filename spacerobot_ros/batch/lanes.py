"""Blocks of flights: in the lanes of vector registers, or each in a thread of a device.

A block's memory is one array (groups, rows, lanes); a row is one number of each flight of a group.
Threads are all in one group. ``driver.hpp`` loops over the ticks and hands back commands that lanes
cannot compute.
"""

from __future__ import annotations

from dataclasses import astuple, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.batch.flights import (
    BatchResult,
    ControlledGoals,
    Counts,
    Flights,
    FollowedSchedule,
    HeldCommands,
    SensorErrors,
)
from spacerobot_ros.batch.native import CompiledTick, Job, Program
from spacerobot_ros.batch.scalar import fly_one_by_one
from spacerobot_ros.batch.targets import Target, vector_unit
from spacerobot_ros.control.goal_monitor import Decision, GoalMonitor
from spacerobot_ros.control.reference import ReferenceProfile
from spacerobot_ros.control.state import ControlState
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.files import warn_once
from spacerobot_ros.model.compilation import NoLibraryError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.model_functions import ModelFunctions
from spacerobot_ros.simulation.effort_plant import FAILURES
from spacerobot_ros.times import SECOND

_MAX_BLOCK_GROUPS = 64
"""Largest number of lane groups in a block; more bring no gain."""

_CHUNK_TICKS = 2000
"""Number of ticks, with their noise, between two checks for signals."""

_PROGRAMS = {
    HeldCommands: Program.HELD,
    FollowedSchedule: Program.FOLLOWED,
    ControlledGoals: Program.CONTROLLED,
}

Flags = npt.NDArray[np.bool_]


def fly_lanes(flights: Flights, target: Target | None = None) -> BatchResult:
    """Fly many flights at once, one in each SIMD lane, or each in a thread of a device.

    Every flight equals the plant's flight with the same numbers up to rounding (1e-12 over the
    flights of the benchmark). Without a C++ compiler, the plant flies the flights one by one;
    :attr:`BatchResult.engine` names the engine used.
    """
    try:
        return _fly_all_in_lanes(flights, target or vector_unit())
    except NoLibraryError as reason:
        warn_once(f"Flights are flown one by one, not in lanes: {reason}.")
        return fly_one_by_one(flights)


def _fly_all_in_lanes(flights: Flights, target: Target) -> BatchResult:
    """Fly on a target; NoLibraryError if the tick cannot be compiled for it here."""
    model, p = symbolic_model_of(flights)
    tick = CompiledTick.of(flights, model, target)
    fit = starts_accepted_by_plant(flights)
    # The scalar plant gives the message about each irregular start.
    result = fly_one_by_one(flights, np.flatnonzero(~fit).tolist())
    failures = dict(result.failures)
    rows = np.flatnonzero(fit)
    size = _block_size(flights, tick)
    for first in range(0, len(rows), size):
        block = LaneBlock(flights, tick, model, p, rows[first : first + size])
        block.fly(result, failures)
    return replace(result, engine=target.engine, failures=failures)


def symbolic_model_of(flights: Flights) -> tuple[ModelFunctions, Array]:
    """Return the model of the robot and its arguments ``p`` (N, ...): the masses of the flights."""
    inertial = flights.inertial
    if inertial is None:
        inertial = flights.robot.inertial.scaled(np.ones((len(flights), 1)))
    return flights.robot.symbolic_model(inertial)


def starts_accepted_by_plant(flights: Flights) -> Flags:
    """Return which flights (N,) start in a state that the plant accepts."""
    starts, robot = flights.initial_states, flights.robot
    fit = np.isfinite(starts.position).all(axis=1) & np.isfinite(starts.momenta).all(axis=1)
    fit &= np.isfinite(starts.qdot).all(axis=1)
    fit &= ((starts.q >= robot.lower) & (starts.q <= robot.upper)).all(axis=1)
    with np.errstate(invalid="ignore"):
        size = np.linalg.norm(starts.quaternion, axis=1)
        return np.asarray(fit & np.isfinite(size) & (size > 1e-3) & (size < 1e3))


def _block_size(flights: Flights, tick: CompiledTick) -> int:
    n, chunk = flights.robot.n, min(flights.ticks, _CHUNK_TICKS)
    each = 8 * (2 * tick.memory_layout.total_rows + 60 * len(flights.report_ticks))
    if flights.sensors is not None:
        each += 8 * chunk * (12 + 2 * n) * 2
    match flights.program:
        case FollowedSchedule(positions=positions):
            tables = [positions]
        case HeldCommands(joints=joints, wrench=wrench):
            tables = [joints] if wrench is None else [joints, wrench]
        case ControlledGoals():
            tables = []
    each += sum(2 * table[0].nbytes for table in tables if table.ndim == 3)
    fitting = tick.target.block_bytes // each
    if tick.target.threads:
        return max(1, int(fitting))
    lanes = tick.target.lanes
    return max(1, min(_MAX_BLOCK_GROUPS, int(fitting) // lanes)) * lanes


class LaneBlock:
    """Memory of the flights that occupy the lanes at the same time.

    Surplus lanes repeat the last flight; their results are dropped.
    """

    def __init__(
        self, flights: Flights, tick: CompiledTick, model: ModelFunctions, p: Array, rows: Counts
    ) -> None:
        self._flights, self._tick, self._flown = flights, tick, rows
        self._target, self._rows = tick.target, tick.memory_layout
        self._lanes = len(rows) if tick.target.threads else tick.target.lanes
        self._groups = -(-len(rows) // self._lanes)
        count = self._groups * self._lanes
        self._surplus = count - len(rows)
        self._rows_of_lanes = np.concatenate([rows, np.repeat(rows[-1:], self._surplus)])
        self._memory = self._target.zeros((self._groups, self._rows.total_rows, self._lanes))
        self._memory[:, self._rows["alive"]] = 1.0
        self._memory[:, self._rows["decided_state"]] = np.nan
        self._memory[:, self._rows["end_state"]] = np.nan
        self._noise = SensorNoise(flights, self._rows_of_lanes)
        self._ended: dict[int, int] = {}
        """Ticks at which flights failed, by lane in the block."""
        self._profiles: dict[int, ReferenceProfile] = {}
        """Reference profiles of flights with a controller, by lane in the block."""
        self._write_starts(model, p[self._rows_of_lanes])
        self._write_errors_and_gains()
        self._loops = count if self._target.threads else self._groups
        """Number of flights or groups whose ticks are counted, each for itself."""
        arrays = self._target.arrays
        self._at = arrays.zeros(self._loops, np.int64)
        self._pending = arrays.zeros(self._loops, np.uint8)
        self._reports = self._target.zeros(
            (self._groups, len(flights.report_ticks), tick.report_width, self._lanes)
        )
        self._job, self._referenced = self._prepare_job()

    def _write_rows(self, name: str, values: Any, lanes: Counts | None = None) -> None:
        """Write rows of a name: (flights of the block, size), or those of some lanes alone."""
        arrays = self._target.arrays
        values = arrays.asarray(values)
        if lanes is None:
            part = values.reshape(self._groups, self._lanes, -1)
            self._memory[:, self._rows[name]] = arrays.swapaxes(part, 1, 2)
            return
        group, lane = np.divmod(lanes[:, np.newaxis], self._lanes)
        rows = np.arange(self._rows.total_rows)[self._rows[name]]
        at = (arrays.asarray(each) for each in (group, rows, lane))
        self._memory[tuple(at)] = values

    def _read_rows(self, name: str) -> Array:
        """Return rows (flights of the block, size) of a name."""
        part = np.swapaxes(self._target.to_numpy(self._memory[:, self._rows[name]]), 1, 2)
        return part.reshape(len(self._rows_of_lanes), -1)

    def _write_starts(self, model: ModelFunctions, p: Array, lanes: Counts | None = None) -> None:
        """Write masses ``p`` and initial states of the flights in all lanes, or in some."""
        starts, at = self._flights.initial_states, self._rows_of_lanes
        if lanes is not None:
            at = at[lanes]
        self._write_rows("p", p, lanes)
        quaternion = starts.quaternion[at]
        quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        q, r = starts.q[at], starts.position[at]
        centers = model.function("center_of_mass", compile=False)(q.T, p.T).full().T
        of_base = r + _rotate_vectors(quaternion, centers)
        r_cm = np.where(starts.position_is_of_center_of_mass[at][:, None], r, of_base)
        if self._flights.actuation == "velocity":
            state = np.concatenate([q, quaternion], axis=1)
            self._write_rows("momenta", starts.momenta[at], lanes)
            self._write_rows("r_cm", r_cm, lanes)
        else:
            state = np.concatenate(
                [q, quaternion, starts.qdot[at], starts.momenta[at], r_cm], axis=1
            )
        self._write_rows("state", state, lanes)

    def _write_errors_and_gains(self) -> None:
        at = self._rows_of_lanes
        if self._flights.sensors is not None:
            self._write_rows("joint_bias", self._flights.sensors.joint_bias[at])
            self._write_rows("joint_noise", self._flights.sensors.noise[at, 4:5])
        if self._tick.controller is not None:
            initial = astuple(GoalMonitor())[1:]
            self._write_rows("monitor", np.tile(initial, (len(at), 1)))
            self._memory[:, self._rows["decided"]] = -1.0
            self._write_rows("gains", self._tick.controller.gains_argument(at.tolist()))
            if self._flights.sensors is not None:
                errors = self._flights.sensors
                self._write_rows("bias", np.hstack([errors.pose_bias[at], errors.joint_bias[at]]))
                self._write_rows("sigma", errors.noise[at])

    def _prepare_job(self) -> tuple[Job, list[Any]]:
        """Return the driver's job, and the arrays that it points to."""
        flights, program = self._flights, self._flights.program
        table = self._target.arrays.asarray(self._command_table())
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
        job = Job(
            groups=self._loops,
            period=flights.control_period,
            period_ns=round(flights.control_period * SECOND),
            program=_PROGRAMS[type(program)],
            table_ticks=table.shape[1] if each_table else table.shape[0],
            each_table=each_table,
            noisy=self._noise.is_fed_back,
            instant_count=len(flights.report_ticks),
            ends=isinstance(program, ControlledGoals) and program.ends_when_decided,
            **{name: self._target.address(array) for name, array in arrays.items()},
        )
        if isinstance(program, FollowedSchedule):
            job.gain = min(program.shape_gain, 1.0 / flights.control_period)
            job.deadband = program.deadband
        return job, list(arrays.values())

    def _command_table(self) -> Array:
        """Return commands (ticks, width), or (groups, ticks, width, lanes) where they differ."""
        program = self._flights.program
        match program:
            case FollowedSchedule():
                table = self._one_table_per_lane(program.positions)
            case HeldCommands():
                parts = [self._one_table_per_lane(program.joints)]
                if self._flights.actuation == "effort":
                    wrench = program.wrench
                    parts.append(
                        np.zeros((1, 6)) if wrench is None else self._one_table_per_lane(wrench)
                    )
                ticks = max(part.shape[-2] for part in parts)
                each = max(part.ndim for part in parts)
                table = np.concatenate(
                    [_pad_table(part, ticks, each, len(self._rows_of_lanes)) for part in parts],
                    axis=-1,
                )
            case ControlledGoals():
                table = np.zeros((1, self._rows.row_count("command")))
        if table.ndim == 3:
            grouped = table.reshape(self._groups, self._lanes, *table.shape[1:])
            table = np.moveaxis(grouped, 1, 3)
        return np.ascontiguousarray(table)

    def _one_table_per_lane(self, table: Array) -> Array:
        return table if table.ndim == 2 else np.asarray(table[self._rows_of_lanes])

    # -- flying -------------------------------------------------------------------------------

    def fly(self, result: BatchResult, failures: dict[int, str]) -> None:
        """Fly the flights and write their results."""
        flights, job, library = self._flights, self._job, self._tick.library
        # A tick of no duration under no command reports the start.
        library.start_flights(job)
        self._write_rows("h", np.full(len(self._rows_of_lanes), flights.control_period))
        for begin in range(0, flights.ticks, _CHUNK_TICKS):
            alive = self._target.to_numpy(self._memory[:, self._rows.first_row("alive")])
            if not alive.any():
                break
            end = min(begin + _CHUNK_TICKS, flights.ticks)
            # The sensors measure the state at the end, too.
            last = end + (end == flights.ticks)
            normals = self._noise.draw_noise(begin, last, alive)
            if normals is not None:
                on_target = self._target.arrays.asarray(normals)
                job.normals = self._target.address(on_target)
                job.normals_from, job.normals_ticks, job.normals_width = begin, *normals.shape[1:3]
            if not begin:
                self._begin_control(failures)
            self._fly_until(end, result, failures)
        if self._tick.controller is not None:
            library.end_flights(job)
        self._write_results(result)

    # -- stepping -----------------------------------------------------------------------------

    def begin_stepping(self) -> None:
        """Prepare for :meth:`restart` and :meth:`step`: surplus lanes are idle."""
        self._job.program = Program.GIVEN
        count = len(self._flown)
        self.end_lanes(np.arange(count, count + self._surplus))
        self._write_rows("h", np.full(len(self._rows_of_lanes), self._flights.control_period))

    def continue_from(self, other: LaneBlock) -> None:
        """Take over the states of a block of the same flights whose model has other masses."""
        for name in ("state", "before", "momenta", "r_cm", "alive"):
            if name in self._rows.slices:
                self._write_rows(name, other._read_rows(name))

    def restart(self, model: ModelFunctions, p: Array, lanes: Counts) -> Array:
        """Restart the flights of some lanes, and return their reports (lanes, width).

        ``p`` are the masses as arguments of the model.
        """
        self._write_starts(model, p, lanes)
        width = self._rows.row_count("command")
        self._write_rows("command", np.zeros((len(lanes), width)), lanes)
        if self._flights.actuation == "velocity":
            self._write_rows("before", np.zeros((len(lanes), self._flights.robot.n)), lanes)
        # A tick of no duration reports the start; groups that have none are left alone.
        self._write_rows("h", np.zeros((len(lanes), 1)), lanes)
        self._write_rows("alive", np.ones((len(lanes), 1)), lanes)
        self._instants[0] = 0
        self._tick.library.start_flights(self._job)
        self._write_rows("h", np.full((len(lanes), 1), self._flights.control_period), lanes)
        at = self._target.arrays.asarray(lanes)
        reports = self._reports[at // self._lanes, 0, :, at % self._lanes]
        return self._target.to_numpy(reports)

    def end_lanes(self, lanes: Counts) -> None:
        """End the flights of some lanes; a group with only idle lanes is skipped."""
        self._write_rows("alive", np.zeros((len(lanes), 1)), lanes)

    def step(
        self, commands: Array, ticks: int, result: BatchResult, failures: dict[int, str]
    ) -> Array:
        """Fly some ticks under given commands, and return the reports (flights, width).

        ``commands`` (flights, width) are held. Flights that fail end with a message in
        ``failures``.
        """
        count = len(self._flown)
        if self._surplus:
            commands = np.concatenate([commands, np.repeat(commands[-1:], self._surplus, axis=0)])
        self._write_rows("command", commands)
        self._at[:], self._instants[0] = 0, ticks
        self._fly_until(ticks, result, failures)
        reports = np.moveaxis(self._target.to_numpy(self._reports[:, 0]), 2, 1)
        return reports.reshape(-1, self._reports.shape[2])[:count]

    def _fly_until(self, tick: int, result: BatchResult, failures: dict[int, str]) -> None:
        self._tick.library.fly_until(self._job, tick)
        while self._pending.any():
            self._command_outside_lanes(result, failures)
            self._tick.library.fly_until(self._job, tick)
        self._note_failures(failures)

    def _end_flight(self, index: int, tick: int, message: str, failures: dict[int, str]) -> None:
        self.end_lanes(np.array([index]))
        if index < len(self._flown):
            failures[int(self._flown[index])] = message
            self._ended[index] = tick

    def _begin_control(self, failures: dict[int, str]) -> None:
        controller = self._tick.controller
        if controller is None:
            return
        self._tick.library.measure_starts(self._job)
        states = self._read_rows("measured")
        numbers = np.zeros((len(states), self._rows.row_count("profile")))
        most = np.zeros((len(states), self._rows.row_count("bounds")))
        for index, (row, state) in enumerate(zip(self._rows_of_lanes, states, strict=True)):
            try:
                profile, most[index] = controller.begin_flight(
                    int(row), ControlState.unstack(state)
                )
            except SpaceRobotError as error:
                self._end_flight(index, 0, str(error), failures)
                continue
            self._profiles[index] = profile
            numbers[index] = controller.profile_argument(profile)
        self._write_rows("profile", numbers)
        self._write_rows("bounds", most)

    def _note_failures(self, failures: dict[int, str]) -> None:
        """Give the flights that the driver has ended their messages."""
        if not self._memory[:, self._rows["failure"]].any():
            return
        reasons, ticks = self._read_rows("failure")[:, 0], self._read_rows("failed_at")[:, 0]
        for index in np.flatnonzero(reasons).tolist():
            self._end_flight(index, int(ticks[index]), FAILURES[int(reasons[index]) - 1], failures)
        self._memory[:, self._rows["failure"]] = 0.0

    def _command_outside_lanes(self, result: BatchResult, failures: dict[int, str]) -> None:
        """Compute the commands that lanes wait for."""
        to_numpy, each = self._target.to_numpy, len(self._rows_of_lanes) // self._loops
        waiting = np.repeat(to_numpy(self._pending) != 0, each)
        waiting &= (self._read_rows("exact") * self._read_rows("alive"))[:, 0] != 0.0
        ticks, states = np.repeat(to_numpy(self._at), each), self._read_rows("measured")
        for index in np.flatnonzero(waiting).tolist():
            try:
                command = self._exact_command(index, int(ticks[index]), states[index])
            except SpaceRobotError as error:
                self._end_flight(index, int(ticks[index]), str(error), failures)
                continue
            self._write_rows("command", command, np.array([index]))
            if index < len(self._flown):
                result.fallback_ticks[self._flown[index]] += 1

    def _exact_command(self, index: int, tick: int, measured: Array) -> Array:
        controller, row = self._tick.controller, int(self._rows_of_lanes[index])
        assert controller is not None
        state = ControlState.unstack(measured)
        realised = controller.exact_command(row, self._profiles[index], tick, state).realised
        return np.concatenate([realised.tau, realised.wrench_B])

    def _write_results(self, result: BatchResult) -> None:
        count, n, rows = len(self._flown), self._flights.robot.n, self._flown
        reports = np.moveaxis(self._target.to_numpy(self._reports), 3, 1)
        reports = reports.reshape(-1, *self._reports.shape[1:3])
        for index, tick in self._ended.items():
            if index < count:
                reports[index, np.array(self._flights.report_ticks) > tick] = np.nan
        ends = np.cumsum([n, n, 7, 6, 7])
        names = ("q", "qdot", "pose", "twist", "momentum")
        for name, part in zip(names, np.split(reports[:count], ends[:-1], axis=2), strict=True):
            getattr(result, name)[rows] = part
        for name in ("peak_rate", "peak_effort", "peak_wrench", "impulse", "lowest", "highest"):
            getattr(result, name)[rows] = self._read_rows(name)[:count]
        limits = self._read_rows("limits")[:count].astype(np.int64)
        first = "effort" if self._flights.actuation == "effort" else "rate"
        result.limited_ticks[first][rows] = limits[:, :n]
        result.limited_ticks["stroke"][rows] = limits[:, n:]
        if self._tick.controller is not None:
            self._write_decisions(result, rows)
        self._noise.measure(result, rows)

    def _write_decisions(self, result: BatchResult, rows: Counts) -> None:
        controller, count = self._tick.controller, len(rows)
        assert controller is not None
        result.decision[rows] = self._read_rows("decision")[:count, 0].astype(np.int64)
        result.decision_tick[rows] = self._read_rows("decided")[:count, 0].astype(np.int64)
        result.momentum_drift[rows] = self._read_rows("drift")[:count]
        result.end_state[rows] = self._read_rows("end_state")[:count]
        result.end_tick[rows] = self._read_rows("ended")[:count, 0].astype(np.int64)
        states = self._read_rows("decided_state")
        for index in np.flatnonzero(result.decision[rows] != Decision.NONE).tolist():
            goal, state = self._profiles[index].goal, ControlState.unstack(states[index])
            distance = controller.distance(state, goal)
            result.decision_distance[rows[index]] = astuple(distance)


def _rotate_vectors(quaternion: Array, vectors: Array) -> Array:
    """Return ``R v`` of quaternions (N, 4) and vectors (N, 3)."""
    x, w = quaternion[:, :3], quaternion[:, 3:]
    return np.asarray(vectors + 2 * np.cross(x, np.cross(x, vectors) + w * vectors))


def _pad_table(table: Array, ticks: int, dimensions: int, count: int) -> Array:
    """Return commands with zeros after their last, and a copy for each flight where wanted."""
    rest = np.zeros((*table.shape[:-2], ticks - table.shape[-2], table.shape[-1]))
    whole = np.concatenate([table, rest], axis=-2)
    return np.broadcast_to(whole, (count, *whole.shape)) if dimensions > whole.ndim else whole


class SensorNoise:
    """The sensors' random numbers for the flights of a block, drawn as by :class:`.Sensors`."""

    def __init__(self, flights: Flights, rows: Counts) -> None:
        self._errors: SensorErrors | None = flights.sensors
        self._affects_all = isinstance(flights.program, ControlledGoals)
        self._instants = flights.report_ticks
        self._n = flights.robot.n
        self._rows = rows
        if self._errors is None:
            return
        self._used = self._errors.is_active[rows] & self._errors.noise[rows].any(axis=1)
        self._generators = [
            np.random.default_rng(int(seed)) if used else None
            for seed, used in zip(self._errors.seeds[rows], self._used, strict=True)
        ]
        self._at_instants = np.zeros((len(rows), len(self._instants), 12 + 2 * self._n))

    @property
    def is_fed_back(self) -> bool:
        """Whether commands depend on sensor errors; along schedules, on joint errors only."""
        errors = self._errors
        if errors is None:
            return False
        joints = errors.noise[self._rows, 4].any() or errors.joint_bias[self._rows].any()
        return bool(self._affects_all or joints)

    def draw_noise(self, begin: int, end: int, alive: Array) -> Array | None:
        """Draw the noise of the ticks from ``begin`` up to but excluding ``end``.

        ``alive`` (groups, lanes): whether flights are in progress. Returns the noise that the
        commands depend on: of joint positions, (groups, ticks, n, lanes), or, with a controller,
        all noise; None if commands do not depend on noise.
        """
        if self._errors is None:
            return None
        ticks, width = end - begin, 12 + 2 * self._n
        columns = slice(0, width) if self._affects_all else slice(12, 12 + self._n)
        kept = None
        if self.is_fed_back:
            kept = np.zeros((len(self._rows), ticks, columns.stop - columns.start))
        chosen = [(i, tick - begin) for i, tick in enumerate(self._instants) if begin <= tick < end]
        drawn = np.empty((ticks, width))
        for index, generator in enumerate(self._generators):
            if generator is None or not alive.flat[index]:
                continue
            generator.standard_normal(out=drawn)
            if kept is not None:
                kept[index] = drawn[:, columns]
            for instant, tick in chosen:
                self._at_instants[index, instant] = drawn[tick]
        if kept is None:
            return None
        grouped = kept.reshape(-1, alive.shape[1], *kept.shape[1:])
        return np.ascontiguousarray(np.moveaxis(grouped, 1, 3))

    def measure(self, result: BatchResult, rows: Counts) -> None:
        """Write the measurements of the reported states of some flights."""
        measured = result.pose[rows], result.q[rows]
        if self._errors is not None:
            at = np.repeat(self._rows[: len(rows)], len(self._instants))
            names = ("pose", "twist", "q", "qdot")
            states = [np.concatenate(getattr(result, name)[rows]) for name in names]
            normals = np.concatenate(self._at_instants[: len(rows)])
            pose, _, q, _ = self._errors[at].measure(normals, *states)
            measured = pose.reshape(measured[0].shape), q.reshape(measured[1].shape)
        result.measured_pose[rows], result.measured_q[rows] = measured
