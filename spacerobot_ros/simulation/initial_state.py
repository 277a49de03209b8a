"""The initial state of a plant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion, unit_quaternion
from spacerobot_ros.simulation.config import PlantConfig


@dataclass(frozen=True)
class InitialState:
    """Where a run starts: base pose in W (m; quaternion x, y, z, w), shape, and total momenta in W.

    ``joint_positions`` None means zero, or the nearest limit of a joint that cannot be there.
    ``angular_momentum`` (kg m^2/s) is about the system's centre of mass. ``joint_velocities`` None
    means zero; the base's twist follows from them and the momenta. ``center_of_mass`` (m, in W)
    puts the system's centre of mass there instead of the base link at ``position``.

    Raises
    ------
    ParameterError
        Both ``position`` and ``center_of_mass`` are given.
    """

    position: Array = field(default_factory=lambda: np.zeros(3))
    quaternion: Array = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))
    joint_positions: Array | None = None
    linear_momentum: Array = field(default_factory=lambda: np.zeros(3))
    angular_momentum: Array = field(default_factory=lambda: np.zeros(3))
    joint_velocities: Array | None = None
    center_of_mass: Array | None = None

    @classmethod
    def of(cls, config: PlantConfig) -> InitialState:
        """Return where a configuration has a run start; an empty list leaves a choice open.

        Raises
        ------
        ParameterError
            The position is given twice.
        """
        return cls(
            position=np.array(config.initial_position or (0.0, 0.0, 0.0)),
            quaternion=np.array(config.initial_orientation or (0.0, 0.0, 0.0, 1.0)),
            joint_positions=_optional(config.initial_joint_positions),
            linear_momentum=np.array(config.linear_momentum or (0.0, 0.0, 0.0)),
            angular_momentum=np.array(config.angular_momentum or (0.0, 0.0, 0.0)),
            joint_velocities=_optional(config.initial_joint_velocities),
            center_of_mass=_optional(config.initial_center_of_mass),
        )

    def __post_init__(self) -> None:
        if self.center_of_mass is not None and np.any(self.position):
            raise ParameterError(
                "The initial position is given twice, of the base and of the centre of mass: "
                "leave one out."
            )

    def attitude(self) -> Array:
        """Return the unit quaternion (x, y, z, w) of the base.

        Raises
        ------
        ParameterError
            The quaternion is zero or not finite.
        """
        try:
            return unit_quaternion(self.quaternion)
        except ValueError as error:
            raise ParameterError(f"The initial orientation is refused: {error}.") from None

    def momenta(self) -> Array:
        """Return linear over angular momentum (6,).

        Raises
        ------
        ParameterError
            One of them is not finite.
        """
        momenta = np.concatenate([self.linear_momentum, self.angular_momentum])
        if not np.all(np.isfinite(momenta)):
            raise ParameterError("The initial momenta must be finite.")
        return momenta

    def shape(self, robot: SpaceRobot) -> Array:
        """Return the joint positions (n,).

        Raises
        ------
        ParameterError
            Their number is wrong, or one lies outside its limits.
        """
        if self.joint_positions is None:
            return np.clip(np.zeros(robot.n), robot.lower, robot.upper)
        q = _of_joints(robot, self.joint_positions, "positions")
        for name, value, lower, upper in zip(
            robot.joint_names, q, robot.lower, robot.upper, strict=True
        ):
            if not (lower <= value <= upper):
                raise ParameterError(
                    f"The initial position of joint '{name}', {value}, is outside its limits "
                    f"[{lower}, {upper}]."
                )
        return q

    def rates(self, robot: SpaceRobot) -> Array:
        """Return the joint velocities (n,).

        Raises
        ------
        ParameterError
            Their number is wrong, or one is not finite.
        """
        if self.joint_velocities is None:
            return np.zeros(robot.n)
        return _of_joints(robot, self.joint_velocities, "velocities")

    def system_position(self, robot: SpaceRobot) -> Array:
        """Return where the system's centre of mass is in W (3,), m.

        Raises
        ------
        ParameterError
            It is not finite, or the shape or the orientation is refused.
        """
        if self.center_of_mass is not None:
            r_WC_W = np.asarray(self.center_of_mass, dtype=float)
        else:
            R_WB = matrix_from_quaternion(self.attitude())
            r_WC_W = self.position + R_WB @ robot.center_of_mass(self.shape(robot))
        if not np.all(np.isfinite(r_WC_W)):
            raise ParameterError("The initial position must be finite.")
        return r_WC_W


def _optional(values: tuple[float, ...]) -> Array | None:
    return np.array(values) if values else None


def _of_joints(robot: SpaceRobot, given: Array, what: str) -> Array:
    values = np.asarray(given, dtype=float)
    if values.shape != (robot.n,):
        raise ParameterError(
            f"The initial joint {what} are {values.size} numbers; robot "
            f"'{robot.description.name}' has {robot.n} joints: {', '.join(robot.joint_names)}."
        )
    if not np.all(np.isfinite(values)):
        raise ParameterError(f"The initial joint {what} must be finite, not {values.tolist()}.")
    return values
