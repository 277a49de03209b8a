"""Square paths of planar robots, and how far they turn the base by another integration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.planar_trees import PlanarTree, random_tree
from support.planners import Planner, planner_of

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState, Tolerance

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf" / "planar_chain.urdf"
PERIOD = 0.05
TIGHT = Tolerance(1e-6, 1e-6)

FOLDED, DEPLOYED = np.array([np.pi, -np.pi]), np.zeros(2)
"""Paper 3, section IV: the shapes before and after."""


# -- the robot of paper 3 ---------------------------------------------------------------------


def closed_forms(psi: Array) -> Array:
    """Return ``s = (N_1, N_2) / D`` (..., 2) of shapes (..., 2): section IV as printed."""
    one, two, both = np.cos(psi[..., 0]), np.cos(psi[..., 1]), np.cos(psi.sum(axis=-1))
    N_1 = 17.5 + 7.5 * one + 10.5 * two + 2.5 * both
    N_2 = 3.75 + 5.25 * two + 2.5 * both
    D = 32.5 + 15 * one + 10.5 * two + 5 * both
    return np.stack([N_1, N_2], axis=-1) / D[..., np.newaxis]


def phase_density(psi: npt.ArrayLike) -> Array:
    """Return ``H = ds_2/dpsi_1 - ds_1/dpsi_2`` (...) of the printed functions at shapes (..., 2),
    by central differences.
    """
    psi, h = np.asarray(psi), 1e-5 * np.eye(2)
    slope = [(closed_forms(psi + step) - closed_forms(psi - step)) / 2e-5 for step in h]
    return np.asarray(slope[0][..., 1] - slope[1][..., 0])


# -- planning ---------------------------------------------------------------------------------


def planner(robot: SpaceRobot, tolerance: Tolerance = TIGHT, **options: Any) -> Planner:
    return planner_of("square_path", robot, PERIOD, tolerance, **options)


def at_rest(q: Array, attitude: Rotation | None = None) -> RobotState:
    quaternion = (attitude or Rotation.identity()).as_quat()
    return RobotState(np.array([0.3, -0.2, 0.5]), quaternion, np.asarray(q, dtype=float))


def goal_of(attitude: Rotation, shape: npt.ArrayLike | None = None) -> Goal:
    return Goal.checked([0.0, 0.0, 0.0], attitude.as_quat(), shape)


def about_z(angle: float) -> Rotation:
    return Rotation.from_rotvec([0.0, 0.0, angle])


def wrapped(angle: float) -> float:
    return float(np.remainder(angle + np.pi, 2 * np.pi) - np.pi)


def paper_gait(chain: SpaceRobot, **options: Any) -> GaitSchedule:
    """From (0, pi, -pi) to (pi/2, 0, 0)."""
    goal = goal_of(about_z(np.pi / 2), DEPLOYED)
    return planner(chain, **options).plan(at_rest(FOLDED), goal)


# -- any robot --------------------------------------------------------------------------------


def turns(s: Any, shapes: Array) -> Array:
    """Return the turns (N,) of the base between the ticks of ``shapes`` (N + 1, n), velocities
    held in between: ``theta_dot = -s' psi_dot`` by DOP853, all ticks side by side.
    """
    rates = np.diff(shapes, axis=0) / PERIOD

    def derivative(t: float, _: Array) -> Array:
        return -np.sum(s(shapes[:-1] + t * rates) * rates, axis=1)

    solution = solve_ivp(
        derivative,
        (0.0, PERIOD),
        np.zeros(len(rates)),
        "DOP853",
        first_step=PERIOD / 2,
        rtol=1e-11,
        atol=1e-13,
    )
    return np.asarray(solution.y[:, -1])


@dataclass(frozen=True)
class Case:
    """A robot somewhere, a goal it can reach, and the robot in formulas."""

    tree: PlanarTree
    robot: SpaceRobot
    state: RobotState
    goal: Goal
    angle: float


def random_case(seed: int, links: int, angle: float | None = None, **kind: bool) -> Case:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, links, **kind)
    angle = float(rng.uniform(-np.pi, np.pi)) if angle is None else angle
    attitude = Rotation.from_rotvec(rng.normal(size=3))
    state = at_rest(rng.uniform(-2, 2, links - 1), attitude)
    # About the axis in the base, which is the same in the world.
    goal_attitude = attitude * Rotation.from_rotvec(angle * tree.plane[:, 2])
    goal = goal_of(goal_attitude, rng.uniform(-2, 2, links - 1))
    return Case(tree, SpaceRobot.from_urdf(tree.urdf), state, goal, angle)


def check_flight(case: Case, gait: GaitSchedule) -> None:
    """Check end, rest, predicted path and notes against the formulas of the robot."""
    assert gait.joint_names == tuple(f"j{k}" for k in range(1, len(case.tree.parts)))
    np.testing.assert_array_equal(gait.positions[0], case.state.q)
    theta = np.append(0.0, np.cumsum(turns(case.tree.s, gait.positions)))
    assert wrapped(theta[-1] - case.angle) == pytest.approx(0.0, abs=1e-7)
    shape = case.state.q if case.goal.joint_positions is None else case.goal.joint_positions
    np.testing.assert_allclose(gait.positions[-1], shape, atol=1e-12)
    # The path: the base turns by theta about its axis, and the mass centre stays.
    ticks = np.round(gait.path.time / PERIOD).astype(int)
    np.testing.assert_allclose(ticks * PERIOD, gait.path.time, atol=1e-9)
    assert (ticks[0], ticks[-1]) == (0, gait.ticks)
    start = Rotation.from_quat(case.state.quaternion)
    axis = case.tree.plane[:, 2]
    c = case.tree.center_of_mass(gait.positions) @ case.tree.plane[:, :2].T
    r_cm = case.state.position + start.apply(c[0])
    attitudes = start * Rotation.from_rotvec(np.multiply.outer(theta[ticks], axis))
    left = attitudes.inv() * Rotation.from_quat(gait.path.quaternion)
    assert left.magnitude().max() < 1e-6
    np.testing.assert_allclose(gait.path.position, r_cm - attitudes.apply(c[ticks]), atol=1e-6)
    np.testing.assert_array_equal(gait.notes["final_position"], gait.path.position[-1])
    assert float(gait.notes["predicted_attitude_error"]) < 1e-6  # type: ignore[arg-type]
