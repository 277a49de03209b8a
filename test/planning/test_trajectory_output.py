"""An executive whose schedules the robot's own controller follows: when they end, and how."""

from __future__ import annotations

import numpy as np
import pytest
from support.planner_loop import TICK, Loop
from support.planner_phases import executing, stub_of

from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Phase
from spacerobot_ros.planning.execution.status import Notice, PlannerState, Severity
from spacerobot_ros.planning.methods.optimal import OptimalGait


def flown(ticks: int = 8, **options: float) -> Loop:
    """Return a loop in the schedule of 0.05 s a tick to a goal at 62 mm."""
    return executing(output="trajectory", ticks=ticks, **options)


def test_a_schedule_ends_when_its_controller_says_so() -> None:
    loop = flown()
    loop.tick(40)
    assert loop.executive.phase is Phase.EXECUTING
    loop.executive.schedule_ended()
    status = loop.until(PlannerState.REACHED)
    assert status.corrections == 0
    # The mark of the first schedule does not end the next one.
    loop.propose_goal(([-0.1, 0.2, 0.05], [0.0, 0.0, 0.0]))
    loop.tick(12)
    assert loop.executive.phase is Phase.EXECUTING


def test_a_violated_tolerance_is_corrected_from_the_measured_state() -> None:
    loop = flown(ticks=16)
    loop.tick(5)
    q = loop.plant.q.copy()
    loop.executive.schedule_ended("the trajectory has ended early by PATH_TOLERANCE_VIOLATED")
    loop.tick(2)
    told = [each for each in loop.outputs if isinstance(each, Notice)]
    assert (
        Notice(Severity.WARNING, "The trajectory has ended early by PATH_TOLERANCE_VIOLATED.")
        in told
    )
    _, second = stub_of(loop).requests
    assert second.correction
    assert second.state.q == pytest.approx(q, abs=1e-9)
    assert np.abs(q).max() > 0.01
    loop.tick(16)
    loop.executive.schedule_ended()
    assert loop.until(PlannerState.REACHED).corrections == 1


def test_a_trajectory_that_no_server_flies_fails_the_goal() -> None:
    loop = flown()
    loop.tick(2)
    loop.executive.schedule_ended("no server of the action '/arm' is there", final=True)
    status = loop.until(PlannerState.FAILED)
    assert status.message.startswith("The goal is not reached: ")
    assert status.message.endswith(", and no server of the action '/arm' is there.")
    assert status.corrections == 0
    assert len(stub_of(loop).requests) == 1
    loop.executive.schedule_ended("too late", final=True)  # There is no goal any more.
    loop.tick()
    assert loop.executive.phase is Phase.IDLE


def test_a_controller_that_never_answers_ends_nothing_for_five_seconds() -> None:
    loop = flown()
    loop.tick(8 + round(5.0 / TICK) - 1)
    assert loop.executive.phase is Phase.EXECUTING
    assert loop.until(PlannerState.REACHED).corrections == 0


def test_a_joint_that_lags_is_left_to_the_controller() -> None:
    loop = flown(ticks=60, stuck_ticks=3)
    loop.plant.hold(np.array([True, False, True]))
    loop.tick(55)
    assert loop.executive.phase is Phase.EXECUTING


def test_an_abort_leaves_the_braking_to_the_controller() -> None:
    loop = flown(ticks=60, abort_time=2.5)
    loop.tick(5)
    assert loop.abort() == "The joints' controller has 2.5 s to bring them to rest."
    assert loop.executive.phase is Phase.BRAKING


OWN = OptimalGait.Options().effort_limits


@pytest.mark.parametrize(
    ("output", "links", "effort_limits"),
    [
        ("commands", ("end_effector",), OWN),
        ("reference", (), 1),
        ("trajectory", ("end_effector",), OWN),
    ],
)
def test_only_plans_for_a_controller_keep_a_reserve_of_efforts(
    output: str, links: tuple[str, ...], effort_limits: int
) -> None:
    config = PlannerConfig(output=output)
    assert config.goal_links == links
    optimal = config.method_options.get("optimal", OptimalGait.Options())
    assert optimal.effort_limits == effort_limits
    assert OWN != 1
