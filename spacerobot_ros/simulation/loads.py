"""External loads of a plant as numbers, and ticks under them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.external_loads import LoadLayout


class PlantLoads:
    """The loads on a robot, which change in place; at first there are none.

    Parameters
    ----------
    robot
        The model.

    Attributes
    ----------
    vector
        All numbers, in the order of :class:`.LoadLayout`.
    in_link, in_world
        (L, 6) force (N) over torque (N m) at the origin of every link, in the order of
        ``robot.link_names``: in components of the link, and in those of W.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        count = len(robot.link_names)
        layout = LoadLayout(count)
        self.vector = np.zeros(layout.size)
        self.in_link = self.vector[layout.in_link].reshape(count, 6)
        self.in_world = self.vector[layout.in_world].reshape(count, 6)
        self._acting = [
            self.vector[part]
            for part in (
                layout.in_link,
                layout.in_world,
                layout.mean_motion,
                layout.gravity_W,
                layout.friction,
            )
        ]
        self._time = self.vector[layout.time]
        self.vector[layout.quaternion_WO] = 0.0, 0.0, 0.0, 1.0

    @property
    def act(self) -> bool:
        """Whether any load acts now."""
        return bool(any(part.any() for part in self._acting))

    @property
    def time(self) -> float:
        """Time at the beginning of the next tick, s."""
        return float(self._time[0])

    @time.setter
    def time(self, seconds: float) -> None:
        self._time[0] = seconds


class LoadedTick:
    """A tick under loads, evaluated on the buffers of the tick without loads.

    Parameters
    ----------
    plain
        The tick without loads, whose inputs and outputs are read and written.
    loaded
        The tick under loads: it takes the vector of loads as one more input, and may have further
        outputs.
    loads
        The loads.
    further
        Arrays for the further outputs.
    """

    def __init__(
        self,
        plain: BufferedFunction,
        loaded: BufferedFunction,
        loads: PlantLoads,
        further: Sequence[Array] = (),
    ) -> None:
        self._loaded, self._loads = loaded, loads
        *inputs, self._vector = loaded.inputs
        self._inputs = list(zip(inputs, plain.inputs, strict=True))
        self._outputs = list(zip([*plain.outputs, *further], loaded.outputs, strict=True))

    def evaluate(self) -> None:
        """Evaluate the outputs at the inputs."""
        for to, given in self._inputs:
            to[...] = given
        self._vector[:] = self._loads.vector
        self._loaded.evaluate()
        for to, result in self._outputs:
            to[...] = result
