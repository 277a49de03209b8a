"""Turns smooth trajectories into commands held for a tick that end at the goal exactly.

The shapes at the ticks are points of the trajectory; between them the shape moves along chords,
with velocities that are means over a tick. So joints, velocities and accelerations keep their
limits, but the areas of the chords' loops are not quite those of the curves, nor is the solution's
attitude that of the plant's integration. Newton's method adds a few smooth waves to the path until
the plant's own prediction ends on the goal. The first variation of the final attitude is

``eta = R_f' sum_k R_k K(q_k)(dq_k, q_k' dt)``,  K the curvature of the connection,

for a change ``dq`` that vanishes at both ends, and more terms where the robot drifts
(:class:`DriftVariation`). Where that needs more speed or acceleration than
the limits allow, the manoeuvre takes a few ticks longer.

Where that fails and the last shape is free, it is changed as well: loops of some robots do not turn
the base. A manoeuvre of a few ticks only is a polygon, whose chords are no image of the curve any
more; one of two or three may have too few corners to end on the goal, and takes a tick more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorRows
from spacerobot_ros.planning.methods.optimal.goal_specification import nearest_for_center
from spacerobot_ros.planning.methods.optimal.joint_efforts import LimitedEfforts
from spacerobot_ros.planning.methods.optimal.kept_distances import (
    DistanceLibrary,
    KeptDistances,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    PathConstraints,
    Trajectory,
)

_WAVES_PER_JOINT = 6
"""Number of waves of a joint that can be added to a path."""

_ATTITUDE_TOLERANCE = 1e-11
"""Attitude error that counts as zero, rad."""

_MAX_NEWTON_STEPS = 25
_MAX_STRETCHES = 40
_MAX_STRETCH_FACTOR = 1.25
"""Largest factor that stretches a manoeuvre to keep its limits: another start does
better."""

_MIN_SMOOTH_TICKS = 20
"""Fewest ticks of a smooth manoeuvre; shorter manoeuvres are polygons."""

_TICK_ROUNDING = 0.02
"""Share of a tick by which a solver's duration may miss a whole number of ticks."""

_LIMIT_ROUNDING = 1e-9
"""Relative rounding error by which a limit may be exceeded."""

_FADING_ZONE = 0.02
"""Share of half a joint's range, off its ends, within which waves are smaller."""


@dataclass(frozen=True)
class HeldCommands:
    """Shapes ``positions`` (N + 1, n) at the ticks, attitudes ``quaternions`` (N + 1, 4) that they
    cause, from the starting one, and the angle ``miss`` (rad) that is left to the goal.
    """

    positions: Array
    quaternions: Array
    miss: float


@dataclass(frozen=True)
class ManoeuvreModel:
    """Model and constraints of all manoeuvres of one robot.

    Attributes
    ----------
    robot, prediction, control_period
        The model, the prediction of the base motion, and the duration of a command, s.
    axes
        (m, 3) directions in the base along which the attitude is reached.
    constraints, efforts, distances
        Constraints of the path; no efforts, no distances: any.
    end_effectors
        Rows of the end-effectors that are to be reached; None: none are.
    """

    robot: SpaceRobot
    prediction: BasePrediction
    control_period: float
    axes: Array
    constraints: PathConstraints
    efforts: LimitedEfforts | None = None
    end_effectors: EndEffectorRows | None = None
    distances: DistanceLibrary | None = None

    def begin(self, boundary: BoundaryConditions) -> KeptDistances | None:
        """Return the distances that are kept between two ends; None: any.

        Raises
        ------
        PlanningError
            Links are too near at an end.
        """
        if self.distances is None:
            return None
        return self.distances.begin(boundary, turn_is_known=len(self.axes) == 3)


class CommandHolder:
    """Turns trajectories of one robot into held commands."""

    def __init__(self, model: ManoeuvreModel) -> None:
        self._robot = robot = model.robot
        self._prediction = model.prediction
        self._period = model.control_period
        self._axes, self._efforts = model.axes, model.efforts
        self._end_effectors = model.end_effectors
        self._curvature = robot.function("curvature", compile=False)
        self._connection = robot.connection
        self._n = robot.n

    def hold(
        self,
        trajectory: Trajectory,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        *,
        fixed: bool = False,
        before: Array | float = 0.0,
    ) -> HeldCommands | None:
        """Return the commands of a trajectory that end in the shape and attitude of the goal.

        They take the trajectory's time, rounded up to ticks, or as much longer as it takes to keep
        the limits (``fixed``: not longer); None where that is not found. Where the boundary
        conditions leave the last shape free, it is the trajectory's, or one near to it. ``before``
        are the velocities (n,) that are held until then.
        """
        final = boundary.final
        if final is None:
            final = np.clip(trajectory.shapes[-1], limits.lower, limits.upper)
        if boundary.center is not None:
            final = nearest_for_center(self._robot, limits, final, boundary.center)
        if final is None:
            return None
        ticks = max(1, math.ceil(trajectory.duration / self._period - _TICK_ROUNDING))
        most = (
            ticks if fixed else max(_MIN_SMOOTH_TICKS, math.ceil(_MAX_STRETCH_FACTOR * ticks) + 4)
        )
        free = boundary.final is None and boundary.center is None
        # The last shape is that at which end-effectors are at their goals.
        choices = (False, True)[free and self._end_effectors is not None : 1 + free]
        for _ in range(_MAX_STRETCHES):
            factor = math.inf
            for moves_end in choices:
                positions = trajectory.at_ticks(ticks)
                held = self._adjust_to_goal(positions, boundary, final, limits, moves_end=moves_end)
                if held is None:
                    continue
                needed, overrun = limits.excess(held.positions, self._period, before)
                if overrun > _LIMIT_ROUNDING:
                    held = self._adjust_to_goal(
                        positions, boundary, final, limits, moves_end=moves_end, clipped=True
                    )
                    if held is None:
                        continue
                    needed, overrun = limits.excess(held.positions, self._period, before)
                if self._efforts is not None:
                    L_B = boundary.momenta_in_base(held.quaternions)
                    needed = max(needed, self._efforts.excess(held.positions, before, L_B))
                if overrun <= _LIMIT_ROUNDING:
                    if needed <= 1 + _LIMIT_ROUNDING:
                        return held
                    factor = min(factor, needed)
                if ticks >= _MIN_SMOOTH_TICKS:
                    break
            if factor == math.inf:
                if ticks >= _MIN_SMOOTH_TICKS:
                    return None
                # A polygon with more corners may reach the goal.
                factor = 1.0
            ticks = max(ticks + 1, math.ceil(ticks * factor - 1e-9))
            if ticks > most:
                return None
        return None

    def corrected_aim(
        self, trajectory: Trajectory, boundary: BoundaryConditions, ticks: int
    ) -> BoundaryConditions:
        """Return boundary conditions whose solution ends at the goal as commands of ``ticks``.

        The goal attitude is turned by the difference between the end of a trajectory and that of
        its commands. Where the robot drifts, the solver's attitude is of order two only.
        """
        start, L_0 = np.array([0.0, 0.0, 0.0, 1.0]), boundary.angular_momentum
        reached = self._prediction.attitudes(trajectory.at_ticks(ticks), start, L_0)[-1]
        error = quaternion_from_rotvec(attitude_error(reached, trajectory.quaternions[-1]))
        return replace(boundary, turn=quaternion_multiply(boundary.turn, error))

    def _adjust_to_goal(
        self,
        positions: Array,
        boundary: BoundaryConditions,
        final: Array,
        limits: MotionLimits,
        *,
        moves_end: bool,
        clipped: bool = False,
    ) -> HeldCommands | None:
        """Add waves to shapes (N + 1, n) so that they end in the goal attitude; None on failure.

        ``moves_end``: the last shape is changed, too. ``clipped``: after every step, shapes beyond
        the joint limits are put on them, and the others make up for the change.
        """
        s = np.linspace(0.0, 1.0, len(positions))[:, np.newaxis]
        # The solver's last shape is the wanted one to its own precision.
        positions = positions + s**3 * (10 - 15 * s + 6 * s**2) * (final - positions[-1])
        positions = np.clip(positions, limits.lower, limits.upper)
        positions[0], positions[-1] = boundary.start, final
        waves, best = self._build_waves(positions, limits), math.inf
        if moves_end:
            waves = np.hstack([waves, self._build_ramps(s, limits)])
        for _ in range(_MAX_NEWTON_STEPS):
            quaternions = self._prediction.attitudes(
                positions, np.array([0.0, 0.0, 0.0, 1.0]), boundary.angular_momentum
            )
            error = self._axes @ attitude_error(quaternions[-1], boundary.turn)
            if self._end_effectors is not None:
                rows, by_turn, by_shape = self._end_effectors.evaluate(
                    quaternions[-1:], positions[-1:], boundary.end_effectors
                )
                error = np.concatenate([error, -rows[0]])
            miss = float(np.linalg.norm(error))
            if miss <= _ATTITUDE_TOLERANCE or (
                miss <= 1e3 * _ATTITUDE_TOLERANCE and miss > best / 2
            ):
                return HeldCommands(positions, quaternions, miss)
            if miss > 2 * best:
                return None
            best = min(best, miss)
            turn = self._first_variation(positions, quaternions, waves, boundary)
            J = self._axes @ turn
            if self._end_effectors is not None:
                J = np.vstack([J, by_turn[0] @ turn + by_shape[0] @ waves[-1].T])
            amplitudes = np.linalg.lstsq(J, error, rcond=1e-10)[0]
            positions = positions + np.einsum("kin,i->kn", waves, amplitudes)
            if clipped:
                positions = np.clip(positions, limits.lower, limits.upper)
                waves = self._build_waves(positions, limits)
                if moves_end:
                    ramps = self._build_ramps(s, limits)
                    if self._end_effectors is not None:
                        # The others make up for joints at the end of their range.
                        ramps = ramps * self._fading(positions[-1], limits)
                    waves = np.hstack([waves, ramps])
        return None

    def _build_waves(self, positions: Array, limits: MotionLimits) -> Array:
        """Return waves (N + 1, w, n) of one joint each, in proportion to its speed."""
        s = np.linspace(0.0, 1.0, len(positions))[:, np.newaxis]
        order = np.arange(1, _WAVES_PER_JOINT + 1)
        shape = np.sin(math.pi * s) * np.sin(math.pi * s * order) / order
        speed, _ = self._speeds_and_half_ranges(positions[0], limits)
        fading = self._fading(positions, limits)
        joints = np.eye(self._n) * speed
        waves = (
            shape[:, :, np.newaxis, np.newaxis] * (fading[:, np.newaxis] * joints)[:, np.newaxis]
        )
        return np.asarray(waves.reshape(len(positions), -1, self._n))

    def _fading(self, positions: Array, limits: MotionLimits) -> Array:
        """Return factors (..., n) that vanish where joints are at the ends of their ranges."""
        _, half = self._speeds_and_half_ranges(positions.reshape(-1, self._n)[0], limits)
        room = np.minimum(positions - limits.lower, limits.upper - positions)
        with np.errstate(divide="ignore", invalid="ignore"):
            fading = np.clip(np.nan_to_num(room / (_FADING_ZONE * half), nan=0.0), 0.0, 1.0)
        # The wave begins smoothly, so that accelerations stay small.
        return np.asarray(fading**2 * (3 - 2 * fading))

    def _build_ramps(self, s: Array, limits: MotionLimits) -> Array:
        """Return ramps (N + 1, n, n) that move the last shape."""
        speed, _ = self._speeds_and_half_ranges(np.zeros(self._n), limits)
        return np.asarray((s**2 * (3 - 2 * s))[:, :, np.newaxis] * np.eye(self._n) * speed)

    def _speeds_and_half_ranges(self, q: Array, limits: MotionLimits) -> tuple[Array, Array]:
        """Return a speed (n,) of every joint, and half of its range round q (n,)."""
        half = limits.span(q)[1]
        return np.where(np.isfinite(limits.velocity), limits.velocity, half), half

    def _first_variation(
        self, positions: Array, quaternions: Array, waves: Array, boundary: BoundaryConditions
    ) -> Array:
        """Return the turns (3, w) of the final attitude by waves (N + 1, w, n), base components."""
        # A few hundred points of a smooth integrand are plenty for Newton's direction.
        stride = max(1, len(positions) // 200)
        chosen = np.arange(stride // 2, len(positions), stride)
        shapes = positions[chosen]
        moved = np.gradient(positions, axis=0)[chosen] * stride
        K = self._curvature(shapes.T).full().reshape(6, len(chosen), self._n, self._n)[3:]
        # The columns of one shape run over i fastest: K[axis, shape, j, i].
        twists = np.einsum("akji,kj,kwi->kaw", K, moved, waves[chosen])
        R = np.array([matrix_from_quaternion(x) for x in quaternions[chosen]])
        R_f = matrix_from_quaternion(quaternions[-1])
        # The last step of a change that does not vanish at the end turns the base directly.
        direct = self._connection(positions[-1])[3:] @ waves[-1].T
        L_B = boundary.momenta_in_base(quaternions[chosen])
        if L_B is None:
            return np.asarray(R_f.T @ np.einsum("kab,kbw->aw", R, twists) - direct)
        moves, duration = waves[chosen].transpose(0, 2, 1), stride * self._period
        accumulated = self._drift.accumulated(shapes, L_B, R, R @ twists, moves, duration)
        return np.asarray(R_f.T @ accumulated - direct)

    @cached_property
    def _drift(self) -> DriftVariation:
        return DriftVariation(self._robot)


class DriftVariation:
    """The first variation of the attitude of a robot whose angular momentum is not zero.

    With ``w = D^-1 (L_B - D_q q')``, ``L_B = R' L``, ``A = D^-1 D_q`` and ``xi = R (eta + A dq)``,

    ``xi' = R (K(dq, q') + G dq + D^-1 (L_B x R' xi))``,
    ``G dq = d(D^-1 L_B)/dq dq + (D^-1 L_B) x A dq - D^-1 (L_B x A dq)``,

    where K is the curvature, as it is at zero momentum.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        q, L_B = ca.SX.sym("q", robot.n), ca.SX.sym("L_B", 3)
        D, D_q = robot.function("locked_inertia", compile=False)(q)
        inverse, drift = solve_positive_definite(D, ca.SX.eye(3)), solve_positive_definite(D, L_B)
        A = inverse @ D_q
        G = ca.jacobian(drift, q) + ca.skew(drift) @ A - inverse @ ca.skew(L_B) @ A
        outputs = [ca.densify(ca.vec(G)), ca.densify(ca.vec(inverse @ ca.skew(L_B)))]
        self._function = ca.Function("drift_variation", [q, L_B], ca.cse(outputs))
        self._n = robot.n

    def accumulated(
        self,
        shapes: Array,
        L_B: Array,
        R: Array,
        turned: Array,
        moves: Array,
        duration: float,
    ) -> Array:
        """Return xi (3, w) at the end of K steps of a duration, s.

        ``shapes`` (K, n), ``L_B`` (K, 3) and ``R`` (K, 3, 3) are those of the steps, ``turned``
        (K, 3, w) what curvature adds to xi in each, and ``moves`` (K, n, w) the changes dq.
        """
        columns = (each.full().T for each in self._function(shapes.T, L_B.T))
        G, M = (each.reshape(len(shapes), -1, 3).transpose(0, 2, 1) for each in columns)
        added = turned + duration * (R @ G @ moves)
        carried = duration * (R @ M @ R.transpose(0, 2, 1))
        # The implicit midpoint rule of xi' = M xi + b.
        half, xi = np.eye(3), np.zeros(turned.shape[1:])
        for step, change in zip(carried, added, strict=True):
            xi = np.linalg.solve(half - step / 2, (half + step / 2) @ xi + change)
        return xi
