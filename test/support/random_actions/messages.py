"""Goals as messages: sound ones and others."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from support.oracles import Array


def fill_pose(message: PoseStamped, position: Array, quaternion: Array) -> None:
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = (float(x) for x in position)
    o.x, o.y, o.z, o.w = (float(x) for x in quaternion)


def moved(pose: PoseStamped, offset: tuple[float, ...], turn: tuple[float, ...]) -> PoseStamped:
    """Return a pose moved by an offset in the world, and turned about its own axes."""
    message = PoseStamped()
    message.header.frame_id = "world"
    p, o = pose.pose.position, pose.pose.orientation
    attitude = Rotation.from_quat([o.x, o.y, o.z, o.w]) * Rotation.from_rotvec(turn)
    fill_pose(message, np.array([p.x, p.y, p.z]) + offset, attitude.as_quat())
    return message


def spoilt(goal: PoseStamped, how: str) -> PoseStamped:
    o = goal.pose.orientation
    match how:
        case "frame":
            goal.header.frame_id = "moon"
        case "quaternion":
            o.x = o.y = o.z = o.w = 0.0
        case "nan":
            goal.pose.position.y = float("nan")
        case _:
            goal.pose.position.z = float("inf")
    return goal


def bad_shape(names: list[str], how: str) -> JointState:
    zeros = [0.0] * len(names)
    match how:
        case "unknown":
            return JointState(name=["nobody", *names[1:]], position=zeros)
        case "short":
            return JointState(name=names, position=zeros[1:])
        case "nan":
            return JointState(name=names, position=[float("nan"), *zeros[1:]])
        case _:
            return JointState(name=[names[0]] * 2, position=[0.0, 0.0])
