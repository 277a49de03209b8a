"""Table of all topics, used by publishers, reports and the documentation, and requests to a stack.

For the state topics of the plant, the table also lists the values in the messages, as needed
by the publisher and by the re-simulation of bags. A new state topic needs an entry here
and a quantity in :mod:`spacerobot_ros.simulation.sensors`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from spacerobot_ros.errors import ParameterError

_POSE_MEMBERS = (*(f"position.{x}" for x in "xyz"), *(f"orientation.{x}" for x in "xyzw"))
_TWIST_MEMBERS = (*(f"linear.{x}" for x in "xyz"), *(f"angular.{x}" for x in "xyz"))
_WRENCH_MEMBERS = (*(f"force.{x}" for x in "xyz"), *(f"torque.{x}" for x in "xyz"))
_MOMENTUM_LABELS = ("linear_x", "linear_y", "linear_z", "angular_x", "angular_y", "angular_z")


@dataclass(frozen=True)
class StateField:
    """Adjacent values in a state topic's message.

    Attributes
    ----------
    path
        Path in the message: a number, a component with numbers, or an array.
    quantity
        Name of the values in :attr:`~spacerobot_ros.simulation.sensors.ReportedState. quantities`.
    members
        The fields of the component at ``path``, in order; empty for an array.
    array_entry_names
        Names of the array entries; empty: one per joint or other object of the topic.
    """

    path: str
    quantity: str
    members: tuple[str, ...] = ()
    array_entry_names: tuple[str, ...] = ()

    @property
    def columns(self) -> list[str]:
        """Value paths in a message, or the path of an array."""
        return [f"{self.path}.{member}" for member in self.members] or [self.path]

    def labels(self, names: Sequence[str]) -> list[str]:
        """Return a label for each value; ``names`` are the joints or thrusters."""
        if self.members:
            return self.columns
        return [entry.replace("_", " ") for entry in self.array_entry_names] or [
            f"{self.path} of {name}" for name in names
        ]

    @property
    def quaternion(self) -> int | None:
        """Index of the first quaternion component, if any."""
        first = "orientation.x"
        return self.members.index(first) if first in self.members else None


@dataclass(frozen=True)
class Topic:
    """One topic.

    Attributes
    ----------
    name
        Topic name, relative to the robot's namespace or absolute.
    type
        Name of the message type, such as ``nav_msgs/msg/Odometry``.
    meaning
        Description of the content.
    publishers
        The nodes that publish the topic; ``user`` for topics from outside the stack.
    condition
        Condition under which the topic exists; empty: always.
    latched
        Whether a late subscriber receives the last message (reliable, transient local, depth 1).
    state
        The values of a plant state; empty for other topics.
    frame
        The frame in the header of a state topic: ``world`` or ``base``.
    array_entries_of
        Objects to which the array entries belong: ``joints`` or ``thrusters``.
    every_tick
        Whether a state topic is published in every tick, or every ``base_pose_period``.
    """

    name: str
    type: str
    meaning: str
    publishers: tuple[str, ...] = ("plant",)
    condition: str = ""
    latched: bool = False
    state: tuple[StateField, ...] = ()
    frame: str = "world"
    array_entries_of: str = "joints"
    every_tick: bool = True

    @property
    def short_type(self) -> str:
        """The type in ROS notation, such as ``nav_msgs/Odometry``."""
        return self.type.replace("/msg/", "/")


def _joint_states(prefix: str) -> tuple[StateField, ...]:
    return (
        StateField("position", f"{prefix}_q"),
        StateField("velocity", f"{prefix}_qdot"),
        StateField("effort", "effort"),
    )


def _odometry(prefix: str) -> tuple[StateField, ...]:
    return (
        StateField("pose.pose", f"{prefix}_pose", _POSE_MEMBERS),
        StateField("twist.twist", f"{prefix}_twist", _TWIST_MEMBERS),
    )


_ARRAY_TYPE = "std_msgs/msg/Float64MultiArray"
_JOINT_STATE_TYPE = "sensor_msgs/msg/JointState"
_ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
_PATH_TYPE = "nav_msgs/msg/Path"
_POSE_STAMPED_TYPE = "geometry_msgs/msg/PoseStamped"
_STATUS_TYPE = "diagnostic_msgs/msg/DiagnosticStatus"
_STRING_TYPE = "std_msgs/msg/String"
_TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"
_TWIST_STAMPED_TYPE = "geometry_msgs/msg/TwistStamped"
_WRENCH_STAMPED_TYPE = "geometry_msgs/msg/WrenchStamped"


def _from_user(name: str, type: str, meaning: str, **options: Any) -> Topic:
    return Topic(name, type, meaning, ("user",), **options)


def _status(name: str, meaning: str, publisher: str = "plant", **options: Any) -> Topic:
    return Topic(name, _STATUS_TYPE, meaning, (publisher,), latched=True, **options)


# The plant publishes its state in this order: the clock first, so that a subscriber that sees a
# state has seen its time; odom and joint_states late, because they trigger the commanders.
_TOPIC_TABLE = (
    Topic("/clock", "rosgraph_msgs/msg/Clock", "simulated time"),
    Topic(
        "base_pose",
        _POSE_STAMPED_TYPE,
        "true base link pose in the world, every `base_pose_period`",
        state=(StateField("pose", "pose", _POSE_MEMBERS),),
        every_tick=False,
    ),
    Topic(
        "end_effector_pose",
        _POSE_STAMPED_TYPE,
        "true pose of the link `end_effector_frame` in the world",
        condition="the robot has a link with that name",
        state=(StateField("pose", "end_effector_pose", _POSE_MEMBERS),),
    ),
    Topic(
        "end_effector/pose",
        _POSE_STAMPED_TYPE,
        "measured pose of the link in the world, from `odom` and `joint_states`; also `NAME/pose` "
        "of every link in the plant's `end_effectors`",
        condition="the plant's `end_effectors` list the link",
        state=(StateField("pose", "pose_of_end_effector", _POSE_MEMBERS),),
    ),
    Topic(
        "momentum",
        _ARRAY_TYPE,
        "linear momentum (kg m/s), angular momentum about the centre of mass (kg m^2/s), both in "
        "the world, and kinetic energy (J), summed over the bodies",
        state=(
            StateField("data", "momentum", array_entry_names=(*_MOMENTUM_LABELS, "kinetic_energy")),
        ),
    ),
    Topic(
        "momentum_expected",
        _ARRAY_TYPE,
        "initial momenta plus the impulses of thrusters, disturbances and captures",
        condition="actuation is effort, a disturbance acts, or there is a target",
        state=(StateField("data", "expected_momenta", array_entry_names=_MOMENTUM_LABELS),),
    ),
    Topic(
        "target/odom",
        _ODOMETRY_TYPE,
        "measured pose of the target's root link in the world, and twist of this link in its own "
        "frame, whether the target is floating or held",
        condition="`target.robot` is set",
        state=_odometry("target"),
    ),
    Topic(
        "target/odom_true",
        _ODOMETRY_TYPE,
        "true target state",
        condition="`target.sensors` have errors",
        state=_odometry("true_target"),
    ),
    Topic(
        "odom_true",
        _ODOMETRY_TYPE,
        "true base state",
        condition="the sensors have errors",
        state=_odometry("true"),
    ),
    Topic(
        "joint_states_true",
        _JOINT_STATE_TYPE,
        "true joint states",
        condition="the sensors have errors",
        state=_joint_states("true"),
        frame="base",
    ),
    Topic(
        "odom",
        _ODOMETRY_TYPE,
        "measured pose of the base link in the world, and twist of the base link in its own frame",
        state=_odometry("measured"),
    ),
    Topic(
        "joint_states",
        _JOINT_STATE_TYPE,
        "measured joint positions and velocities, and actuator efforts in the last tick",
        state=_joint_states("measured"),
        frame="base",
    ),
    Topic(
        "base_wrench_realised",
        _WRENCH_STAMPED_TYPE,
        "mean thruster wrench in the last tick",
        condition="`thrusters` is set",
        state=(StateField("wrench", "thruster_wrench", _WRENCH_MEMBERS),),
        frame="base",
    ),
    Topic(
        "thrusters",
        _JOINT_STATE_TYPE,
        "by thruster name: total on-time (position, s), on-time as a fraction of the last tick "
        "(velocity), and mean force in that tick (effort, N)",
        condition="`thrusters` is set",
        state=(
            StateField("position", "thruster_on_time"),
            StateField("velocity", "thruster_duty"),
            StateField("effort", "thruster_force"),
        ),
        frame="base",
        array_entries_of="thrusters",
    ),
    Topic(
        "/tf",
        _TRANSFORMS_TYPE,
        "base link in the world and links in their parent frames, from odom and joint_states, "
        "every `tf_period`",
        condition="tf2_msgs is installed; always in bags",
    ),
    Topic(
        "/tf_static",
        _TRANSFORMS_TYPE,
        "links on fixed joints in their parent frames",
        condition="tf2_msgs is installed and the robot has such links; always in bags",
        latched=True,
    ),
    Topic("robot_description", _STRING_TYPE, "the robot's URDF", latched=True),
    Topic(
        "target/robot_description",
        _STRING_TYPE,
        "the target's URDF",
        condition="`target.robot` is set",
        latched=True,
    ),
    Topic(
        "markers",
        "visualization_msgs/msg/MarkerArray",
        "robot, target, obstacles, goal and planned path as namespaces, for viewers",
        ("plant", "planner"),
    ),
    Topic(
        "/diagnostics",
        "diagnostic_msgs/msg/DiagnosticArray",
        "rejected commands, limits, momentum, faults, deadlines; ignored states; silent nodes; "
        "recorded and lost messages",
        ("plant", "planner", "coordinated_control", "recorder"),
    ),
    Topic(
        "clearance",
        _STATUS_TYPE,
        "smallest distance between two links, every `clearance_period`: `time` (s), `distance` "
        "(m; negative: penetration depth), and the links `first` and `second`; `second_is` is "
        "`obstacle` if `second` is an obstacle",
        condition="robot links could touch",
    ),
    _from_user("fault_injection", _STRING_TYPE, "faults for the plant, one per line, or `clear`"),
    _from_user(
        "disturbance_injection",
        _STRING_TYPE,
        "disturbances for the plant, one per line, or `clear`",
    ),
    _from_user(
        "obstacles",
        _STRING_TYPE,
        "URDF of all fixed obstacles, for the planner, a controller that plans, the plant and "
        "viewers; each message replaces all previous obstacles; an empty string removes them",
        latched=True,
    ),
    Topic(
        "joint_commands",
        _JOINT_STATE_TYPE,
        "velocities or efforts (by `actuation`) of all joints by name, with the stamp of the "
        "state to which they respond",
        ("planner", "coordinated_control"),
    ),
    Topic(
        "base_wrench",
        _WRENCH_STAMPED_TYPE,
        "commanded thruster force and torque at the base link origin, in the base link frame",
        ("coordinated_control",),
    ),
    _from_user(
        "goal_pose",
        _POSE_STAMPED_TYPE,
        "base goal pose in the world; NaN means any position or any attitude",
    ),
    _from_user(
        "goal_path",
        _PATH_TYPE,
        "base poses in the world for a controller with `profile: planned`, which brings the robot "
        "to rest at each of them; the last pose is the goal",
    ),
    _from_user(
        "goal_joint_states",
        _JOINT_STATE_TYPE,
        "final joint positions for later goals; a message without joints allows any positions",
    ),
    _from_user(
        "end_effector/goal_pose",
        _POSE_STAMPED_TYPE,
        "end-effector goal pose in the world; also `NAME/goal_pose` for links in the planner's "
        "`end_effectors`, and for the controller's `end_effector_frame`. For the planner, an "
        "all-zero orientation means any attitude, and poses with the same stamp, including the "
        "base pose, form one goal",
    ),
    _from_user(
        "end_effector/twist",
        _TWIST_STAMPED_TYPE,
        "commanded end-effector twist in the frame in its header: the world, the base link or the "
        "end-effector; also `NAME/twist` for links in the planner's `end_effectors`. The joints "
        "brake if no twist arrives for `twist_timeout`",
    ),
    _from_user(
        "end_effector/path",
        _PATH_TYPE,
        "end-effector path in the world, which is straight from pose to pose; the last pose is "
        "the goal, and the base is free; also `NAME/path` for links in the planner's "
        "`end_effectors`. If all orientations are zero, any attitude is accepted",
    ),
    Topic(
        "joint_reference",
        _JOINT_STATE_TYPE,
        "joint positions and velocities for coordinated control to track",
        ("planner",),
        condition="`output` is reference",
    ),
    _from_user(
        "base_reference",
        _ODOMETRY_TYPE,
        "moving base reference for coordinated control, one message per state",
    ),
    Topic(
        "gait_schedule",
        "trajectory_msgs/msg/JointTrajectory",
        "the whole planned schedule",
        ("planner",),
        latched=True,
    ),
    Topic(
        "planned_path",
        _PATH_TYPE,
        "predicted base path",
        ("planner", "coordinated_control"),
        latched=True,
    ),
    _status(
        "plant/status",
        "plant state, reason, active injected faults, and the held `payload`, on every change; "
        "`state` is inactive, running, resting, paused, latched or failed",
    ),
    _status("planner/status", "planner state, reason, goal and remaining error", "planner"),
    _status(
        "controller/status",
        "controller state, reason, goal, expected arrival (`ends_at_s`), errors, and saturation "
        "losses",
        "coordinated_control",
    ),
    _status(
        "replay/status",
        "replay status: `state` (playing, paused or ended), `position_s` from the beginning, "
        "`duration_s` and `rate`; on every change, and five times per second",
        "replay",
        condition="a bag is replayed",
    ),
    _from_user(
        "replay/seek",
        "std_msgs/msg/Float64",
        "time at which a replay continues, s after the beginning of the bag",
        condition="a bag is replayed",
    ),
    Topic(
        "events",
        _STATUS_TYPE,
        "one record per state change: `event` is the type of change, `time` is the simulated "
        "time (s), and `wall_time` the time since the epoch (s; not in flights without nodes)",
        ("plant", "planner", "coordinated_control", "recorder", "replay"),
    ),
    Topic(
        "heartbeat",
        _STATUS_TYPE,
        "five times per second of wall time from every active node: `name`, `hardware_id` (its "
        "role), `message` (active, busy or inactive); recorded in bags only on request",
        ("plant", "planner", "coordinated_control", "recorder", "replay"),
    ),
)

TOPICS: dict[str, Topic] = {topic.name: topic for topic in _TOPIC_TABLE}
"""Every topic of the stack by name; the plant's topics are in publication order."""

GLOBAL_TOPICS = ("/clock", "/tf", "/tf_static")
"""Topics with absolute names; a stack in a namespace remaps them to that namespace."""

TOPICS_NOT_RECORDED = ("/rosout", "/parameter_events", "/transition_event", "/heartbeat")
"""Suffixes of topics that are recorded only on request."""


def link_topic(end_effector: str, kind: str) -> str:
    """Return the topic ``goal_pose``, ``twist``, ``path`` or ``pose`` of an end-effector, with the
    link name converted to a valid topic name.
    """
    return re.sub(r"\W|^(?=\d)", "_", end_effector, flags=re.ASCII) + f"/{kind}"


def require_own_topics(end_effectors: Sequence[str]) -> None:
    """Check that no two of the links share their topics; see :func:`link_topic`.

    Raises
    ------
    ParameterError
        Two of them do.
    """
    if len({link_topic(name, "pose") for name in end_effectors}) < len(end_effectors):
        raise ParameterError(
            "Parameter 'end_effectors' names links that share the topic NAME/pose: "
            f"{', '.join(end_effectors)}; name only one of them."
        )


def pose_topic(end_effector: str) -> Topic:
    """Return the entry for the poses of an end-effector; see :func:`link_topic`."""
    name = link_topic(end_effector, "pose")
    state = StateField("pose", f"pose_of_{name.removesuffix('/pose')}", _POSE_MEMBERS)
    return replace(TOPICS["end_effector/pose"], name=name, state=(state,))


def topic_named(name: str) -> Topic:
    """Return the entry for a topic; goals, twists, paths and poses of any end-effector use the
    ``end_effector`` entry.

    Raises
    ------
    KeyError
        There is no such topic.
    """
    link, _, kind = name.rpartition("/")
    if name in TOPICS or not link:
        return TOPICS[name]
    if kind == "pose":
        return pose_topic(link)
    return replace(TOPICS[f"end_effector/{kind}"], name=name)


def state_topics(end_effectors: Iterable[str] = ()) -> list[Topic]:
    """Return the state topics of a plant, including the poses of these end-effectors, in
    publication order.
    """
    poses = {topic.name: topic for topic in map(pose_topic, end_effectors)}
    return [topic for topic in {**poses, **TOPICS}.values() if topic.state]


class Request(Enum):
    """A request that a service of the stack carries out."""

    ABORT = "abort"
    """The planner and the controller drop their goals; the joints brake."""
    STOP = "stop"
    """The joints brake, the thrusters are off, and commands are rejected until ``REARM``."""
    REARM = "rearm"
    PAUSE = "pause"
    RESUME = "resume"
    RESET = "reset"
    PLAY = "play"
    """Continue a replay."""
    HOLD = "hold"
    """Pause a replay."""


SERVICE_BY_REQUEST: Mapping[Request, tuple[tuple[str, ...], str, bool | None]] = {
    Request.ABORT: (("planner", "controller"), "abort", None),
    Request.STOP: (("plant",), "abort", None),
    Request.REARM: (("plant",), "rearm", None),
    Request.RESET: (("plant",), "reset", None),
    Request.PAUSE: (("plant",), "pause", True),
    Request.RESUME: (("plant",), "pause", False),
    Request.PLAY: (("replay",), "pause", False),
    Request.HOLD: (("replay",), "pause", True),
}
"""For each request: nodes, service name, and the value for ``SetBool`` (None: ``Trigger``)."""
