"""Flights on vector registers: blocks of groups, each lane of a group a flight.

A block's memory is one array (groups, rows, lanes); a row is a number of each flight of a group.
``driver.hpp`` loops over the ticks; what no lane can do, it hands back: a flight whose joint
touches a stop has that tick taken by the scalar plant, and goes on in its lane.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.batch.compiled_tick import CompiledTick
from spacerobot_ros.batch.controlling import (
    CONTROL_INPUTS,
    CONTROL_OUTPUTS,
    control_state,
)
from spacerobot_ros.batch.flights import (
    BatchResult,
    Controlled,
    Counts,
    Decision,
    Flights,
    FollowedSchedule,
    HeldCommands,
)
from spacerobot_ros.batch.native import Job, Span
from spacerobot_ros.batch.scalar import fly_one_by_one, plant_of
from spacerobot_ros.batch.sensor_noise import SensorNoise
from spacerobot_ros.control.executive import LOST_STATES
from spacerobot_ros.control.reference import ReferenceProfile
from spacerobot_ros.control.thrusters import ThrusterModulator
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.compilation import NoLibraryError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.model_functions import ModelFunctions
from spacerobot_ros.private_files import warn_once
from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.times import SECOND

_BLOCK_BYTES = 32 * 2**20
"""Memory of a block of flights, noise and commands among it."""

_MOST_GROUPS = 64
"""Groups of a block: more gain nothing."""

_CHUNK_TICKS = 2000
"""So many ticks are flown between two looks at signals, and noise is drawn for them."""

_HELD, _FOLLOWED, _CONTROLLED = 0, 1, 2

_COMMIT, _TICK, _FIRE = 1, 2, 3
"""What a group waits for: to commit a tick, to take one, or to fire thrusters."""

_PROGRAMS = {HeldCommands: _HELD, FollowedSchedule: _FOLLOWED, Controlled: _CONTROLLED}

Flags = npt.NDArray[np.bool_]


def fly_lanes(flights: Flights) -> BatchResult:
    """Fly many flights at once.

    Every flight is the one that the plant flies on its own with the same numbers, to rounding
    (1e-12 over the flights of the benchmark). Without a C++ compiler the plant flies them one by
    one; :attr:`BatchResult.engine` says so.
    """
    try:
        return _fly_in_lanes(flights)
    except NoLibraryError as reason:
        warn_once(f"Flights are flown one by one, not in lanes: {reason}.")
        return fly_one_by_one(flights)


def _fly_in_lanes(flights: Flights) -> BatchResult:
    """Fly on vector registers.

    Raises
    ------
    NoLibraryError
        The tick cannot be compiled for them here.
    """
    inertial = flights.inertial
    if inertial is None:
        inertial = flights.robot.inertial.scaled(np.ones((len(flights), 1)))
    model, p = flights.robot.symbolic_model(inertial)
    tick = CompiledTick.of(flights, model)
    fit = _regular_starts(flights)
    result = fly_one_by_one(flights, np.flatnonzero(~fit).tolist())
    failures = dict(result.failures)
    rows = np.flatnonzero(fit)
    size = _block_size(flights, tick)
    for first in range(0, len(rows), size):
        block = _Block(flights, tick, model, p, rows[first : first + size])
        block.fly(result, failures)
    lanes, unit = tick.driver.unit.lanes, tick.driver.unit.name
    return replace(result, engine=f"{lanes} lanes ({unit})", failures=failures)


def _regular_starts(flights: Flights) -> Flags:
    """Return which flights (N,) start where a plant can; the others have it say why not."""
    starts, robot = flights.starts, flights.robot
    fit = np.isfinite(starts.position).all(axis=1) & np.isfinite(starts.momenta).all(axis=1)
    fit &= np.isfinite(starts.qdot).all(axis=1)
    fit &= ((starts.q >= robot.lower) & (starts.q <= robot.upper)).all(axis=1)
    with np.errstate(invalid="ignore"):
        size = np.linalg.norm(starts.quaternion, axis=1)
        return np.asarray(fit & np.isfinite(size) & (size > 1e-3) & (size < 1e3))


def _block_size(flights: Flights, tick: CompiledTick) -> int:
    """Return how many flights fit into a block."""
    n, chunk = flights.robot.n, min(flights.ticks, _CHUNK_TICKS)
    each = 8 * (2 * sum(tick.sizes.values()) + 60 * len(flights.instants))
    if flights.sensors is not None:
        each += 8 * chunk * (12 + 2 * n) * 2
    match flights.program:
        case FollowedSchedule(positions=positions):
            tables = [positions]
        case HeldCommands(joints=joints, wrench=wrench):
            tables = [joints] if wrench is None else [joints, wrench]
        case Controlled():
            tables = []
    each += sum(2 * table[0].nbytes for table in tables if table.ndim == 3)
    lanes = tick.driver.unit.lanes
    groups = max(1, min(_MOST_GROUPS, _BLOCK_BYTES // (each * lanes)))
    return int(groups * lanes)


class _Rows:
    """Names for the rows of a group's memory."""

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self.slices: dict[str, slice] = {}
        end = 0
        for name, size in sizes.items():
            self.slices[name] = slice(end, end + size)
            end += size
        self.count = end

    def __getitem__(self, name: str) -> slice:
        return self.slices[name]

    def first(self, name: str, offset: int = 0) -> int:
        return self.slices[name].start + offset

    def span(self, from_: str, to: str) -> Span:
        at = self.slices[from_]
        return Span(at.start, self.slices[to].start, at.stop - at.start)


class _Block:
    """The memory of flights that are in lanes at the same time, and their flying.

    Lanes that are left over fly the last flight again; what they give is dropped.
    """

    def __init__(
        self, flights: Flights, tick: CompiledTick, model: ModelFunctions, p: Array, rows: Counts
    ) -> None:
        self._flights, self._tick, self._flown = flights, tick, rows
        self._lanes = tick.driver.unit.lanes
        self._groups = -(-len(rows) // self._lanes)
        wanted = self._groups * self._lanes
        self._rows_of_lanes = np.concatenate([rows, np.repeat(rows[-1:], wanted - len(rows))])
        n = flights.robot.n
        effort = flights.actuation == "effort"
        self._modulator = None
        if flights.thrusters is not None:
            self._modulator = ThrusterModulator(flights.thrusters, flights.control_period)
        thrusters = 0 if flights.thrusters is None else len(flights.thrusters.names)
        self._rows = rows_ = _Rows(
            {
                **{"measured": n, "normals": 0, "time": 0, "since": 0, "begun": 0},
                **{"exact": 0, "settled": 0, "wild": 0, "errors": 0},
                **tick.sizes,
                **{"alive": 1, "joint_bias": n, "joint_noise": 1, "reached": 1},
                **{"limits": n if effort else 2 * n, "peak_rate": n, "peak_effort": n},
                **{"peak_wrench": 2, "impulse": 2, "lowest": n, "highest": n},
                **{"wild_count": 2, "decision": 1, "decided": 1, "decided_errors": 3, "ended": 1},
                **{"first_momenta": 6, "drift": 2, "propellant": 1, "unallocated": 1},
                **{"wanted": 6, "owed": 6, "left": thrusters, "on": thrusters, "levels": thrusters},
            }
        )
        self._memory = _aligned((self._groups, rows_.count, self._lanes))
        self._memory[:, rows_.first("alive")] = 1.0
        self._set("p", p[self._rows_of_lanes])
        self._noise = SensorNoise(flights, self._rows_of_lanes)
        self._stopped: dict[int, EffortPlant] = {}
        """The scalar plants of flights that have touched a stop, by their lane in the block."""
        self._ended: dict[int, int] = {}
        """The ticks that flights could not take, by their lane in the block."""
        self._profiles: dict[int, ReferenceProfile] = {}
        """Those of the flights with a controller, by their lane in the block."""
        self._place(model, p)
        self._job, self._kept = self._prepared()

    def _set(self, name: str, values: Array) -> None:
        """Write rows (flights of the block, size) of a name."""
        part = values.reshape(self._groups, self._lanes, -1)
        self._memory[:, self._rows[name]] = np.swapaxes(part, 1, 2)

    def _get(self, name: str) -> Array:
        """Return rows (flights of the block, size) of a name."""
        part = np.swapaxes(self._memory[:, self._rows[name]], 1, 2)
        return part.reshape(len(self._rows_of_lanes), -1)

    def _place(self, model: ModelFunctions, p: Array) -> None:
        """Put the flights where they start."""
        starts, at = self._flights.starts, self._rows_of_lanes
        quaternion = starts.quaternion[at]
        quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        q, r = starts.q[at], starts.position[at]
        centers = model.function("center_of_mass", compile=False)(q.T, p[at].T).full().T
        of_base = r + _rotated(quaternion, centers)
        r_cm = np.where(starts.of_center[at][:, None], r, of_base)
        if self._flights.actuation == "velocity":
            state = np.concatenate([q, quaternion], axis=1)
            self._set("momenta", starts.momenta[at])
            self._set("r_cm", r_cm)
        else:
            state = np.concatenate(
                [q, quaternion, starts.qdot[at], starts.momenta[at], r_cm], axis=1
            )
        self._set("state", state)
        if self._flights.sensors is not None:
            self._set("joint_bias", self._flights.sensors.joint_bias[at])
            self._set("joint_noise", self._flights.sensors.noise[at, 4:5])
        if self._tick.controller is not None:
            self._set("gains", self._tick.controller.gains(at.tolist()))
            if self._flights.sensors is not None:
                errors = self._flights.sensors
                self._set("bias", np.hstack([errors.pose_bias[at], errors.joint_bias[at]]))
                self._set("sigma", errors.noise[at])

    def _prepared(self) -> tuple[Job, list[Any]]:
        """Return what the driver takes, and the memory that it points to."""
        flights, kind, rows = self._flights, self._tick.layout, self._rows
        n, effort = flights.robot.n, flights.actuation == "effort"
        kept: list[Any] = []

        def pointer(array: Any) -> int:
            kept.append(array)
            return int(array.ctypes.data) if isinstance(array, np.ndarray) else _address(array)

        def spans(each: Sequence[Span]) -> Any:
            return (Span * len(each))(*each)

        state, limited = rows.first("next_state"), rows.first("limited", 1)
        rates = rows.first("qdot") if not effort else state + n + 4
        copies = [rows.span(a, b) for a, b in kind.copies.items()]
        sums = [Span(limited, rows.first("limits"), n if effort else 2 * n)]
        peaks = [Span(rates, rows.first("peak_rate"), n)]
        if effort:
            peaks.append(Span(rows.first("realised"), rows.first("peak_effort"), n))
        reported = [Span(state, 0, n), Span(rates, n, n)]
        width = 2 * n
        for name, size in (("pose", 7), ("twist", 6), ("momentum", 7)):
            reported.append(Span(rows.first(name), width, size))
            width += size
        instants = np.array(flights.instants, dtype=np.int64)
        self._at = np.zeros(self._groups, np.int64)
        self._pending = np.zeros(self._groups, np.uint8)
        self._reports = _aligned((self._groups, len(instants), width, self._lanes))
        arguments = _numbers([rows.first(name) for name in (*kind.inputs, "p")])
        flight = _numbers([rows.first(name) for name in kind.flight])
        report = _numbers([rows.first(name) for name in kind.reported])
        table, program = self._table(), flights.program
        each_table = table.ndim == 4
        self._reached = _aligned((self._groups, width, self._lanes), np.nan)
        self._ends = _aligned((self._groups, width, self._lanes), np.nan)
        control_in, control_out = _numbers([]), _numbers([])
        if isinstance(program, Controlled):
            control_in = _numbers([rows.first(name) for name in CONTROL_INPUTS])
            control_out = _numbers([rows.first(name) for name in CONTROL_OUTPUTS])
        job = Job(
            memory=pointer(self._memory),
            groups=self._groups,
            rows=rows.count,
            at=pointer(self._at),
            pending=pointer(self._pending),
            arguments=pointer(arguments),
            flight_results=pointer(flight),
            report_results=pointer(report),
            argument_count=len(arguments),
            flight_result_count=len(flight),
            report_result_count=len(report),
            copies=pointer(spans(copies)),
            sums=pointer(spans(sums)),
            peaks=pointer(spans(peaks)),
            copy_count=len(copies),
            sum_count=len(sums),
            peak_count=len(peaks),
            stop_row=rows.first("limited", 1 + n) if effort else -1,
            alive_row=rows.first("alive"),
            wrench_row=self._commanded_wrench() if effort else -1,
            wrench_peak_row=rows.first("peak_wrench"),
            impulse_row=rows.first("impulse"),
            period=flights.control_period,
            period_ns=round(flights.control_period * SECOND),
            program=_PROGRAMS[type(program)],
            command_row=rows.first("command"),
            command_count=table.shape[2] if each_table else table.shape[1],
            table=pointer(table),
            table_ticks=table.shape[1] if each_table else table.shape[0],
            each_table=each_table,
            q_row=rows.first("state"),
            measured_row=rows.first("measured"),
            bias_row=rows.first("joint_bias"),
            noise_row=rows.first("joint_noise"),
            n=n,
            noisy=self._noise.commanded_by,
            gain=0.0,
            deadband=0.0,
            instants=pointer(instants),
            instant_count=len(instants),
            reports=pointer(self._reports),
            reported=pointer(spans(reported)),
            reported_count=len(reported),
            report_rows=width,
            control_arguments=pointer(control_in),
            control_results=pointer(control_out),
            control_argument_count=len(control_in),
            control_result_count=len(control_out),
            **{
                f"{name}_row": rows.first(name)
                for name in (
                    *("normals", "time", "since", "begun", "exact", "settled", "reached"),
                    *("lowest", "highest", "wild", "wild_count", "errors", "decision", "decided"),
                    *("decided_errors", "ended", "momentum", "first_momenta", "drift"),
                )
            },
            reached=pointer(self._reached),
            ended=pointer(self._ends),
            lost_states=LOST_STATES,
            last_tick=-1 if self._tick.controller is None else self._tick.controller.last_tick,
            ends=isinstance(program, Controlled) and program.until_decided,
            expected_row=rows.first("next_state", 2 * n + 4),
            **{
                f"{name}_row": rows.first(name)
                for name in ("wanted", "owed", "left", "on", "levels", "unallocated", "propellant")
            },
            **{f"thruster_{name}": pointer(x) for name, x in self._thruster_numbers().items()},
        )
        if isinstance(program, FollowedSchedule):
            job.gain = min(program.shape_gain, 1.0 / flights.control_period)
            job.deadband = program.deadband
        return job, kept

    def _commanded_wrench(self) -> int:
        """Return the row where the wrench begins that is commanded."""
        if self._modulator is not None:
            return self._rows.first("wanted")
        return self._rows.first("realised", self._flights.robot.n)

    def _thruster_numbers(self) -> dict[str, Array]:
        """Return what the driver knows of thrusters, by the ends of its names."""
        modulator = self._modulator
        if modulator is None:
            return {}
        matrix, weights = modulator.allocation.problem
        numbers = {"matrix": matrix.T, "wrenches": modulator.table.wrenches.T, "weights": weights}
        numbers |= {"shortest": modulator.table.min_on_time, "flow": modulator.table.mass_flow}
        return {name: np.ascontiguousarray(x, dtype=float) for name, x in numbers.items()}

    def _table(self) -> Array:
        """Return commands (ticks, width), or (groups, ticks, width, lanes) where they differ."""
        program = self._flights.program
        match program:
            case FollowedSchedule():
                table = self._of_lanes(program.positions)
            case HeldCommands():
                parts = [self._of_lanes(program.joints)]
                if self._flights.actuation == "effort":
                    wrench = program.wrench
                    parts.append(np.zeros((1, 6)) if wrench is None else self._of_lanes(wrench))
                ticks = max(part.shape[-2] for part in parts)
                each = max(part.ndim for part in parts)
                table = np.concatenate(
                    [_lengthened(part, ticks, each, len(self._rows_of_lanes)) for part in parts],
                    axis=-1,
                )
            case Controlled():
                table = np.zeros((1, self._tick.sizes["command"]))
        if table.ndim == 3:
            grouped = table.reshape(self._groups, self._lanes, *table.shape[1:])
            table = np.moveaxis(grouped, 1, 3)
        return np.ascontiguousarray(table)

    def _of_lanes(self, table: Array) -> Array:
        return table if table.ndim == 2 else np.asarray(table[self._rows_of_lanes])

    # -- flying -------------------------------------------------------------------------------

    def fly(self, result: BatchResult, failures: dict[int, str]) -> None:
        """Fly the flights and write what comes of them."""
        flights, job, driver = self._flights, self._job, self._tick.driver
        # A tick of no duration under no command reports the start.
        driver.start(job)
        self._set("h", np.full(len(self._rows_of_lanes), flights.control_period))
        alive = self._memory[:, self._rows.first("alive")]
        for begin in range(0, flights.ticks, _CHUNK_TICKS):
            if not alive.any():
                break
            end = min(begin + _CHUNK_TICKS, flights.ticks)
            # The state at the end is measured too.
            last = end + (end == flights.ticks)
            normals = self._noise.drawn(begin, last, alive)
            if normals is not None:
                job.normals = normals.ctypes.data
                job.normals_from, job.normals_ticks, job.normals_width = begin, *normals.shape[1:3]
            if not begin:
                self._begin_control(failures)
            while driver.fly_until(job, end):
                self._help(result, failures)
        self._write(result)

    def _end(self, index: int, tick: int, why: str, failures: dict[int, str]) -> None:
        """End the flight of a lane at a tick that it cannot take."""
        group, lane = divmod(index, self._lanes)
        self._memory[group, self._rows["alive"], lane] = 0.0
        if index < len(self._flown):
            failures[int(self._flown[index])] = why
            self._ended[index] = tick

    def _begin_control(self, failures: dict[int, str]) -> None:
        """Begin the references of all flights at what is measured first."""
        controller = self._tick.controller
        if controller is None:
            return
        self._tick.driver.measure_starts(self._job)
        states = self._get("measured")
        numbers = np.zeros((len(states), self._tick.sizes["profile"]))
        most = np.zeros((len(states), self._tick.sizes["bounds"]))
        for index, (row, state) in enumerate(zip(self._rows_of_lanes, states, strict=True)):
            try:
                profile, most[index] = controller.begin(int(row), control_state(state))
            except SpaceRobotError as error:
                self._end(index, 0, str(error), failures)
                continue
            self._profiles[index] = profile
            numbers[index] = controller.numbers(profile)
        self._set("profile", numbers)
        self._set("bounds", most)

    def _help(self, result: BatchResult, failures: dict[int, str]) -> None:
        """Do what lanes that wait cannot: give a command, allocate it to thrusters, or take a tick
        of the scalar plant.
        """
        rows, alive = self._rows, self._rows["alive"]
        kinds = {
            _COMMIT: (rows.first("limited", 1 + self._flights.robot.n), self._take),
            _TICK: (rows["exact"].start, self._command),
            _FIRE: (rows["unallocated"].start, self._allocate),
        }
        for group in np.flatnonzero(self._pending):
            waits, help_lane = kinds[int(self._pending[group])]
            lanes = (self._memory[group, waits] != 0.0) & (self._memory[group, alive][0] != 0.0)
            for lane in np.flatnonzero(lanes):
                index = int(group * self._lanes + lane)
                try:
                    help_lane(int(group), int(lane), index, result)
                except SpaceRobotError as error:
                    self._end(index, int(self._at[group]), str(error), failures)

    def _command(self, group: int, lane: int, index: int, result: BatchResult) -> None:
        controller, row = self._tick.controller, int(self._rows_of_lanes[index])
        assert controller is not None
        state = control_state(self._memory[group, self._rows["measured"], lane])
        tick = int(self._at[group])
        realised = controller.exact(row, self._profiles[index], tick, state).realised
        command = np.concatenate([realised.tau, realised.wrench_B])
        self._memory[group, self._rows["command"], lane] = command
        if index < len(self._flown):
            result.fallback_ticks[row] += 1

    def _allocate(self, group: int, lane: int, index: int, result: BatchResult) -> None:
        modulator, period = self._modulator, self._flights.control_period
        assert modulator is not None
        memory = {
            name: self._memory[group, self._rows[name], lane]
            for name in ("owed", "wanted", "left", "levels")
        }
        outstanding = memory["owed"] + period * memory["wanted"]
        most = modulator.table.min_on_time + period - memory["left"]
        memory["levels"][:] = modulator.allocation.allocate(outstanding, most).levels
        if index < len(self._flown):
            result.fallback_ticks[self._rows_of_lanes[index]] += 1

    def _take(self, group: int, lane: int, index: int, result: BatchResult) -> None:
        row, n = int(self._rows_of_lanes[index]), self._flights.robot.n
        if index not in self._stopped:
            plant = plant_of(self._flights, row)
            assert isinstance(plant, EffortPlant)
            self._stopped[index] = plant
        plant = self._stopped[index]
        memory = {name: self._memory[group, at, lane] for name, at in self._rows.slices.items()}
        plant.place(memory["state"])
        before = plant.stroke_limited.copy()
        plant.step(memory["command"][:n], memory["command"][n:])
        memory["next_state"][:] = plant.state
        memory["pose"][:], memory["twist"][:] = plant.pose, plant.twist
        memory["momentum"][:], memory["limited"][1 + n] = plant.momentum, 0.0
        if index < len(self._flown):
            result.limited["stroke"][row] += plant.stroke_limited - before
            result.fallback_ticks[row] += 1

    def _write(self, result: BatchResult) -> None:
        count, n, rows = len(self._flown), self._flights.robot.n, self._flown
        reports = np.moveaxis(self._reports, 3, 1).reshape(-1, *self._reports.shape[1:3])
        for index, tick in self._ended.items():
            if index < count:
                reports[index, np.array(self._flights.instants) > tick] = np.nan
        ends = np.cumsum([n, n, 7, 6, 7])
        names = ("q", "qdot", "pose", "twist", "momentum")
        for name, part in zip(names, np.split(reports[:count], ends[:-1], axis=2), strict=True):
            getattr(result, name)[rows] = part
        for name in ("peak_rate", "peak_effort", "peak_wrench", "impulse"):
            getattr(result, name)[rows] = self._get(name)[:count]
        limits = self._get("limits")[:count].astype(np.int64)
        first = "effort" if self._flights.actuation == "effort" else "rate"
        result.limited[first][rows] = limits[:, :n]
        if first == "rate":
            result.limited["stroke"][rows] = limits[:, n:]
        for name in ("lowest", "highest"):
            getattr(result, name)[rows] = self._get(name)[:count]
        if self._modulator is not None:
            result.propellant[rows] = self._get("propellant")[:count, 0]
        if self._tick.controller is not None:
            self._write_decisions(result, rows)
        pose, q = self._noise.measured(result.pose[rows], result.q[rows])
        result.measured_pose[rows], result.measured_q[rows] = pose, q

    def _write_decisions(self, result: BatchResult, rows: Counts) -> None:
        """Write what became of the goals of a controller."""
        count, n = len(rows), self._flights.robot.n

        def of_flights(name: str) -> Array:
            return self._get(name)[:count]

        time = of_flights("reached")[:, 0]
        result.reached_time[rows] = np.where(time >= 0.0, time, np.nan)
        result.reached_state[rows] = _by_flight(self._reached)[:count]
        decision = of_flights("decision")[:, 0].astype(np.int64)
        made = decision != Decision.NONE
        result.decision[rows] = decision
        result.decided_tick[rows] = of_flights("decided")[:, 0].astype(np.int64)
        errors = of_flights("decided_errors")
        result.decided_errors[rows] = np.where(made[:, np.newaxis], errors, np.nan)
        result.momentum_drift[rows] = of_flights("drift")
        # Flights that are not decided are where they are now.
        state = of_flights("next_state")
        parts = state[:, :n], state[:, n + 4 : 2 * n + 4], of_flights("pose")
        now = np.hstack([*parts, of_flights("twist"), of_flights("momentum")])
        ended = made & bool(self._job.ends)
        states = np.where(ended[:, np.newaxis], _by_flight(self._ends)[:count], now)
        result.end_state[rows] = states
        at = np.repeat(self._at, self._lanes)[:count]
        ticks = of_flights("ended")[:, 0].astype(np.int64)
        result.end_tick[rows] = np.where(ended, ticks, at)


def _rotated(quaternion: Array, vectors: Array) -> Array:
    """Return ``R v`` of quaternions (N, 4) and vectors (N, 3)."""
    x, w = quaternion[:, :3], quaternion[:, 3:]
    return np.asarray(vectors + 2 * np.cross(x, np.cross(x, vectors) + w * vectors))


def _by_flight(rows: Array) -> Array:
    """Return rows (groups, size, lanes) flight by flight."""
    return np.swapaxes(rows, 1, 2).reshape(-1, rows.shape[1])


def _lengthened(table: Array, ticks: int, dimensions: int, count: int) -> Array:
    """Return commands with zeros after their last, and a copy for each flight where wanted."""
    rest = np.zeros((*table.shape[:-2], ticks - table.shape[-2], table.shape[-1]))
    whole = np.concatenate([table, rest], axis=-2)
    return np.broadcast_to(whole, (count, *whole.shape)) if dimensions > whole.ndim else whole


def _aligned(shape: tuple[int, ...], value: float = 0.0) -> Array:
    """Return equal numbers that begin where a vector register can be loaded from."""
    count = int(np.prod(shape))
    memory = np.full(count + 8, value)
    offset = (-memory.ctypes.data % 64) // 8
    return memory[offset : offset + count].reshape(shape)


def _numbers(values: Sequence[int]) -> npt.NDArray[np.int64]:
    return np.array(values, dtype=np.int64)


def _address(array: Any) -> int:
    return ctypes.addressof(array)
