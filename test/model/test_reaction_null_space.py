"""Joint rates that leave the base still, against Pinocchio, alone and with a captured body."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import Array

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.resources import robot_file

BODY = Inertia(
    23.0,
    np.array([0.3, -0.2, 0.4]),
    Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()
    @ np.diag([2.1, 3.9, 5.4])
    @ Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix().T,
)
SHAPE = np.array([0.3, -0.7, 0.5, 1.1, -0.4, 0.8, -0.6])


def base_rate(robot: SpaceRobot, held: Inertia | None, q: Array, qdot: Array) -> Array:
    """The angular velocity of the base at zero momentum, by Pinocchio's inertia matrix."""
    model = pin.buildModelFromXML(robot.description.urdf, pin.JointModelFreeFlyer())
    model.armature = np.zeros(model.nv)
    if held is not None:
        wrist = model.frames[model.getFrameId("link_7", pin.FrameType.BODY)]
        inertia = pin.Inertia(held.mass, held.com, held.about_com)
        model.appendBodyToJoint(wrist.parentJoint, inertia, wrist.placement)
    columns = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    at, rates = pin.neutral(model), np.zeros(model.nv)
    at[[column + 1 for column in columns]], rates[columns] = q, qdot
    H = np.triu(pin.crba(model, model.createData(), at))
    H += np.triu(H, 1).T
    return np.asarray(-np.linalg.solve(H[:6, :6], H[:6, 6:] @ rates[6:])[3:])


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPACEROBOT_COMPILE", "0")
        return SpaceRobot.from_file(robot_file("seven_joint_arm"))


@pytest.mark.parametrize("held", [None, BODY], ids=["alone", "after a capture"])
def test_the_base_is_still_while_the_joints_move(
    arm: SpaceRobot, held: Inertia | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    robot = arm if held is None else Payload("link_7", held).attached_to(arm)
    q, wanted = SHAPE.copy(), np.array([0.5, -0.2, 0.4, 0.3, -0.6, 0.2, 0.7])
    for _ in range(6):
        N = robot.reaction_null_space(q)
        assert N.shape == (7, 4)
        np.testing.assert_allclose(N.T @ N, np.eye(4), atol=1e-12)
        rates = N @ (N.T @ wanted)
        assert np.linalg.norm(rates) > 0.2
        assert np.linalg.norm(base_rate(robot, held, q, rates)) < 1e-9
        # The wanted rates themselves turn it, and so do those for the other robot.
        assert np.linalg.norm(base_rate(robot, held, q, wanted)) > 1e-2
        other = BODY if held is None else None
        assert np.linalg.norm(base_rate(robot, other, q, rates)) > 1e-3
        q = q + 0.2 * rates


@pytest.mark.parametrize(
    ("name", "joints", "free"), [("planar_manipulator", 2, 1), ("three_joint_arm", 3, 1)]
)
def test_the_dimension_is_that_of_the_joints_beyond_the_independent_turns(
    name: str, joints: int, free: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    robot = SpaceRobot.from_file(robot_file(name))
    assert robot.reaction_null_space(np.array([0.4, -0.9, 1.1])[:joints]).shape == (joints, free)
