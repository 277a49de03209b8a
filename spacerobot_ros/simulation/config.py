"""Plant parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.grasp import RelativeMotion
from spacerobot_ros.model.shared_parameters import DEFAULT_TICK_RATE, RobotConfig
from spacerobot_ros.parameters import WatchdogConfig, group, nonnegative, parameter
from spacerobot_ros.times import SECOND

_MAX_SENSOR_ERROR = 1e6
"""Largest sensor error, m or rad (/s): the squares of much larger errors would overflow."""

_MAX_INITIAL_VALUE = 1e9
"""Largest initial state value and longest time, SI units."""

_CONTACT_PERIOD = 0.1
"""Longest simulated time between contact checks, s."""


def period_ns(tick_rate: float) -> int:
    """Return the duration of a tick, ns; stamps are whole multiples of it."""
    return round(SECOND / tick_rate)


def _noise(description: str, unit: str) -> Any:
    return nonnegative(0.0, description, unit, maximum=_MAX_SENSOR_ERROR)


def _bias(description: str, unit: str, default: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Any:
    """Return a bias parameter with the length of its default, or of any length for ()."""
    bound = _MAX_SENSOR_ERROR
    return parameter(
        default, description, unit, minimum=-bound, maximum=bound, length=len(default) or None
    )


def _initial(
    description: str,
    unit: str,
    default: tuple[float, ...] = (0.0, 0.0, 0.0),
    length: int | None = 3,
) -> Any:
    bound = _MAX_INITIAL_VALUE
    return parameter(default, description, unit, minimum=-bound, maximum=bound, length=length)


def _orientation(description: str) -> Any:
    return parameter((0.0, 0.0, 0.0, 1.0), description, length=4)


def _time(default: float, description: str) -> Any:
    return nonnegative(default, description, "s", maximum=_MAX_INITIAL_VALUE)


@dataclass(frozen=True)
class SensorConfig:
    """Sensor errors: noise standard deviations, biases, and the seed."""

    position_noise: float = _noise("1 sigma of the odom position, per world axis", "m")
    attitude_noise: float = _noise(
        "1 sigma of the attitude, per axis of a rotation vector in the base frame", "rad"
    )
    velocity_noise: float = _noise("1 sigma of the linear velocity, per axis", "m/s")
    angular_velocity_noise: float = _noise("1 sigma of the angular velocity, per axis", "rad/s")
    joint_noise: float = _noise("1 sigma of every joint position", "m or rad")
    joint_rate_noise: float = _noise("1 sigma of every joint velocity", "m/s or rad/s")
    position_bias: tuple[float, ...] = _bias("bias of the odom position, in world axes", "m")
    attitude_bias: tuple[float, ...] = _bias(
        "bias of the attitude, as a rotation vector in the base frame", "rad"
    )
    joint_bias: tuple[float, ...] = _bias("biases in URDF joint order; []: none", "m or rad", ())
    seed: int = nonnegative(0, "seed of the sensor and actuator noise")


@dataclass(frozen=True)
class TargetSensorConfig:
    """Errors in target/odom: noise standard deviations, biases, delay, loss and rate."""

    position_noise: float = _noise("1 sigma of the position in target/odom, per axis", "m")
    attitude_noise: float = _noise(
        "1 sigma of the attitude, per axis of a rotation vector in the root link frame", "rad"
    )
    velocity_noise: float = _noise("1 sigma of the linear velocity, per axis", "m/s")
    angular_velocity_noise: float = _noise("1 sigma of the angular velocity, per axis", "rad/s")
    position_bias: tuple[float, ...] = _bias(
        "bias of the position in target/odom, in the rotating root link frame", "m"
    )
    attitude_bias: tuple[float, ...] = _bias(
        "bias of the attitude, as a rotation vector in the root link frame", "rad"
    )
    delay: float = nonnegative(
        0.0, "age of the state in target/odom, in whole ticks", "s", maximum=60.0
    )
    loss: float = nonnegative(0.0, "fraction of measurements lost at random", maximum=1.0)
    rate: float = nonnegative(
        0.0,
        "number of measurements per second; the interval must be a whole number of ticks; 0: one "
        "every tick",
        "Hz",
        maximum=100000.0,
    )


@dataclass(frozen=True)
class TargetConfig:
    """A free-floating target: its URDF, its grapple frame and its initial state."""

    robot: str = parameter("", "URDF file of the target, whose joints are locked; '': no target")
    robot_description: str = parameter(
        "", "URDF of the target as a string; takes precedence over 'target.robot'"
    )
    joint_positions: tuple[float, ...] = _initial(
        "positions of the locked target joints, in the joint order of the target's URDF; []: zero",
        "m or rad",
        (),
        length=None,
    )
    grapple_frame: str = parameter("grapple", "link of the target at which it is captured")
    position: tuple[float, ...] = _initial(
        "initial position of the target's root link in the world", "m"
    )
    orientation: tuple[float, ...] = _orientation("initial orientation, quaternion x, y, z, w")
    velocity: tuple[float, ...] = _initial(
        "velocity of the origin of the target's root link, in the world frame", "m/s"
    )
    angular_velocity: tuple[float, ...] = _initial("angular velocity, in the world frame", "rad/s")

    sensors: TargetSensorConfig = group(TargetSensorConfig())

    @property
    def given(self) -> bool:
        """Whether there is a target."""
        return bool(self.robot or self.robot_description)


@dataclass(frozen=True)
class CaptureConfig:
    """Capture conditions: the trigger (manual or automatic) and the bounds."""

    mode: str = parameter(
        "manual",
        "manual: the service ~/capture captures the target; automatic: the plant captures it as "
        "soon as possible",
        choices=("manual", "automatic"),
    )
    end_effector: str = parameter(
        "",
        "link that captures the target; '': the link in end_effector_frame or, if that is "
        "empty, 'end_effector'",
    )
    distance: float = nonnegative(0.05, "largest distance of the grapple frame from the link", "m")
    angle: float = nonnegative(0.2, "largest angle between the two frames", "rad")
    speed: float = nonnegative(
        0.1, "largest speed of the grapple frame relative to the link", "m/s"
    )
    rate: float = nonnegative(0.1, "largest relative angular rate of the two frames", "rad/s")
    joint_impulse_limit: float = nonnegative(
        0.0, "joint impulse above which the capture event is a warning; 0: no limit", "N m s or N s"
    )

    def misses(self, approach: RelativeMotion) -> list[str]:
        """Return a clause for each quantity that exceeds its limit; none if a capture is
        possible."""
        return [
            f"{name} is {value:.4g} {unit}, {value - limit:.4g} {unit} more than "
            f"'capture.{name}', {limit:g}"
            for name, unit, value, limit in (
                ("distance", "m", approach.distance, self.distance),
                ("angle", "rad", approach.angle, self.angle),
                ("speed", "m/s", approach.speed, self.speed),
                ("rate", "rad/s", approach.rate, self.rate),
            )
            if not value <= limit
        ]


@dataclass(frozen=True)
class OrbitConfig:
    """A circular orbit on which the world frame origin is in free fall."""

    altitude: float = nonnegative(
        0.0,
        "height above the Earth's equatorial radius; 0: no orbit, unless mean_motion is set",
        "m",
        maximum=_MAX_INITIAL_VALUE,
    )
    mean_motion: float = nonnegative(
        0.0, "mean motion of the orbit; can be set instead of altitude", "rad/s", maximum=100.0
    )
    orientation: tuple[float, ...] = _orientation(
        "orientation of the orbital frame in the world at time zero (x radially outward, z along "
        "the orbit normal), quaternion x, y, z, w"
    )


@dataclass(frozen=True)
class TableConfig:
    """An air-bearing table in the world's x-y plane, for planar robots."""

    tilt: float = nonnegative(0.0, "tilt of the table", "rad", maximum=1.5707963)
    direction: float = parameter(
        0.0,
        "downhill direction in the x-y plane, as an angle from the x axis",
        "rad",
        minimum=-6.2831854,
        maximum=6.2831854,
    )
    gravity: float = nonnegative(9.80665, "acceleration of gravity", "m/s^2", maximum=1000.0)
    friction: float = nonnegative(
        0.0,
        "viscous bearing friction: force on a body divided by its momentum",
        "1/s",
        maximum=1000.0,
    )


@dataclass(frozen=True)
class PlantConfig(WatchdogConfig, RobotConfig):
    """Plant parameters: actuation, time, limits, initial state, faults and sensors."""

    actuation: str = parameter(
        "auto",
        "type of joint_commands; auto: the type of the first non-zero command",
        choices=("auto", "velocity", "effort"),
    )
    engine: str = parameter(
        "exact",
        "motion integrator: the package's own equations (no contacts) or MuJoCo (with contacts)",
        choices=("exact", "mujoco"),
    )
    time_mode: str = parameter(
        "realtime",
        "what advances time: the commands or the wall clock",
        choices=("realtime", "lockstep"),
    )
    tick_rate: float = parameter(
        DEFAULT_TICK_RATE, "ticks per simulated second", "Hz", minimum=0.001, maximum=100000.0
    )
    real_time_factor: float = parameter(
        1.0, "simulated over wall time", minimum=0.001, maximum=1000.0
    )
    command_timeout: float = _time(0.5, "realtime: age at which commands expire; 0: never")
    beyond_limits: str = parameter(
        "clip", "handling of commands beyond the URDF's limits", choices=("clip", "refuse")
    )
    second_commander: str = parameter(
        "refuse",
        "realtime: how a second command for the same state is handled if several nodes publish "
        "commands",
        choices=("refuse", "accept"),
    )
    latched_faults: str = parameter(
        "second_commander",
        "refusal reasons that latch a fault until ~/rearm, separated by spaces: malformed "
        "not_finite stale early unknown_state out_of_order beyond_limits second_commander",
    )
    watchdog_action: str = parameter(
        "report",
        "reaction to a silent commander: report only, or also latch a fault",
        choices=("report", "latch"),
    )
    integration_step: float = _time(
        0.0,
        "maximum integration step; 0: 0.01 s (velocity actuation) or 0.001 s (effort actuation)",
    )
    thrusters: str = parameter(
        "",
        "source of the thruster table: 'urdf' (the robot's URDF) or a YAML file; "
        "'': no thrusters, any wrench is realised",
    )
    thrusters_excluded: str = parameter("", "space-separated names of disabled thrusters")
    world_frame: str = parameter("world", "name of the inertial frame")
    end_effector_frame: str = parameter(
        "", "link whose pose is published on end_effector_pose; '': 'end_effector', if it exists"
    )
    end_effectors: tuple[str, ...] = parameter(
        (), "links whose measured poses are published on NAME/pose", texts=True
    )
    base_pose_period: float = _time(
        0.0, "simulated time between poses; 0: every tick. Realtime: at most 0.5 s of wall time"
    )
    marker_period: float = _time(
        0.5, "simulated time between marker messages; 0: none. Realtime: at most 0.5 s of wall time"
    )
    tf_period: float = _time(
        0.1,
        "simulated time between transforms on /tf; 0: none. Realtime: at most 0.1 s of wall time",
    )
    tf_links: bool = parameter(
        True,
        "whether the transforms of all links are published on /tf; false: only that of the base, "
        "for use with robot_state_publisher",
    )
    frame_prefix: str = parameter(
        "",
        "prefix for the names of the robot's frames, such as 'robot_1/'; world_frame gets no "
        "prefix. '': none, or 'robot/' if a link is named like world_frame",
    )
    diagnostics_period: float = _time(
        1.0,
        "simulated time between diagnostics; 0: none. Realtime: at least once per second of wall "
        "time; a paused plant publishes once per second of wall time",
    )
    clearance_period: float = _time(
        1.0,
        "simulated time between clearance messages (smallest distance between links); 0: none. "
        "Realtime: at most 0.5 s of wall time",
    )
    resume_bag: str = parameter(
        "", "bag from whose last state and time the plant continues; '': the initial state"
    )
    initial_position: tuple[float, ...] = _initial("position of the base link in the world", "m")
    initial_orientation: tuple[float, ...] = _orientation("quaternion x, y, z, w")
    initial_joint_positions: tuple[float, ...] = _initial(
        "joint positions in URDF joint order; []: zero", "m or rad", (), length=None
    )
    initial_joint_velocities: tuple[float, ...] = _initial(
        "joint velocities in URDF joint order, for effort actuation only; []: zero",
        "m/s or rad/s",
        (),
        length=None,
    )
    initial_center_of_mass: tuple[float, ...] = _initial(
        "position of the system's centre of mass in the world, instead of initial_position", "m", ()
    )
    linear_momentum: tuple[float, ...] = _initial(
        "total linear momentum, in the world frame", "kg m/s"
    )
    angular_momentum: tuple[float, ...] = _initial(
        "total angular momentum about the centre of mass, in the world frame", "kg m^2/s"
    )
    faults: tuple[str, ...] = parameter(
        (), "fault lines, e.g. 'joint_stuck joint_2 at 10 until 50'; see docs/faults.md", texts=True
    )
    disturbances: tuple[str, ...] = parameter(
        (),
        "external wrenches on links, e.g. 'hand force 1 0 0 in world at 10 until 50'; see "
        "docs/disturbances.md",
        texts=True,
    )
    orbit: OrbitConfig = group(OrbitConfig())
    table: TableConfig = group(TableConfig())
    sensors: SensorConfig = group(SensorConfig())
    target: TargetConfig = group(TargetConfig())
    capture: CaptureConfig = group(CaptureConfig())

    def decided(self, actuation: str = "") -> PlantConfig:
        """Return the configuration with ``auto`` replaced by an actuation mode.

        ``actuation`` is the command type; empty selects velocities, unless thrusters or moving
        joints require efforts.
        """
        if self.actuation != "auto":
            return self
        needs_efforts = bool(self.thrusters) or any(self.initial_joint_velocities)
        return replace(self, actuation=actuation or ("effort" if needs_efforts else "velocity"))

    def prefix_for(self, robot: RobotDescription) -> str:
        """Return the prefix for a robot's frame names that keeps them distinct from the world
        frame."""
        taken = self.world_frame in robot.frames
        return self.frame_prefix or ("robot/" if taken else "")

    @property
    def period_ns(self) -> int:
        """Duration of a tick, ns."""
        return period_ns(self.tick_rate)

    @property
    def contact_ticks(self) -> int:
        """Ticks between contact checks; 0: no checks."""
        return self.ticks_of(min(self.clearance_period, _CONTACT_PERIOD))

    def ticks_of(self, period: float) -> int:
        """Return the number of ticks in a period, s: at least one, or 0 if the period is 0."""
        return max(1, round(period * SECOND / self.period_ns)) if period else 0

    @property
    def control_period(self) -> float:
        """Duration of a tick, s."""
        return self.period_ns / SECOND
