"""Options that several commands take, and what they change."""

from __future__ import annotations

from dataclasses import replace

import click

from spacerobot_ros.planning import Goal
from spacerobot_ros.session.scenario import goal_from_rotvec

pose_option = click.option(
    "--goal", nargs=7, type=float, metavar="X Y Z QX QY QZ QW", help="Goal pose (m, quaternion)."
)
rotvec_option = click.option(
    "--goal-rotvec",
    nargs=3,
    type=float,
    metavar="RX RY RZ",
    help="Attitude of the goal as exponential coordinates (rad).",
)
settings_option = click.option("--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE")


def changed_goal(
    goal: Goal, pose: tuple[float, ...] | None, rotvec: tuple[float, ...] | None
) -> Goal:
    """Return a goal with another pose (7,), and then another attitude (3,), where they are given.

    Raises
    ------
    PlanningError
        The pose or the rotation vector is not finite.
    """
    if pose is not None:
        given = Goal.checked(pose[:3], pose[3:])
        goal = replace(goal, position=given.position, quaternion=given.quaternion)
    if rotvec is not None:
        given = goal_from_rotvec(goal.position.tolist(), rotvec)
        goal = replace(goal, quaternion=given.quaternion)
    return goal
