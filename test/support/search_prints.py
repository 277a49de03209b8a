"""Numbers on the way to a manoeuvre of ``optimal``: guesses, programs, and held commands.

A plan of ``optimal`` is a solver's, whose last digits and iterations differ between machines; these
are not, and are kept as plans of the other methods are.
"""

from __future__ import annotations

import itertools
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal, RobotState
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorRows
from spacerobot_ros.planning.methods.optimal.held_commands import ManoeuvreModel
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.multiple_shooting import _pack_parameters
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    PossibleEnd,
    Trajectory,
)
from spacerobot_ros.planning.methods.optimal.transcription import Layout, Stages, program
from spacerobot_ros.resources import robot_file

Array = npt.NDArray[np.float64]

START, FINAL = np.array([0.3, -0.5, 0.2]), np.array([-0.4, 0.9, 0.8])
TURN = np.array([0.12, -0.08, 0.25, 0.9574967362870842])
GAIN = np.array([0.3, -0.2, 0.25])
LIMITS = MotionLimits(
    np.array([-1.0, -2.0, -np.inf]),
    np.array([1.4, 2.0, np.inf]),
    np.array([0.5, 0.8, 1.1]),
    np.array([0.9, 0.7, 1.3]),
)
WITHIN = MotionLimits(
    np.array([-1.5, -1.6, -1.7]),
    np.array([1.4, 1.8, 1.9]),
    np.array([0.5, 0.8, 1.1]),
    np.array([0.9, 0.7, 1.3]),
)


def _sums(values: npt.ArrayLike) -> list[float]:
    """Return the number of some values and sums of them, each with another weight."""
    flat = np.asarray(values, dtype=float).ravel()
    place = np.arange(1, flat.size + 1)
    return [
        float(flat.size),
        float(np.sqrt(np.mean(flat**2))) if flat.size else 0.0,
        *(float(flat @ np.sin(rate * place)) for rate in (0.7, 1.9)),
    ]


def _trajectory(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "step": trajectory.step,
        "shapes": _sums(trajectory.shapes),
        "velocities": _sums(trajectory.velocities),
        "end": [*trajectory.shapes[-1].tolist(), *trajectory.quaternions[-1].tolist()],
    }


def _areas() -> tuple[ca.Function, ca.Function]:
    """Return a turn of the base by the areas that a step sweeps, and its curvature."""
    q, u, u_next = (ca.SX.sym(name, 3) for name in ("q", "u", "u_next"))
    mean = (u + u_next) / 2
    turn = ca.Function("turn", [q, u, u_next], [ca.DM(GAIN) * ca.cross(q + mean / 2, mean)])
    curvature = np.zeros((6, 9))
    for j, k in itertools.product(range(3), range(3)):
        curvature[3:, 3 * j + k] = -2 * GAIN * np.cross(np.eye(3)[j], np.eye(3)[k])
    return turn, ca.Function("curvature", [q], [ca.DM(curvature)])


def guesses() -> dict[str, Any]:
    """Return guesses of a robot whose base turns by areas, and the loops that they have."""
    found: dict[str, Any] = {}
    source = InitialGuesses(*_areas(), 60)
    boundary = BoundaryConditions(START, TURN, FINAL, FINAL)
    sequence = source.generate(boundary, LIMITS)
    found["to one end"] = [_trajectory(next(sequence)) for _ in range(6)]
    ends = (PossibleEnd(FINAL, TURN), PossibleEnd(-FINAL / 2, np.array([0.6, 0.0, 0.0, 0.8])))
    sequence = source.generate(BoundaryConditions(START, TURN, FINAL, possible_ends=ends), LIMITS)
    found["to two ends"] = [_trajectory(next(sequence)) for _ in range(5)]
    first = next(source.generate(boundary, LIMITS))
    velocity = np.array([0.2, -0.3, 0.5])
    found["moving at the start"] = _trajectory(
        source.with_initial_velocity(first, velocity, LIMITS)
    )
    found["on another grid"] = _trajectory(InitialGuesses(*_areas(), 47).resample(first))
    found["from ticks"] = _trajectory(source.from_ticks(first.shapes[::5], velocity, 0.35))
    return found


_PROGRAMS: dict[str, dict[str, Any]] = {
    "plain": {},
    "position": {"base_position": 1},
    "cone": {
        "keep_axis": [0.6, 0.0, 0.8],
        "keep_direction": [0.0, 0.8, 0.6],
        "keep_angle": 0.4,
        "max_base_rate": 0.05,
    },
    "box": {"keep_out": [-0.5, -0.7, -0.9, 0.4, 0.6, 0.8], "joint_margin": [0.1, 0.2, 0.3]},
}


def _wavy(joints: int, intervals: int) -> Trajectory:
    """Return a trajectory of no particular meaning, with attitudes that are quaternions."""
    s = np.linspace(0.0, 1.0, intervals + 1)[:, np.newaxis]
    rate = np.arange(1, joints + 1)
    shapes = 0.4 * np.sin(2.1 * s * rate + rate) + 0.1 * rate
    velocities = 0.3 * np.cos(1.7 * s * rate)
    half = np.hstack([0.1 * s, -0.2 * s, 0.15 * np.sin(3 * s)])
    quaternions = np.hstack([half, np.sqrt(1 - np.sum(half**2, axis=1, keepdims=True))])
    return Trajectory(0.23, shapes, velocities, quaternions)


def _program(stages: Stages, boundary: BoundaryConditions) -> dict[str, Any]:
    intervals = 5
    made = program(stages, intervals)
    s = np.arange(1, Layout.of(stages, intervals).size + 1)
    x = 0.3 + 0.2 * np.sin(1.3 * s)
    p = _pack_parameters(boundary, WITHIN, _wavy(stages.joints, intervals), fixed=True)
    multipliers = np.cos(0.9 * np.arange(made.lower.size))
    values, jacobian = made.jac_g(x, p)
    hessian = made.hess_lag(x, p, 0.7, multipliers)
    objective = ca.Function("f", [made.problem["x"], made.problem["p"]], [made.problem["f"]])
    return {
        "objective": float(objective(x, p)),
        "rows": _sums(values.full()),
        "jacobian": _sums(jacobian.full()),
        "hessian": _sums(hessian.full()),
        "bounds": [_sums(made.lower), float(np.isinf(made.upper).sum())],
    }


def programs() -> dict[str, Any]:
    """Return rows and derivatives of programs of an arm, at variables of no particular meaning."""
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    found = {}
    for name, values in _PROGRAMS.items():
        options = OptimalOptions(**values)
        constraints = PathConstraints.of(robot, options)
        position = options.base_position == 1
        axes = np.eye(3)[:2] if name == "plain" else np.eye(3)
        stages = Stages.of(robot, axes, position, constraints)
        center = np.array([0.1, -0.2, 0.3]) if position else None
        direction = np.array([0.0, 0.8, 0.6])
        boundary = BoundaryConditions(START, TURN, FINAL, None, center, direction)
        found[name] = _program(stages, boundary)
    rows = EndEffectorRows(robot, [("end_effector", True)], np.eye(3))
    stages = Stages.of(
        robot,
        np.zeros((0, 3)),
        False,
        PathConstraints.of(robot, OptimalOptions()),
        end_effectors=rows.function,
    )
    goal = EndEffectorGoal("end_effector", np.array([1.2, 0.4, 0.3]), TURN)
    attitude = Goal.from_rotvec([0.0] * 3, [0.3, 0.2, 0.1]).quaternion
    state = RobotState(np.array([0.1, 0.2, -0.3]), attitude, START)
    packed = rows.pack(state, [goal])
    boundary = BoundaryConditions(START, TURN, FINAL, direction=np.zeros(3), end_effectors=packed)
    found["end-effector"] = _program(stages, boundary)
    return found


def held() -> dict[str, Any]:
    """Return held commands of smooth trajectories of an arm, with and without a last shape."""
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    stages = Stages.of(robot, np.eye(3), False, PathConstraints.of(robot, OptimalOptions()))
    source = InitialGuesses(stages.rotation_of_step, robot.function("curvature", compile=False), 60)
    way = BoundaryConditions(START, TURN, FINAL, FINAL)
    sequence = source.generate(way, WITHIN)
    found: dict[str, Any] = {}
    for number, (period, free) in enumerate(
        ((0.1, False), (0.25, True), (0.7, False), (0.4, True))
    ):
        guess = next(sequence)
        model = ManoeuvreModel(
            robot,
            BasePrediction(robot, period, period),
            period,
            np.eye(3),
            PathConstraints.of(robot, OptimalOptions()),
        )
        turn = guess.quaternions[-1]
        final = None if free else guess.shapes[-1]
        boundary = BoundaryConditions(guess.shapes[0], turn, guess.shapes[-1], final)
        commands = model.hold(guess, boundary, WITHIN)
        found[f"guess {number}, {period} s"] = (
            None
            if commands is None
            else {
                "ticks": len(commands.positions) - 1,
                "positions": _sums(commands.positions),
                "end": [*commands.positions[-1].tolist(), *commands.quaternions[-1].tolist()],
            }
        )
    return found


SEARCHES = {"guesses": guesses, "programs": programs, "held commands": held}
"""What prints the parts of the search, by the name under which it is kept."""
