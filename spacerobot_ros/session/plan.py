"""Plans without ROS: from a scenario or a robot to a schedule, and its flight in the plant."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.cli.options import changed_goal
from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.parameters import configured, declared, values_of
from spacerobot_ros.planning import (
    METHODS,
    GaitSchedule,
    Goal,
    PlanRequest,
    PoseError,
    RobotState,
    Tolerance,
    build_method,
)
from spacerobot_ros.planning.core.goal import Controlled
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.resources import resource_names, robot_file
from spacerobot_ros.session.scenario import load_scenario, parse_setting, scenario_names
from spacerobot_ros.simulation.building import initial_state, period_ns
from spacerobot_ros.simulation.initial_state import InitialState
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

_PLANT = {
    "initial_position": [0.0, 0.0, 0.0],
    "initial_orientation": [0.0, 0.0, 0.0, 1.0],
    "linear_momentum": [0.0, 0.0, 0.0],
    "angular_momentum": [0.0, 0.0, 0.0],
}
_PLANNER = {
    "tick_rate": 20.0,
    "integration_step": 0.01,
    "position_tolerance": 1e-3,
    "attitude_tolerance": 1e-3,
    "joint_tolerance": 1e-3,
}
"""Those of the nodes' parameters that a plan follows from, with the nodes' defaults."""

_MOST_PIECES = 1000
"""Schedules that end short of the goal on purpose may follow each other this often."""


@dataclass(frozen=True)
class Problem:
    """What is to be planned: robot, start, goal, and the planner's ``parameters`` by name."""

    name: str
    robot: SpaceRobot
    initial: InitialState
    goal: Goal
    parameters: Mapping[str, Any]

    @property
    def tick_period(self) -> float:
        """How long a command is held, s."""
        return period_ns(self.parameters["tick_rate"]) / 1e9

    @property
    def tolerance(self) -> Tolerance:
        """How near is there."""
        values = self.parameters
        return Tolerance(
            values["position_tolerance"], values["attitude_tolerance"], values["joint_tolerance"]
        )

    def method(self, name: str) -> GaitMethod:
        """Build a method with its options."""
        step = self.parameters["integration_step"]
        options = configured(PlannerConfig, self.parameters).options
        return build_method(name, self.robot, self.tick_period, step, options)

    def plant(self) -> VelocityPlant:
        """Return the robot at the start."""
        step = self.parameters["integration_step"]
        return VelocityPlant(self.robot, self.tick_period, self.initial, step)


@dataclass(frozen=True)
class Planned:
    """A method's answer to a problem, and what became of it in the plant.

    ``pieces`` are the schedules flown one after the other: one, for a method that plans to the
    end. ``error`` is what was left to the goal at ``pose`` (7,), ``limited`` the ticks in which the
    plant limited a joint, ``plan_time`` wall time in s, ``controls`` the parts of the goal
    that the schedules control.
    """

    method: str
    pieces: Sequence[GaitSchedule]
    error: PoseError
    pose: Array
    limited: int
    plan_time: float
    succeeded: bool
    controls: frozenset[Controlled]

    @property
    def duration(self) -> float:
        """Time that the manoeuvre takes, s."""
        return sum(piece.duration for piece in self.pieces)


def problem(
    name: str,
    goal: tuple[float, ...] | None = None,
    goal_rotvec: tuple[float, ...] | None = None,
    settings: Sequence[str] = (),
) -> Problem:
    """Return the problem of a scenario, or of a robot (a name or a URDF file) at the origin.

    ``goal`` (7,) and ``goal_rotvec`` (3,) replace the scenario's, ``settings`` are
    ``planner.parameter=value`` and ``plant.parameter=value``.

    Raises
    ------
    ParameterError
        There is no such scenario or robot, or a parameter is refused.
    PlanningError
        The goal is not finite.
    """
    plant, planner, own_goal = _sections(name)
    for text in settings:
        node, parameter, value = parse_setting(text)
        if node not in ("plant", "planner"):
            raise ParameterError(f"'{text}' sets a parameter of {node}, which plans nothing.")
        (plant if node == "plant" else planner)[parameter] = value
    wanted = changed_goal(own_goal, goal, goal_rotvec)
    robot_name = planner.get("robot") or plant.get("robot")
    if not robot_name:
        raise ParameterError(f"The scenario '{name}' names no robot; see plant.robot.")
    robot = SpaceRobot.from_file(robot_file(str(robot_name)))
    return Problem(name, robot, initial_state({**_PLANT, **plant}), wanted, _checked(planner))


def solve(problem: Problem, name: str, method: GaitMethod | None = None) -> Planned:
    """Plan by a method, ``method`` if it is built already, and fly the schedule in the plant.

    Raises
    ------
    PlanningError
        The method refuses the goal.
    """
    plant = problem.plant()
    pieces: list[GaitSchedule] = []
    began = time.perf_counter()
    method = method or problem.method(name)
    plan_time = time.perf_counter() - began
    while not pieces or (pieces[-1].partial and len(pieces) < _MOST_PIECES):
        began = time.perf_counter()
        schedule = method.plan(
            PlanRequest(
                start_of(plant),
                problem.goal,
                problem.tolerance,
                correction=bool(pieces),
                previous=pieces[-1] if pieces else None,
            )
        )
        plan_time += time.perf_counter() - began
        for rates in schedule.velocities:
            plant.step(rates)
        pieces.append(schedule)
        error = PoseError.between(plant.pose[:3], plant.pose[3:], problem.goal, plant.q)
        if problem.tolerance.admits(error, schedule.controls):
            break
    limited = sum(int(counts.max(initial=0)) for counts in plant.limit_counts.values())
    met = problem.tolerance.admits(error, schedule.controls)
    return Planned(
        name, pieces, error, plant.pose.copy(), limited, plan_time, met, schedule.controls
    )


def compare(problem: Problem) -> dict[str, Planned | str]:
    """Return what every method makes of a problem: its flight, or why it refuses."""
    answers: dict[str, Planned | str] = {}
    for name, method in METHODS.items():
        # That one only chooses among the others.
        if name == "auto":
            continue
        if objection := method.objection(problem.robot):
            answers[name] = objection
            continue
        try:
            answers[name] = solve(problem, name)
        except (ParameterError, PlanningError) as refusal:
            answers[name] = str(refusal)
    return answers


def json_of(problem: Problem, planned: Planned) -> dict[str, Any]:
    """Return what ``--json`` writes of a flight."""
    goal, path = problem.goal, [piece.path for piece in planned.pieces]
    starts = np.cumsum([0.0, *(piece.duration for piece in planned.pieces)])
    positions = [planned.pieces[0].positions[:1], *(x.positions[1:] for x in planned.pieces)]
    return {
        "scenario": problem.name,
        "method": planned.method,
        "goal": [*goal.position.tolist(), *goal.quaternion.tolist()],
        "succeeded": planned.succeeded,
        "manoeuvre_time_s": planned.duration,
        "plan_time_s": planned.plan_time,
        "final_position_m": planned.pose[:3].tolist(),
        "final_attitude_rotvec_rad": rotvec_from_quaternion(planned.pose[3:]).tolist(),
        "final_joint_positions": planned.pieces[-1].positions[-1].tolist(),
        "position_error_m": planned.error.distance,
        "attitude_error_rad": planned.error.angle,
        "notes": planned.pieces[-1].notes,
        "schedule": {
            "tick_period_s": problem.tick_period,
            "joint_names": list(problem.robot.joint_names),
            "positions": np.vstack(positions).tolist(),
        },
        "path": {
            "time_s": np.concatenate(
                [start + x.time for start, x in zip(starts, path, strict=False)]
            ).tolist(),
            "position_m": np.vstack([x.position for x in path]).tolist(),
            "quaternion": np.vstack([x.quaternion for x in path]).tolist(),
        },
    }


def table_of(answers: Mapping[str, Planned | str]) -> list[str]:
    """Return the lines of a comparison; errors that a method leaves as they come in brackets."""
    lines = [
        f"{'method':<14}{'manoeuvre':>12}{'planned in':>12}{'attitude':>14}{'position':>14}",
        f"{'':<14}{'s':>12}{'s':>12}{'rad off':>14}{'m off':>14}",
    ]
    for name, answer in answers.items():
        if isinstance(answer, str):
            lines.append(f"{name:<14}{answer}")
            continue
        lines.append(
            f"{name:<14}{answer.duration:>12.6g}{answer.plan_time:>12.3f}"
            f"{_error(answer, 'attitude', answer.error.angle):>14}"
            f"{_error(answer, 'position', answer.error.distance):>14}"
        )
    return lines


def _error(planned: Planned, part: Controlled, error: float) -> str:
    return f"{error:.3g}" if part in planned.controls else f"({error:.3g})"


def _sections(name: str) -> tuple[dict[str, Any], dict[str, Any], Goal]:
    """Return the parameters of plant and planner, and the goal, of a scenario or a robot."""
    if name not in scenario_names() and (
        name.endswith(".urdf") or name in resource_names("urdf", ".urdf")
    ):
        return {"robot": name}, {}, Goal.checked([0, 0, 0], [0, 0, 0, 1])
    scenario = load_scenario(name)
    return scenario.parameters("plant"), scenario.parameters("planner"), scenario.goal


def _checked(planner: Mapping[str, Any]) -> dict[str, Any]:
    """Return all parameters of the planner, those that are not given by default."""
    known = {parameter.name for parameter in declared(PlannerConfig)}
    for name in planner:
        if name.partition(".")[0] in METHODS and name not in known:
            raise ParameterError(f"The planner has no parameter '{name}'.")
    return dict(values_of(configured(PlannerConfig, {**_PLANNER, **planner})))


def start_of(plant: VelocityPlant) -> RobotState:
    """Return the state that a plant is in."""
    return RobotState(
        plant.pose[:3].copy(),
        plant.pose[3:].copy(),
        plant.q.copy(),
        plant.expected_momenta[:3].copy(),
        plant.expected_momenta[3:].copy(),
    )
