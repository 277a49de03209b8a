"""Fifty goals that can be reached and thirty that cannot, for each robot of papers 1 to 3.

What can be reached is said by eq. (9) of paper 1 and by the conservation of momentum in the plant,
not by the planners: goals are made of a final shape, or of an attitude alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.flown import STEP, fly, plant_at
from scipy.spatial.transform import Rotation
from support.planners import Planner, planner_of

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal, RobotState, Tolerance

Array = npt.NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "urdf"
PERIOD = {"lie_bracket": 0.05, "area_loop": 0.25, "square_path": 0.05}
TOLERANCE = Tolerance(2e-3, 2e-3, 1e-6)
STROKE, MASSES, TOTAL = 2.5, 2.0, 16.0
"""Paper 1's robot: sliders of 2 kg of 16 kg, slots along the axes of the base."""


@pytest.fixture(autouse=True)
def _interpreted() -> None:
    """Compile, in place of the folder's choice: these flights are long."""


@pytest.fixture(scope="module")
def robots() -> dict[str, SpaceRobot]:
    names = {
        "lie_bracket": "sliding_masses",
        "area_loop": "three_joint_arm",
        "square_path": "planar_chain",
    }
    return {method: SpaceRobot.from_file(FOLDER / f"{name}.urdf") for method, name in names.items()}


def planner(method: str, robot: SpaceRobot, **options: Any) -> Planner:
    if method == "lie_bracket":
        options = {"t1": 10.0, "n1": 1, "loop_area": 0.2, **options}
    return planner_of(method, robot, PERIOD[method], TOLERANCE, STEP, **options)


def at(q: npt.ArrayLike, attitude: Rotation, **momenta: Array) -> RobotState:
    return RobotState(np.zeros(3), attitude.as_quat(), np.asarray(q, dtype=float), **momenta)


def pose_of_sliders(z0: Array, attitude: Rotation, zf: Array, turn: Rotation) -> Goal:
    """Return the pose in which the sliders are at ``zf``: eq. (9), the mass centre rests."""
    end = attitude * turn
    r = MASSES / TOTAL * (attitude.apply(z0) - end.apply(zf))
    return Goal.checked(r, end.as_quat())


def some_turn(rng: np.random.Generator, least: float, most: float) -> Rotation:
    axis = rng.normal(size=3)
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(least, most))


# -- goals that can be reached ----------------------------------------------------------------


def reachable(method: str, rng: np.random.Generator, robot: SpaceRobot) -> tuple[Array, Any, Goal]:
    """Return a shape and an attitude to start from, and a goal."""
    attitude = Rotation.random(random_state=rng)
    if method == "lie_bracket":
        z0, zf = rng.uniform(-1.8, 1.8, (2, 3))
        return z0, attitude, pose_of_sliders(z0, attitude, zf, some_turn(rng, 0.02, 0.5))
    if method == "area_loop":
        q, final = rng.uniform(robot.lower, robot.upper, (2, 3))
        shape = final if rng.uniform() < 0.5 else None
        goal = (attitude * some_turn(rng, 0.05, 1.5)).as_quat()
        return q, attitude, Goal.checked(np.zeros(3), goal, shape)
    q, final = rng.uniform(-np.pi, np.pi, (2, 2))
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    shape = final if rng.uniform() < 0.5 else None
    return q, attitude, Goal.checked(np.zeros(3), (attitude * turn).as_quat(), shape)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["lie_bracket", "area_loop", "square_path"])
def test_fifty_goals_are_planned_and_met_in_the_plant(
    robots: dict[str, SpaceRobot], method: str
) -> None:
    robot, rng = robots[method], np.random.default_rng(1994)
    gait = planner(method, robot)
    for number in range(50):
        q, attitude, goal = reachable(method, rng, robot)
        flight = fly(gait, plant_at(robot, q, PERIOD[method], attitude), goal)
        angle = np.linalg.norm(flight.left(goal)[-1])
        assert angle <= TOLERANCE.attitude + 1e-9, f"goal {number}: {angle} rad"
        if method == "lie_bracket":
            distance = np.linalg.norm(flight.poses[-1][:3] - goal.position)
            assert distance <= TOLERANCE.position, f"goal {number}: {distance} m"
        if goal.joint_positions is not None:
            np.testing.assert_allclose(flight.shapes[-1], goal.joint_positions, atol=1e-6)


# -- goals that cannot ------------------------------------------------------------------------


def refused(gait: Planner, state: RobotState, goal: Goal) -> str:
    with pytest.raises(PlanningError) as refusal:
        gait.plan(state, goal)
    return str(refusal.value)


def test_ten_poses_beyond_the_stroke_of_a_slider(robots: dict[str, SpaceRobot]) -> None:
    rng, gait = np.random.default_rng(1), planner("lie_bracket", robots["lie_bracket"])
    for _ in range(10):
        attitude = Rotation.random(random_state=rng)
        zf = rng.uniform(-2, 2, 3)
        beyond = int(rng.integers(3))
        zf[beyond] = rng.choice([-1, 1]) * rng.uniform(2.6, 4.0)
        goal = pose_of_sliders(np.zeros(3), attitude, zf, some_turn(rng, 0.0, 0.5))
        reason = refused(gait, at(np.zeros(3), attitude), goal)
        assert (
            f"beyond stroke: it needs joint 'slider_{beyond + 1}' at {zf[beyond]:.4g} m" in reason
        )


def test_ten_turns_with_a_slider_at_the_end_of_its_stroke(robots: dict[str, SpaceRobot]) -> None:
    rng, gait = np.random.default_rng(2), planner("lie_bracket", robots["lie_bracket"])
    for _ in range(10):
        attitude = Rotation.random(random_state=rng)
        zf = rng.uniform(-2, 2, 3)
        zf[rng.integers(3)] = rng.choice([-STROKE, STROKE])
        # A hair inside, so that rounding does not make it beyond.
        goal = pose_of_sliders(np.zeros(3), attitude, zf * (1 - 1e-12), some_turn(rng, 0.3, 0.6))
        reason = refused(gait, at(np.zeros(3), attitude), goal)
        assert "The turn would take more than 100000 s within the strokes" in reason


@pytest.mark.parametrize("method", ["lie_bracket", "area_loop", "square_path"])
def test_ten_drifting_robots(robots: dict[str, SpaceRobot], method: str) -> None:
    rng, robot = np.random.default_rng(3), robots[method]
    gait = planner(method, robot)
    for _ in range(10):
        q, attitude, goal = reachable(method, rng, robot)
        p, L = rng.normal(size=(2, 3)) * rng.choice([0.0, 1.0], 2)[:, np.newaxis]
        L[0] += 0.1
        reason = refused(gait, at(q, attitude, linear_momentum=p, angular_momentum=L), goal)
        assert "total momentum is not zero" in reason
        assert f"{np.linalg.norm(L):.3g} kg m^2/s" in reason


def test_ten_shapes_beyond_the_limits_of_the_arm(robots: dict[str, SpaceRobot]) -> None:
    rng, robot = np.random.default_rng(4), robots["area_loop"]
    gait = planner("area_loop", robot)
    for _ in range(10):
        final = rng.uniform(robot.lower, robot.upper)
        joint = int(rng.integers(3))
        final[joint] = robot.upper[joint] + rng.uniform(0.01, 1.0)
        goal = Goal.checked(np.zeros(3), Rotation.random(random_state=rng).as_quat(), final)
        reason = refused(gait, at(np.zeros(3), Rotation.identity()), goal)
        assert f"joint '{robot.joint_names[joint]}' at {final[joint]:.4g} rad" in reason


def test_ten_turns_that_the_arm_has_too_few_cycles_for(robots: dict[str, SpaceRobot]) -> None:
    rng = np.random.default_rng(5)
    # A cycle makes up for 15 % at most: twenty leave 4 % of a turn.
    gait = planner("area_loop", robots["area_loop"], most_cycles=20)
    for _ in range(10):
        turn = some_turn(rng, 0.2, 3.0)
        assert turn.magnitude() * 0.85**20 > TOLERANCE.attitude
        goal = Goal.checked(np.zeros(3), turn.as_quat())
        reason = refused(gait, at(np.radians([0, -45, 90]), Rotation.identity()), goal)
        assert "more than most_cycles = 20" in reason


def test_ten_tilts_of_a_planar_chain(robots: dict[str, SpaceRobot]) -> None:
    rng, gait = np.random.default_rng(6), planner("square_path", robots["square_path"])
    for _ in range(10):
        attitude = Rotation.random(random_state=rng)
        across = np.append(rng.normal(size=2), 0.0)
        tilt = rng.uniform(0.01, 3.0)
        about = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-3, 3)])
        turn = about * Rotation.from_rotvec(tilt * across / np.linalg.norm(across))
        goal = Goal.checked(np.zeros(3), (attitude * turn).as_quat())
        reason = refused(gait, at([1.0, -2.0], attitude), goal)
        assert f"{tilt:.4g} rad off any rotation about the axis" in reason


def test_ten_turns_that_the_chain_has_too_few_loops_for(robots: dict[str, SpaceRobot]) -> None:
    # No loop of this chain turns it by a third of a turn: its curvature is at most 0.5376, and has
    # one sign over a part of the plane only.
    rng, gait = (
        np.random.default_rng(7),
        planner("square_path", robots["square_path"], most_loops=1),
    )
    for _ in range(10):
        q = rng.uniform(-np.pi, np.pi, 2)
        turn = Rotation.from_rotvec([0.0, 0.0, rng.choice([-1, 1]) * rng.uniform(2.1, 3.1)])
        goal = Goal.checked(np.zeros(3), turn.as_quat())
        reason = refused(gait, at(q, Rotation.identity()), goal)
        assert "takes 2 loops, more than most_loops = 1" in reason
