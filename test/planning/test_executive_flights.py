"""Goals of an executive that plans with a real method, on the plant and without ROS."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.planner_loop import HERE, NEAR, TURNED, Loop, MovingStub, StubMethod
from support.planner_phases import until
from support.sentences import assert_one_sentence

from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, GoalFile
from spacerobot_ros.planning.execution.measured_states import PathSensitivity
from spacerobot_ros.planning.execution.status import Phase, PlannerState, PlanReason
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait
from spacerobot_ros.resources import share_directory

# Wide tolerances and one large cycle: a first order that is some way off.
COARSE = {"position_tolerance": 0.1, "attitude_tolerance": 0.1, "lie_bracket.loop_area": 10.0}


# -- reached, or refused with the true reason -------------------------------------------------


def test_a_goal_that_is_missed_fails_with_a_sentence() -> None:
    loop = Loop({**COARSE, "max_corrections": 0})
    loop.propose_goal(TURNED)
    loop.tick()
    loop.set(attitude_tolerance=1e-9)
    status = loop.until(PlannerState.FAILED)
    assert_one_sentence(status.message, "not reached", "0 corrections")
    loop.tick(10)
    assert loop.speeds[-1] == 0.0


def test_the_goal_is_on_file_as_long_as_it_is_pursued(tmp_path: Path) -> None:
    file = GoalFile(str(tmp_path / "goal.json"))
    loop = Loop(goal_file=file)
    goal_id = loop.propose_goal(NEAR)
    loop.tick(5)
    assert file.load()[BASE_GOAL_KEY].goal_id == goal_id
    loop.stop()
    assert file.load()[BASE_GOAL_KEY].goal_id == goal_id, "it is resumed after a restart"
    loop.decide(NEAR)
    assert file.load() == {}
    loop.propose_goal(HERE)
    loop.tick(5)
    loop.abort()
    assert file.load() == {}


def test_a_goal_that_cannot_be_saved_is_pursued(tmp_path: Path) -> None:
    loop = Loop(goal_file=GoalFile(str(tmp_path / "none" / "goal.json")))
    assert loop.decide(NEAR).state is PlannerState.REACHED
    assert any("cannot be written" in notice for notice in loop.notices)


# -- replaced, given up, off the path ---------------------------------------------------------


def test_a_new_goal_replaces_the_one_that_is_pursued() -> None:
    loop = Loop()
    loop.propose_goal(([-0.1, 0.0, 0.05], [0.0, 0.0, 0.0]))
    loop.tick(15)
    assert loop.speeds[-1] > 0.0
    assert loop.decide(TURNED).state is PlannerState.REACHED
    assert loop.states == ["executing", "executing", "reached"]
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, PlanReason.BLEND]
    assert max(loop.error_to(TURNED)) <= 1e-3
    first, second = loop.starts
    assert second.stamp_ns < first.stamp_ns + first.schedule.duration * 1e9
    # The second begins at the shape that the first had come to.
    tick = second.stamp_ns // 50_000_000
    np.testing.assert_array_equal(second.schedule.positions[0], loop.shapes[tick])
    # No joint stops dead: the joints brake before the second gait begins.
    before, now = loop.commands[tick - 1], loop.commands[tick]
    assert np.abs(before).max() > 0.01
    assert np.abs(now - before).max() < 0.2 * np.abs(before).max()
    # And the path that is predicted for braking and gait together is what happens.
    path = second.schedule.path
    for k in range(0, len(path.time), 7):
        at = tick + round(path.time[k] / 0.05)
        np.testing.assert_allclose(path.position[k], loop.poses[at][:3], rtol=0, atol=1e-9)


def test_a_base_off_its_path_is_planned_for_again(tmp_path: Path) -> None:
    """The base is heavier than the planner believes, so that it does not go where it should."""
    urdf = (share_directory() / "urdf" / "sliding_masses.urdf").read_text("utf-8")
    heavier = tmp_path / "heavier.urdf"
    heavier.write_text(urdf.replace('<mass value="10"/>', '<mass value="13"/>'), "utf-8")
    loop = Loop(
        {"drift_position": 2e-3, "max_corrections": 10},
        robot=str(heavier),
        believed="sliding_masses",
    )
    assert loop.decide(NEAR).state is PlannerState.REACHED
    first, second = loop.starts[:2]
    assert first.stamp_ns < second.stamp_ns < first.stamp_ns + first.schedule.duration * 1e9
    assert max(loop.error_to(NEAR)) <= 1e-3


def test_small_tracking_errors_are_left_to_the_end() -> None:
    loop = Loop({"drift_position": 2e-3, "drift_attitude": 2e-3})
    loop.decide(NEAR)
    assert loop.states == ["executing", "reached"]


def test_a_goal_that_waits_for_a_state_can_be_aborted() -> None:
    loop = Loop()
    loop.propose_goal(NEAR)
    loop.abort()
    loop.tick(10)
    assert not loop.starts


# -- planned in the background ----------------------------------------------------------------


def test_a_new_goal_in_flight_is_planned_from_rest() -> None:
    loop = Loop({"abort_time": 0.5}, held=True)
    loop.propose_goal(NEAR)
    loop.tick()
    loop.held.release()
    loop.tick(15)
    loop.propose_goal(TURNED)
    until(loop, Phase.PLANNING)
    resting = len(loop.commands)
    loop.tick(20)
    assert not any(loop.speeds[resting:])
    loop.held.release()
    loop.tick()
    loop.until(PlannerState.REACHED)
    assert max(loop.error_to(TURNED)) < 1e-3
    # Nothing jumps: from tick to tick no faster than the gait itself accelerates.
    steps = np.abs(np.diff(loop.shapes, axis=0))
    assert steps.max() <= 0.05 * max(loop.speeds) + 1e-12


def test_an_abort_cancels_what_is_being_planned() -> None:
    loop = Loop({"abort_time": 0.5}, held=True)
    loop.propose_goal(NEAR)
    loop.tick(3)
    assert loop.abort() == "The joints rest."
    assert loop.held.cancelled
    # Another goal waits until the cancelled plan has ended.
    loop.propose_goal(NEAR)
    loop.tick(10)
    assert len(loop.held.tasks) == 1
    loop.held.release()
    loop.tick(3)
    assert len(loop.held.tasks) == 2
    assert loop.states == ["aborted"]
    loop.held.release()
    loop.until(PlannerState.REACHED)


class Searching(LieBracketGait):
    """Looks whether its plan is cancelled, and waits for permission where it is given a gate."""

    gate: threading.Event | None = None

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        while self.gate is not None and not self.gate.wait(0.005):
            cancellation.raise_if_requested()
        cancellation.raise_if_requested()
        return super().plan(request, cancellation)


def threaded(method: LieBracketGait | StubMethod) -> Loop:
    return Loop({"plan_in_background": True, "abort_time": 0.5}, method=method)


def searching() -> Searching:
    built = Loop().method
    return Searching(built.robot, built.control_period, built.integration_step, built.options)


def wait(loop: Loop, goal_id: str, state: PlannerState = PlannerState.REACHED) -> None:
    """Tick until this is the state of the goal, however long a thread plans."""
    end = time.monotonic() + 15.0
    while not any((s.goal_id, s.state) == (goal_id, state) for s in loop.statuses[-1:]):
        assert time.monotonic() < end, f"{goal_id} is not {state.value}: {loop.statuses}"
        loop.tick()


def test_the_thread_that_plans_derives_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    threads, derive = set[threading.Thread](), PathSensitivity.path_derivatives

    def derived(*given: Any) -> Any:
        threads.add(threading.current_thread())
        return derive(*given)

    monkeypatch.setattr(PathSensitivity, "path_derivatives", derived)
    loop = threaded(MovingStub())
    wait(loop, loop.propose_goal(NEAR))
    assert len(threads - {threading.main_thread()}) == len(threads) == 1


def test_a_worker_that_is_closed_has_its_search_end_soon() -> None:
    method = searching()
    method.gate = threading.Event()
    loop = threaded(method)
    before = threading.active_count()
    loop.propose_goal(NEAR)
    loop.tick(200)
    assert threading.active_count() == before + 1
    assert not loop.states, "it searches still"
    loop.stop()
    assert threading.active_count() == before
    # It plans again when it is wanted again.
    method.gate.set()
    wait(loop, loop.propose_goal(NEAR))


@pytest.mark.parametrize("background", [False, True])
def test_a_plan_after_an_abort_is_not_cancelled(background: bool) -> None:
    loop = Loop({"plan_in_background": background, "abort_time": 0.5}, method=searching())
    wait(loop, loop.propose_goal(NEAR), PlannerState.EXECUTING)
    assert loop.abort() is not None
    wait(loop, loop.propose_goal(NEAR))


@pytest.mark.parametrize("background", [False, True])
def test_a_defect_of_a_method_is_seen(background: bool) -> None:
    class Broken(StubMethod):
        def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
            raise ZeroDivisionError("a defect")

    loop = Loop({"plan_in_background": background}, method=Broken())
    goal_id = loop.propose_goal(NEAR)
    with pytest.raises(ZeroDivisionError, match="a defect"):
        wait(loop, goal_id)
