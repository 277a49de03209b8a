"""External loads on a plant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, Inertia, Pose, plane_normal
from spacerobot_ros.model.grasp import BodyMotion
from spacerobot_ros.model.integration import LoadLayout
from spacerobot_ros.model.rotations import matrix_from_quaternion, unit_quaternion
from spacerobot_ros.simulation.config import OrbitConfig, TableConfig

_PLANE_TOLERANCE = 1e-9
"""Largest component in the table plane of the normal to a planar robot's plane of motion."""

EARTH_GRAVITATION = 3.986004418e14
"""Earth's gravitational parameter, m^3/s^2."""

EARTH_RADIUS = 6378137.0
"""Earth's equatorial radius, m (WGS 84)."""

_LOWEST_ORBIT = 100e3
"""Smallest altitude of an orbit, m; smaller values are probably in km."""


def mean_motion_at(altitude: float) -> float:
    """Return the mean motion of a circular orbit around the Earth, rad/s.

    ``altitude`` is the height above the equatorial radius, m.
    """
    return math.sqrt(EARTH_GRAVITATION / (EARTH_RADIUS + altitude) ** 3)


@dataclass(frozen=True)
class Surroundings:
    """Loads from the robot's environment, constant during a flight.

    Attributes
    ----------
    mean_motion
        Mean motion of the circular orbit, rad/s; zero if there is no orbit.
    quaternion_WO
        (4,) attitude (x, y, z, w) of the orbital frame in W at time zero.
    gravity_W
        (3,) uniform acceleration, m/s^2.
    friction
        Viscous friction force on a body divided by the body's momentum, 1/s.
    """

    mean_motion: float = 0.0
    quaternion_WO: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    gravity_W: tuple[float, float, float] = (0.0, 0.0, 0.0)
    friction: float = 0.0

    @classmethod
    def of(cls, orbit: OrbitConfig, table: TableConfig) -> Surroundings:
        """Return the configured surroundings.

        Raises
        ------
        ParameterError
            The orbit is specified twice or is too low, its orientation is not a quaternion, or both
            a table and an orbit are set.
        """
        if orbit.altitude and orbit.mean_motion:
            raise ParameterError(
                f"Parameters 'orbit.altitude' ({orbit.altitude:g} m) and 'orbit.mean_motion' "
                f"({orbit.mean_motion:g} rad/s) both define the orbit: set one of them to 0."
            )
        if 0.0 < orbit.altitude < _LOWEST_ORBIT:
            raise ParameterError(
                f"Parameter 'orbit.altitude' is {orbit.altitude:g} m, but no orbit is below "
                f"{_LOWEST_ORBIT:g} m: give it in m, not in km, or set it to 0."
            )
        try:
            orientation = unit_quaternion(np.array(orbit.orientation))
        except ValueError as error:
            raise ParameterError(f"Parameter 'orbit.orientation' is refused: {error}.") from None
        slope = table.gravity * math.sin(table.tilt)
        found = cls(
            mean_motion_at(orbit.altitude) if orbit.altitude else orbit.mean_motion,
            tuple(orientation.tolist()),
            (slope * math.cos(table.direction), slope * math.sin(table.direction), 0.0),
            table.friction,
        )
        if found.mean_motion and found.on_table:
            raise ParameterError(
                "Parameters 'table.*' and 'orbit.*' are both set: a robot can be either on a "
                "table or in an orbit."
            )
        return found

    @property
    def on_table(self) -> bool:
        """Whether a table slope or table friction acts."""
        return bool(any(self.gravity_W) or self.friction)

    @property
    def has_loads(self) -> bool:
        """Whether there is any load."""
        return bool(self.mean_motion or self.on_table)

    def require_suitable(self, robot: SpaceRobot, quaternion_WB: Array) -> None:
        """Reject a robot that cannot move in the table plane.

        Raises
        ------
        ParameterError
            The robot is not planar, or, with the attitude ``quaternion_WB`` (4,), its plane is not
            the table plane.
        """
        if not self.on_table:
            return
        normal = plane_normal(robot.description)
        if normal is None:
            raise ParameterError(
                f"Parameters 'table.*' are set, but robot '{robot.description.name}' is not "
                "planar: on an air-bearing table, all joints must move in the table plane."
            )
        normal_W = matrix_from_quaternion(quaternion_WB) @ normal
        if np.abs(normal_W[:2]).max() > _PLANE_TOLERANCE:
            raise ParameterError(
                f"Parameters 'table.*' are set, but the plane of robot '{robot.description.name}' "
                "is not the world's x-y plane: change 'initial_orientation'."
            )

    def require_flat(self, name: str, motion: BodyMotion, inertia: Inertia) -> None:
        """Reject a free body that would leave the table plane.

        Parameters
        ----------
        name
            Name of the body.
        motion, inertia
            Its motion, and its mass properties in its frame.

        Raises
        ------
        ParameterError
            The body moves out of the plane, or rotates about an axis other than the plane's normal,
            or about a non-principal axis.
        """
        if not self.on_table:
            return
        center = motion.at(Pose(r=inertia.com))
        about = motion.R_WT @ inertia.about_com @ motion.R_WT.T
        out_of_plane = np.array([center.v[2], *motion.omega[:2]])
        tilting = about[:2, 2] / np.trace(about)
        if np.abs(np.append(out_of_plane, tilting)).max() > _PLANE_TOLERANCE:
            raise ParameterError(
                f"Parameters 'table.*' are set, but the target '{name}' leaves the world's x-y "
                "plane: it must move in this plane and rotate about a principal axis along z."
            )


class PlantLoads:
    """The loads on a robot, updated in place; initially there are no wrenches.

    Parameters
    ----------
    robot
        The model.
    surroundings
        Constant loads; None: none.

    Attributes
    ----------
    vector
        All values, in the order of :class:`.LoadLayout`.
    in_link, in_world
        (L, 6) force (N) and torque (N m) at each link origin, in the order of
        ``robot.link_names``; one array is in link components, the other in W.
    last
        ``vector`` of the last tick.
    surroundings
        The constant loads.
    """

    def __init__(self, robot: SpaceRobot, surroundings: Surroundings | None = None) -> None:
        count = len(robot.link_names)
        layout = self._layout = LoadLayout(count)
        self.vector, self.last = np.zeros((2, layout.size))
        self.in_link = self.vector[layout.in_link].reshape(count, 6)
        self.in_world = self.vector[layout.in_world].reshape(count, 6)
        self._time = self.vector[layout.time]
        given = self.surroundings = surroundings or Surroundings()
        self.vector[layout.mean_motion] = given.mean_motion
        self.vector[layout.quaternion_WO] = given.quaternion_WO
        self.vector[layout.gravity_W] = given.gravity_W
        self.vector[layout.friction] = given.friction

    @property
    def has_loads(self) -> bool:
        """Whether any load acts now."""
        acting = self.vector.copy()
        acting[self._layout.quaternion_WO] = acting[self._layout.time] = 0.0
        return bool(acting.any())

    @property
    def time(self) -> float:
        """Time at the beginning of the next tick, s."""
        return float(self._time[0])

    @time.setter
    def time(self, seconds: float) -> None:
        self._time[0] = seconds
