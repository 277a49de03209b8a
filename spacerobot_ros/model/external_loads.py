"""External loads on robot links: wrenches, a gravity gradient, and a tilted air table.

The equations are derived in docs/theory/external_loads.md. All loads on a robot form one vector
(:class:`LoadLayout`); all times are in plant time. Frame W is in free fall on a circular orbit with
mean motion n and does not rotate. The orbital frame O has its x axis radially outward and its z
axis along the orbit normal; ``R_WO`` is the attitude of O at time zero, ``o`` the unit vector along
the radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.model.inertial_parameters import rotational
from spacerobot_ros.model.kinematics import TreeKinematics
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion


class LoadLayout:
    """Slices of the load vector for a robot with L links.

    Attributes
    ----------
    in_link, in_world
        Force (N) and torque (N m) at the origin of every link, in link components and in W
        components: (6 L,) each.
    mean_motion
        Mean motion of the orbit, rad/s; zero if there is no gravity gradient.
    quaternion_WO
        Attitude (x, y, z, w) of the orbital frame in W at time zero.
    gravity_W
        Uniform acceleration (3,), m/s^2.
    friction
        Viscous friction force on a body divided by the body's momentum, 1/s.
    time
        Time at the beginning of the tick, s.
    size
        Length of the vector.
    """

    def __init__(self, links: int) -> None:
        ends = np.cumsum([6 * links, 6 * links, 1, 4, 3, 1, 1]).tolist()
        self.in_link, self.in_world, self.mean_motion, self.quaternion_WO, *rest = map(
            slice, [0, *ends], ends
        )
        self.gravity_W, self.friction, self.time = rest
        self.size: int = ends[-1]


@dataclass(frozen=True)
class ExternalLoads:
    """Loads in a state, as expressions in the base frame.

    Attributes
    ----------
    composites
        Moment and force (6,) about the system's centre of mass on every composite (a body and all
        bodies that it carries), due to the wrenches and the gravity gradient.
    gravity_W, friction
        Uniform acceleration (3,) in W, m/s^2, and friction divided by momentum, 1/s. Both loads are
        proportional to mass, so they affect momenta and joints independently.
    """

    composites: tuple[ca.SX, ...]
    gravity_W: ca.SX
    friction: ca.SX

    def momentum_rates(
        self, R_WB: ca.SX, p_W: ca.SX, L_W: ca.SX, mass: float | ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Return the rates of change of both total momenta due to the loads, N and N m, in W."""
        moment, force = self.composites[0][:3], self.composites[0][3:]
        return (
            R_WB @ force + mass * self.gravity_W - self.friction * p_W,
            R_WB @ moment - self.friction * L_W,
        )


def external_loads(
    kin: TreeKinematics,
    second_moments: tuple[ca.SX, ...],
    quaternion: ca.SX,
    r_WC_W: ca.SX,
    loads: ca.SX,
    time: ca.SX,
) -> ExternalLoads:
    """Return the loads in a state.

    Parameters
    ----------
    kin
        The kinematics.
    second_moments
        (3, 3) second moment of mass of every body about its own centre, in the base frame.
    quaternion
        (4,) of ``R_WB``.
    r_WC_W
        (3,) position of the system's centre of mass, m.
    loads
        The vector of :class:`LoadLayout`.
    time
        Time, s.
    """
    links = [link.name for link in kin.robot.links]
    layout = LoadLayout(len(links))
    R_BW = matrix_from_quaternion(quaternion).T
    forces = [ca.SX(6, 1) for _ in kin.robot.bodies]
    in_link, in_world = (
        ca.reshape(loads[part], 6, len(links)) for part in (layout.in_link, layout.in_world)
    )
    for i, link in enumerate(links):
        R_BL, r_BL_B, body = kin.frame(link)
        force = R_BL @ in_link[:3, i] + R_BW @ in_world[:3, i]
        torque = R_BL @ in_link[3:, i] + R_BW @ in_world[3:, i]
        forces[body] += ca.vertcat(torque + ca.cross(r_BL_B - kin.r_BC_B, force), force)
    n = loads[layout.mean_motion]
    angle = n * time
    radius_O = ca.vertcat(ca.cos(angle), ca.sin(angle), 0)
    o = R_BW @ (matrix_from_quaternion(loads[layout.quaternion_WO]) @ radius_O)
    r_WC_B = R_BW @ r_WC_W
    for k, J in enumerate(second_moments):
        arm = kin.com[k] - kin.r_BC_B
        r = r_WC_B + arm
        force = kin.mass(k) * n**2 * (3 * ca.dot(o, r) * o - r)
        moment = ca.cross(arm, force) + 3 * n**2 * ca.cross(o, rotational(J) @ o)
        forces[k] += ca.vertcat(moment, force)
    for k in range(kin.moving_body_count, 0, -1):
        forces[kin.parent(k)] += forces[k]
    return ExternalLoads(tuple(forces), loads[layout.gravity_W], loads[layout.friction])


EARTH_GRAVITATION = 3.986004418e14
"""Earth's gravitational parameter, m^3/s^2."""

EARTH_RADIUS = 6378137.0
"""Earth's equatorial radius, m (WGS 84)."""


def mean_motion_at(altitude: float) -> float:
    """Return the mean motion of a circular orbit around the Earth, rad/s.

    ``altitude`` is the height above the equatorial radius, m.
    """
    return math.sqrt(EARTH_GRAVITATION / (EARTH_RADIUS + altitude) ** 3)
