"""Flies campaign draws in SIMD lanes or on a device.

A lane, or a thread of a device, can follow one schedule to its end and evaluate the goal, or fly
under coordinated control until the outcome is known. A draw that requires more (a correction, a
joint at a limit, a loss of control) is passed on to engine ``flights``; the resulting rows of the
dataset are the same.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from spacerobot_ros.batch import (
    ControlledGoals,
    Decision,
    Flights,
    FollowedSchedule,
    InitialStates,
    SensorErrors,
    fly_lanes,
)
from spacerobot_ros.batch.flights import BatchResult
from spacerobot_ros.batch.targets import device_named, vector_unit
from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.dataset import Row
from spacerobot_ros.campaign.draws import Draw, drawn_flights
from spacerobot_ros.campaign.one_by_one import (
    FirstPlans,
    FlightsEngine,
    nominal_robots,
    plant_robot,
)
from spacerobot_ros.campaign.targets import DrawnFlight
from spacerobot_ros.control.controller import build_controller, controlled_outputs
from spacerobot_ros.control.goals import decided_message
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.outputs import OutputDistance, controlled_parts
from spacerobot_ros.control.status import ControllerState
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import Measures, Outcome, momentum_drift
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.planning import GaitSchedule, Goal, PoseError
from spacerobot_ros.planning.core.goal import POSE, end_effector_pose, missed_parts, reached_message
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.status import describe_remaining_error
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.simulation.config import OrbitConfig, TableConfig
from spacerobot_ros.simulation.plant import InitialState
from spacerobot_ros.times import SECOND

_STATES_PER_FLIGHT = 40
"""Largest number of states evaluated along a flight's schedule, in addition to the last state."""

_MAX_BATCH_TICKS = 4_000_000
"""Largest number of ticks in one batch; all its schedules are in memory."""

_DEVICE_FLIGHTS = 4096
"""Flights per batch on a device: about as many as are prepared in the following time."""

_MAX_BATCH_PREPARATION_TIME = 4.0
"""Wall time, s, after which a batch is flown with the draws that are ready; this limits the loss if
the campaign is interrupted."""

_END_POSITION_TOLERANCE = 1e-6
"""Largest distance between a joint and its final scheduled position, m or rad."""

_EXTERNAL_LOAD_PREFIXES = "plant.disturbances", "plant.orbit.", "plant.table."

_GAIN_PREFIX = "coordinated_control.gains."
"""Prefix of controller parameters that may differ between lanes."""

_COMMON_PARAMETERS = "plant.tick_rate", "plant.integration_step", "plant.actuation", "plant.engine"
"""Prefixes of parameters that are the same in all lanes."""

_PARAMETERS_COMMON_TO_CONTROLLERS = (
    *_COMMON_PARAMETERS,
    *("plant.thrusters", "plant.end_effector_frame", "plant.beyond_limits"),
    *("plant.latched_faults", "plant.robot"),
)

_PARAMETERS_COMMON_TO_SCHEDULES = (
    *_COMMON_PARAMETERS,
    *("planner.tick_rate", "planner.averaging", "planner.drift", "planner.replan"),
    *("planner.shape_", "planner.max_corrections", "planner.output"),
)

_OUTCOME_OF_DECISION = {
    Decision.REACHED: (Outcome.REACHED, ControllerState.REACHED),
    Decision.FAILED: (Outcome.FAILED, ControllerState.FAILED),
}


@dataclass(frozen=True)
class _PreparedDraw:
    """A draw that is ready for lanes, with its schedule, if any, and the planning wall time, s."""

    draw: Draw
    flight: DrawnFlight
    planned: GaitSchedule | None = None
    plan_time: float = 0.0

    @property
    def schedule(self) -> GaitSchedule:
        assert self.planned is not None
        return self.planned


class LanesEngine:
    """Engine that flies many draws at once, in SIMD lanes or on a device.

    Parameters
    ----------
    name
        ``lanes``, or the name of a device; see :func:`.device_named`.
    """

    def __init__(self, name: str = "lanes") -> None:
        self.name = name
        self._target = vector_unit() if name == "lanes" else device_named(name)
        self.efficient_flights = _DEVICE_FLIGHTS if self._target.threads else 64
        """Smaller batches of draws take as long as one of this size."""
        self._scheduled, self._controlled = _ScheduledLanes(), _ControlledLanes()

    def refusal(self, campaign: Campaign) -> str:
        """Return the reason why lanes cannot fly a campaign, as a clause; empty if they can."""
        if reason := FlightsEngine().refusal(campaign):
            return reason
        scenario = campaign.scenario
        plant = scenario.plant
        if plant.faults or _any_begins(campaign.names, "faults"):
            return "it has faults"
        if plant.target.given:
            return "it has a target"
        if plant.engine != "exact":
            return f"its plant uses the engine '{plant.engine}'; use engine 'flights'"
        loads = plant.disturbances, plant.orbit, plant.table
        dispersed = _any_begins(campaign.names, _EXTERNAL_LOAD_PREFIXES)
        if dispersed or loads != ((), OrbitConfig(), TableConfig()):
            return "it has disturbances, an orbit or a table; use engine 'flights'"
        if campaign.measures_clearance:
            return "it uses the metric clearance_m, and lanes measure no distances between links"
        if own := campaign.own_metrics:
            return f"the metric '{own[0]}' requires whole flights; use engine 'flights'"
        match scenario.commanders, plant.actuation:
            case ("planner",), "velocity":
                return self._scheduled.refusal(campaign)
            case ("coordinated_control",), "effort":
                return self._controlled.refusal(campaign)
        return "lanes support only planner velocities or coordinated control efforts"

    def fly(
        self, campaign: Campaign, draws: Iterable[Draw], stopped: Callable[[], bool]
    ) -> Iterator[Row | Draw]:
        """Fly draws in batches."""
        lanes: _ScheduledLanes | _ControlledLanes = self._controlled
        if "planner" in campaign.scenario.commanders:
            lanes = self._scheduled
        common, batch, ticks = DrawnFlight.of(campaign.scenario), list[_PreparedDraw](), 0
        began = time.perf_counter()
        for draw, flight in drawn_flights(campaign, draws, common):
            if stopped():
                return
            try:
                if isinstance(flight, Exception):
                    raise flight
                ready = lanes.prepare_draw(campaign, draw, flight)
            except Exception as error:  # The error is reported as a row.
                yield Row.of_error(draw, error, self.name)
                continue
            if isinstance(ready, str):
                yield replace(draw, fallback=ready)
                continue
            batch.append(ready)
            ticks += 0 if ready.planned is None else ready.schedule.ticks
            late = time.perf_counter() - began > _MAX_BATCH_PREPARATION_TIME
            most = max(lanes.max_batch_flights, self.efficient_flights)
            if late or len(batch) >= most or ticks > _MAX_BATCH_TICKS:
                yield from self._fly_batch(campaign, lanes, batch, stopped)
                batch, ticks, began = [], 0, time.perf_counter()
        if batch:
            yield from self._fly_batch(campaign, lanes, batch, stopped)

    def _fly_batch(
        self,
        campaign: Campaign,
        lanes: _ScheduledLanes | _ControlledLanes,
        batch: Sequence[_PreparedDraw],
        stopped: Callable[[], bool],
    ) -> Iterator[Row | Draw]:
        began, interrupted = time.perf_counter(), False

        def look() -> bool:
            nonlocal interrupted
            interrupted = interrupted or stopped()
            return interrupted

        try:
            flights = lanes.flights(campaign, batch)
            result = fly_lanes(flights, self._target, look)
            if interrupted:
                return
        # The error concerns one draw, so each draw is flown separately.
        except SpaceRobotError as error:
            yield from (replace(each.draw, fallback=str(error)) for each in batch)
            return
        taken = (time.perf_counter() - began) / len(batch)
        flown: list[tuple[Draw, Measures]] = []
        each_measures = lanes.measures(campaign, result, batch, flights)
        for ready, measures in zip(batch, each_measures, strict=True):
            if isinstance(measures, str):
                yield replace(ready.draw, fallback=measures)
            else:
                wall_time = taken + ready.plan_time
                flown.append((ready.draw, replace(measures, wall_time=wall_time)))
        yield from Row.of_each(campaign, flown, self.name)


class _ScheduledLanes:
    """Flights along the schedules that the planner's executive makes for the first states."""

    max_batch_flights = 512

    def __init__(self) -> None:
        self._plans = FirstPlans()

    def refusal(self, campaign: Campaign) -> str:
        """Return the reason why lanes cannot fly a campaign, as a clause; empty if they can."""
        planner, sensors = campaign.scenario.planner, campaign.scenario.plant.sensors
        if planner.averaging > 1 or planner.drift_position or planner.drift_attitude:
            return "the planner averages states, or monitors the path"
        if campaign.scenario.goal.end_effectors:
            return "the goal specifies end-effector poses"
        if planner.replanning or planner.output != "commands":
            return "the planner replans during the motion"
        for name in campaign.names:
            if name.startswith(_PARAMETERS_COMMON_TO_SCHEDULES):
                return f"'{name}' is dispersed, but shared by all lanes"
        noisy = sensors.joint_noise or any(sensors.joint_bias)
        if noisy or _any_begins(campaign.names, "plant.sensors.joint"):
            return "the joints are measured with errors"
        return ""

    def prepare_draw(
        self, campaign: Campaign, draw: Draw, flight: DrawnFlight
    ) -> _PreparedDraw | str:
        """Plan for the first state of a draw; if planning fails, return the reason."""
        began = time.perf_counter()
        schedule, goal = self._plans.schedule(flight), flight.scenario.goal
        if schedule is None:
            return "had no schedule in its first state"
        if schedule.controls & (POSE - goal.asked):
            return "maintains a part of the pose that its goal does not specify"
        return _PreparedDraw(draw, flight, schedule, time.perf_counter() - began)

    def flights(self, campaign: Campaign, batch: Sequence[_PreparedDraw]) -> Flights:
        planner = batch[0].flight.scenario.planner
        schedules = [each.schedule for each in batch]
        ticks = {each.ticks for each in schedules}
        most = max(ticks)
        positions = schedules[0].positions
        if any(each is not schedules[0] for each in schedules):
            padded = (
                np.pad(each.positions, ((0, most - each.ticks), (0, 0)), "edge")
                for each in schedules
            )
            positions = np.array([*padded])
        instants = np.unique(np.concatenate([_evaluated_ticks(each) for each in ticks]))
        return _batch_of_flights(
            [each.flight for each in batch],
            FollowedSchedule(positions, planner.shape_gain, planner.shape_deadband),
            most,
            instants=tuple(instants.tolist()),
        )

    def measures(
        self,
        campaign: Campaign,
        result: BatchResult,
        batch: Sequence[_PreparedDraw],
        flights: Flights,
    ) -> Iterator[Measures | str]:
        """Yield the measures of each flight whose outcome is known at the end of its schedule, or
        the reason for a fallback."""
        rows = np.arange(len(batch))
        instants = {tick: place for place, tick in enumerate(flights.report_ticks)}
        ends = np.array([instants[each.schedule.ticks] for each in batch])
        measured, measured_q = result.measured_pose[rows, ends], result.measured_q[rows, ends]
        poses, q = result.pose[rows, ends], result.q[rows, ends]
        last = np.array([each.schedule.positions[-1] for each in batch])
        deviations = np.abs(last - measured_q).max(axis=1, initial=0.0).tolist()
        limited = np.any([x.any(axis=1) for x in result.limited_ticks.values()], axis=0).tolist()
        durations = (result.time[ends] - result.time[0]).tolist()
        ticks = [each.schedule.ticks for each in batch]
        own = {each: np.isin(flights.report_ticks, _evaluated_ticks(each)) for each in set(ticks)}
        evaluated = np.array([own[each] for each in ticks])
        drifts = momentum_drift(np.where(evaluated[..., np.newaxis], result.momentum, np.nan))
        shared = {id(each.schedule): each.schedule.positions for each in batch}
        extremes = {key: (each.min(axis=0), each.max(axis=0)) for key, each in shared.items()}
        scenarios = _distinct_scenarios(each.flight for each in batch)
        planners = {key: each.planner for key, each in scenarios.items()}
        for row, ready in enumerate(batch):
            if row in result.failures:
                yield "was refused by the plant"
                continue
            if limited[row]:
                yield "had a joint at its limit"
                continue
            scenario, schedule = ready.flight.scenario, ready.schedule
            planner = planners[id(scenario)]
            if deviations[row] > max(_END_POSITION_TOLERANCE, planner.shape_deadband):
                yield "had a joint that did not follow its schedule"
                continue
            decided = _decide_goal(scenario.goal, planner, schedule, measured[row], measured_q[row])
            if isinstance(decided, str):
                yield decided
                continue
            duration, pose = durations[row], poses[row]
            if duration > campaign.max_flight_time:
                yield "took longer than the campaign allows"
                continue
            hand = _end_effector_error(flights.robot, ready.flight, q[row], pose)
            lowest, highest = extremes[id(schedule)]
            yield Measures(
                *decided,
                duration=duration,
                manoeuvre_time=duration,
                error=PoseError.between(pose[:3], pose[3:], scenario.goal),
                peak_rate=result.peak_rate[row],
                peak_effort=result.peak_effort[row],
                peak_wrench=np.zeros(2),
                # The joints follow the schedule exactly at every tick.
                lowest=lowest,
                highest=highest,
                momentum_drift=drifts[row],
                end_effector_distance=math.nan if hand is None else hand.distance,
                plan_time=ready.plan_time,
            )


class _ControlledLanes:
    max_batch_flights = 128

    def refusal(self, campaign: Campaign) -> str:
        """Return the reason why lanes cannot fly a campaign, as a clause; empty if they can."""
        scenario = campaign.scenario
        plant = scenario.plant
        if scenario.goal.end_effectors:
            return "the goal specifies end-effector poses"
        if scenario.goal.asked != POSE:
            return "the goal specifies only part of the base pose"
        if plant.thrusters:
            return "it has on/off thrusters; use engine 'flights'"
        if plant.beyond_limits != "clip":
            return "the plant refuses commands beyond limits"
        robots = nominal_robots(scenario)
        if robots.plant.description.world is not None:
            return "it has obstacles, and lanes do not detect contacts"
        if robots.controller.description.wheel_names:
            return "the robot has reaction wheels; use engine 'flights'"
        if scenario.controller.plans:
            return "its controller tracks planned references; use engine 'flights'"
        if scenario.controller.tasks:
            return "its controller performs tasks before goals; use engine 'flights'"
        for name in campaign.names:
            own = name.startswith("coordinated_control.") and not name.startswith(_GAIN_PREFIX)
            if own or name.startswith(_PARAMETERS_COMMON_TO_CONTROLLERS):
                return f"'{name}' is dispersed, but shared by all lanes"
        try:
            law = build_controller(robots.controller, scenario.controller).law
        except SpaceRobotError as error:
            return str(error)
        gains = [name for name in campaign.names if name.startswith(_GAIN_PREFIX)]
        if law.integrates or any(name.endswith(".ki") for name in gains):
            return "its controller has integral gains; use engine 'flights'"
        if law.couples:
            return "its gains are matrices; use engine 'flights'"
        if law.fixed_inputs is None:
            return f"the law '{law.name}' with these options is not a single function"
        goals = {"base": scenario.goal, "end_effector": scenario.end_effector_goal}
        for key, goal in goals.items():
            if goal is not None and not getattr(law.outputs.selection, key):
                return f"the law '{law.name}' does not control the {key.replace('_', '-')}"
        if controlled_parts(law.outputs.selection.base) != POSE:
            return f"the law '{law.name}' controls only part of the base pose"
        return ""

    def prepare_draw(
        self, campaign: Campaign, draw: Draw, flight: DrawnFlight
    ) -> _PreparedDraw | str:
        """Check that a draw can be flown in a batch, because an error would also end the other
        flights of the batch."""
        ready = _PreparedDraw(draw, flight)
        try:
            self.flights(campaign, [ready])
        except SpaceRobotError as error:
            return str(error)
        return ready

    def flights(self, campaign: Campaign, batch: Sequence[_PreparedDraw]) -> Flights:
        """Return a batch of draws; raise SpaceRobotError if a parameter, start or goal is
        invalid."""
        scenario = campaign.scenario
        drawn = [each.flight for each in batch]
        dispersed = _any_begins(campaign.names, _GAIN_PREFIX)
        gains = tuple(each.scenario.controller.gains for each in drawn) if dispersed else ()
        program = ControlledGoals(
            scenario.controller,
            base=_goal_poses([each.scenario.goal for each in drawn]),
            end_effector=_goal_poses([each.scenario.end_effector_goal for each in drawn]),
            gains=gains,
            robot=nominal_robots(scenario).controller,
            ends_when_decided=True,
        )
        return _batch_of_flights(
            drawn,
            program,
            _tick_of_interruption(campaign.max_flight_time, scenario.plant.period_ns),
        )

    def measures(
        self,
        campaign: Campaign,
        result: BatchResult,
        batch: Sequence[_PreparedDraw],
        flights: Flights,
    ) -> Iterator[Measures | str]:
        """Yield the measures of each flight, or the reason for a fallback."""
        n, program = flights.robot.n, flights.program
        assert isinstance(program, ControlledGoals)
        law_type = LAWS[program.config.law]
        outputs = controlled_outputs(program.robot or flights.robot, program.config, law_type)
        turns = any(axis.startswith("r") for axis in outputs.end_effector)
        for row, ready in enumerate(batch):
            scenario = ready.flight.scenario
            decision, decided = Decision(result.decision[row]), int(result.decision_tick[row])
            if row in result.failures:
                yield "was refused by the plant"
                continue
            if decision is Decision.LOST:
                yield "lost control"
                continue
            if decided == 0:
                yield "ended in its first state"
                continue
            end = result.end_state[row]
            q, pose = end[:n], end[2 * n : 2 * n + 7]
            hand = _end_effector_error(flights.robot, ready.flight, q, pose)
            duration = int(result.end_tick[row]) * scenario.plant.period_ns / SECOND
            if decision is Decision.NONE:
                outcome, flown = Outcome.INTERRUPTED, duration
                message = f"Interrupted after {duration:.6g} s of simulated time."
            else:
                outcome, state = _OUTCOME_OF_DECISION[decision]
                left = OutputDistance(*result.decision_distance[row].tolist())
                message = decided_message(state, left, scenario.controller)
                flown = decided * scenario.plant.period_ns / SECOND
            initial_rate = np.abs(flights.initial_states.qdot[row])
            yield Measures(
                outcome=outcome,
                message=message,
                duration=duration,
                manoeuvre_time=flown,
                error=PoseError.between(pose[:3], pose[3:], scenario.goal),
                peak_rate=np.maximum(result.peak_rate[row], initial_rate),
                peak_effort=result.peak_effort[row],
                peak_wrench=result.peak_wrench[row],
                lowest=np.minimum(result.lowest[row], q),
                highest=np.maximum(result.highest[row], q),
                momentum_drift=result.momentum_drift[row],
                end_effector_distance=math.nan if hand is None else hand.distance,
                end_effector_angle=hand.angle if turns and hand is not None else math.nan,
                plan_time=0.0,
            )


def _any_begins(names: Iterable[str], prefixes: str | tuple[str, ...]) -> bool:
    return any(name.startswith(prefixes) for name in names)


def _distinct_scenarios(drawn: Iterable[DrawnFlight]) -> dict[int, Scenario]:
    """Return scenarios by ``id``: draws that do not change the scenario share it."""
    return {id(each.scenario): each.scenario for each in drawn}


def _batch_of_flights(
    drawn: Sequence[DrawnFlight],
    program: FollowedSchedule | ControlledGoals,
    ticks: int,
    instants: tuple[int, ...] = (),
) -> Flights:
    robot, nominal = plant_robot(drawn[0]), InertialParameters.of(drawn[0].nominal)
    scenarios = _distinct_scenarios(drawn)
    places = {key: place for place, key in enumerate(scenarios)}
    rows = np.array([places[id(each.scenario)] for each in drawn])
    plants = [scenario.plant for scenario in scenarios.values()]
    sensors = SensorErrors.of(robot, [plant.sensors for plant in plants])[rows]
    sensors.seeds[:] = [
        seed if each.seed is None else each.seed
        for each, seed in zip(drawn, sensors.seeds.tolist(), strict=True)
    ]
    return Flights(
        robot=robot,
        actuation="effort" if isinstance(program, ControlledGoals) else "velocity",
        control_period=plants[0].control_period,
        ticks=ticks,
        initial_states=InitialStates.of(robot, [InitialState.of(plant) for plant in plants])[rows],
        program=program,
        inertial=InertialParameters.stacked([each.inertial or nominal for each in drawn]),
        sensors=sensors,
        integration_step=plants[0].integration_step,
        report_ticks=instants,
    )


def _end_effector_error(
    robot: SpaceRobot, flight: DrawnFlight, q: Array, pose: Array
) -> PoseError | None:
    goal = flight.scenario.end_effector_goal
    if goal is None:
        return None
    link = robot.description.end_effector(flight.scenario.plant.end_effector_frame)
    if not link:
        return None
    return PoseError.between(*end_effector_pose(robot, link, pose[:3], pose[3:], q), goal)


def _decide_goal(
    goal: Goal, planner: PlannerConfig, schedule: GaitSchedule, pose: Array, q: Array
) -> tuple[Outcome, str] | str:
    """Return the outcome of a goal at the end of a schedule with its message, or the reason for a
    fallback, for the measured pose (7,) and joint positions (n,).
    """
    error = PoseError.between(pose[:3], pose[3:], goal, q)
    tolerance = planner.tolerance
    missed = missed_parts(goal, error, schedule.controls, tolerance)
    remaining = describe_remaining_error(error, schedule.controls, tolerance, goal)
    if tolerance.admits(error, schedule.controls):
        outcome = Outcome.REACHED_PARTLY if missed else Outcome.REACHED
        return outcome, reached_message(remaining, missed)
    if planner.max_corrections:
        return "needed corrections"
    return Outcome.FAILED, f"The goal is not reached after 0 corrections: {remaining}."


@lru_cache(maxsize=64)
def _evaluated_ticks(ticks: int) -> Array:
    """Return the ticks at which a flight along a schedule with this many ticks is evaluated.

    The ticks depend on nothing else, so that a flight has the same measures in any batch; the
    ticks of different flights coincide if possible.
    """
    spacing = 1 << max(0, math.ceil(math.log2(ticks / _STATES_PER_FLIGHT)))
    return np.append(np.arange(0, ticks, spacing), ticks)


def _goal_poses(goals: Sequence[Goal | None]) -> Array | None:
    """Return goals as received by a controller, (N, 7); None if there are none."""
    checked = [Goal.checked(each.position, each.quaternion) for each in goals if each is not None]
    if not checked:
        return None
    return np.array([np.concatenate([each.position, each.quaternion]) for each in checked])


def _tick_of_interruption(longest: float, period_ns: int) -> int:
    tick = max(1, int(longest * SECOND / period_ns) - 1)
    while tick * period_ns / SECOND < longest:
        tick += 1
    return tick
