"""Draws flown in lanes: those that follow one schedule from start to end, and coordinated control.

The planner's executive makes the plan of each draw, as in every engine. Where it would do anything
but track that plan to its end and evaluate the goal (a correction, a joint that is limited or does
not follow), the draw is flown again by the engine ``flights``: the rows are the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.batch import Flights, FollowedSchedule, SensorErrors, Starts, fly_lanes
from spacerobot_ros.batch.flights import BatchResult
from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.controlled_lanes import (
    control_refusal,
    end_effector_error,
    fly_controlled,
    require_lane,
)
from spacerobot_ros.campaign.draws import Draw, drawn_flight
from spacerobot_ros.campaign.one_by_one import FlightsEngine, node_robot, robots_of
from spacerobot_ros.campaign.rows import LANES, Fallback, Row
from spacerobot_ros.campaign.targets import DrawnFlight
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.measures import Measures, Outcome, momentum_drift
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.parameters import values_of
from spacerobot_ros.planning import GaitSchedule, PoseError
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.status import PlannerStatus, remaining_error
from spacerobot_ros.simulation.plant import InitialState

_INSTANTS = 40
"""States of a flight that are looked at, beside its last one."""

_MOST_TICKS = 4_000_000
"""Ticks of one batch: its schedules are in memory."""

_MOST = 512
"""Flights of one batch."""

_MOST_CONTROLLED = 128
"""Likewise, with a controller."""

_LONGEST_BATCH = 4.0
"""Wall s after which a batch is flown with those that are planned: what ends the campaign loses no
more."""

_AT_END = 1e-6
"""A schedule has ended when every joint is this near its last position, m or rad."""


@dataclass(frozen=True)
class _Planned:
    """A draw with its schedule, and when that was made."""

    draw: Draw
    flight: DrawnFlight
    schedule: GaitSchedule
    gait: PlannerStatus
    plan_time: float

    @classmethod
    def of(
        cls,
        draw: Draw,
        flight: DrawnFlight,
        plan: tuple[GaitSchedule, PlannerStatus] | None,
        began: float,
    ) -> _Planned | None:
        """Return a draw whose planning ``began`` at a wall time, s; None without a plan."""
        return None if plan is None else cls(draw, flight, *plan, time.perf_counter() - began)


class LanesEngine:
    """Many flights at once, on vector registers."""

    name = LANES
    least = 64

    def __init__(self) -> None:
        self._flights = FlightsEngine()
        self._kept: tuple[str, tuple[GaitSchedule, PlannerStatus] | None] | None = None
        """The last plan from a state that was measured without noise, and what it follows from."""
        self._planner: tuple[PlannerConfig, str] | None = None
        """The planner's configuration of the last draw, mostly that of all, and its text."""

    def refusal(self, campaign: Campaign, *, asked: bool = False) -> str:
        """Return why not, as a clause."""
        why = self._flights.refusal(campaign)
        if why:
            return why
        scenario = campaign.scenario
        plant = scenario.plant
        if plant.faults or any(each.name.startswith("faults") for each in campaign.dispersions):
            return "it has faults"
        match scenario.commanders, plant.actuation:
            case ("planner",), "velocity":
                return _tracking_refusal(campaign)
            case ("coordinated_control",), "effort":
                return control_refusal(campaign, asked=asked)
        return "lanes have velocities of a planner, or efforts of coordinated control"

    def fly(
        self, campaign: Campaign, draws: Sequence[Draw], stopped: Callable[[], bool]
    ) -> Iterator[Row | Fallback]:
        """Fly draws in batches; leave those that need a planner or controller on the way."""
        plans = "planner" in campaign.scenario.commanders
        return (self._tracked if plans else self._controlled)(campaign, draws, stopped)

    def _controlled(
        self, campaign: Campaign, draws: Sequence[Draw], stopped: Callable[[], bool]
    ) -> Iterator[Row | Fallback]:
        """Fly draws of coordinated control."""
        common = DrawnFlight.of(campaign.scenario)
        for first in range(0, len(draws), _MOST_CONTROLLED):
            if stopped():
                return
            batch = []
            for draw in draws[first : first + _MOST_CONTROLLED]:
                try:
                    flight = drawn_flight(campaign, draw, common)
                except SpaceRobotError as error:
                    yield Row.failed(draw, error, self.name)
                    continue
                try:
                    require_lane(campaign, flight)
                except SpaceRobotError as error:  # It alone: the others of its batch are flown.
                    yield Fallback(draw, str(error))
                    continue
                batch.append((draw, flight))
            if not batch:
                continue
            try:
                flown = fly_controlled(campaign, batch)
            except SpaceRobotError as error:  # Of one of them: each is flown by itself.
                yield from (Fallback(draw, str(error)) for draw, _ in batch)
                continue
            for draw, measures in flown:
                if isinstance(measures, str):
                    yield Fallback(draw, measures)
                else:
                    yield Row.of(campaign, draw, measures, self.name)

    def _tracked(
        self, campaign: Campaign, draws: Sequence[Draw], stopped: Callable[[], bool]
    ) -> Iterator[Row | Fallback]:
        """Fly draws that follow the plans of a planner."""
        common, batch, ticks = DrawnFlight.of(campaign.scenario), list[_Planned](), 0
        began = time.perf_counter()
        for draw in draws:
            if stopped():
                return
            try:
                planned = self._planned(draw, drawn_flight(campaign, draw, common))
            except Exception as error:  # It is a row, with its reason.
                yield Row.failed(draw, error, self.name)
                continue
            if planned is None:
                yield Fallback(draw, "had no schedule at the first state")
                continue
            batch.append(planned)
            ticks += planned.schedule.ticks
            late = time.perf_counter() - began > _LONGEST_BATCH
            if late or len(batch) >= _MOST or ticks > _MOST_TICKS:
                yield from self._flown(campaign, batch)
                batch, ticks, began = [], 0, time.perf_counter()
        if batch:
            yield from self._flown(campaign, batch)

    def _planned(self, draw: Draw, flight: DrawnFlight) -> _Planned | None:
        """Have the executive plan a draw; None where it makes no plan for the first state."""
        began = time.perf_counter()
        if _has_noise(flight):
            # What is measured differs from draw to draw.
            return _Planned.of(draw, flight, _first_plan(flight), began)
        planner = flight.scenario.planner
        if self._planner is None or self._planner[0] is not planner:
            self._planner = planner, repr(values_of(planner))
        key = self._planner[1] + _key(flight)
        if self._kept is None or self._kept[0] != key:
            self._kept = key, _first_plan(flight)
        return _Planned.of(draw, flight, self._kept[1], began)

    def _flown(self, campaign: Campaign, batch: list[_Planned]) -> Iterator[Row | Fallback]:
        """Fly a batch in lanes."""
        began = time.perf_counter()
        flights, ends = _flights(batch)
        result = fly_lanes(flights)
        taken = (time.perf_counter() - began) / len(batch)
        for row, planned in enumerate(batch):
            measures = _measures(result, row, planned, flights, ends[row])
            if isinstance(measures, str):
                yield Fallback(planned.draw, measures)
            elif measures.duration > campaign.longest:
                yield Fallback(planned.draw, "took longer than the campaign allows")
            else:
                measures = replace(measures, wall_time=taken + planned.plan_time)
                yield Row.of(campaign, planned.draw, measures, self.name)


def _tracking_refusal(campaign: Campaign) -> str:
    """Return why lanes cannot follow the schedules of a campaign, as a clause; empty if so."""
    scenario = campaign.scenario
    plant = scenario.plant
    planner = scenario.planner
    if planner.averaging > 1 or planner.drift_position or planner.drift_attitude:
        return "the planner averages states, or watches the path"
    if planner.replanning or planner.output != "commands":
        return "the planner plans again on the way"
    dispersed = [each.name for each in campaign.dispersions]
    changing = (
        *("plant.tick_rate", "plant.integration_step", "planner.tick_rate"),
        *("planner.averaging", "planner.drift", "planner.replan", "planner.shape_"),
        *("planner.max_corrections", "planner.output", "plant.actuation"),
    )
    if any(name.startswith(changing) for name in dispersed):
        return "what lanes have in common is dispersed"
    sensors = plant.sensors
    joints = sensors.joint_noise or any(sensors.joint_bias)
    if joints or any(name.startswith("plant.sensors.joint") for name in dispersed):
        return "the joints are not measured as they are"
    return ""


def _has_noise(flight: DrawnFlight) -> bool:
    sensors = values_of(flight.scenario.plant.sensors)
    return any(np.any(value) for name, value in sensors.items() if name != "seed")


def _first_plan(flight: DrawnFlight) -> tuple[GaitSchedule, PlannerStatus] | None:
    """Have the executive plan for the first state; None where it makes no such plan."""
    period = flight.scenario.plant.control_period
    first = fly_scenario(flight.scenario, robots=robots_of(flight), longest=period)
    if len(first.schedules) != 1 or first.gait is None:
        return None
    ((begins_ns, schedule),) = first.schedules
    if begins_ns or schedule.partial or not schedule.ticks:
        return None
    return schedule, first.gait


def _key(flight: DrawnFlight) -> str:
    """Return what the plan of a flight without noise follows from beside its planner, as a text."""
    scenario = flight.scenario
    plant = replace(scenario.plant, sensors=replace(scenario.plant.sensors, seed=0))
    # The robot of the plant is only measured: at rest, whatever its masses are, unless it drifts.
    moving = any(plant.linear_momentum) or any(plant.angular_momentum)
    inertial = flight.inertial
    weight = None
    if inertial is not None and (moving or plant.initial_center_of_mass):
        weight = inertial.vector.tolist()
    goal = [*scenario.goal.position, *scenario.goal.quaternion]
    shape = scenario.goal.joint_positions
    wanted = goal, None if shape is None else shape.tolist(), weight
    return f"{plant} {wanted}"


def _flights(batch: list[_Planned]) -> tuple[Flights, list[int]]:
    """Return the batch of some draws, and which of its instants is the end of each."""
    scenario = batch[0].flight.scenario
    plant = scenario.plant
    robot = node_robot("plant", batch[0].flight)
    ticks = [each.schedule.ticks for each in batch]
    most = max(ticks)
    instants = np.unique([*np.linspace(0, most, _INSTANTS).astype(int), *ticks]).tolist()
    configs = [each.flight.scenario.plant for each in batch]
    nominal = InertialParameters.of(batch[0].flight.nominal)
    positions: Array = np.array([_padded(each.schedule.positions, most) for each in batch])
    first = batch[0].schedule
    if all(each.schedule is first for each in batch):
        positions = first.positions
    planner = scenario.planner
    flights = Flights(
        robot=robot,
        actuation="velocity",
        control_period=plant.control_period,
        ticks=most,
        starts=Starts.of(robot, [InitialState.of(config) for config in configs]),
        program=FollowedSchedule(positions, planner.shape_gain, planner.shape_deadband),
        inertial=InertialParameters.stacked([each.flight.inertial or nominal for each in batch]),
        sensors=SensorErrors.of(robot, [config.sensors for config in configs]),
        integration_step=plant.integration_step,
        instants=tuple(instants),
    )
    return flights, [instants.index(tick) for tick in ticks]


def _padded(positions: Array, ticks: int) -> Array:
    missing = ticks + 1 - len(positions)
    return np.vstack([positions, np.repeat(positions[-1:], missing, axis=0)])


def _measures(
    result: BatchResult, row: int, planned: _Planned, flights: Flights, end: int
) -> Measures | str:
    """Return the measures of a flight that is decided at the end of its schedule; else the reason
    why it is not.
    """
    if row in result.failures:
        return "was refused by the plant"
    if any(counts[row].any() for counts in result.limited.values()):
        return "had a joint at its limit"
    scenario, schedule = planned.flight.scenario, planned.schedule
    measured, q = result.measured_pose[row, end], result.measured_q[row, end]
    band = max(_AT_END, scenario.planner.shape_deadband)
    if np.abs(schedule.positions[-1] - q).max(initial=0.0) > band:
        return "had a joint that did not follow its schedule"
    error = PoseError.between(measured[:3], measured[3:], scenario.goal, q)
    left = remaining_error(error, schedule.controls)
    outcome, message = Outcome.REACHED, f"The goal is reached: {left}."
    if not scenario.planner.tolerance.admits(error, schedule.controls):
        if scenario.planner.max_corrections:
            return "needed corrections"
        outcome = Outcome.FAILED
        message = f"The goal is not reached: {left} after 0 correction(s)."
    pose = result.pose[row, end]
    duration = float(result.time[end] - result.time[0])
    return Measures(
        outcome=outcome,
        message=message,
        duration=duration,
        manoeuvre_time=duration,
        error=PoseError.between(pose[:3], pose[3:], scenario.goal),
        end_effector_error=end_effector_error(
            flights.robot, planned.flight, result.q[row, end], pose
        ),
        peak_rate=result.peak_rate[row],
        peak_effort=np.zeros(flights.robot.n),
        peak_wrench=np.zeros(2),
        # The shape is that of the schedule in every tick: its feedback had nothing to do.
        lowest=schedule.positions.min(axis=0),
        highest=schedule.positions.max(axis=0),
        momentum_drift=momentum_drift(result.momentum[row, : end + 1]),
        corrections=planned.gait.corrections,
        plan_time=planned.plan_time,
    )
