"""Base class for control laws, which compute a wrench and joint efforts from a state and a
reference."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.outputs import OutputSelection, OutputVector, default_selection
from spacerobot_ros.control.state import Actuation, ControlState, Reference
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.compilation import dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.parameters import configured, group, nonnegative, parameter, values_of

FORCE_GAINS = "N/m or N m/rad", "N s/m or N m s/rad"
"""Units of Kp and Kd for laws that command forces."""

ACCELERATION_GAINS = "1/s^2", "1/s"
"""Units of Kp and Kd for laws that command accelerations."""

_FASTEST_DAMPING = 2.0
"""Largest automatic Kd for accelerations, 1/s: errors decay within seconds."""

_DAMPING_PER_PERIOD = 0.4
"""Largest product of automatic Kd and the control period: the loop is unstable at 1 if commands
arrive one period late, and at 2 if they do not."""

_CRITICAL_STIFFNESS = 1 / 4
"""Ratio of automatic Kp to the square of Kd, for accelerations: critical damping."""

_LARGEST_GROWTH = 1.001
"""Largest error growth factor per control period that is considered stable."""

_SINGULAR_DAMPING = 0.02
"""Relative increase in each output's mobility, which keeps automatic gains bounded at
singularities."""


@dataclass(frozen=True)
class GainPair:
    """Proportional, derivative and integral gains for each output in a group: entries of Kp, Kd and
    Ki, in units that depend on the law (:attr:`ControlLaw.gain_units`; for Ki, per second).

    Automatic gains depend on the robot and the control period (:meth:`ControlLaw.set_gains`).

    The integral gain removes the steady-state error under constant disturbances. With laws that use
    the inertia, each error decays if ``ki < kp kd``; choose a much smaller value.

    Commands are held for one control period. If a derivative gain removes more than the whole
    velocity within one period, the loop is unstable: Kd times the period must stay well below 2
    (with ``transposed_jacobian``, below twice the smallest inertia moved by the output, which for
    end-effector attitude is that of the last wrist link about its joint).
    """

    kp: float = nonnegative(
        0.0,
        "proportional gain; 0: automatic, from masses and control period. N/m or N m/rad with "
        "laws that command forces (transposed_jacobian), "
        "1/s^2 with laws that command accelerations (model_based, computed_torque)",
        "by law",
        maximum=1e9,
        read_only=False,
    )
    kd: float = nonnegative(
        0.0,
        "derivative gain; 0: automatic, from masses and control period. N s/m or N m s/rad "
        "with laws that command forces (transposed_jacobian), "
        "1/s with laws that command accelerations (model_based, computed_torque)",
        "by law",
        maximum=1e9,
        read_only=False,
    )
    ki: float = nonnegative(
        0.0,
        "integral gain, which removes errors due to constant disturbances; 0: none. N/(m s) or N "
        "m/(rad s) with laws that command forces, 1/s^3 with laws that command accelerations",
        "by law",
        maximum=1e9,
        read_only=False,
    )


def _matrix_parameter(name: str) -> Any:
    return parameter(
        (),
        f"matrix {name} for all outputs, row by row in the order of the errors in statuses, "
        f"symmetric and positive definite; []: the {name.lower()} of the groups",
        "by law",
        maximum=1e9,
        minimum=-1e9,
        read_only=False,
    )


@dataclass(frozen=True)
class Gains:
    """Diagonals of Kp, Kd (paper 4, eqs 27 and 29) and Ki by group; 0 in Kp or Kd: automatic.

    If given, ``kp_matrix`` and ``kd_matrix`` (m * m,) replace Kp and Kd for all outputs.
    """

    base_position: GainPair = group(GainPair())
    base_attitude: GainPair = group(GainPair())
    end_effector_position: GainPair = group(GainPair())
    end_effector_attitude: GainPair = group(GainPair())
    joints: GainPair = group(GainPair())
    kp_matrix: tuple[float, ...] = _matrix_parameter("Kp")
    kd_matrix: tuple[float, ...] = _matrix_parameter("Kd")

    @classmethod
    def uniform(cls, kp: float, kd: float, ki: float = 0.0) -> Gains:
        """Return the same gains for every group."""
        pair = GainPair(kp, kd, ki)
        return cls(pair, pair, pair, pair, pair)

    def matrices(self, selection: OutputSelection) -> tuple[Array, Array]:
        """Return Kp and Kd (m, m) for the selected outputs; 0 on a diagonal: automatic.

        Raises
        ------
        ParameterError
            A matrix does not have m * m numbers, or is not symmetric and positive definite.
        """
        pairs = self._pairs(selection)
        return (
            _checked_matrix("kp_matrix", self.kp_matrix, [pair.kp for pair in pairs], selection),
            _checked_matrix("kd_matrix", self.kd_matrix, [pair.kd for pair in pairs], selection),
        )

    def diagonals(self, selection: OutputSelection) -> tuple[Array, Array]:
        """Return the diagonals of Kp and Kd (m,) for the selected outputs; 0: automatic."""
        kp, kd = map(np.diag, self.matrices(selection))
        return kp.copy(), kd.copy()

    def integral_diagonal(self, selection: OutputSelection) -> Array:
        """Return the diagonal of Ki (m,) for the selected outputs."""
        return np.array([pair.ki for pair in self._pairs(selection)])

    def _pairs(self, selection: OutputSelection) -> list[GainPair]:
        pairs: list[GainPair] = []
        for axes, position, attitude in (
            (selection.base, self.base_position, self.base_attitude),
            (selection.end_effector, self.end_effector_position, self.end_effector_attitude),
        ):
            pairs += [attitude if axis.startswith("r") else position for axis in axes]
        return pairs + [self.joints] * len(selection.joints)


def _checked_matrix(
    name: str, numbers: Sequence[float], diagonal: Sequence[float], selection: OutputSelection
) -> Array:
    if not len(numbers):
        return np.diag(np.array(diagonal, dtype=float))
    m, labels = len(selection.labels), ", ".join(selection.labels)
    if len(numbers) != m * m:
        raise ParameterError(
            f"Parameter 'gains.{name}' has {len(numbers)} values; the {m} outputs of the law "
            f"({labels}) require {m * m}, row by row."
        )
    matrix = np.reshape(numbers, (m, m)).astype(float)
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
        raise ParameterError(f"Parameter 'gains.{name}' is not symmetric.")
    if np.linalg.eigvalsh(matrix).min() <= 0.0:
        raise ParameterError(f"Parameter 'gains.{name}' is not positive definite.")
    return matrix


@dataclass(frozen=True)
class LawStatus:
    """Conditioning of the last command.

    ``smallest_singular_value`` of ``J_z`` in SI units; ``singular``: whether it is below the law's
    threshold; ``damping``: added in quadrature to the smallest singular value; zero if not needed.
    """

    smallest_singular_value: float
    singular: bool
    damping: float


@dataclass(frozen=True)
class LawOptions:
    """Options common to all laws."""

    singular_value_threshold: float = parameter(
        0.1,
        "smallest singular value (SI units) of J_z below which J_z is considered singular",
        minimum=1e-06,
        maximum=1000000000.0,
    )


class ControlLaw(ABC):
    """A function from output errors to thruster forces and joint efforts.

    A law is constructed once per robot and computes one command per control period. A subclass
    defines ``name``, ``gain_units`` and :meth:`results`, and if it has options, ``Options``: a
    frozen dataclass derived from :class:`LawOptions`, whose fields become the parameters
    ``<name>.<option>`` of the controller node. A line in
    :mod:`spacerobot_ros.control.laws.registry` makes the law available.

    Parameters
    ----------
    robot
        The controller's robot model.
    outputs
        The controlled outputs; :meth:`default_outputs` returns the robot's defaults.
    gains
        Diagonals of Kp and Kd by group, in the law's units (:class:`GainPair`).
    options
        An instance of the law's ``Options``; None: their defaults.
    thrust
        Whether thrusters act on the base; if not, the law commands no force.
    control_period
        Duration for which a command is held, s; longer durations lower the automatic gains.

    Raises
    ------
    ParameterError
        The robot does not have these outputs, the law cannot control them, or an option is out of
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
        control_period: float = 0.0,
    ) -> None:
        self.robot = robot
        self.control_period = control_period
        """Duration for which a command is held, s; 0: unknown."""
        self.time = 0.0
        """Command time, s; set by the controller before each command."""
        self._damping_rate = _FASTEST_DAMPING
        """Automatic Kd per unit of mass, 1/s."""
        if control_period > 0:
            self._damping_rate = min(_FASTEST_DAMPING, _DAMPING_PER_PERIOD / control_period)
        accepted = self.accepted_outputs(robot, outputs)
        self.outputs = OutputVector(robot, accepted, thrust=thrust)
        self.options: Any = configured(self.Options, values_of(options or self.Options()))
        self.singular_value_threshold: float = self.options.singular_value_threshold
        self._integral = np.zeros(self.outputs.m)
        """Integral of the errors (m,), m s or rad s."""
        self._use_function(weighs=self.has_automatic_gains(gains))
        self.set_gains(gains)

    def _use_function(self, *, weighs: bool) -> None:
        """Build the function of the law; one that ``weighs`` outputs computes automatic gains."""
        self._weighs, robot = weighs, self.robot
        self._fills_gains = False
        inputs = {name: np.asarray(value) for name, value in self.inputs().items()}
        key: tuple[Any, ...] = (
            type(self),
            self.outputs.selection,
            self.outputs.thrust,
            self.options,
        )
        if weighs:
            key += (self._damping_rate,)
        make = cache(partial(self._make_function, inputs))
        if not type(self).__module__.startswith("spacerobot_ros."):
            # A user may have changed the class, or a number to which it refers.
            key += (make().serialize(),)
        self.function, self._function = robot.view(key, make)
        command, integral = (
            self.function.index_out("actuation"),
            self.function.index_in("integral"),
        )
        self._has_integral = self.function.jac_sparsity(command, integral).nnz() > 0
        names = self.function.name_in()[: self.function.n_in() - len(robot.mass_arguments)]
        self._in = dict(zip(names, self._function.inputs, strict=True))
        self._out = dict(zip(self.function.name_out(), self._function.outputs, strict=True))
        for name, value in inputs.items():
            self._in[name][:] = value

    def has_automatic_gains(self, gains: Gains) -> bool:
        """Return whether any output has automatic gains that depend on the masses."""
        force = self.gain_units != ACCELERATION_GAINS
        return force and not all(each.all() for each in gains.diagonals(self.outputs.selection))

    def _make_function(self, inputs: Mapping[str, Array]) -> ca.Function:
        """Return the law as expressions of state, reference, kp, kd, integral and its inputs."""
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
            **self.results(symbols),
        }
        size = 6 + self.robot.n
        if (shape := ca.SX(results.get("actuation", [])).shape) != (size, 1):
            raise ParameterError(
                f"The 'actuation' in the results of law '{self.name}' has shape {shape}; it must "
                f"be a column of {size} expressions: the base wrench, then the joint efforts."
            )
        if self._weighs and not self._fills_gains:
            gains = ca.vertcat(symbols["kp"], symbols["kd"])
            if ca.depends_on(results["actuation"], gains):
                raise ParameterError(
                    f"The law '{self.name}' has no automatic gains: set kp and kd for all its "
                    f"output groups ({', '.join(self.outputs.labels)})."
                )
        return dense_function(f"law_{self.name}", symbols | weights, results)

    @property
    def follows_accelerations(self) -> bool:
        """Whether commands include feedforward efforts for reference accelerations."""
        return self.gain_units != FORCE_GAINS or self._weighs

    @property
    def joint_damping(self) -> float:
        """Viscous joint friction included in every command, N m s/rad."""
        return 0.0

    def automatic_effort(self, symbols: Mapping[str, ca.SX]) -> ca.SX:
        """Return the efforts (m,) due to automatic gains if the law commands forces; else zeros.

        They critically damp the errors of outputs with zero ``kp`` and ``kd``:
        ``Htilde (z1ddot_des + Kd edot + Kp e)``, with the output mass matrix ``Htilde`` (eq. 25),
        slightly damped so that it stays bounded at singularities.
        """
        z1 = self.outputs
        if not self._weighs:
            return ca.SX(z1.m, 1)
        mobility = z1.mobility(z1.model("inertia_matrix", z1.q))
        mobility = mobility + _SINGULAR_DAMPING * ca.diag(ca.diag(mobility))
        self._fills_gains = True
        Kd = self._damping_rate
        Kp = _CRITICAL_STIFFNESS * Kd**2
        damping = ca.if_else(symbols["kd"] > 0, 0, Kd * z1.error_rate)
        stiffness = ca.if_else(symbols["kp"] > 0, 0, z1.acceleration + Kp * z1.error)
        return solve_positive_definite(mobility, damping + stiffness)

    @classmethod
    def default_outputs(cls, robot: SpaceRobot, end_effector_link: str) -> OutputSelection:
        """Return the outputs used if none are selected; see :func:`default_selection`."""
        return default_selection(robot.description, end_effector_link)

    @classmethod
    def accepted_outputs(cls, robot: SpaceRobot, outputs: OutputSelection) -> OutputSelection:
        """Return the outputs in the form controlled by the law.

        Raises
        ------
        ParameterError
            The law cannot control these outputs.
        """
        return outputs

    def set_gains(self, gains: Gains) -> None:
        """Change the gains from the next command on.

        Automatic gains make every error critically damped, as fast as the control period permits;
        if the law commands forces, the gains are scaled by the masses (:meth:`automatic_effort`).

        Raises
        ------
        ParameterError
            An integral gain is nonzero, but the law has no integral term.
        """
        selection = self.outputs.selection
        self._ki = gains.integral_diagonal(selection)
        self.integrates = bool(self._ki.any())
        """Whether an integral gain is not zero."""
        if self.integrates and not self._has_integral:
            raise ParameterError(
                f"The law '{self.name}' has no integral term: its gains ki must be 0."
            )
        if self.has_automatic_gains(gains) and not self._weighs:
            before = self._in
            self._use_function(weighs=True)
            for name, value in before.items():
                self._in[name][:] = value
        couplings = tuple(K - np.diag(np.diag(K)) for K in gains.matrices(selection))
        self.couples = any(coupling.any() for coupling in couplings)
        """Whether a gain matrix has off-diagonal elements."""
        if self.couples and not self.takes_matrices:
            raise ParameterError(f"The law '{self.name}' does not accept gain matrices.")
        self._couplings = couplings
        self._in["kp"][:], self._in["kd"][:] = self.gain_arguments(gains)
        self._integral[self._ki == 0.0] = 0.0
        self._in["integral"][:] = self._ki * self._integral

    def gain_arguments(self, gains: Gains) -> tuple[Array, Array]:
        """Return the arguments ``kp`` and ``kd`` (m,) of :attr:`function`.

        Zero selects an automatic gain, which the function computes from the masses.
        """
        kp, kd = gains.diagonals(self.outputs.selection)
        return (kp, kd) if self.gain_units != ACCELERATION_GAINS else self._filled(kp, kd)

    def _filled(self, kp: Array, kd: Array) -> tuple[Array, Array]:
        """Return gains (m,) with zeros replaced by acceleration gains."""
        rate = self._damping_rate
        filled_kp = np.where(kp > 0, kp, _CRITICAL_STIFFNESS * rate**2)
        return filled_kp, np.where(kd > 0, kd, rate)

    def integrate_error(self, duration: float, *, limited: bool = False) -> None:
        """Integrate the error at the last command over ``duration`` (s).

        If the command was ``limited``, an integral may only shrink (anti-windup).
        """
        if not self.integrates:
            return
        error = self._out["error"]
        grows = error * self._integral >= 0.0
        added = np.where((self._ki == 0.0) | (grows & limited), 0.0, duration * error)
        self._integral += added
        self._in["integral"][:] = self._ki * self._integral

    def start(self, time: float, start: Reference, goal: Reference) -> None:
        """Restart the law: at ``time`` (s), the reference starts towards new goals.

        A stateful law overrides this method: it calls the method of the base class, then
        initialises its state.
        """
        self.reset_integral()

    def reset_integral(self) -> None:
        """Reset the error integral to zero."""
        self._integral[:] = self._in["integral"][:] = 0.0

    @property
    def gain_diagonals(self) -> tuple[Array, Array]:
        """The diagonals of Kp and Kd (m,), in the order of ``outputs.labels``.

        Automatic gains are per unit of mass or inertia.
        """
        return self._filled(self._in["kp"], self._in["kd"])

    @property
    def gain_matrices(self) -> tuple[Array, Array]:
        """Kp and Kd (m, m): :attr:`gain_diagonals` with couplings between outputs."""
        (kp, kd), (beside_p, beside_d) = self.gain_diagonals, self._couplings
        return np.diag(kp) + beside_p, np.diag(kd) + beside_d

    @property
    def takes_matrices(self) -> bool:
        """Whether gains may be matrices; they act through the law's integral term."""
        return self._has_integral

    def command(self, state: ControlState, reference: Reference) -> Actuation:
        """Return the unlimited thruster wrench and joint efforts.

        Raises
        ------
        TargetNotSetError
            The reference lacks an output group.
        NotFiniteError
            The state or the reference contains a non-finite value.
        ValueError
            A component of the state or the reference has the wrong length.
        """
        self.outputs.pack_state(state, self._in["state"])
        self.outputs.pack_reference(reference, self._in["reference"])
        if self.couples:
            # Errors also act on other outputs, via the argument for the integral.
            self._function.evaluate()
            between = zip(self._couplings, (self.error, self.error_rate), strict=True)
            self._in["integral"][:] = self._ki * self._integral + sum(K @ e for K, e in between)
        return self.actuation(reference)

    def slowest_decay(self) -> float:
        """Return the decay rate (1/s) of the error that decays slowest, near the last state with
        the robot at rest."""
        Kp, Kd, _ = self._acceleration_gains()
        m = self.outputs.m
        motion = np.block([[np.zeros((m, m)), np.eye(m)], [-Kp, -Kd]])
        return float(-np.linalg.eigvals(motion).real.max())

    def sampling_warning(self) -> str:
        """Return a warning if errors grow near the last state, with the robot at rest, when
        commands are held for a control period and arrive one period late; empty if errors decay.
        """
        Kp, Kd, mobility = self._acceleration_gains()
        m, h = self.outputs.m, self.control_period
        one, zero = np.eye(m), np.zeros((m, m))
        # Errors, their rates, and the accelerations due to the previous command.
        sampled = np.block([[one, h * one, h**2 / 2 * one], [zero, one, h * one], [-Kp, -Kd, zero]])
        growth, modes = np.linalg.eig(sampled)
        fastest = int(np.abs(growth).argmax())
        if np.abs(growth[fastest]) <= _LARGEST_GROWTH:
            return ""
        i = int(np.abs(modes[:m, fastest]).argmax())
        kp, kd = (gains[i] for gains in self.gain_diagonals)
        inertia = f", for an inertia (or mass) of {1 / mobility[i, i]:.1g}"
        return (
            f"The gains kp = {kp:g} and kd = {kd:g} of output '{self.outputs.labels[i]}'"
            f"{inertia if self.gain_units == FORCE_GAINS else ''} are too high for a control "
            f"period of {h:g} s: the sampled loop is unstable or nearly so. Lower them, set them "
            "to 0 (automatic), or raise tick_rate."
        )

    def _acceleration_gains(self) -> tuple[Array, Array, Array]:
        """Return the output accelerations (m, m) per error and per error rate, and their
        mobility (m, m), near the last state at rest.
        """
        Kp, Kd = self.gain_matrices
        J, q = self._out["J_z"], self.state.q
        H = self.robot.inertia_matrix(q)[3:, 3:]
        mobility = J[:, :3] @ J[:, :3].T / self.robot.total_mass
        mobility += J[:, 3:] @ np.linalg.solve(H, J[:, 3:].T)
        if self.gain_units != ACCELERATION_GAINS:
            # Automatic gains are already acceleration gains.
            given = [self._in[name] > 0 for name in ("kp", "kd")]
            Kp, Kd = (
                mobility @ np.where(is_given, K, 0.0) + np.where(is_given, 0.0, K)
                for is_given, K in zip(given, (Kp, Kd), strict=True)
            )
        return Kp, Kd, mobility

    @property
    def singular_error_share(self) -> float:
        """Fraction of the last error (norm, SI) in directions that no actuator can move."""
        error = self._out["error"]
        U, singular_values, _ = np.linalg.svd(self._out["J_z"], full_matrices=False)
        along = U[:, singular_values < self.singular_value_threshold].T @ error
        size = float(np.linalg.norm(error))
        return float(np.linalg.norm(along)) / size if size > 0 else 0.0

    @property
    def state(self) -> ControlState:
        """Copy of the state at the last command."""
        return ControlState.unstack(self._in["state"])

    @property
    def error(self) -> Array:
        """The error (m,) at the last command, in the order of ``outputs.labels``."""
        return self._out["error"].copy()

    def largest_error_share(self, bounds: Array) -> float:
        """Return the largest ratio of an error at the last command to its positive bound (m,)."""
        # NumPy's max, as Python's may hide a NaN, which must not count as reached.
        return float(np.abs(self._out["error"] / bounds).max(initial=0.0))

    @property
    def error_rate(self) -> Array:
        """The error rate (m,) at the last command."""
        return self._out["error_rate"].copy()

    @property
    def status(self) -> LawStatus:
        """Conditioning of the last command."""
        smallest = float(np.linalg.svd(self._out["J_z"], compute_uv=False)[-1])
        singular = smallest < self.singular_value_threshold
        return LawStatus(smallest, singular, self._damping(smallest))

    def _damping(self, singular_value: float) -> float:
        return 0.0

    def inputs(self) -> Mapping[str, npt.ArrayLike]:
        """Return the law's additional function arguments, by name, with their initial values.

        These arguments follow the state, reference and gains; :meth:`actuation` may change them in
        ``self._in``.
        """
        return {}

    @property
    def fixed_inputs(self) -> Mapping[str, npt.ArrayLike] | None:
        """Arguments of :attr:`function` other than state, reference and gains, if these are the
        same in all flights; None if some depend on the flight, or if the function does not compute
        the whole command.

        The latter is assumed if a law overrides a step of the command but not :meth:`is_complete`.
        """
        steps = min(map(self._owner, ("command", "actuation")))
        if steps < self._owner("is_complete"):
            return None
        integral = {"integral": np.zeros(self.outputs.m)}
        return {**integral, **self.inputs(), **self.robot.mass_arguments}

    def _owner(self, method: str) -> int:
        """Return the index, in the method resolution order, of the class that defines a method."""
        classes = type(self).__mro__
        return next(place for place, each in enumerate(classes) if method in vars(each))

    def is_complete(self, results: Mapping[str, ca.SX]) -> ca.SX:
        """Return whether :attr:`function` computes the complete command, without further steps."""
        return ca.SX(1)

    @abstractmethod
    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """Return expressions for the law's results, other than the errors and ``J_z``, by name.

        ``actuation`` (6 + n,) is the command: force (N) and torque (N m) at the base link origin in
        base components, then the joint efforts; other results are specific to the law.
        ``symbols`` contains ``kp``, ``kd`` and ``integral`` (m,), to be added to ``kp`` times the
        error, and one symbol per name of :meth:`inputs`; all other symbols are in ``self.outputs``.
        If ``actuation`` does not depend on ``integral``, the law rejects integral gains.
        """

    def actuation(self, reference: Reference) -> Actuation:
        """Evaluate the function and return the command; its inputs are in ``self._in``."""
        self._function.evaluate()
        actuation = self._out["actuation"].copy()
        return Actuation(actuation[:6], actuation[6:])
