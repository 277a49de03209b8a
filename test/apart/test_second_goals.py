"""Goals that come while the robot flies to others: the last is flown, the others are replaced."""

from __future__ import annotations

import re

import pytest
from support.nodes_apart import NodesApart
from support.planner_flight import Place, values_of

COMMAND_TIMEOUT = 0.5
"""s without a command after which a plant rests, by default."""


def turned(k: int) -> Place:
    """Return a place that is none of the others, and far from the one before."""
    sign = 1.0 if k % 2 else -1.0
    return ([0.0, 0.0, 0.0], [0.03 * sign + 0.001 * k, 0.0, 0.04 * sign])


def slid(k: int) -> Place:
    sign = 1.0 if k % 2 else -1.0
    return ([0.1 * sign + 0.001 * k, 0.02 * sign, 0.0], [0.0, 0.0, 0.0])


def replace_in_motion(apart: NodesApart, first: Place, second: Place) -> None:
    """Send a goal while the robot moves to another; the second is flown, the first replaced."""
    began = apart.send(first)
    apart.wait(
        lambda: any(state == "executing" for state, _ in apart.told("planner", began)),
        "the robot moves",
    )
    then = apart.send(second)
    state, message = apart.decision("planner", then)
    assert state == "reached", f"{message}\n{apart.said}"
    apart.wait(lambda: replaced(apart, began), "the first goal is reported as replaced", 5.0)


def replaced(apart: NodesApart, goal_id: str) -> bool:
    """Whether a status or an event says so of a goal."""
    heard = [*apart.probe.messages["planner/status"], *apart.probe.messages["events"]]
    return any("replace" in m.message and values_of(m).get("goal_id") == goal_id for m in heard)


def plan_times(apart: NodesApart) -> list[float]:
    """Return how long plans took by the planner's log, s."""
    return [float(each) for each in re.findall(r"Planned in ([\d.e-]+) s", apart.said)]


def test_a_second_goal_in_motion_is_flown(apart: NodesApart) -> None:
    apart.start("plant", robot="sliding_masses")
    apart.start("planner")
    replace_in_motion(apart, slid(1), slid(2))
    apart.end()
    assert [line for line in apart.complaints if "replaced" not in line] == []


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["sliding_masses", "seven_joint_arm"])
def test_twenty_second_goals_in_motion_are_flown(apart: NodesApart, robot: str) -> None:
    """Ten for a robot whose plans are quick, and ten for one whose plans take seconds."""
    place = slid if robot == "sliding_masses" else turned
    apart.start("plant", robot=robot)
    apart.start("planner")
    for k in range(10):
        replace_in_motion(apart, place(2 * k + 1), place(2 * k + 2))
    if robot == "seven_joint_arm":
        assert max(plan_times(apart)) > COMMAND_TIMEOUT
    apart.end()
    # The planner may say that a plan was late; the plant has never been without commands.
    assert [line for line in apart.complaints if line.startswith("/plant")] == []
