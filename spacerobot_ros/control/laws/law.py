"""What every control law is: a state and a reference in, a wrench and joint efforts out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from spacerobot_ros.control.gains import Gains
from spacerobot_ros.control.outputs import OutputVector
from spacerobot_ros.control.selection import OutputSelection, default_selection
from spacerobot_ros.control.state import Actuation, ControlState, Reference
from spacerobot_ros.model.compilation import BufferedFunction, compiled, dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.parameters import configured, parameter, require_known


@dataclass(frozen=True)
class LawStatus:
    """How well the last command was defined.

    ``smallest_singular_value`` of ``J_z`` in SI units; ``singular``: it is below the law's
    threshold; ``damping``: the damping in effect, added to that singular value in quadrature (zero
    where none is needed, and with laws that need none).
    """

    smallest_singular_value: float
    singular: bool
    damping: float


@dataclass(frozen=True)
class LawOptions:
    """Options that every law has."""

    singular_value_threshold: float = parameter(
        0.1,
        "J_z is near singular where its smallest singular value (SI units) is below this",
        minimum=1e-06,
        maximum=1000000000.0,
    )


class ControlLaw(ABC):
    """A way to turn errors of the outputs into thruster forces and joint efforts.

    A law is constructed once for a robot and commands every tick. Its ``options`` become the
    parameters ``<name>.<option>`` of the controller node and arrive as keyword arguments.

    Parameters
    ----------
    robot
        The model, as the controller believes it.
    outputs
        What is controlled; :meth:`default_outputs` chooses by the robot.
    gains
        Diagonals of Kp and Kd by group, in the law's units (:class:`GainPair`).
    options
        Values of the law's ``options`` by name; those left out have their defaults.

    Raises
    ------
    ParameterError
        The robot does not have these outputs, the law cannot drive them, there is no such option,
        or one is out of range.
    """

    name: ClassVar[str]
    Options: ClassVar[Any] = LawOptions

    def __init__(
        self, robot: SpaceRobot, outputs: OutputSelection, gains: Gains, **options: float
    ) -> None:
        self.robot = robot
        self.outputs = OutputVector(robot, outputs)
        require_known(self.name, self.Options, options)
        self._options = configured(self.Options, options)
        self.singular_value_threshold: float = self._options.singular_value_threshold
        symbols = {
            "state": self.outputs.state,
            "reference": self.outputs.reference,
            "kp": ca.SX.sym("kp", self.outputs.m),
            "kd": ca.SX.sym("kd", self.outputs.m),
            **self._parameters(),
        }
        results = {
            "error": self.outputs.error,
            "error_rate": self.outputs.error_rate,
            "J_z": self.outputs.J_z,
            **self._results(symbols),
        }
        names = list(symbols), list(results)
        function = dense_function(
            f"law_{self.name}", list(symbols.values()), list(results.values()), names
        )
        self._function = BufferedFunction(compiled(function))
        self._in = dict(zip(symbols, self._function.inputs, strict=True))
        self._out = dict(zip(results, self._function.outputs, strict=True))
        self.set_gains(gains)

    @classmethod
    def default_outputs(cls, robot: SpaceRobot, end_effector_link: str) -> OutputSelection:
        """Return what the law drives unless told otherwise; see :func:`default_selection`."""
        return default_selection(robot.description, end_effector_link)

    def set_gains(self, gains: Gains) -> None:
        """Change the gains from the next command on."""
        self._in["kp"][:], self._in["kd"][:] = gains.diagonals(self.outputs.selection)

    def command(self, state: ControlState, reference: Reference) -> Actuation:
        """Return the wrench of the thrusters and the joint efforts, not limited.

        Raises
        ------
        TargetNotSetError
            The reference lacks a group of the outputs.
        NotFiniteError
            The state or the reference holds a number that is not finite.
        ValueError
            A part of them has the wrong length.
        """
        self.outputs.pack_state(state, self._in["state"])
        self.outputs.pack_reference(reference, self._in["reference"])
        return self._actuation(reference)

    @property
    def error(self) -> Array:
        """The error (m,) at the last command, in the order of ``outputs.labels``."""
        return self._out["error"].copy()

    @property
    def error_rate(self) -> Array:
        """The rate of the error (m,) at the last command."""
        return self._out["error_rate"].copy()

    @property
    def status(self) -> LawStatus:
        """How well the last command was defined."""
        smallest = float(np.linalg.svd(self._out["J_z"], compute_uv=False)[-1])
        singular = smallest < self.singular_value_threshold
        return LawStatus(smallest, singular, self._damping(smallest))

    def _damping(self, singular_value: float) -> float:
        """Return the damping that the law adds to a singular value of J_z."""
        return 0.0

    def _parameters(self) -> dict[str, ca.SX]:
        """Return the symbols that the law's function takes beside state, reference and gains."""
        return {}

    @abstractmethod
    def _results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """Return what the law's function gives beside the errors and ``J_z``, by name."""

    @abstractmethod
    def _actuation(self, reference: Reference) -> Actuation:
        """Evaluate the function at the packed inputs and return the command."""
