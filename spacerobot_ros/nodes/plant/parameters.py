"""The parameters of the plant node."""

from __future__ import annotations

from spacerobot_ros.nodes.common.parameters import ParameterSpec
from spacerobot_ros.nodes.common.robot_source import ROBOT_SPECS
from spacerobot_ros.simulation.building import PLANTS

PLANT_SPECS: tuple[ParameterSpec, ...] = (
    *ROBOT_SPECS,
    ParameterSpec("actuation", "velocity", "", "what joint_commands carry", choices=tuple(PLANTS)),
    ParameterSpec("time_mode", "realtime", "", "who drives time", choices=("realtime", "lockstep")),
    ParameterSpec("tick_rate", 20.0, "Hz", "ticks a second of simulated time", 1e-3, 1e5),
    ParameterSpec("real_time_factor", 1.0, "", "simulated over wall time", 1e-3, 1e3),
    ParameterSpec(
        "command_timeout", 0.5, "s", "realtime: older commands stop the joints; 0: never", 0.0
    ),
    ParameterSpec(
        "beyond_limits",
        "clip",
        "",
        "commands beyond the rate or effort limits of the URDF",
        choices=("clip", "refuse"),
    ),
    ParameterSpec(
        "second_commander",
        "refuse",
        "",
        "realtime: a second answer to the same state, from another commander",
        choices=("refuse", "accept"),
    ),
    ParameterSpec(
        "latched_faults",
        "second_commander",
        "",
        "reasons to refuse a command after which nothing moves until ~/rearm, separated by "
        "spaces: malformed not_finite stale early out_of_order beyond_limits second_commander",
    ),
    ParameterSpec(
        "integration_step", 0.0, "s", "longest step; 0: 0.01 (velocity), 0.001 (effort)", 0.0
    ),
    ParameterSpec(
        "thrusters", "", "", "'urdf': those of the robot's URDF; a YAML file; '': any wrench"
    ),
    ParameterSpec(
        "thrusters_excluded", "", "", "names of thrusters that are not used, separated by spaces"
    ),
    ParameterSpec("world_frame", "world", "", "name of the inertial frame"),
    ParameterSpec(
        "end_effector_frame", "", "", "link of end_effector_pose; '': 'end_effector', if any"
    ),
    ParameterSpec(
        "base_pose_period", 0.0, "s", "simulated time between base_pose; 0: every tick", 0.0
    ),
    ParameterSpec("marker_period", 0.5, "s", "simulated time between markers; 0: none", 0.0),
    ParameterSpec(
        "diagnostics_period", 1.0, "s", "simulated time between diagnostics; 0: none", 0.0
    ),
    ParameterSpec(
        "resume_bag", "", "", "bag from whose last state and time to go on; '': the initial state"
    ),
    ParameterSpec("initial_position", [0.0, 0.0, 0.0], "m", "base link in the world", length=3),
    ParameterSpec(
        "initial_orientation", [0.0, 0.0, 0.0, 1.0], "", "quaternion x, y, z, w", length=4
    ),
    ParameterSpec(
        "initial_joint_positions", [], "m or rad", "by joint order of the URDF; []: zero"
    ),
    ParameterSpec(
        "initial_joint_velocities", [], "m/s or rad/s", "likewise, under efforts; []: zero"
    ),
    ParameterSpec(
        "initial_center_of_mass",
        [],
        "m",
        "of the system in the world, instead of initial_position",
        length=3,
    ),
    ParameterSpec("linear_momentum", [0.0, 0.0, 0.0], "kg m/s", "total, in world", length=3),
    ParameterSpec(
        "angular_momentum",
        [0.0, 0.0, 0.0],
        "kg m^2/s",
        "total, about the centre of mass, in world",
        length=3,
    ),
    ParameterSpec(
        "faults",
        [],
        "",
        "what goes wrong and when, e.g. 'joint_stuck joint_2 at 10 until 50'; see docs/faults.md",
        texts=True,
    ),
    ParameterSpec("sensors.position_noise", 0.0, "m", "1 sigma an axis of odom, in world", 0.0),
    ParameterSpec("sensors.attitude_noise", 0.0, "rad", "likewise, a rotation vector in base", 0.0),
    ParameterSpec("sensors.velocity_noise", 0.0, "m/s", "likewise, of the twist", 0.0),
    ParameterSpec("sensors.angular_velocity_noise", 0.0, "rad/s", "likewise", 0.0),
    ParameterSpec("sensors.joint_noise", 0.0, "m or rad", "1 sigma of every joint position", 0.0),
    ParameterSpec("sensors.joint_rate_noise", 0.0, "m/s or rad/s", "of every joint velocity", 0.0),
    ParameterSpec("sensors.position_bias", [0.0, 0.0, 0.0], "m", "of odom, in world", length=3),
    ParameterSpec(
        "sensors.attitude_bias", [0.0, 0.0, 0.0], "rad", "rotation vector in base", length=3
    ),
    ParameterSpec("sensors.joint_bias", [], "m or rad", "by joint order of the URDF; []: none"),
    ParameterSpec("sensors.seed", 0, "", "of the noise of sensors and actuators", 0),
)
