"""The arrays of a flight, collected tick by tick."""

from __future__ import annotations

from typing import Any

import numpy as np

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.events import Event
from spacerobot_ros.flight.series import Commands, Signal
from spacerobot_ros.messages.statuses import StatusRecord
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.commands import CommandValidator, Refusal
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND


class FlightLog:
    """Collects the arrays of a :class:`~spacerobot_ros.flight.flight.Flight` tick by tick.

    Parameters
    ----------
    plant, reported, commands
        The plant, its reported quantities, and its commands.
    period_ns
        Duration of a tick, ns.
    """

    def __init__(
        self,
        plant: PlantWithFaults,
        reported: ReportedState,
        commands: CommandValidator,
        period_ns: int,
    ) -> None:
        self.events: list[Event] = []
        self.statuses: list[tuple[int, Status]] = []
        self.schedules: list[tuple[int, GaitSchedule]] = []
        self.paths: list[tuple[int, BasePath]] = []
        self.plant_statuses: list[tuple[int, PlantStatus]] = []
        self.diagnostics: list[tuple[int, tuple[StatusRecord, ...]]] = []
        self.covariances: list[tuple[int, Array]] = []
        self.refusals: list[tuple[float, str, Refusal]] = []
        self._period_ns = period_ns
        self._thrusters = plant.thrusters
        self._propellant = np.zeros(1)
        true = {"pose": plant.pose, "twist": plant.twist, "q": plant.q, "qdot": plant.qdot}
        # Without sensor errors, the measurements are the true arrays.
        unused = [f"true_{name}" for name in true]
        unused += [] if reported.sensors.used else [f"measured_{name}" for name in true]
        sources = {
            **{name: x for name, x in reported.quantities.items() if name not in unused},
            **true,
        }
        if self._thrusters is not None:
            sources["propellant"] = self._propellant
        self._sources, self._parts = sources, tuple(sources.values())
        self._states: list[Array] = []
        """All quantities of each state, in one row per state."""
        self._commands: dict[str, list[tuple[int, Array]]] = {
            source.topic: [] for source in commands.sources
        }
        self._sizes = {source.topic: len(source.limits) for source in commands.sources}
        self._setpoints: dict[str, list[Array]] = {}
        self._plant = plant
        self._faults_seen: object = None
        self._ticks_without_pose: list[int] = []
        self._ticks_without_target: list[int] = []
        self._reported = reported

    def add_state(self, tick: int) -> None:
        """Add the current state."""
        if self._thrusters is not None:
            self._propellant[0] = self._thrusters.propellant
        self._states.append(np.concatenate(self._parts))
        sensors = self._reported.sensors
        if sensors.used and self._plant.active is not self._faults_seen:
            self._faults_seen = self._plant.active
            both = np.concatenate([sensors.pose_covariance, sensors.twist_covariance])
            self.covariances.append((tick * self._period_ns, both))
        if sensors.dropout:
            self._ticks_without_pose.append(tick)
        if self._reported.misses_target:
            self._ticks_without_target.append(tick)

    def add_command(
        self, topic: str, tick: int, values: Array, setpoint: tuple[Array, Array] | None = None
    ) -> None:
        """Add a command; planner commands include the setpoint, joint positions and rates."""
        self._commands.setdefault(topic, []).append((tick, values.copy()))
        self._sizes.setdefault(topic, len(values))
        if setpoint is not None:
            self._setpoints.setdefault(topic, []).append(np.concatenate(setpoint))

    def data(self) -> dict[str, Any]:
        """Return the collected fields of the flight by name."""
        table = np.array(self._states)
        ends = np.cumsum([source.size for source in self._parts])
        columns = np.split(table, ends[:-1], axis=1)
        states = {name: each.copy() for name, each in zip(self._sources, columns, strict=True)}
        lost = {"pose_lost": self._ticks_without_pose}
        if self._ticks_without_target:
            lost["target_lost"] = self._ticks_without_target
        for name, ticks in lost.items():
            states[name] = np.zeros((len(table), 1))
            states[name][ticks] = 1.0
        time: Array = np.arange(len(table)) * self._period_ns / SECOND
        commands = {
            topic: Commands(
                np.array([tick for tick, _ in sent], np.int64),
                np.array([values for _, values in sent]).reshape(len(sent), self._sizes[topic]),
                np.array(self._setpoints[topic]) if topic in self._setpoints else None,
            )
            for topic, sent in self._commands.items()
        }
        return {
            "series": {name: Signal(time, values) for name, values in states.items()},
            "commands": commands,
            # The public lists are fields of the same names.
            **{name: tuple(each) for name, each in vars(self).items() if name[0] != "_"},
        }
