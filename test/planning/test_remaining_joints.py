"""Goals are planned with the joints that remain, and the plant, whose joints are stuck, agrees."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.effort_flights import robot_of
from support.planners import Planner
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import (
    GaitSchedule,
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
    method_options,
)
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.execution import worker as worker_module
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.worker import PlanningTask, PlanningWorker
from spacerobot_ros.planning.methods.remaining_joints import RemainingJointsGait
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import InitialState, VelocityPlant
from spacerobot_ros.simulation.actuators import PlantWithFaults

TICK = 0.05
SERVICER = (share_directory() / "urdf" / "servicer.urdf").read_text("utf-8")
ARM = (share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8")
SHAPE = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])


def gait(
    urdf: str, places: npt.ArrayLike, *stuck: str, method: str = "area_loop", **options: Any
) -> Planner:
    """Return a planner for goals without some joints, where these are in the shape ``places``."""
    robot = robot_of(urdf)
    where = dict(zip(robot.joint_names, np.asarray(places).tolist(), strict=True))
    given = {} if method == "auto" else {method: method_options(method, options)}
    without = RemainingJointsGait(
        robot,
        TICK,
        DEFAULT_INTEGRATION_STEP,
        stuck={name: where[name] for name in stuck},
        method=method,
        options=given,
    )
    return Planner(without, Tolerance(1e-3, 1e-3))


def state_of(plant: PlantWithFaults) -> RobotState:
    return RobotState(plant.pose[:3].copy(), plant.pose[3:].copy(), plant.q.copy())


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"nominal": SHAPE.tolist()}, id="a shape of all joints"),
        pytest.param({"joints": "shoulder_yaw shoulder_pitch elbow_pitch"}, marks=pytest.mark.slow),
        pytest.param({"joints": "shoulder_yaw shoulder_pitch wrist_pitch"}, marks=pytest.mark.slow),
    ],
)
def test_an_arm_turns_its_base_without_its_elbow(options: dict[str, Any]) -> None:
    """The plant holds the joint; the flight ends where it does by its own equations."""
    elbow = 2
    inner = VelocityPlant(robot_of(SERVICER), TICK, InitialState(joint_positions=SHAPE))
    plant = PlantWithFaults(inner, ["joint_stuck elbow_pitch"], TICK, wrench=False)
    method = gait(SERVICER, SHAPE, "elbow_pitch", k=0.5, **options)
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.01, 0.005, -0.01]).as_quat())
    for _ in range(30):
        schedule = method.plan(state_of(plant), goal)
        assert schedule.joint_names == plant.robot.joint_names
        assert np.ptp(schedule.positions[:, elbow]) == 0.0
        for rates in schedule.velocities:
            plant.step(rates)
        # What is predicted for the locked model is what the whole one does.
        np.testing.assert_allclose(plant.pose[:3], schedule.path.position[-1], atol=1e-8)
        left = Rotation.from_quat(schedule.path.quaternion[-1]).inv() * Rotation.from_quat(
            plant.pose[3:]
        )
        assert left.magnitude() < 1e-8
        if not schedule.partial:
            break
    error = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(goal.quaternion)
    assert error.magnitude() < 1e-3
    assert plant.q[elbow] == SHAPE[elbow]
    assert "attitude" in schedule.controls


def test_options_of_joints_are_those_of_the_joints_that_are_left() -> None:
    """Three joints, and directions of three numbers: only what is of joints gets shorter."""
    start = np.array([0.1, -0.7, 1.5])
    speeds = np.array([0.5, 0.02, 0.3])
    method = gait(
        ARM,
        start,
        "shoulder_yaw",
        method="optimal",
        base_attitude=0,
        base_position=2,
        max_velocity=speeds.tolist(),
        keep_axis=[1.0, 0.0, 0.0],
        keep_direction=[0.0, 0.0, 1.0],
        keep_angle=0.5,
        starts=2,
        answers=1,
        intervals=20,
        cache=0,
    )
    wanted = start + np.array([0.0, 0.05, -0.2])
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), start)
    schedule = method.plan(state, Goal(np.zeros(3), state.quaternion, wanted))
    assert schedule.method == "optimal"
    np.testing.assert_allclose(schedule.positions[-1], wanted, atol=1e-6)
    fastest = np.abs(schedule.velocities).max(axis=0)
    assert fastest[0] == 0.0
    assert np.all(fastest <= speeds * (1 + 1e-6))
    # The slow joint is the one that takes all its speed.
    assert fastest[1] > 0.9 * speeds[1]
    axis = Rotation.from_quat(schedule.path.quaternion).as_matrix()[:, :, 0]
    assert np.arccos(axis[:, 2]).min() >= 0.5


def test_joints_that_do_not_suffice_are_refused_with_the_reason() -> None:
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, -0.7, 1.5]))
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.05, 0.0, 0.0]).as_quat())
    with pytest.raises(PlanningError) as refusal:
        gait(ARM, state.q, "elbow_pitch", "shoulder_yaw").plan(state, goal)
    assert_one_sentence(
        str(refusal.value),
        "joint 'shoulder_yaw' is stuck at 0 rad and joint 'elbow_pitch' is stuck at 1.5 rad; ",
        "with the remaining joints: ",
        "three joints",
    )
    with pytest.raises(PlanningError, match="no joint follows"):
        gait(ARM, state.q, "elbow_pitch", "shoulder_yaw", "shoulder_pitch").plan(state, goal)


def test_a_shape_that_a_stuck_joint_is_not_in_is_refused() -> None:
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), SHAPE)
    wanted = SHAPE.copy()
    wanted[2] += 0.1
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.01, 0.0, 0.0]).as_quat(), wanted)
    with pytest.raises(
        PlanningError, match=r"stuck at 2 rad; the goal wants .*'elbow_pitch' at 2\.1"
    ):
        gait(SERVICER, SHAPE, "elbow_pitch").plan(state, goal)


def test_a_chain_turns_its_base_by_the_one_pin_that_is_left() -> None:
    chain = (share_directory() / "urdf" / "planar_chain.urdf").read_text("utf-8")
    robot = robot_of(chain)
    plant = PlantWithFaults(VelocityPlant(robot, TICK), ["joint_stuck pin_1"], TICK, wrench=False)
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.0, 0.0, 0.1]).as_quat())
    method = gait(chain, plant.q, "pin_1", method="square_path")
    for rates in method.plan(state_of(plant), goal).velocities:
        plant.step(rates)
    left = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(goal.quaternion)
    assert left.magnitude() < 1e-3
    assert plant.q[0] == 0.0


def test_a_method_that_leaves_the_position_does_not_stand_in_for_one_that_does_not() -> None:
    chain = (share_directory() / "urdf" / "planar_chain.urdf").read_text("utf-8")
    without = RemainingJointsGait(
        robot_of(chain),
        TICK,
        DEFAULT_INTEGRATION_STEP,
        stuck={"pin_1": 0.0},
        method="auto",
        options={},
        required=frozenset({"position", "attitude"}),
    )
    method = Planner(without, Tolerance(1e-3, 1e-3))
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.0, 0.0, 0.1]).as_quat())
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(2))
    with pytest.raises(PlanningError, match="optimal does not control the position of the base"):
        method.plan(state, goal)


def test_a_worker_builds_the_method_without_some_joints_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = robot_of(SERVICER)
    built: list[dict[str, Any]] = []

    class Counted(RemainingJointsGait):
        def __init__(self, *args: Any, **options: Any) -> None:
            built.append(options)
            super().__init__(*args, **options)

        def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
            raise PlanningError("It is only counted.")

    monkeypatch.setattr(worker_module, "RemainingJointsGait", Counted)
    worker = PlanningWorker(robot, configured(PlannerConfig, {"method": "area_loop"}))
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), SHAPE)
    request = PlanRequest(state, Goal(np.zeros(3), state.quaternion), Tolerance(1e-3, 1e-3))
    attitude = frozenset({"attitude"})
    for stuck, required, count in (
        ({"elbow_pitch": 2.0}, frozenset(), 1),
        ({"elbow_pitch": 2.0}, frozenset(), 1),
        ({"elbow_pitch": 2.5}, frozenset(), 2),
        ({"elbow_pitch": 2.5}, attitude, 3),
        ({"elbow_pitch": 2.5}, attitude, 3),
        ({"elbow_pitch": 2.5, "wrist_pitch": 0.8}, attitude, 4),
    ):
        with pytest.raises(PlanningError, match="only counted"):
            worker.plan(PlanningTask(request, stuck, required), Cancellation())  # type: ignore[arg-type]
        assert len(built) == count
        assert (built[-1]["stuck"], built[-1]["required"]) == (stuck, required)
        assert built[-1]["method"] == "area_loop"
