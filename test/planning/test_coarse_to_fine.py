"""Which solutions on the coarse grid are made into manoeuvres; the solvers are scripted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from planning.test_optimal import FOLDER
from scipy.spatial.transform import Rotation

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.held_commands import ManoeuvreModel
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    TOLERANCE,
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
from spacerobot_ros.planning.methods.optimal.search import ManoeuvreSearch
from spacerobot_ros.planning.methods.optimal.transcription import Stages

PERIOD = 0.05
INTERVALS = 80
BUDGET = OptimalOptions(
    duration=0.0,
    longest=60.0,
    starts=24,
    answers=5,
    agreeing=3,
    iterations=300,
    time_budget=0.0,
)


@dataclass
class Scripted:
    """A solver whose solutions are one path, in the times of a script."""

    intervals: int
    turn: object
    path: Trajectory
    durations: Iterator[float]
    iterations: int = 1
    converged: bool = True

    def solve(self, *_: object) -> Trajectory:
        return self.path.stretched(next(self.durations) / self.path.duration)


@pytest.fixture(scope="module")
def chain() -> SpaceRobot:
    return SpaceRobot.from_file(FOLDER / "planar_chain.urdf")


@pytest.mark.parametrize(
    ("coarse", "fine", "made"),
    [
        pytest.param([6.0, 5.0, 5.0, 5.0], [5.4], [5.4], id="the next one promises nothing"),
        pytest.param([5.3, 5.0, 5.0, 5.0], [5.6, 5.4], [5.6, 5.4], id="the best one was overrated"),
        pytest.param([5.2, 5.0, 5.1, 5.3, 5.4], [4.0, 4.1], [4.0, 4.1], id="none agree"),
        pytest.param([5.6, 5.0, 5.7, 5.8, 5.9], [4.0], [4.0], id="the others are far behind"),
    ],
)
def test_the_next_solution_is_refined_where_it_may_be_the_better_one(
    chain: SpaceRobot, coarse: list[float], fine: list[float], made: list[float]
) -> None:
    options = OptimalOptions()
    constraints, limits = PathConstraints.of(chain, options), MotionLimits.of(chain, options)
    goal = Rotation.from_rotvec([0.0, 0.0, 0.5]).as_quat()
    boundary = BoundaryConditions(np.zeros(2), goal, np.zeros(2))
    stages = Stages.of(chain, np.eye(3)[2:], False, constraints)
    curvature = chain.function("curvature", compile=False)
    guess = next(
        InitialGuesses(stages.rotation_of_step, curvature, 20).generate(
            boundary, limits, np.zeros(2)
        )
    )
    path = MultipleShooting(stages, 20).solve(
        boundary, limits, guess, StopRule(300), DurationBounds(0.1, 60.0)
    )
    assert path is not None
    solvers = {
        INTERVALS: Scripted(INTERVALS, stages.rotation_of_step, path, iter(fine)),
        INTERVALS // 5: Scripted(INTERVALS // 5, stages.rotation_of_step, path, iter(coarse)),
    }

    class ScriptedSearch(ManoeuvreSearch):
        def solver(  # type: ignore[override]
            self,
            intervals: int,
            position: bool,
            tolerance: float = TOLERANCE,
            pairs: tuple[int, ...] = (),
            *,
            drifting: bool = False,
            planes: bool = False,
        ) -> Scripted:
            return solvers[intervals]

    prediction = BasePrediction(chain, PERIOD, 0.01)
    model = ManoeuvreModel(chain, prediction, PERIOD, np.eye(3)[2:], constraints)
    found = ScriptedSearch(model).search(
        boundary, limits, np.array([0.0, 0.0, 0.0, 1.0]), INTERVALS, BUDGET
    )
    np.testing.assert_allclose(found.solutions, made, atol=PERIOD)
    np.testing.assert_allclose(found.duration, min(made), atol=PERIOD)
    assert all(next(each.durations, None) is None for each in solvers.values())
