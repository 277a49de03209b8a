"""A flight that was flown: its arrays, to look at, to put into tables and bags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.events import Event
from spacerobot_ros.flight.arrays import Commands, FlightArrays, Outcome
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.simulation.actuators import FaultyPlant, thrusters_in
from spacerobot_ros.simulation.commands import CommandValidator, Refusal
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    import os

    import pandas as pd

    from spacerobot_ros.flight.scenario import Scenario


_FIRST_CAPACITY = 1024


@dataclass(frozen=True, eq=False, repr=False)
class Flight(FlightArrays):
    """A flight, from :func:`spacerobot_ros.fly` or from a bag."""

    def to_pandas(self) -> pd.DataFrame:
        """Return a table with a row a state, indexed by time (s).

        Raises
        ------
        SpaceRobotError
            pandas is not installed.
        """
        from spacerobot_ros.flight.views import table

        return table(self)

    def plot(self) -> Any:
        """Return a matplotlib figure: the base's pose and its goal, the joints, what drove them."""
        from spacerobot_ros.flight.views import figure

        return figure(self)

    def animate(self, *, seconds: float = 8.0, frames: int = 80) -> Any:
        """Return the robot in motion as an HTML animation for a notebook.

        ``seconds`` is how long it takes to watch, ``frames`` of how many pictures: at most 1000.

        Raises
        ------
        ParameterError
            One of them is none.
        """
        from spacerobot_ros.flight.views import animation

        return animation(self, seconds, frames)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write a bag that ``spacerobot verify`` and ``spacerobot report`` take.

        Raises
        ------
        RecordingError
            The file is there and is not to be replaced, or cannot be written.
        """
        from spacerobot_ros.flight.saved import save_flight

        save_flight(self, path, overwrite=overwrite)


class FlightLog:
    """Collects the data of a :class:`Flight`.

    Parameters
    ----------
    plant, reported, commands
        What is flown.
    period_ns
        Duration of a tick, ns.
    """

    def __init__(
        self,
        plant: FaultyPlant,
        reported: ReportedState,
        commands: CommandValidator,
        period_ns: int,
    ) -> None:
        self.events: list[Event] = []
        self.statuses: list[tuple[int, Status]] = []
        self.schedules: list[tuple[int, GaitSchedule]] = []
        self.refusals: list[tuple[float, str, Refusal]] = []
        self.refused_states: list[tuple[float, str]] = []
        self._period_ns = period_ns
        self._thrusters = thrusters_in(plant)
        self._propellant = np.zeros(1)
        true = {"true_pose": plant.pose, "true_twist": plant.twist}
        true |= {"true_q": plant.q, "true_qdot": plant.qdot}
        sources = {**reported.quantities, **true}
        if not reported.sensors.used:
            # The same arrays.
            sources = {name: x for name, x in sources.items() if not name.startswith("measured_")}
        if self._thrusters is not None:
            sources["propellant"] = self._propellant
        self._states = {name: _Rows(source.size) for name, source in sources.items()}
        self._sources = [(self._states[name], source) for name, source in sources.items()]
        self._commands = {
            source.topic: (_Rows(1), _Rows(len(source.limits))) for source in commands.sources
        }
        self._lost: list[int] = []
        self._sensors = reported.sensors

    def add_state(self, tick: int) -> None:
        """Take the state that is reported now."""
        if self._thrusters is not None:
            self._propellant[0] = self._thrusters.propellant
        for rows, source in self._sources:
            rows.add(source)
        if self._sensors.dropout:
            self._lost.append(tick)

    def add_command(self, topic: str, tick: int, values: Array) -> None:
        """Take a command that is sent."""
        if topic not in self._commands:
            self._commands[topic] = _Rows(1), _Rows(len(values))
        ticks, rows = self._commands[topic]
        ticks.add(tick)
        rows.add(values)

    def flight(
        self,
        scenario: Scenario,
        robot: RobotDescription,
        *,
        outcome: Outcome,
        sentence: str,
        status: Status | None,
        gait: PlannerStatus | None,
        plan_time: float,
        wall_time: float,
    ) -> Flight:
        """Return the flight."""
        states = {name: rows.array() for name, rows in self._states.items()}
        lost = np.zeros(len(states["pose"]), dtype=bool)
        lost[self._lost] = True
        states["pose_lost"] = lost[:, np.newaxis].astype(float)
        for name in ("pose", "twist", "q", "qdot"):
            states[name] = states.pop(f"true_{name}")
        count = len(states["pose"])
        return Flight(
            scenario=scenario,
            robot=robot,
            outcome=outcome,
            sentence=sentence,
            control_period=self._period_ns / SECOND,
            time=np.arange(count) * self._period_ns / SECOND,
            **{
                name: states.pop(name)
                for name in ("pose", "twist", "q", "qdot", "effort", "momentum")
            },
            quantities=states,
            commands={
                topic: Commands(ticks.array()[:, 0].astype(np.int64), rows.array())
                for topic, (ticks, rows) in self._commands.items()
            },
            statuses=tuple(self.statuses),
            schedules=tuple(self.schedules),
            events=tuple(self.events),
            status=status,
            gait=gait,
            plan_time=plan_time,
            wall_time=wall_time,
            refusals=tuple(self.refusals),
        )


class _Rows:
    """A table that grows by rows."""

    def __init__(self, size: int) -> None:
        self._table = np.empty((_FIRST_CAPACITY, size))
        self._count = 0

    def add(self, row: Array | float) -> None:
        if self._count == len(self._table):
            self._table = np.concatenate([self._table, np.empty_like(self._table)])
        self._table[self._count] = row
        self._count += 1

    def array(self) -> Array:
        return self._table[: self._count].copy()
