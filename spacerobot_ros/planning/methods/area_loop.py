"""Closed motions of three joints that rotate a spacecraft about three axes (paper 2).

Small loops around a nominal shape rotate the base by ``dTheta = M S``: M (3, 3) is the curvature of
the connection for the joint pairs (1, 2), (2, 3), (3, 1), and S contains the areas enclosed by the
loop in their planes. Each cycle corrects the fraction k of the remaining rotation, ``S = k M^-1
dTheta``; the next cycle, from the measured attitude, corrects the first-order error.

Edges are straight lines in shape space, from rest to rest: held commands follow them exactly.

Loops run along joint coordinate axes and enclose given areas (figure 5) in the planes of joints (1,
2), (2, 3) and (3, 1); an area is positive if the path is counter-clockwise. Six edges of a box
enclose all three areas at once; rectangles enclose them one by one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from typing_extensions import override

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import attitude_error, quaternion_inverse, quaternion_multiply
from spacerobot_ros.parameters import parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.controllability import best_sampled_brackets
from spacerobot_ros.planning.core.goal import Controlled, PoseError, RobotState
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule, Notes, straight_motion
from spacerobot_ros.planning.methods.nominal_shape import (
    JOINT_PLANES,
    NominalShape,
    NominalShapeChooser,
)

_MAX_SHRINKS = 14
"""Number of attempts for a cycle in which links come too close, each half as large."""

_MAX_CYCLE_TRIALS = 6
"""Number of attempts for a cycle that would not bring the base closer, each half as large."""

_MAX_CYCLE_SHARE = 1.0 - 1e-9
"""Fraction k of the remaining rotation above which one cycle corrects all of it."""

_NEGLIGIBLE_AREA_SHARE = 1e-3
"""Fraction of the largest area treated as zero; a later cycle corrects the remaining error."""

_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])

LegEnds = list[tuple[Array, float]]
"""End shapes (n,) of straight legs, and leg durations, s."""


@dataclass(frozen=True)
class AreaLoopOptions:
    """The options of ``area_loop``."""

    k: float = parameter(
        0.15, "fraction of the remaining rotation corrected by one cycle", minimum=1e-3, maximum=1.0
    )
    edge_time: float = parameter(
        4.0, "duration of an edge; longer for slow joints", "s", minimum=1e-3, maximum=1e9
    )
    largest_edge: float = parameter(
        1.0, "longest edge of a loop", "m or rad", minimum=1e-3, maximum=10.0
    )
    nominal: tuple[float, ...] = parameter(
        (),
        "nominal shape of all joints; []: the best shape",
        "m or rad",
        minimum=-1e6,
        maximum=1e6,
        of_joints=True,
    )
    joints: str = parameter(
        "", "names of the three joints, separated by spaces; '': the best three", of_joints=True
    )
    cycles_per_plan: int = parameter(
        1, "number of cycles before the attitude is measured again", minimum=1, maximum=10000
    )
    most_cycles: int = parameter(
        1000, "largest number of cycles for a goal", minimum=1, maximum=1000000
    )
    longest: float = parameter(
        100000.0, "longest permitted manoeuvre", "s", minimum=1.0, maximum=1e9
    )


@dataclass(frozen=True)
class AreaLoopProgress:
    """Progress towards a goal; the next schedule continues from there.

    ``nominal`` is the chosen nominal shape, ``cycles`` the number of cycles flown at the end.
    """

    nominal: NominalShape
    cycles: int


class AreaLoopGait(GaitMethod):
    """Controls the attitude and final shape of a robot with three or more joints of any kind.

    The base position follows from the attitude and the shape (the centre of mass is at rest), so it
    cannot be chosen. A schedule is one cycle, or ``cycles_per_plan`` predicted cycles.
    """

    name: ClassVar[str] = "area_loop"
    repeats_cycles: ClassVar[bool] = True
    controls: frozenset[Controlled] = frozenset({"attitude", "shape"})
    Options: ClassVar[type[AreaLoopOptions]] = AreaLoopOptions
    options: AreaLoopOptions

    @override
    def setup(self) -> None:
        robot, chosen = self.robot, self.options
        self._nominal = NominalShapeChooser(
            robot,
            chosen.largest_edge,
            chosen.joints,
            chosen.nominal,
            None if self.clearance is None else self.clearance.is_roomy,
        )
        self.require_suitable(robot)

    @classmethod
    @override
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Reject robots in which loops of three joints cannot rotate the base about three axes."""
        if robot.n < 3:
            raise PlanningError(
                f"area_loop needs three joints (paper 2); robot '{robot.description.name}' has "
                f"{robot.n}."
            )
        best_sampled_brackets(robot).require()

    @override
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan the path to the nominal shape and the next cycle; see :meth:`GaitMethod.plan`.

        The schedule is ``partial`` unless its own prediction reaches the goal. ``most_cycles`` and
        ``longest`` limit the cycles for the goal, including earlier cycles (``request.previous``).
        """
        state, goal, tolerance = request.state, request.goal, request.tolerance
        self.require_rest(state)
        self.require_goal_of_base(goal)
        final = self._clear_goal_shape(request)
        gait = _PlannedMotion.at(state)
        notes: Notes = {"cycles": 0.0}
        progress = None if request.previous is None else request.previous.progress
        if not isinstance(progress, AreaLoopProgress):
            progress = None
        error = PoseError.between(state.position, state.quaternion, goal, state.q)
        if tolerance.admits(error, self.controls):
            return self._build_schedule(gait, request, notes, progress)
        chosen = self._nominal.at(state.q, None if progress is None else progress.nominal)
        if progress is None:
            chosen = self._nominal_shape_with_clearance(request, final, chosen, cancellation)
        flown = 0 if progress is None else progress.cycles
        nominal, gait, target = self._move_to_nominal(request, final, chosen)
        remaining = 0.0
        for planned in range(self.options.cycles_per_plan + 1):
            cancellation.raise_if_requested()
            left = attitude_error(gait.attitudes[-1], target)
            if np.linalg.norm(left) <= tolerance.attitude:
                if final is not None:
                    gait = self._add_legs(gait, [(final, self.options.edge_time)])
                break
            if planned < self.options.cycles_per_plan:
                gait, cycle_notes, remaining = self._add_cycle(
                    gait, target, left, nominal, tolerance.attitude, flown
                )
                flown += 1
                notes = {**cycle_notes, "cycles": float(planned + 1)}
        progress = AreaLoopProgress(chosen, flown)
        return self._build_schedule(gait, request, notes, progress, remaining)

    def _nominal_shape_with_clearance(
        self,
        request: PlanRequest,
        final: Array | None,
        chosen: NominalShape,
        cancellation: Cancellation,
    ) -> NominalShape:
        """Return the nominal shape for a goal: the chosen one if links stay clear on the path to it
        and on its first loop, else the fastest one for the goal among those with more room.
        """
        if self.clearance is None:
            return chosen
        least, whole = self._expected_time(request, final, chosen)
        if whole:
            return chosen
        required = self.clearance.required(request.state.q)
        keeps_clear = partial(self.clearance.is_clear, required=required)
        for other in self._nominal.shapes_with_more_room(request.state.q, keeps_clear):
            cancellation.raise_if_requested()
            time, _ = self._expected_time(request, final, other)
            if time < least:
                least, chosen = time, other
        return chosen

    def _expected_time(
        self, request: PlanRequest, final: Array | None, chosen: NominalShape
    ) -> tuple[float, bool]:
        """Return the duration of the cycles for a goal around a nominal shape, s, infinite if links
        come too close, and whether links stay clear without a smaller loop.
        """
        nominal, gait, target = self._move_to_nominal(request, final, chosen)
        left = attitude_error(gait.attitudes[-1], target)
        missing, enough = float(np.linalg.norm(left)), request.tolerance.attitude
        if missing <= enough:
            return 0.0, True
        if self._too_near_after(gait, 0):
            return math.inf, False
        S, share = self._initial_loop_areas(left, nominal)
        try:
            clear, _ = self._shrink_until_clear(gait, S, share, nominal)
        except PlanningError:
            return math.inf, False
        loop, _ = self._add_loop(gait, clear * S, nominal)
        duration = (len(loop.positions) - len(gait.positions)) * self.control_period
        return self._count_cycles_left(missing, clear, enough) * duration, clear == share

    def _initial_loop_areas(self, left: Array, nominal: NominalShape) -> tuple[Array, float]:
        """Return the areas (3,) for the fraction k of a rotation (3,), rad, and the fraction of
        these areas enclosed by loops with edges of the largest length.
        """
        S = self.options.k * np.linalg.solve(nominal.M, left).astype(float)
        # Edges scale with the square root of areas.
        return S, min(1.0, edge_path(S, nominal.longest).edge_ratio ** -2)

    def _add_cycle(
        self,
        gait: _PlannedMotion,
        target: Array,
        left: Array,
        nominal: NominalShape,
        enough: float,
        flown: int,
    ) -> tuple[_PlannedMotion, Notes, float]:
        """Add one cycle for the turn ``left`` (3,), rad; cycles continue until the attitude is off
        by ``enough`` (rad), and ``flown`` cycles are complete.

        Also returned are the paper's symbols and the expected duration of later cycles, s.
        """
        options = self.options
        S, share = self._initial_loop_areas(left, nominal)
        missing = float(np.linalg.norm(left))
        share, too_near = self._shrink_until_clear(gait, S, share, nominal)
        cycles, most = flown + self._count_cycles_left(missing, share, enough), options.most_cycles
        if cycles > most:
            why = f" In a loop twice as large, {too_near}." if too_near else ""
            raise PlanningError(
                f"The goal takes about {cycles:.4g} cycles, more than most_cycles = {most}; "
                f"{flown} have been flown.{why}"
            )
        for _ in range(_MAX_CYCLE_TRIALS):
            after, path = self._add_loop(gait, share * S, nominal)
            if np.linalg.norm(attitude_error(after.attitudes[-1], target)) < missing:
                break
            share /= 2
        else:
            raise PlanningError(
                f"None of {_MAX_CYCLE_TRIALS} cycles of area_loop around the nominal shape "
                f"{np.round(nominal.shape, 4).tolist()}, each half as large as the one before, "
                f"brings the base closer to its goal than {missing:.3g} rad."
            )
        duration = (len(after.positions) - len(gait.positions)) * self.control_period
        if cycles * duration > options.longest:
            raise PlanningError(
                f"The manoeuvre would take about {cycles:.4g} cycles of {duration:.4g} s, more "
                f"than longest = {options.longest:.6g} s."
            )
        notes: Notes = {
            "joints": ", ".join(self.robot.joint_names[i] for i in nominal.joints),
            "nominal": nominal.shape.tolist(),
            "condition": nominal.condition,
            "S": (share * S).tolist(),
            "path": path.kind,
            "edges": np.ptp(np.vstack(path.loops), axis=0).tolist(),
            "expected_cycles": cycles,
        }
        return after, notes, max(0.0, cycles - flown - 1) * duration

    def _shrink_until_clear(
        self, gait: _PlannedMotion, S: Array, share: float, nominal: NominalShape
    ) -> tuple[float, str]:
        """Return a fraction of areas ``S`` (3,), up to a given one, on whose loop links stay clear.

        The second is the clause on the last loop that was too large; empty where the first one is
        clear. PlanningError if links come too near on small loops, too.
        """
        too_near = ""
        if self.clearance is None:
            return share, too_near
        for _ in range(_MAX_SHRINKS):
            loop, _ = self._add_loop(gait, share * S, nominal)
            found = self._too_near_after(loop, len(gait.positions) - 1)
            if not found:
                return share, too_near
            share, too_near = share / 2, found
        raise PlanningError(f"Even in the smallest of {_MAX_SHRINKS} loops, {too_near}.")

    def _too_near_after(self, gait: _PlannedMotion, tick: int) -> str:
        """Return the clause about links that come too near from a tick on; empty: none do."""
        shapes, attitudes = gait.positions[tick:], gait.attitudes[tick:]
        return self._too_near(shapes, self._base_poses(gait.start, shapes, attitudes))

    def _count_cycles_left(self, missing: float, share: float, enough: float) -> float:
        """Return the number of cycles left for a remaining rotation (rad), to first order."""
        unbounded = missing * share
        many = (1.0 / share - 1.0) / self.options.k
        if unbounded <= enough:
            return max(1.0, (missing - enough) / (self.options.k * unbounded))
        if enough <= 0.0:
            return math.inf
        factor = -math.log1p(-min(self.options.k, _MAX_CYCLE_SHARE))
        return many + max(1.0, math.log(unbounded / enough) / factor)

    def _add_loop(
        self, gait: _PlannedMotion, areas: Array, nominal: NominalShape
    ) -> tuple[_PlannedMotion, EdgePath]:
        """Add a loop around areas (3,); return the motion, and the path of the loop."""
        path, chosen = edge_path(areas, nominal.longest), list(nominal.joints)
        lower, upper = self.robot.lower[chosen], self.robot.upper[chosen]
        ends: LegEnds = []
        for loop in path.loops:
            half = np.abs(loop).max(axis=0)
            # A box that does not fit around the nominal shape is moved into the limits.
            centre = np.maximum(np.minimum(nominal.shape[chosen], upper - half), lower + half)
            corners = np.tile(nominal.shape, (len(loop), 1))
            corners[:, chosen] = np.clip(centre + loop, lower, upper)
            # From the middle of the box to a corner, joints move half as far as along an edge.
            ends.append((corners[0], self.options.edge_time / 2))
            ends += [(corner, self.options.edge_time) for corner in corners[1:]]
            ends.append((nominal.shape, self.options.edge_time / 2))
        return self._add_legs(gait, ends), path

    def _move_to_nominal(
        self, request: PlanRequest, final: Array | None, chosen: NominalShape
    ) -> tuple[NominalShape, _PlannedMotion, Array]:
        """Return the nearest nominal shape, the path to it, and the attitude (4,) to reach there:
        the straight path from there to the final shape rotates the base, too.
        """
        state, edge_time = request.state, self.options.edge_time
        nominal = self._nominal.move_to_nearest_turn(chosen, state.q)
        gait = self._add_legs(_PlannedMotion.at(state), [(nominal.shape, edge_time)])
        start = _PlannedMotion.at(RobotState(np.zeros(3), _IDENTITY, nominal.shape))
        aside = self._add_legs(start, [] if final is None else [(final, edge_time)]).attitudes[-1]
        target = quaternion_multiply(request.goal.quaternion, quaternion_inverse(aside))
        return nominal, gait, target

    def _add_legs(self, gait: _PlannedMotion, ends: LegEnds) -> _PlannedMotion:
        shapes = straight_motion(
            self.robot, gait.positions[-1], ends, self.control_period, self.options.longest
        )
        # A robot at rest has no momentum: its attitudes depend only on its shapes.
        attitudes = self._prediction.attitudes(shapes, gait.attitudes[-1], np.zeros(3))
        positions = np.vstack([gait.positions, shapes[1:]])
        return _PlannedMotion(gait.start, positions, np.vstack([gait.attitudes, attitudes[1:]]))

    def _build_schedule(
        self,
        gait: _PlannedMotion,
        request: PlanRequest,
        notes: Notes,
        progress: AreaLoopProgress | None,
        remaining: float = 0.0,
    ) -> GaitSchedule:
        goal = request.goal
        path = self._prediction.path(request.state, gait.positions, gait.attitudes)
        left = PoseError.between(path.position[-1], path.quaternion[-1], goal, gait.positions[-1])
        notes = {**notes, "predicted_attitude_error": left.angle}
        partial = not request.tolerance.admits(left, self.controls)
        return self.schedule_of(
            goal,
            gait.positions,
            path,
            notes,
            partial=partial,
            remaining=remaining if partial else 0.0,
            progress=progress,
        )


@dataclass(frozen=True)
class _PlannedMotion:
    """Shapes (N + 1, n) at the ticks from a start, and the attitudes (N + 1, 4) of the base."""

    start: RobotState
    positions: Array
    attitudes: Array

    @classmethod
    def at(cls, start: RobotState) -> _PlannedMotion:
        return cls(start, start.q[np.newaxis], start.quaternion[np.newaxis])


@dataclass(frozen=True)
class EdgePath:
    """Closed polygons that the shape follows in succession.

    Attributes
    ----------
    loops
        Each polygon (V, 3): vertices in order, the first also last, in a box around the origin.
    edge_ratio
        Largest ratio of an edge to the longest allowed edge.
    """

    loops: tuple[Array, ...]
    edge_ratio: float

    @property
    def kind(self) -> str:
        """``cube``, ``rectangles`` or ``nothing``."""
        if not self.loops:
            return "nothing"
        return "cube" if len(self.loops[0]) == 7 else "rectangles"


def edge_path(areas: Array, longest: Array) -> EdgePath:
    """Return the path around ``areas`` (3,), with edges of at most ``longest`` (3,) if possible.

    The cube-like path is used if its edges are short enough, or shorter than those of the
    rectangles. If the areas are too large, ``edge_ratio`` exceeds 1: edges scale as their root.
    """
    areas = np.where(np.abs(areas) > _NEGLIGIBLE_AREA_SHARE * np.abs(areas).max(), areas, 0.0)
    rectangles = _rectangle_path(areas, longest)
    if np.all(areas != 0.0):
        cube = _cube_path(areas, longest)
        if cube.edge_ratio <= max(1.0, rectangles.edge_ratio):
            return cube
    return rectangles


def _cube_path(areas: Array, longest: Array) -> EdgePath:
    """Return the path with edges +d1, +d2, +d3, -d1, -d2, -d3 around areas (3,), none of them zero.

    The projected areas are (d1 d2, d2 d3, -d1 d3), of product -(d1 d2 d3)^2; negative backwards.
    """
    S12, S23, S31 = areas
    backwards = bool(S12 * S23 * S31 > 0)
    sense = -1.0 if backwards else 1.0
    d1 = np.sqrt(abs(S12)) * np.sqrt(abs(S31 / S23))
    d2 = sense * S12 / d1
    d = np.array([d1, d2, sense * S23 / d2])
    corners = np.vstack([np.zeros(3), np.cumsum(np.vstack([np.diag(d), -np.diag(d)]), axis=0)])
    corners[-1] = 0.0
    loop = corners - d / 2
    excess = float(np.max(np.abs(d) / longest))
    return EdgePath((loop[::-1] if backwards else loop,), excess)


def _rectangle_path(areas: Array, longest: Array) -> EdgePath:
    loops, excess = [], 0.0
    for area, (i, j) in zip(areas, JOINT_PLANES, strict=True):
        if area == 0.0:
            continue
        # Both edges have the same ratio to the longest edges.
        share = np.sqrt(abs(area) / (longest[i] * longest[j]))
        excess = max(excess, float(share))
        loop = np.zeros((5, 3))
        loop[:, i] = share * longest[i] * np.array([-0.5, 0.5, 0.5, -0.5, -0.5])
        loop[:, j] = share * longest[j] * np.array([-0.5, -0.5, 0.5, 0.5, -0.5])
        loops.append(loop if area > 0 else loop[::-1])
    return EdgePath(tuple(loops), excess)
