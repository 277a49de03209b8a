"""Draws of coordinated control flown in lanes, to the decision about their goals.

The decision is that of the controller's executive. Where control is lost, the draw is flown again
by the engine ``flights``: what the executive does then is not in lanes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spacerobot_ros.batch import Controlled, Decision, Flights, SensorErrors, Starts, fly_lanes
from spacerobot_ros.batch.flights import BatchResult
from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.draws import Draw
from spacerobot_ros.campaign.one_by_one import node_robot, nominal_robots
from spacerobot_ros.campaign.targets import DrawnFlight
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import decided_message
from spacerobot_ros.control.outputs import OutputDistance
from spacerobot_ros.control.status import ControllerState
from spacerobot_ros.control.thrusters import find_thrusters
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.scenario import Scenario
from spacerobot_ros.measures import Measures, Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.simulation.plant import InitialState
from spacerobot_ros.times import SECOND

_FREE = "coordinated_control.gains."
"""Parameters of the controller that may differ from lane to lane."""

_COMMON = (
    *("plant.tick_rate", "plant.integration_step", "plant.thrusters", "plant.end_effector_frame"),
    *("plant.beyond_limits", "plant.latched_faults", "plant.actuation", "plant.robot"),
)
"""Parameters of the plant that may not."""

_OUTCOMES = {
    Decision.REACHED: (Outcome.REACHED, ControllerState.REACHED),
    Decision.FAILED: (Outcome.FAILED, ControllerState.FAILED),
}


def control_refusal(campaign: Campaign, *, asked: bool) -> str:
    """Return why lanes cannot fly a campaign of coordinated control, as a clause; empty if they do.

    On/off thrusters amplify rounding: 1e-15 m at the start become 1e-4 m and 0.1 s at the end. So a
    draw in lanes is another flight than that of the engine ``flights``, and is flown only where
    lanes are ``asked`` for.
    """
    scenario = campaign.scenario
    plant = scenario.plant
    if plant.thrusters and not asked:
        return "its thrusters are on or off, which multiplies rounding: ask for lanes by name"
    if plant.thrusters and plant.thrusters_excluded:
        return "some of its thrusters are not used"
    if plant.beyond_limits != "clip":
        return "the plant refuses commands beyond limits"
    for dispersion in campaign.dispersions:
        name = dispersion.name
        own = name.startswith("coordinated_control.") and not name.startswith(_FREE)
        if own or name.startswith(_COMMON):
            return f"'{name}' differs, which lanes have in common"
    try:
        law = build_controller(nominal_robots(scenario).controller, scenario.controller).law
    except SpaceRobotError as error:
        return str(error)
    if law.fixed_inputs is None:
        return f"the law '{law.name}' needs more than its function"
    for key, goal in _goals(scenario).items():
        if goal is not None and not getattr(law.outputs.selection, key):
            return f"the law '{law.name}' does not control the {key.replace('_', '-')}"
    return ""


def require_lane(campaign: Campaign, flight: DrawnFlight) -> None:
    """Refuse a draw that begins nowhere, as the plant and the controller refuse it.

    Raises
    ------
    SpaceRobotError
        A parameter, the start or a goal is refused.
    """
    _flights(campaign, [flight])


def fly_controlled(
    campaign: Campaign, batch: Sequence[tuple[Draw, DrawnFlight]]
) -> list[tuple[Draw, Measures | str]]:
    """Fly draws together, to the decisions about their goals.

    Returns
    -------
    list
        Each draw with the measures of its flight, or the reason why another engine is to fly it.

    Raises
    ------
    SpaceRobotError
        One of them cannot be flown.
    """
    began = time.perf_counter()
    flights = _flights(campaign, [flight for _, flight in batch])
    result = fly_lanes(flights)
    taken = (time.perf_counter() - began) / len(batch)
    found: list[tuple[Draw, Measures | str]] = []
    for row, (draw, drawn) in enumerate(batch):
        measures = _measures(result, row, drawn, flights)
        if not isinstance(measures, str):
            measures = replace(measures, wall_time=taken)
        found.append((draw, measures))
    return found


def _goals(scenario: Scenario) -> dict[str, Goal | None]:
    return {"base": scenario.goal, "end_effector": scenario.end_effector_goal}


def _flights(campaign: Campaign, drawn: Sequence[DrawnFlight]) -> Flights:
    scenario = campaign.scenario
    plant, controller = scenario.plant, scenario.controller
    robot = node_robot("plant", drawn[0])
    configs = [each.scenario.plant for each in drawn]
    goals = [_goals(each.scenario) for each in drawn]
    free = any(each.name.startswith(_FREE) for each in campaign.dispersions)
    gains = tuple(each.scenario.controller.gains for each in drawn) if free else ()
    nominal = InertialParameters.of(drawn[0].nominal)
    table = find_thrusters(plant.thrusters, robot.description) if plant.thrusters else None
    return Flights(
        robot=robot,
        actuation="effort",
        control_period=plant.control_period,
        ticks=_ticks(campaign.longest, plant.period_ns),
        starts=Starts.of(robot, [InitialState.of(config) for config in configs]),
        program=Controlled(
            controller,
            base=_poses([each["base"] for each in goals]),
            end_effector=_poses([each["end_effector"] for each in goals]),
            gains=gains,
            robot=nominal_robots(scenario).controller,
            until_decided=True,
        ),
        inertial=InertialParameters.stacked([each.inertial or nominal for each in drawn]),
        sensors=SensorErrors.of(robot, [config.sensors for config in configs]),
        integration_step=plant.integration_step,
        thrusters=table,
    )


def _poses(goals: Sequence[Goal | None]) -> Array | None:
    """Return goals as they are received, (N, 7)."""
    checked = [Goal.checked(each.position, each.quaternion) for each in goals if each is not None]
    if not checked:
        return None
    return np.array([np.concatenate([each.position, each.quaternion]) for each in checked])


def _ticks(longest: float, period_ns: int) -> int:
    """Return the first tick at which a flight is interrupted."""
    tick = max(1, int(longest * SECOND / period_ns) - 1)
    while tick * period_ns / SECOND < longest:
        tick += 1
    return tick


def _measures(
    result: BatchResult, row: int, drawn: DrawnFlight, flights: Flights
) -> Measures | str:
    """Return the measures of a flight, or the reason why it is not decided in lanes."""
    decision = Decision(int(result.decision[row]))
    decided, period_ns = int(result.decided_tick[row]), drawn.scenario.plant.period_ns
    if row in result.failures:
        return "was refused by the plant"
    if decision is Decision.LOST:
        return "lost control"
    if decided == 0:
        return "ended at its first state"
    n, end = flights.robot.n, result.end_state[row]
    q, pose = end[:n], end[2 * n : 2 * n + 7]
    duration = int(result.end_tick[row]) * period_ns / SECOND
    if decision is Decision.NONE:
        outcome, flown = Outcome.INTERRUPTED, duration
        message = f"Interrupted after {duration:.6g} s of simulated time."
    else:
        outcome, state = _OUTCOMES[decision]
        message = decided_message(state, OutputDistance(*result.decided_distance[row].tolist()))
        flown = decided * period_ns / SECOND
    scenario = drawn.scenario
    return Measures(
        outcome=outcome,
        message=message,
        duration=duration,
        manoeuvre_time=flown,
        error=PoseError.between(pose[:3], pose[3:], scenario.goal),
        end_effector_error=end_effector_error(flights.robot, drawn, q, pose),
        peak_rate=np.maximum(result.peak_rate[row], np.abs(flights.starts.qdot[row])),
        peak_effort=result.peak_effort[row],
        peak_wrench=result.peak_wrench[row],
        lowest=np.minimum(result.lowest[row], q),
        highest=np.maximum(result.highest[row], q),
        momentum_drift=result.momentum_drift[row],
        propellant=math.nan if flights.thrusters is None else float(result.propellant[row]),
        plan_time=0.0,
    )


def end_effector_error(
    robot: SpaceRobot, drawn: DrawnFlight, q: Array, pose: Array
) -> PoseError | None:
    """Return the error of the end-effector to its goal; None without one of them.

    Parameters
    ----------
    robot, drawn
        The robot and the flight.
    q, pose
        Joint positions (n,) and the pose (7,) of the base in W.
    """
    goal = drawn.scenario.end_effector_goal
    link = robot.description.end_effector(drawn.scenario.plant.end_effector_frame)
    if goal is None or not link:
        return None
    R_BE, r_BE_B = robot.link_pose(link, q)
    R_WB = matrix_from_quaternion(pose[3:])
    return PoseError.between(pose[:3] + R_WB @ r_BE_B, quaternion_from_matrix(R_WB @ R_BE), goal)
