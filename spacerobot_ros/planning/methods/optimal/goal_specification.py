"""Goal specification: the goal components to be reached, and whether the joints can reach them.

At zero momentum, ``omega_WB_B = F(q) qdot``. If all columns of F are parallel to one axis, the base
rotates only about that axis. Otherwise the brackets of the columns span all rotations, provided
that the curvature of the connection is not zero everywhere (paper 1, section 4).
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.errors import NotFoundError, PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_inverse,
    quaternion_multiply,
    swing_angle,
)
from spacerobot_ros.planning.core.controllability import (
    curvatures,
    independent_slots,
    sample_shapes,
    tilted_goal_error,
)
from spacerobot_ros.planning.core.goal import POSITION_SLACK, Controlled, RobotState
from spacerobot_ros.planning.core.method import NO_JOINTS, PlanRequest
from spacerobot_ros.planning.methods.optimal.motion_bounds import CenterReach
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
)

_ZERO_ROTATION_ANGLE = 1e-9

_SAMPLED_SHAPE_COUNT = 12
_SINGULAR_VALUE_TOLERANCE = 1e-7
_AXIS_TOLERANCE = 1e-6

_MIN_BASE_TURN = 1e-12
"""Largest base rotation, rad, per metre or radian of the joints that is treated as zero."""

_MAX_SHAPE_GUESSES = 8

_INTEGRATION_STEPS, _INTEGRATION_ERROR = 1000, 1e-5
"""Number of integration steps for a base rotation by one joint, and their largest error, rad."""

_JOINT_LIMIT_ROUNDING = 1e-9  # m or rad

_QUADRATURE_NODES = 48
"""Number of Gauss-Legendre nodes along the path to a shape."""

_POSITION_TOLERANCE = 1e-10  # m


@dataclass(frozen=True)
class GoalSpecification:
    """Goal components controlled by one robot's manoeuvres.

    Attributes
    ----------
    robot
        The model.
    position, attitude
        Whether these are controlled.
    same_shape
        Whether goals without a shape end in the initial shape.
    base_rotations
        How the joints rotate the base.
    """

    robot: SpaceRobot
    position: bool
    attitude: bool
    same_shape: bool
    base_rotations: BaseRotations

    @classmethod
    def of(cls, robot: SpaceRobot, options: OptimalOptions) -> GoalSpecification:
        """Return a robot's goal specification according to the options."""
        position = options.base_position == 1
        if options.base_position == 0:
            # Sliders move the base anywhere if their slots span three directions.
            with suppress(PlanningError):
                independent_slots(robot)
                position = True
        attitude, same_shape = bool(options.base_attitude), bool(options.final_shape)
        return cls(robot, position, attitude, same_shape, BaseRotations.of(robot))

    @property
    def controls(self) -> frozenset[Controlled]:
        """The controlled components by name."""
        parts: set[Controlled] = {"shape"}
        if self.position:
            parts.add("position")
        if self.attitude:
            parts.add("attitude")
        return frozenset(parts)

    @property
    def axes(self) -> Array:
        """Directions (m, 3), in the base frame, along which the attitude must be reached."""
        return self.base_rotations.axes if self.attitude else np.zeros((0, 3))

    def require_suitable(self) -> None:
        """Reject a robot that cannot reach any goal in the controlled components.

        Raises
        ------
        PlanningError
            The robot cannot reach any goal; the message says why.
        """
        name = self.robot.description.name
        if self.robot.n == 0:
            raise PlanningError(NO_JOINTS.format(name))
        if self.attitude and self.base_rotations.turns_base and not len(self.base_rotations.axes):
            raise PlanningError(
                f"The attitude of robot '{name}' is uncontrollable: its joints rotate its base "
                "along one curve of attitudes only; with optimal.base_attitude 0, the goal "
                "attitude is ignored."
            )

    def boundary_conditions(
        self, request: PlanRequest, shape: Array | None, limits: MotionLimits
    ) -> BoundaryConditions:
        """Return the boundary conditions for a request.

        Parameters
        ----------
        request, limits
            The request, and the motion limits.
        shape
            (n,) of the goal, within the joint limits; None: any.

        Raises
        ------
        UnreachableError
            A goal component is out of the robot's reach.
        NotFoundError
            No shape that puts the base at its goal was found.
        PlanningError
            The method does not plan for such a goal.
        """
        self.require_suitable()
        robot = self.robot
        state, goal, tolerance = request.state, request.goal, request.tolerance
        turn = quaternion_multiply(quaternion_inverse(state.quaternion), goal.quaternion)
        if shape is None and self.same_shape:
            shape = state.q
        if self.attitude:
            self.require_turning_with_drift(state)
            self.require_reachable_turn(turn, tolerance.attitude)
            if robot.n == 1 and len(self.base_rotations.axes):
                self._require_within_one_joint(limits, state.q, turn, tolerance.attitude)
            if shape is not None and len(self.axes) and not self.base_rotations.loops_turn_base:
                turn = self._turn_on_way_to_shape(turn, state.q, shape, tolerance.attitude)
                # With one joint, the goal attitude fixes the final shape.
                shape = shape if robot.n > 1 else None
        if not self.position:
            likely = state.q if shape is None else shape
            return BoundaryConditions(state.q, turn, likely, shape)
        if not self.attitude:
            raise PlanningError(
                "The base position depends on the base attitude: optimal reaches it together "
                "with the attitude (optimal.base_attitude 1)."
            )
        # The centre of mass r + R c(q) is fixed, which determines c(q_f).
        R_WB = matrix_from_quaternion(state.quaternion)
        r_cm = state.position + R_WB @ robot.center_of_mass(state.q)
        center = matrix_from_quaternion(goal.quaternion).T @ (r_cm - goal.position)
        if shape is not None:
            miss = float(np.linalg.norm(robot.center_of_mass(shape) - center))
            if miss > tolerance.position:
                raise UnreachableError(
                    f"The goal attitude and shape put the base {miss:.3g} m from the goal "
                    "position: without thrust the centre of mass stays where it is. Omit the "
                    "shape, or ignore the position with optimal.base_position 2.",
                    Proof.MOMENTUM,
                )
            return BoundaryConditions(state.q, turn, shape, shape)
        likely = _shape_for_center(
            robot, limits, state.q, center, POSITION_SLACK * tolerance.position
        )
        center = robot.center_of_mass(likely)
        # With three joints, one centre of mass has at most a few shapes.
        if robot.n <= 3:
            return BoundaryConditions(state.q, turn, likely, likely)
        return BoundaryConditions(state.q, turn, likely, center=center)

    def require_turning_with_drift(self, state: RobotState) -> None:
        """Reject drifting robots whose joints cannot rotate the base about the axis of the drift.

        Raises
        ------
        PlanningError
            The robot cannot stop its base.
        """
        L_W, name = state.angular_momentum, self.robot.description.name
        if not L_W.any():
            return
        size = float(np.linalg.norm(L_W))
        drifts = f"Robot '{name}' drifts, with an angular momentum of {size:.3g} kg m^2/s"
        if not self.base_rotations.loops_turn_base:
            raise PlanningError(
                f"{drifts}, and loops of its joints do not rotate its base: optimal can plan for "
                "a drifting robot only if such loops rotate its base. With "
                "optimal.base_attitude 0, the attitude is ignored."
            )
        if len(self.base_rotations.axes) == 1:
            axis = self.base_rotations.axes[0]
            D = self.robot.function("locked_inertia", compile=False)(state.q)[0].full()
            turned = matrix_from_quaternion(state.quaternion).T @ L_W / size
            off = max(np.linalg.norm(np.cross(axis, x)) for x in (turned, D @ axis / D.max()))
            if off > _AXIS_TOLERANCE:
                raise PlanningError(
                    f"{drifts}, which rotates its base about an axis other than that of its "
                    "joints: no joint motion can stop this rotation. With optimal.base_attitude "
                    "0, the goal attitude is ignored."
                )

    def require_reachable_turn(self, turn: Array, tolerance: float) -> None:
        """Reject attitudes that the joints cannot reach."""
        axes, name = self.base_rotations.axes, self.robot.description.name
        tilt = swing_angle(turn, axes)
        if tilt > max(tolerance, _ZERO_ROTATION_ANGLE):
            if not len(axes):
                raise UnreachableError(
                    f"The attitude of robot '{name}' is uncontrollable: its joints do not rotate "
                    f"its base, and the goal is rotated by {tilt:.4g} rad.",
                    Proof.RANK,
                )
            raise tilted_goal_error(self.robot, axes[0], tilt)

    def _turn_on_way_to_shape(
        self, turn: Array, start: Array, shape: Array, tolerance: float
    ) -> Array:
        """Return the turn (4,) on any path to a shape (n,), for robots whose loops rotate nothing.

        UnreachableError if it is not the goal rotation.
        """
        axis, way, robot = self.base_rotations.axes[0], shape - start, self.robot
        nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
        rates = [-axis @ robot.connection(start + (1 + node) / 2 * way)[3:] @ way for node in nodes]
        angle = float(weights @ np.array(rates)) / 2
        wanted = 2 * math.atan2(float(axis @ turn[:3]), float(turn[3]))
        if abs(math.remainder(wanted - angle, 2 * math.pi)) > max(tolerance, _ZERO_ROTATION_ANGLE):
            raise UnreachableError(
                f"The attitude of robot '{robot.description.name}' is uncontrollable if the "
                "final shape is given: loops of its joints do not rotate its base, and the path to "
                f"that shape rotates it by {angle:.4g} rad.",
                Proof.RANK,
            )
        return quaternion_from_rotvec(axis * angle)

    def _require_within_one_joint(
        self, limits: MotionLimits, q: Array, turn: Array, tolerance: float
    ) -> None:
        """Reject a rotation that the only joint, at ``q`` (1,), cannot cause within its limits.

        The base rotates back and forth with the joint; the angle is an integral.
        """
        robot, axis = self.robot, self.base_rotations.axes[0]
        ends = np.array([limits.lower[0], limits.upper[0]])
        if not np.all(np.isfinite(ends)):
            return
        connection = robot.function("connection", compile=False)
        angles = [0.0]
        for end in ends:
            step = (end - q[0]) / _INTEGRATION_STEPS
            middle = q[0] + step * (np.arange(_INTEGRATION_STEPS) + 0.5)
            rates = -axis @ connection(middle[np.newaxis]).full()[3:]
            angles.extend(np.cumsum(rates) * step)
        least, most = min(angles), max(angles)
        wanted = 2 * np.arctan2(axis @ turn[:3], turn[3])
        whole = 2 * np.pi
        # The same attitude may also be reached by rotating the other way.
        turns = np.arange(np.floor(least / whole) - 1, np.ceil(most / whole) + 2)
        nearest = wanted + whole * turns
        beyond = np.maximum(least - nearest, nearest - most)
        if beyond.min() > max(tolerance, _INTEGRATION_ERROR):
            joint = robot.description.movable_joints[0]
            angle = (wanted + np.pi) % whole - np.pi
            raise UnreachableError(
                f"The goal attitude is beyond the joint limits: joint '{joint.name}', the only "
                f"joint, can rotate the base by {least:.4g} to {most:.4g} rad from here, and the "
                f"goal is rotated by {angle:.4g} rad.",
                Proof.LIMITS,
            )


@dataclass(frozen=True)
class BaseRotations:
    """Base rotations caused by joint motions.

    Attributes
    ----------
    axes
        (m, 3) in the base frame: one unit vector for a planar robot, the unit matrix if all
        attitudes can be reached, none if the joints do not rotate the base, or rotate it only back
        and forth along one attitude curve.
    turns_base
        Whether joints rotate the base at all.
    loops_turn_base
        Whether closed shape loops rotate the base.
    """

    axes: Array
    turns_base: bool
    loops_turn_base: bool

    @property
    def loop_axes(self) -> Array:
        """Axes (m, 3) about which closed shape loops rotate the base; none if they do not."""
        return self.axes if self.loops_turn_base else np.zeros((0, 3))

    @classmethod
    def of(cls, robot: SpaceRobot) -> BaseRotations:
        """Test a robot at a few shapes in general position."""
        none = np.zeros((0, 3))
        if robot.n == 0:
            return cls(none, turns_base=False, loops_turn_base=False)
        shapes = sample_shapes(robot, _SAMPLED_SHAPE_COUNT)
        A = robot.function("connection", compile=False)(shapes.T).full()[3:]
        U, sizes, _ = np.linalg.svd(A, full_matrices=False)
        if sizes[0] <= _MIN_BASE_TURN:
            return cls(none, turns_base=False, loops_turn_base=False)
        loops = bool(np.abs(curvatures(robot, shapes)).max() > _SINGULAR_VALUE_TOLERANCE * sizes[0])
        if np.sum(sizes > _SINGULAR_VALUE_TOLERANCE * sizes[0]) == 1:
            axis = U[:, 0] * np.sign(U[np.argmax(np.abs(U[:, 0])), 0])
            return cls(axis[np.newaxis], turns_base=True, loops_turn_base=loops)
        return cls(np.eye(3) if loops else none, turns_base=True, loops_turn_base=loops)


def _center_rate(robot: SpaceRobot, q: Array) -> Array:
    """Return ``dc/dq`` (3, n) of the centre of mass in the base frame: ``-A_v + c x A_omega``."""
    A = robot.connection(q)
    return np.asarray(A[:3] - np.cross(robot.center_of_mass(q), A[3:], axisb=0, axisc=0))


def _shape_for_center(
    robot: SpaceRobot, limits: MotionLimits, start: Array, wanted: Array, enough: float
) -> Array:
    """Return the shape (n,) near ``start`` whose centre of mass is at ``wanted`` (3,), m, in B, or
    at most ``enough``, m, away from there if there is no such shape.
    """
    if all(joint.kind is JointKind.PRISMATIC for joint in robot.description.movable_joints):
        # The centre of mass is linear in sliders: one Newton step is exact.
        found = nearest_shape_for_center(robot, limits, start, wanted)
        if found is not None:
            return found
    lower, upper = limits.lower, limits.upper
    # The solver needs lower bounds below upper bounds.
    room = 1e-9 * (1 + np.abs(start))
    middle, half = limits.joint_ranges(start)
    from scipy.optimize import least_squares  # Slow to import, and not all robots need it.

    rng = np.random.default_rng(0)
    best, miss = start, np.inf
    for attempt in range(_MAX_SHAPE_GUESSES):
        guess = start if attempt == 0 else middle + half * rng.uniform(-0.9, 0.9, robot.n)
        found = least_squares(
            lambda q: robot.center_of_mass(q) - wanted,
            np.clip(guess, lower, upper),
            lambda q: _center_rate(robot, q),
            bounds=(lower - room, upper + room),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        q = np.clip(found.x, lower, upper)
        distance = float(np.linalg.norm(robot.center_of_mass(q) - wanted))
        if distance < miss:
            best, miss = q, distance
        if miss <= 1e-6:
            break
    found = nearest_shape_for_center(robot, limits, best, wanted)
    if found is not None:
        return found
    if miss <= enough:
        return best
    name = robot.description.name
    gap = CenterReach.of(robot, lower, upper).distance_outside(wanted)
    if gap <= _POSITION_TOLERANCE:
        raise NotFoundError(
            f"No shape of '{name}' that puts the base at the goal position was found from "
            f"{_MAX_SHAPE_GUESSES} starts: without thrust, the centre of mass stays where it is, "
            f"and the nearest shape that was found puts the base {miss:.3g} m from it. A closer "
            "position, another attitude, or optimal.base_position 2, which ignores the position, "
            "may help."
        )
    raise UnreachableError(
        "The goal position is out of reach: without thrust the centre of mass stays where it is, "
        f"and the joints of '{name}' bring the base no closer to it than {gap:.3g} m.",
        Proof.LIMITS,
    )


def nearest_shape_for_center(
    robot: SpaceRobot, limits: MotionLimits, near: Array, wanted: Array
) -> Array | None:
    """Return the shape nearest to ``near`` that puts the centre of mass at ``wanted`` (3,)."""
    q = near.copy()
    for _ in range(20):
        miss = wanted - robot.center_of_mass(q)
        if np.linalg.norm(miss) <= 1e-14:
            break
        q = q + np.linalg.lstsq(_center_rate(robot, q), miss, rcond=1e-9)[0]
    if np.maximum(limits.lower - q, q - limits.upper).max() > _JOINT_LIMIT_ROUNDING:
        q = near
    q = np.clip(q, limits.lower, limits.upper)
    return q if np.linalg.norm(robot.center_of_mass(q) - wanted) <= _POSITION_TOLERANCE else None
