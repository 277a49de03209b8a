"""Stuck joints are found, others are not taken for stuck, and the rest is planned without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.effort_flights import robot_of
from support.ros_harness import assert_one_sentence

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning import Goal, RobotState, Tolerance
from spacerobot_ros.planning.execution.stuck_joints import RemainingJointsGait, StuckJointWatch
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import InitialState, VelocityPlant
from spacerobot_ros.simulation.faults_plant import FaultyPlant

Array = npt.NDArray[np.float64]

TICK = 0.05
NEEDED = 20
GAIN = 2.0


def ramp(time: float) -> Array:
    return np.array([0.1 * time, -0.05 * time, 0.0])


def swing(time: float) -> Array:
    """Return a gait of small circles, as sliders go round: amplitude 0.02."""
    return 0.02 * np.array([np.sin(2 * np.pi * time), np.cos(2 * np.pi * time) - 1.0, 0.0])


def watched(
    gait: Callable[[float], Array],
    follows: Callable[[float], Any],
    *,
    seconds: float = 60.0,
    noise: float = 0.0,
    band: float = 0.0,
    least: int = NEEDED,
) -> dict[int, float]:
    """Fly a gait with the planner's feedback; return when which joint was found stuck, s.

    ``follows`` tells, at a time, which share of its commanded velocity each joint does.
    """
    watch = StuckJointWatch(3, least, TICK, band)
    rng = np.random.default_rng(7)
    q = np.zeros(3)
    found: dict[int, float] = {}
    for tick in range(round(seconds / TICK)):
        time = tick * TICK
        measured = q + noise * rng.standard_normal(3)
        wanted = gait(time)
        error = wanted - measured
        error -= np.clip(error, -band / 2, band / 2)
        velocity = (gait(time + TICK) - wanted) / TICK + GAIN * error
        for joint in watch.look(measured, wanted, velocity):
            found.setdefault(joint, time)
        q += np.asarray(follows(time)) * velocity * TICK
    return found


def from_time(begin: float, joint: int, share: float = 0.0) -> Callable[[float], Array]:
    """Return that one joint does only a share of what it is told from a time on."""
    sound, broken = np.ones(3), np.ones(3)
    broken[joint] = share
    return lambda time: broken if time >= begin else sound


@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_stuck_joint_is_found_soon(gait: Callable[[float], Array], joint: int) -> None:
    found = watched(gait, from_time(10.0, joint))
    assert list(found) == [joint]
    assert NEEDED * TICK <= found[joint] - 10.0 <= 3 * NEEDED * TICK


def test_two_stuck_joints_are_both_found() -> None:
    assert set(watched(ramp, lambda _: [0.0, 0.0, 1.0])) == {0, 1}


@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.8])
def test_a_slow_joint_is_not_stuck(gait: Callable[[float], Array], share: float) -> None:
    assert watched(gait, from_time(5.0, 0, share), seconds=200.0) == {}


def test_a_joint_that_is_not_commanded_is_not_stuck() -> None:
    assert watched(ramp, from_time(0.0, 2)) == {}


@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("band", [0.0, 8e-3])
def test_noise_makes_no_joint_stuck(gait: Callable[[float], Array], band: float) -> None:
    assert watched(gait, lambda _: np.ones(3), noise=1e-3, band=band, seconds=300.0) == {}


@pytest.mark.parametrize("band", [0.0, 8e-3])
def test_a_stuck_joint_is_found_in_noise(band: float) -> None:
    found = watched(ramp, from_time(10.0, 0), noise=1e-3, band=band)
    assert list(found) == [0]
    assert found[0] < 20.0


def test_nobody_looks_when_told_not_to() -> None:
    assert watched(ramp, from_time(0.0, 0), least=0) == {}


# -- planning around them ---------------------------------------------------------------------

SERVICER = (share_directory() / "urdf" / "servicer.urdf").read_text("utf-8")
ARM = (share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8")
SHAPE = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])
OPTIONS = {"area_loop.k": 0.5, "area_loop.nominal": [], "area_loop.joints": ""}


def gait(urdf: str, *stuck: str, method: str = "area_loop", **options: Any) -> RemainingJointsGait:
    return RemainingJointsGait(
        robot_of(urdf),
        TICK,
        Tolerance(1e-3, 1e-3),
        stuck=stuck,
        method=method,
        options={**OPTIONS, **{f"area_loop.{key}": value for key, value in options.items()}},
    )


def state_of(plant: FaultyPlant) -> RobotState:
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
    plant = FaultyPlant(inner, ["joint_stuck elbow_pitch"], TICK, wrench=False)
    method = gait(SERVICER, "elbow_pitch", **options)
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
    assert "attitude" in method.controls


def test_options_of_joints_are_those_of_the_joints_that_are_left() -> None:
    """Three joints, and directions of three numbers: only what is of joints gets shorter."""
    start = np.array([0.1, -0.7, 1.5])
    speeds = np.array([0.5, 0.02, 0.3])
    method = RemainingJointsGait(
        robot_of(ARM),
        TICK,
        Tolerance(1e-3, 1e-3),
        stuck=["shoulder_yaw"],
        method="optimal",
        options={
            "optimal.base_attitude": 0,
            "optimal.base_position": 2,
            "optimal.max_velocity": speeds.tolist(),
            "optimal.keep_axis": [1.0, 0.0, 0.0],
            "optimal.keep_direction": [0.0, 0.0, 1.0],
            "optimal.keep_angle": 0.5,
            "optimal.starts": 2,
            "optimal.answers": 1,
            "optimal.intervals": 20,
            "optimal.cache": 0,
        },
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
        gait(ARM, "elbow_pitch", "shoulder_yaw").plan(state, goal)
    assert_one_sentence(
        str(refusal.value),
        "joint 'shoulder_yaw' is stuck at 0 rad and joint 'elbow_pitch' is stuck at 1.5 rad; ",
        "with the remaining joints: ",
        "three joints",
    )
    with pytest.raises(PlanningError, match="no joint follows"):
        gait(ARM, "elbow_pitch", "shoulder_yaw", "shoulder_pitch").plan(state, goal)


def test_a_shape_that_a_stuck_joint_is_not_in_is_refused() -> None:
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), SHAPE)
    wanted = SHAPE.copy()
    wanted[2] += 0.1
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.01, 0.0, 0.0]).as_quat(), wanted)
    with pytest.raises(
        PlanningError, match=r"stuck at 2 rad; the goal wants .*'elbow_pitch' at 2\.1"
    ):
        gait(SERVICER, "elbow_pitch").plan(state, goal)


def test_a_chain_turns_its_base_by_the_one_pin_that_is_left() -> None:
    chain = (share_directory() / "urdf" / "planar_chain.urdf").read_text("utf-8")
    robot = robot_of(chain)
    plant = FaultyPlant(VelocityPlant(robot, TICK), ["joint_stuck pin_1"], TICK, wrench=False)
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.0, 0.0, 0.1]).as_quat())
    method = gait(chain, "pin_1", method="square_path")
    for rates in method.plan(state_of(plant), goal).velocities:
        plant.step(rates)
    left = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(goal.quaternion)
    assert left.magnitude() < 1e-3
    assert plant.q[0] == 0.0


def test_a_method_that_leaves_the_position_does_not_stand_in_for_one_that_does_not() -> None:
    chain = (share_directory() / "urdf" / "planar_chain.urdf").read_text("utf-8")
    method = RemainingJointsGait(
        robot_of(chain),
        TICK,
        Tolerance(1e-3, 1e-3),
        stuck=["pin_1"],
        method="auto",
        options={},
        controls=frozenset({"position", "attitude"}),
    )
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.0, 0.0, 0.1]).as_quat())
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(2))
    with pytest.raises(PlanningError, match="optimal would leave the position as it comes"):
        method.plan(state, goal)


@pytest.mark.parametrize("gait", [ramp, swing])
def test_commands_that_do_not_arrive_for_a_while_jam_no_joint(
    gait: Callable[[float], Array],
) -> None:
    def away(time: float) -> float:
        return 0.0 if 10.0 <= time < 10.0 + 4 * NEEDED * TICK else 1.0

    assert not watched(gait, away)


@pytest.mark.parametrize("gait", [ramp, swing])
def test_joints_that_never_follow_again_are_found_in_the_end(
    gait: Callable[[float], Array],
) -> None:
    found = watched(gait, lambda time: 0.0 if time >= 10.0 else 1.0)
    assert set(found) == {0, 1}
    assert 10.0 + 4 * NEEDED * TICK < min(found.values()) < 10.0 + 20 * NEEDED * TICK
