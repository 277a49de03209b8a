"""What the actuators can give, and how fast references may move so that they can follow."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import casadi as ca
import numpy as np

from spacerobot_ros.control.state import Actuation
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.parameters import parameter

_SHARE = 0.5
"""Part of the thrust that a reference may ask for; the feedback, and masses that are not quite as
believed, need the rest."""


@dataclass(frozen=True)
class MotionLimits:
    """The fastest a reference moves: speeds and accelerations of poses and of joints.

    ``joint_speed`` and ``joint_acceleration`` hold for every joint (m or rad, s); they are no
    parameters of the controller node, whose goals are poses.

    Raises
    ------
    ParameterError
        A limit is not positive; the sentence names it.
    """

    speed: float = parameter(0.1, "largest speed of a reference", unit="m/s", minimum=1e-06)
    acceleration: float = parameter(
        0.02, "largest acceleration of a reference", unit="m/s^2", minimum=1e-06
    )
    angular_speed: float = parameter(
        0.1, "largest angular speed of a reference", unit="rad/s", minimum=1e-06
    )
    angular_acceleration: float = parameter(
        0.02, "largest angular acceleration of a reference", unit="rad/s^2", minimum=1e-06
    )
    joint_speed: float = 0.1
    joint_acceleration: float = 0.02

    def __post_init__(self) -> None:
        for limit in fields(self):
            value = getattr(self, limit.name)
            if not value > 0:
                raise ParameterError(f"The limit '{limit.name}' is {value}; it must be positive.")

    def within_thrust(self, actuators: ActuatorLimits, robot: SpaceRobot, q: Array) -> MotionLimits:
        """Return the limits with accelerations lowered to what the thrusters give at a shape.

        The whole robot is taken as one body at the shape ``q`` (n,): force over total mass; torque
        over its largest moment of inertia about the center of mass; and the force, which acts at
        the base, needs torque too where the center of mass is elsewhere. A spacecraft without
        thrusters is left as it is.
        """
        torque = _SHARE * actuators.torque
        lever = float(np.linalg.norm(robot.center_of_mass(q)))
        accelerations = [self.acceleration, _SHARE * actuators.force / robot.total_mass]
        if lever > 0:
            accelerations.append(torque / (robot.total_mass * lever))
        inertia = float(np.linalg.eigvalsh(robot.inertia_matrix(q)[3:6, 3:6])[-1])
        return replace(
            self,
            acceleration=_smallest(accelerations),
            angular_acceleration=_smallest([self.angular_acceleration, torque / inertia]),
        )


@dataclass(frozen=True)
class Saturated:
    """``realised``: what the actuators give; ``loss``: commanded minus realised."""

    realised: Actuation
    loss: Actuation

    @classmethod
    def of(cls, commanded: Actuation, realised: Actuation) -> Saturated:
        """Return what is realised of a command, and what is lost."""
        wrench = commanded.wrench_B - realised.wrench_B
        return cls(realised, Actuation(wrench, commanded.tau - realised.tau))

    @property
    def limited(self) -> bool:
        """Whether anything was limited."""
        return bool(self.loss.wrench_B.any() or self.loss.tau.any())


@dataclass(frozen=True)
class ActuatorLimits:
    """Limits of the thrusters and of the joints.

    The thrusters give any force up to ``force`` (N) and any torque up to ``torque`` (N m), both in
    Euclidean norm and independently of each other. Beyond, the force is scaled to its limit, and
    so is the torque: each keeps its direction, so that a limited spacecraft is pushed where it is
    wanted, only less. Each joint gives up to its ``effort`` (n,), N m or N, by itself. Infinite
    where there is no limit.

    Raises
    ------
    ParameterError
        A limit is negative or not a number.
    """

    force: float
    torque: float
    effort: Array

    def __post_init__(self) -> None:
        for name, value, unit in (("force", self.force, "N"), ("torque", self.torque, "N m")):
            if math.isnan(value) or value < 0:
                raise ParameterError(
                    f"The {name} limit of the thrusters is {value} {unit}; it must not be negative."
                )
        if not np.all(self.effort >= 0):
            raise ParameterError(
                f"The effort limits of the joints are {self.effort.tolist()}; "
                "none must be negative."
            )

    def apply(self, commanded: Actuation) -> Saturated:
        """Return what the actuators give of a command, and what is lost."""
        wrench = np.concatenate(
            [
                _scaled(commanded.wrench_B[:3], self.force),
                _scaled(commanded.wrench_B[3:], self.torque),
            ]
        )
        tau = np.clip(commanded.tau, -self.effort, self.effort)
        return Saturated.of(commanded, Actuation(wrench, tau))

    def expression(self, actuation: ca.SX) -> ca.SX:
        """Return what :meth:`apply` realises of a command ``[f; n; tau]`` (6 + n,)."""
        parts = []
        for vector, limit in ((actuation[:3], self.force), (actuation[3:6], self.torque)):
            size = ca.sqrt(ca.dot(vector, vector))
            within = not math.isfinite(limit)
            parts.append(vector if within else vector * ca.if_else(size <= limit, 1, limit / size))
        return ca.vertcat(*parts, ca.fmin(ca.fmax(actuation[6:], -self.effort), self.effort))


def _scaled(vector: Array, limit: float) -> Array:
    size = math.sqrt(vector.dot(vector))
    return vector if size <= limit else vector * (limit / size)


def _smallest(accelerations: list[float]) -> float:
    return min(a for a in accelerations if a > 0 and math.isfinite(a))
