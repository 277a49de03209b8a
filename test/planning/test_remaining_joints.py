"""Stuck joints are found, and goals are planned with the joints that remain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.flown import measured
from scipy.spatial.transform import Rotation
from support.effort_flights import robot_of
from support.planners import Planner
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
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
from spacerobot_ros.planning.core.goal import Controlled
from spacerobot_ros.planning.execution import worker as worker_module
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.tracker import StuckJointWatch
from spacerobot_ros.planning.execution.worker import PlanningTask, PlanningWorker
from spacerobot_ros.planning.methods.registry import RemainingJointsGait
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState, VelocityPlant
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.config import PlantConfig

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
        for joint in watch.find_stuck(measured, wanted, velocity):
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


@pytest.mark.slow
@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.8])
def test_a_slow_joint_is_not_stuck(gait: Callable[[float], Array], share: float) -> None:
    assert watched(gait, from_time(5.0, 0, share), seconds=200.0) == {}


def test_a_joint_that_is_not_commanded_or_not_watched_is_not_stuck() -> None:
    assert watched(ramp, from_time(0.0, 2)) == {}
    assert watched(ramp, from_time(0.0, 0), least=0) == {}


@pytest.mark.slow
@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("band", [0.0, 8e-3])
def test_noise_makes_no_joint_stuck(gait: Callable[[float], Array], band: float) -> None:
    assert watched(gait, lambda _: np.ones(3), noise=1e-3, band=band, seconds=300.0) == {}


@pytest.mark.parametrize("band", [0.0, 8e-3])
def test_a_stuck_joint_is_found_in_noise(band: float) -> None:
    found = watched(ramp, from_time(10.0, 0), noise=1e-3, band=band)
    assert list(found) == [0]
    assert found[0] < 20.0


def found_at(goes: Callable[[int], float], ticks: int = 10 * NEEDED) -> int | None:
    """Return the tick at which the first joint is found stuck, counted from the first one watched.

    It is commanded 1 mm a tick and goes, from tick 0, as the function of the tick says (mm); the
    second joint follows.
    """
    watch = StuckJointWatch(3, NEEDED, TICK)
    velocity = np.array([1e-3, 1e-3, 0.0]) / TICK
    for tick in range(-15, ticks):
        q = np.array([goes(max(tick, 0)), tick, 0.0]) * 1e-3
        wanted = np.array([tick + 30.0, tick + 1e-3, 0.0]) * 1e-3
        stuck = watch.find_stuck(q, wanted, velocity)
        assert stuck in ([], [0])
        if stuck:
            return tick + 1
    return None


def test_noise_that_hides_a_stuck_joint_for_a_while_does_not_hide_it_for_ever() -> None:
    """Noise of a tenth of the way is not following: twice the way is waited for, then more."""
    assert found_at(lambda _: 0.0) == NEEDED
    assert found_at(lambda tick: 0.09 * NEEDED * (tick % 2)) == 2 * NEEDED
    assert found_at(lambda tick: 0.19 * NEEDED * (tick % 2)) == 4 * NEEDED


def test_what_a_slow_joint_has_gone_counts_until_it_has_followed() -> None:
    """One that stops after a while is compared with all the way since it was last seen to follow:
    slow until then, it is given longer; having followed, it is not."""
    for share, found in ((0.18, 4), (0.45, 16), (0.55, 2)):
        assert found_at(lambda tick, s=share: s * min(tick, NEEDED), 20 * NEEDED) == found * NEEDED  # type: ignore[misc]


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


# -- goals are planned with the joints that remain ----------------------------------------------


SERVICER, ARM, CHAIN = (
    robot_file(name).read_text("utf-8") for name in ("servicer", "three_joint_arm", "planar_chain")
)
SHAPE = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])
CONFIG = PlantConfig(actuation="velocity", tick_rate=1 / TICK)


def gait(
    urdf: str,
    places: npt.ArrayLike,
    *stuck: str,
    method: str = "area_loop",
    required: frozenset[Controlled] = frozenset(),
    **options: Any,
) -> Planner:
    """Return a planner for goals without some joints, where these are in the shape ``places``."""
    robot = robot_of(urdf)
    where = dict(zip(robot.joint_names, np.asarray(places).tolist(), strict=True))
    without = RemainingJointsGait(
        robot,
        TICK,
        DEFAULT_INTEGRATION_STEP,
        stuck={name: where[name] for name in stuck},
        method=method,
        options={method: method_options(method, options)} if options else {},
        required=required,
    )
    return Planner(without, Tolerance(1e-3, 1e-3))


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
    plant = PlantWithFaults(inner, replace(CONFIG, faults=("joint_stuck elbow_pitch",)))
    method = gait(SERVICER, SHAPE, "elbow_pitch", k=0.5, **options)
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.01, 0.005, -0.01]).as_quat())
    for _ in range(30):
        schedule = method.plan(measured(plant), goal)
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


@pytest.mark.parametrize("named", [False, True])
def test_options_of_joints_are_those_of_the_joints_that_are_left(named: bool) -> None:
    """Three joints, and directions of three numbers: only what is of joints gets shorter."""
    start = np.array([0.1, -0.7, 1.5])
    speeds = np.array([0.5, 0.02, 0.3])
    by_name = dict(zip(robot_of(ARM).joint_names, speeds.tolist(), strict=True))
    quick: dict[str, Any] = {"starts": 2, "answers": 1, "intervals": 20, "cache": 0}
    method = gait(
        *(ARM, start, "shoulder_yaw"),
        method="optimal",
        base_attitude=0,
        base_position=2,
        max_velocity=by_name if named else speeds.tolist(),
        keep_axis=[1.0, 0.0, 0.0],
        keep_direction=[0.0, 0.0, 1.0],
        keep_angle=0.5,
        **quick,
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
        PlanningError, match=r"stuck at 2 rad; the goal requires .*'elbow_pitch' at 2\.1"
    ):
        gait(SERVICER, SHAPE, "elbow_pitch").plan(state, goal)


def test_a_chain_turns_its_base_by_the_one_pin_that_is_left() -> None:
    stuck = replace(CONFIG, faults=("joint_stuck pin_1",))
    plant = PlantWithFaults(VelocityPlant(robot_of(CHAIN), TICK), stuck)
    goal = Goal(np.zeros(3), Rotation.from_rotvec([0.0, 0.0, 0.1]).as_quat())
    method = gait(CHAIN, plant.q, "pin_1", method="square_path")
    for rates in method.plan(measured(plant), goal).velocities:
        plant.step(rates)
    left = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(goal.quaternion)
    assert left.magnitude() < 1e-3
    assert plant.q[0] == 0.0


def test_a_method_that_leaves_the_position_does_not_stand_in_for_one_that_does_not() -> None:
    required: frozenset[Controlled] = frozenset({"position", "attitude"})
    method = gait(CHAIN, np.zeros(2), "pin_1", method="auto", required=required)
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
