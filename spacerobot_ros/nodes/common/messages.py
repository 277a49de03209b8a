"""Messages that several nodes make or read: types by name, diagnostics, markers, goals."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from visualization_msgs.msg import Marker

from spacerobot_ros.bag import message_definition
from spacerobot_ros.errors import PlanningError, RecordingError, SpaceRobotError
from spacerobot_ros.model.description import Array, Shape
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_multiply
from spacerobot_ros.planning import Goal

_KINDS = {
    "box": Marker.CUBE,
    "cylinder": Marker.CYLINDER,
    "sphere": Marker.SPHERE,
    "mesh": Marker.MESH_RESOURCE,
}


def message_class(type_name: str) -> Any:
    """Return the class of a type such as ``nav_msgs/msg/Odometry``.

    Names come from bags, too: nothing is imported but packages whose definitions are installed.

    Raises
    ------
    SpaceRobotError
        Its package is not installed; the sentence goes after the name of a topic.
    """
    try:
        message_definition(type_name)
        package, _, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError, ValueError, RecordingError):
        raise SpaceRobotError(f"its type {type_name} is not installed here.") from None


def diagnostic_name(node: str, part: str) -> str:
    """Return the name of a part of a node in /diagnostics, as diagnostic_updater forms it.

    Aggregators match the beginning of names, and make folders of them: no slash comes first.
    """
    return f"{node.removeprefix('/')}: {part}"


def diagnostic_status(
    name: str, level: bytes, sentence: str, values: Mapping[str, object], hardware_id: str = ""
) -> DiagnosticStatus:
    """Return the status of the component ``name``, with values as texts."""
    return DiagnosticStatus(
        level=level,
        name=name,
        message=sentence,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


def shape_marker(shape: Shape, frame: str, namespace: str, number: int) -> Marker:
    """Return the marker of a URDF visual, its pose left open."""
    marker = Marker(ns=namespace, id=number, type=_KINDS[shape.kind], action=Marker.ADD)
    marker.header.frame_id = frame
    size = shape.size
    if shape.kind == "cylinder":
        size = (2 * size[0], 2 * size[0], size[1])
    elif shape.kind == "sphere":
        size = (2 * size[0],) * 3
    marker.scale.x, marker.scale.y, marker.scale.z = (float(x) for x in size)
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = (float(x) for x in shape.rgba)
    marker.mesh_resource = shape.resource
    return marker


def goal_of(
    message: PoseStamped,
    frame: str,
    what: str = "The goal pose",
    shape: Array | None = None,
    pose_of: Callable[[str], Array | None] = lambda frame: None,
) -> Goal:
    """Return the goal of a pose message in ``frame``; ``shape`` goes with it.

    ``pose_of`` returns the pose (7,) of another frame in that one, None for one that is not known.

    Raises
    ------
    PlanningError
        It is in another frame, or no pose; ``what`` names it.
    """
    given = message.header.frame_id.removeprefix("/")
    pose = None
    if given not in ("", frame):
        pose = pose_of(given)
        if pose is None:
            raise PlanningError(
                f"{what} is in frame '{given}'; goals are taken in '{frame}', in frames of the "
                "robot once its state is known, and in those that /tf connects with them."
            )
    p, o = message.pose.position, message.pose.orientation
    goal = Goal.checked([p.x, p.y, p.z], [o.x, o.y, o.z, o.w], shape)
    if pose is None:
        return goal
    moved = chained(pose, np.concatenate([goal.position, goal.quaternion]))
    return Goal.checked(moved[:3], moved[3:], shape)


def goal_sentence(part: str, goal_id: str, message: PoseStamped, goal: Goal) -> str:
    """Return one line about a goal that has come."""
    position = ", ".join(f"{x:.4g}" for x in goal.position)
    quaternion = ", ".join(f"{x:.4g}" for x in goal.quaternion)
    given = f", given in '{message.header.frame_id}'" if message.header.frame_id else ""
    return f"Goal {goal_id} of the {part}: ({position}) m, ({quaternion}){given}."


def chained(outer: Array, inner: Array) -> Array:
    """Return the pose (7,) that ``inner`` has where the frame that it is in has ``outer``."""
    position = outer[:3] + matrix_from_quaternion(outer[3:]) @ inner[:3]
    return np.concatenate([position, quaternion_multiply(outer[3:], inner[3:])])


def shape_of(message: JointState, joint_names: Sequence[str]) -> Array:
    """Return the positions (n,) of a message in the order of the robot's joints.

    Raises
    ------
    PlanningError
        A joint is missing, or a position is not finite.
    """
    values = dict(zip(message.name, message.position, strict=False))
    missing = set(joint_names) - set(values)
    if missing:
        raise PlanningError(f"The goal shape is refused: joint '{min(missing)}' is missing.")
    if not np.all(np.isfinite(list(values.values()))):
        raise PlanningError("The goal shape is refused: a position is not finite.")
    return np.array([values[name] for name in joint_names])
