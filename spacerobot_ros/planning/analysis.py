"""Capabilities of a robot: base rotations by joint motions, suitable gait methods, and workspaces.

The path-independent and path-dependent workspaces are those of an end-effector while the base
floats. At zero momentum, the generalised Jacobian ``J*(q)`` maps joint rates to the velocity of the
end-effector. If ``J*`` loses rank, there is a direction in which no joint rates can move the
end-effector: a dynamic singularity. Whether this happens depends on the configuration. The distance
of the end-effector from the system's centre of mass also depends only on the configuration: the
centre of mass is at rest, while the base may have any attitude. A distance attained by some
singular configuration is therefore *path-dependent*: whether the robot is singular there depends on
the path that led there. Distances not attained by any singular configuration are *path-independent*
(Papadopoulos and Dubowsky; paper 4, section V).

Singular configurations are solutions ``(q, u)`` of ``J*(q)^T u = 0, |u| = 1``, where ``u`` is the
direction in which no motion is possible. Starting from seeded configurations spread over the shape
space, Gauss-Newton iterations find the nearest solutions; from each of these solutions, curves of
solutions are followed to larger and to smaller distances. Distances change continuously on a curve,
so all distances between its ends are path-dependent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.errors import ParameterError, PlanningError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.planning.core.controllability import (
    MAX_CONDITION,
    Controllability,
    best_sampled_brackets,
    best_triple,
    brackets_at,
    check_sliding_masses,
    curvatures,
    sample_shapes,
)
from spacerobot_ros.planning.methods.nominal_shape import NominalShape, NominalShapeChooser
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.registry import METHODS, AutoGait
from spacerobot_ros.planning.methods.square_path import check_planar_chain

# -- workspaces ------------------------------------------------------------------------------------

_SEED = 20
_SAMPLED_SHAPES = 48
"""Number of start configurations of searches for singular shapes, and of samples for the reach."""

_EXTREME_STARTS = 3
_NEWTON_STEPS, _LONGEST_NEWTON_STEP = 40, 0.5
_WALK_STEPS, _LONGEST_STEP, _SHORTEST_STEP = 60, 0.25, 1e-4
"""Number of steps along a curve; longest and shortest step, rad or m of the fastest joint."""

_ZERO_RESIDUAL = 1e-9
"""Largest residual of the dimensionless singularity equations that is treated as zero."""

_ZERO_RATE = 1e-6
"""Largest singular value of J*, relative to the reach, that is treated as zero."""

_MAX_CLOSED_GAP = 2e-3
"""Gaps between path-dependent distances smaller than this fraction of the reach are closed: curves
end on either side of a distance at which others begin."""

Interval = tuple[float, float]


@dataclass(frozen=True)
class Workspaces:
    """Distances of a link's origin from the centre of mass, m, by workspace type.

    Attributes
    ----------
    link
        The link.
    within_limits
        Whether joint limits are enforced; if not, revolute joints are unlimited.
    distance_range
        The smallest and the largest attainable distance.
    path_dependent
        Closed intervals of link distances attained by singular configurations, in ascending order.
    dimensions
        Dimension of the space in which the joints move the link at zero momentum: 2 in a plane.
    singular_shapes
        Number of singular configurations from which the intervals were found.
    """

    link: str
    within_limits: bool
    distance_range: Interval
    path_dependent: tuple[Interval, ...]
    dimensions: int
    singular_shapes: int

    @property
    def path_independent(self) -> tuple[Interval, ...]:
        """Intervals of the reach between path-dependent intervals, in ascending order."""
        nearest, farthest = self.distance_range
        ends = [nearest, *np.ravel(self.path_dependent).tolist(), farthest]
        gaps = zip(ends[::2], ends[1::2], strict=True)
        smallest = _MAX_CLOSED_GAP * farthest
        return tuple((low, high) for low, high in gaps if high - low > smallest)


def workspaces(robot: SpaceRobot, link: str) -> tuple[Workspaces, ...]:
    """Return the workspaces of a link's origin at zero momentum, without and within joint limits.

    Except for gaps of less than 0.2 % of the reach, all distances in an interval are attained by
    singular configurations that were found. The intervals are complete only if the seeded
    configurations lead to all curves of singular configurations: for two joints in a plane, each
    curve is found many times.

    Raises
    ------
    KeyError
        There is no such link.
    """
    equations = _Equations.of(robot, link)
    free = _search(robot, link, equations, within_limits=False)
    if all(map(np.array_equal, _bounds(robot, False), _bounds(robot, True))):
        return (free,)
    limited = _search(robot, link, equations, within_limits=True)
    # Singular shapes within the limits are also singular without them.
    intervals = np.array([*free.path_dependent, *limited.path_dependent]).reshape(-1, 2)
    joined = _union(intervals, _MAX_CLOSED_GAP * free.distance_range[1])
    return replace(free, path_dependent=tuple(joined)), limited


def _search(
    robot: SpaceRobot, link: str, equations: _Equations, *, within_limits: bool
) -> Workspaces:
    lower, upper = _bounds(robot, within_limits)
    reach, extremes = equations.reach(lower, upper)
    found = Workspaces(link, within_limits, reach, (reach,), equations.dimensions, 0)
    if equations.rank < equations.dimensions:
        return found
    box = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    if within_limits:
        box = robot.description.shape_box
    shapes = np.random.default_rng(_SEED).uniform(*box, (_SAMPLED_SHAPES, robot.n))
    # At an extreme distance, joint rates do not change it.
    starts = np.vstack([shapes, extremes])
    curves, count = _Search(equations, lower, upper).intervals(starts)
    ends = [*reach, *np.ravel(curves)]
    reach = float(min(ends)), float(max(ends))
    return replace(found, distance_range=reach, path_dependent=tuple(curves), singular_shapes=count)


def _bounds(robot: SpaceRobot, within_limits: bool) -> tuple[Array, Array]:
    """Return bounds (n,), (n,) of the shape; infinite for joints that rotate freely."""
    lower, upper = robot.lower.copy(), robot.upper.copy()
    followed = {x.mimic.joint for x in robot.description.moving_joints if x.mimic is not None}
    box = robot.description.shape_box
    for k, joint in enumerate(robot.description.movable_joints):
        if joint.kind is JointKind.PRISMATIC:
            lower[k], upper[k] = box[0][k], box[1][k]
        elif not within_limits and joint.name not in followed:
            lower[k], upper[k] = -np.inf, np.inf
    return lower, upper


@dataclass(frozen=True)
class _Equations:
    """Equations of singular configurations, ``J*^T u = 0``, ``|u|^2 = 1``, in units of the reach.

    ``jacobian`` is ``q -> J*`` (m, n), rows along the directions in which the joints move the link;
    ``function`` is ``(q, u) -> equations (n + 1,), derivatives (n + 1, n + m), distance, its
    gradient``. ``samples`` (K, n) cover the shape space, ``rank`` is the largest rank of J*.
    """

    jacobian: ca.Function
    function: ca.Function
    samples: Array
    dimensions: int
    rank: int

    @classmethod
    def of(cls, robot: SpaceRobot, link: str) -> _Equations:
        n, q = robot.n, ca.SX.sym("q", robot.n)
        J = robot.function(f"jacobian:{link}", compile=False)(q)
        A = ca.reshape(robot.function("connection", compile=False)(q), 6, n)
        _, r = robot.function("link_poses", compile=False)(q)
        center = robot.function("center_of_mass", compile=False)(q)
        r_CE = r[:, robot.link_names.index(link)] - center
        J = (J[:, 6:] - J[:, 3:6] @ A[3:, :])[:3, :]
        of_samples = ca.Function("samples", [q], [ca.densify(J), ca.densify(r_CE)])
        samples = sample_shapes(robot, _SAMPLED_SHAPES)
        found, places = (x.full() for x in of_samples(samples.T))
        largest = float(np.linalg.norm(places, axis=0).max())
        directions, values, _ = np.linalg.svd(found, full_matrices=False)
        rows = directions[:, values > _ZERO_RATE * max(values[0], largest)].T
        m = len(rows)
        by_shape = (rows @ found).reshape(m, len(samples), n).transpose(1, 0, 2)
        rank = 0
        if m:
            rank = int(np.linalg.matrix_rank(by_shape, tol=_ZERO_RATE * largest).max())
        u = ca.SX.sym("u", m)
        J = ca.densify(ca.DM(rows) @ J)
        z = ca.vertcat(q, u)
        equations = ca.vertcat(J.T @ u / largest, ca.dot(u, u) - 1)
        distance = ca.norm_2(r_CE)
        outputs = [equations, ca.jacobian(equations, z), distance, ca.gradient(distance, z)]
        function = ca.Function("singular", [z], ca.cse([ca.densify(x) for x in outputs]))
        return cls(ca.Function("J", [q], [J]), function, samples, m, rank)

    def evaluate(self, z: Array) -> tuple[Array, Array, Array, Array]:
        """Return equations (K, n + 1), derivatives, distances (K,), gradients, at z (K, n + m)."""
        K, size = z.shape
        g, by_z, r, by_r = (x.full() for x in self.function(z.T))
        derivatives = by_z.reshape(-1, K, size).transpose(1, 0, 2)
        # At the centre of mass itself the distance has no direction of ascent.
        gradients = np.nan_to_num(by_r.reshape(size, K, order="F").T)
        return g.T, derivatives, r.ravel(), gradients

    def starts(self, shapes: Array) -> Array:
        """Return z (K, n + m) for shapes (K, n), with the directions of least motion."""
        n = shapes.shape[1]
        J = self.jacobian(shapes.T).full().reshape(self.dimensions, -1, n).transpose(1, 0, 2)
        return np.hstack([shapes, np.linalg.svd(J)[0][:, :, -1]])

    def reach(self, lower: Array, upper: Array) -> tuple[Interval, Array]:
        """Return the extreme distances within bounds, and their configurations (2, n)."""
        from scipy.optimize import minimize

        m = self.dimensions

        def squared(q: Array, sign: float) -> tuple[float, Array]:
            _, _, r, gradient = self.evaluate(np.append(q, np.zeros(m))[np.newaxis])
            return sign * float(r[0]) ** 2, sign * 2 * float(r[0]) * gradient[0, : len(q)]

        z = np.hstack([self.samples, np.zeros((len(self.samples), m))])
        order = np.argsort(self.evaluate(z)[2])
        ends, shapes = [], []
        for sign, best in ((1.0, order[:_EXTREME_STARTS]), (-1.0, order[-_EXTREME_STARTS:])):
            found = [
                minimize(
                    squared,
                    self.samples[k],
                    (sign,),
                    "L-BFGS-B",
                    jac=True,
                    bounds=np.column_stack([lower, upper]),
                    options={"ftol": 1e-15, "gtol": 1e-12},
                )
                for k in best
            ]
            extreme = min(found, key=lambda each: float(each.fun))
            shapes.append(np.clip(extreme.x, lower, upper))
            ends.append(float(np.sqrt(max(sign * extreme.fun, 0.0))))
        smallest, largest = ends
        return (0.0 if smallest < 1e-6 * largest else smallest, largest), np.array(shapes)


class _Search:
    """Search for singular configurations within bounds, many at a time."""

    def __init__(self, equations: _Equations, lower: Array, upper: Array) -> None:
        m = np.full(equations.dimensions, np.inf)
        self._equations = equations
        self._lower, self._upper = np.append(lower, -m), np.append(upper, m)

    def intervals(self, shapes: Array) -> tuple[list[Interval], int]:
        """Return the distance intervals of singular shapes found from (K, n), and their number."""
        z = self._project_to_singular_shapes(self._equations.starts(shapes), _NEWTON_STEPS)
        g, _, _, _ = self._equations.evaluate(z)
        z = z[np.linalg.norm(g, axis=1) < _ZERO_RESIDUAL]
        if not len(z):
            return [], 0
        curves = [self._follow_singular_curve(z, sign) for sign in (-1.0, 1.0)]
        radii = np.column_stack([self._equations.evaluate(end)[2] for end in curves])
        largest = float(radii.max())
        radii[radii <= 1e-6 * largest] = 0.0
        return _union(radii, _MAX_CLOSED_GAP * largest), len(z)

    def _project_to_singular_shapes(self, z: Array, steps: int) -> Array:
        """Return the singular configurations nearest to z (K, n + m) within bounds."""
        z = z.copy()
        moving = np.arange(len(z))
        for _ in range(steps):
            here = z[moving]
            g, by_z, _, _ = self._equations.evaluate(here)
            missing = np.abs(g).max(axis=1) > _ZERO_RESIDUAL / 10
            if not missing.any():
                break
            moving, here, g, by_z = moving[missing], here[missing], g[missing], by_z[missing]
            step = _least_solution(by_z, g, np.ones(here.shape))
            free = self._free_coordinates(here, -step)
            if not free.all():
                step = _least_solution(by_z, g, free)
            size = np.abs(step).max(axis=1, keepdims=True)
            step *= np.minimum(1.0, _LONGEST_NEWTON_STEP / np.maximum(size, 1e-12))
            z[moving] = np.clip(here - step, self._lower, self._upper)
        return z

    def _free_coordinates(self, z: Array, step: Array) -> Array:
        """Return zeros (K, n + m) where a step would leave the bounds, and ones elsewhere."""
        low, high = z <= self._lower + 1e-12, z >= self._upper - 1e-12
        return np.asarray(1.0 - ((low & (step < 0)) | (high & (step > 0))))

    def _follow_singular_curve(self, z: Array, sign: float) -> Array:
        """Return the ends of singular curves from z to larger (1) or smaller (-1) distances."""
        z, length = z.copy(), np.full(len(z), _LONGEST_STEP / 2)
        for _ in range(_WALK_STEPS):
            walking = np.flatnonzero(length > _SHORTEST_STEP)
            if not len(walking):
                break
            here = z[walking]
            _, by_z, r, ascent = self._equations.evaluate(here)
            free = np.ones(here.shape)
            for _ in range(2):
                along = sign * ascent * free
                along -= _least_solution(by_z, np.einsum("kij,kj->ki", by_z, along), free)
                free = free * self._free_coordinates(here, along)
            along *= free
            size = np.abs(along).max(axis=1, keepdims=True)
            step = length[walking, np.newaxis] * along / np.maximum(size, 1e-12)
            there = self._project_to_singular_shapes(
                np.clip(here + step, self._lower, self._upper), 5
            )
            g, _, after, _ = self._equations.evaluate(there)
            near = np.abs(there - here).max(axis=1) <= 3 * length[walking]
            better = (np.linalg.norm(g, axis=1) < _ZERO_RESIDUAL) & near & (sign * (after - r) > 0)
            z[walking[better]] = there[better]
            length[walking] = np.where(
                better, np.minimum(1.5 * length[walking], _LONGEST_STEP), length[walking] / 2
            )
        return z


def _least_solution(A: Array, b: Array, free: Array) -> Array:
    """Return the least-norm x (K, N) of ``A x = b``, A (K, M, N), nonzero where ``free`` is one."""
    A = A * free[:, np.newaxis]
    square = A @ A.transpose(0, 2, 1)
    # Slight damping: equations may be dependent where two curves meet.
    square += 1e-12 * np.eye(A.shape[1])
    solution = np.linalg.solve(square, b[:, :, np.newaxis])
    return np.asarray((A.transpose(0, 2, 1) @ solution)[:, :, 0])


def _union(intervals: Array, gap: float) -> list[Interval]:
    """Return the union of intervals (K, 2), gaps below ``gap`` closed, in ascending order."""
    found: list[list[float]] = []
    for low, high in intervals[np.argsort(intervals[:, 0])]:
        if found and low - found[-1][1] <= gap:
            found[-1][1] = max(found[-1][1], float(high))
        else:
            found.append([float(low), float(high)])
    return [(low, high) for low, high in found]


# -- analysis --------------------------------------------------------------------------------------

_CONDITION_SAMPLE_COUNT = 300

_LOOP_EDGE_LENGTH = 1.0
"""Loop edge length for which the nominal shape is optimised, m or rad, as in area_loop."""


@dataclass(frozen=True)
class Analysis:
    """Controllability of a robot, and the gait methods suitable for it.

    Attributes
    ----------
    robot
        The model.
    shape
        (n,) examined configuration: as given, the best nominal one, or the middle of the ranges.
    nominal
        The three nominal joints and their matrix M at this configuration; None if there are fewer
        than three joints, or if no loops rotate the base about three axes.
    at_shape, anywhere
        The span of first-order brackets at ``shape``, and at the best of many configurations.
    conditions
        (300,) condition numbers of the best three brackets, at configurations spread evenly.
    planar, sliding
        Results of the tests in papers 3 and 1.
    objections
        Reason why a method is unsuitable for the robot, by method name; None if it is suitable.
    geometry
        The robot's solids, and the pairs of solids whose distances are checked.
    end_effector
        The link whose workspaces are computed; "" if not given and the default link does not exist.
    """

    robot: SpaceRobot
    shape: Array
    nominal: NominalShape | None
    at_shape: Controllability
    anywhere: Controllability
    conditions: Array
    planar: Controllability
    sliding: Controllability
    objections: dict[str, str | None]
    geometry: CollisionGeometry
    end_effector: str = ""

    @cached_property
    def workspaces(self) -> tuple[Workspaces, ...]:
        """Workspaces of the end-effector, without and with joint limits.

        Empty if there is no end-effector or there are no joints.
        """
        if not self.end_effector or self.robot.n == 0:
            return ()
        return workspaces(self.robot, self.end_effector)

    @property
    def chosen(self) -> str:
        """Method usually chosen by ``auto``: ``optimal`` if suitable; "" if no method is."""
        suits = [
            name
            for name, objection in self.objections.items()
            if not objection and METHODS[name].plans_for_base
        ]
        return OptimalGait.name if OptimalGait.name in suits else next(iter(suits), "")


def analyze(
    robot: SpaceRobot, shape: Sequence[float] | None = None, end_effector: str = ""
) -> Analysis:
    """Analyse a robot at a shape (n,), or at the best shape for loops.

    ``end_effector`` names the link whose workspaces are computed; "": the default one.

    Raises
    ------
    ParameterError
        The shape or the link does not belong to this robot.
    """
    link = robot.description.end_effector(end_effector)
    names = [each.name for each in robot.description.links if each.name != robot.base_link]
    if link and link not in names:
        raise ParameterError(
            f"Robot '{robot.description.name}' has no link '{link}' other than its base; its links "
            f"are {', '.join(names)}."
        )
    given = None if shape is None else np.asarray(shape, dtype=float)
    if given is not None and not (given.shape == (robot.n,) and np.all(np.isfinite(given))):
        raise ParameterError(
            f"The shape has {counted(given.size, 'number')}; robot '{robot.description.name}' "
            f"needs a finite value for each joint: {', '.join(robot.joint_names)}."
        )
    anywhere = best_sampled_brackets(robot)
    nominal, loops = None, NominalShapeChooser(robot, _LOOP_EDGE_LENGTH)
    if loops.triples and anywhere.controllable:
        middle = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
        nominal = loops.best(middle) if given is None else loops.around(given)
    planar = check_planar_chain(robot)
    if given is None:
        best = planar if planar.controllable else anywhere
        given = best.shape if nominal is None else nominal.shape
    objections: dict[str, str | None] = {}
    for name, method in METHODS.items():
        try:
            method.require_suitable(robot)
            objections[name] = None
        except PlanningError as refusal:
            objections[name] = str(refusal)
    del objections[AutoGait.name]
    return Analysis(
        robot,
        given,
        nominal,
        brackets_at(robot, given),
        anywhere,
        _condition_numbers(robot),
        planar,
        check_sliding_masses(robot),
        objections,
        CollisionGeometry(robot.description),
        link,
    )


def _condition_numbers(robot: SpaceRobot) -> Array:
    if robot.n < 3:
        return np.full(_CONDITION_SAMPLE_COUNT, np.inf)
    K = curvatures(robot, sample_shapes(robot, _CONDITION_SAMPLE_COUNT))
    matrices = np.array([best_triple(at, range(robot.n))[1] for at in K])
    conditions = np.linalg.cond(matrices)
    return np.where(conditions < MAX_CONDITION, conditions, np.inf)
