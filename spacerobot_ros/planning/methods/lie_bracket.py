"""Sliding masses and first-order Lie brackets: the manoeuvre of paper 1, section 5.

Step 1 finds the final shape ``zf`` that puts the base at the goal position (eq. 9). Step 2 slides
the masses to this shape (eq. 10). Step 3 rotates the base by n equal cycles with three frequencies,
whose brackets sum to the remaining rotation.

The plant holds each command for one tick. The sliders therefore trace polygons inside the smooth
curves. Amplitudes compensate for the smaller area, by a factor ``sin(x)/x``, x the phase per tick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from typing_extensions import override

from spacerobot_ros.errors import PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
    rotvec_from_quaternion,
)
from spacerobot_ros.parameters import nonnegative, parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.controllability import (
    MAX_CONDITION,
    best_triple,
    check_sliding_masses,
    independent_slots,
    sliders_of,
)
from spacerobot_ros.planning.core.goal import POSITION_SLACK, Goal, RobotState
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule, Notes, straight_motion

_MIN_CYCLE_TICKS = 12
_MAX_REFINEMENTS = 20
_SHRINK_FACTOR = 1.4
"""Reduction factor for a cycle in which links come too close."""

_PATH_POSES_PER_STEP = 100
"""Smallest number of predicted path poses in a step; a step has at most twice as many."""

_ZERO_ROTATION_ANGLE = 1e-9


@dataclass(frozen=True)
class LieBracketOptions:
    """The options of ``lie_bracket``."""

    t1: float = parameter(
        100.0, "duration of step 2, the motion to the final shape", "s", minimum=1e-3, maximum=1e9
    )
    n1: int = parameter(
        10, "number of periods of the sin^2 velocity profile in step 2", minimum=1, maximum=10000
    )
    cycle_period: float = parameter(
        3.0, "duration of one cycle in step 3, (tf - t1) / n", "s", minimum=1e-3, maximum=1e9
    )
    cycles: int = nonnegative(
        0, "n, the number of cycles of step 3; 0: determined by loop_area", maximum=1e8
    )
    loop_area: float = parameter(
        0.04, "|alpha| / n if cycles is 0", "m^2", minimum=1e-9, maximum=1e9
    )
    a22_ratio: float = parameter(
        1.0, "free amplitude a22 over sqrt(|a22 b12|); 1: balanced", minimum=1e-3, maximum=1e9
    )
    a31_ratio: float = parameter(
        1.0, "a31 over sqrt(|a31 (b21, b11)|); 1: balanced", minimum=1e-3, maximum=1e9
    )
    longest: float = parameter(
        100000.0, "longest permitted manoeuvre", "s", minimum=1.0, maximum=1e9
    )


class LieBracketGait(GaitMethod):
    """Controls the pose of a base with three or more sliders; slots may be offset."""

    name: ClassVar[str] = "lie_bracket"
    repeats_cycles: ClassVar[bool] = True
    Options: ClassVar[type[LieBracketOptions]] = LieBracketOptions
    options: LieBracketOptions

    @override
    def setup(self) -> None:
        # A cycle is a whole number of ticks, so all cycles have the same commands and rotation.
        self.ticks_a_cycle = max(
            round(self.options.cycle_period / self.control_period), _MIN_CYCLE_TICKS
        )
        self.sliders = sliders_of(self.robot)

    @classmethod
    @override
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Reject robots whose sliders violate the conditions of paper 1."""
        check_sliding_masses(robot).require()

    @override
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan steps 1 to 3; see :meth:`GaitMethod.plan`."""
        cancellation.raise_if_requested()
        state, goal = request.state, request.goal
        self.require_rest(state)
        self.require_goal_of_base(goal)
        z_f = self.final_shape(state, goal, POSITION_SLACK * request.tolerance.position)
        # Step 2, ``v_i = c_i sin^2(2 pi n1 t / t1)``, eq. (10), with four or more ticks a period.
        n1, period = self.options.n1, self.control_period
        ends = [(z_f, max(self.options.t1, 4 * n1 * period))]
        slide = straight_motion(self.robot, state.q, ends, period, self.options.longest, 2 * n1)
        t1 = (len(slide) - 1) * period or self.options.t1
        attitudes = self._prediction.attitudes(slide, state.quaternion, state.angular_momentum)
        self._require_clear(slide)
        cycle, n, notes = self._plan_turn(attitudes[-1], z_f, request)
        turn = np.tile(cycle[1:], (n, 1)) if n else np.empty((0, self.robot.n))
        path = self._predict_path(state, slide, attitudes, cycle, n)
        symbols: Notes = {
            "zf": [float(z_f[i]) for i in self.sliders],
            "c": [2 * float((z_f - state.q)[i]) / t1 for i in self.sliders],
        }
        positions = np.vstack([slide, turn])
        # The base pose differs in every cycle.
        is_clear = not self._has_obstacles
        return self.schedule_of(goal, positions, path, symbols | notes, is_clear=is_clear)

    def final_shape(self, state: RobotState, goal: Goal, enough: float = 0.0) -> Array:
        """Step 1: the shape ``zf`` (n,) that solves eq. (9), nearest to the current shape.

        If strokes are too short, the base position may miss the goal by up to ``enough``, m.

        Raises
        ------
        UnreachableError
            ``zf`` exceeds a stroke, and the robot has only sliders.
        PlanningError
            ``zf`` exceeds a stroke, and the robot has other joints; or slots are dependent.
        """
        robot = self.robot
        R0, Rf = matrix_from_quaternion(state.quaternion), matrix_from_quaternion(goal.quaternion)
        c0 = robot.center_of_mass(state.q)
        # The system's centre of mass is fixed: r_f + R_f c(zf) = r_0 + R_0 c(z0).
        shift = Rf.T @ (state.position + R0 @ c0 - goal.position) - c0
        P = independent_slots(robot, state.q)
        z0, lower, upper = (x[self.sliders] for x in (state.q, robot.lower, robot.upper))
        dz: Array = np.linalg.lstsq(P, shift, rcond=None)[0].astype(float)
        if np.any(z0 + dz < lower) or np.any(z0 + dz > upper):
            dz = self._keep_strokes(P, shift, state.q, dz, enough)
        z_f = state.q.copy()
        z_f[self.sliders] = np.clip(z0 + dz, lower, upper)
        return z_f

    def _keep_strokes(self, P: Array, shift: Array, q: Array, dz: Array, enough: float) -> Array:
        """Spread a displacement over four or more sliders; name one whose stroke is too short."""
        from scipy.optimize import lsq_linear  # scipy is slow to import, and few goals need it.

        z0, lower, upper = (x[self.sliders] for x in (q, self.robot.lower, self.robot.upper))
        # The solver needs different bounds: a slider's range at its end is widened slightly.
        room = 1e-12 * (1.0 + np.abs(upper - lower))
        bounded = lsq_linear(P, shift, (lower - z0 - room, upper - z0 + room), method="bvls")
        gap = float(np.linalg.norm(P @ bounded.x - shift))
        if gap <= max(enough, 1e-9 * max(1.0, float(np.linalg.norm(shift)))):
            return np.asarray(bounded.x, dtype=float)
        if len(self.sliders) == 3:
            z = z0 + dz
            worst = int(np.argmax(np.maximum(lower - z, z - upper)))
            name = self.robot.joint_names[self.sliders[worst]]
            message = (
                f"The goal is beyond the stroke: it requires joint '{name}' at {z[worst]:.4g} m, "
                f"but its stroke is [{lower[worst]:.4g}, {upper[worst]:.4g}] m."
            )
        else:
            message = (
                f"The goal is beyond the stroke: {len(self.sliders)} sliders bring the base no "
                f"closer to it than {gap:.3g} m."
            )
        # Other joints could move the centre of mass, but this method holds them.
        if len(self.sliders) < self.robot.n or self.robot.description.has_mimic_joints:
            raise PlanningError(message)
        raise UnreachableError(message, Proof.LIMITS)

    def _plan_turn(
        self, quaternion: Array, z_f: Array, request: PlanRequest
    ) -> tuple[Array, int, Notes]:
        """Step 3: one cycle of shapes (m + 1, n), the number of cycles, and the paper's symbols."""
        wanted = attitude_error(quaternion, request.goal.quaternion)
        enough = request.tolerance.attitude
        if np.linalg.norm(wanted) <= _ZERO_ROTATION_ANGLE:
            return z_f[np.newaxis].copy(), 0, {"cycles": 0.0}
        triple, brackets = self._best_triple(z_f)
        least = 0 if request.correction else self.options.cycles
        best = self._refine_turn(wanted, brackets, triple, z_f, least, enough)
        while (
            best.rotation_error > enough
            and 2 * best.cycles * self.ticks_a_cycle * self.control_period <= self.options.longest
        ):
            # The error of the first-order theory decreases as 1/sqrt(n).
            best = self._refine_turn(wanted, brackets, triple, z_f, 2 * best.cycles, enough)
        notes: Notes = {
            "sliders": ", ".join(self.robot.joint_names[i] for i in triple),
            "omega_d": wanted.tolist(),
            "alpha": best.alpha.tolist(),
            "cycles": float(best.cycles),
            "amplitudes": best.amplitudes.tolist(),
            "predicted_attitude_error": best.rotation_error,
        }
        return best.shapes, best.cycles, notes

    def _refine_turn(
        self,
        wanted: Array,
        brackets: Array,
        triple: tuple[int, int, int],
        z_f: Array,
        least: int,
        enough: float,
    ) -> _TurnStep:
        """Add the first-order error to the desired rotation until it is below ``enough`` (rad)."""
        omega_d, best = wanted, None
        target = quaternion_from_rotvec(wanted)
        for _ in range(_MAX_REFINEMENTS):
            alpha = np.linalg.solve(brackets, omega_d).astype(float)
            turn = self._fit_to_limits(alpha, triple, z_f, least)
            least = turn.cycles
            reached = turn.cycles * self._cycle_rotation(turn.shapes)
            miss = attitude_error(quaternion_from_rotvec(reached), target)
            turn = replace(turn, rotation_error=float(np.linalg.norm(miss)))
            if best is None or turn.rotation_error < best.rotation_error:
                best = turn
            omega_d = omega_d + wanted - reached
            if turn.rotation_error <= enough or np.linalg.norm(omega_d) > 4 * np.pi:
                break
        assert best is not None
        return best

    def _best_triple(self, z_f: Array) -> tuple[tuple[int, int, int], Array]:
        """Return the three sliders with the best-conditioned brackets at zf, and these brackets."""
        triple, M = best_triple(self.robot.curvature(z_f)[3:], self.sliders)
        # M holds the curvature of the pairs 12, 23 and 31; the brackets are its negative.
        brackets = M * np.array([-1.0, -1.0, 1.0])
        condition = float(np.linalg.cond(brackets))
        if not condition < MAX_CONDITION:
            raise PlanningError(
                "The sliders' first-order Lie brackets do not span the three axes of "
                f"rotation at the final shape {np.round(z_f, 4).tolist()} (condition number "
                f"{condition:.2g}): lie_bracket cannot control the attitude at this shape."
            )
        return triple, brackets

    def _fit_to_limits(
        self, alpha: Array, triple: tuple[int, int, int], z_f: Array, least: int
    ) -> _TurnStep:
        """Choose n, from ``least`` up, so that a cycle stays within rates and strokes; more cycles
        are smaller. With ``least`` 0, the first n follows from ``loop_area``.
        """
        n = least or max(1, math.ceil(float(np.linalg.norm(alpha)) / self.options.loop_area))
        amplitudes = self._cycle_amplitudes(alpha)
        robot, longest = self.robot, self.options.longest
        room = np.minimum(z_f - robot.lower, robot.upper - z_f)
        too_near = ""
        while True:
            if n * self.ticks_a_cycle * self.control_period > longest:
                if too_near:
                    raise PlanningError(f"In slider loops, {too_near}.")
                raise PlanningError(
                    f"The rotation would take more than {longest:.6g} s within the strokes and "
                    f"rates of the sliders at the final shape {np.round(z_f, 4).tolist()}; "
                    "a goal that leaves the sliders more room takes less time."
                )
            shapes = self._cycle_shapes(amplitudes, n, triple, z_f)
            swing = np.abs(shapes - z_f).max(axis=0)
            rate = np.abs(np.diff(shapes, axis=0)).max(axis=0) / self.control_period
            active = swing > 0
            with np.errstate(divide="ignore"):
                excess = max(
                    float(np.max(swing[active] / np.maximum(room[active], 1e-300), initial=0.0)),
                    float(np.max(rate[active] / robot.velocity_limit[active], initial=0.0)),
                )
            if excess <= 1.0:
                too_near = self._too_near(shapes)
                if not too_near:
                    return _TurnStep(shapes, n, alpha, amplitudes)
                excess = _SHRINK_FACTOR
            # Amplitudes scale as 1/sqrt(n).
            n = math.ceil(min(n * min(excess, 1e6) ** 2 * 1.001, 1e12)) + 1

    def _cycle_amplitudes(self, alpha: Array) -> Array:
        """Return (b11, b12, b21, a22, a31): ``a22 b12 = 2 alpha1/pi``, ``a31 b21 = alpha2/pi``,
        ``a31 b11 = alpha3/pi``, each product increased by the loss of polygons.
        """
        p12, p23, p13 = 2 * alpha[0] / np.pi, alpha[1] / np.pi, alpha[2] / np.pi
        a22 = self.options.a22_ratio * math.sqrt(abs(p12))
        a31 = self.options.a31_ratio * math.sqrt(math.hypot(p23, p13))
        step = 2 * np.pi / self.ticks_a_cycle
        first, second = np.sinc(step / np.pi), np.sinc(2 * step / np.pi)
        b12 = p12 / (second * a22) if a22 else 0.0
        b21, b11 = (p23 / (first * a31), p13 / (first * a31)) if a31 else (0.0, 0.0)
        return np.array([b11, b12, b21, a22, a31])

    def _cycle_shapes(
        self, amplitudes: Array, n: int, triple: tuple[int, int, int], z_f: Array
    ) -> Array:
        """Return the shapes of a cycle from ``zf`` back to it: the integrals of v1, v2, v3."""
        b11, b12, b21, a22, a31 = amplitudes / math.sqrt(n)
        phi = np.linspace(0.0, 2 * np.pi, self.ticks_a_cycle + 1)
        z1 = b11 * (1 - np.cos(phi)) + b12 * (1 - np.cos(2 * phi)) / 2
        z2 = b21 * (1 - np.cos(phi)) + a22 * (np.sin(2 * phi) / 2 - np.sin(3 * phi) / 3)
        z3 = a31 * (np.sin(phi) - np.sin(3 * phi) / 3)
        shapes = np.tile(z_f, (len(phi), 1))
        for index, z in zip(triple, (z1, z2, z3), strict=True):
            shapes[:, index] += z
        shapes[-1] = z_f
        return shapes

    def _cycle_rotation(self, cycle: Array) -> Array:
        """Return the rotation vector (3,) of the base over one cycle, rad."""
        identity = np.array([0.0, 0.0, 0.0, 1.0])
        return rotvec_from_quaternion(self._prediction.attitudes(cycle, identity, np.zeros(3))[-1])

    def _predict_path(
        self, state: RobotState, slide: Array, attitudes: Array, cycle: Array, n: int
    ) -> BasePath:
        """Base path: step 2 in detail, step 3 at the ends of some cycles."""
        stride = max(1, len(slide) // _PATH_POSES_PER_STEP)
        chosen = np.unique(np.append(np.arange(0, len(slide), stride), len(slide) - 1))
        time, shapes, quaternions = chosen * self.control_period, slide[chosen], attitudes[chosen]
        if n:
            done = np.unique(np.append(np.arange(0, n, max(1, n // _PATH_POSES_PER_STEP))[1:], n))
            rotation = self._cycle_rotation(cycle)
            turned = [
                quaternion_multiply(attitudes[-1], quaternion_from_rotvec(k * rotation))
                for k in done
            ]
            seconds = (len(slide) - 1 + done * self.ticks_a_cycle) * self.control_period
            time = np.append(time, seconds)
            shapes = np.vstack([shapes, np.tile(cycle[-1], (len(done), 1))])
            quaternions = np.vstack([quaternions, turned])
        return BasePath(
            time, self._prediction.positions(state, time, shapes, quaternions), quaternions
        )


@dataclass(frozen=True)
class _TurnStep:
    """The chosen step 3; ``rotation_error`` is its remaining error, rad."""

    shapes: Array
    cycles: int
    alpha: Array
    amplitudes: Array
    rotation_error: float = math.inf
