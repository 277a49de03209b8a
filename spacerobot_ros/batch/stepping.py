"""Flights that a caller advances tick by tick, each with its own start, time and end.

:class:`SteppedFlights` is the plant of many simultaneous flights: a policy, or any other source of
commands, reads the states and provides the next commands. A step is the plant's, in SIMD lanes or,
without them, in one plant per flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from spacerobot_ros.batch.flights import (
    BatchResult,
    Counts,
    Flights,
    HeldCommands,
    InitialStates,
    assign_rows,
)
from spacerobot_ros.batch.lanes import LaneBlock, starts_accepted_by_plant, symbolic_model_of
from spacerobot_ros.batch.native import CompiledTick
from spacerobot_ros.batch.scalar import plant_of, pose_of_link
from spacerobot_ros.batch.targets import Target, vector_unit
from spacerobot_ros.errors import CommandError, ParameterError, SpaceRobotError
from spacerobot_ros.files import warn_once
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import NoLibraryError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.simulation.actuators import PLANTS, build_plant
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.plant import Plant

LINK_POSE_SIZE = 12
"""Numbers of a link's pose: rotation by columns and position."""


class SteppedFlights:
    """N flights of one robot, advanced together by ticks under given commands.

    After :meth:`reset` and :meth:`step`, the attributes hold the states of the flights:

    ``pose``
        (N, 7) position ``r_WB`` (m) and quaternion ``R_WB`` (x, y, z, w) of the base.
    ``twist``
        (N, 6) ``v_WB_B`` (m/s) and ``omega_WB_B`` (rad/s).
    ``q``, ``qdot``
        (N, n) joint positions (m or rad) and velocities (per second).
    ``momentum``
        (N, 7) linear (kg m/s) and angular momentum about the centre of mass (kg m^2/s), both in
        W, and kinetic energy (J).
    ``link_R``, ``link_r``
        (N, 3, 3) and (N, 3): pose in B of the link ``link``; empty arrays without one.
    ``ticks``
        (N,) ticks since the last reset of each flight.
    ``has_not_ended``
        (N,) whether the flight is in progress: it has neither failed nor been ended.
    ``failures``
        The messages of flights that failed since their last reset, by row.

    A flight that has ended keeps the state of its last tick.

    Parameters
    ----------
    robot, actuation, control_period, starts, inertial, integration_step
        See :class:`.Flights`; all flights begin at the starts.
    link
        Link whose pose is computed; empty: none.
    in_lanes
        Whether the flights are in SIMD lanes; if not, or if lanes cannot be compiled, each flight
        has a plant. Both compute the same states up to rounding.
    plants
        Configurations of plants for each flight, with thrusters, faults or external loads, which
        lanes do not support; a reset builds a plant from the present configuration in the list.
        Empty: none.
    target
        What lanes run on; None: the widest registers of this processor.

    Raises
    ------
    ParameterError
        Some values do not match, there is no such link, or a start is invalid.
    RobotDescriptionError
        A mass or an inertia is not physical.
    """

    pose: Array
    twist: Array
    q: Array
    qdot: Array
    momentum: Array
    link_R: Array
    link_r: Array

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
                f"Robot '{robot.description.name}' has no link '{link}'; it has: "
                f"{', '.join(robot.link_names)}."
            )
        count = len(starts)
        if inertial is None:
            inertial = robot.inertial.scaled(np.ones((count, 1)))
        every = np.arange(count)  # Rows are replaced at resets: the arrays are copies.
        self._flights = Flights(
            *(robot, actuation, control_period, 1),
            starts[every],
            HeldCommands(np.zeros((1, robot.n))),
            inertial[every],
            integration_step=integration_step,
        )
        self.robot, self.control_period, self._link = robot, control_period, link
        self.command_size = robot.n + (6 if PLANTS[actuation].wrench else 0)
        """Numbers of a command: n joint velocities, or n efforts and a wrench (6) on the base."""
        self.ticks = np.zeros(count, dtype=np.int64)
        self.has_not_ended = np.ones(count, dtype=np.bool_)
        self.failures: dict[int, str] = {}
        self._require_regular(self._flights)
        scalar = plants or not in_lanes
        self._engine = (
            _PlantEngine(self._flights, link, plants) if scalar else self._choose_engine(target)
        )
        width = 2 * robot.n + 20 + (LINK_POSE_SIZE if link else 0)
        self._reports = np.zeros((count, width))
        self._attach_reports()
        self._begin(every)

    def __len__(self) -> int:
        return len(self.ticks)

    @property
    def engine(self) -> str:
        """Name of the engine: lanes with their registers, or ``scalar``."""
        return self._engine.name

    @property
    def substeps(self) -> int:
        """Runge-Kutta steps in a tick."""
        return self._flights.substeps

    @property
    def time(self) -> Array:
        """(N,) simulated time since the last reset of each flight, s."""
        return np.asarray(self.ticks * self.control_period)

    def reset(
        self, rows: npt.ArrayLike, starts: InitialStates, inertial: InertialParameters | None = None
    ) -> None:
        """Restart some flights; the others are unaffected.

        Parameters
        ----------
        rows
            (K,) numbers of the flights.
        starts
            Initial states, K rows.
        inertial
            Masses, centres and inertias, (K, ...); None: unchanged.

        Raises
        ------
        ParameterError
            The numbers of rows differ, or a start is invalid.
        RobotDescriptionError
            A mass or an inertia is not physical.
        """
        chosen = np.atleast_1d(np.asarray(rows, dtype=np.int64))
        if len(starts) != len(chosen) or (
            inertial is not None and len(inertial.masses) != len(chosen)
        ):
            raise ParameterError(
                f"{len(chosen)} flights are reset to {len(starts)} starts"
                + ("." if inertial is None else f" with {len(inertial.masses)} rows of masses.")
            )
        of_others = self._flights.initial_states, self._flights.inertial
        assert of_others[1] is not None
        # Checked as rows of their own: a refusal changes no flight.
        self.require_startable(starts, of_others[1][chosen] if inertial is None else inertial)
        assign_rows(of_others[0], chosen, starts)
        if inertial is not None:
            assign_rows(of_others[1], chosen, inertial)
        self._begin(chosen)

    def require_startable(self, starts: InitialStates, inertial: InertialParameters) -> None:
        """Refuse starts (K rows) and masses as :meth:`reset` does, without a reset.

        Raises
        ------
        ParameterError
            The plant refuses a start.
        RobotDescriptionError
            A mass or an inertia is not physical.
        """
        self._require_regular(replace(self._flights, initial_states=starts, inertial=inertial))

    def end(self, rows: npt.ArrayLike) -> None:
        """End some flights; they are not stepped until they are reset."""
        chosen = np.atleast_1d(np.asarray(rows, dtype=np.int64))
        self.has_not_ended[chosen] = False
        self._engine.end(chosen)

    def step(self, commands: Array, ticks: int = 1) -> None:
        """Advance all flights in progress by some ticks under held commands.

        Parameters
        ----------
        commands
            (N, command_size) joint velocities, or efforts and a wrench on the base: force (N) over
            torque (N m) at the origin of the base link, base components. Commands are clipped to
            the limits.
        ticks
            Number of ticks.

        Raises
        ------
        ParameterError
            The shape of the commands is wrong, or there are no ticks.
        CommandError
            A command of a flight in progress is not finite; no flight is stepped.
        """
        if np.shape(commands) != (len(self), self.command_size):
            raise ParameterError(
                f"The commands are {np.shape(commands)}, not ({len(self)}, {self.command_size})."
            )
        if ticks < 1:
            raise ParameterError(f"A step of {ticks} ticks is too short: use at least 1.")
        bad = np.flatnonzero(self.has_not_ended & ~np.isfinite(commands).all(axis=1))
        if bad.size:
            raise CommandError(f"The command of flight {bad[0]} is not finite.")
        before = self.has_not_ended.copy()
        failed: dict[int, str] = {}
        reports = self._engine.step(commands, ticks, failed)
        self.failures |= failed
        self.has_not_ended[list(failed)] = False
        self._reports[self.has_not_ended] = reports[self.has_not_ended]
        self.ticks[before & self.has_not_ended] += ticks

    def _begin(self, rows: Counts) -> None:
        self._reports[rows] = self._engine.start(rows)
        self.ticks[rows], self.has_not_ended[rows] = 0, True
        for row in rows.tolist():
            self.failures.pop(row, None)

    def _require_regular(self, flights: Flights) -> None:
        """Refuse starts that the plant would refuse, with its message."""
        for row in np.flatnonzero(~starts_accepted_by_plant(flights)).tolist():
            plant_of(flights, row)

    def _choose_engine(self, target: Target | None) -> _Engine:
        try:
            return _LaneEngine(self._flights, self._link, target or vector_unit())
        except NoLibraryError as reason:
            warn_once(f"Flights are flown one by one, not in lanes: {reason}.")
            return _PlantEngine(self._flights, self._link, ())

    def _attach_reports(self) -> None:
        """Let the attributes be parts of the reports."""
        n, count = self.robot.n, len(self)
        ends = np.cumsum([n, n, 7, 6, 7])
        names = ("q", "qdot", "pose", "twist", "momentum")
        *parts, rest = np.split(self._reports, ends, axis=1)
        for name, part in zip(names, parts, strict=True):
            setattr(self, name, part)
        rotation, self.link_r = rest[:, :9], rest[:, 9:]
        self.link_R = np.swapaxes(rotation.reshape((count, 3, -1)), 1, 2)


class _Engine(Protocol):
    """Steps flights; reports are rows of q, qdot, pose, twist, momentum and the link's pose."""

    name: str

    def start(self, rows: Counts) -> Array:
        """Begin flights at the starts of their rows, and return their reports."""

    def end(self, rows: Counts) -> None:
        """End flights."""

    def step(self, commands: Array, ticks: int, failures: dict[int, str]) -> Array:
        """Step the flights in progress; flights that fail are ended, with their messages."""


class _LaneEngine:
    """Flights in SIMD lanes, all in one block; NoLibraryError if no tick can be compiled here."""

    def __init__(self, flights: Flights, link: str, target: Target) -> None:
        self._flights, self._link, self._target = flights, link, target
        self._result = BatchResult.empty(flights)
        self._block = self._new_block()

    def _new_block(self) -> LaneBlock:
        flights = self._flights
        self._model, p = symbolic_model_of(flights)
        tick = CompiledTick.of(flights, self._model, self._target, self._link)
        self.name = self._target.engine
        block = LaneBlock(flights, tick, self._model, p, np.arange(len(flights)))
        block.begin_stepping()
        return block

    def start(self, rows: Counts) -> Array:
        flights = self._flights
        assert flights.inertial is not None
        model, p = flights.robot.symbolic_model(flights.inertial[rows])
        if model is not self._model:
            whole, all_p = symbolic_model_of(flights)
            if whole is not self._model:
                # The first masses with entries that are usually zero need another model.
                before, self._block = self._block, self._new_block()
                self._block.continue_from(before)
            p = all_p[rows]
        return self._block.restart(self._model, p, rows)

    def end(self, rows: Counts) -> None:
        self._block.end_lanes(rows)

    def step(self, commands: Array, ticks: int, failures: dict[int, str]) -> Array:
        return self._block.step(commands, ticks, self._result, failures)


class _PlantEngine:
    name = "scalar"

    def __init__(self, flights: Flights, link: str, configs: Sequence[PlantConfig]) -> None:
        self._flights, self._link, self._configs = flights, link, configs
        self._plants: dict[int, Plant] = {}
        self._alive = np.ones(len(flights), dtype=np.bool_)
        self._masses = [b""] * len(flights)

    def start(self, rows: Counts) -> Array:
        for row in rows.tolist():
            self._start_plant(row)
        self._alive[rows] = True
        return np.array([self._report(self._plants[row]) for row in rows.tolist()])

    def _start_plant(self, row: int) -> None:
        """Return the plant of a flight to a start; other masses need another plant."""
        flights = self._flights
        assert flights.inertial is not None
        if self._configs:
            start, robot = flights.initial_states.initial_state(row), flights.robot_of(row)
            self._plants[row] = build_plant(robot, self._configs[row], start)
            return
        masses = flights.inertial[row].vector.tobytes()
        if row in self._plants and self._masses[row] == masses:
            plant = self._plants[row]
            plant.initial = flights.initial_states.initial_state(row)
            plant.reset()
        else:
            self._plants[row], self._masses[row] = plant_of(flights, row), masses

    def end(self, rows: Counts) -> None:
        self._alive[rows] = False

    def step(self, commands: Array, ticks: int, failures: dict[int, str]) -> Array:
        reports, n = [], self._flights.robot.n
        for row, plant in sorted(self._plants.items()):
            parts = [commands[row, :n], commands[row, n:]][: 1 + (commands.shape[1] > n)]
            if self._alive[row]:
                try:
                    self._step_plant(plant.step, parts, ticks)
                except SpaceRobotError as error:
                    failures[row], self._alive[row] = str(error), False
            reports.append(self._report(plant))
        return np.array(reports)

    def _step_plant(self, step: Callable[..., bool], command: list[Array], ticks: int) -> None:
        for _ in range(ticks):
            step(*command)

    def _report(self, plant: Plant) -> Array:
        parts = [plant.q, plant.qdot, plant.pose, plant.twist, plant.momentum]
        if self._link:
            parts.append(pose_of_link(plant, self._link))
        return np.concatenate(parts)
