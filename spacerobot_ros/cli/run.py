"""The command ``spacerobot run``."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spacerobot_ros.cli.errors import end_if_requested, fail
from spacerobot_ros.cli.options import (
    LAWS,
    METHODS,
    PATH,
    GoalOptions,
    Registered,
    goal_options,
    json_option,
    numbers,
    settings_option,
    view_option,
    viewing_if,
    write_json,
)
from spacerobot_ros.cli.progress import display
from spacerobot_ros.termination import termination

if TYPE_CHECKING:
    from spacerobot_ros.flight.scenario import Scenario


@click.command("run")
@click.argument("scenario", metavar="SCENARIO|ROBOT")
@goal_options
@click.option(
    "--method", type=Registered(METHODS, LAWS), help="Gait method or control law [the scenario's]."
)
@settings_option
@click.option("--bag", type=PATH, help="Bag to write [out/SCENARIO.mcap, or the next free name].")
@json_option("Write the result as JSON.")
@click.option("--report", type=PATH, help="Write a report with pictures and a 3D view (HTML).")
@click.option(
    "--realtime",
    is_flag=False,
    flag_value=1.0,
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="[FACTOR]",
    help="Run on the wall clock, FACTOR times as fast (1 without a number).",
)
@click.option(
    "--longest",
    type=click.FloatRange(min=0.0, min_open=True),
    default=math.inf,
    metavar="SECONDS",
    help="Simulated time after which the flight is interrupted.",
)
@click.option("--processes", is_flag=True, help="Give each node a process of its own.")
@view_option
def command(
    scenario: str,
    goal: GoalOptions,
    method: str | None,
    settings: tuple[str, ...],
    bag: Path | None,
    json_file: Path | None,
    report: Path | None,
    realtime: float | None,
    longest: float,
    processes: bool,
    view: bool,
) -> None:
    """Fly a SCENARIO or a ROBOT to its goal, and record a bag.

    A SCENARIO is a name or a parameter file, a ROBOT a name or a URDF file.

    Exit code 0: the goal was reached within tolerance; 1: it was not; 2: bad input. A signal ends
    the flight early: the bag and the summary cover it until then, and the exit code is 128 plus the
    number of the signal, 130 after Ctrl-C.
    """
    chosen = _chosen(scenario, goal, method, settings, realtime)
    from spacerobot_ros.bag import free_name
    from spacerobot_ros.session.run import run_scenario

    if view and realtime is None:
        raise click.UsageError("--view needs --realtime: what is flown in lockstep is over soon.")
    path = bag or free_name(Path("out") / f"{chosen.name}.mcap")
    with viewing_if(view, chosen.parameters("viewer")), display(chosen.name) as shown:
        result = run_scenario(chosen, path, shown.fly, processes=processes, longest=longest)
    path = Path(result.summary["bag"])
    if json_file is not None:
        write_json(json_file, result.summary)
    for line in (*_summary_lines(result.summary), *_published_lines(chosen, result.summary)):
        click.echo(line)
    if report is not None and termination() is not None:
        words = shlex.join(["spacerobot", "report", str(path), "--output", str(report)])
        click.echo(f"report      none of what was interrupted: `{words}` makes one")
    end_if_requested()
    if report is not None:
        from spacerobot_ros.report import write_report

        write_report(path, report)
        click.echo(f"report      {report}")
    if not result.succeeded:
        fail(result.sentence)


def _chosen(
    name: str,
    goal: GoalOptions,
    method: str | None,
    settings: tuple[str, ...],
    realtime: float | None,
) -> Scenario:
    """Return the scenario with what the command line changes."""
    from spacerobot_ros.flight.scenario import scenario_or_robot

    scenario = goal.of(scenario_or_robot(name))
    scenario.require_goal()
    if realtime is not None:
        scenario = scenario.in_real_time(realtime)
    scenario = scenario.with_settings(settings)
    return scenario if method is None else scenario.with_method(method)


def _summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return the result as lines for people."""
    degrees = math.degrees(summary["attitude_error_rad"])
    return [
        f"{summary['scenario']}, {summary['method']}: {summary['message']}",
        f"position    ({numbers(summary['final_position_m'])}) m, "
        f"{summary['position_error_m']:.3g} m from the goal",
        f"attitude    ({numbers(summary['final_attitude_rotvec_rad'])}) rad, "
        f"{summary['attitude_error_rad']:.3g} rad = {degrees:.3g} deg from the goal",
        *_end_effector_line(summary),
        f"shape       ({numbers(summary['final_joint_positions'])})",
        f"manoeuvre   {summary['manoeuvre_time_s']:.6g} s, "
        f"{summary['corrections']} correction(s), planned in {summary['plan_time_s']:.3f} s",
        f"flight      {summary['ticks']} ticks in {summary['wall_time_s']:.2f} s: "
        f"{summary['ticks_per_s']:.0f} ticks/s, {summary['real_time_factor']:.0f} times real time",
        f"momentum    changed by at most {summary['linear_momentum_drift']:.1e} kg m/s and "
        f"{summary['angular_momentum_drift']:.1e} kg m^2/s",
        *_propellant_line(summary),
        f"bag         {summary['bag']} ({summary['messages_recorded']} messages)",
    ]


def _end_effector_line(summary: dict[str, Any]) -> list[str]:
    if "end_effector_position_error_m" not in summary:
        return []
    position = numbers(summary["end_effector_final_position_m"])
    error = summary["end_effector_position_error_m"]
    return [f"end-effector ({position}) m, {error:.3g} m from its goal"]


def _propellant_line(summary: dict[str, Any]) -> list[str]:
    used = summary.get("propellant_kg")
    return [] if used is None else [f"propellant  {1e3 * used:.1f} g"]


def _published_lines(scenario: Scenario, summary: dict[str, Any]) -> list[str]:
    """Return lines with the published figures beside the measured ones."""
    lines = []
    for row in scenario.comparable if summary["state"] in ("reached", "failed") else ():
        measured = summary.get(row.quantity, summary["gait"].get(row.quantity))
        if isinstance(measured, list):
            printed, found = (f"({numbers(values, 4)})" for values in (row.printed, measured))
            lines.append(f"  {row.quantity:<26}{printed:<30}{found}")
            if row.note:
                lines.append(f"    {row.note}")
    return [f"  {'':<26}{'printed in the paper':<30}here", *lines] if lines else []
