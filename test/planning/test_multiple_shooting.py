"""Solutions of the optimal control problem, before they become held commands."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from planning.test_optimal import ARM_START, FOLDER
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    DurationBounds,
    MultipleShooting,
    StopRule,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    Trajectory,
)
from spacerobot_ros.planning.methods.optimal.transcription import PathInequality, Stages

Array = npt.NDArray[np.float64]

URDF = FOLDER / "three_joint_arm.urdf"
TURN = Rotation.from_rotvec([0.1, -0.2, 0.15])
INTERVALS = 20


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(URDF)


def solved(
    arm: SpaceRobot, velocity: Array | float = 0.0, inequalities: tuple[PathInequality, ...] = ()
) -> Trajectory:
    """Return the fastest way of the arm to turn its base, from joints that move at a velocity."""
    options = OptimalOptions()
    constraints = PathConstraints.of(arm, options)
    stages = Stages.of(arm, np.eye(3), False, constraints, inequalities)
    solver = MultipleShooting(stages, INTERVALS)
    boundary = BoundaryConditions(ARM_START, TURN.as_quat(), ARM_START, velocity=velocity)
    limits = MotionLimits.of(arm, options)
    curvature = arm.function("curvature", compile=False)
    guesses = InitialGuesses(stages.rotation_of_step, curvature, INTERVALS)
    guess = next(guesses.generate(boundary, limits, ARM_START))
    solution = solver.solve(boundary, limits, guess, StopRule(300), DurationBounds(1.0, 60.0))
    assert solver.converged
    assert solution is not None
    return solution


def test_a_solution_from_moving_joints_turns_the_base_as_momentum_says(arm: SpaceRobot) -> None:
    """By Pinocchio's momentum along the shapes of the parabolas, two stages of order four."""
    velocity = np.array([0.2, -0.3, 0.1])
    solution = solved(arm, velocity)
    np.testing.assert_allclose(solution.velocities[0], velocity, atol=1e-12)
    np.testing.assert_allclose(solution.velocities[-1], 0.0, atol=1e-12)
    np.testing.assert_allclose(solution.shapes[0], ARM_START, atol=1e-6)
    fine = solution.at_ticks(10 * INTERVALS)
    begins = (fine[1] - fine[0]) / (solution.duration / (10 * INTERVALS))
    np.testing.assert_allclose(begins, velocity, atol=0.03)
    oracle = PinocchioOracle(URDF.read_text(), arm.joint_names)
    attitude = Rotation.identity()
    for q, q_next in pairwise(fine):
        middle, move = (q + q_next) / 2, q_next - q
        attitude = attitude * Rotation.from_rotvec(-oracle.connection(middle)[3:] @ move)
    assert (attitude.inv() * TURN).magnitude() <= 2e-3


@pytest.mark.slow
def test_a_solution_keeps_inequalities_of_shape_velocity_and_acceleration(arm: SpaceRobot) -> None:
    """A bound on the power of the first joint at the ends of the intervals."""
    free = solved(arm)
    q, v, a = (ca.SX.sym(name, 3) for name in "qva")
    bound = ca.Function("bound", [q, v, a], [ca.vertcat(0.1 - v[0] * a[0], v[0] * a[0] + 0.1)])

    def power(solution: Trajectory) -> Array:
        accelerations = np.diff(solution.velocities[:, 0]) / solution.step
        ends = solution.velocities[:-1, 0], solution.velocities[1:, 0]
        return np.abs(np.array([end * accelerations for end in ends]))

    assert power(free).max() > 0.2
    kept = solved(arm, inequalities=(PathInequality(bound),))
    assert power(kept).max() <= 0.1 + 1e-5
    assert kept.duration > free.duration


def test_derivatives_and_curvature_repeat_few_operations(arm: SpaceRobot) -> None:
    """Repeated ones, which take long to find, are found where they are few."""
    stages = Stages.of(arm, np.eye(3), False, PathConstraints.of(arm, OptimalOptions()))
    curvature = arm.function("curvature", compile=False)
    for function, share in ((stages.interval.hessian, 1.03), (curvature, 1.2)):
        arguments = function.sx_in()
        fewest = ca.Function("fewest", arguments, ca.cse(function.call(arguments)))
        assert function.n_instructions() <= share * fewest.n_instructions()
