"""A bound on where the joints can put the centre of mass in the base: a proof for goals beyond.

Without thrust the centre of mass rests in the world, so a pose of the base says where it is in the
base. Sliders whose directions are fixed in the base move it along straight slots, exactly. What
turns is somewhere in a ball round the first joint that turns it (triangle inequality over the links
behind that joint). The sum of both is a convex set that holds the centre of mass in all shapes; for
robots that have only such sliders it is the set of all centres of mass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, Body, JointKind

_ROOM = 1e-12
"""Bounds of a slider differ at least by this, m: the solver wants room between them."""


@dataclass(frozen=True)
class CenterReach:
    """The set ``origin + slots z + ball``, ``lower <= z <= upper``.

    Attributes
    ----------
    origin
        (3,) m, base components.
    slots
        (3, s) how far the centre of mass moves with each slider of fixed direction, m/m.
    lower, upper
        (s,) ends of their ranges, m.
    radius
        Of the ball, m.
    """

    origin: Array
    slots: Array
    lower: Array
    upper: Array
    radius: float

    @classmethod
    def of(cls, robot: SpaceRobot, lower: Array, upper: Array) -> CenterReach:
        """Return the set of a robot whose joints keep to ``lower`` and ``upper`` (n,)."""
        bodies = robot.description.bodies
        if robot.description.coupled:
            lower, upper = _of_moving_joints(robot, lower, upper)
        base = bodies[0].inertia
        origin, radius = base.mass * base.com, 0.0
        slots = np.zeros((3, len(lower)))
        places = [_Place(np.zeros(3), np.eye(3), (), 0.0)]
        for joint, body in enumerate(bodies[1:]):
            place = places[body.parent].next(joint, body, lower[joint], upper[joint])
            places.append(place)
            mass, com = body.inertia.mass, body.inertia.com
            if place.R is None:
                origin = origin + mass * place.r
                radius += mass * (place.around + float(np.linalg.norm(com)))
            else:
                origin = origin + mass * (place.r + place.R @ com)
            for slider, axis in place.sliders:
                slots[:, slider] += mass * axis
        sliders = np.flatnonzero(slots.any(axis=0))
        total = robot.total_mass
        slots = slots[:, sliders] / total
        return cls(origin / total, slots, lower[sliders], upper[sliders], radius / total)

    def gap(self, point: Array) -> float:
        """Return how far a point (3,) is from the set, m: no shape comes nearer."""
        if not np.isfinite(self.radius):
            return 0.0
        beside = point - self.origin
        if self.slots.size:
            from scipy.optimize import lsq_linear  # Slow to import, and few goals need it.

            bounds = self.lower - _ROOM, self.upper + _ROOM
            beside = beside - self.slots @ lsq_linear(self.slots, beside, bounds, method="bvls").x
        return max(0.0, float(np.linalg.norm(beside)) - self.radius)


def _of_moving_joints(robot: SpaceRobot, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return ranges (m,) of all moving joints, each by itself: a larger set than that of (n,)."""
    G, offsets = robot.description.coupling
    leaders = np.argmax(np.abs(G), axis=1)
    factors = G[np.arange(len(G)), leaders]
    ends = factors * lower[leaders] + offsets, factors * upper[leaders] + offsets
    return np.minimum(*ends), np.maximum(*ends)


@dataclass(frozen=True)
class _Place:
    """What is known of the frame of a body, whatever the shape.

    It is within ``around`` m of ``r`` (3,), displaced by the ``sliders``: pairs of an index and a
    direction (3,). ``R`` (3, 3) is its attitude in the base, None where that depends on the shape.
    """

    r: Array
    R: Array | None
    sliders: tuple[tuple[int, Array], ...]
    around: float

    def next(self, index: int, body: Body, lower: float, upper: float) -> _Place:
        """Return the place of a body behind this one, which a joint with these limits carries."""
        assert body.joint is not None
        slides = body.joint.kind is JointKind.PRISMATIC
        if self.R is None:
            travel = max(abs(lower), abs(upper)) if slides else 0.0
            around = self.around + float(np.linalg.norm(body.origin.r)) + travel
            return _Place(self.r, None, self.sliders, around)
        r, R = self.r + self.R @ body.origin.r, self.R @ body.origin.R
        if slides:
            return _Place(r, R, (*self.sliders, (index, R @ body.joint.axis)), self.around)
        return _Place(r, None, self.sliders, self.around)
