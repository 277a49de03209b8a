"""Commands for robots: analyze, new, robots."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import click

from spacerobot_ros.cli.options import (
    complete_robot,
    json_option,
    out_option,
    picture_option,
    write_json,
)
from spacerobot_ros.cli.terminal import display, fail, say
from spacerobot_ros.errors import ParameterError, counted
from spacerobot_ros.files import write_output

if TYPE_CHECKING:
    from spacerobot_ros.model import SpaceRobot
    from spacerobot_ros.planning.analysis import Analysis
    from spacerobot_ros.planning.core.controllability import Controllability

_MAX_LISTED_JOINTS = 12
"""Maximum number of joints listed; any others are only counted."""


_MAX_LISTED_DISTANCES = 3

_MAX_LISTED_INTERVALS = 4
"""Maximum number of distance intervals listed; if there are more, only their number and length are
listed.
"""


@click.command("analyze")
@click.argument("robot", shell_complete=complete_robot)
@click.option(
    "--shape",
    metavar="'Q1 Q2 ...'",
    help="Configuration to analyse, m or rad [the one with the best condition].",
)
@click.option(
    "--end-effector",
    default="",
    metavar="LINK",
    help="Link whose workspaces are computed [end_effector].",
)
@picture_option(
    "Curvature picture (.png, .svg, .pdf) [out/ROBOT_curvature.png]. The workspace picture "
    "has _workspaces in its name."
)
@json_option("Write the findings as JSON.")
def analyze_command(
    robot: str, shape: str | None, end_effector: str, picture: Path | None, json_file: Path | None
) -> None:
    """Analyse the loops, dynamic singularities and workspaces of ROBOT.

    ROBOT is a name or a URDF file. Suitable methods are listed.
    """
    from spacerobot_ros.model import SpaceRobot
    from spacerobot_ros.planning.analysis import analyze
    from spacerobot_ros.resources import robot_file

    model = SpaceRobot.from_file(robot_file(robot))
    try:
        numbers = None if shape is None else [float(x) for x in shape.replace(",", " ").split()]
    except ValueError:
        message = f"--shape is '{shape}'; it must have one number per joint."
        raise ParameterError(message) from None
    found = analyze(model, numbers, end_effector)
    for line in (*analysis_lines(found), *_notes(model), "", *workspace_lines(found)):
        say(line)
    if json_file is not None:
        write_json(json_file, analysis_json(found))
    from spacerobot_ros.report.figures import PictureFormat
    from spacerobot_ros.report.planning_figures import draw_analysis, draw_workspaces

    name = model.description.name
    target = picture or Path("out") / f"{name}_curvature.png"
    drawn = draw_analysis(found, PictureFormat.of(target))
    if drawn is None:
        say(f"{'picture':<13}none: no loops of movable joints rotate the base")
    else:
        write_output(target, drawn)
        say(f"{'picture':<13}{target}")
    if found.workspaces:
        of_workspaces = target.with_name(
            f"{name if picture is None else target.stem}_workspaces{target.suffix}"
        )
        write_output(of_workspaces, draw_workspaces(found, PictureFormat.of(of_workspaces)))
        say(f"{'':<13}{of_workspaces}")


def analysis_lines(found: Analysis) -> list[str]:
    """Return the findings as lines that fit the screen."""
    from spacerobot_ros.planning.core.controllability import sliders_of
    from spacerobot_ros.planning.methods.registry import METHODS

    robot = found.robot
    base = robot.description.bodies[0].inertia.mass
    n, name = robot.n, robot.description.name
    lines = [
        f"{name}: {counted(n, 'joint')}, {robot.total_mass:.6g} kg, of which {base:.6g} kg for the "
        "base"
    ]
    lines += [*_joint_rows(robot), "", *_rotation_lines(found)]
    position = "follows from attitude and shape: the centre of mass is at rest"
    if found.sliding.controllable:
        count = len(sliders_of(robot))
        position = f"{count} sliders with independent slots control the base position (paper 1)"
    lines += [f"{'position':<13}{position}", ""]
    for method, objection in found.objections.items():
        suits = "yes" if METHODS[method].plans_for_base else "yes, for end-effectors"
        lines.append(f"{method:<15}{'no: ' + objection if objection else suits}")
    lines.append(f"{'auto':<15}{found.chosen or 'no method suits this robot'}")
    return [*lines, "", *_distance_lines(found)]


def _notes(robot: SpaceRobot) -> list[str]:
    from spacerobot_ros.session.own_robot import urdf_remarks

    return [f"{'note':<13}{remark}" for remark in urdf_remarks(robot.description)]


def workspace_lines(found: Analysis) -> list[str]:
    """Return the end-effector workspaces as lines that fit the screen."""
    if not found.workspaces:
        why = "the robot has no joints"
        if not found.end_effector:
            why = "no link is named 'end_effector': select one with --end-effector"
        return [f"{'workspaces':<13}none: {why}"]
    lines = []
    for each in found.workspaces:
        limits = "within joint limits" if each.within_limits else "joints turn freely"
        place = " in a plane" if each.dimensions == 2 else ""
        reach = _interval_text(each.distance_range)
        count = (
            f", from {each.singular_shapes} singular configurations" if each.singular_shapes else ""
        )
        lines += [
            f"'{each.link}', {limits}: {reach} m from the centre of mass{place}",
            f"  path-dependent    {_intervals_text(each.path_dependent)}{count}",
            f"  path-independent  {_intervals_text(each.path_independent)}",
        ]
    return [f"{'workspaces' if not i else '':<13}{line}" for i, line in enumerate(lines)]


def _interval_text(ends: tuple[float, float]) -> str:
    # Millimetres are not enough to compare with papers.
    low, high = (f"{end:.5f}".rstrip("0").rstrip(".") for end in ends)
    return low if low == high else f"{low} to {high}"


def _intervals_text(intervals: Sequence[tuple[float, float]]) -> str:
    if not intervals:
        return "none found"
    if len(intervals) > _MAX_LISTED_INTERVALS:
        total = sum(high - low for low, high in intervals)
        span = _interval_text((intervals[0][0], intervals[-1][1]))
        return f"{len(intervals)} intervals from {span} m, together {total:.3g} m"
    return " and ".join(map(_interval_text, intervals)) + " m"


def analysis_json(found: Analysis) -> dict[str, Any]:
    """Return the findings for JSON; infinite condition numbers and limits become null."""
    robot = found.robot
    finite = _finite_conditions(found)
    return {
        "robot": robot.description.name,
        "mass_kg": robot.total_mass,
        "bodies": {body.name: body.inertia.mass for body in robot.description.bodies},
        "joints": [
            {
                "name": joint.name,
                "kind": joint.kind.value,
                "lower": _finite_or_none(joint.limits.lower),
                "upper": _finite_or_none(joint.limits.upper),
                "velocity": _finite_or_none(joint.limits.velocity),
                "effort": _finite_or_none(joint.limits.effort),
            }
            for joint in robot.description.movable_joints
        ],
        "shape": found.shape.tolist(),
        "at_shape": _finding_json(found.at_shape),
        "anywhere": _finding_json(found.anywhere),
        "curvature_matrix": None if found.nominal is None else found.nominal.M.tolist(),
        "condition_over_shapes": {
            "shapes": len(found.conditions),
            "spanning": len(finite),
            "best": min(finite, default=None),
            "median": median(finite) if finite else None,
        },
        "planar": _finding_json(found.planar),
        "sliding": _finding_json(found.sliding),
        "distances": [
            {"links": list(pair), "distance_m": distance}
            for pair, distance in found.geometry.distances_of_links(found.shape).items()
        ],
        "workspaces": [
            {
                "link": each.link,
                "within_limits": each.within_limits,
                "dimensions": each.dimensions,
                "reach_m": list(each.distance_range),
                "path_dependent_m": [list(ends) for ends in each.path_dependent],
                "path_independent_m": [list(ends) for ends in each.path_independent],
                "singular_shapes": each.singular_shapes,
            }
            for each in found.workspaces
        ],
        "methods": found.objections,
        "auto": found.chosen or None,
    }


def _joint_rows(robot: SpaceRobot) -> list[str]:
    from spacerobot_ros.model.description import JointKind

    joints, bodies = robot.description.moving_joints, robot.description.bodies[1:]
    listed = joints[:_MAX_LISTED_JOINTS]
    width = max([5, *(len(joint.name) for joint in listed)])
    wide = max([15, *(len(joint.parent) for joint in listed)])
    head = (
        f"{'joint':<{width}}  {'kind':<11}{'on':<{wide}} {'limits':>19} {'speed':>11} {'effort':>9}"
    )
    rows = [f"{head}{'mass':>12}"]
    for joint, body in zip(listed, bodies, strict=False):
        unit, effort_unit = ("m", "N") if joint.kind is JointKind.PRISMATIC else ("rad", "N m")
        limits = joint.limits
        turns = unit == "rad"
        range_text = f"{limits.lower:.4g} .. {limits.upper:.4g} {unit}"
        degrees = ""
        if turns and not math.isinf(limits.lower):
            low, high = math.degrees(limits.lower), math.degrees(limits.upper)
            degrees = f"  {low:.4g} .. {high:.4g} deg"
        if turns and math.isfinite(limits.velocity):
            degrees += f"  {math.degrees(limits.velocity):.3g} deg/s"
        if math.isinf(limits.lower):
            range_text = "free"
        speed, effort = f"{limits.velocity:.3g} {unit}/s", f"{limits.effort:.4g} {effort_unit}"
        follows = joint.mimic
        rows.append(
            f"{joint.name:<{width}}  {joint.kind.value:<11}{joint.parent:<{wide}} {range_text:>19}"
            f" {speed:>11} {effort:>9}{body.inertia.mass:>9.4g} kg{degrees}"
            + (f"  follows {follows.joint}" if follows is not None else "")
        )
    if len(joints) > _MAX_LISTED_JOINTS:
        rows.append(f"and {len(joints) - _MAX_LISTED_JOINTS} more")
    return rows


def _rotation_lines(found: Analysis) -> list[str]:
    lines = [f"{'rotation':<13}{found.anywhere.message}"]
    if found.planar.controllable:
        lines = [f"{'rotation':<13}{found.planar.message}"]
    if found.nominal is not None:
        at, values = found.nominal, ", ".join(f"{x:.3g}" for x in found.nominal.singular_values)
        names = ", ".join(found.robot.joint_names[i] for i in at.joints)
        shape = ", ".join(f"{x:.4g}" for x in found.shape)
        lines += [
            f"{'at shape':<13}({shape}): rank {found.at_shape.rank}, condition {at.condition:.3g}",
            f"{'':<13}singular values ({values}) rad per unit of area, joints {names}",
        ]
        finite = _finite_conditions(found)
        lines.append(
            f"{'shape space':<13}rank 3 at {len(finite)} of {len(found.conditions)} shapes; "
            f"condition {min(finite):.3g} at best, {median(finite):.3g} in the median"
        )
    return lines


def _finding_json(found: Controllability) -> dict[str, Any]:
    return {
        "controllable": found.controllable,
        "rank": found.rank,
        "wanted": found.required_rank,
        "condition": _finite_or_none(found.condition),
        "singular_values": found.singular_values.tolist(),
        "joints": list(found.joints),
        "shape": found.shape.tolist(),
        "sentence": found.message,
    }


def _finite_conditions(found: Analysis) -> list[float]:
    return [float(x) for x in found.conditions if math.isfinite(x)]


def _finite_or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _distance_lines(found: Analysis) -> list[str]:
    geometry = found.geometry
    distances = geometry.distances_of_links(found.shape)
    lines = [f"{counted(len(distances), 'pair')} of links may touch"]
    if distances:
        distance = "a distance" if len(distances) == 1 else "distances"
        lines[0] += f", with {distance} at this shape:"
    lines += [f"  {d:.3g} m  {pair}" for pair, d in list(distances.items())[:_MAX_LISTED_DISTANCES]]
    if len(distances) > _MAX_LISTED_DISTANCES:
        lines.append(f"  and larger distances for {len(distances) - _MAX_LISTED_DISTANCES} others")
    lines += [f"not counted: {pair} ({why})" for pair, why in geometry.ignored_pairs.items()]
    lines += geometry.notes
    if not geometry.exact and distances:
        lines.append("Distances are lower bounds, because the package coal is not installed.")
    return [f"{'distances' if not i else '':<13}{line}" for i, line in enumerate(lines)]


@click.command("new")
@click.argument("robot", metavar="URDF", shell_complete=complete_robot)
@out_option("Scenario file to write [NAME.yaml].")
@click.option(
    "--nearest-inertia",
    is_flag=True,
    help="Replace unphysical inertias with the nearest physical ones in NAME_possible.urdf, and "
    "use that file.",
)
def new_command(robot: str, out: Path | None, nearest_inertia: bool) -> None:
    """Check your robot, plan a first rotation, and write a scenario.

    URDF is a URDF or xacro file, or the name of a robot. A robot without joints uses thrusters.
    Exit code 0: a scenario that reaches its goal is written; 1: no method reaches a goal; 2: the
    robot is rejected.
    """
    from spacerobot_ros.bag import free_name
    from spacerobot_ros.errors import PlanningError
    from spacerobot_ros.flight.trials import try_method
    from spacerobot_ros.model import SpaceRobot
    from spacerobot_ros.model.urdf import nearest_inertias, xacro_arguments
    from spacerobot_ros.planning.analysis import analyze
    from spacerobot_ros.resources import is_path, robot_file
    from spacerobot_ros.session.own_robot import (
        first_problem,
        scenario_text,
        thruster_scenario_text,
    )

    file = robot_file(robot)
    name = file.name.split(".")[0]
    target = free_name(out or Path(f"{name}.yaml"))
    if nearest_inertia:
        text, changes = nearest_inertias(file)
        for link, change in changes.items():
            say(f"{'inertia':<13}link '{link}' is changed by {100 * change:.2g} %")
        if changes:
            file = free_name(target.with_name(f"{name}_possible.urdf"))
            write_output(file, text)
            robot = str(file)
    model = SpaceRobot.from_file(file)
    with display(name):
        known = analyze(model)
    for line in (*analysis_lines(known), *_notes(model)):
        say(line)
    click.echo()
    # A robot file next to its scenario is found from any working directory.
    from_there = os.path.relpath(file.resolve(), target.resolve().parent)
    named = from_there if is_path(robot) else robot
    # A xacro file is another robot with other arguments.
    arguments = xacro_arguments() if file.suffix == ".xacro" else []
    options = [word for each in arguments for word in ("--xacro-arg", each)]
    fly = f"  {shlex.join(['spacerobot', *options, 'run', str(target)])}"
    if not model.n:
        write_output(target, thruster_scenario_text(model, named))
        say(f"The robot has no joints and uses thrusters. The scenario is {target}:")
        click.echo(fly)
        return
    missing = [each.link for each in known.geometry.unread_meshes if each.is_collision_shape]
    problem = first_problem(name, model, file, clear=not missing)
    try:
        with display(name):
            plan = try_method(problem, "auto")
    except PlanningError as refusal:
        fail(f"{refusal} No scenario is written.")
    if not plan.reached:
        fail("No method reaches the goal of the first flight; no scenario is written.")
    method = plan.pieces[0].method
    write_output(target, scenario_text(problem, method, named))
    say(f"\n{method} is the fastest: {plan.duration:.4g} s. The scenario is {target}:")
    click.echo(fly)


@click.command("robots")
def robots_command() -> None:
    """List the robots that come with the package."""
    from spacerobot_ros.model import load_robot
    from spacerobot_ros.resources import resource_names, robot_file

    click.echo(f"{'robot':<22}{'joints':>6}{'mass':>15}{'base':>15}")
    for name in resource_names("urdf", ".urdf"):
        robot = load_robot(robot_file(name))
        base = robot.bodies[0].inertia.mass
        joints = len(robot.joint_names)
        click.echo(f"{name:<22}{joints:>6}{robot.total_mass:>12.4g} kg{base:>12.4g} kg")
