"""Obstacles that come while a planner flies: which commands are looked at, and what is told."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.planner_loop import TICK, Loop
from support.planner_phases import executing, planning, resting, stub_of, twisting

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.urdf import load_robot, parse_world
from spacerobot_ros.model.world import with_world
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Phase
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.resources import robot_file

Array = npt.NDArray[np.float64]

BALL = (
    '<robot name="w"><link name="w"/><link name="ball"><collision><geometry><sphere radius="0.3"/>'
    '</geometry></collision></link><joint name="a" type="fixed"><parent link="w"/>'
    '<child link="ball"/></joint></robot>'
)


def use(loop: Loop, approaches: Callable[..., Any], *, has_obstacles: bool = True) -> Any:
    """Let a worker with a made-up clearance take the place of that of a loop."""
    clearance = SimpleNamespace(
        has_obstacles=has_obstacles,
        approaches=approaches,
        clause=lambda approach, period: (
            f"link 'a' and obstacle 'b' touch at {approach}, {period:g}"
        ),
    )
    worker: Any = PlanningWorker(loop.plant.robot, loop.config, loop.method)
    worker.clearance = clearance
    loop.executive.use_obstacles(lambda: worker)
    loop._take()
    return worker


def test_the_rest_of_the_schedule_is_looked_at_with_its_predicted_base() -> None:
    loop, asked = executing(ticks=40), []

    def approaches(positions: Array, base: Any) -> list[str]:
        asked.append((positions, base))
        return []

    loop.tick(11)
    schedule = loop.starts[-1].schedule
    worker = use(loop, approaches)
    ((positions, base),) = asked
    np.testing.assert_array_equal(positions, schedule.positions[11:])
    np.testing.assert_allclose(base.position, schedule.path.position[11:], atol=1e-15)
    np.testing.assert_allclose(base.quaternion, schedule.path.quaternion[11:], atol=1e-15)
    assert loop.executive.phase is Phase.EXECUTING
    assert loop.executive._worker is worker
    assert loop.states == ["executing"]
    loop.until(PlannerState.REACHED)


def test_the_joints_brake_before_an_obstacle_and_go_on_to_the_goal() -> None:
    loop = executing(ticks=60, abort_time=0.4)
    loop.tick(20)
    use(loop, lambda positions, base: ["here", "there"])
    said = (
        f"Link 'a' and obstacle 'b' touch at here, {TICK:g}: the joints brake, and the remaining "
        "motion is planned again."
    )
    status = loop.statuses[-1]
    assert (status.state, status.message, status.goal_id) == ("executing", said, "goal-1")
    assert said in loop.notices
    assert loop.executive.phase is Phase.BRAKING
    reached = loop.until(PlannerState.REACHED)
    assert reached.corrections == 0
    assert len(stub_of(loop).requests) == 2
    assert not stub_of(loop).requests[-1].correction
    assert np.abs(np.diff(loop.speeds)).max() < 0.5 * max(loop.speeds)


def test_a_goal_behind_an_obstacle_has_failed_with_both_reasons() -> None:
    loop = executing(ticks=60)
    loop.tick(20)

    def approaches(positions: Array, base: Any) -> list[str]:
        raise PlanningError("Link 'a' and obstacle 'b' are 0.001 m apart at the start.")

    use(loop, approaches)
    assert loop.statuses[-1].message.startswith("Link 'a' and obstacle 'b' are 0.001 m apart at")
    assert loop.statuses[-1].message.endswith(
        "start: the joints brake, and the remaining motion is planned again."
    )
    stub_of(loop).refusing = True
    assert "It is too far." in loop.until(PlannerState.FAILED).message


def test_without_obstacles_nothing_is_looked_at() -> None:
    loop = executing(ticks=40)
    loop.tick(5)
    use(loop, lambda positions, base: ["here"], has_obstacles=False)
    assert loop.executive.phase is Phase.EXECUTING
    loop.executive._worker.clearance = None
    assert loop.executive._obstacle_clause(loop.executive._active_goal) == ""  # type: ignore[arg-type]


def test_a_plan_that_is_made_is_made_again_for_a_goal_that_rests_or_waits() -> None:
    loop = planning()
    assert len(loop.held.tasks) == 1
    loop.executive.use_obstacles(lambda: loop.held)
    loop._take()
    assert loop.executive.phase is Phase.MEASURING
    loop.tick(2)
    assert len(loop.held.tasks) == 2
    idle = resting()
    idle.tick(2)
    use(idle, lambda positions, base: ["here"])
    assert idle.executive.phase is Phase.IDLE


def test_twists_keep_clear_of_the_new_obstacles() -> None:
    loop = twisting()
    before = loop.executive._teleoperation
    assert before is not None
    follower = before.follower
    worker = use(loop, lambda positions, base: [])
    after = loop.executive._teleoperation
    assert after is not None
    assert after.follower is not follower
    assert after.follower._clearance is worker.clearance
    assert loop.executive.phase is Phase.TELEOPERATING


# -- parts --------------------------------------------------------------------------------------


def test_a_path_of_the_base_is_read_between_its_poses() -> None:
    turns = Rotation.from_rotvec([[0.0, 0, 0.1], [0.0, 0, 0.3], [0.0, 0.02, 0.3]])
    quaternions = turns.as_quat() * np.array([[1.0], [-1.0], [1.0]])
    path = BasePath(np.array([0.0, 1.0, 3.0]), np.eye(3), quaternions)
    position, quaternion = path.at(np.array([0.25, 1.0, 2.0, 9.0]))
    wanted_r: Any = [[0.75, 0.25, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]
    np.testing.assert_allclose(position, wanted_r)
    wanted = Slerp([0.0, 1.0, 3.0], turns)([0.25, 1.0, 2.0, 3.0])
    assert (wanted.inv() * Rotation.from_quat(quaternion)).magnitude().max() < 1e-4
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-14)


def test_the_clearance_of_another_robot_is_among_the_same_obstacles() -> None:
    robot = load_robot(robot_file("planar_chain"))
    described = with_world(robot, parse_world(BALL))
    other = Clearance(described, 0.03).of(robot)
    assert (other._robot.world, other.distance) == (described.world, 0.03)


@pytest.mark.parametrize("obstacles", [True, False])
def test_a_worker_plans_among_the_obstacles_that_it_is_given(*, obstacles: bool) -> None:
    loop = resting()
    robot, config = loop.plant.robot, PlannerConfig(clearance=0.0)
    described = with_world(robot.description, parse_world(BALL)) if obstacles else None
    worker = PlanningWorker(robot, config, loop.method, described=described)
    if described is None:
        assert worker.clearance is None
    else:
        assert worker.clearance is not None
        assert worker.clearance._robot.world is described.world
        assert worker.clearance.distance == 0.01
