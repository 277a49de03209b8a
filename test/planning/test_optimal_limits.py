"""What optimal manoeuvres keep on their way, what is refused, and what is remembered."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from planning.test_optimal import ARM_START, CHAIN, QUICK, hinged
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.oracles.oracle import Motion
from support.planners import assert_within, planner_of
from support.tracked_flight import TrackedFlight, track, with_effort_limits

from spacerobot_ros import fly
from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.files import Cache
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot, model_functions
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState, Tolerance, plan
from spacerobot_ros.planning.core import progress
from spacerobot_ros.planning.core.method import BEYOND_EFFORT_LIMITS
from spacerobot_ros.planning.core.schedule import HeldMotion, JointEfforts
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.optimal.problem import OptimalOptions, PathConstraints
from spacerobot_ros.planning.methods.optimal.transcription import Stages, program
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState, VelocityPlant

EAST = [1.0, 0.0, 0.0]
SUN = [float(np.cos(0.3)), float(np.sin(0.3)), 0.0]


def of_arm(arm: SpaceRobot, turn: npt.ArrayLike, **options: Any) -> GaitSchedule:
    return plan(arm, rotvec=turn, start=ARM_START, **{**QUICK, **options})


def reached(schedule: GaitSchedule, turn: npt.ArrayLike) -> float:
    """Return the angle left to a goal, rad."""
    last = Rotation.from_quat(schedule.path.quaternion[-1])
    return float((last.inv() * Rotation.from_rotvec(turn)).magnitude())


# -- on the way -------------------------------------------------------------------------------


def test_the_base_turns_no_faster_than_it_may(arm: SpaceRobot) -> None:
    turn = [0.2, -0.1, 0.3]
    slow = of_arm(arm, turn, max_base_rate=0.12)
    attitudes = Rotation.from_quat(slow.path.quaternion)
    rates = (attitudes[:-1].inv() * attitudes[1:]).magnitude() / np.diff(slow.path.time)
    assert 0.08 < rates.max() <= 0.12
    assert reached(slow, turn) <= 1e-6


def test_an_axis_stays_out_of_a_cone(arm: SpaceRobot) -> None:
    turn = [0.0, 0.0, 0.6]

    def nearest(schedule: GaitSchedule) -> float:
        axes = Rotation.from_quat(schedule.path.quaternion).apply(EAST)
        return float(np.arccos(np.clip(axes @ SUN, -1, 1)).min())

    assert nearest(of_arm(arm, turn)) < 0.22
    away = of_arm(arm, turn, keep_axis=EAST, keep_direction=SUN, keep_angle=0.25)
    assert nearest(away) >= 0.25
    assert reached(away, turn) <= 1e-6


def test_joints_stay_out_of_a_box(arm: SpaceRobot) -> None:
    turn, far = [0.2, -0.1, 0.3], 1e9
    assert of_arm(arm, turn).positions[:, 1].max() > 0.0
    box = [-far, -0.7, -far, far, far, far]
    assert of_arm(arm, turn, keep_out=box).positions[:, 1].max() <= -0.7


def test_accelerations_are_limited_where_the_base_may_end_anywhere(arm: SpaceRobot) -> None:
    """Held commands that are too fast are changed, and nothing but the shape counts at the end."""
    start, final = np.array([-0.8, 0.0, 0.0]), np.array([-0.3, 0.2, -0.7])
    velocity, acceleration = np.array([0.3, 0.3, 0.5]), np.array([0.9, 0.3, 1.0])
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), start)
    schedule = plan(
        arm,
        start=state,
        joint_positions=final,
        base_attitude=0,
        base_position=2,
        max_velocity=velocity.tolist(),
        max_acceleration=acceleration.tolist(),
        **QUICK,
    )
    np.testing.assert_array_equal(schedule.positions[-1], final)
    steps = np.diff(np.vstack([start, start, schedule.positions, final]), axis=0)
    changes = np.abs(np.diff(steps, axis=0)).max(axis=0) / schedule.control_period**2
    assert np.all(changes <= acceleration * (1 + 1e-6))
    assert (changes / acceleration).max() > 0.999
    # No faster than the slowest joint allows, from rest to rest.
    way = np.abs(final - start)
    assert schedule.duration >= (way / velocity + velocity / acceleration).max()


def test_margins_are_kept_but_where_the_goal_is_in_them(arm: SpaceRobot) -> None:
    turn, margin = [0.2, -0.1, 0.3], np.array([2.5, 1.0, 0.0])
    schedule = of_arm(arm, turn, joint_margin=margin.tolist())
    assert np.all(schedule.positions >= arm.lower + margin - 1e-9)
    assert np.all(schedule.positions <= arm.upper - margin + 1e-9)
    inside = of_arm(arm, turn, joint_margin=margin.tolist(), joint_positions=[0.8, -0.8, 1.0])
    assert inside.positions[-1, 0] == pytest.approx(0.8)
    assert inside.positions[:, 0].max() <= 0.8 + 1e-9


class SlowClock:
    """A clock that goes on whenever it is asked for the time, s: a machine that is that busy."""

    def __init__(self, step: float = 10.0) -> None:
        self.now, self._step = 0.0, step

    def monotonic(self) -> float:
        self.now += self._step
        return self.now


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have 20 ms go by whenever a search asks for the time, on any machine."""
    monkeypatch.setattr(progress, "time", SlowClock(0.02))


@pytest.mark.usefixtures("ticking")
def test_a_search_cut_short_gives_the_best_so_far(arm: SpaceRobot) -> None:
    turn = [0.5, -0.6, 0.4]
    hasty = of_arm(arm, turn, time_budget=0.7, answers=12, agreeing=0)
    assert float(str(hasty.notes["starts"])) < 12
    assert "optimal.time_budget, 0.7 s" in str(hasty.notes["cut_short"])
    assert reached(hasty, turn) <= 1e-6
    assert_within(hasty, arm.velocity_limit, arm.velocity_limit / 0.5)


def test_all_searches_of_a_plan_share_its_time(
    arm: SpaceRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A base that drifts is planned for at once, then for its passes of the goal, then for any."""
    clock = SlowClock(0.02)
    monkeypatch.setattr(progress, "time", clock)
    few: dict[str, Any] = {"iterations": 4, "starts": 24, "angular_momentum": [1.5, -0.6, 1.1]}
    with pytest.raises(PlanningError, match=r"within optimal\.time_budget 0\.5 s"):
        of_arm(arm, [0.5, -0.6, 0.4], time_budget=0.5, **few)
    assert 2.5 < clock.now < 4.0


def test_a_plan_is_the_same_on_a_busy_machine(
    arm: SpaceRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    turn = [0.2, -0.3, 0.25]
    quiet = of_arm(arm, turn, answers=2)
    monkeypatch.setattr(progress, "time", SlowClock())
    busy = of_arm(arm, turn, answers=2)
    assert busy.positions.tobytes() == quiet.positions.tobytes()
    assert busy.notes == quiet.notes
    assert "cut_short" not in quiet.notes


@pytest.mark.slow
def test_a_plan_is_the_same_with_compiled_functions_and_without(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """From an empty cache, from one that is filled, and in the virtual machine."""
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    asked: dict[str, Any] = {"rotvec": [0, 0, 2.5], "cache": 0, "intervals": 40}
    plans = [plan("planar_chain", **asked).positions.tobytes() for _ in range(2)]
    assert not list(tmp_path.glob("*.so")), "a plan waits for no compiler"
    asked_clear = {**asked, "rotvec": (0.09, -0.26, -0.21), "clearance": 0.03, "answers": 1}
    plans += [plan("three_joint_arm", **asked_clear).positions.tobytes() for _ in range(2)]
    assert list(tmp_path.glob("interval_hess*.so")), "a search for a clear path takes longer"
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    assert plans[:2] == [plan("planar_chain", **asked).positions.tobytes()] * 2
    assert plans[2:] == [plan("three_joint_arm", **asked_clear).positions.tobytes()] * 2


def test_a_plan_waits_for_no_compiler_of_its_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {"rotvec": [0, 0, 0.4], "cache": 0, "intervals": 20}
    expected = plan("planar_chain", **asked).positions

    def refuse(function: ca.Function) -> ca.Function:
        raise AssertionError(f"{function.name()} is compiled")

    monkeypatch.setattr(model_functions, "compiled", refuse)
    # By another name it is another robot, of which nothing is known yet.
    text = CHAIN
    again = SpaceRobot(parse_robot(text.replace('name="planar_chain"', 'name="chain_anew"')))
    np.testing.assert_array_equal(plan(again, **asked).positions, expected)


@pytest.mark.usefixtures("ticking")
def test_a_plan_that_was_cut_short_is_not_kept(
    arm: SpaceRobot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    turn = [0.2, -0.3, 0.25]
    hasty = of_arm(arm, turn, answers=12, agreeing=0, time_budget=0.5, cache=1)
    assert "cut_short" in hasty.notes
    assert not list(tmp_path.rglob("*.json"))
    whole = of_arm(arm, turn, time_budget=600.0, cache=1)
    assert "cut_short" not in whole.notes
    assert len(list(tmp_path.rglob("*.json"))) == 1


def test_every_start_has_a_limit_of_its_own(arm: SpaceRobot) -> None:
    asked: dict[str, Any] = {"iterations": 2, "starts": 4}
    with pytest.raises(PlanningError, match=r"from 4 starts: .* More optimal\.starts") as one:
        of_arm(arm, [0.5, -0.6, 0.4], **asked)
    with pytest.raises(PlanningError) as two:
        of_arm(arm, [0.5, -0.6, 0.4], **asked)
    assert str(one.value) == str(two.value)


# -- refusals ---------------------------------------------------------------------------------


def test_two_links_turn_but_not_in_place() -> None:
    """One joint turns the base to and fro: by its shape, and by no loop."""
    robot = SpaceRobot.from_urdf(hinged("0 0 1", height=0.0))
    schedule = plan(robot, rotvec=[0, 0, 0.3], **QUICK)
    assert reached(schedule, [0, 0, 0.3]) <= 1e-6
    with pytest.raises(PlanningError, match="uncontrollable if the final shape is given"):
        plan(robot, rotvec=[0, 0, 0.3], final_shape=1, **QUICK)
    with pytest.raises(PlanningError, match="no joints"):
        plan(SpaceRobot.from_urdf(hinged()), rotvec=[0, 0, 0.3], **QUICK)


def test_joints_without_a_velocity_limit_are_refused_with_the_remedies() -> None:
    text = CHAIN.replace("revolute", "continuous")
    free = SpaceRobot.from_urdf(re.sub(r"<limit[^>]*/>", "", text))
    with pytest.raises(ParameterError) as refusal:
        plan(free, rotvec=[0, 0, 0.2], **QUICK)
    assert str(refusal.value) == (
        "Joint 'pin_1' has no velocity limit, which optimal requires: give it "
        '<limit velocity="..." effort="..."/> in the URDF, or optimal.max_velocity.'
    )
    assert plan(free, rotvec=[0, 0, 0.2], max_velocity=[0.5, 0.5], **QUICK).ticks > 0
    stiff = SpaceRobot.from_urdf(re.sub(r'(<limit[^>]* velocity=)"[^"]*"', r'\1"0"', text, count=1))
    with pytest.raises(ParameterError, match=r"'pin_1' has a velocity limit of 0, .*make it fixed"):
        plan(stiff, rotvec=[0, 0, 0.2], **QUICK)


def test_a_start_that_breaks_a_constraint_is_refused(arm: SpaceRobot) -> None:
    with pytest.raises(PlanningError, match=r"The start violates .*: the shape enters a keep_out"):
        of_arm(arm, [0, 0, 0.1], keep_out=[-1, -1, 1, 1, 0, 2])


# -- derivatives ------------------------------------------------------------------------------


def test_derivatives_of_the_program_are_those_of_its_functions(arm: SpaceRobot) -> None:
    """The Jacobian and the Hessian that are put together, against CasADi's own."""
    constraints = PathConstraints.of(
        arm,
        OptimalOptions(
            max_base_rate=0.2,
            keep_axis=tuple(EAST),
            keep_direction=tuple(SUN),
            keep_angle=0.2,
            keep_out=(0.5, 0.0, 0.0, 1.0, 1.0, 1.0),
        ),
    )
    q, v, a = (ca.SX.sym(name, 3) for name in "qva")
    power = ca.Function("power", [q, v, a], [5.0 - ca.cos(q) * v * a])
    stages = Stages.of(arm, np.eye(3), position=True, constraints=constraints, inequality=power)
    made = program(stages, 3)
    x, p, g = (made.problem[name] for name in ("x", "p", "g"))
    lam = ca.MX.sym("lam", g.numel())
    lagrangian = 0.7 * made.problem["f"] + ca.dot(lam, g)
    plain = ca.Function(
        "plain", [x, p, lam], [ca.jacobian(g, x), ca.triu(ca.hessian(lagrangian, x)[0])]
    )
    rng = np.random.default_rng(0)
    at, of, by = (rng.uniform(0.2, 0.8, s.numel()) for s in (x, p, lam))
    jacobian, hessian = plain(at, of, by)
    values, jac = made.jac_g(at, of)
    assert values.numel() == len(made.lower) == len(made.upper)
    np.testing.assert_allclose(jac.full(), jacobian.full(), atol=1e-9)
    found = made.hess_lag(at, of, 0.7, by).full()
    np.testing.assert_allclose(found, hessian.full(), rtol=1e-9, atol=1e-8)


# -- plans that were kept are flown for the same request, and only if they are whole -------------


ASKED: dict[str, Any] = {**QUICK, "cache": 1, "rotvec": [0, 0, 0.3], "joint_positions": [0.4, 0.1]}


@pytest.fixture(scope="module")
def made(chain: SpaceRobot, tmp_path_factory: pytest.TempPathFactory) -> tuple[GaitSchedule, Path]:
    """Return a plan and the file that it was kept in."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(folder))
        schedule = plan(chain, **ASKED)
    (kept,) = (folder / "plans").iterdir()
    return schedule, kept


@pytest.fixture
def cache(
    made: tuple[GaitSchedule, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    no_search: None,
) -> Cache:
    """Return a cache of this test's own with that plan; a search for another one fails."""
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    cache = Cache(tmp_path / "plans")
    cache.folder.mkdir()
    shutil.copy(made[1], cache.folder)
    return cache


@pytest.mark.parametrize("bit", [100, 1200, -40])
def test_one_bit_makes_a_plan_another(
    bit: int, chain: SpaceRobot, cache: Cache, caplog: pytest.LogCaptureFixture
) -> None:
    (kept,) = cache.folder.iterdir()
    whole = bytearray(kept.read_bytes())
    whole[bit] ^= 1
    kept.write_bytes(whole)
    with pytest.raises(PlanningError, match="A search was begun"):
        plan(chain, **ASKED)
    assert "it is damaged" in caplog.text


@pytest.mark.parametrize(
    "options",
    [
        {"keep_out": [0.05, -10.0, 10.0, 10.0]},
        {"max_base_rate": 1e-4},
        {"max_velocity": [0.01, 0.01]},
        {"rotvec": [0, 0, 0.31]},
        {"joint_positions": [0.4, 0.2]},
        {"start": [0.01, 0.0]},
        {"duration": 100.0},
        {"control_period": 0.05},
        {"effort_limits": 1},
        {"robot": ('"120"', '"121"')},
        {"robot": ('effort="', 'effort="9')},
    ],
)
def test_only_the_plan_of_the_same_request_is_flown(
    options: dict[str, Any], chain: SpaceRobot, made: tuple[GaitSchedule, Path], cache: Cache
) -> None:
    first, again = made[0], plan(chain, **ASKED)
    np.testing.assert_array_equal(again.positions, first.positions)
    for part in ("time", "position", "quaternion"):
        np.testing.assert_array_equal(getattr(again.path, part), getattr(first.path, part))
    assert again.notes == {**first.notes, "from_cache": 1.0}
    other = {"robot": chain, **ASKED, **options}
    if "robot" in options:
        other["robot"] = SpaceRobot.from_urdf(CHAIN.replace(*options["robot"]))
    with pytest.raises(PlanningError, match="A search was begun"):
        plan(**other)


# -- limits of efforts ----------------------------------------------------------------------------


PERIOD = 0.01
SHORT: dict[str, Any] = {"cache": 0, "answers": 1, "intervals": 20, "control_period": PERIOD}
CHAIN_START, CHAIN_TURN = [np.pi, -np.pi], [0.0, 0.0, 0.3]


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
    asked: dict[str, Any] = {"rotvec": CHAIN_TURN, "start": CHAIN_START, **SHORT}
    fast = plan(free, **asked)
    peak = np.abs(track(free, fast).asked).max(axis=0)
    assert "effort" not in str(fast.notes["limited_by"])
    # What the controller asks for is what the planner predicts, but for feedback.
    shares = JointEfforts(free, np.ones(2)).shares(HeldMotion(fast.positions, PERIOD))
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
    asked: dict[str, Any] = {"rotvec": [0, 0, 0.1], "start": CHAIN_START, **SHORT, "starts": 1}
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
    asked: dict[str, Any] = {"rotvec": CHAIN_TURN, "start": CHAIN_START, **SHORT, "starts": 1}
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
        ("seven_joint_arm", [0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0], [0.05, -0.03, 0.04]),
    ],
)
def test_bags_of_servos_with_a_tenth_of_the_efforts_keep_them(
    name: str, start: list[float], turn: list[float], tmp_path: Path
) -> None:
    """No option is set; efforts are Pinocchio's, of the positions and velocities in the bag."""
    urdf = robot_file(name).read_text("utf-8")
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
        omega = oracle.base_twist(q[k], mean)[3:]
        still, attitude = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        motion = Motion(q[k], mean, attitude, still, still, omega)
        # The base goes as no force from outside acts; the joints are accelerated.
        H, C = oracle.mass_matrix(motion), oracle.bias(motion)
        base = np.linalg.solve(H[:6, :6], -H[:6, 6:] @ change - C[:6])
        tau = H[6:, :6] @ base + H[6:, 6:] @ change + C[6:]
        np.testing.assert_allclose(efforts[k + 1], tau, rtol=1e-6, atol=1e-6 * taken.max())
        largest = np.maximum(largest, np.abs(tau))
    share = largest / robot.effort_limit
    assert 0.9 < share.max() <= 1 + 1e-5
    assert slow.time[-1] > 1.3 * fast.time[-1]


@pytest.mark.parametrize(
    ("settings", "effort_limits", "links"),
    [
        ({}, 0, ("end_effector",)),
        ({"output": "trajectory"}, 0, ("end_effector",)),
        ({"output": "reference"}, 1, ()),
        ({"output": "reference", "optimal.effort_limits": 2}, 2, ()),
        ({"optimal.effort_limits": 1}, 1, ("end_effector",)),
    ],
)
def test_efforts_have_a_reserve_where_a_controller_is_given_a_reference(
    settings: dict[str, Any], effort_limits: int, links: tuple[str, ...]
) -> None:
    config: PlannerConfig = configured(PlannerConfig, settings)
    assert config.method_options["optimal"].effort_limits == effort_limits
    assert config.goal_links == links


def test_a_correction_keeps_them(chain: SpaceRobot) -> None:
    chosen: dict[str, Any] = {"cache": 0, "intervals": 20, "effort_limits": 1}
    chosen["max_effort"] = [0.05, 0.04]
    tolerance = Tolerance(1e-3, 1e-3, 1e-3)
    planner = planner_of("optimal", chain, PERIOD, tolerance, **chosen)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.4, -0.3]))
    goal = Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, 0.02]).as_quat())
    schedule = planner.plan(state, goal, correction=True)
    motion = HeldMotion(schedule.positions, PERIOD)
    shares = JointEfforts(chain, np.array([0.05, 0.04])).shares(motion)
    assert 0.5 < np.abs(shares).max() <= 0.85 * (1 + 1e-8)


@pytest.mark.slow
def test_a_given_duration_is_long_enough_or_refused(chain: SpaceRobot) -> None:
    asked: dict[str, Any] = {"rotvec": CHAIN_TURN, "start": CHAIN_START, **SHORT, "starts": 2}
    limited: dict[str, Any] = {"effort_limits": 1, "max_effort": [3.4, 1.6]}
    schedule = plan(chain, **asked, **limited, duration=4.0)
    assert schedule.duration == pytest.approx(4.0)
    motion = HeldMotion(schedule.positions, PERIOD)
    shares = JointEfforts(chain, np.array([3.4, 1.6])).shares(motion)
    assert np.abs(shares).max() <= 0.85 * (1 + 1e-8)
    with pytest.raises(PlanningError, match=r"= 1\.5 s: the fastest one found takes 3"):
        plan(chain, **asked, **limited, duration=1.5)
    # The limits of the robot are kept where they can be: nobody asked for them.
    weak = SpaceRobot.from_urdf(with_effort_limits(CHAIN, {"pin_1": 3.4, "pin_2": 1.6}))
    hurried = plan(weak, **asked, duration=1.5)
    assert "times its limit of 3.4 N m" in str(hurried.notes[BEYOND_EFFORT_LIMITS])


def test_a_motor_without_effort_is_refused(chain: SpaceRobot) -> None:
    with pytest.raises(ParameterError, match="'pin_2' is limited to an effort of 0"):
        plan(chain, rotvec=[0, 0, 0.1], **SHORT, effort_limits=1, max_effort=[1.0, 0.0])
