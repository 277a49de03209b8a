"""The parameters of the planner node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spacerobot_ros.nodes.common.parameters import ParameterSpec, Value, option_specs
from spacerobot_ros.nodes.common.robot_source import MODEL_ERROR_SPECS, ROBOT_SPECS
from spacerobot_ros.planning import METHODS, Tolerance

PLANNER_SPECS: tuple[ParameterSpec, ...] = (
    *ROBOT_SPECS,
    *MODEL_ERROR_SPECS,
    ParameterSpec("method", "auto", "", "gait method", choices=tuple(METHODS)),
    ParameterSpec("tick_rate", 20.0, "Hz", "commands a second; the plant's", 1e-3, 1e5),
    ParameterSpec("integration_step", 0.01, "s", "longest step of the prediction", 1e-6),
    ParameterSpec("world_frame", "world", "", "frame that goals must be given in"),
    ParameterSpec("position_tolerance", 1e-3, "m", "a goal is met within", 0.0, live=True),
    ParameterSpec("attitude_tolerance", 1e-3, "rad", "a goal is met within", 0.0, live=True),
    ParameterSpec("joint_tolerance", 1e-3, "m or rad", "a shape is met within", 0.0, live=True),
    ParameterSpec(
        "output",
        "commands",
        "",
        "joint_commands (velocities) for the plant, or joint_reference for a controller",
        choices=("commands", "reference"),
    ),
    ParameterSpec("max_corrections", 3, "", "new plans after the first", 0, 1000, live=True),
    ParameterSpec(
        "abort_time",
        1.0,
        "s",
        "to rest along the gait after ~/abort, or for another goal",
        0.01,
        1e3,
    ),
    ParameterSpec(
        "drift_position", 0.0, "m", "farther off the path the rest is planned again; 0: never", 0.0
    ),
    ParameterSpec("drift_attitude", 0.0, "rad", "likewise", 0.0),
    ParameterSpec("shape_gain", 2.0, "1/s", "feedback on the shape while flying", 0.0, 1e3),
    ParameterSpec(
        "shape_deadband", 0.0, "m or rad", "shape errors up to this are noise: no feedback", 0.0
    ),
    ParameterSpec(
        "averaging", 1, "", "measured states at rest that are averaged to plan and to judge", 1, 1e6
    ),
    ParameterSpec(
        "rest_tolerance",
        0.0,
        "m/s or rad/s",
        "measured rates up to this are noise about rest; 0: all count",
        0.0,
    ),
    ParameterSpec(
        "stuck_ticks",
        40,
        "",
        "ticks of commanded motion after which a joint that does not follow is stuck; 0: never",
        0,
        1e6,
    ),
    ParameterSpec(
        "plan_in_background",
        False,
        "",
        "plan in a thread from a robot at rest and go on answering; false: states wait (lockstep)",
    ),
    ParameterSpec(
        "resume_file", "", "", "keeps the present goal for a planner that starts again; '': none"
    ),
    *option_specs(METHODS),
)


def tolerance_of(parameters: Mapping[str, Value]) -> Tolerance:
    """Return how near is there, as the parameters say now."""
    values: Mapping[str, Any] = parameters
    return Tolerance(
        values["position_tolerance"], values["attitude_tolerance"], values["joint_tolerance"]
    )
