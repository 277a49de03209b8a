"""Plans in the background for robots that drift: each begins where the base is by then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.planner_loop import TICK, TICK_NS, Loop, StubMethod, goal_at

from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.simulation import InitialState

VELOCITY = np.array([0.004, -0.003, 0.002])
"""Of the centre of mass, m/s: in 2 s it moves ten times as far as the tolerance."""

GOAL = ([0.04, -0.03, 0.02], [0.0, 0.0, 0.0])


class Coasting(StubMethod):
    """Slides the base relative to a centre of mass that coasts."""

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        velocity = request.state.linear_momentum / self.robot.total_mass
        there = request.goal.position - velocity * self.ticks * TICK
        moved = replace(request, goal=replace(request.goal, position=there))
        schedule = super().plan(moved, cancellation)
        path = schedule.path
        drifted = path.position + np.outer(path.time, velocity)
        return replace(schedule, goal=request.goal, path=replace(path, position=drifted))


def loop_of(**parameters: object) -> Loop:
    mass = Coasting().robot.total_mass
    momentum = InitialState(linear_momentum=VELOCITY * mass)
    given = {"max_corrections": 0, "position_tolerance": 8e-4, **parameters}
    return Loop(given, method=Coasting(20), initial=momentum, held=True)


def test_a_plan_begins_with_a_rest_while_which_it_is_made() -> None:
    loop = loop_of()
    loop.tick(3)
    loop.propose_goal(goal_at(GOAL))
    loop.tick(18)
    loop.held.release()
    status = loop.until(PlannerState.REACHED, PlannerState.FAILED)
    assert status.state is PlannerState.REACHED, status.message
    (start,) = loop.starts
    assert start.stamp_ns == 3 * TICK_NS
    rests = 40
    positions = start.schedule.positions
    np.testing.assert_array_equal(positions[: rests + 1], np.tile(positions[0], (rests + 1, 1)))
    assert np.abs(positions[rests + 1] - positions[0]).max() > 0
    assert not any(loop.speeds[: 3 + rests])
    assert loop.speeds[3 + rests] > 0
    ahead = loop.plant.pose[:3] - goal_at(GOAL).position
    assert np.linalg.norm(ahead) < 8e-4


@pytest.mark.parametrize("late", [41, 67])
def test_a_plan_that_comes_too_late_is_made_again(late: int) -> None:
    loop = loop_of()
    loop.propose_goal(goal_at(GOAL))
    loop.tick(late + 1)
    loop.held.release()
    loop.tick(2)
    assert loop.states == []
    (told,) = [each for each in loop.notices if "made again" in each]
    assert f"The plan came {(late + 1) * TICK - 2.0:.3g} s after its start" in told
    loop.held.release()
    status = loop.until(PlannerState.REACHED, PlannerState.FAILED)
    assert status.state is PlannerState.REACHED, status.message
    (start,) = loop.starts
    assert start.stamp_ns == 0
    # Twice the time that planning took.
    assert len(start.schedule.positions) - 1 - 20 == 2 * (late + 1)
    assert np.linalg.norm(loop.plant.pose[:3] - goal_at(GOAL).position) < 8e-4


def test_planning_that_takes_too_long_is_refused() -> None:
    loop = loop_of()
    loop.propose_goal(goal_at(GOAL))
    loop.tick(601 * 20)
    loop.held.release()
    loop.tick(2)
    status = loop.statuses[-1]
    assert status.state is PlannerState.REFUSED
    assert "601 s of planning were not enough" in status.message


def test_a_correction_begins_with_a_rest_too() -> None:
    loop = loop_of(max_corrections=1)
    method = loop.held._method
    assert isinstance(method, Coasting)
    method.overshoot = 0.2
    loop.propose_goal(goal_at(GOAL))
    loop.tick(2)
    loop.held.release()
    for _ in range(200):
        loop.tick()
        if len(loop.held.tasks) == 2:
            break
    method.overshoot = 0.0
    loop.tick(11)
    loop.held.release()
    status = loop.until(PlannerState.REACHED, PlannerState.FAILED)
    assert status.state is PlannerState.REACHED, status.message
    second = loop.starts[1].schedule
    np.testing.assert_array_equal(second.positions[40], second.positions[0])
    assert len(second.positions) == 61


def test_a_robot_at_rest_begins_at_once() -> None:
    loop = Loop(method=StubMethod(), held=True)
    loop.propose_goal(goal_at(GOAL))
    loop.tick(7)
    loop.held.release()
    loop.until(PlannerState.REACHED)
    (start,) = loop.starts
    assert (start.schedule.ticks, start.stamp_ns) == (8, 7 * TICK_NS)
