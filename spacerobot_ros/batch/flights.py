"""A flight batch: shared values, values per flight, and results.

Rows are flights. A row contains the values of :class:`.PlantConfig`, :class:`.InitialState` and
:class:`.SensorConfig` for one flight; with the same values, the plant flies the same flight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.goal_monitor import Decision
from spacerobot_ros.control.laws.law import Gains
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.integration import count_steps
from spacerobot_ros.model.rotations import quaternion_multiply, quaternions_from_rotvecs
from spacerobot_ros.simulation.actuators import PLANTS
from spacerobot_ros.simulation.config import SensorConfig
from spacerobot_ros.simulation.plant import InitialState, Plant
from spacerobot_ros.simulation.sensors import NOISE_PARAMETERS
from spacerobot_ros.times import SECOND

Counts = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

NOISES = tuple(NOISE_PARAMETERS.values())
""":class:`.SensorConfig` parameters in the column order of :attr:`SensorErrors.noise`."""


@dataclass(frozen=True)
class InitialStates:
    """Initial states, one row per flight; see :class:`.InitialState`."""

    position: Array
    """(N, 3) position of the base link, or, with ``position_is_of_center_of_mass``, of the system's
    centre of mass, in W, m."""
    quaternion: Array
    """(N, 4) unit quaternions (x, y, z, w) of ``R_WB``."""
    q: Array
    """(N, n) joint positions, m or rad."""
    qdot: Array
    """(N, n) joint rates, m/s or rad/s."""
    momenta: Array
    """(N, 6) total momenta in W: linear (kg m/s), then angular about the centre of mass (kg
    m^2/s)."""
    position_is_of_center_of_mass: npt.NDArray[np.bool_]
    """(N,) whether ``position`` is the position of the centre of mass."""

    @classmethod
    def of(cls, robot: SpaceRobot, initial: Sequence[InitialState]) -> InitialStates:
        """Return initial states as rows.

        Raises
        ------
        ParameterError
            The plant would reject an initial state.
        """
        is_center_of_mass = [each.center_of_mass is not None for each in initial]
        positions = [
            each.position if each.center_of_mass is None else each.center_of_mass
            for each in initial
        ]
        return cls(
            np.array(positions, dtype=float).reshape(-1, 3),
            np.array([each.attitude() for each in initial]).reshape(-1, 4),
            np.array([each.shape(robot) for each in initial]).reshape(len(initial), robot.n),
            np.array([each.rates(robot) for each in initial]).reshape(len(initial), robot.n),
            np.array([each.momenta() for each in initial]).reshape(-1, 6),
            np.array(is_center_of_mass, dtype=np.bool_),
        )

    @classmethod
    def repeated(cls, robot: SpaceRobot, initial: InitialState, count: int) -> InitialStates:
        """Return ``count`` identical rows; the caller may overwrite columns.

        Raises
        ------
        ParameterError
            The plant would reject the initial state.
        """
        return cls.of(robot, [initial] * count)

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: Counts) -> InitialStates:
        """Return the selected rows, in any order and number."""
        return InitialStates(*(getattr(self, each.name)[rows] for each in fields(self)))

    def initial_state(self, index: int) -> InitialState:
        """Return one row as an initial plant state."""
        is_center_of_mass = bool(self.position_is_of_center_of_mass[index])
        state = InitialState(
            quaternion=self.quaternion[index],
            joint_positions=self.q[index],
            joint_velocities=self.qdot[index],
            linear_momentum=self.momenta[index, :3],
            angular_momentum=self.momenta[index, 3:],
            center_of_mass=self.position[index] if is_center_of_mass else None,
        )
        return state if is_center_of_mass else replace(state, position=self.position[index])


@dataclass(frozen=True)
class SensorErrors:
    """Sensor errors, one row per flight; see :class:`.SensorConfig`."""

    noise: Array
    """(N, 6) 1 sigma by group: position (m), attitude (rad), velocity (m/s), angular velocity
    (rad/s), joints (m or rad), joint rates."""
    pose_bias: Array
    """(N, 6) pose biases: position in W (m), then rotation vector in B (rad)."""
    joint_bias: Array
    """(N, n) joint position biases, m or rad."""
    seeds: Counts
    """(N,) noise seeds; :class:`.Sensors` draws the same noise from the same seed."""

    @classmethod
    def of(cls, robot: SpaceRobot, each: Sequence[SensorConfig]) -> SensorErrors:
        """Return sensor configurations as rows."""
        zero = (0.0, 0.0, 0.0)
        return cls(
            np.array([[getattr(one, name) for name in NOISES] for one in each]).reshape(-1, 6),
            np.array(
                [[*(one.position_bias or zero), *(one.attitude_bias or zero)] for one in each]
            ).reshape(-1, 6),
            np.array([one.joint_bias or (0.0,) * robot.n for one in each]).reshape(
                len(each), robot.n
            ),
            np.array([one.seed for one in each], dtype=np.int64),
        )

    def __len__(self) -> int:
        return len(self.seeds)

    def __getitem__(self, rows: Counts) -> SensorErrors:
        """Return the selected rows, in any order and number."""
        return SensorErrors(*(getattr(self, each.name)[rows] for each in fields(self)))

    def measure(
        self, normals: Array, pose: Array, twist: Array, q: Array, qdot: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return measurements of poses (N, 7), twists (N, 6), and joint positions and rates (N, n).

        ``normals`` (N, 12 + 2 n) are random numbers in the order of :class:`.Sensors`.
        """
        n, sigma = q.shape[1], self.noise
        turns = self.pose_bias[:, 3:] + sigma[:, 1:2] * normals[:, 3:6]
        position = pose[:, :3] + self.pose_bias[:, :3] + sigma[:, :1] * normals[:, :3]
        attitude = quaternion_multiply(pose[:, 3:], quaternions_from_rotvecs(turns))
        return (
            np.hstack([position, attitude]),
            twist + np.repeat(sigma[:, 2:4], 3, axis=1) * normals[:, 6:12],
            q + self.joint_bias + sigma[:, 4:5] * normals[:, 12 : 12 + n],
            qdot + sigma[:, 5:] * normals[:, 12 + n :],
        )

    @property
    def is_active(self) -> npt.NDArray[np.bool_]:
        """(N,) whether measurements differ from the true values; noise is drawn only if they do."""
        return np.asarray(
            self.noise.any(axis=1) | self.pose_bias.any(axis=1) | self.joint_bias.any(axis=1)
        )


R = TypeVar("R", InitialStates, SensorErrors, InertialParameters)


def joined_rows(each: Sequence[R]) -> R:
    """Return one object with the concatenated rows of several objects."""
    names = [part.name for part in fields(each[0])]
    parts = (np.concatenate([getattr(one, name) for one in each]) for name in names)
    return type(each[0])(*parts)


def assign_rows(to: R, rows: Counts, values: R) -> None:
    """Replace the selected rows in place."""
    for part in fields(to):
        getattr(to, part.name)[rows] = getattr(values, part.name)


@dataclass(frozen=True)
class FollowedSchedule:
    """Velocity commands of the planner's :class:`.ScheduleFollower` along a schedule."""

    positions: Array
    """(T + 1, n) shapes at the ticks, or (N, T + 1, n) for each flight; the last shape is held."""
    shape_gain: float = 0.0
    """Feedback from measured shape errors to velocities, 1/s; 0: open loop."""
    deadband: float = 0.0
    """Shape errors up to this value are not fed back, m or rad."""


@dataclass(frozen=True)
class HeldCommands:
    """Prescribed commands for each tick, independent of measurements."""

    table: Array
    """(T, command_size) or (N, T, command_size); see :attr:`Flights.command_size`. Zero after the
    last."""


@dataclass(frozen=True)
class ControlledGoals:
    """Commands of a :class:`.CoordinatedController` whose goals are set at the first state."""

    config: ControllerConfig
    """Controller parameters, shared by all flights; their gains apply if ``gains`` is empty."""
    base: Array | None = None
    """Goals in W, (7,) or (N, 7): position (m) and quaternion; None: the initial pose is held."""
    end_effector: Array | None = None
    """End-effector goals, in the same form as the base goals."""
    joints: Array | None = None
    """Goal shapes, (n,) or (N, n); None: the initial shapes."""
    gains: tuple[Gains, ...] = ()
    """Gains of each flight; empty: the gains in ``config``."""
    robot: SpaceRobot | None = None
    """Robot model used by the controller; None: the nominal robot of the flights."""
    ends_when_decided: bool = False
    """Whether a flight ends when its goal is decided: one tick later, after the command for that
    state. Otherwise the flight continues and holds the goal."""


FlightProgram = FollowedSchedule | HeldCommands | ControlledGoals


@dataclass(frozen=True)
class Flights:
    """N flights of one robot that differ only in numerical values.

    Raises
    ------
    ParameterError
        Some values are inconsistent; the message names them.
    RobotDescriptionError
        A mass or an inertia is not physical.
    """

    robot: SpaceRobot
    """The robot."""
    actuation: str
    """``velocity`` or ``effort``."""
    control_period: float
    """Duration of a tick, s."""
    ticks: int
    """Ticks of each flight."""
    initial_states: InitialStates
    """Initial states, one row per flight."""
    program: FlightProgram
    """Source of the commands."""
    inertial: InertialParameters | None = None
    """Masses, centres of mass and inertias, (N, ...); None: those of ``robot``."""
    sensors: SensorErrors | None = None
    """Sensor errors; None: none."""
    integration_step: float = 0.0
    """Longest Runge-Kutta step, s; 0: the default of the actuation."""
    report_ticks: tuple[int, ...] = field(default=())
    """Ticks after which the state is reported, ascending; 0 is the start. Empty: only the end."""

    def __post_init__(self) -> None:
        count, robot = len(self), self.robot
        if self.actuation not in PLANTS:
            raise ParameterError(f"The actuation is '{self.actuation}', not velocity or effort.")
        if self.ticks < 1:
            raise ParameterError(f"A flight of {self.ticks} ticks is too short: use at least 1.")
        if not self.report_ticks:
            object.__setattr__(self, "report_ticks", (self.ticks,))
        match self.program:
            case FollowedSchedule(positions=positions):
                if self.actuation != "velocity":
                    raise ParameterError("A schedule requires velocity actuation.")
                _require_rows("positions", positions, count, robot.n)
            case HeldCommands(table=table):
                _require_rows("commands", table, count, self.command_size)
            case ControlledGoals(config=config, gains=gains):
                if robot.description.wheel_names:
                    raise ParameterError(
                        f"Robot '{robot.description.name}' has reaction wheels, which lanes do "
                        "not support: use engine 'flights'."
                    )
                if self.actuation != "effort":
                    raise ParameterError("A controller requires effort actuation.")
                if round(config.control_period * SECOND) != round(self.control_period * SECOND):
                    raise ParameterError("The controller and the plant have different rates.")
                if gains and len(gains) != count:
                    raise ParameterError(f"There are gains for {len(gains)} flights, not {count}.")
        limits = (-1, *self.report_ticks, self.ticks + 1)
        if list(limits) != sorted(set(limits)):
            raise ParameterError(
                f"The instants {self.report_ticks} are not ascending ticks of a flight of "
                f"{self.ticks} ticks."
            )
        if self.inertial is not None:
            bodies = robot.description.bodies
            if self.inertial.masses.shape != (count, len(bodies)):
                raise ParameterError(
                    f"The masses have shape {self.inertial.masses.shape}, not "
                    f"({count}, {len(bodies)})."
                )
            self.inertial.require_physical([body.name for body in bodies])
        if self.sensors is not None and len(self.sensors) != count:
            raise ParameterError(f"There are sensors for {len(self.sensors)} flights, not {count}.")
        if self.actuation == "velocity" and self.initial_states.qdot.any():
            raise ParameterError("Joints under velocity commands must start at rest.")

    def __len__(self) -> int:
        return len(self.initial_states)

    @property
    def command_size(self) -> int:
        """Size of a command: n joint velocities, or n efforts and a wrench (6) on the base: force
        (N), then torque (N m), in the base frame."""
        return self.robot.n + (6 if PLANTS[self.actuation].takes_wrench else 0)

    @property
    def substeps(self) -> int:
        """Number of Runge-Kutta steps in a tick."""
        step = self.integration_step or PLANTS[self.actuation].default_integration_step
        return count_steps(self.control_period, step)

    @property
    def table(self) -> Array:
        """Commands or shapes (ticks, width) or (N, ticks, width); zeros if a controller computes
        the commands."""
        match self.program:
            case FollowedSchedule(positions=table) | HeldCommands(table=table):
                return table
        return np.zeros((1, self.command_size))

    def robot_of(self, index: int) -> SpaceRobot:
        """Return the robot of one flight."""
        if self.inertial is None:
            return self.robot
        return self.robot.with_inertial(self.inertial[index])


def _require_rows(name: str, array: Array, count: int, width: int) -> None:
    if array.ndim not in (2, 3) or array.shape[-1] != width or array.shape[-2] < 1:
        raise ParameterError(f"The {name} have shape {array.shape}, not (ticks, {width}).")
    if array.ndim == 3 and len(array) != count:
        raise ParameterError(f"There are {name} for {len(array)} flights, not {count}.")
    if not np.all(np.isfinite(array)):
        raise ParameterError(f"The {name} contain a value that is not finite.")


def state_size(n: int) -> int:
    """Return the size of a state of a robot with n joints."""
    return 2 * n + 20


def state_parts(states: Array, n: int) -> dict[str, Array]:
    """Return the components of states (..., 2 n + 20) as views: q, qdot, pose, twist, momentum."""
    names = ("q", "qdot", "pose", "twist", "momentum")
    ends = np.cumsum([0, n, n, 7, 6, 7]).tolist()
    return {
        name: states[..., first:last]
        for name, first, last in zip(names, ends[:-1], ends[1:], strict=True)
    }


def plant_of(flights: Flights, row: int) -> Plant:
    """Return the plant of one flight in its start state.

    Raises
    ------
    SpaceRobotError
        The plant rejects the start state.
    """
    return PLANTS[flights.actuation](
        flights.robot_of(row),
        flights.control_period,
        flights.initial_states.initial_state(row),
        flights.integration_step or None,
    )


def split_command(flights: Flights, command: Array) -> list[Array]:
    """Return a command as arguments of a plant's step."""
    n = flights.robot.n
    return [command] if flights.actuation == "velocity" else [command[:n], command[n:]]


def state_of(plant: Plant) -> Array:
    """Return the state (2 n + 20,) of a plant."""
    return np.concatenate([plant.q, plant.qdot, plant.pose, plant.twist, plant.momentum])


@dataclass(frozen=True)
class BatchResult:
    """Results of N flights at I reported instants."""

    engine: str
    """Name of the engine that flew the flights."""
    time: Array
    """(I,) s."""
    states: Array
    """(N, I, 2 n + 20) all of the following arrays up to ``momentum``, in the order of
    :func:`state_parts`."""
    pose: Array
    """(N, I, 7) position ``r_WB`` (m) and quaternion ``R_WB`` (x, y, z, w) of the base."""
    twist: Array
    """(N, I, 6) ``v_WB_B`` (m/s) and ``omega_WB_B`` (rad/s)."""
    q: Array
    """(N, I, n) joint positions, m or rad."""
    qdot: Array
    """(N, I, n) joint rates, m/s or rad/s."""
    momentum: Array
    """(N, I, 7) linear (kg m/s) and angular momentum about the centre of mass (kg m^2/s), both in
    W, and kinetic energy (J)."""
    measured_pose: Array
    """(N, I, 7) ``pose`` as measured by the sensors."""
    measured_q: Array
    """(N, I, n) ``q`` as measured by the sensors."""
    peak_rate: Array
    """(N, n) largest joint rate at the end of a tick, m/s or rad/s."""
    peak_effort: Array
    """(N, n) largest joint effort in a tick, N or N m."""
    peak_wrench: Array
    """(N, 2) largest force (N) and torque (N m) commanded on the base."""
    limited_ticks: Mapping[str, Counts]
    """(N, n) numbers of ticks in which each joint was limited, by limit type, as in the plant."""
    fallback_ticks: Counts
    """(N,) numbers of ticks in which a step was computed outside the lanes."""
    lowest: Array
    """(N, n) smallest joint positions over all ticks."""
    highest: Array
    """(N, n) largest joint positions over all ticks."""
    decision: Counts
    """(N,) first :class:`.Decision` about the goal of a controller."""
    decision_tick: Counts
    """(N,) tick of the state at that decision; -1: no decision."""
    decision_distance: Array
    """(N, 3) the :class:`.OutputDistance` to the goal at that state; NaN without a decision."""
    end_tick: Counts
    """(N,) number of flown ticks."""
    end_state: Array
    """(N, 2 n + 20) the last state: q, qdot, pose, twist and momentum; NaN without a controller."""
    momentum_drift: Array
    """(N, 2) largest change in linear and angular momentum not explained by thrust; NaN
    without a controller."""
    failures: dict[int, str]
    """Error messages of failed flights, by row; the later values of these flights are NaN."""

    @classmethod
    def empty(cls, flights: Flights) -> BatchResult:
        """Return an empty result to be filled by the flights."""
        N, n = len(flights), flights.robot.n
        instants = N, len(flights.report_ticks)
        states = np.full((*instants, state_size(n)), np.nan)
        first = {"velocity": "rate", "effort": "effort"}[flights.actuation]
        return cls(
            engine="",
            time=np.array(flights.report_ticks) * flights.control_period,
            states=states,
            **state_parts(states, n),
            measured_pose=np.full((*instants, 7), np.nan),
            measured_q=np.full((*instants, n), np.nan),
            peak_rate=np.zeros((N, n)),
            peak_effort=np.zeros((N, n)),
            peak_wrench=np.zeros((N, 2)),
            limited_ticks={name: np.zeros((N, n), np.int64) for name in (first, "stroke")},
            fallback_ticks=np.zeros(N, np.int64),
            lowest=flights.initial_states.q.copy(),
            highest=flights.initial_states.q.copy(),
            decision=np.full(N, Decision.NONE, np.int64),
            decision_tick=np.full(N, -1, np.int64),
            decision_distance=np.full((N, 3), np.nan),
            end_tick=np.full(N, flights.ticks, np.int64),
            end_state=np.full((N, state_size(n)), np.nan),
            momentum_drift=np.full((N, 2), np.nan),
            failures={},
        )

    def errors(self, position: Array, quaternion: Array) -> tuple[Array, Array]:
        """Return distance (N, I) in m and angle (N, I) in rad to a pose, position (3,) and
        quaternion (4,), or to one pose per flight, (N, 3) and (N, 4).
        """
        wanted = np.broadcast_to(position, (len(self.pose), 3))[:, None]
        attitude = np.broadcast_to(quaternion, (len(self.pose), 4))[:, None]
        x, y = self.pose[..., 3:6], attitude[..., :3]
        a, b = self.pose[..., 6:], attitude[..., 3:]
        vector = np.linalg.norm(a * y - b * x - np.cross(x, y), axis=-1)
        scalar = np.abs((x * y).sum(axis=-1) + (a * b)[..., 0])
        distance = np.linalg.norm(self.pose[..., :3] - wanted, axis=-1)
        return distance, 2 * np.arctan2(vector, scalar)
