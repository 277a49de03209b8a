"""A clearance for which a test decides where links come too near."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spacerobot_ros.collision import Approach, BasePoses, LinkPair
from spacerobot_ros.model import RobotDescription
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.clearance import Clearance

CLAUSE = "links 'a' and 'b' come within 0.004 m"


class DecidedClearance(Clearance):
    """Links come too near where ``is_near`` holds of shapes (N, n), whatever the robot is.

    ``motions`` is what holds of motions; by default the same.
    """

    def __init__(
        self,
        robot: RobotDescription,
        is_near: Callable[[Array], bool],
        motions: Callable[[Array], bool] | None = None,
        *,
        obstacles: bool = False,
    ) -> None:
        super().__init__(robot, 0.01)
        self._is_near, self._motions = is_near, motions or is_near
        self._obstacles = obstacles

    @property
    def has_obstacles(self) -> bool:
        return self._obstacles

    def required(self, start: Array, base: BasePoses | None = None) -> Array:
        return np.zeros(0)

    def is_clear(self, shapes: Array, required: Array) -> bool:
        return not self._is_near(shapes)

    def approaches(
        self, positions: Array, required: Array | None = None, base: BasePoses | None = None
    ) -> list[Approach]:
        near = self._motions(positions)
        return [Approach(LinkPair("a", "b"), 0, 0.004, 0.0, positions[0])] if near else []

    def clause(self, approach: Approach, control_period: float | None) -> str:
        return CLAUSE
