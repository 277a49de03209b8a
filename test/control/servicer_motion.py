"""States, references and output accelerations of the servicer, the last from Pinocchio."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
from control.flights import (
    END_EFFECTOR,
    SERVICER_SHAPE,
    Array,
    plant_of,
    random_pose_reference,
    random_state,
)
from scipy.spatial.transform import Rotation

from spacerobot_ros.control import (
    Actuation,
    ControlState,
    GainPair,
    Gains,
    OutputSelection,
    Reference,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.inverse_kinematics import AXES

GAINS = Gains(
    GainPair(3.0, 4.0), GainPair(2.0, 3.5), GainPair(5.0, 6.0), GainPair(7.0, 5.5), GainPair(1, 2)
)
KP = np.repeat([3.0, 2.0, 5.0, 7.0], 3)
KD = np.repeat([4.0, 3.5, 6.0, 5.5], 3)
POSES = OutputSelection(AXES, AXES, (), END_EFFECTOR)


def well_conditioned_state(rng: np.random.Generator) -> ControlState:
    """Return a moving servicer with its arm away from singularities."""
    state = random_state(rng, 6)
    return replace(state, q=SERVICER_SHAPE + rng.uniform(-0.2, 0.2, 6))


def random_reference(rng: np.random.Generator) -> Reference:
    return Reference(random_pose_reference(rng), random_pose_reference(rng))


class OutputMotion:
    """Errors, error rates and accelerations of base and end-effector pose, from Pinocchio."""

    def __init__(self, robot: SpaceRobot, state: ControlState, actuation: Actuation) -> None:
        plant = plant_of(robot, state)
        base_rate, qddot = plant.acceleration(actuation)
        q = np.concatenate([state.r_WB, state.quaternion_WB, state.q])
        u = np.concatenate([state.v_WB_B, state.omega_WB_B, state.qdot])
        pin.forwardKinematics(plant.model, plant.data, q, u, np.concatenate([base_rate, qddot]))
        pin.updateFramePlacements(plant.model, plant.data)
        self._plant = plant
        self.frames = [
            plant.model.getFrameId(link, pin.FrameType.BODY)
            for link in (robot.base_link, END_EFFECTOR)
        ]

    def _all(self, function: Callable[..., pin.Motion]) -> Array:
        plant, axes = self._plant, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        motions = [function(plant.model, plant.data, frame, axes) for frame in self.frames]
        return np.concatenate([part for m in motions for part in (m.linear, m.angular)])

    @property
    def velocity(self) -> Array:
        return self._all(pin.getFrameVelocity)

    @property
    def acceleration(self) -> Array:
        return self._all(pin.getFrameClassicalAcceleration)

    def error(self, reference: Reference) -> Array:
        parts = []
        for frame, wanted in zip(
            self.frames, (reference.base, reference.end_effector), strict=True
        ):
            assert wanted is not None
            placement = self._plant.data.oMf[frame]
            turn = (
                Rotation.from_quat(wanted.quaternion)
                * Rotation.from_matrix(placement.rotation).inv()
            )
            parts += [wanted.position - placement.translation, turn.as_rotvec()]
        return np.concatenate(parts)


def rates(reference: Reference) -> tuple[Array, Array]:
    """Return the wanted velocities and accelerations of both poses."""
    poses = [p for p in (reference.base, reference.end_effector) if p is not None]
    velocity = [part for p in poses for part in (p.velocity, p.angular_velocity)]
    acceleration = [part for p in poses for part in (p.acceleration, p.angular_acceleration)]
    return np.concatenate(velocity), np.concatenate(acceleration)
