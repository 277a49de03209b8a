"""The command ``spacerobot``."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from spacerobot_ros import __version__
from spacerobot_ros.cli.analyze import analyze
from spacerobot_ros.cli.bags import replay, salvage, verify
from spacerobot_ros.cli.errors import GOAL_NOT_REACHED, sentences
from spacerobot_ros.cli.live import goal as goal_command
from spacerobot_ros.cli.live import up
from spacerobot_ros.cli.options import (
    changed_goal,
    pose_option,
    rotvec_option,
    settings_option,
)
from spacerobot_ros.cli.plan import plan
from spacerobot_ros.control import LAWS
from spacerobot_ros.planning import METHODS
from spacerobot_ros.session.scenario import Scenario, load_scenario, scenario_names


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="spacerobot")
def main() -> None:
    """Fly free-floating space robots: plan gaits, run them through ROS 2, record and report."""


main.add_command(analyze)
main.add_command(goal_command)
main.add_command(plan)
main.add_command(replay)
main.add_command(up)
main.add_command(salvage)
main.add_command(verify)


@main.command()
@click.argument("scenario")
@pose_option
@rotvec_option
@click.option(
    "--method", type=click.Choice(sorted({*METHODS, *LAWS})), help="Gait method, or control law."
)
@settings_option
@click.option("--bag", type=click.Path(path_type=Path), help="Bag to write [out/SCENARIO.mcap].")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the result.")
@click.option("--report", type=click.Path(path_type=Path), help="Write a picture report (HTML).")
@click.option(
    "--realtime",
    is_flag=False,
    flag_value=1.0,
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="[FACTOR]",
    help="Run on the wall clock, FACTOR times as fast.",
)
@click.option("--processes", is_flag=True, help="Give each node a process of its own.")
@sentences
def run(
    scenario: str,
    goal: tuple[float, ...] | None,
    goal_rotvec: tuple[float, ...] | None,
    method: str | None,
    settings: tuple[str, ...],
    bag: Path | None,
    json_file: Path | None,
    report: Path | None,
    realtime: float | None,
    processes: bool,
) -> None:
    """Fly SCENARIO (a name or a parameter file) to its goal and record it.

    Exit code 0: the goal was reached within tolerance; 1: it was not; 2: bad input.
    """
    chosen = _chosen(scenario, goal, goal_rotvec, method, settings, realtime)
    path = bag or Path("out") / f"{chosen.name}.mcap"
    from spacerobot_ros.session.run import run_scenario

    with _progress(chosen.name) as progress:
        result = run_scenario(chosen, path, progress, processes=processes)
    if json_file is not None:
        result.write_json(json_file)
    for line in (*_summary_lines(result.summary), *_published_lines(chosen, result.summary)):
        click.echo(line)
    if report is not None:
        from spacerobot_ros.report import write_report

        write_report(path, report)
        click.echo(f"report      {report}")
    if not result.succeeded:
        click.echo(result.sentence, err=True)
        sys.exit(GOAL_NOT_REACHED)


@main.command()
def scenarios() -> None:
    """List the scenarios that come with the package."""
    for name in scenario_names():
        click.echo(f"{name:<22}{load_scenario(name).description}")


@main.command("report")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--output", "-o", type=click.Path(path_type=Path), help="HTML file [beside the bag].")
@click.option("--picture", type=click.Path(path_type=Path), help="Also draw an overview (PNG).")
@click.option(
    "--beside",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="BAG",
    help="Another run to compare with: a row of numbers and its path. May be repeated.",
)
@sentences
def report_command(
    bag: Path, output: Path | None, picture: Path | None, beside: tuple[Path, ...]
) -> None:
    """Make a picture report of a BAG."""
    from spacerobot_ros.report import write_picture, write_report

    target = output or bag.with_suffix(".html")
    write_report(bag, target, beside)
    click.echo(f"report      {target}")
    if picture is not None:
        write_picture(bag, picture)
        click.echo(f"picture     {picture}")


@main.command()
@click.option("--ticks", default=20_000, show_default=True, type=click.IntRange(min=100))
@click.option(
    "--real-time",
    "seconds",
    type=click.FloatRange(min=5.0),
    metavar="S",
    help="Instead: fly for S s in real time, in separate processes; deadlines, losses, memory.",
)
@click.option(
    "--rate",
    "rates",
    multiple=True,
    type=click.FloatRange(min=1.0, max=1e4),
    metavar="HZ",
    help="... with so many commands a second. May be repeated.  [default: 100]",
)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures.")
@sentences
def bench(
    ticks: int, seconds: float | None, rates: tuple[float, ...], json_file: Path | None
) -> None:
    """Measure the speed of the stack against a bare ping-pong in the same run."""
    from spacerobot_ros.benchmarks import bench, real_time

    if seconds is None:
        lines = bench.run_benchmark(ticks, json_file)
    else:
        lines = real_time.run_benchmark(seconds, rates or (100.0,), json_file)
    for line in lines:
        click.echo(line)


def _chosen(
    name: str,
    goal: tuple[float, ...] | None,
    goal_rotvec: tuple[float, ...] | None,
    method: str | None,
    settings: tuple[str, ...],
    realtime: float | None,
) -> Scenario:
    """Return the scenario with what the command line changes."""
    scenario = load_scenario(name)
    if goal is not None or goal_rotvec is not None:
        # Published figures belong to the published goal.
        other = changed_goal(scenario.goal, goal, goal_rotvec)
        scenario = replace(scenario, goal=other, published=())
    if realtime is not None:
        scenario = scenario.in_real_time(realtime)
    scenario = scenario.with_settings(settings)
    if method is not None:
        node, parameter = (
            ("planner", "method") if method in METHODS else ("coordinated_control", "law")
        )
        scenario = scenario.with_overrides(node, {parameter: method})
    return scenario


@contextmanager
def _progress(label: str) -> Iterator[Callable[[float, float], None]]:
    """Show simulated time against the end of the schedule, where somebody is looking."""
    with click.progressbar(
        length=1000, label=label, file=sys.stderr, hidden=not sys.stderr.isatty()
    ) as bar:

        def show(now: float, end: float) -> None:
            share = min(now / end, 1.0) if end > 0 else 0.0
            bar.update(max(0, int(1000 * share) - bar.pos))

        yield show


def _summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return the result as lines for people."""

    def numbers(values: list[float], digits: int = 5) -> str:
        return ", ".join(f"{x:.{digits}f}" for x in values)

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
    position = ", ".join(f"{x:.5f}" for x in summary["end_effector_final_position_m"])
    error = summary["end_effector_position_error_m"]
    return [f"end-effector ({position}) m, {error:.3g} m from its goal"]


def _propellant_line(summary: dict[str, Any]) -> list[str]:
    used = summary.get("propellant_kg")
    return [] if used is None else [f"propellant  {1e3 * used:.1f} g"]


def _published_lines(scenario: Scenario, summary: dict[str, Any]) -> list[str]:
    """Return what a publication prints beside what was measured."""
    lines = []
    for row in scenario.comparable if summary["state"] in ("reached", "failed") else ():
        measured = summary.get(row.quantity, summary["gait"].get(row.quantity))
        if isinstance(measured, list):
            printed, found = (
                "(" + ", ".join(f"{x:.4f}" for x in values) + ")"
                for values in (row.printed, measured)
            )
            lines.append(f"  {row.quantity:<26}{printed:<30}{found}")
            if row.note:
                lines.append(f"    {row.note}")
    return [f"  {'':<26}{'printed in the paper':<30}here", *lines] if lines else []


if __name__ == "__main__":
    main()
