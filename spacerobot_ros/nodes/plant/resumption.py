"""Where a plant goes on that was ended in mid-flight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spacerobot_ros.bag.recorded_robot import last_state
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.simulation.building import period_ns
from spacerobot_ros.simulation.initial_state import InitialState


def resumed(
    values: Mapping[str, Any], namespace: str, robot: SpaceRobot
) -> tuple[InitialState | None, int]:
    """Return the state to start from (None: the one of the parameters) and its tick.

    Raises
    ------
    ParameterError
        The bag is of another robot.
    RecordingError
        It cannot be read, or holds no state.
    """
    path = values["resume_bag"]
    if not path:
        return None, 0
    state = last_state(path, namespace.rstrip("/"))
    if state.joint_names != list(robot.joint_names):
        raise ParameterError(
            f"Parameter 'resume_bag' is '{path}', a bag of a robot with the joints "
            f"{', '.join(state.joint_names)}; this one has {', '.join(robot.joint_names)}."
        )
    # Servos hold the rates that they are commanded: only motors leave joints moving.
    moving = values["actuation"] == "effort"
    initial = InitialState(
        position=state.position,
        quaternion=state.quaternion,
        joint_positions=state.joints,
        linear_momentum=state.momenta[:3],
        angular_momentum=state.momenta[3:],
        joint_velocities=state.rates if moving else None,
    )
    return initial, round(state.time_ns / period_ns(values["tick_rate"]))
