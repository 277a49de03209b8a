"""Commands that fly: run, up, goal, request, scenarios."""

from __future__ import annotations

import math
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spacerobot_ros.cli.options import (
    LAWS,
    METHODS,
    GoalCommand,
    GoalOptions,
    NumberRange,
    attitude_options,
    bag_option,
    complete_scenario,
    end_effector_goals,
    end_effector_options,
    goal_options,
    json_option,
    registered_option,
    report_option,
    settings_option,
    view_option,
    viewer_if_requested,
    write_json,
)
from spacerobot_ros.cli.terminal import display, exit_if_terminated, fail, say
from spacerobot_ros.errors import counted, numbers, quantity
from spacerobot_ros.termination import termination
from spacerobot_ros.topics import Request

if TYPE_CHECKING:
    from spacerobot_ros.scenario import Scenario


@click.command("run", cls=GoalCommand)
@click.argument("scenario", metavar="SCENARIO|ROBOT", shell_complete=complete_scenario)
@goal_options
@registered_option(
    "--method", registries=(METHODS, LAWS), help="Gait method or control law [as in the scenario]."
)
@settings_option
@bag_option("Bag to write [out/SCENARIO.mcap, or the next free name].")
@json_option("Write the result as JSON.")
@report_option("Write a report with pictures and a 3D view (HTML).")
@click.option(
    "--realtime",
    is_flag=False,
    flag_value=1.0,
    type=NumberRange(min=0.0, min_open=True),
    metavar="[FACTOR]",
    help="Fly with the nodes on the wall clock, at FACTOR times real time (1 if FACTOR is "
    "omitted).",
)
@click.option(
    "--longest",
    type=NumberRange(min=0.0, min_open=True),
    default=math.inf,
    metavar="SECONDS",
    help="Simulated time after which the flight is interrupted.",
)
@click.option(
    "--nodes",
    "--processes",
    "nodes",
    is_flag=True,
    help="Fly with the ROS 2 nodes, one process each.",
)
@view_option
def run_command(
    scenario: str,
    goal: GoalOptions,
    method: str | None,
    settings: tuple[str, ...],
    bag: Path | None,
    json_file: Path | None,
    report: Path | None,
    realtime: float | None,
    longest: float,
    nodes: bool,
    view: bool,
) -> None:
    """Fly a SCENARIO or a ROBOT to its goal, and record a bag.

    A SCENARIO is a name or a parameter file; a ROBOT is a name or a URDF file. The flight needs ROS
    2 only with --nodes or --realtime. In lockstep, nodes do not change the states or commands.

    Exit code 0: the goal was reached within tolerance; 1: it was not; 2: bad input. A signal ends
    the flight early: the bag and the summary cover the flight up to that time, and the exit code is
    128 plus the signal number (130 after Ctrl-C).
    """
    from spacerobot_ros.scenario import scenario_or_robot

    chosen = goal(scenario_or_robot(scenario))
    if method is not None:
        chosen = chosen.with_method(method)
    if realtime is not None:
        chosen = chosen.in_real_time(realtime)
    chosen = chosen.with_settings(settings)
    chosen.require_goal()
    from spacerobot_ros.bag import free_name
    from spacerobot_ros.bag.reader import bag_files
    from spacerobot_ros.session.run import run_scenario

    if view and realtime is None:
        raise click.UsageError("--view needs --realtime: a lockstep flight ends too soon.")
    usual = bag or Path("out") / f"{chosen.name}.mcap"
    free = free_name(usual)
    page = viewer_if_requested(view, chosen.parameters("viewer"), settings=settings)
    with page, display(chosen.name) as shown:
        by_nodes = nodes or realtime is not None
        result = run_scenario(chosen, bag or free, shown.fly, nodes=by_nodes, longest=longest)
    path = Path(result.summary["bag"])
    refused = result.summary["state"] == "refused" and not result.summary["ticks"]
    if refused and bag is None and report is None:
        # No one has requested a recording of a robot that did not move.
        for file in bag_files(path):
            file.unlink(missing_ok=True)
        result.summary["bag"] = None
    if json_file is not None:
        write_json(json_file, result.summary)
    if refused:
        if report is not None:
            _write_report(path, report)
        fail(result.message)
    verdict, *lines = _summary_lines(result.summary)
    published = _published_lines(chosen, result.summary)
    for line in (verdict, *_fault_lines(chosen, result.summary), *lines, *published):
        say(line)
    if usual not in (free, path):
        say(f"            {usual} contains an earlier flight and is kept")
    words = ["spacerobot", "report", str(path)]
    if report is None:
        say(f"next        `{shlex.join(words)}` draws this flight")
    elif termination() is not None:
        words += ["--out", str(report)]
        say(f"report      none for an interrupted flight: `{shlex.join(words)}` makes one")
    exit_if_terminated()
    if report is not None:
        _write_report(path, report)
    if not result.succeeded:
        fail()


def _write_report(bag: Path, html: Path) -> None:
    from spacerobot_ros.report import write_report

    write_report(bag, html)
    say(f"report      {html}")


def _summary_lines(summary: dict[str, Any]) -> list[str]:
    position, attitude = summary["position_error_m"], summary["attitude_error_rad"]
    beside = turned = ""
    if position is not None and attitude is not None:
        beside = f", {quantity(position, 'm')} from the goal{_judged(summary, 'position', 'm')}"
        turned = (
            f", {quantity(attitude, 'rad')} = {math.degrees(attitude):.3f} deg from the goal"
            f"{_judged(summary, 'attitude', 'rad')}"
        )
    used, expected = summary.get("propellant_kg"), summary.get("planned_propellant_kg")
    of_plan = "" if expected is None else f" (planned {max(0.0, 1e3 * expected):.1f} g)"
    # The angles of wheels are meaningless.
    joints = zip(summary["joint_names"], summary["final_joint_positions"], strict=True)
    shape = [position for name, position in joints if name not in summary["wheel_names"]]
    drift = "not explained by thrusters:" if summary["has_thrust"] else "changed by"
    took, factor = summary["plan_time_s"], summary["real_time_factor"]
    # A controller in a separate process does not report its planning time.
    planned = f", planned in {took:.3f} s" if took else ""
    pace = f"{factor:.0f}" if factor >= 10 else f"{factor:.2g}"
    return [
        f"{summary['scenario']}, {summary['method']}: {summary['verdict']}",
        f"position    ({numbers(summary['final_position_m'])}) m{beside}",
        f"attitude    ({numbers(summary['final_attitude_rotvec_rad'])}) rad{turned}",
        *_end_effector_line(summary),
        *([f"shape       ({numbers(shape)})"] if shape else []),
        f"manoeuvre   {summary['manoeuvre_time_s']:.6g} s, "
        f"{counted(summary['corrections'], 'correction')}{planned}",
        f"flight      {summary['ticks']} ticks in {summary['wall_time_s']:.2f} s: "
        f"{summary['ticks_per_s']:.0f} ticks/s, {pace} times real time",
        f"momentum    {drift} {quantity(summary['linear_momentum_drift'], 'kg m/s')} and "
        f"{quantity(summary['angular_momentum_drift'], 'kg m^2/s')}",
        *([] if used is None else [f"propellant  {1e3 * used:.1f} g{of_plan}"]),
        *_capture_line(summary),
        *_clearance_line(summary),
        f"bag         {summary['bag']} ({summary['messages_recorded']} messages)",
    ]


def _fault_lines(scenario: Scenario, summary: dict[str, Any]) -> list[str]:
    """Return the faults and disturbances that the scenario injects, and what detected a fault."""
    from spacerobot_ros.simulation.faults import with_seconds

    plant = scenario.plant
    lines = [f"fault       {with_seconds(each)}" for each in plant.faults]
    if found := summary.get("detection"):
        line = f"detected    by {found['node']} at {found['time_s']:.6g} s: {found['message']}"
        lines.append(line)
    return [*lines, *(f"disturbance {with_seconds(each)}" for each in plant.disturbances)]


def _judged(summary: dict[str, Any], part: str, unit: str) -> str:
    """Return, in brackets, the tolerance of an error, or that the part is not controlled."""
    if part in summary["not_controlled"]:
        return " (not controlled)"
    tolerance = summary[f"{part}_tolerance_{unit}"]
    return "" if tolerance is None else f" (tolerance {quantity(tolerance, unit)})"


def _end_effector_line(summary: dict[str, Any]) -> list[str]:
    if "end_effectors" in summary:
        return [
            f"{link}: "
            + _end_effector_errors(summary, each["position_error_m"], each["attitude_error_rad"])
            for link, each in summary["end_effectors"].items()
        ]
    if "end_effector_position_error_m" not in summary:
        return []
    position = numbers(summary["end_effector_final_position_m"])
    distance = summary["end_effector_position_error_m"]
    errors = _end_effector_errors(summary, distance, summary.get("end_effector_attitude_error_rad"))
    return [f"end-effector ({position}) m, {errors}"]


def _end_effector_errors(summary: dict[str, Any], distance: float, angle: float | None) -> str:
    """Return the errors of an end-effector with their tolerances; None: its attitude is free."""
    error, limit = quantity(distance, "m"), summary["position_tolerance_m"]
    limits = "" if limit is None else quantity(limit, "m")
    if angle is not None:
        error += f" and {quantity(angle, 'rad')}"
        limits += f", {quantity(summary['attitude_tolerance_rad'], 'rad')}" if limits else ""
    return f"{error} from its goal" + (limits and f" (tolerance {limits})")


def _capture_line(summary: dict[str, Any]) -> list[str]:
    if "capture" not in summary:
        return []
    capture = summary["capture"]
    if capture["captured"]:
        done = f"at {capture['time_s']:.6g} s"
        if "planned_momentum_Nms" in capture:
            done += f", planned to leave {capture['planned_momentum_Nms']:.3g} N m s"
        return [f"capture     {done}"]
    missed = "the target is not captured"
    if "nearest_m" in capture:
        nearest, limit = capture["nearest_m"], quantity(capture["distance_limit_m"], "m")
        beyond = f"'capture.distance' is {limit}"
        if nearest <= capture["distance_limit_m"]:
            beyond = "its angle, speed or rate exceeded the limits in 'capture'"
        missed += (
            f": its grapple frame came within {quantity(nearest, 'm')} of the end-effector at "
            f"{capture['nearest_time_s']:.6g} s, and {beyond}"
        )
    return [f"capture     {missed}"]


def _clearance_line(summary: dict[str, Any]) -> list[str]:
    if "clearance_m" not in summary:
        return []
    first, second = summary["clearance_links"]
    distance, time = summary["clearance_m"], summary["clearance_time_s"]
    apart = quantity(abs(distance), "m")
    fact = f"come within {apart}" if distance > 0 else f"touch, {apart} deep,"
    return [f"clearance   '{first}' and '{second}' {fact} at {time:.4g} s"]


def _published_lines(scenario: Scenario, summary: dict[str, Any]) -> list[str]:
    lines, flown = [], summary["state"] in ("reached", "reached_partly", "failed")
    for row in scenario.comparable if flown else ():
        measured = summary.get(row.quantity, summary["gait"].get(row.quantity))
        if isinstance(measured, list):
            printed, here = (f"({numbers(values, 4)})" for values in (row.printed, measured))
            lines.append(f"  {row.quantity:<26}{printed:<30}{here}")
            if row.note:
                lines.append(f"    {row.note}")
    return [f"  {'':<26}{'printed in the paper':<30}here", *lines] if lines else []


@click.command("up")
@click.argument("scenario", metavar="SCENARIO|ROBOT", shell_complete=complete_scenario)
@settings_option
@bag_option("Bag to write [none].")
@click.option(
    "--rate",
    default=1.0,
    show_default=True,
    type=NumberRange(min=0.0, min_open=True),
    help="Speed: ratio of simulated time to wall time.",
)
@click.option(
    "--nodes",
    "--processes",
    is_flag=True,
    hidden=True,
    expose_value=False,
    help="Accepted for consistency with `run`: each node always has its own process.",
)
@click.option(
    "--restarts",
    default=3,
    show_default=True,
    type=click.IntRange(min=0),
    help="Maximum restarts per minute of the planner, controller or viewer after a crash; 0: "
    "never.",
)
@click.option(
    "--namespace", default="", help="Namespace of all nodes and topics, including /clock and /tf."
)
@view_option
def up_command(
    scenario: str,
    settings: tuple[str, ...],
    bag: Path | None,
    rate: float,
    restarts: int,
    namespace: str,
    view: bool,
) -> None:
    """Keep the nodes of a SCENARIO or a ROBOT running in real time.

    A SCENARIO is a name or a parameter file; a ROBOT is a name or a URDF file. Each node is a
    process. Send goals on topics or with the command `spacerobot goal`. Ctrl-C, SIGTERM or SIGHUP
    ends the nodes.
    """
    from spacerobot_ros.scenario import scenario_or_robot

    chosen = scenario_or_robot(scenario).in_real_time(rate).with_settings(settings)
    from spacerobot_ros.session.live import run_until_stopped

    mode = "real time" if rate == 1.0 else f"{rate:g} times real time"
    shown: dict[str, Any] = {"title": f"{chosen.name}, {mode}"}
    if view and chosen.has_goal and not chosen.goal.has_path:
        from spacerobot_ros.viewer.state import goals_to_text

        shown["scenario_goals"] = goals_to_text(chosen.goal, chosen.end_effector_goal)
    parameters = {**shown, **chosen.parameters("viewer")}
    with viewer_if_requested(view, parameters, namespace, settings) as viewer:
        if viewer is not None:
            viewer.restarts = restarts
        recorded = run_until_stopped(
            chosen,
            bag,
            say,
            namespace=namespace,
            restarts=restarts,
            supervise=lambda: None if viewer is None else viewer.supervise(),
        )
    if recorded is not None:
        say(f"bag         {recorded}")


@click.command("goal", context_settings={"ignore_unknown_options": True})
@click.argument("pose", nargs=-1, type=float, metavar="X Y Z [QX QY QZ QW]")
@attitude_options
@end_effector_options
@click.option("--namespace", default="", help="Namespace of the stack.")
@click.option(
    "--timeout",
    default=0.0,
    type=NumberRange(min=0.0),
    help="Maximum wait for the result, s of wall time; 0: no limit.",
)
def goal_command(
    pose: tuple[float, ...],
    rotvec: tuple[float, float, float] | None,
    rpy_deg: tuple[float, float, float] | None,
    links: tuple[str, ...],
    positions: tuple[tuple[float, ...], ...],
    poses: tuple[tuple[float, ...], ...],
    paths: tuple[Path, ...],
    namespace: str,
    timeout: float,
) -> None:
    """Send a goal pose to a running stack, and wait for the result.

    If X Y Z is omitted, the base keeps its position; if no attitude is given, it keeps its
    attitude. With an end-effector goal, the base is free unless its pose is also given. Exit code
    0: the goal was reached; 1: it was not; 2: bad input; 130: Ctrl-C ended the command; the stack
    still pursues the goal.
    """
    hands = end_effector_goals(poses, positions, links, paths)
    turned = rotvec is not None or rpy_deg is not None
    if len(pose) not in ((0, 3, 7) if hands or turned else (3, 7)):
        raise click.UsageError("A goal is X Y Z, or X Y Z QX QY QZ QW.")
    if rotvec and rpy_deg:
        raise click.UsageError("The attitude is given twice, in radians and in degrees.")
    if hands and turned and not pose:
        raise click.UsageError(
            "With end-effector goals, give the base attitude together with the position X Y Z."
        )
    from spacerobot_ros.planning import Goal
    from spacerobot_ros.planning.core.goal import warn_of_large_angles

    if not (pose or turned):
        goal = Goal.of_end_effectors(hands)
    else:
        # NaN: the base keeps its position or attitude.
        position, quaternion = pose[:3] or [math.nan] * 3, pose[3:] or [math.nan] * 4
        if rotvec:
            warn_of_large_angles(rotvec)
            quaternion = Goal.from_rotvec([0, 0, 0], rotvec).quaternion.tolist()
        if rpy_deg:
            quaternion = Goal.from_rpy([0, 0, 0], rpy_deg).quaternion.tolist()
        goal = Goal.received(position, quaternion)
        goal = replace(goal, end_effectors=tuple(hands))
    from spacerobot_ros.measures import Outcome
    from spacerobot_ros.session.live import send_goal

    outcome = send_goal(goal, say, namespace=namespace, timeout=timeout)
    exit_if_terminated()
    if outcome is Outcome.INTERRUPTED:
        fail(f"The goal has no result after {timeout:g} s; the stack still pursues it.")
    if outcome is not Outcome.REACHED:
        fail()


@click.command("request")
@click.argument("request", metavar="REQUEST", type=click.Choice([each.value for each in Request]))
@click.option("--namespace", default="", help="Namespace of the stack.")
def request_command(request: str, namespace: str) -> None:
    """Abort, stop, rearm, pause or reset a running stack.

    \b
    abort          abandon the goal; the joints brake
    stop           joints brake, and thrusters are off until rearm
    rearm          accept commands again after a stop
    pause, resume  stop the simulated time, and continue
    reset          return to the initial state
    hold, play     pause a replay, and continue
    """
    from spacerobot_ros.session.live import send_request

    if not send_request(Request(request), say, namespace=namespace):
        fail()


@click.command("scenarios")
def scenarios_command() -> None:
    """List the scenarios that come with the package."""
    from spacerobot_ros.scenario import load_scenario, scenario_names

    for name in scenario_names():
        text = click.wrap_text(load_scenario(name).description, 80, f"{name:<26}", " " * 26)
        click.echo(text)
