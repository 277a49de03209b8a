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
from support.planner_phases import executing, resting, stub_of

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.urdf import parse_world
from spacerobot_ros.model.world import with_obstacles_around
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Phase
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.planning.execution.worker import PlanningWorker

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


@pytest.mark.parametrize("obstacles", [True, False])
def test_a_worker_plans_among_the_obstacles_that_it_is_given(*, obstacles: bool) -> None:
    loop = resting()
    robot, config = loop.plant.robot, PlannerConfig(clearance=0.0)
    described = with_obstacles_around(robot.description, parse_world(BALL)) if obstacles else None
    worker = PlanningWorker(robot, config, loop.method, described=described)
    if described is None:
        assert worker.clearance is None
    else:
        assert worker.clearance is not None
        assert worker.clearance._robot.world is described.world
        assert worker.clearance.distance == 0.01
