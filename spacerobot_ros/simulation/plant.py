"""What every plant offers to whoever steps and publishes it."""

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
    """A robot that steps by ticks and holds the state it has then; see the plants for shapes."""

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
