"""A schedule flown in the plant under efforts, tracked by the computed-torque law."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.reference import HeldVelocityReference
from spacerobot_ros.control.state import ControlState, Reference
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.execution.tracker import ScheduleFollower
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.effort_plant import EffortPlant

Array = npt.NDArray[np.float64]

_KP, _KD, _SHAPE_GAIN = 100.0, 20.0, 2.0
_SETTLING = 0.6


@dataclass(frozen=True)
class TrackedFlight:
    """Efforts that were asked for and realised (ticks, n), and the attitude at the end (4,)."""

    asked: Array
    realised: Array
    quaternion: Array


def track(robot: SpaceRobot, schedule: GaitSchedule) -> TrackedFlight:
    """Fly a schedule and hold its last shape, with the gains of the scenario ``planar_chain``."""
    h = schedule.control_period
    plant = EffortPlant(robot, h, InitialState(joint_positions=schedule.positions[0]), 0.005)
    settings = {"law": "computed_torque", "tick_rate": 1 / h}
    gains = {"gains.joints.kp": _KP, "gains.joints.kd": _KD}
    controller = build_controller(robot, configured(ControllerConfig, {**settings, **gains}))
    follower, held = ScheduleFollower(schedule, 0, _SHAPE_GAIN), HeldVelocityReference(h)
    held.at_command(plant.q, np.zeros(robot.n))
    wanted, rates = np.zeros((2, robot.n))
    asked, realised = [], []
    for tick in range(schedule.ticks + round(_SETTLING / h)):
        follower.command(round(tick * h * 1e9), plant.q, wanted, rates)
        r_WB, quaternion = plant.pose[:3].copy(), plant.pose[3:].copy()
        v_WB, omega_WB = plant.twist[:3].copy(), plant.twist[3:].copy()
        state = ControlState(r_WB, quaternion, v_WB, omega_WB, plant.q.copy(), plant.qdot.copy())
        controller.follow(Reference(joints=held.at_command(wanted, rates)))
        result = controller.command(tick * h, state, state.q, state.qdot)
        asked.append(result.realised.tau + result.excess.tau)
        plant.step(result.realised.tau)
        realised.append(plant.effort.copy())
    return TrackedFlight(np.array(asked), np.array(realised), plant.pose[3:].copy())


def with_effort_limits(urdf: str, limits: dict[str, float]) -> str:
    """Return a URDF with effort limits (N or N m) by joint."""
    joints = re.split(r"(<joint .*?</joint>)", urdf, flags=re.DOTALL)
    for i, text in enumerate(joints):
        name = re.match(r'<joint name="([^"]*)"', text)
        if name is not None and name[1] in limits:
            joints[i] = re.sub(r'effort="[^"]*"', f'effort="{limits[name[1]]!r}"', text)
    return "".join(joints)
