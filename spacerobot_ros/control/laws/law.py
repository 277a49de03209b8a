"""Base class of control laws, from a state and a reference to a wrench and joint efforts."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.outputs import (
    OutputSelection,
    OutputVector,
    default_selection,
    require_finite,
)
from spacerobot_ros.control.state import Actuation, ControlState, Reference
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.compilation import dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.parameters import configured, group, parameter, values_of


@dataclass(frozen=True)
class GainPair:
    """Proportional, derivative and integral gain of each output of a group, in Kp, Kd and Ki.

    Their units are the law's (:attr:`ControlLaw.gain_units`): a force or torque per error and per
    error rate with ``transposed_jacobian``, an acceleration per error and per error rate with the
    laws that know the inertia. The unit of Ki is that of Kp over seconds.

    The integral gain removes the steady-state error under constant disturbances. With the laws
    that know the inertia, each error is stable for ``ki < kp kd``; take much less.

    Commands are held for a control period. A derivative gain that takes more than its velocity
    within one makes the loop unstable: Kd times the period must stay well below 2 (with
    ``transposed_jacobian``, below twice the least inertia that the output meets, which for the
    attitude of an end-effector is that of the last wrist link about its joint).
    """

    kp: float = parameter(
        30.0,
        "proportional gain; N/m or N m/rad with laws that command forces (transposed_jacobian), "
        "1/s^2 with laws that command accelerations (model_based, computed_torque)",
        unit="by law",
        minimum=1e-9,
        maximum=1e9,
        read_only=False,
    )
    kd: float = parameter(
        60.0,
        "derivative gain; N s/m or N m s/rad with laws that command forces (transposed_jacobian), "
        "1/s with laws that command accelerations (model_based, computed_torque)",
        unit="by law",
        minimum=1e-9,
        maximum=1e9,
        read_only=False,
    )
    ki: float = parameter(
        0.0,
        "integral gain, against constant disturbances; 0: none. N/(m s) or N m/(rad s) with laws "
        "that command forces, 1/s^3 with laws that command accelerations",
        unit="by law",
        minimum=0.0,
        maximum=1e9,
        read_only=False,
    )


@dataclass(frozen=True)
class Gains:
    """The diagonals of Kp and Kd (paper 4, eqs 27 and 29), positive definite, and of Ki.

    Raises
    ------
    ParameterError
        A gain is not positive and finite, or an integral gain negative; the message names it.
    """

    base_position: GainPair = group(GainPair(30.0, 60.0))
    base_attitude: GainPair = group(GainPair(30.0, 60.0))
    end_effector_position: GainPair = group(GainPair(30.0, 60.0))
    end_effector_attitude: GainPair = group(GainPair(30.0, 60.0))
    joints: GainPair = group(GainPair(4.0, 4.0))

    def __post_init__(self) -> None:
        for each in fields(self):
            pair: GainPair = getattr(self, each.name)
            for name, value in (("kp", pair.kp), ("kd", pair.kd)):
                if not (math.isfinite(value) and value > 0):
                    raise ParameterError(
                        f"The gain {each.name}.{name} is {value}; it must be positive and finite."
                    )
            if not (math.isfinite(pair.ki) and pair.ki >= 0):
                raise ParameterError(
                    f"The gain {each.name}.ki is {pair.ki}; it must be finite and not negative."
                )

    @classmethod
    def uniform(cls, kp: float, kd: float, ki: float = 0.0) -> Gains:
        """Return the same gains for every group."""
        return cls(*(GainPair(kp, kd, ki) for _ in fields(cls)))

    def diagonals(self, selection: OutputSelection) -> tuple[Array, Array]:
        """Return the diagonals of Kp and Kd (m,) of the selected outputs."""
        pairs = self._pairs(selection)
        return np.array([pair.kp for pair in pairs]), np.array([pair.kd for pair in pairs])

    def integral_diagonal(self, selection: OutputSelection) -> Array:
        """Return the diagonal of Ki (m,) of the selected outputs."""
        return np.array([pair.ki for pair in self._pairs(selection)])

    def _pairs(self, selection: OutputSelection) -> list[GainPair]:
        return [
            *(_axis_gains(axis, self.base_position, self.base_attitude) for axis in selection.base),
            *(
                _axis_gains(axis, self.end_effector_position, self.end_effector_attitude)
                for axis in selection.end_effector
            ),
            *(self.joints for _ in selection.joints),
        ]


_NO_REFERENCE = Reference()


@dataclass(frozen=True)
class LawStatus:
    """Conditioning of the last command.

    ``smallest_singular_value`` of ``J_z`` in SI units; ``singular``: it is below the law's
    threshold; ``damping``: added to that singular value in quadrature, zero if none is needed.
    """

    smallest_singular_value: float
    singular: bool
    damping: float


@dataclass(frozen=True)
class LawOptions:
    """Options that every law has."""

    singular_value_threshold: float = parameter(
        0.1,
        "smallest singular value (SI units) of J_z below which it counts as singular",
        minimum=1e-06,
        maximum=1000000000.0,
    )


class ControlLaw(ABC):
    """A way to turn errors of the outputs into thruster forces and joint efforts.

    A law is constructed once for a robot and commands once every control period. A subclass gives
    ``name``, ``gain_units`` and :meth:`_results`, and where it has options, ``Options``: a frozen
    dataclass derived from :class:`LawOptions`, whose fields become the parameters
    ``<name>.<option>`` of the controller node. A line in
    :mod:`spacerobot_ros.control.laws.registry` makes it available.

    Parameters
    ----------
    robot
        The model, as the controller believes it.
    outputs
        The controlled outputs; :meth:`default_outputs` selects them by the robot.
    gains
        Diagonals of Kp and Kd by group, in the law's units (:class:`GainPair`).
    options
        An instance of the law's ``Options``; None: their defaults.
    thrust
        Whether thrusters push the base; otherwise the law commands no force.

    Raises
    ------
    ParameterError
        The robot does not have these outputs, the law cannot drive them, or an option is out of
        range.
    """

    name: ClassVar[str]
    gain_units: ClassVar[tuple[str, str]]
    """Units of Kp and Kd."""
    Options: ClassVar[Any] = LawOptions

    def __init__(
        self,
        robot: SpaceRobot,
        outputs: OutputSelection,
        gains: Gains,
        options: LawOptions | None = None,
        *,
        thrust: bool = True,
    ) -> None:
        self.robot = robot
        accepted = self.accepted_outputs(robot, outputs)
        self.outputs = OutputVector(robot, accepted, thrust=thrust)
        self.options: Any = configured(self.Options, values_of(options or self.Options()))
        self.singular_value_threshold: float = self.options.singular_value_threshold
        inputs = {name: np.asarray(value) for name, value in self._inputs().items()}
        key = (type(self), accepted, thrust, self.options)
        self.function, self._has_integral = robot.cached_object(
            key, lambda: self._make_function(inputs)
        )
        self._function = robot.view(self.function, ("compiled", *key))
        self._integral = np.zeros(self.outputs.m)
        """Integral of the errors (m,), m s or rad s."""
        names = self.function.name_in()[: self.function.n_in() - len(robot.mass_arguments)]
        self._in = dict(zip(names, self._function.inputs, strict=True))
        self._out = dict(zip(self.function.name_out(), self._function.outputs, strict=True))
        for name, value in inputs.items():
            self._in[name][:] = value
        self.set_gains(gains)

    def _make_function(self, inputs: Mapping[str, Array]) -> tuple[ca.Function, bool]:
        """Return the law as expressions of state, reference, kp, kd, integral and its own inputs,
        and whether it depends on the integral.
        """
        symbols = {
            "state": self.outputs.state,
            "reference": self.outputs.reference,
            "kp": ca.SX.sym("kp", self.outputs.m),
            "kd": ca.SX.sym("kd", self.outputs.m),
            "integral": ca.SX.sym("integral", self.outputs.m),
            **{name: ca.SX.sym(name, value.size) for name, value in inputs.items()},
        }
        weights = self.outputs.model.inputs
        results = {
            "error": self.outputs.error,
            "error_rate": self.outputs.error_rate,
            "J_z": self.outputs.J_z,
            **self._results(symbols),
        }
        function = dense_function(f"law_{self.name}", symbols | weights, results)
        has_integral = bool(ca.depends_on(results["actuation"], symbols["integral"]))
        return function, has_integral

    @classmethod
    def default_outputs(cls, robot: SpaceRobot, end_effector_link: str) -> OutputSelection:
        """Return the outputs if none are selected; see :func:`default_selection`."""
        return default_selection(robot.description, end_effector_link)

    @classmethod
    def accepted_outputs(cls, robot: SpaceRobot, outputs: OutputSelection) -> OutputSelection:
        """Return the outputs in the form that the law controls.

        Raises
        ------
        ParameterError
            The law cannot control these outputs of the robot.
        """
        return outputs

    def set_gains(self, gains: Gains) -> None:
        """Change the gains from the next command on.

        Raises
        ------
        ParameterError
            An integral gain is not zero, and the law has no integral term.
        """
        selection = self.outputs.selection
        self._ki = gains.integral_diagonal(selection)
        self.integrates = bool(self._ki.any())
        """Whether an integral gain is not zero."""
        if self.integrates and not self._has_integral:
            raise ParameterError(
                f"The law '{self.name}' has no integral term: its gains ki must be 0."
            )
        self._in["kp"][:], self._in["kd"][:] = gains.diagonals(selection)
        self._integral[self._ki == 0.0] = 0.0
        self._in["integral"][:] = self._ki * self._integral

    def integrate_error(self, duration: float, *, limited: bool = False) -> None:
        """Add the error of the last command, which is held for ``duration`` (s), to the integral.

        Where the command was ``limited``, an integral may only shrink (anti-windup).
        """
        if not self.integrates:
            return
        error = self._out["error"]
        grows = error * self._integral >= 0.0
        added = np.where((self._ki == 0.0) | (grows & limited), 0.0, duration * error)
        self._integral += added
        self._in["integral"][:] = self._ki * self._integral

    def reset_integral(self) -> None:
        """Set the integral of the error to zero."""
        self._integral[:] = self._in["integral"][:] = 0.0

    @property
    def gain_diagonals(self) -> tuple[Array, Array]:
        """The diagonals of Kp and Kd (m,), in the order of ``outputs.labels``."""
        return self._in["kp"].copy(), self._in["kd"].copy()

    @property
    def integral_gains(self) -> Array:
        """The diagonal of Ki (m,), in the order of ``outputs.labels``."""
        return self._ki.copy()

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

    def command_to_packed(self, state: ControlState, packed: Array) -> Actuation:
        """Return :meth:`command` for a reference in the form of its :attr:`function`.

        Only for laws with :attr:`fixed_inputs`: the others look at the joints of references.
        """
        self.outputs.pack_state(state, self._in["state"])
        require_finite("reference", packed)
        self._in["reference"][:] = packed
        return self._actuation(_NO_REFERENCE)

    def command_per_error(self, state: ControlState) -> Array:
        """Return the command (6 + n, m) at rest per unit of ``Kp e``, in the shape of a state."""
        state = ControlState.at_rest(state.r_WB, state.quaternion_WB, state.q)
        selection = self.outputs.selection
        reference = Reference.present(self.robot, state, selection.end_effector_link)
        given = {name: memory.copy() for name, memory in self._in.items()}
        self.outputs.pack_state(state, given["state"])
        self.outputs.pack_reference(reference, given["reference"])
        columns = []
        for unit in np.vstack([np.zeros(self.outputs.m), np.eye(self.outputs.m)]):
            given["integral"] = unit
            results = self.function(*given.values(), *self.robot.mass_arguments.values())
            actuation = dict(zip(self.function.name_out(), results, strict=True))["actuation"]
            columns.append(np.array(actuation).ravel())
        at_rest, *each = columns
        return np.array(each).T - at_rest[:, np.newaxis]

    @property
    def state(self) -> ControlState:
        """A copy of the state at the last command."""
        return ControlState.unstack(self._in["state"])

    @property
    def error(self) -> Array:
        """The error (m,) at the last command, in the order of ``outputs.labels``."""
        return self._out["error"].copy()

    def largest_error_share(self, bounds: Array) -> float:
        """Return the largest error at the last command as a share of its bound (m,), > 0."""
        errors = self._out["error"].tolist()
        shares = [abs(e / bound) for e, bound in zip(errors, bounds.tolist(), strict=True)]
        # The largest of some numbers may hide one that is none: it must not count as reached.
        return math.nan if math.isnan(sum(shares)) else max(shares, default=0.0)

    @property
    def error_rate(self) -> Array:
        """The rate of the error (m,) at the last command."""
        return self._out["error_rate"].copy()

    @property
    def status(self) -> LawStatus:
        """Conditioning of the last command."""
        smallest = float(np.linalg.svd(self._out["J_z"], compute_uv=False)[-1])
        singular = smallest < self.singular_value_threshold
        return LawStatus(smallest, singular, self._damping(smallest))

    def _damping(self, singular_value: float) -> float:
        """Return the damping that the law adds to a singular value of J_z."""
        return 0.0

    def _inputs(self) -> Mapping[str, npt.ArrayLike]:
        """Return the law's own arguments of its function, by name, with their initial values.

        They follow state, reference and gains; :meth:`_actuation` may change them, in ``self._in``.
        """
        return {}

    @property
    def fixed_inputs(self) -> Mapping[str, npt.ArrayLike] | None:
        """Arguments of :attr:`function` beside state, reference and gains that are the same in
        every flight; None: some depend on the flight.
        """
        integral = {"integral": np.zeros(self.outputs.m)}
        return {**integral, **self._inputs(), **self.robot.mass_arguments}

    def is_complete(self, results: Mapping[str, ca.SX]) -> ca.SX:
        """Return whether the results of :attr:`function` are the command without further steps."""
        return ca.SX(1)

    @abstractmethod
    def _results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """Return the expressions of the law's results beside the errors and ``J_z``, by name.

        ``actuation`` (6 + n,) is the command: force (N) and torque (N m) at the origin of the base
        link in base components, then the joint efforts; other results are the law's own.
        ``symbols`` has ``kp`` and ``kd`` (m,), ``integral`` (m,), to be added to ``kp`` times the
        error, and one for each name of :meth:`_inputs`; all else is in ``self.outputs``. A law
        whose ``actuation`` does not depend on ``integral`` refuses integral gains.
        """

    def _actuation(self, reference: Reference) -> Actuation:
        """Evaluate the function and return the command; its inputs are in ``self._in``."""
        self._function.evaluate()
        actuation = self._out["actuation"].copy()
        return Actuation(actuation[:6], actuation[6:])


def _axis_gains(axis: str, position: GainPair, attitude: GainPair) -> GainPair:
    return attitude if axis.startswith("r") else position
