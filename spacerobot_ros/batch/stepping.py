"""Flights that the caller advances tick by tick, each with its own start, time and end.

:class:`SteppedFlights` is the plant for many simultaneous flights: a policy, or any other command
source, reads the states and provides the next commands. Steps are the same as in the plant,
computed in SIMD lanes or, if these are unavailable, in one plant per flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.batch.flights import (
    BatchResult,
    Counts,
    Flags,
    Flights,
    HeldCommands,
    InitialStates,
    assign_rows,
    plant_of,
    split_command,
    state_of,
    state_parts,
    state_size,
)
from spacerobot_ros.batch.lanes import LaneBlock, starts_accepted_by_plant, symbolic_model_of
from spacerobot_ros.batch.native import CompiledTick, Program
from spacerobot_ros.batch.targets import Target, vector_unit
from spacerobot_ros.errors import CommandError, ParameterError, SpaceRobotError, counted
from spacerobot_ros.files import warn_once
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import NoLibraryError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.plant import Plant


class SteppedFlights:
    """N flights of one robot, advanced together tick by tick under given commands.

    An ended flight keeps the state of its last tick. ``pose``, ``twist``, ``q``, ``qdot`` and
    ``momentum`` (N, ...) are as in :class:`.BatchResult`, at one instant. On a device, the arrays
    are those of the device.

    Parameters
    ----------
    robot, actuation, control_period, starts, inertial, integration_step
        See :class:`.Flights`; all flights begin at their start states.
    link
        Link whose position is computed; empty: none.
    in_lanes
        Whether the flights run in SIMD lanes; if not, or if lanes cannot be compiled, each flight
        has its own plant. Lanes and plants compute the same states up to rounding.
    plants
        Plant configuration for each flight, with thrusters, faults or external loads, which lanes
        do not support; a reset builds a plant from the current configuration in the list.
        Empty: none.
    target
        What lanes run on; None: the widest registers of this processor.

    Raises
    ------
    ParameterError
        Some values are inconsistent, there is no such link, or a start state is invalid.
    RobotDescriptionError
        A mass or an inertia is not physical.
    """

    pose: Array
    twist: Array
    q: Array
    qdot: Array
    momentum: Array
    link_r: Array
    """(N, 3) position of the link ``link`` in B, m; (N, 0) without one."""

    def __init__(
        self,
        robot: SpaceRobot,
        actuation: str,
        control_period: float,
        starts: InitialStates,
        inertial: InertialParameters | None = None,
        *,
        integration_step: float = 0.0,
        link: str = "",
        in_lanes: bool = True,
        plants: Sequence[PlantConfig] = (),
        target: Target | None = None,
    ) -> None:
        if link and link not in robot.link_names:
            raise ParameterError(
                f"Robot '{robot.description.name}' has no link '{link}'; its links are: "
                f"{', '.join(robot.link_names)}."
            )
        count = len(starts)
        if inertial is None:
            inertial = robot.inertial.scaled(np.ones((count, 1)))
        every = np.arange(count)  # Rows are replaced at resets: the arrays are copies.
        self._flights = Flights(
            *(robot, actuation, control_period, 1),
            starts[every],
            HeldCommands(np.zeros((1, robot.n + 6 * (actuation == "effort")))),
            inertial[every],
            integration_step=integration_step,
        )
        self.robot, self.control_period = robot, control_period
        self.command_size = self._flights.command_size
        """See :attr:`.Flights.command_size`."""
        self.require_startable(starts, None)
        engine: _SteppedLanes | _SteppedPlants | None = None
        if in_lanes and not plants:
            try:
                engine = _SteppedLanes(self._flights, link, target or vector_unit())
            except NoLibraryError as reason:
                if target is not None:
                    raise SpaceRobotError(f"'{target.name}' has no program: {reason}.") from reason
                warn_once(f"Flights are flown one by one, not in lanes: {reason}.")
        self._engine = engine or _SteppedPlants(self._flights, link, plants)
        self.arrays = self._engine.arrays
        """Array module: NumPy, or that of the device."""
        self.ticks = self.arrays.zeros(count, dtype=np.int64)
        """(N,) ticks since the last reset of each flight."""
        self.has_not_ended = self.arrays.ones(count, dtype=np.bool_)
        """(N,) whether the flight is in progress: it has neither failed nor been ended."""
        self.engine = self._engine.name
        """Engine name: lanes with their registers, or ``scalar``."""
        self.failures = self._engine.failures
        """The messages of flights that failed since their last reset, by row."""
        width = state_size(robot.n) + (3 if link else 0)
        self._reports = self.arrays.zeros((count, width), self._engine.dtype)
        vars(self).update(state_parts(self._reports, robot.n))
        self.link_r = self._reports[:, state_size(robot.n) :]
        self._begin(every)

    def __len__(self) -> int:
        return len(self.ticks)

    @property
    def time(self) -> Array:
        """(N,) simulated time since the last reset of each flight, s."""
        return self.ticks * self.control_period

    def reset(
        self, rows: npt.ArrayLike, starts: InitialStates, inertial: InertialParameters | None = None
    ) -> None:
        """Restart some flights; the others are unaffected.

        Parameters
        ----------
        rows
            (K,) flight indices.
        starts
            Initial states, K rows.
        inertial
            Masses, centres of mass and inertias, (K, ...); None: unchanged.

        Raises
        ------
        ParameterError
            The numbers of rows differ, or a start state is invalid.
        RobotDescriptionError
            A mass or an inertia is not physical.
        """
        chosen = np.atleast_1d(np.asarray(rows, dtype=np.int64))
        if len(starts) != len(chosen) or (
            inertial is not None and len(inertial.masses) != len(chosen)
        ):
            raise ParameterError(
                f"A reset of {counted(len(chosen), 'flight')} has "
                f"{counted(len(starts), 'start state')}"
                + ("." if inertial is None else f" and {len(inertial.masses)} rows of masses.")
            )
        # Checked as separate rows, so that a rejection changes no flight.
        self.require_startable(starts, inertial)
        assign_rows(self._flights.initial_states, chosen, starts)
        if inertial is not None:
            assert self._flights.inertial is not None
            assign_rows(self._flights.inertial, chosen, inertial)
        self._begin(chosen)

    def remember_starts(self) -> None:
        """Store the states and masses with which flights on a device began, for :meth:`restart`."""
        self._lanes.remember_starts()

    def restart(self, rows: Any, starts: Any) -> None:
        """Restart some flights on a device (K,), each as the remembered flight in ``starts`` (K,)
        began; both are arrays of flight indices on the device, and are not copied to the host."""
        self._write_reports(rows, self._lanes.restart(rows, starts))

    @property
    def _lanes(self) -> _SteppedLanes:
        assert isinstance(self._engine, _SteppedLanes), "there is no device"
        return self._engine

    def require_startable(self, starts: InitialStates, inertial: InertialParameters | None) -> None:
        """Validate start states (K rows) and masses as in :meth:`reset`, without resetting.

        Raises
        ------
        ParameterError
            The plant rejects a start state.
        RobotDescriptionError
            A mass or an inertia is not physical.
        """
        flights = replace(self._flights, initial_states=starts, inertial=inertial)
        for row in np.flatnonzero(~starts_accepted_by_plant(flights)).tolist():
            plant_of(flights, row)  # Raises an error with the reason.

    def end(self, rows: npt.ArrayLike) -> None:
        """End some flights; they are not stepped until they are reset."""
        self.has_not_ended[self.arrays.asarray(rows, dtype=np.int64)] = False

    def step(self, commands: Array, ticks: int = 1) -> None:
        """Advance all flights in progress by several ticks under held commands.

        Parameters
        ----------
        commands
            (N, command_size) joint velocities, or efforts and a base wrench: force (N), then torque
            (N m) at the base link origin, in the base frame. Commands are clipped to the limits.
        ticks
            Number of ticks.

        Raises
        ------
        ParameterError
            The command array has the wrong shape, or ``ticks`` is less than 1.
        CommandError
            A command for a flight in progress is not finite; no flight is stepped.
        """
        arrays = self.arrays
        commands = arrays.asarray(commands)
        if commands.shape != (len(self), self.command_size):
            raise ParameterError(
                f"The commands have shape {commands.shape}, not ({len(self)}, {self.command_size})."
            )
        if ticks < 1:
            raise ParameterError(f"A step of {ticks} ticks is too short: use at least 1.")
        bad = arrays.flatnonzero(self.has_not_ended & ~arrays.isfinite(commands).all(axis=1))
        if bad.size:
            raise CommandError(f"The command for flight {bad[0]} is not finite.")
        reports = self._engine.step(commands, ticks, self.has_not_ended)
        if self.failures:
            self.end(list(self.failures))
        arrays.copyto(self._reports, reports, where=self.has_not_ended[:, None])
        self.ticks += ticks * self.has_not_ended

    def _begin(self, rows: Counts) -> None:
        self._write_reports(self.arrays.asarray(rows), self._engine.start(rows))

    def _write_reports(self, rows: Any, reports: Any) -> None:
        self._reports[rows] = reports
        self.ticks[rows], self.has_not_ended[rows] = 0, True
        if self.failures:
            for row in rows.tolist():
                self.failures.pop(row, None)


class _SteppedLanes(LaneBlock):
    """All flights in one block; NoLibraryError if no tick can be compiled here."""

    def __init__(self, flights: Flights, link: str, target: Target) -> None:
        self.name, self._link = target.engine, link
        self.arrays, self.dtype = target.arrays, target.dtype
        result = BatchResult.empty(flights)
        self.failures = result.failures
        self._lay_out(flights, target, result)

    def _lay_out(self, flights: Flights, target: Target, result: BatchResult) -> None:
        model, p = symbolic_model_of(flights)
        tick = CompiledTick.of(flights, model, target, self._link)
        super().__init__(flights, tick, model, p, np.arange(len(flights)), result)
        self._job.program = Program.GIVEN
        self._memory[:, self._rows["h"]] = flights.control_period

    def start(self, rows: Counts) -> Array:
        """Begin flights at the initial states in their rows, and return their reports (rows,
        width)."""
        flights = self._flights
        assert flights.inertial is not None
        model, p = flights.robot.symbolic_model(flights.inertial[rows])
        if model is not self._model:
            whole, all_p = symbolic_model_of(flights)
            if whole is not self._model:
                # The first masses with usually zero entries that are nonzero need another model.
                names = ("state", "before", "momenta", "r_cm")
                kept = {each: self._read_rows(each) for each in names if each in self._rows}
                self._lay_out(flights, self._target, self._result)
                for name, values in kept.items():
                    self._write_rows(name, values)
            p = all_p[rows]
        self._write_starts(p, rows)
        return self._report_starts(self.arrays.asarray(rows))

    def remember_starts(self) -> None:
        names = ("p", "state", "momenta", "r_cm")
        parts = [self._rows[name] for name in names if name in self._rows]
        self._starts = [(part, self._memory[0, part].copy()) for part in parts]

    def restart(self, rows: Any, starts: Any) -> Any:
        for part, first in self._starts:
            self._memory[0, part][:, rows] = first[:, starts]
        return self._report_starts(rows)

    def _report_starts(self, rows: Any) -> Any:
        self._write_rows("command", 0.0, rows)
        if self._flights.actuation == "velocity":
            self._write_rows("before", 0.0, rows)
        # A zero-duration tick reports the start; it leaves groups without starts unchanged.
        self._write_rows("h", 0.0, rows)
        self._instants[0] = 0
        self._call("start_flights")
        self._write_rows("h", self._flights.control_period, rows)
        return self._reports_of_flights()[rows]

    def step(self, commands: Any, ticks: int, under_way: Any) -> Any:
        """Step the flights in progress under held commands, and return all reports."""
        self._write_rows("alive", under_way[:, np.newaxis])
        self._write_rows("command", commands)
        self._at[:], self._instants[0] = 0, ticks
        self._fly_until(ticks)
        return self._reports_of_flights()

    def _reports_of_flights(self) -> Any:
        each = self._reports[:, 0].swapaxes(1, 2)
        return each.reshape(-1, each.shape[2])[: len(self._flown)]


class _SteppedPlants:
    name, arrays, dtype = "scalar", np, np.float64

    def __init__(self, flights: Flights, link: str, configs: Sequence[PlantConfig]) -> None:
        self._flights, self._configs = flights, configs
        self._link = flights.robot.link_names.index(link) if link else -1
        self._plants: dict[int, Plant] = {}
        self._masses = [b""] * len(flights)
        self.failures: dict[int, str] = {}

    def start(self, rows: Counts) -> Array:
        flights, plants = self._flights, self._plants
        assert flights.inertial is not None
        for row in rows.tolist():
            start = flights.initial_states.initial_state(row)
            masses = flights.inertial[row].vector.tobytes()
            if self._configs:
                plants[row] = build_plant(flights.robot_of(row), self._configs[row], start)
            elif row in plants and self._masses[row] == masses:
                plants[row].initial = start
                plants[row].reset()
            else:
                plants[row], self._masses[row] = plant_of(flights, row), masses
        return np.array([self._report(plants[row]) for row in rows.tolist()])

    def step(self, commands: Array, ticks: int, under_way: Flags) -> Array:
        for row in np.flatnonzero(under_way).tolist():
            command = split_command(self._flights, commands[row])
            try:
                for _ in range(ticks):
                    self._plants[row].step(*command)
            except SpaceRobotError as error:
                self.failures[row] = str(error)
        return np.array([self._report(plant) for _, plant in sorted(self._plants.items())])

    def _report(self, plant: Plant) -> Array:
        of_link = plant.link_r.reshape((3, -1), order="F")[:, self._link]
        return np.concatenate([state_of(plant), of_link[: 3 * (self._link >= 0)]])
