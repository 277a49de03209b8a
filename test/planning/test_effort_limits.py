"""Joint efforts within limits: flown in the plant under efforts, tracked by computed torque."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.test_optimal import FOLDER
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.oracles.oracle import Motion
from support.planners import planner_of
from support.tracked_flight import TrackedFlight, track, with_effort_limits
from support.urdf_text import link

from spacerobot_ros import fly
from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState, Tolerance, plan
from spacerobot_ros.planning.core.joint_efforts import JointEfforts
from spacerobot_ros.planning.core.method import BEYOND_EFFORT_LIMITS
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.optimal.search import ManoeuvreSearch
from spacerobot_ros.simulation import InitialState, VelocityPlant

Array = npt.NDArray[np.float64]

PERIOD = 0.01
QUICK: dict[str, Any] = {"cache": 0, "answers": 1, "intervals": 20, "control_period": PERIOD}
CHAIN = (FOLDER / "planar_chain.urdf").read_text(encoding="utf-8")
CHAIN_START, CHAIN_TURN = [np.pi, -np.pi], [0.0, 0.0, 0.3]


def seven_joints() -> str:
    """Return an arm of seven joints on a base of 100 kg, as URDF."""
    parts = [link("base", 100.0, np.diag([9.0, 8.0, 10.0]), np.zeros(3))]
    lengths, masses = [0.15, 0.2, 0.2, 0.2, 0.2, 0.1, 0.1], [4.0, 4.0, 3.0, 3.0, 2.0, 2.0, 1.0]
    parent, origin = "base", "0.3 0.1 0.4"
    for k, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        across = mass * length**2 / 12 + 0.01
        moments = np.diag([across, 1.1 * across, 0.01])
        parts.append(link(f"l{k}", mass, moments, np.array([0.02, 0.01, length / 2])))
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>'
            f'<origin xyz="{origin}"/><axis xyz="{"0 1 0" if k % 2 else "0 0 1"}"/>'
            '<limit lower="-2.7" upper="2.7" velocity="1.2" effort="87"/></joint>'
        )
        parent, origin = f"l{k}", f"0 0 {length}"
    return f'<robot name="seven">{"".join(parts)}</robot>'


def tenth(urdf: str, peak: Array) -> SpaceRobot:
    """Return the robot with limits of a tenth of these efforts (n,)."""
    names = SpaceRobot.from_urdf(urdf).joint_names
    limits = dict(zip(names, (0.1 * peak).tolist(), strict=True))
    robot = SpaceRobot.from_urdf(with_effort_limits(urdf, limits))
    np.testing.assert_allclose(robot.effort_limit, 0.1 * peak)
    return robot


def assert_flies(
    robot: SpaceRobot, schedule: GaitSchedule, turn: npt.ArrayLike, within: float
) -> TrackedFlight:
    flight = track(robot, schedule)
    assert np.all(np.abs(flight.realised) <= robot.effort_limit)
    # Not because anything was clipped: feedback may ask for a little more in single ticks, where
    # accelerations jump from one limit to the other.
    beyond = np.any(np.abs(flight.asked) > robot.effort_limit, axis=1)
    assert beyond.mean() <= 0.01
    left = Rotation.from_quat(flight.quaternion).inv() * Rotation.from_rotvec(turn)
    assert left.magnitude() <= within
    return flight


@pytest.mark.slow
def test_a_chain_keeps_a_tenth_of_its_efforts() -> None:
    free = SpaceRobot.from_urdf(CHAIN)
    asked: dict[str, Any] = {"rotvec": CHAIN_TURN, "start": CHAIN_START, **QUICK}
    fast = plan(free, **asked)
    peak = np.abs(track(free, fast).asked).max(axis=0)
    assert "effort" not in str(fast.notes["limited_by"])
    # What the controller asks for is what the planner predicts, but for feedback.
    shares = JointEfforts(free, np.ones(2), PERIOD).shares(fast.positions)
    np.testing.assert_allclose(np.abs(shares).max(axis=0), peak, rtol=0.1)
    # Limits that are not reached change nothing, and neither do those that are not to be kept.
    for unlimited in ({"effort_limits": 1}, {"max_effort": [1.0, 1.0], "effort_limits": 2}):
        same = plan(free, **asked, **unlimited)
        assert same.positions.tobytes() == fast.positions.tobytes()
    robot = tenth(CHAIN, peak)
    slow = plan(robot, **asked, effort_limits=1)
    assert_flies(robot, slow, CHAIN_TURN, 1e-5)
    assert "effort of pin_" in str(slow.notes["limited_by"])
    # The same path would take the root of 10 times as long, and of 1 / 0.85 for the reserve.
    assert fast.duration * 1.5 < slow.duration < fast.duration * 3.5


def test_servos_keep_a_tenth_of_the_efforts_by_default() -> None:
    """Effort limits that nobody asked for, in the plant under joint velocities."""
    asked: dict[str, Any] = {"rotvec": [0, 0, 0.1], "start": CHAIN_START, **QUICK, "starts": 1}
    asked["control_period"] = 0.05
    free = SpaceRobot.from_urdf(CHAIN)
    fast = plan(free, **asked)
    taken = np.abs(efforts_of_servos(free, fast)).max(axis=0)
    robot = tenth(CHAIN, taken)
    slow = plan(robot, **asked)
    share = np.abs(efforts_of_servos(robot, slow)) / robot.effort_limit
    assert 0.9 < share.max() <= 1 + 1e-6
    assert BEYOND_EFFORT_LIMITS not in slow.notes
    careless = plan(robot, **asked, effort_limits=2)
    assert careless.positions.tobytes() == fast.positions.tobytes()
    peak = f"pin_1 requires {taken[0]:.4g} N m, 10 times its limit of {taken[0] / 10:.4g} N m, "
    assert str(careless.notes[BEYOND_EFFORT_LIMITS]).startswith(peak + "pin_2 requires")


@pytest.mark.parametrize("effort", [0.0, 1e9])
def test_unknown_and_strong_motors_change_nothing(effort: float) -> None:
    asked: dict[str, Any] = {"rotvec": CHAIN_TURN, "start": CHAIN_START, **QUICK, "starts": 1}
    limits = {"pin_1": effort, "pin_2": effort}
    robot = SpaceRobot.from_urdf(with_effort_limits(CHAIN, limits))
    same, free = plan(robot, **asked), plan(SpaceRobot.from_urdf(CHAIN), **asked, effort_limits=2)
    assert same.positions.tobytes() == free.positions.tobytes()
    assert BEYOND_EFFORT_LIMITS not in same.notes


def test_a_gait_beyond_effort_limits_says_so() -> None:
    limits = {"pin_1": 0.4, "pin_2": 50.0}
    robot = SpaceRobot.from_urdf(with_effort_limits(CHAIN, limits))
    schedule = plan(robot, method="square_path", rotvec=CHAIN_TURN, start=CHAIN_START)
    taken = np.abs(efforts_of_servos(robot, schedule)).max(axis=0)
    assert schedule.notes[BEYOND_EFFORT_LIMITS] == (
        f"pin_1 requires {taken[0]:.4g} N m, {taken[0] / 0.4:.3g} times its limit of 0.4 N m"
    )


def efforts_of_servos(robot: SpaceRobot, schedule: GaitSchedule) -> Array:
    """Return the efforts (ticks + 1, n) that the plant publishes when a schedule is flown."""
    h = schedule.control_period
    start = InitialState(joint_positions=schedule.positions[0])
    plant, efforts = VelocityPlant(robot, h, start), []
    for rates in [*(np.diff(schedule.positions, axis=0) / h), np.zeros(robot.n)]:
        plant.step(rates)
        efforts.append(plant.effort.copy())
    np.testing.assert_allclose(plant.q, schedule.positions[-1], atol=1e-9)
    return np.array(efforts)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "start", "turn"),
    [
        ("planar_chain", CHAIN_START, [0.0, 0.0, 0.3]),
        ("three_joint_arm", [0.0, -np.pi / 4, np.pi / 2], [0.2, -0.3, 0.25]),
        ("sliding_masses", [0.0, 0.0, 0.0], [0.2, -0.1, 0.1]),
        ("servicer", [0.0, -1.2, 2.0, 0.0, 0.8, 0.0], [0.1, -0.2, 0.5]),
        ("seven", [0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0], [0.05, -0.03, 0.04]),
    ],
)
def test_bags_of_servos_with_a_tenth_of_the_efforts_keep_them(
    name: str, start: list[float], turn: list[float], tmp_path: Path
) -> None:
    """No option is set; efforts are Pinocchio's, of the positions and velocities in the bag."""
    urdf = seven_joints() if name == "seven" else (FOLDER / f"{name}.urdf").read_text("utf-8")
    free = SpaceRobot.from_urdf(urdf)
    quick = {"answers": 1, "intervals": 40, "cache": 0}
    chosen: dict[str, Any] = {f"planner.optimal.{k}": value for k, value in quick.items()}
    chosen |= {f"{node}.tick_rate": 50.0 for node in ("plant", "planner")}
    chosen |= {"planner.position_tolerance": 10.0, "planner.optimal.base_position": 2}
    chosen["plant.initial_joint_positions"] = start
    asked: dict[str, Any] = {"rotvec": turn, "method": "optimal", "parameters": chosen}
    fast = fly(free, (0.0, 0.0, 0.0), **asked)
    taken = np.abs(fast.effort).max(axis=0)
    limits = dict(zip(free.joint_names, (0.1 * taken).tolist(), strict=True))
    robot = SpaceRobot.from_urdf(with_effort_limits(urdf, limits))
    slow = fly(robot, (0.0, 0.0, 0.0), **asked)
    assert slow.outcome is Outcome.REACHED
    slow.save(tmp_path / "slow.mcap")
    joints = read_bag(tmp_path / "slow.mcap")["/joint_states"]
    q, rates, efforts = (joints.field(each) for each in ("position", "velocity", "effort"))
    oracle = PinocchioOracle(urdf, robot.joint_names)
    largest = np.zeros(robot.n)
    for k in range(len(q) - 1):
        mean, change = (rates[k] + rates[k + 1]) / 2, (rates[k + 1] - rates[k]) * 50.0
        twist = oracle.base_twist(q[k], mean)
        attitude = np.array([0.0, 0.0, 0.0, 1.0])
        motion = Motion(q[k], mean, attitude, np.zeros(3), np.zeros(3), twist[3:])
        # The base goes as no force from outside acts; the joints are accelerated.
        at_rest = oracle.forward_dynamics(motion, np.zeros(6), np.zeros(robot.n))[6:]
        by_joint = [
            oracle.forward_dynamics(motion, np.zeros(6), unit)[6:] - at_rest
            for unit in np.eye(robot.n)
        ]
        tau = np.linalg.solve(np.column_stack(by_joint), change - at_rest)
        np.testing.assert_allclose(efforts[k + 1], tau, rtol=1e-6, atol=1e-6 * taken.max())
        largest = np.maximum(largest, np.abs(tau))
    share = largest / robot.effort_limit
    assert 0.9 < share.max() <= 1 + 1e-5
    assert slow.time[-1] > 1.3 * fast.time[-1]


def test_efforts_have_a_reserve_where_a_controller_is_given_a_reference(chain: SpaceRobot) -> None:
    def limits(settings: dict[str, Any]) -> int:
        config: PlannerConfig = configured(PlannerConfig, settings)
        return int(config.method_options["optimal"].effort_limits)

    assert limits({}) == 0
    assert limits({"output": "reference"}) == 1
    assert limits({"output": "reference", "optimal.effort_limits": 2}) == 2
    assert limits({"optimal.effort_limits": 1}) == 1


def test_a_correction_keeps_them(chain: SpaceRobot) -> None:
    chosen: dict[str, Any] = {"cache": 0, "intervals": 20, "effort_limits": 1}
    chosen["max_effort"] = [0.05, 0.04]
    tolerance = Tolerance(1e-3, 1e-3, 1e-3)
    planner = planner_of("optimal", chain, PERIOD, tolerance, **chosen)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.4, -0.3]))
    goal = Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, 0.02]).as_quat())
    schedule = planner.plan(state, goal, correction=True)
    shares = JointEfforts(chain, np.array([0.05, 0.04]), PERIOD).shares(schedule.positions)
    assert 0.5 < np.abs(shares).max() <= 0.85 * (1 + 1e-8)


@pytest.mark.slow
def test_a_given_duration_is_long_enough_or_refused(chain: SpaceRobot) -> None:
    asked: dict[str, Any] = {"rotvec": CHAIN_TURN, "start": CHAIN_START, **QUICK, "starts": 2}
    limited: dict[str, Any] = {"effort_limits": 1, "max_effort": [3.4, 1.6]}
    schedule = plan(chain, **asked, **limited, duration=4.0)
    assert schedule.duration == pytest.approx(4.0)
    shares = JointEfforts(chain, np.array([3.4, 1.6]), PERIOD).shares(schedule.positions)
    assert np.abs(shares).max() <= 0.85 * (1 + 1e-8)
    with pytest.raises(PlanningError, match=r"= 1\.5 s: the fastest one found takes 3"):
        plan(chain, **asked, **limited, duration=1.5)
    # The limits of the robot are kept where they can be: nobody asked for them.
    weak = SpaceRobot.from_urdf(with_effort_limits(CHAIN, {"pin_1": 3.4, "pin_2": 1.6}))
    hurried = plan(weak, **asked, duration=1.5)
    assert "times its limit of 3.4 N m" in str(hurried.notes[BEYOND_EFFORT_LIMITS])


def test_a_motor_without_effort_is_refused(chain: SpaceRobot) -> None:
    with pytest.raises(ParameterError, match="'pin_2' is limited to an effort of 0"):
        plan(chain, rotvec=[0, 0, 0.1], **QUICK, effort_limits=1, max_effort=[1.0, 0.0])


def test_a_plan_for_stronger_motors_is_not_taken_from_the_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    asked: dict[str, Any] = {"rotvec": CHAIN_TURN, "start": CHAIN_START, **QUICK, "cache": 1}
    strong, weak = (
        SpaceRobot.from_urdf(with_effort_limits(CHAIN, {"pin_1": limit, "pin_2": 50.0}))
        for limit in (90.0, 30.0)
    )
    plan(strong, **asked, effort_limits=1)

    def searching(*arguments: Any, **options: Any) -> None:
        raise PlanningError("searched")

    monkeypatch.setattr(ManoeuvreSearch, "search", searching)
    assert "from_cache" in plan(strong, **asked, effort_limits=1).notes
    for robot, limits in ((weak, 1), (strong, 2)):
        with pytest.raises(PlanningError, match="searched"):
            plan(robot, **asked, effort_limits=limits)
