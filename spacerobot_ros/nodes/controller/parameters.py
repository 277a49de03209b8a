"""The parameters of coordinated control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spacerobot_ros.control import LAWS, PROFILES, GainPair, Gains
from spacerobot_ros.nodes.common.parameters import ParameterSpec, Value, option_specs
from spacerobot_ros.nodes.common.robot_source import MODEL_ERROR_SPECS, ROBOT_SPECS

_GROUPS = (
    ("base_position", 30.0, 60.0),
    ("base_attitude", 30.0, 60.0),
    ("end_effector_position", 30.0, 60.0),
    ("end_effector_attitude", 30.0, 60.0),
    ("joints", 4.0, 4.0),
)
_SMALLEST_GAIN = 1e-9

_GAIN_SPECS = tuple(
    ParameterSpec(
        f"gains.{group}.{name}",
        default,
        "of the law",
        f"{meaning} gain of the {group.replace('_', ' ')}",
        _SMALLEST_GAIN,
        live=True,
    )
    for group, kp, kd in _GROUPS
    for name, meaning, default in (("kp", "proportional", kp), ("kd", "derivative", kd))
)

CONTROL_SPECS = (
    *ROBOT_SPECS,
    *MODEL_ERROR_SPECS,
    ParameterSpec("law", "transposed_jacobian", "", "control law", choices=tuple(LAWS)),
    ParameterSpec("tick_rate", 100.0, "Hz", "commands a second; the plant's", 1e-3, 1e5),
    ParameterSpec("world_frame", "world", "", "frame that goals must be given in"),
    ParameterSpec(
        "end_effector_frame", "", "", "link that is controlled; '': 'end_effector', if any"
    ),
    ParameterSpec("base_outputs", "", "", "axes of the base: x y z rx ry rz; '': by the robot"),
    ParameterSpec("end_effector_outputs", "", "", "axes of the end-effector; '': by the robot"),
    ParameterSpec("joint_outputs", "", "", "joints that are outputs; '': by the robot"),
    ParameterSpec("profile", "step", "", "how references move to goals", choices=tuple(PROFILES)),
    ParameterSpec("motion.speed", 0.1, "m/s", "fastest reference", 1e-6),
    ParameterSpec("motion.acceleration", 0.02, "m/s^2", "of the reference", 1e-6),
    ParameterSpec("motion.angular_speed", 0.1, "rad/s", "fastest reference", 1e-6),
    ParameterSpec("motion.angular_acceleration", 0.02, "rad/s^2", "of the reference", 1e-6),
    ParameterSpec("max_force", 0.0, "N", "of the thrusters; 0: no limit", 0.0),
    ParameterSpec("max_torque", 0.0, "N m", "of the thrusters; 0: no limit", 0.0),
    ParameterSpec("estimation_time", 1.0, "s", "without odom the base is estimated this long", 0.0),
    ParameterSpec("position_tolerance", 1e-3, "m", "a goal is met within", 0.0, live=True),
    ParameterSpec("attitude_tolerance", 1e-3, "rad", "a goal is met within", 0.0, live=True),
    ParameterSpec("joint_tolerance", 1e-3, "m or rad", "a goal is met within", 0.0, live=True),
    ParameterSpec("settle_time", 1.0, "s", "... for this long", 0.0, live=True),
    ParameterSpec(
        "time_limit", 0.0, "s", "a goal not met after this long has failed; 0: never", 0.0
    ),
    ParameterSpec("status_period", 1.0, "s", "simulated time between status messages", 0.01),
    ParameterSpec(
        "resume_file", "", "", "keeps the present goals for one that starts again; '': none"
    ),
    *_GAIN_SPECS,
    *option_specs(LAWS),
)


def gains_of(parameters: Mapping[str, Value]) -> Gains:
    """Return the gains that the parameters give.

    Raises
    ------
    ParameterError
        One is not positive and finite.
    """
    values: Mapping[str, Any] = parameters
    pairs = {
        group: GainPair(values[f"gains.{group}.kp"], values[f"gains.{group}.kd"])
        for group, _, _ in _GROUPS
    }
    return Gains(**pairs)
