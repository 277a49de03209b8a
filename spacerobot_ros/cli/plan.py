"""The command that plans without ROS."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spacerobot_ros.cli.options import (
    METHODS,
    GoalCommand,
    GoalOptions,
    complete_scenario,
    goal_options,
    json_option,
    picture_option,
    registered_option,
    settings_option,
    write_json,
)
from spacerobot_ros.cli.terminal import display, fail, say
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.files import write_output

if TYPE_CHECKING:
    from spacerobot_ros.flight.trials import PlanEvaluation, PlanningProblem


@click.command("plan", cls=GoalCommand)
@click.argument("scenario", metavar="SCENARIO|ROBOT", shell_complete=complete_scenario)
@goal_options
@registered_option("--method", registries=(METHODS,), help="Gait method [the scenario's].")
@settings_option
@json_option("Write the schedule and the predicted path as JSON.")
@picture_option("Draw the schedule and the predicted path (.png, .svg, .pdf).")
@click.option(
    "--compare", "comparing", is_flag=True, help="Plan with every method, and print a table."
)
@click.option(
    "--random",
    "count",
    type=click.IntRange(min=1),
    metavar="N",
    help="Plan for N random goals instead of one goal, and print statistics.",
)
@click.option(
    "--within",
    nargs=2,
    type=float,
    default=(0.3, 180.0),
    metavar="M DEG",
    show_default=True,
    help="With --random: largest distance (m) and angle (deg) of the goals from the start.",
)
@registered_option(
    "--beside",
    registries=(METHODS,),
    help="With --random: also plan for the goals with this method.",
)
def plan_command(
    scenario: str,
    goal: GoalOptions,
    method: str | None,
    settings: tuple[str, ...],
    json_file: Path | None,
    picture: Path | None,
    comparing: bool,
    count: int | None,
    within: tuple[float, float],
    beside: str | None,
) -> None:
    """Plan a gait for a SCENARIO or a ROBOT without ROS.

    The gait is simulated. Exit code 0: the plan ends within tolerance; 1: it does not, or the goal
    cannot be reached; 2: bad input.
    """
    from spacerobot_ros.flight.trials import (
        PlanEvaluation,
        PlanningProblem,
        compare,
        fastest,
        try_method,
    )
    from spacerobot_ros.planning.core.goal import missed_parts, reached_message
    from spacerobot_ros.planning.core.method import BEYOND_EFFORT_LIMITS
    from spacerobot_ros.planning.execution.status import describe_remaining_error
    from spacerobot_ros.scenario import scenario_or_robot
    from spacerobot_ros.scenario_files import parse_setting

    for text in settings:
        node, _, _ = parse_setting(text)
        if node not in ("plant", "planner"):
            raise ParameterError(f"'{text}' sets a parameter of {node}, which does not plan.")
    chosen = goal(scenario_or_robot(scenario).with_settings(settings))
    problem = PlanningProblem.of(chosen)
    method = method or problem.config.method
    if count is not None:
        _plan_random_goals(problem, [method] if beside is None else [method, beside], count, within)
        return
    plans: Mapping[str, PlanEvaluation | SpaceRobotError]
    with display(scenario):
        plans = compare(problem) if comparing else {method: try_method(problem, method)}
    if comparing:
        for line in comparison_lines(plans):
            say(line)
    trial = fastest(plans) if comparing and method == "auto" else plans.get(method)
    if not isinstance(trial, PlanEvaluation):
        fail()
    tolerance = problem.config.tolerance
    left = describe_remaining_error(trial.error, trial.controls, tolerance, problem.goal)
    if not comparing:
        say(f"{scenario}, {method}: {trial.duration:.6g} s; {left}")
        say(f"planned in {trial.plan_time:.3f} s")
        if problem.config.clearance:
            say(_clearance_line(problem, trial))
        beyond = [str(piece.notes.get(BEYOND_EFFORT_LIMITS, "")) for piece in trial.pieces]
        for clause in filter(None, dict.fromkeys(beyond)):
            say(f"warning     Efforts exceed limits: {clause}.")
    if json_file is not None:
        content = plan_json(problem, trial)
        if comparing:
            content["compared"] = {
                name: each.duration if isinstance(each, PlanEvaluation) else str(each)
                for name, each in plans.items()
            }
        write_json(json_file, content, indent=None)
        say(f"json        {json_file}")
    if picture is not None:
        from spacerobot_ros.report.figures import PictureFormat
        from spacerobot_ros.report.planning_figures import draw_plan

        write_output(picture, draw_plan(problem, trial, PictureFormat.of(picture)))
        say(f"picture     {picture}")
    if not trial.reached:
        stopped = trial.pieces[-1].notes.get("stopped", "")
        fail(f"The goal is not reached: the plan ends {left}. {stopped}".rstrip())
    missed = missed_parts(problem.goal, trial.error, trial.controls, tolerance)
    if missed:
        fail(reached_message(left, missed))


def _clearance_line(problem: PlanningProblem, trial: PlanEvaluation) -> str:
    from spacerobot_ros.collision import CollisionGeometry, nearest_approach
    from spacerobot_ros.planning import RobotState
    from spacerobot_ros.planning.core.prediction import BasePrediction

    robot, positions = problem.robot, trial.positions
    geometry, base = CollisionGeometry(robot.description), None
    if robot.description.world is not None:
        step = problem.config.integration_step
        start = RobotState(trial.path.position[0], trial.path.quaternion[0], positions[0])
        base = BasePrediction(robot.interpreted, problem.control_period, step).poses(
            start, positions
        )
    nearest = nearest_approach(geometry, positions, base)
    if nearest is not None:
        return f"clearance   {nearest}"
    reasons = Counter(geometry.ignored_pairs.values())
    listed = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
    return f"clearance   no link pairs are checked{listed and f' ({listed})'}"


def plan_json(problem: PlanningProblem, trial: PlanEvaluation) -> dict[str, Any]:
    """Return the content for the ``--json`` file."""
    from spacerobot_ros.model.rotations import rotvec_from_quaternion

    goal, path, hands = problem.goal, trial.path, {}
    if goal.end_effectors:
        hands["end_effectors"] = {
            each.link: {
                "goal": list(each.values),
                "position_error_m": error.distance,
                "attitude_error_rad": error.angle,
            }
            for each, error in zip(goal.end_effectors, trial.error.end_effectors, strict=True)
        }
    return {
        "scenario": problem.name,
        "method": trial.method,
        "goal": [*goal.position.tolist(), *goal.quaternion.tolist()] if goal.base else None,
        "succeeded": trial.reached,
        "manoeuvre_time_s": trial.duration,
        "plan_time_s": trial.plan_time,
        "final_position_m": trial.pose[:3].tolist(),
        "final_attitude_rotvec_rad": rotvec_from_quaternion(trial.pose[3:]).tolist(),
        "final_joint_positions": trial.positions[-1].tolist(),
        "position_error_m": trial.error.distance if "position" in goal.base else None,
        "attitude_error_rad": trial.error.angle if "attitude" in goal.base else None,
        **hands,
        "notes": trial.pieces[-1].notes,
        "schedule": {
            "tick_period_s": problem.control_period,
            "joint_names": list(problem.robot.joint_names),
            "positions": trial.positions.tolist(),
        },
        "path": {
            "time_s": path.time.tolist(),
            "position_m": path.position.tolist(),
            "quaternion": path.quaternion.tolist(),
        },
    }


def comparison_lines(plans: Mapping[str, PlanEvaluation | SpaceRobotError]) -> Iterator[str]:
    """Yield the lines of a table of plans by method; errors in components that a method does not
    control are in brackets.
    """
    yield f"{'method':<14}{'manoeuvre':>12}{'planned in':>12}{'attitude':>14}{'position':>14}"
    yield f"{'':<14}{'s':>12}{'s':>12}{'rad off':>14}{'m off':>14}"
    for name, trial in plans.items():
        if isinstance(trial, SpaceRobotError):
            yield f"{name:<14}{trial}"
            continue
        angle, distance = (
            f"{error:.3g}" if part in trial.controls else f"({error:.3g})"
            for part, error in (("attitude", trial.error.angle), ("position", trial.error.distance))
        )
        times = f"{trial.duration:>12.6g}{trial.plan_time:>12.3f}"
        yield f"{name:<14}{times}{angle:>14}{distance:>14}"


def _plan_random_goals(
    problem: PlanningProblem, methods: list[str], count: int, within: tuple[float, float]
) -> None:
    import numpy as np

    from spacerobot_ros.flight.trials import PlanEvaluation, random_goals, try_goals

    goals = random_goals(problem, count, within[0], math.radians(within[1]))
    show = partial(say, err=True) if sys.stderr.isatty() else lambda line: None
    results = try_goals(problem, goals, methods, show)
    flown = {
        name: [each for each in found if isinstance(each, PlanEvaluation)]
        for name, found in results.items()
    }
    say(
        f"{'method':<14}{'goals':>7}{'met':>7}{'missed':>8}{'refused':>9}{'shortest':>10}"
        f"{'median':>10}{'longest':>10}{'planned in':>11}{'at most':>9}"
    )
    for name, trials in flown.items():
        reached, goals_tried = sum(each.reached for each in trials), len(results[name])
        missed, refused = len(trials) - reached, goals_tried - len(trials)
        row = f"{name:<14}{goals_tried:>7}{reached:>7}{missed:>8}{refused:>9}"
        if trials:
            low, middle, high = np.quantile([each.duration for each in trials], [0.0, 0.5, 1.0])
            planned, longest = np.quantile([each.plan_time for each in trials], [0.5, 1.0])
            row += f"{low:>10.4g}{middle:>10.4g}{high:>10.4g}{planned:>11.3g}{longest:>9.3g}"
        say(row)
    for name, found in results.items():
        for reason in dict.fromkeys(str(each) for each in found if isinstance(each, Exception)):
            say(f"{name} refused: {reason}")
    if not all(each.reached for each in flown[methods[0]]):
        fail()
