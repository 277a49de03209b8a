"""The interface of every plant, and plants round other plants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.simulation.initial_state import InitialState

Counts = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class Plant(Protocol):
    """A robot that steps by ticks; the attributes are the state that it would report then.

    ``pose``
        (7,) position ``r_WB`` in m and quaternion ``R_WB`` (x, y, z, w) of the base link.
    ``twist``
        (6,) ``v_WB_B`` in m/s and ``omega_WB_B`` in rad/s.
    ``q``, ``qdot``
        (n,) joint positions (m or rad) and velocities (a second).
    ``effort``
        (n,) efforts of the joints' actuators, N or N m.
    ``momentum``
        (7,) linear momentum (kg m/s), angular momentum about the system's centre of mass
        (kg m^2/s), both in W, and kinetic energy (J): summed body by body from the state above.
    ``link_R``, ``link_r``
        (3, 3 L) and (3, L): pose in B of every link, in the order of ``robot.link_names``.

    The arrays are the plant's own: they change in place.
    """

    robot: SpaceRobot
    initial: InitialState
    pose: Array
    twist: Array
    q: Array
    qdot: Array
    effort: Array
    momentum: Array
    link_R: Array
    link_r: Array

    def reset(self) -> None:
        """Return to the initial state."""

    def hold(self, joints: Flags) -> None:
        """Hold these joints (n,) where they are from now on, and no others."""

    @property
    def step(self) -> Callable[..., bool]:
        """Advance a tick under the plant's commands; return whether a joint was limited."""

    @property
    def limit_counts(self) -> Mapping[str, Counts]:
        """Ticks in which each joint (n,) was limited, by what limited it."""

    @property
    def expected_momenta(self) -> Array:
        """Linear over angular momentum (6,) in W: from the beginning and by the thrusters."""


class WrappedPlant:
    """Reports the state of the plant within, in the same arrays; subclasses add its step."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.robot, self.initial = plant.robot, plant.initial
        self.pose, self.twist, self.momentum = plant.pose, plant.twist, plant.momentum
        self.q, self.qdot, self.effort = plant.q, plant.qdot, plant.effort
        self.link_R, self.link_r = plant.link_R, plant.link_r

    @property
    def limit_counts(self) -> Mapping[str, Counts]:
        """Ticks in which each joint (n,) was limited, by what limited it."""
        return self.plant.limit_counts

    @property
    def expected_momenta(self) -> Array:
        """Linear over angular momentum (6,) in W: from the beginning and by the thrusters."""
        return self.plant.expected_momenta

    def hold(self, joints: Flags) -> None:
        """Hold these joints (n,) where they are from now on, and no others."""
        self.plant.hold(joints)

    def reset(self) -> None:
        """Return to the initial state."""
        self.plant.reset()
