"""Pinocchio and MuJoCo on the same URDF: dynamics engines that the model is held against."""

from support.oracles.agreement import Array, assert_agrees, relative_deviation
from support.oracles.mujoco_oracle import MujocoOracle
from support.oracles.oracle import Motion, Oracle, random_motion
from support.oracles.pinocchio_oracle import PinocchioOracle

ENGINES: tuple[type[Oracle], ...] = (PinocchioOracle, MujocoOracle)

__all__ = [
    "ENGINES",
    "Array",
    "Motion",
    "MujocoOracle",
    "Oracle",
    "PinocchioOracle",
    "assert_agrees",
    "random_motion",
    "relative_deviation",
]
