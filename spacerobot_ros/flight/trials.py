"""Evaluates plans in the plant without ROS: the plans of all methods for one goal, or plans for
random goals."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.errors import ParameterError, PlanningError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec, quaternion_multiply
from spacerobot_ros.planning import (
    METHODS,
    BasePath,
    GaitMethod,
    GaitSchedule,
    Goal,
    PlanRequest,
    PoseError,
    RobotState,
    build_method,
)
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import Controlled
from spacerobot_ros.planning.core.progress import PieceProgress, log_progress
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.optimal.goal_specification import BaseRotations
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.simulation.plant import InitialState
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

_LOG = logging.getLogger(__name__)

_MAX_SCHEDULES = 1000

_RANDOM_GOAL_TOLERANCE = 1e-5  # rad and m


@dataclass(frozen=True)
class PlanningProblem:
    """A planning problem.

    Attributes
    ----------
    name
        Name of the scenario or robot.
    robot, initial
        The model and its initial state.
    goal
        The goal.
    config
        Planner parameters: control period, tolerance, method options.
    """

    name: str
    robot: SpaceRobot
    initial: InitialState
    goal: Goal
    config: PlannerConfig

    @classmethod
    def of(cls, scenario: Scenario) -> PlanningProblem:
        """Return the planning problem for a scenario's base goal.

        Raises
        ------
        ParameterError
            The scenario has no robot, or a parameter is invalid.
        GoalError
            The goal's joint positions belong to another robot.
        """
        plant, planner = scenario.plant, scenario.planner
        name = planner.robot or plant.robot
        if not name:
            raise ParameterError(f"The scenario '{scenario.name}' has no robot; see plant.robot.")
        described = planner.described(plant.described(load_robot(robot_file(name))))
        robot = SpaceRobot(described)
        scenario.require_shape_of(robot)
        goal = scenario.goal.for_robot(robot.description)
        return cls(scenario.name, robot, InitialState.of(plant), goal, planner)

    @property
    def control_period(self) -> float:
        """Duration for which a command is held, s."""
        return self.config.control_period

    def method(self, name: str) -> GaitMethod:
        """Build a gait method with its options."""
        clearance = Clearance.wanted(self.robot.description, self.config.clearance)
        times = self.control_period, self.config.integration_step
        return build_method(name, self.robot, *times, self.config.method_options, clearance)

    def plant(self) -> VelocityPlant:
        """Return the plant in the initial state."""
        step = self.config.integration_step
        # A plan has too few ticks to be worth the compilation of the plant.
        return VelocityPlant(self.robot.interpreted, self.control_period, self.initial, step)


@dataclass(frozen=True)
class PlanEvaluation:
    """A method's plan for a problem, and its flight result in the plant.

    Attributes
    ----------
    method
        Name of the gait method.
    pieces
        Successive schedules; only one, unless the method plans in stages.
    error
        Final error in ``pose`` and in the joint positions.
    pose
        (7,) final base pose in W: position (m) and quaternion.
    plan_time
        Planning wall time, s.
    reached
        Whether the goal was reached within the planner's tolerance.
    controls
        The goal components that the schedules control.
    """

    method: str
    pieces: Sequence[GaitSchedule]
    error: PoseError
    pose: Array
    plan_time: float
    reached: bool
    controls: frozenset[Controlled]

    @property
    def duration(self) -> float:
        """Duration of the manoeuvre, s."""
        return sum(piece.duration for piece in self.pieces)

    @property
    def positions(self) -> Array:
        """(N + 1, n) joint positions at the ticks, m or rad."""
        first, *later = (piece.positions for piece in self.pieces)
        return np.vstack([first, *(positions[1:] for positions in later)])

    @property
    def path(self) -> BasePath:
        """The predicted base path, with times from the start of the first schedule."""
        paths = [piece.path for piece in self.pieces]
        starts = np.cumsum([0.0, *(piece.duration for piece in self.pieces[:-1])])
        return BasePath(
            np.concatenate([t + path.time for t, path in zip(starts, paths, strict=True)]),
            np.vstack([path.position for path in paths]),
            np.vstack([path.quaternion for path in paths]),
        )


def robot_state_of(plant: VelocityPlant) -> RobotState:
    """Return a plant's state."""
    pose, momenta = plant.pose.copy(), plant.expected_momenta.copy()
    return RobotState(pose[:3], pose[3:], plant.q.copy(), momenta[:3], momenta[3:])


def try_method(
    problem: PlanningProblem, name: str, method: GaitMethod | None = None
) -> PlanEvaluation:
    """Plan with the named method (or the given ``method``) and fly the schedule in the plant.

    Raises
    ------
    PlanningError
        The method rejects the goal.
    ParameterError
        An option is invalid for the robot.
    """
    plant, tolerance = problem.plant(), problem.config.tolerance
    pieces: list[GaitSchedule] = []
    began = time.perf_counter()
    method = method or problem.method(name)
    plan_time = time.perf_counter() - began
    while not pieces or (pieces[-1].partial and len(pieces) < _MAX_SCHEDULES):
        began = time.perf_counter()
        previous = pieces[-1] if pieces else None
        wanted = robot_state_of(plant), problem.goal, tolerance
        corrects = previous is not None
        schedule = method.plan(PlanRequest(*wanted, correction=corrects, previous=previous))
        plan_time += time.perf_counter() - began
        for rates in schedule.velocities:
            plant.step(rates)
        pieces.append(schedule)
        if schedule.partial:
            planned = sum(piece.duration for piece in pieces)
            total = planned + schedule.remaining
            progress = PieceProgress(len(pieces), 0, planned, elapsed_s=plan_time, total_s=total)
            log_progress(_LOG, progress, progress.message)
        pose = plant.pose
        error = PoseError.between(pose[:3], pose[3:], problem.goal, plant.q, plant.robot)
        reached = tolerance.admits(error, schedule.controls)
        if reached:
            break
    controls = schedule.controls
    return PlanEvaluation(name, pieces, error, plant.pose.copy(), plan_time, reached, controls)


def compare(problem: PlanningProblem) -> dict[str, PlanEvaluation | SpaceRobotError]:
    """Return every method's evaluation, or the reason for its rejection, by name.

    Methods for end-effector goals only are omitted for base goals.
    """
    found: dict[str, PlanEvaluation | SpaceRobotError] = {}
    for name, method in METHODS.items():
        if name == "auto":
            continue  # The method `auto` only chooses among the other methods.
        if not (method.plans_for_base or problem.goal.end_effectors):
            continue
        try:
            method.require_suitable(problem.robot)
            found[name] = try_method(problem, name)
        except (ParameterError, PlanningError) as refusal:
            found[name] = refusal
    return found


def fastest(plans: Mapping[str, PlanEvaluation | SpaceRobotError]) -> PlanEvaluation | None:
    """Return the shortest plan that ends within tolerance; None if there is no such plan."""
    reached = [each for each in plans.values() if isinstance(each, PlanEvaluation) and each.reached]
    return min(reached, key=lambda plan: plan.duration, default=None)


def random_goals(problem: PlanningProblem, count: int, distance: float, angle: float) -> list[Goal]:
    """Return random goals within ``distance`` (m) and ``angle`` (rad) of the start, with a fixed
    seed.

    Rotation axes are uniformly distributed; planar robots rotate about their axis.

    Raises
    ------
    ParameterError
        A bound is negative or not finite.
    """
    if not (0.0 <= distance < math.inf and 0.0 <= angle < math.inf):
        raise ParameterError(
            f"Random goals lie within {distance:g} m and {math.degrees(angle):g} deg of the "
            "start; both bounds must be finite and not negative."
        )
    rng = np.random.default_rng(0)
    start = problem.plant().pose
    axes = BaseRotations.of(problem.robot).axes
    goals = []
    for _ in range(count):
        offset = rng.normal(size=3)
        offset *= distance * rng.uniform() ** (1 / 3) / np.linalg.norm(offset)
        axis = rng.normal(size=3)
        if len(axes) == 1:
            axis = axes[0] * math.copysign(1.0, axis[0])
        turn = rng.uniform(0.0, angle) * axis / np.linalg.norm(axis)
        attitude = quaternion_multiply(start[3:], quaternion_from_rotvec(turn))
        goals.append(replace(problem.goal, position=start[:3] + offset, quaternion=attitude))
    return goals


def try_goals(
    problem: PlanningProblem,
    goals: Sequence[Goal],
    methods: Sequence[str],
    show: Callable[[str], None] = lambda line: None,
) -> dict[str, list[PlanEvaluation | PlanningError]]:
    """Plan every goal with every method, and return the results by method, in goal order.

    ``show`` is called with one line of text for each result.
    """
    tight = replace(
        problem.config,
        position_tolerance=_RANDOM_GOAL_TOLERANCE,
        attitude_tolerance=_RANDOM_GOAL_TOLERANCE,
        joint_tolerance=_RANDOM_GOAL_TOLERANCE,
    )
    problem = replace(problem, config=tight)
    built = {name: problem.method(name) for name in methods}
    results: dict[str, list[PlanEvaluation | PlanningError]] = {name: [] for name in methods}
    for number, goal in enumerate(goals, 1):
        for name, found in results.items():
            try:
                trial = try_method(replace(problem, goal=goal), name, built[name])
                off = f"{trial.error.angle:.2g} rad and {trial.error.distance:.2g} m off"
                text = f"{trial.duration:.6g} s, {off}"
                found.append(trial)
            except PlanningError as refusal:
                found.append(refusal)
                text = str(refusal)
            show(f"goal {number}, {name}: {text}")
    return results
