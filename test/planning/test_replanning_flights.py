"""Goals that change in flight, and robots with wrong masses, flown with `optimal` by an executive.

The worker is a background whose plans take a fixed simulated time, so the flights are those of real
time and yet depend on nothing but their parameters.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.planner_loop import TICK, HeldWorker, Loop, PlantState, robot_of

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import GaitMethod, Goal
from spacerobot_ros.planning.execution.executive import Executive, Phase
from spacerobot_ros.planning.execution.state_average import BaseMeasurement
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.planning.execution.worker import Planned, PlanningTask, PlanningWorker, Refused
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import InitialState, VelocityPlant

Array = npt.NDArray[np.float64]

SHAPES = {
    "planar_chain": np.array([0.3, -0.2]),
    "three_joint_arm": np.array([0.0, -0.785, 1.57]),
}
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
        for _ in range(count):
            super().tick(base=base)
            self.largest = max(self.largest, float(np.abs(momentum(self.plant)).max()))


@cache
def oracle_of(model: SpaceRobot) -> PinocchioOracle:
    urdf = (share_directory() / "urdf" / f"{model.description.name}.urdf").read_text("utf-8")
    return PinocchioOracle(urdf, model.joint_names)


def momentum(plant: VelocityPlant) -> Array:
    """Return the momentum (6,) of all bodies by Pinocchio, from what the plant reports."""
    oracle = oracle_of(plant.robot)
    oracle.place(plant.q, plant.pose[3:], plant.pose[:3])
    u = oracle.joint_velocities(plant.qdot)
    u[:6] = plant.twist
    return np.asarray((oracle.own_mass_matrix() @ u)[:6])


def loop_of(robot: str, method: GaitMethod | None, **parameters: Any) -> BalancedLoop:
    loop = BalancedLoop(
        {"method": "optimal", "optimal.cache": 0, **parameters},
        robot=robot,
        initial=InitialState(joint_positions=SHAPES[robot]),
    )
    states = round(PLANNING_TIME[robot] / TICK) - 1
    loop.held = SlowWorker(robot_of(robot), loop.config, method, states=states)
    loop.executive = Executive(robot_of(robot), loop.config, loop.held)
    return loop


def flown(loop: Loop, first: Goal, changed: Goal) -> float:
    """Change the goal halfway; return the time from then until it is reached, s."""
    loop.propose_goal(first)
    while loop.executive.phase is not Phase.EXECUTING:
        loop.tick()
    loop.tick(loop.starts[0].schedule.ticks // 2)
    before = len(loop.commands)
    loop.propose_goal(changed)
    assert loop.until(PlannerState.REACHED, PlannerState.FAILED).state is PlannerState.REACHED
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
    """Ten goals for each of two robots, against flights that stop before they are planned for."""
    shares: dict[str, list[float]] = {}
    began = time.process_time()
    for robot in SHAPES:
        rng = np.random.default_rng(11)
        method: GaitMethod | None = None
        for _ in range(10):
            pair = goals(robot, rng)
            stopping = loop_of(robot, method, takeover_time=0.0)
            method = stopping.held._method
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
    assert of_all <= 0.75


class NoisyState(PlantState):
    """The measured state with noise of the base (1 mm, 0.87 mrad), the joints, and all rates."""

    def __init__(self, plant: VelocityPlant, seed: int) -> None:
        super().__init__(plant)
        self._rng, self._drawn_ns = np.random.default_rng(seed), -1

    def _draw(self) -> None:
        if self._drawn_ns == self.stamp_ns:
            return
        self._drawn_ns, plant, normal = self.stamp_ns, self._plant, self._rng.normal
        n = len(plant.q)
        self._q = plant.q + 1e-3 * normal(size=n)
        noise = Rotation.from_rotvec(8.7e-4 * normal(size=3))
        attitude = (Rotation.from_quat(plant.pose[3:]) * noise).as_quat()
        pose = np.concatenate([plant.pose[:3] + 1e-3 * normal(size=3), attitude])
        twist, rates = plant.twist + 1e-3 * normal(size=6), plant.qdot + 1e-3 * normal(size=n)
        self._base = BaseMeasurement(pose, twist, rates)

    @property
    def q(self) -> Array:
        self._draw()
        return self._q

    def base(self) -> BaseMeasurement | None:
        self._draw()
        return self._base


@dataclass(frozen=True)
class Trial:
    """How robots with wrong masses are tried.

    ``period`` is that of the shrinking horizon and what its plans take, simulated s; ``turns`` are
    the least and the largest angle to turn by, rad.
    """

    start: Array
    period: float
    turns: tuple[float, float]


TRIALS = {
    "three_joint_arm": Trial(SHAPES["three_joint_arm"], 0.3, (0.3, 0.8)),
    "servicer": Trial(np.zeros(6), 0.4, (0.4, 1.0)),
    "planar_chain": Trial(SHAPES["planar_chain"], 0.15, (0.8, 2.0)),
}


def with_wrong_masses(
    robot: str, seed: int, method: GaitMethod | None, *, horizon: bool = True
) -> tuple[Loop, float]:
    """Fly a robot whose masses are wrong by 10 %; return the share of the nominal duration."""
    trial = TRIALS[robot]
    parameters: dict[str, Any] = {
        "takeover_time": trial.period,
        "replan_period": trial.period if horizon else 0.0,
        "max_corrections": 0,
        "averaging": 3,
        "attitude_tolerance": 0.01,
        "shape_deadband": 4e-3,
        "rest_tolerance": 5e-3,
        "method": "optimal",
        "optimal.cache": 0,
    }
    initial = InitialState(joint_positions=trial.start)
    loop = Loop(parameters, robot=robot, initial=initial, method=method)
    wrong = robot_of(robot).description.with_model_error(0.1, seed)
    loop.plant = VelocityPlant(SpaceRobot(wrong), TICK, initial)
    loop.measured = NoisyState(loop.plant, seed)
    worker = PlanningWorker(robot_of(robot), loop.config, method)
    loop.method = worker._method
    loop.executive = Executive(robot_of(robot), loop.config, worker)
    rng = np.random.default_rng(seed)
    axis = np.array([0.0, 0.0, 1.0]) if robot == "planar_chain" else rng.normal(size=3)
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(*trial.turns))
    loop.propose_goal(Goal.checked(np.zeros(3), turn.as_quat()))
    loop.until(PlannerState.REACHED, PlannerState.FAILED)
    first, last = loop.starts[0], loop.starts[-1]
    took = (last.stamp_ns - first.stamp_ns) / 1e9 + last.schedule.duration
    return loop, took / first.schedule.duration


@pytest.mark.slow
def test_the_shrinking_horizon_makes_up_for_wrong_masses() -> None:
    for horizon, state in ((True, "reached"), (False, "failed")):
        loop, share = with_wrong_masses("planar_chain", 1, None, horizon=horizon)
        assert loop.states[-1] == state
        assert share < 1.15


def test_no_momentum_arises_where_a_plan_takes_over() -> None:
    """The momentum of all bodies by Pinocchio, from what the plant reports at every tick."""
    robot = "planar_chain"
    first = Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, 0.8]).as_quat(), SHAPES[robot])
    other = Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, 0.9]).as_quat(), SHAPES[robot])
    loop = loop_of(robot, None, takeover_time=0.3, **{"optimal.answers": 1})
    loop.propose_goal(first)
    while loop.executive.phase is not Phase.EXECUTING:
        loop.tick()
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
