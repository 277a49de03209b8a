"""End-effectors at the end of a motion: conditions on the final shape and attitude.

At zero momentum, the system's centre of mass C is at rest, so the final shape q and the base
rotation X since the start determine the pose of every link E: relative to C, in the initial
attitude B_0 of the base,

``r_CE = X (r_BE(q) - r_BC(q))``,  ``R = X R_BE(q)``.

An end-effector goal specifies ``r_CE``, or both ``r_CE`` and ``R``; a base position is treated as
the goal of the base link. In the optimal control problem, the goals become
:class:`EndEffectorRows`, only along directions in which the joints can move the link. The solver
finds only the nearest minimum, and every family of shapes has its own minimum. So the guesses end
in shapes found by inverse kinematics (:meth:`EndEffectorSpecification.boundary_conditions`), each
with the base rotation along the direct path to that shape (Umetani and Yoshida's generalised
Jacobian).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from spacerobot_ros.errors import NotFoundError, PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_inverse,
    quaternion_multiply,
    quaternions_from_rotvecs,
    swing_angle,
)
from spacerobot_ros.model.symbolic_rotations import half_angle_vector
from spacerobot_ros.model.symbolic_rotations import (
    matrix_from_quaternion as symbolic_matrix_from_quaternion,
)
from spacerobot_ros.planning.core.controllability import sample_shapes
from spacerobot_ros.planning.core.goal import (
    Controlled,
    EndEffectorGoal,
    Goal,
    RobotState,
    Tolerance,
    end_effector_pose,
)
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.methods.optimal.goal_specification import GoalSpecification
from spacerobot_ros.planning.methods.optimal.initial_guesses import attitudes_along
from spacerobot_ros.planning.methods.optimal.motion_bounds import reach_of_end_effector
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    PossibleEnd,
)
from spacerobot_ros.planning.methods.optimal.transcription import turn_function

_SAMPLED_SHAPES = 8
_SINGULAR_VALUE_TOLERANCE = 1e-7

_MIN_MOTION = 1e-9
"""Largest link motion, m or rad, per metre or radian of the joints that is treated as zero."""

_PARAMETERS_PER_LINK = 7
"""Number of values of a link's goal: r_CE and a quaternion."""

_STARTS, _ADDITIONAL_STARTS = 16, 96
"""Number of start shapes for inverse kinematics, and of further ones if none succeeds."""

_ITERATIONS = 40
"""Steps of inverse kinematics."""

_DAMPING = 1e-4
"""Least-squares damping in a step, relative to the largest matrix entry."""

_DAMPING_OF_EXACT_ENDS = 1e-9
"""The same if end shapes must meet the goal exactly."""

_END_ERROR = 2e-3
"""Largest error, m or rad, of the end of an initial guess; the solver removes it."""

_DIRECT_PATH_STEPS = 12

_MAX_STEP = 0.5  # m or rad

_POSSIBLE_ENDS = 6
"""Number of end shapes that the initial guesses of a search use in turn."""

_MIN_END_DIFFERENCE = 0.05
"""End shapes closer than this, as a fraction of the joint ranges, are considered equal."""

_GIVEN_SHAPE_ERROR = 1e-9
"""Smallest error at which given joint positions contradict an end-effector goal, m or rad."""


@dataclass(frozen=True)
class LinkDirections:
    """Directions, in B_0, along which the joints can move a link: (k, 3) of its origin, (l, 3) of
    its rotation; no rotation rows if any attitude is allowed.
    """

    link: str
    displacements: Array
    rotations: Array


class EndEffectorRows:
    """Constraint rows that vanish if a robot's links are at their goals.

    Parameters
    ----------
    robot
        The model.
    links
        Links, each with a flag for whether the link attitude is part of the goal.
    axes
        (m, 3) directions in the base frame about which joint loops rotate it.
    """

    def __init__(self, robot: SpaceRobot, links: Sequence[tuple[str, bool]], axes: Array) -> None:
        self.robot, self.links, self.axes = robot, tuple(links), axes
        self.parameters = _PARAMETERS_PER_LINK * len(self.links)
        self.directions = tuple(self._directions(link, attitude) for link, attitude in links)
        """Directions of each link."""

    @cached_property
    def turn(self) -> ca.Function:
        """Base rotation by a shape step (:func:`.turn_function`)."""
        return turn_function(self.robot)

    @cached_property
    def function(self) -> ca.Function:
        """The rows by base rotation (4,), shape (n,) and parameters (:meth:`pack`), in SX."""
        X, q = ca.SX.sym("X", 4), ca.SX.sym("q", self.robot.n)
        parameters = ca.SX.sym("p", self.parameters)
        center = self.robot.function("center_of_mass", compile=False)(q)
        R_X, rows = symbolic_matrix_from_quaternion(X), [ca.SX(0, 1)]
        by_link = ca.vertsplit(parameters, _PARAMETERS_PER_LINK)
        for each, goal in zip(self.directions, by_link, strict=True):
            R_BE, r_BE = self.robot.function(f"link_pose:{each.link}", compile=False)(q)
            r_CE = R_X @ (r_BE - center)
            rows.append(ca.DM(each.displacements) @ (r_CE - goal[:3]))
            if len(each.rotations):
                turned = R_X @ R_BE @ symbolic_matrix_from_quaternion(goal[3:]).T
                rows.append(ca.DM(each.rotations) @ half_angle_vector(turned))
        return ca.Function("end_effectors", [X, q, parameters], [ca.vertcat(*rows)])

    def pack(self, state: RobotState, goals: Sequence[EndEffectorGoal]) -> Array:
        """Return the goal parameters (7 k,): r_CE and the quaternion of E, both in B_0."""
        R_WB = matrix_from_quaternion(state.quaternion)
        r_WC = state.position + R_WB @ self.robot.center_of_mass(state.q)
        from_start = quaternion_inverse(state.quaternion)
        values = []
        for each in goals:
            values.append(R_WB.T @ (each.position - r_WC))
            attitude = np.array([0.0, 0.0, 0.0, 1.0])
            if each.quaternion is not None:
                attitude = quaternion_multiply(from_start, each.quaternion)
            values.append(attitude)
        return np.concatenate(values)

    @cached_property
    def _with_derivatives(self) -> ca.Function:
        """Rows, and their derivatives by a base rotation (in the base frame) and by q."""
        X, q = ca.SX.sym("X", 4), ca.SX.sym("q", self.robot.n)
        p = ca.SX.sym("p", self.parameters)
        rows = self.function(X, q, p)
        v, w = X[:3], X[3]
        by_rotation = ca.vertcat(w * ca.DM.eye(3) + ca.skew(v), -v.T) / 2
        outputs = [rows, ca.jacobian(rows, X) @ by_rotation, ca.jacobian(rows, q)]
        return ca.Function("end_effectors", [X, q, p], ca.cse(list(map(ca.densify, outputs))))

    def evaluate(self, X: Array, q: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """Return rows (K, m) and their derivatives (K, m, 3) and (K, m, n) at K motion ends.

        The derivatives are by a rotation in the base frame and the shape; X (K, 4), q (K, n).
        """
        K = len(q)
        p = np.repeat(parameters[:, np.newaxis], K, axis=1)
        rows, by_rotation, by_shape = (each.full() for each in self._with_derivatives(X.T, q.T, p))
        m = len(rows)
        return (
            rows.T,
            by_rotation.reshape(m, K, 3).transpose(1, 0, 2),
            by_shape.reshape(m, K, self.robot.n).transpose(1, 0, 2),
        )

    def turns_along_direct_path(self, start: Array, ends: Array) -> Array:
        """Return the base rotations (K, 4) along straight paths from a shape to ends (K, n)."""
        step = ((ends - start) / _DIRECT_PATH_STEPS)[:, np.newaxis]
        shapes = start + step * np.arange(_DIRECT_PATH_STEPS)[:, np.newaxis]
        steps = np.broadcast_to(step, shapes.shape)
        return attitudes_along(self.turn, shapes, steps, steps)[:, -1]

    def rank(self, fixed_attitude: bool) -> tuple[int, int]:
        """Return the number of rows that the joints can move independently, and of all rows.

        Rows are counted at shapes in general position, with the base attitude given or free.
        """
        shapes, turns = self._samples()
        nowhere = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], len(self.links))
        _, by_rotation, J = self.evaluate(turns, shapes, nowhere)
        if not fixed_attitude:
            J = np.concatenate([J, by_rotation @ self.axes.T], axis=2)
        return int(np.linalg.matrix_rank(J, tol=1e-6).max()), J.shape[1]

    def require_directions(
        self, state: RobotState, goals: Sequence[EndEffectorGoal], tolerance: Tolerance
    ) -> None:
        """Reject goals outside the directions in which the links can move.

        Raises
        ------
        UnreachableError
            The goal requires link motion in other directions.
        """
        R_WB = matrix_from_quaternion(state.quaternion)
        name = self.robot.description.name
        for each, goal in zip(self.directions, goals, strict=True):
            r_WE, now = end_effector_pose(
                self.robot, each.link, state.position, state.quaternion, state.q
            )
            way = R_WB.T @ (goal.position - r_WE)
            beside = float(np.linalg.norm(way - each.displacements.T @ (each.displacements @ way)))
            if beside > tolerance.position:
                where = {0: "does not move", 1: "moves along one line", 2: "moves in one plane"}
                raise UnreachableError(
                    f"The end-effector '{each.link}' of robot '{name}' "
                    f"{where[len(each.displacements)]} for any joint motion, but its goal is "
                    f"{beside:.3g} m away from there.",
                    Proof.RANK,
                )
            if goal.quaternion is None:
                continue
            turn = quaternion_multiply(goal.quaternion, quaternion_inverse(now))
            turn = np.append(R_WB.T @ turn[:3], turn[3])
            swing = swing_angle(turn, each.rotations)
            if swing > tolerance.attitude:
                where = {0: "does not rotate", 1: "rotates about one axis"}
                raise UnreachableError(
                    f"The end-effector '{each.link}' of robot '{name}' "
                    f"{where[len(each.rotations)]} for any joint motion, but its goal is tilted "
                    f"by {swing:.3g} rad from there.",
                    Proof.RANK,
                )

    def require_within_reach(
        self, limits: MotionLimits, state: RobotState, goals: Sequence[EndEffectorGoal]
    ) -> None:
        """Reject goals that are farther from the centre of mass than shapes reach.

        Raises
        ------
        UnreachableError
            No shape within the limits brings a link so far.
        """
        robot, R_WB = self.robot, matrix_from_quaternion(state.quaternion)
        r_WC = state.position + R_WB @ robot.center_of_mass(state.q)
        for each in goals:
            reach = reach_of_end_effector(robot, limits.lower, limits.upper, each.link)
            distance = float(np.linalg.norm(each.position - r_WC))
            if distance > reach * (1 + 1e-9):
                raise UnreachableError(
                    f"The goal of '{each.link}' is out of reach: it is {distance:.4g} m from the "
                    "centre of mass, which stays where it is without thrust, and the joints of "
                    f"'{robot.description.name}' can move '{each.link}' no farther from it than "
                    f"{reach:.4g} m.",
                    Proof.LIMITS,
                )

    def _samples(self) -> tuple[Array, Array]:
        """Return shapes (K, n) in general position, and a base rotation (K, 4) for each."""
        shapes = sample_shapes(self.robot, _SAMPLED_SHAPES)
        vectors = np.random.default_rng(0).normal(size=(len(shapes), len(self.axes))) @ self.axes
        return shapes, quaternions_from_rotvecs(vectors)

    def _directions(self, link: str, attitude: bool) -> LinkDirections:
        # Rates in B_0 relative to C, by the joints at zero momentum and by base rotations.
        velocities, turns = [], []
        for q, X in zip(*self._samples(), strict=True):
            R_X = matrix_from_quaternion(X)
            # [v_cm; omega; qdot] -> [v_E; omega_E]
            by_base = self.robot.jacobian(link, q)[:, 3:6] @ self.axes.T
            for rates in (self.robot.generalised_jacobian(link, q), by_base):
                velocities.append(R_X @ rates[:3])
                turns.append(R_X @ rates[3:])
        rotations = _span(np.hstack(turns)) if attitude else np.zeros((0, 3))
        return LinkDirections(link, _span(np.hstack(velocities)), rotations)


def _span(vectors: Array) -> Array:
    """Return an orthonormal basis (k, 3) of the space that columns (3, N) span."""
    U, sizes, _ = np.linalg.svd(vectors, full_matrices=False)
    if sizes[0] <= _MIN_MOTION:
        return np.zeros((0, 3))
    k = int(np.sum(sizes > _SINGULAR_VALUE_TOLERANCE * sizes[0]))
    return np.eye(3) if k == 3 else np.asarray(U[:, :k].T)


@dataclass(frozen=True)
class _InverseKinematics:
    """Finds shapes and base rotations with the links of ``rows`` at their goals, ``parameters`` (7
    k,), after a motion from the shape ``start`` (n,); ``fixed``: the base rotation is given.
    """

    rows: EndEffectorRows
    start: Array
    limits: MotionLimits
    parameters: Array
    fixed: bool

    def solve(
        self, shapes: Array, turns: Array | None, *, exact: bool = False
    ) -> tuple[Array, Array, Array]:
        """Return shapes (K, n), turns (K, 4) and errors (K,) of ends, from initial shapes (K, n).

        The ``turns`` (K, 4) of the base are fixed, or initial values that are free along the axes;
        None: they follow the direct path. ``exact``: whether ends meet the goal exactly.
        """
        damping = _DAMPING_OF_EXACT_ENDS if exact else _DAMPING
        error = _GIVEN_SHAPE_ERROR if exact else _END_ERROR / 10
        rows, limits, parameters = self.rows, self.limits, self.parameters
        n, count = len(self.start), len(shapes)
        connection = rows.robot.function("connection", compile=False)
        X = rows.turns_along_direct_path(self.start, shapes) if turns is None else turns
        free = turns is not None and not self.fixed
        for _ in range(_ITERATIONS):
            values, by_rotation, by_shape = rows.evaluate(X, shapes, parameters)
            J = by_shape
            if free:
                J = np.concatenate([by_shape, by_rotation @ rows.axes.T], axis=2)
            elif turns is None:
                A = connection(shapes.T).full()[3:].reshape(3, count, n).transpose(1, 0, 2)
                J = by_shape - by_rotation @ A
            if np.abs(values).max() <= error:
                break
            # Joints at a limit that the step would exceed are excluded from the step.
            for _ in range(2):
                normal = J.transpose(0, 2, 1) @ J
                largest = np.maximum(np.abs(normal).max(axis=(1, 2)), 1e-12)
                normal = normal + damping * largest[:, np.newaxis, np.newaxis] * np.eye(J.shape[2])
                slope = -(J.transpose(0, 2, 1) @ values[:, :, np.newaxis])
                step = np.linalg.solve(normal, slope)[:, :, 0]
                beyond = (shapes <= limits.lower) & (step[:, :n] < 0)
                beyond |= (shapes >= limits.upper) & (step[:, :n] > 0)
                if not beyond.any():
                    break
                J = J.copy()
                J[:, :, :n] *= ~beyond[:, np.newaxis]
            step *= np.minimum(1.0, _MAX_STEP / np.abs(step).max(axis=1, keepdims=True).clip(1e-9))
            shapes = np.clip(shapes + step[:, :n], limits.lower, limits.upper)
            if free:
                turned = quaternions_from_rotvecs(step[:, n:] @ rows.axes)
                X = quaternion_multiply(X, turned)
            elif turns is None:
                X = rows.turns_along_direct_path(self.start, shapes)
        values, _, _ = rows.evaluate(X, shapes, parameters)
        return shapes, X, np.abs(values).max(axis=1)


@dataclass(frozen=True)
class EndEffectorSpecification:
    """End-effector goal components reached by one robot's manoeuvres.

    Attributes
    ----------
    rows
        Rows for the end-effectors, and for the base link if its position is requested.
    base
        How the joints rotate the base.
    base_parts, shape
        The components of the base pose in the goal, and whether joint positions are part of it.
    overdetermined
        Whether the goal has more coordinates than the joints can move independently. Few such goals
        can be reached, in isolated shapes, which inverse kinematics finds before planning.
    """

    rows: EndEffectorRows
    base: GoalSpecification
    base_parts: frozenset[Controlled]
    shape: bool
    overdetermined: bool

    @classmethod
    def of(cls, base: GoalSpecification, goal: Goal) -> EndEffectorSpecification:
        """Return the specification for goals like this one, whose links are resolved."""
        robot = base.robot
        links = [(each.link, each.quaternion is not None) for each in goal.end_effectors]
        if "position" in goal.base:
            links.append((robot.base_link, False))
        rows = EndEffectorRows(robot, links, base.base_rotations.loop_axes)
        rank, count = rows.rank("attitude" in goal.base)
        shape = goal.joint_positions is not None
        return cls(rows, base, goal.base, shape, rank < count)

    @staticmethod
    def key(goal: Goal) -> tuple[object, ...]:
        """Return a key that is equal for goals with the same components."""
        links = ((each.link, each.quaternion is not None) for each in goal.end_effectors)
        return (*links, goal.base, goal.joint_positions is not None)

    @property
    def controls(self) -> frozenset[Controlled]:
        """The controlled components by name."""
        return self.base_parts | {"shape", "end_effectors"}

    @property
    def attitude(self) -> bool:
        """Whether the base attitude is part of the goal."""
        return "attitude" in self.base_parts

    @property
    def ends_in_one_shape(self) -> bool:
        """Whether a motion is planned to a given shape, not to end-effector goals."""
        return self.shape or self.overdetermined

    @property
    def axes(self) -> Array:
        """Directions (m, 3), in the base frame, along which the base attitude must be reached."""
        if self.ends_in_one_shape:
            return self.rows.axes
        return self.base.base_rotations.axes if self.attitude else np.zeros((0, 3))

    def boundary_conditions(
        self, request: PlanRequest, shape: Array | None, limits: MotionLimits
    ) -> BoundaryConditions:
        """Return the boundary conditions for a request, with possible ends for the guesses.

        The arguments are as in :meth:`GoalSpecification.boundary_conditions`.

        Raises
        ------
        UnreachableError
            A goal component is out of the robot's reach.
        NotFoundError
            No shape that puts the end-effectors at their goals was found.
        PlanningError
            The method does not support such a goal.
        """
        robot, state = self.base.robot, request.state
        goal, tolerance = request.goal, request.tolerance
        if robot.n == 0:
            name = robot.description.name
            raise PlanningError(f"Robot '{name}' has no joints that could move an end-effector.")
        turn = quaternion_multiply(quaternion_inverse(state.quaternion), goal.quaternion)
        if self.attitude:
            self.base.require_suitable()
            self.base.require_turning_with_drift(state)
            self.base.require_reachable_turn(turn, tolerance.attitude)
        goals = list(goal.end_effectors)
        if "position" in self.base_parts:
            goals.append(EndEffectorGoal(robot.base_link, goal.position))
        rows = self.rows
        rows.require_directions(state, goals, tolerance)
        rows.require_within_reach(limits, state, goal.end_effectors)
        parameters = rows.pack(state, goals)
        kinematics = _InverseKinematics(rows, state.q, limits, parameters, self.attitude)
        if shape is not None:
            turn = self._turn_with_shape(kinematics, shape, turn, tolerance.position)
            ends: list[PossibleEnd] = [PossibleEnd(shape, turn)]
        else:
            ends = self._find_possible_ends(kinematics, turn)
        if shape is None and self.overdetermined:
            ends = [self._exact_end(kinematics, ends, tolerance)]
            shape, turn = ends[0].shape, ends[0].base_rotation
        return BoundaryConditions(
            state.q,
            turn,
            ends[0].shape,
            shape,
            end_effectors=np.zeros(0) if self.ends_in_one_shape else parameters,
            possible_ends=tuple(ends),
        )

    def _turn_with_shape(
        self, kinematics: _InverseKinematics, shape: Array, turn: Array, tolerance: float
    ) -> Array:
        """Return the base rotation (4,) that puts the end-effectors at their goals in a shape.

        UnreachableError if there is none.
        """
        if self.attitude:
            X = turn
        elif not len(self.rows.axes):
            X = self.rows.turns_along_direct_path(kinematics.start, shape[np.newaxis])[0]
        else:
            # Joint loops rotate the base about the axes; the shape is given.
            candidates = quaternions_from_rotvecs(
                np.vstack([np.zeros((1, 3)), *(np.pi * k / 2 * self.rows.axes for k in (1, 2, 3))])
            )
            shapes = np.tile(shape, (len(candidates), 1))
            limits = replace(kinematics.limits, lower=shape, upper=shape)
            given = replace(kinematics, start=shape, limits=limits)
            _, turns, miss = given.solve(shapes, candidates, exact=True)
            X = turns[np.argmin(miss)]
        values, _, _ = self.rows.evaluate(X[np.newaxis], shape[np.newaxis], kinematics.parameters)
        if np.abs(values).max(initial=0.0) > max(tolerance, _GIVEN_SHAPE_ERROR):
            raise UnreachableError(
                f"With the goal's joint positions, no base attitude puts the end-effectors closer "
                f"than {np.linalg.norm(values):.3g} m or rad to their goals: "
                "the centre of mass stays where it is. Leave the joint positions out.",
                Proof.MOMENTUM,
            )
        return X

    def _find_possible_ends(self, kinematics: _InverseKinematics, turn: Array) -> list[PossibleEnd]:
        """Return ends for guesses, fastest to reach first, or raise NotFoundError."""
        rng, start, limits = np.random.default_rng(0), kinematics.start, kinematics.limits
        middle, half = limits.joint_ranges(start)
        nearest = np.inf
        for count, follows in ((_STARTS, True), (_STARTS, False), (_ADDITIONAL_STARTS, False)):
            # From the start, from nearby, and from anywhere.
            anywhere = middle + half * rng.uniform(-1, 1, (count, len(start)))
            share = np.linspace(0.0, 1.0, count)[:, np.newaxis]
            shapes = np.clip(start + share * (anywhere - start), limits.lower, limits.upper)
            turns = None if follows else self.rows.turns_along_direct_path(start, shapes)
            if self.attitude:
                turns = np.tile(turn, (count, 1))
            shapes, X, miss = kinematics.solve(shapes, turns)
            nearest = min(nearest, float(miss.min()))
            speeds = np.maximum(limits.speeds(start), 1e-9)
            times = np.abs((shapes - start) / speeds).max(axis=1)
            ends: list[PossibleEnd] = []
            for k in np.argsort(times, kind="stable"):
                scaled = [np.abs((shapes[k] - end.shape) / np.maximum(half, 1e-9)) for end in ends]
                is_new = all(each.max() > _MIN_END_DIFFERENCE for each in scaled)
                if miss[k] <= _END_ERROR and is_new:
                    ends.append(PossibleEnd(shapes[k], X[k]))
            if ends:
                return ends[:_POSSIBLE_ENDS]
        raise self._not_found(nearest)

    def _exact_end(
        self, kinematics: _InverseKinematics, ends: Sequence[PossibleEnd], tolerance: Tolerance
    ) -> PossibleEnd:
        """Return the first end that meets an overdetermined goal, or raise NotFoundError."""
        turns = np.array([each.base_rotation for each in ends])
        shapes, X, miss = kinematics.solve(
            np.array([each.shape for each in ends]),
            turns if self.attitude or len(self.rows.axes) else None,
            exact=True,
        )
        exact = miss <= max(_GIVEN_SHAPE_ERROR, min(tolerance.position, tolerance.attitude))
        if not exact.any():
            raise self._not_found(float(miss.min()))
        k = int(np.argmax(exact))
        return PossibleEnd(shapes[k], X[k])

    def _not_found(self, nearest: float) -> NotFoundError:
        """Return the error for a goal whose nearest shape misses it by ``nearest``, m or rad."""
        robot = self.rows.robot.description.name
        names = " and ".join(f"'{link}'" for link, _ in self.rows.links)
        remedy = (
            "A closer goal, a position instead of a pose, or more freedom for the base may help."
        )
        if self.overdetermined:
            rank, count = self.rows.rank(self.attitude)
            remedy = (
                f"The goal requires {count} independent coordinates, but the joints move no more "
                f"than {rank}: request a position instead of a pose, or fewer base components."
            )
        return NotFoundError(
            f"No shape of robot '{robot}' with {names} at the goal was found from "
            f"{2 * _STARTS + _ADDITIONAL_STARTS} shapes; the nearest is {nearest:.3g} m or rad "
            f"away. {remedy}"
        )
