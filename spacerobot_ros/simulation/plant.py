"""Plant interface, a base class for plant wrappers, and the initial state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import count_steps
from spacerobot_ros.model.model_functions import Composition
from spacerobot_ros.model.rotations import matrix_from_quaternion, unit_quaternion
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.loads import PlantLoads

Counts = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class Plant(Protocol):
    """A simulated robot that advances tick by tick; its attributes hold the state after the last
    tick.

    ``pose``
        (7,) position ``r_WB`` in m and quaternion ``R_WB`` (x, y, z, w) of the base link.
    ``twist``
        (6,) ``v_WB_B`` in m/s and ``omega_WB_B`` in rad/s.
    ``q``, ``qdot``
        (n,) joint positions (m or rad) and velocities (m/s or rad/s).
    ``effort``
        (n,) joint actuator efforts, N or N m.
    ``momentum``
        (7,) linear momentum (kg m/s), angular momentum about the system's centre of mass
        (kg m^2/s), both in W, and kinetic energy (J), summed over the bodies.
    ``expected_momenta``
        (6,) linear and angular momentum in W: initial value plus impulses of thrust and loads.
    ``link_R``, ``link_r``
        (3, 3 L) and (3, L): pose of each link in B, in the order of ``robot.link_names``.
    ``limit_counts``
        Number of ticks in which each joint (n,) was limited, by kind of limit.

    The arrays belong to the plant and change in place: copy any values you keep.
    """

    robot: SpaceRobot
    control_period: float
    """Duration of a tick, s."""
    initial: InitialState
    pose: Array
    twist: Array
    q: Array
    qdot: Array
    effort: Array
    momentum: Array
    expected_momenta: Array
    link_R: Array
    link_r: Array
    limit_counts: dict[str, Counts]

    def reset(self) -> None:
        """Return to the initial state; the limit counts are kept."""

    def hold(self, joints: Flags) -> None:
        """Lock the marked joints (n,) at their positions, and release all others."""

    def load(self, loads: PlantLoads) -> None:
        """Apply external loads; their values may change before each step."""

    @property
    def step(self) -> Callable[..., bool]:
        """Advance one tick under the plant's commands; return whether a joint was limited.

        Raises
        ------
        CommandError
            A command is not finite; the plant does not advance.
        SpaceRobotError
            The motion is no longer finite; only a plant in MuJoCo has advanced.
        """


class WrappedPlant:
    """Base class of plants that wrap another and share its state arrays; subclasses implement
    ``step``."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.robot, self.initial = plant.robot, plant.initial
        self.control_period = plant.control_period
        self.pose, self.twist = plant.pose, plant.twist
        self.momentum, self.expected_momenta = plant.momentum, plant.expected_momenta
        self.q, self.qdot, self.effort = plant.q, plant.qdot, plant.effort
        self.link_R, self.link_r = plant.link_R, plant.link_r
        self.limit_counts = plant.limit_counts

    def hold(self, joints: Flags) -> None:
        """Lock the marked joints (n,) at their positions, and release all others."""
        self.plant.hold(joints)

    def load(self, loads: PlantLoads) -> None:
        """Apply external loads; their values may change before each step."""
        self.plant.load(loads)

    def reset(self) -> None:
        """Return to the initial state."""
        self.plant.reset()


class CompiledPlant(ABC):
    """Base class of plants that compute each tick by one compiled function.

    Parameters
    ----------
    robot
        The model.
    control_period
        Duration of a tick, s.
    initial
        Initial state.
    integration_step
        Maximum Runge-Kutta step within a tick, s; None: the default of the plant.

    Raises
    ------
    ParameterError
        The initial configuration has the wrong length or violates joint limits, or a value is
        invalid.
    """

    actuation: ClassVar[str]
    """Value of the parameter ``actuation`` that selects the plant."""
    default_integration_step: ClassVar[float]
    """Default maximum Runge-Kutta step, s."""
    takes_wrench: ClassVar[bool]
    """Whether a step accepts a wrench on the base."""
    limits: ClassVar[tuple[str, str]]
    """Kinds of limits that the plant counts."""

    _h: Array
    """Input of the tick: its duration, s."""

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        initial: InitialState | None = None,
        integration_step: float | None = None,
    ) -> None:
        step = self.default_integration_step if integration_step is None else integration_step
        self.robot, self.control_period = robot, control_period
        self.initial = initial or InitialState()
        self._substeps = count_steps(control_period, step)
        self._advance = self._composed()
        self._tick = self._advance
        self.limit_counts = {each: np.zeros(robot.n, dtype=np.int64) for each in self.limits}
        self._bind(self._advance.inputs, self._advance.outputs)
        self.reset()

    @staticmethod
    @abstractmethod
    def tick_function(
        robot: SpaceRobot, model: Composition, substeps: int, *, loaded: bool = False
    ) -> ca.Function:
        """Compose the tick from model functions: limits, integration, and all published quantities.
        With ``loaded``, the external load vector is the last input."""

    @abstractmethod
    def _bind(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        """Name the inputs and outputs of the tick."""

    @abstractmethod
    def reset(self) -> None:
        """Return to the initial state; the limit counts are kept."""

    def _composed(
        self, prefix: str = "", inputs: Sequence[Array] = (), outputs: Sequence[Array] = ()
    ) -> BufferedFunction:
        robot, substeps = self.robot, self._substeps
        return robot.composed(
            f"{prefix}{self.actuation}_tick_{substeps}",
            lambda: self.tick_function(
                robot, robot.expressions(ca.MX), substeps, loaded=bool(prefix)
            ),
            inputs,
            outputs,
        )

    def _use_loads(self, loads: PlantLoads) -> None:
        """Apply loads from now on, by a tick in the memory of the tick without loads."""
        plain = self._advance
        self._tick = self._composed("loaded_", [*plain.inputs, loads.vector], plain.outputs)

    def _update_outputs(self) -> None:
        """Compute all outputs of the current state, by a tick of zero duration."""
        self._h[:] = 0.0
        self._advance.evaluate()
        self._h[:] = self.control_period


def body_outputs(
    model: Composition,
    q: ca.MX,
    quaternion: ca.MX,
    qdot: ca.MX,
    momenta: tuple[ca.MX, ca.MX],
    r_WC_W: ca.MX,
) -> tuple[ca.MX, ca.MX, list[Any]]:
    """Return the outputs of a state that all ticks compute: ``pose``, ``twist``, and a list of
    ``momentum``, ``link_R`` and ``link_r`` of a :class:`Plant`.

    The linear and angular ``momenta`` and the centre of mass ``r_WC_W`` (3,), m, are in W.
    """
    v, omega = model("base_twist", quaternion, q, qdot, *momenta)
    center = model("center_of_mass", q)
    pose = ca.vertcat(r_WC_W - model("rotate", quaternion, center), quaternion)
    momentum = model("momentum", quaternion, q, v, omega, qdot)
    return pose, ca.vertcat(v, omega), [ca.vertcat(*momentum), *model("link_poses", q)]


@dataclass(frozen=True)
class InitialState:
    """Initial plant state: base pose in W (m; quaternion x, y, z, w), configuration, momenta in W.

    ``joint_positions`` None means zero, or the nearest limit if a joint's range excludes zero.
    ``angular_momentum`` (kg m^2/s) is about the system's centre of mass. ``joint_velocities`` None
    means zero; the base twist follows from the joint velocities and the momenta. ``center_of_mass``
    (m, in W) positions the system's centre of mass instead of the base link.

    Raises
    ------
    ParameterError
        Both ``position`` and ``center_of_mass`` are set. The methods raise it if the quaternion is
        zero, a value is not finite, the number of joint values is wrong, or a joint position
        violates its limits.
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
        """Return the configured initial state; empty lists select defaults.

        Raises
        ------
        ParameterError
            The position is specified twice.
        """
        return cls(
            position=np.array(config.initial_position or (0.0, 0.0, 0.0)),
            quaternion=np.array(config.initial_orientation or (0.0, 0.0, 0.0, 1.0)),
            joint_positions=_array_or_none(config.initial_joint_positions),
            linear_momentum=np.array(config.linear_momentum or (0.0, 0.0, 0.0)),
            angular_momentum=np.array(config.angular_momentum or (0.0, 0.0, 0.0)),
            joint_velocities=_array_or_none(config.initial_joint_velocities),
            center_of_mass=_array_or_none(config.initial_center_of_mass),
        )

    @classmethod
    def of_motion(cls, pose: Array, q: Array, qdot: Array | None, momenta: Array) -> InitialState:
        """Return the state with a base pose (7,), joint positions and velocities (n,), and linear
        and angular momentum in the first six ``momenta``; the arrays are copied."""
        momenta, rates = momenta.copy(), None if qdot is None else qdot.copy()
        return cls(pose[:3].copy(), pose[3:].copy(), q.copy(), momenta[:3], momenta[3:6], rates)

    def __post_init__(self) -> None:
        if self.center_of_mass is not None and np.any(self.position):
            raise ParameterError(
                "The initial position is set for both the base and the centre of mass: omit one "
                "of them."
            )

    def attitude(self) -> Array:
        """Return the unit quaternion (x, y, z, w) of the base attitude.

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
        """Return linear and angular momentum (6,).

        Raises
        ------
        ParameterError
            A momentum is not finite.
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
            The number of joints is wrong, or a position violates its limits.
        """
        if self.joint_positions is None:
            return np.clip(np.zeros(robot.n), robot.lower, robot.upper)
        q = _require_joint_values(robot, self.joint_positions, "positions")
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
            The number of joints is wrong, or a velocity is not finite.
        """
        if self.joint_velocities is None:
            return np.zeros(robot.n)
        return _require_joint_values(robot, self.joint_velocities, "velocities")

    def system_position(self, robot: SpaceRobot) -> Array:
        """Return the position of the system's centre of mass in W (3,), m.

        Raises
        ------
        ParameterError
            The position is not finite, or the configuration or the orientation is invalid.
        """
        if self.center_of_mass is not None:
            r_WC_W = np.asarray(self.center_of_mass, dtype=float)
        else:
            R_WB = matrix_from_quaternion(self.attitude())
            r_WC_W = self.position + R_WB @ robot.center_of_mass(self.shape(robot))
        if not np.all(np.isfinite(r_WC_W)):
            raise ParameterError("The initial position must be finite.")
        return r_WC_W


def _array_or_none(values: tuple[float, ...]) -> Array | None:
    return np.array(values) if values else None


def _require_joint_values(robot: SpaceRobot, given: Array, quantity: str) -> Array:
    values = np.asarray(given, dtype=float)
    if values.shape != (robot.n,):
        raise ParameterError(
            f"There are {values.size} initial joint {quantity}; robot "
            f"'{robot.description.name}' has {robot.n} joints: {', '.join(robot.joint_names)}."
        )
    if not np.all(np.isfinite(values)):
        raise ParameterError(f"The initial joint {quantity} must be finite, not {values.tolist()}.")
    return values
