"""Bounds on base positions and on manoeuvre durations, proved before a search.

:class:`CenterReach` bounds the centre of mass relative to the base, proving that goals beyond it
are out of reach. Without thrust, the centre of mass is at rest in the world, so a base pose
determines its base-frame position. Sliders with directions fixed in the base move the centre of
mass exactly along straight slots. Everything that rotates stays within a ball around the first
joint that rotates it (triangle inequality over the links beyond that joint). The sum of the slots
and the balls is a convex set that contains the centre of mass for all shapes; for robots with only
such sliders, it is the set of all centres of mass.

:class:`ConnectionBounds` bounds the base motion caused by each joint. While one joint moves and the
others are at rest, the robot consists of two rigid bodies with masses ``m_P`` and ``m_D``, inboard
and outboard of the joint. With the locked inertia ``H`` about the centre of mass, and the angular
momentum ``h_i`` about it due to the joint at unit rate with the base at rest, the base rotates at
``-H^-1 h_i``. The distances of the centres of mass from the joint bound ``|h_i|`` for all shapes,
and the smallest principal moments of all bodies bound ``H`` from below. Energy yields another
bound: the energy of the base motion is not available outboard of the joint,
``omega . (H + I_base) omega <= M_ii``. The smaller bound applies.

:class:`DurationBound` follows from both, and from the largest joint travel; no shape is sampled.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, Body, JointKind
from spacerobot_ros.model.rotations import quaternion_inverse, quaternion_multiply
from spacerobot_ros.planning.core.goal import end_effector_pose
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits

_BOUND_ROUNDING = 1e-6
"""Relative rounding error of a bound: manoeuvres miss their goals by less than this."""

_BISECTIONS, _LONGEST = 32, 1e10
"""Number of bisections for a shortest time, and the longest time searched for, s."""

_WITHIN = "within the velocity and acceleration limits"

_PARALLEL = 1e-12
"""Sine of the angle between two directions below which they are considered equal."""

_MIN_SLIDER_RANGE = 1e-12
"""Smallest difference between the two bounds of a slider, m: the solver needs room between them."""


@dataclass(frozen=True)
class CenterReach:
    """The set ``origin + slots z + ball``, ``lower <= z <= upper``.

    Attributes
    ----------
    origin
        (3,) m, base components.
    slider_directions
        (3, s) centre-of-mass motion per motion of each slider with fixed direction, m/m.
    lower, upper
        (s,) ends of the slider ranges, m.
    radius
        Radius of the ball, m.
    """

    origin: Array
    slider_directions: Array
    lower: Array
    upper: Array
    radius: float

    @classmethod
    def of(cls, robot: SpaceRobot, lower: Array, upper: Array) -> CenterReach:
        """Return the set for a robot with joints between ``lower`` and ``upper`` (n,)."""
        bodies = robot.description.bodies
        if robot.description.has_mimic_joints:
            lower, upper = moving_joint_ranges(robot, lower, upper)
        base = bodies[0].inertia
        origin, radius = base.mass * base.com, 0.0
        slots = np.zeros((3, len(lower)))
        # The frame of a body is within a distance of r, displaced by sliders (3, m); R is its
        # attitude in B, None if that depends on the shape.
        places: list[tuple[Array, Array | None, Array, float]]
        places = [(np.zeros(3), np.eye(3), slots.copy(), 0.0)]
        for k, body in enumerate(bodies[1:]):
            assert body.joint is not None
            slides = body.joint.kind is JointKind.PRISMATIC
            r, R, moved, around = places[body.parent]
            if R is None:
                travel = max(abs(lower[k]), abs(upper[k])) if slides else 0.0
                around = around + float(np.linalg.norm(body.origin.r)) + travel
            else:
                r, R = r + R @ body.origin.r, R @ body.origin.R
                moved = moved.copy()
                moved[:, k] = slides * (R @ body.joint.axis)
                R = R if slides else None
            places.append((r, R, moved, around))
            mass, com = body.inertia.mass, body.inertia.com
            slots += mass * moved
            if R is None:
                origin = origin + mass * r
                radius += mass * (around + float(np.linalg.norm(com)))
            else:
                origin = origin + mass * (r + R @ com)
        sliders = np.flatnonzero(slots.any(axis=0))
        total = robot.total_mass
        slots = slots[:, sliders] / total
        return cls(origin / total, slots, lower[sliders], upper[sliders], radius / total)

    def distance_outside(self, point: Array) -> float:
        """Return the distance of a point (3,) from the set, m: no shape comes closer."""
        if not np.isfinite(self.radius):
            return 0.0
        beside = point - self.origin
        if self.slider_directions.size:
            from scipy.optimize import lsq_linear  # Slow to import, and few goals need it.

            bounds = self.lower - _MIN_SLIDER_RANGE, self.upper + _MIN_SLIDER_RANGE
            beside = (
                beside
                - self.slider_directions
                @ lsq_linear(self.slider_directions, beside, bounds, method="bvls").x
            )
        return max(0.0, float(np.linalg.norm(beside)) - self.radius)


def moving_joint_ranges(robot: SpaceRobot, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return independent ranges (m,) of all moving joints: a larger set than the ranges (n,)."""
    G, offsets = robot.description.coupling
    leaders = np.argmax(np.abs(G), axis=1)
    factors = G[np.arange(len(G)), leaders]
    ends = factors * lower[leaders] + offsets, factors * upper[leaders] + offsets
    return np.minimum(*ends), np.maximum(*ends)


@dataclass(frozen=True)
class ConnectionBounds:
    """Bounds on the base motion at zero momentum, for all shapes within the joint limits.

    Attributes
    ----------
    turn
        (n,) largest base rotation caused by each joint, rad per rad or m; infinite: unknown.
    center
        (n,) largest centre-of-mass displacement relative to the base, m per rad or m.
    inertia
        Smallest moment of inertia with locked joints, kg m^2; if planar, about the robot's axis.
    """

    turn: Array
    center: Array
    inertia: float

    def drift(self, boundary: BoundaryConditions) -> float:
        """Return the largest base rate with the joints at rest, rad/s."""
        momentum = float(np.linalg.norm(boundary.angular_momentum))
        return momentum / self.inertia if momentum > 0 else 0.0

    @classmethod
    def of(cls, robot: SpaceRobot, axes: Array) -> ConnectionBounds:
        """Return the bounds for a robot whose base rotates about base-frame ``axes`` (m, 3)."""
        tree = _Tree.of(robot, robot.lower, robot.upper)
        least, base = sum(tree.least_moments), tree.least_moments[0]
        if len(axes) == 1:
            about = float(axes[0] @ tree.bodies[0].inertia.about_com @ axes[0])
            least, base = least - base + about, about
        joints = range(1, len(tree.bodies))
        moved = [tree.moved_by(joint, planar=len(axes) == 1) for joint in joints]
        momentum, energy, center = np.array(moved).reshape(-1, 3).T
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = np.fmin(momentum / least, np.sqrt(energy / (least + base)))
        turn = np.where(np.isnan(turn), np.inf, turn)
        return cls(_coupled(robot, turn), _coupled(robot, center), least)


def _coupled(robot: SpaceRobot, values: Array) -> Array:
    """Return bounds (n,) per coordinate from bounds (m,) per moving joint."""
    G = np.abs(robot.description.coupling[0])
    with np.errstate(invalid="ignore"):
        # An unknown bound does not affect joints that do not move the body.
        return np.asarray(np.where(G > 0, G * values[:, np.newaxis], 0.0).sum(axis=0))


@dataclass(frozen=True)
class _Tree:
    """The bodies of a robot, with bounds on the distances between them.

    ``hinges`` (b, 3) are the origins of bodies in their parents at the middle of the joint's range,
    m; ``travels`` half of the range of the slider that carries each body, m (0: none does);
    ``least_moments`` the smallest principal moments of inertia, kg m^2.
    """

    bodies: Sequence[Body]
    hinges: Array
    travels: list[float]
    least_moments: list[float]

    @classmethod
    def of(cls, robot: SpaceRobot, lower_q: Array, upper_q: Array) -> _Tree:
        bodies = robot.description.bodies
        hinges, travels = np.zeros((len(bodies), 3)), [0.0] * len(bodies)
        ranges = zip(*moving_joint_ranges(robot, lower_q, upper_q), strict=True)
        for b, (body, (lower, upper)) in enumerate(zip(bodies[1:], ranges, strict=True), 1):
            assert body.joint is not None
            hinges[b] = body.origin.r
            if body.joint.kind is JointKind.PRISMATIC:
                travels[b] = (upper - lower) / 2
                if math.isfinite(travels[b]):
                    hinges[b] += body.origin.R @ body.joint.axis * (lower + upper) / 2
        moments = [float(np.linalg.eigvalsh(body.inertia.about_com)[0]) for body in bodies]
        return cls(bodies, hinges, travels, [max(0.0, moment) for moment in moments])

    def reach(self, body: int, point: Array) -> float:
        """Return the largest distance, m, of a point (3,) of a body from the centre of mass: the
        vector between them is the mass-weighted mean of the vectors from all centres of mass.
        """
        masses = [each.inertia.mass for each in self.bodies]
        apart = self.distances(body, point, -1, np.eye(3))
        return float(sum(masses[k] * distance for k, distance in apart) / sum(masses))

    def moved_by(self, joint: int, *, planar: bool) -> tuple[float, float, float]:
        """Return bounds on the angular momentum ``h`` about the centre of mass (kg m^2/s), the
        inertia ``M`` (kg m^2 or kg) and the centre-of-mass displacement (m), at unit rate of the
        joint that carries a body.
        """
        body = self.bodies[joint]
        assert body.joint is not None
        axis, parent, here = body.joint.axis, body.parent, np.zeros(3)
        across = np.eye(3) - np.outer(axis, axis)
        levers = dict(self.distances(joint, here, parent, across))
        m = np.array([each.inertia.mass for each in self.bodies])
        total, behind = m.sum(), sum(m[k] for k in levers)
        first_moment = sum(m[k] * lever for k, lever in levers.items())
        if body.joint.kind is JointKind.PRISMATIC:
            axis = body.origin.R @ axis
            across = np.eye(3) - np.outer(axis, axis)
            before = dict(self.distances(parent, self.hinges[joint], joint, across))
            other = sum(m[k] * lever for k, lever in before.items())
            share = behind / total
            momentum = (1 - share) * first_moment + share * other
            return momentum, behind * (1 - share), share
        before = dict(self.distances(parent, self.hinges[joint], joint, np.eye(3)))
        reach = dict(self.distances(joint, here, parent, np.eye(3)))
        energy = largest = 0.0
        for k, lever in levers.items():
            inertia = self.bodies[k].inertia.about_com
            moment = float(np.linalg.eigvalsh(inertia)[-1])
            largest += moment + m[k] * reach[k] ** 2
            energy += (axis @ inertia @ axis if k == joint else moment) + m[k] * lever**2
        # |X a| <= sqrt(|X| a . X a) for the inertia X of everything outboard of the joint.
        momentum = energy if planar else math.sqrt(largest * energy)
        if len(levers) == 1:
            d, rest = body.inertia.com, 1 - behind / total
            own = body.inertia.about_com @ axis + rest * behind * np.cross(d, np.cross(axis, d))
            momentum = float(np.linalg.norm(own))
        momentum += first_moment * sum(m[k] * far for k, far in before.items()) / total
        return momentum, energy, first_moment / total

    def chain(self, body: int, point: Array) -> tuple[Array, Array]:
        """Return the largest rotation (rad/rad) and displacement (m/rad or m/m) of a ``point`` (3,)
        of a body caused by each moving joint (m,) with the base at rest.
        """
        turning, levers = (np.zeros(len(self.bodies) - 1) for _ in range(2))
        way = 0.0
        while body > 0:
            joint = self.bodies[body].joint
            assert joint is not None
            across, slides = np.cross(joint.axis, point), joint.kind is JointKind.PRISMATIC
            turning[body - 1] = 0.0 if slides else 1.0
            levers[body - 1] = 1.0 if slides else way + float(np.linalg.norm(across))
            way += float(np.linalg.norm(point)) + self.travels[body]
            point, body = self.hinges[body], self.bodies[body].parent
        return turning, levers

    def distances(
        self, at: int, point: Array, came_from: int, measured: Array
    ) -> Iterator[tuple[int, float]]:
        """Yield the largest distances, m, of centres of mass from a ``point`` (3,) of body ``at``,
        for this body and all bodies reached from it, except through ``came_from``.

        The matrix ``measured`` (3, 3) multiplies body-frame vectors before their norms are taken.
        """

        def way(joint: int, vector: Array, R: Array) -> float:
            distance, travel = float(np.linalg.norm(measured @ vector)), self.travels[joint]
            if travel > 0:
                carried = self.bodies[joint].joint
                assert carried is not None
                along = float(np.linalg.norm(measured @ R @ carried.axis))
                distance += travel * along if along > _PARALLEL else 0.0
            return distance

        yield at, float(np.linalg.norm(measured @ (self.bodies[at].inertia.com - point)))
        whole, start, parent = np.eye(3), np.zeros(3), self.bodies[at].parent
        for child, body in enumerate(self.bodies):
            if body.parent == at and child != came_from:
                far = way(child, self.hinges[child] - point, body.origin.R)
                for k, more in self.distances(child, start, at, whole):
                    yield k, far + more
        if at > 0 and parent != came_from:
            far = way(at, point, whole)
            for k, more in self.distances(parent, self.hinges[at], at, whole):
                yield k, far + more


def reach_of_end_effector(robot: SpaceRobot, lower: Array, upper: Array, link: str) -> float:
    """Return an upper bound, m, on a link's distance from the centre of mass, by limits (n,)."""
    body, pose = robot.description.frames[link]
    return _Tree.of(robot, lower, upper).reach(body, pose.r)


@dataclass(frozen=True)
class Demand:
    """A motion that the joints must produce: ``weights`` times the joint travels, plus ``drift``
    times the duration, must be at least ``amount``.

    Attributes
    ----------
    weights
        (n,), rad or m per rad or m.
    amount
        rad or m.
    reason
        The motion, as a clause.
    drift
        rad/s or m/s.
    """

    weights: Array
    amount: float
    reason: str
    drift: float = 0.0


@dataclass(frozen=True)
class DurationBound:
    """A lower bound on the duration of all manoeuvres to a goal.

    Attributes
    ----------
    seconds
        Duration, a multiple of the control period.
    reason
        The motion that requires it, as a clause.
    """

    seconds: float
    reason: str

    @classmethod
    def of(
        cls,
        robot: SpaceRobot,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        period: float,
        axes: Array,
        connection: ConnectionBounds,
        *,
        final_is_given: bool,
        base_rate_limit: float = 0.0,
        demands: Iterable[Demand] = (),
    ) -> DurationBound:
        """Return the bound for commands held for ``period`` s.

        Parameters
        ----------
        boundary, limits
            Ends of the manoeuvre, and joint limits.
        axes
            (m, 3) base axes along which the final attitude is given.
        connection
            Bounds on the base motion.
        final_is_given
            Whether the last shape in the boundary conditions is the only one at the goal.
        base_rate_limit
            Largest rate of the base, rad/s; 0: any.
        demands
            Further demands.
        """
        demands = list(demands)
        angle = _least_turn(boundary.goal_rotation, axes)
        turns = f"the base rotates by {angle:.4g} rad"
        if angle > 0:
            reason = f"{turns} {_WITHIN} of the joints"
            demands.append(Demand(connection.turn, angle, reason, connection.drift(boundary)))
        if final_is_given and boundary.final is not None:
            ways = np.nan_to_num(np.abs(boundary.final - boundary.start)).tolist()
            for unit, joint, way in zip(
                np.eye(robot.n), robot.description.movable_joints, ways, strict=True
            ):
                moves = f"joint '{joint.name}' moves by {way:.4g} {joint.unit}"
                demands.append(Demand(unit, way, f"{moves} {_WITHIN} that it has"))
        if boundary.center is not None:
            way = float(np.linalg.norm(boundary.center - robot.center_of_mass(boundary.start)))
            moves = f"the centre of mass moves by {way:.4g} m in the base"
            demands.append(Demand(connection.center, way, f"{moves} {_WITHIN} of the joints"))
        ends = np.maximum(np.abs(boundary.velocity), np.abs(boundary.final_velocity))
        # Held velocities cover no more distance than a motion that is one period longer.
        times = _shortest_times(demands, limits, ends) - period
        bounds = list(zip(times.tolist(), (each.reason for each in demands), strict=True))
        if base_rate_limit > 0:
            least = angle * (1 - _BOUND_ROUNDING) / base_rate_limit
            bounds.append((least, f"{turns} at no more than optimal.max_base_rate"))
        seconds, reason = max(bounds, key=lambda each: each[0], default=(0.0, ""))
        if not seconds > 0:
            return cls(0.0, "")
        return cls(math.ceil(seconds / period - _BOUND_ROUNDING) * period, reason)

    @override
    def __str__(self) -> str:
        return f"no manoeuvre to this goal takes less than {self.seconds:.6g} s, as {self.reason}"


def _least_turn(rotation: Array, axes: Array) -> float:
    """Return the least angle, rad, by which a base rotates to ``rotation`` (4,) along ``axes``."""
    if not len(axes):
        return 0.0
    along = float(axes[0] @ rotation[:3]) if len(axes) == 1 else np.linalg.norm(rotation[:3])
    return abs(math.remainder(2 * math.atan2(along, rotation[3]), 2 * math.pi))


def link_demands(
    robot: SpaceRobot,
    request: PlanRequest,
    boundary: BoundaryConditions,
    connection: ConnectionBounds,
) -> Iterator[Demand]:
    """Yield the end-effector motions that goals require, reduced by the tolerances."""
    state, tolerance, drift = request.state, request.tolerance, connection.drift(boundary)
    tree = _Tree.of(robot, robot.lower, robot.upper)
    for goal in request.goal.end_effectors:
        body, pose = robot.description.frames[goal.link]
        # From the centre of mass, farther than the origin of the link in any shape.
        far = tree.reach(body, pose.r)
        turning, levers = (_coupled(robot, each) for each in tree.chain(body, pose.r))
        position, quaternion = end_effector_pose(
            robot, goal.link, state.position, state.quaternion, state.q
        )
        way = float(np.linalg.norm(goal.position - position)) - tolerance.position
        moves = f"'{goal.link}' moves by {way:.4g} m {_WITHIN} of the joints"
        place = connection.turn * far + connection.center + levers
        yield Demand(place, way, moves, drift * far)
        if goal.quaternion is None:
            continue
        turn = quaternion_multiply(quaternion_inverse(quaternion), goal.quaternion)
        angle = _least_turn(turn, np.eye(3)) - tolerance.attitude
        turns = f"'{goal.link}' rotates by {angle:.4g} rad {_WITHIN} of the joints"
        yield Demand(connection.turn + turning, angle, turns, drift)


def _shortest_times(demands: Sequence[Demand], limits: MotionLimits, ends: Array) -> Array:
    """Return the times (K,), s, before which no motion of the joints meets each of K demands.

    Joints are no faster at both ends than ``ends`` (n,).
    """
    if not demands:
        return np.zeros(0)
    weights = np.array([each.weights for each in demands])
    amounts = np.array([each.amount * (1 - _BOUND_ROUNDING) for each in demands])
    drifts = np.array([each.drift for each in demands])
    ends = np.minimum(np.broadcast_to(ends, limits.velocity.shape), limits.velocity)

    def reached(T: Array) -> Array:
        T = T[:, np.newaxis]
        ramp = np.minimum(T / 2, (limits.velocity - ends) / limits.acceleration)
        ways = ends * T + limits.acceleration * ramp * (T - ramp)
        with np.errstate(invalid="ignore"):
            parts = np.where(weights > 0, weights * ways, 0.0)
        return np.asarray(parts.sum(axis=1) + drifts * T[:, 0])

    lower, upper = np.zeros(len(amounts)), np.full(len(amounts), 1e-3)
    while np.any(short := reached(upper) < amounts) and upper.max() < _LONGEST:
        upper = np.where(short, 2 * upper, upper)
    for _ in range(_BISECTIONS):
        middle = (lower + upper) / 2
        short = reached(middle) < amounts
        lower, upper = np.where(short, middle, lower), np.where(short, upper, middle)
    return lower
