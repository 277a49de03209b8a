"""Joint commands by name: read from bytes, checked, ordered as the model's joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import CommandError
from spacerobot_ros.nodes.common.cdr import TemplateReader

Quantity = Literal["position", "velocity", "effort"]


class JointReader:
    """Takes one quantity of JointState messages into the order of the model's joints.

    Joints that a message does not name are left out (zero).

    Parameters
    ----------
    joint_names
        The model's joints.
    quantities
        What to read; the first is required in every message.
    complete
        Whether every joint must be named, as in a measured state.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        quantities: Sequence[Quantity],
        *,
        complete: bool = False,
    ) -> None:
        self._complete = complete
        self._index = {name: i for i, name in enumerate(joint_names)}
        self._robot_joints = ", ".join(joint_names)
        self._quantities = quantities
        self._reader = TemplateReader(JointState, self._spans)
        self._changes = 0
        self._problem = ""
        self._order: npt.NDArray[np.intp] | None = None
        self._copies: list[tuple[memoryview, slice]] = []
        self.values = {name: np.zeros(len(joint_names)) for name in quantities}

    def accept(self, raw: bytes) -> int:
        """Read a message into ``values`` and return its stamp in ns.

        Raises
        ------
        CommandError
            A joint is unknown or named twice, or a length is wrong.
        """
        self._reader.accept(raw)
        if self._reader.changes != self._changes:
            self._changes = self._reader.changes
            self._check()
        if self._problem:
            raise CommandError(self._problem)
        for target, place in self._copies:
            target[:] = raw[place]
        if self._order is not None:
            for name, values in self.values.items():
                if self._reader.has(name):
                    values[self._order] = self._reader.floats(name)
        return self._reader.stamp_ns

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last message given to :meth:`accept`, refused or not, ns."""
        return self._reader.stamp_ns

    def _spans(self, message: JointState) -> dict[str, int]:
        return {name: len(getattr(message, name)) for name in self._quantities}

    def _check(self) -> None:
        """Judge names and lengths, once for every layout."""
        message = self._reader.prototype
        assert message is not None
        names = list(message.name)
        self._problem = ""
        unknown = [name for name in names if name not in self._index]
        for values in self.values.values():
            values[:] = 0.0
        if unknown:
            self._problem = f"joint '{unknown[0]}' is unknown; the robot has {self._robot_joints}"
        elif self._complete and len(set(names)) < len(self._index):
            missing = next(name for name in self._index if name not in names)
            self._problem = f"joint '{missing}' is missing"
        elif len(set(names)) != len(names):
            self._problem = f"a joint is named twice in {names}"
        else:
            for i, quantity in enumerate(self._quantities):
                count = len(getattr(message, quantity))
                if count != len(names) and (count or i == 0):
                    self._problem = (
                        f"{len(names)} joint(s) are named but {count} {quantity} value(s) given"
                    )
        # Joints in the model's order, as the stack's own nodes send them, are copied as bytes.
        self._order, self._copies = None, []
        if names == list(self._index):
            self._copies = [
                (values.data.cast("B"), self._reader.place(name))
                for name, values in self.values.items()
                if self._reader.has(name)
            ]
        else:
            self._order = np.array([self._index.get(name, 0) for name in names], dtype=np.intp)
