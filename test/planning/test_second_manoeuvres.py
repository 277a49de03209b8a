"""Manoeuvres after the first one: from a moved and turned base, in another shape."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from planning.flown import fly, plant_at
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.planner_loop import (
    NEAR,
    TICK,
    HeldWorker,
    Loop,
    MovingStub,
    Place,
    PlantState,
    StubMethod,
    goal_at,
    robot_of,
)
from support.planner_phases import OTHER, long_flight, stub_of, stuck, until
from support.planners import planner_of
from support.slow import some_fast

from spacerobot_ros.errors import UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import GaitMethod, GaitSchedule, Goal, Tolerance
from spacerobot_ros.planning.execution.executive import Executive
from spacerobot_ros.planning.execution.measured_states import BaseMeasurement
from spacerobot_ros.planning.execution.status import Phase, PlannerState
from spacerobot_ros.planning.execution.worker import Planned, PlanningTask, Refused
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState, VelocityPlant

SECOND_TICK = 0.05
TOLERANCE = Tolerance(2e-3, 2e-3, 1e-6)
SIXTH: Place = ([0.03, 0.05, -0.02], [0.0, 0.0, 0.0])


# -- methods ----------------------------------------------------------------------------------

OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "lie_bracket": ("sliding_masses", {"t1": 10.0, "n1": 1, "loop_area": 0.2}),
    "area_loop": ("three_joint_arm", {"k": 0.9, "cycles_per_plan": 4}),
    "square_path": ("planar_chain", {}),
    "optimal": ("planar_chain", {"starts": 3, "answers": 1}),
}


def mass_centre(plant: VelocityPlant, robot: SpaceRobot) -> Array:
    """Return where the centre of mass of the system is in the world, which no joint can change."""
    attitude = Rotation.from_quat(plant.pose[3:])
    return np.asarray(plant.pose[:3] + attitude.apply(robot.center_of_mass(plant.q)))


def goals_of(name: str, robot: SpaceRobot, start: VelocityPlant) -> list[Goal]:
    """Return two goals that the method reaches one after the other."""
    attitude = Rotation.from_quat(start.pose[3:])
    turns = [[0.0, 0.0, 0.4], [0.0, 0.0, -0.9]]
    if name in ("lie_bracket", "area_loop"):
        turns = [[0.05, -0.1, 0.08], [-0.12, 0.03, -0.06]]
    shapes = {
        "lie_bracket": [[0.4, -0.6, 0.2], [-0.3, 0.5, 0.7]],
        "area_loop": [[0.3, -0.5, 1.1], [-0.2, -0.9, 1.6]],
    }.get(name, [[0.5, -0.7], [-0.3, 1.1]])
    goals = []
    for turn, shape in zip(turns, shapes, strict=True):
        attitude = attitude * Rotation.from_rotvec(turn)
        c = attitude.apply(robot.center_of_mass(np.array(shape)))
        position = mass_centre(start, robot) - c
        final = None if name == "lie_bracket" else shape
        goals.append(Goal.checked(position, attitude.as_quat(), final))
    return goals


@pytest.mark.parametrize("name", OPTIONS)
def test_a_second_goal_is_reached_from_where_the_first_manoeuvre_ended(name: str) -> None:
    robot_name, options = OPTIONS[name]
    robot = robot_of(robot_name)
    q = {"lie_bracket": [0.3, -0.2, 0.5], "area_loop": [0.2, -0.6, 1.3]}.get(name, [0.9, -1.2])
    planar = robot_name == "planar_chain"
    turned = Rotation.from_rotvec([0.0, 0.0, 1.1] if planar else [0.4, -0.7, 1.1])
    plant = plant_at(robot, q, SECOND_TICK, turned)
    method = planner_of(name, robot, SECOND_TICK, TOLERANCE, SECOND_TICK, **options)
    centre = mass_centre(plant, robot)
    for goal in goals_of(name, robot, plant):
        path = fly(method, plant, goal).pieces[-1].path
        np.testing.assert_allclose(path.position[-1], plant.pose[:3], atol=1e-6)
        np.testing.assert_allclose(path.quaternion[-1] @ plant.pose[3:], 1.0, atol=1e-6)
        left = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(goal.quaternion)
        assert left.magnitude() <= TOLERANCE.attitude + 1e-9
        assert np.linalg.norm(plant.pose[:3] - goal.position) <= 2 * TOLERANCE.position
        np.testing.assert_allclose(mass_centre(plant, robot), centre, atol=1e-6)
        if goal.joint_positions is not None:
            np.testing.assert_allclose(plant.q, goal.joint_positions, atol=1e-6)


# -- corrections ------------------------------------------------------------------------------


def test_corrections_of_one_goal_are_not_counted_for_the_next() -> None:
    """Every goal has all of its corrections, and its statuses count them from zero."""
    loop = Loop({"max_corrections": 2}, method=StubMethod(8))
    stub_of(loop).overshoot = 0.1
    for place in (NEAR, OTHER, SIXTH):
        before = len(loop.statuses)
        status = loop.decide(place)
        assert status.state is PlannerState.REACHED
        counted = [each.corrections for each in loop.statuses[before:]]
        assert counted[0] == 0
        assert counted[-1] == max(counted) > 0
    # Without any left the next one fails, though the ones before have used none of them.
    loop.set(max_corrections=0)
    assert loop.decide(NEAR).state is PlannerState.FAILED
    assert loop.statuses[-1].corrections == 0


def test_a_goal_that_takes_over_a_schedule_begins_with_no_correction() -> None:
    loop = Loop({"takeover_time": 0.3}, method=MovingStub(40))
    stub_of(loop).overshoot = 0.1
    loop.propose_goal(NEAR)
    while not loop.statuses or loop.statuses[-1].corrections == 0:
        loop.tick()
    assert loop.executive.phase is Phase.EXECUTING
    loop.propose_goal(NEAR)
    loop.tick()
    last = loop.statuses[-1]
    assert (last.goal_id, last.corrections) == ("goal-2", 0)
    # Another goal in motion: its plan takes over, and nothing of the first is counted for it.
    loop.propose_goal(OTHER)
    while (loop.statuses[-1].goal_id, loop.statuses[-1].state.value) != ("goal-3", "executing"):
        loop.tick()
    assert loop.statuses[-1].corrections == 0
    assert loop.statuses[-1].manoeuvre_time_s == pytest.approx(40 * SECOND_TICK)


# -- stuck joints -----------------------------------------------------------------------------


def test_a_second_stuck_joint_is_planned_without_beside_the_first() -> None:
    """The third slider sticks after the first: both rest from then on, where they are measured."""
    loop = stuck(long_flight())
    first_at = loop.plant.q[0]
    until(loop, Phase.PLANNING)
    assert dict(loop.held.tasks[-1].stuck_joint_positions) == {"slider_1": first_at}
    loop.held.release()
    until(loop, Phase.EXECUTING)
    # Let the first go on a little: it slips, and is found where it is then.
    loop.plant.q[0] += 1e-4
    loop.plant.hold(np.array([True, False, True]))
    until(loop, Phase.PLANNING)
    q = loop.plant.q.copy()
    task = loop.held.tasks[-1]
    assert dict(task.stuck_joint_positions) == {"slider_1": q[0], "slider_3": q[2]}
    assert task.required == {"position"}
    loop.held.release()
    until(loop, Phase.EXECUTING)
    loop.tick(20)
    commands = np.array(loop.commands[-20:])
    assert not commands[:, [0, 2]].any()
    assert commands[:, 1].any()
    assert [n.split(":")[1] for n in loop.notices if n.startswith("Stuck")] == [
        " slider_1. The remaining motion is planned without stuck joints.",
        " slider_1, slider_3. The remaining motion is planned without stuck joints.",
    ]
    # The next goal is planned for with all joints again.
    loop.plant.hold(np.zeros(3, dtype=np.bool_))
    loop.propose_goal(OTHER)
    until(loop, Phase.PLANNING)
    assert not loop.held.tasks[-1].stuck_joint_positions
    assert not loop.held.tasks[-1].required
    loop.held.release()
    until(loop, Phase.EXECUTING)
    loop.tick(20)
    assert np.all(np.array(loop.commands[-20:]).any(axis=0))


# -- limits that differ -----------------------------------------------------------------------


LIMITS = (
    '<limit lower="-2.9" upper="1.3" velocity="0.7" effort="11"/>',
    '<limit lower="-0.8" upper="2.6" velocity="0.4" effort="5"/>',
)


def unequal() -> SpaceRobot:
    """Return the chain with limits that differ by joint, side and kind."""
    urdf = robot_file("planar_chain").read_text("utf-8").replace("continuous", "revolute")
    limits = iter(LIMITS)
    return SpaceRobot.from_urdf(re.sub(r"<limit [^>]*/>", lambda _: next(limits), urdf))


@pytest.mark.parametrize(
    ("shape", "sentence"),
    [
        ([-2.95, 0.0], "'pin_1' at -2.95 rad, but its limits are [-2.9, 1.3] rad"),
        ([1.35, 0.0], "'pin_1' at 1.35 rad, but its limits are [-2.9, 1.3] rad"),
        ([0.0, -0.85], "'pin_2' at -0.85 rad, but its limits are [-0.8, 2.6] rad"),
        ([0.0, 2.65], "'pin_2' at 2.65 rad, but its limits are [-0.8, 2.6] rad"),
    ],
)
def test_a_goal_shape_is_held_against_the_limits_of_its_own_joint(
    shape: list[float], sentence: str
) -> None:
    method = planner_of("square_path", unequal(), SECOND_TICK, TOLERANCE, SECOND_TICK).method
    with pytest.raises(UnreachableError, match="violates joint limits: joint ") as refusal:
        method.goal_shape(replace(goal_at(NEAR), joint_positions=np.array(shape)))
    assert sentence in str(refusal.value)
    within = np.array([-2.85, 2.55])
    found = method.goal_shape(replace(goal_at(NEAR), joint_positions=within))
    np.testing.assert_array_equal(found, within)


@pytest.mark.parametrize("name", some_fast(["square_path", "optimal"], "square_path"))
def test_every_joint_keeps_its_own_limits_in_both_directions(name: str) -> None:
    robot = unequal()
    options: dict[str, Any] = {"starts": 3, "answers": 1, "cache": 0} if name == "optimal" else {}
    plant = plant_at(robot, [0.4, 0.3], SECOND_TICK, Rotation.from_rotvec([0.0, 0.0, -0.8]))
    method = planner_of(name, robot, SECOND_TICK, TOLERANCE, SECOND_TICK, **options)
    fastest = np.zeros(2)

    def watch(schedule: GaitSchedule) -> None:
        nonlocal fastest
        assert np.all(schedule.positions >= robot.lower - 1e-9)
        assert np.all(schedule.positions <= robot.upper + 1e-9)
        fastest = np.maximum(fastest, np.abs(schedule.velocities).max(axis=0))

    for turn, shape in ((0.3, [-2.5, 2.2]), (-0.2, [1.1, -0.6])):
        attitude = Rotation.from_quat(plant.pose[3:]) * Rotation.from_rotvec([0.0, 0.0, turn])
        goal = Goal.checked(plant.pose[:3], attitude.as_quat(), shape)
        fly(method, plant, goal, watch=watch)
        np.testing.assert_allclose(plant.q, shape, atol=1e-6)
    assert np.all(fastest <= np.array([0.7, 0.4]) * (1 + 1e-9))
    if name == "optimal":
        assert np.all(fastest >= 0.95 * np.array([0.7, 0.4])), "each is as fast as it may be"


SHAPES = {"planar_chain": np.array([0.3, -0.2]), "three_joint_arm": np.array([0.0, -0.785, 1.57])}
PLANNING_TIME = {"planar_chain": 0.3, "three_joint_arm": 0.8}
"""Simulated s that every plan takes; a plan in motion takes over just then."""


class SlowWorker(HeldWorker):
    """Plans in the background; every plan takes the same number of states."""

    def __init__(self, *arguments: Any, states: int, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._states, self._left = states, 0

    def start(self, task: PlanningTask) -> None:
        super().start(task)
        self._left = self._states

    def take_result(self) -> Planned | Refused | None:
        self._left -= 1
        if self._left < 0 or self.cancelled:
            self.release()
        return super().take_result()


class BalancedLoop(Loop):
    """Holds the momentum of all bodies, by Pinocchio, against zero at every tick."""

    largest = 0.0
    """kg m/s and kg m^2/s about the origin of the base."""

    def tick(self, count: int = 1, *, base: bool = True) -> None:
        plant, oracle = self.plant, oracle_of(self.plant.robot)
        for _ in range(count):
            super().tick(base=base)
            oracle.place(plant.q, plant.pose[3:], plant.pose[:3])
            u = oracle.joint_velocities(plant.qdot)
            u[:6] = plant.twist
            momentum = (oracle.own_mass_matrix() @ u)[:6]
            self.largest = max(self.largest, float(np.abs(momentum).max()))


@cache
def oracle_of(model: SpaceRobot) -> PinocchioOracle:
    return PinocchioOracle(model.description.urdf, model.joint_names)


def loop_of(robot: str, method: GaitMethod | None, **parameters: Any) -> BalancedLoop:
    loop = BalancedLoop(
        {"method": "optimal", "optimal.cache": 0, **parameters},
        robot=robot,
        method=method,
        initial=InitialState(joint_positions=SHAPES[robot]),
    )
    states = round(PLANNING_TIME[robot] / TICK) - 1
    loop.held = SlowWorker(robot_of(robot), loop.config, loop.method, states=states)
    loop.executive = Executive(robot_of(robot), loop.config, loop.held)
    return loop


def flown(loop: Loop, first: Goal, changed: Goal) -> float:
    """Change the goal halfway; return the time from then until it is reached, s."""
    loop.propose_goal(first)
    until(loop, Phase.EXECUTING)
    loop.tick(loop.starts[0].schedule.ticks // 2)
    before = len(loop.commands)
    loop.propose_goal(changed)
    # The position of the base is left open.
    decided = loop.until(PlannerState.REACHED_PARTLY, PlannerState.FAILED)
    assert decided.state is PlannerState.REACHED_PARTLY
    return TICK * (len(loop.commands) - before)


def goals(robot: str, rng: np.random.Generator) -> tuple[Goal, Goal]:
    """Return a goal, and the same one turned by a few degrees more."""

    def turn(least: float, most: float) -> Rotation:
        axis = np.array([0.0, 0.0, 1.0]) if robot == "planar_chain" else rng.normal(size=3)
        angle = rng.uniform(least, most) * rng.choice([-1, 1])
        return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))

    shape = SHAPES[robot] if robot == "planar_chain" else None
    first = turn(0.6, 1.2)
    changed = first * turn(0.03, 0.2)
    return tuple(Goal.checked(np.zeros(3), each.as_quat(), shape) for each in (first, changed))  # type: ignore[return-value]


def require_limits(loop: Loop, robot: str) -> None:
    """Check velocities, accelerations and travel of what was flown, by differences."""
    model = robot_of(robot)
    shapes = np.array(loop.shapes)
    rates = np.diff(shapes, axis=0) / TICK
    speed = model.velocity_limit
    assert (np.abs(rates) <= speed * (1 + 1e-6)).all()
    assert (np.abs(np.diff(rates, axis=0)) / TICK <= speed / 0.5 * (1 + 1e-4)).all()
    assert (shapes >= model.lower - 1e-9).all()
    assert (shapes <= model.upper + 1e-9).all()


@pytest.mark.slow
def test_a_goal_that_is_changed_halfway_is_reached_without_a_stop() -> None:
    """Four goals for each of two robots, against flights that stop before they are planned for."""
    shares: dict[str, list[float]] = {}
    began = time.process_time()
    for robot in SHAPES:
        rng = np.random.default_rng(11)
        method: GaitMethod | None = None
        for _ in range(4):
            pair = goals(robot, rng)
            stopping = loop_of(robot, method, takeover_time=0.0)
            method = stopping.method
            stop_and_go = flown(stopping, *pair)
            moving = loop_of(robot, method, takeover_time=PLANNING_TIME[robot])
            shares.setdefault(robot, []).append(flown(moving, *pair) / stop_and_go)
            require_limits(moving, robot)
            assert moving.largest < 1e-9
            assert all(t.target is not Phase.BRAKING for t in moving.transitions)
        print(robot, "time over that of stop and go:", np.round(shares[robot], 3))
    medians = {robot: np.median(each).round(3) for robot, each in shares.items()}
    of_all = np.median(list(shares.values()))
    print(f"medians {medians}, of all {of_all:.3f}; {time.process_time() - began:.0f} s CPU")
    assert of_all <= 0.8


class NoisyState(PlantState):
    """The measured state with noise of the base (1 mm, 0.87 mrad), the joints, and all rates."""

    @property
    def _noise(self) -> Array:
        """Numbers (2, 6 + n) of order one that are the same as long as the state is."""
        return np.random.default_rng(self.stamp_ns).normal(size=(2, 6 + len(self._plant.q)))

    @property
    def q(self) -> Array:
        return np.asarray(self._plant.q + 1e-3 * self._noise[0, 6:])

    @property
    def base(self) -> BaseMeasurement | None:
        plant, (of_place, of_rates) = self._plant, self._noise
        noise = Rotation.from_rotvec(8.7e-4 * of_place[3:6])
        attitude = (Rotation.from_quat(plant.pose[3:]) * noise).as_quat()
        pose = np.concatenate([plant.pose[:3] + 1e-3 * of_place[:3], attitude])
        rates = 1e-3 * of_rates
        return BaseMeasurement(pose, plant.twist + rates[:6], plant.qdot + rates[6:])


def with_wrong_masses(*, horizon: bool) -> tuple[Loop, float]:
    """Fly a chain whose masses are wrong by 10 %; return the share of the nominal duration."""
    parameters: dict[str, Any] = {
        "takeover_time": 0.15,
        "replan_period": 0.15 if horizon else 0.0,
        "max_corrections": 0,
        "averaging": 3,
        "attitude_tolerance": 0.01,
        "shape_deadband": 4e-3,
        "rest_tolerance": 5e-3,
        "method": "optimal",
        "optimal.cache": 0,
    }
    initial = InitialState(joint_positions=SHAPES["planar_chain"])
    loop = Loop(parameters, robot="planar_chain", initial=initial)
    wrong = robot_of("planar_chain").description.with_model_error(0.1, 1)
    loop.plant = VelocityPlant(SpaceRobot(wrong), TICK, initial)
    loop.measured = NoisyState(loop.plant)
    angle = np.random.default_rng(1).uniform(0.8, 2.0)
    loop.propose_goal(Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, angle]).as_quat()))
    loop.until(PlannerState.REACHED_PARTLY, PlannerState.FAILED)
    first, last = loop.starts[0], loop.starts[-1]
    took = (last.stamp_ns - first.stamp_ns) / 1e9 + last.schedule.duration
    return loop, took / first.schedule.duration


@pytest.mark.slow
def test_the_shrinking_horizon_makes_up_for_wrong_masses() -> None:
    for horizon, state in ((True, "reached_partly"), (False, "failed")):
        loop, share = with_wrong_masses(horizon=horizon)
        assert loop.states[-1] == state
        assert share < 1.15


def test_no_momentum_arises_where_a_plan_takes_over() -> None:
    """The momentum of all bodies by Pinocchio, from what the plant reports at every tick."""
    robot = "planar_chain"
    first = Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, 0.8]).as_quat(), SHAPES[robot])
    other = Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, 0.9]).as_quat(), SHAPES[robot])
    loop = loop_of(robot, None, takeover_time=0.3, **{"optimal.answers": 1})
    loop.propose_goal(first)
    until(loop, Phase.EXECUTING)
    loop.tick(loop.starts[0].schedule.ticks // 2)
    loop.propose_goal(other)
    slowest = np.inf
    for _ in range(25):
        loop.tick()
        slowest = min(slowest, np.abs(loop.plant.qdot).max())
    assert loop.largest < 1e-9
    assert len(loop.starts) == 2
    assert slowest > 0.1, "it never stops"
    require_limits(loop, robot)
