"""Messages for viewers and people, made without a node: shapes, paths, goals, diagnoses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from support.ros_harness import nanoseconds
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.commanding.fly_to import GoalErrors, Progress
from spacerobot_ros.errors import PlanningError, SpaceRobotError
from spacerobot_ros.messages.builders import (
    MARKER_ARRAY,
    RobotMarkers,
    goal_markers,
    path_message,
    shape_marker,
)
from spacerobot_ros.messages.definitions import encode
from spacerobot_ros.messages.diagnostics import PlantDiagnostics, encode_diagnostics
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.description import Pose, Shape
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.model.urdf import parse_world, with_world
from spacerobot_ros.nodes.common.fly_to import GoalClient, NavigateToPoseAction
from spacerobot_ros.nodes.common.messages import (
    goal_description,
    goal_of,
    interface_class,
    message_class,
    shape_of,
)
from spacerobot_ros.planning import BasePath, Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig

RED = (0.9, 0.1, 0.2, 0.7)


def markers_of(raw: bytes | None) -> list[Marker]:
    assert raw is not None
    found: list[Marker] = deserialize_message(raw, MarkerArray).markers
    return found


def shape(kind: str, size: tuple[float, ...], resource: str = "") -> Shape:
    return Shape(kind=kind, size=size, rgba=RED, pose=Pose(), resource=resource)


@pytest.mark.parametrize(
    ("kind", "size", "marker", "scale"),
    [
        ("box", (1.0, 2.0, 3.0), Marker.CUBE, (1.0, 2.0, 3.0)),
        # A URDF has radius and length, a marker diameters.
        ("cylinder", (0.5, 4.0), Marker.CYLINDER, (1.0, 1.0, 4.0)),
        ("sphere", (0.25,), Marker.SPHERE, (0.5, 0.5, 0.5)),
        ("mesh", (0.1, 0.2, 0.3), Marker.MESH_RESOURCE, (0.1, 0.2, 0.3)),
    ],
)
def test_shapes_have_their_sizes(
    kind: str, size: tuple[float, ...], marker: int, scale: tuple[float, ...]
) -> None:
    drawn = shape_marker(shape(kind, size, "package://a/b.stl"), "map", "a_link", 7)
    (found,) = markers_of(encode(MARKER_ARRAY, {"markers": [drawn]}))
    assert (found.type, found.action, found.ns, found.id) == (marker, Marker.ADD, "a_link", 7)
    assert found.header.frame_id == "map"
    assert (found.scale.x, found.scale.y, found.scale.z) == scale
    assert (found.color.r, found.color.g, found.color.b, found.color.a) == pytest.approx(RED)
    assert found.mesh_resource == "package://a/b.stl"


TURNED = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat()
GOAL = Goal.checked([1.0, -2.0, 3.0], TURNED)
PATH = BasePath(
    np.array([0.0, 0.5, 2.25]),
    np.array([[0.0, 0.1, 0.2], [1.0, 1.1, 1.2], [2.0, 2.1, 2.2]]),
    np.array([[0.0, 0.0, 0.0, 1.0], TURNED, [0.0, 0.6, 0.0, 0.8]]),
)


def homogeneous(goal: Goal) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(goal.quaternion).as_matrix(), goal.position
    return matrix


def numbers(pose: Any) -> list[float]:
    p, o = pose.position, pose.orientation
    return [p.x, p.y, p.z, o.x, o.y, o.z, o.w]


def transform(element: Any) -> np.ndarray:
    """Return the ``origin`` of an element of a URDF as a matrix (4, 4), read with scipy."""
    origin = element.find("origin")
    matrix = np.eye(4)
    if origin is not None:
        angles = [float(x) for x in origin.get("rpy", "0 0 0").split()]
        matrix[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        matrix[:3, 3] = [float(x) for x in origin.get("xyz", "0 0 0").split()]
    return matrix


def base_visuals(urdf: str) -> list[np.ndarray]:
    """Return where the visuals of the base and of the links fixed to it are in the base."""
    tree = ElementTree.fromstring(urdf)
    above: dict[Any, Any] = {
        child.get("link"): joint for joint in tree.iter("joint") for child in joint.iter("child")
    }
    found = []
    for link in tree.iter("link"):
        name, placed = link.get("name"), np.eye(4)
        while name in above and above[name].get("type") == "fixed":
            placed = transform(above[name]) @ placed
            name = above[name].find("parent").get("link")
        if name not in above:
            found += [placed @ transform(visual) for visual in link.iter("visual")]
    return found


ROBOTS = ["servicer", "station_arm", "dual_arm", "seven_joint_arm", "planar_chain", "surveyor"]


@pytest.mark.parametrize("name", [*ROBOTS, "sliding_masses"])
def test_the_goal_is_a_ghost_of_the_base_and_the_path_a_line(name: str) -> None:
    robot = load_robot(robot_file(name))
    # The order of the links in a file says nothing: the base is the root of the tree.
    robot = replace(robot, links=robot.links[::-1])
    *ghosts, line, given = markers_of(goal_markers(GOAL, PATH, robot, "map"))
    assert (given.ns, given.id, given.action) == ("given_path", 0, Marker.DELETE)
    expected = [homogeneous(GOAL) @ each for each in base_visuals(robot.urdf)]
    assert expected
    found = []
    for number, ghost in enumerate(ghosts):
        assert (ghost.ns, ghost.id, ghost.header.frame_id) == ("goal", number, "map")
        assert ghost.color.a == 0.25
        pose = numbers(ghost.pose)
        found.append(homogeneous(Goal(np.array(pose[:3]), np.array(pose[3:]))))
    assert len(found) == len(expected)
    for each in expected:
        assert min(np.abs(each - other).max() for other in found) < 1e-9
    assert (line.ns, line.id, line.type) == ("planned_path", len(ghosts), Marker.LINE_STRIP)
    assert line.header.frame_id == "map"
    assert [[p.x, p.y, p.z] for p in line.points] == PATH.position.tolist()
    assert numbers(line.pose) == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    assert line.scale.x > 0
    colour = (line.color.r, line.color.g, line.color.b, line.color.a)
    assert colour == pytest.approx((0.95, 0.6, 0.1, 1.0))


LAST = 2**31 - 1


def test_a_path_begins_at_its_start() -> None:
    message = deserialize_message(path_message(PATH, 7_900_000_000, "map"), PathMessage)
    assert (message.header.frame_id, nanoseconds(message.header.stamp)) == ("map", 7_900_000_000)
    times = [nanoseconds(pose.header.stamp) for pose in message.poses]
    assert times == [7_900_000_000, 8_400_000_000, 10_150_000_000]
    assert {pose.header.frame_id for pose in message.poses} == {"map"}
    for k, stamped in enumerate(message.poses):
        expected = [*PATH.position[k], *PATH.quaternion[k]]
        assert numbers(stamped.pose) == pytest.approx(expected)
    # Beyond the last time that a stamp may have, it ends there.
    message = deserialize_message(path_message(PATH, LAST * 1_000_000_000, "map"), PathMessage)
    assert [pose.header.stamp.sec for pose in message.poses] == [LAST] * 3


def test_a_goal_pose_is_taken_in_its_frame() -> None:
    message = PoseStamped()
    message.pose.position.y = -2.0
    message.pose.orientation.x, message.pose.orientation.w = 0.6, 0.8
    for frame in ("", "map"):
        message.header.frame_id = frame
        goal = goal_of(message, "map", shape=np.array([1.0, 2.0]))
        assert goal.position.tolist() == [0.0, -2.0, 0.0]
        assert goal.quaternion == pytest.approx([0.6, 0.0, 0.0, 0.8])
        assert goal.joint_positions is not None
        assert goal.joint_positions.tolist() == [1.0, 2.0]
    message.header.frame_id = "world"
    with pytest.raises(PlanningError, match="is in frame 'world'; goals are accepted in 'map'"):
        goal_of(message, "map")


@pytest.mark.parametrize(
    ("left_open", "said"),
    [("position", "any position, (0.6, 0, 0, 0.8)"), ("orientation", "(1, -2, 0) m, any attitude")],
)
def test_a_logged_goal_has_only_what_is_requested(left_open: str, said: str) -> None:
    message = PoseStamped()
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, o.x, o.w = 1.0, -2.0, 0.6, 0.8
    part = getattr(message.pose, left_open)
    for name in part.get_fields_and_field_types():
        setattr(part, name, math.nan)
    line = goal_description("the base", "7.0", message, goal_of(message, "world"))
    assert line == f"Goal 7.0 of the base: {said}."


def test_a_goal_shape_is_taken_by_the_names_of_its_joints() -> None:
    message = JointState(name=["c", "a", "b"], position=[3.0, 1.0, 2.0])
    assert shape_of(message, ["a", "b", "c"]).tolist() == [1.0, 2.0, 3.0]
    assert shape_of(message, ["b"]).tolist() == [2.0]
    with pytest.raises(PlanningError, match="joint 'd' is missing"):
        shape_of(message, ["a", "d"])
    message.position[0] = math.inf
    with pytest.raises(PlanningError, match="not finite"):
        shape_of(message, ["a", "b", "c"])


# -- the plant --------------------------------------------------------------------------------


class Diagnosed:
    """A plant at rest, and what its diagnostics say."""

    def __init__(self, robot: str = "sliding_masses", **parameters: Any) -> None:
        config = PlantConfig(robot=robot, time_mode="lockstep", **parameters)
        self.plant = build_plant(SpaceRobot.from_file(robot_file(robot)), config)
        commands = CommandValidator(self.plant, config)
        self.diagnostics = PlantDiagnostics("/a/plant", self.plant, commands)

    def status(self, part: str) -> tuple[int, str, Mapping[str, str]]:
        """Return level, sentence and values of a part."""
        (found,) = (s for s in self.diagnostics.records() if s.name == f"a/plant: {part}")
        return found.level, found.message, found.values


OK, WARN, ERROR = 0, 1, 2


@pytest.fixture
def diagnosed(monkeypatch: pytest.MonkeyPatch) -> Diagnosed:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    return Diagnosed()


def test_margins_are_to_the_nearer_limit(diagnosed: Diagnosed) -> None:
    robot = diagnosed.plant.robot
    diagnosed.plant.q[:] = robot.lower + np.array([0.25, 1.0, 0.0])
    diagnosed.plant.q[2] = robot.upper[2] - 0.125
    level, _, values = diagnosed.status("strokes")
    assert level == OK
    assert values == {"slider_1": "0.25", "slider_2": "1", "slider_3": "0.125"}
    raw = encode_diagnostics(diagnosed.diagnostics.records(), 12_500_000_000)
    message = deserialize_message(raw, DiagnosticArray)
    assert nanoseconds(message.header.stamp) == 12_500_000_000
    (status,) = (each for each in message.status if each.name == "a/plant: strokes")
    assert (status.level, status.hardware_id) == (DiagnosticStatus.OK, "sliding_masses")
    assert {pair.key: pair.value for pair in status.values} == values


def test_a_change_of_momentum_that_nothing_explains_is_an_error(diagnosed: Diagnosed) -> None:
    plant = diagnosed.plant
    plant.momentum[:] = [3.0, 4.0, 0.0, 0.0, 0.0, 0.0, 2.5]
    plant.expected_momenta[:] = [3.0, 4.0, 0.0, 0.0, 0.0, 0.0]
    level, sentence, values = diagnosed.status("momentum")
    assert (level, sentence) == (OK, "momentum is accounted for")
    assert values["kinetic_energy_J"] == "2.500000e+00"
    plant.momentum[:6] += [3e-6, 0.0, -4e-6, 0.0, 2e-9, 0.0]
    level, sentence, values = diagnosed.status("momentum")
    assert (level, sentence) == (ERROR, "momentum changes that no thruster accounts for")
    assert (values["linear_change"], values["angular_change"]) == ("5.000e-06", "2.000e-09")
    # 1e-9 m/s of 16 kg only rounds; that holds for angular momentum too.
    plant.momentum[:6] = plant.expected_momenta
    plant.momentum[3] += 15e-9
    assert diagnosed.status("momentum")[0] == OK
    plant.momentum[3] += 2e-9
    assert diagnosed.status("momentum")[0] == ERROR


def test_limits_are_a_warning_once(diagnosed: Diagnosed) -> None:
    what = next(iter(diagnosed.plant.limit_counts))
    assert diagnosed.status("actuators")[:2] == (OK, "within limits")
    diagnosed.plant.limit_counts[what][1] += 3
    level, sentence, values = diagnosed.status("actuators")
    assert (level, sentence) == (WARN, "joints are limited by the URDF")
    assert values[f"{what}_limited.slider_2"] == "3"
    assert values[f"{what}_limited.slider_1"] == "0"
    assert diagnosed.status("actuators")[0] == OK


def test_what_thrusters_could_not_give_is_a_warning_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    diagnosed = Diagnosed("servicer", actuation="effort", thrusters="urdf")
    thrusters = diagnosed.plant.thrusters
    assert thrusters is not None
    none = np.zeros(diagnosed.plant.robot.n)
    for _ in range(3):
        diagnosed.plant.step(none, np.array([1e3, 0.0, 0.0, 0.0, 0.0, 1e2]))
    level, message, values = diagnosed.status("thrusters")
    assert (level, message) == (WARN, "the requested wrench exceeds the available thrust")
    assert float(values["propellant_kg"]) == pytest.approx(thrusters.propellant) != 0.0
    counts = [int(values[f"pulses.{name}"]) for name in thrusters.table.names]
    assert max(counts) > 1
    assert int(values["pulses"]) == sum(counts) == thrusters.modulator.pulses.sum()
    assert int(values["unmet_ticks"]) == 3
    assert float(values["unmet_force_N"]) == pytest.approx(1e3, rel=0.2)
    assert float(values["unmet_torque_Nm"]) == pytest.approx(1e2, rel=0.2)
    assert diagnosed.status("thrusters")[:2] == (OK, "the requested wrench is produced")


def test_faults_are_listed(diagnosed: Diagnosed) -> None:
    assert diagnosed.status("faults") == (OK, "no fault is injected", {})
    diagnosed.plant.inject("joint_stuck slider_2\njoint_stuck slider_1")
    level, sentence, values = diagnosed.status("faults")
    assert level == WARN
    assert sentence == f"injected: {values['fault_1']}; {values['fault_2']}"
    assert "slider_2" in values["fault_1"]
    diagnosed.plant.disturb("mass_1 force 1 0 0\nmass_2 torque 0 0 1")
    diagnosed.plant.inject("clear")
    level, sentence, values = diagnosed.status("faults")
    assert level == WARN
    assert sentence == (
        "injected: mass_1 force 1 0 0 in world at 0; mass_2 torque 0 0 1 in world at 0"
    )
    assert list(values) == ["disturbance_1", "disturbance_2"]


URDF = """<robot name="r"><link name="base"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><geometry><box size="1 1 1"/></geometry></visual></link>
<link name="arm"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><origin xyz="0.5 0 0" rpy="1.5707963267948966 0 0"/>
<geometry><cylinder radius="0.1" length="2"/></geometry></visual></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/>
<origin xyz="0 0 2"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="1" effort="1"/></joint></robot>"""


def test_shapes_are_drawn_where_they_are() -> None:
    """Base at (1, 2, 3), turned by 90 deg about z; the joint turned by 90 deg more."""
    c = math.sqrt(0.5)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    pose = np.array([1.0, 2.0, 3.0, 0.0, 0.0, c, c])
    np.testing.assert_allclose(matrix_from_quaternion(pose[3:]), quarter, atol=1e-15)
    link_R = np.hstack([np.eye(3), quarter])
    link_r = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 2.0]])
    markers = RobotMarkers(parse_robot(URDF), None, "map")
    box, arm = markers_of(markers.message(7_250_000_000, pose, link_R, link_r, None))
    assert (box.ns, arm.ns, box.id, arm.id) == ("robot", "robot", 0, 1)
    assert {m.header.frame_id for m in (box, arm)} == {"map"}
    assert {nanoseconds(m.header.stamp) for m in (box, arm)} == {7_250_000_000}
    assert numbers(box.pose) == pytest.approx(pose.tolist())
    # The link is turned by 180 deg about z in all; its visual by 90 deg about the x of the link.
    found = numbers(arm.pose)
    assert found[:3] == pytest.approx([0.5, 2.0, 5.0])
    turn = Rotation.from_euler("z", 180, degrees=True) * Rotation.from_euler("x", 90, degrees=True)
    left = Rotation.from_quat(found[3:]).inv() * turn
    assert left.magnitude() == pytest.approx(0.0, abs=1e-12)


def test_obstacles_are_drawn_where_they_rest() -> None:
    world = parse_world(
        '<robot name="w"><link name="w"/><link name="post"><collision>'
        '<origin xyz="0.5 0 0"/><geometry><box size="1 2 3"/></geometry></collision></link>'
        '<joint name="j" type="fixed"><parent link="w"/><child link="post"/>'
        '<origin xyz="1 -2 4" rpy="0 0 1.5707963267948966"/></joint></robot>'
    )
    robot = with_world(parse_robot(URDF), world)
    for pose in ([1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8], [0.0, 0.0, 0.0, 0.6, 0.0, 0.0, 0.8]):
        markers = RobotMarkers(robot, None, "map")
        base, link_R = np.array(pose), np.hstack([np.eye(3), np.eye(3)])
        *_, post = markers_of(markers.message(7, base, link_R, np.zeros((3, 2)), None))
        assert (post.ns, post.id, post.header.frame_id) == ("obstacles", 2, "map")
        assert numbers(post.pose) == pytest.approx(
            [1.0, -1.5, 4.0, 0, 0, math.sqrt(0.5), math.sqrt(0.5)]
        )
        assert (post.scale.x, post.scale.y, post.scale.z) == (1.0, 2.0, 3.0)


def test_obstacles_that_are_gone_are_erased() -> None:
    def world(*names: str) -> str:
        shape = '<collision><geometry><sphere radius="0.2"/></geometry></collision>'
        links = "".join(f'<link name="{name}">{shape}</link>' for name in names)
        joints = "".join(
            f'<joint name="of_{name}" type="fixed"><parent link="w"/><child link="{name}"/></joint>'
            for name in names
        )
        return f'<robot name="w"><link name="w"/>{links}{joints}</robot>'

    robot = with_world(parse_robot(URDF), parse_world(world("post")))
    markers = RobotMarkers(robot, None, "map")
    pose = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8])
    link_R, link_r = np.hstack([np.eye(3), np.eye(3)]), np.zeros((3, 2))
    drawn = []
    for there in (None, parse_world(world("post", "ball")), None, parse_world(world("ball"))):
        markers.use_obstacles(there)
        found = markers_of(markers.message(7, pose, link_R, link_r, None))
        drawn.append([(each.ns, each.id, each.action) for each in found[2:]])
    assert drawn == [
        [("obstacles", 2, Marker.DELETE)],
        [("obstacles", 2, Marker.ADD), ("obstacles", 3, Marker.ADD)],
        [("obstacles", 2, Marker.DELETE), ("obstacles", 3, Marker.DELETE)],
        [("obstacles", 2, Marker.ADD), ("obstacles", 3, Marker.DELETE)],
    ]


@pytest.mark.parametrize(
    "name", ["trap/msg/Sprung", "trap/Sprung", "../trap/msg/Sprung", "trap", "", "a/b/c/d"]
)
def test_a_type_name_imports_no_module_that_is_not_of_messages(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Type names stand in bags, which others write."""
    (tmp_path / "trap" / "msg").mkdir(parents=True)
    (tmp_path / "trap" / "__init__.py").write_text("raise SystemExit('sprung')")
    (tmp_path / "trap" / "msg" / "__init__.py").write_text("Sprung = int")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SpaceRobotError, match="is not installed here"):
        message_class(name)
    assert message_class("nav_msgs/msg/Odometry").__name__ == "Odometry"


def test_a_package_without_its_libraries_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its Python modules may be on the paths alone: then its types cannot be sent."""

    class Half:
        @classmethod
        def __import_type_support__(cls) -> None:
            raise RuntimeError("Could not import 'rosidl_typesupport_c' for package 'nav_msgs'")

        _TYPE_SUPPORT = None

    monkeypatch.setattr("nav_msgs.msg.Odometry", Half)
    assert interface_class("nav_msgs.msg", "Odometry") is None
    with pytest.raises(SpaceRobotError, match="its type nav_msgs/msg/Odometry is not installed"):
        message_class("nav_msgs/msg/Odometry")
    assert interface_class("nav_msgs.msg", "Path") is not None
    assert interface_class("nav_msgs.msg", "Absent") is None


class NavigateToPose:
    """As nav2_msgs of ROS 2 Jazzy has it."""

    @dataclass
    class Feedback:
        current_pose: Any = None
        navigation_time: Duration = field(default_factory=Duration)
        estimated_time_remaining: Duration = field(default_factory=Duration)
        distance_remaining: float = -1.0

    @dataclass
    class Result:
        error_code: int = 7
        error_msg: str = ""


ACTION = NavigateToPoseAction(NavigateToPose)
POSE = np.array([0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8])


def test_the_course_of_a_goal_of_nav2() -> None:
    progress = Progress("executing", 12.5, 3.25, 4_500_000_000, POSE, GoalErrors(position=0.75))
    message = ACTION.feedback(progress, "map")
    assert nanoseconds(message.navigation_time) == 3_250_000_000
    assert nanoseconds(message.estimated_time_remaining) == 12_500_000_000
    assert message.distance_remaining == 0.75
    here = message.current_pose
    assert (here.header.frame_id, nanoseconds(here.header.stamp)) == ("map", 4_500_000_000)
    assert numbers(here.pose) == pytest.approx(POSE.tolist())
    # What is not known is zero.
    message = ACTION.feedback(Progress("planning", None, 1.0, 0, None, GoalErrors()), "map")
    assert nanoseconds(message.estimated_time_remaining) == message.distance_remaining == 0.0
    assert message.current_pose is None


def final(outcome: str, message: str) -> PlannerStatus:
    return PlannerStatus(PlannerState(outcome), message)


def test_the_result_of_a_goal_of_nav2() -> None:
    reached = ACTION.result(final("reached", "There."), GoalErrors())
    assert (reached.error_code, reached.error_msg) == (0, "")
    failed = ACTION.result(final("failed", "Not there."), GoalErrors())
    assert failed.error_code > 0
    assert failed.error_msg == "Not there."


class Handle:
    """What rclpy has for a goal, and a server beside it: both note what is done to them."""

    def __init__(self, canceling: bool) -> None:
        self.is_cancel_requested = canceling
        self.done: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *values: self.done.append((name, *values))


@pytest.mark.parametrize(
    ("outcome", "canceling", "state"),
    [
        ("reached", False, "succeed"),
        ("reached", True, "succeed"),
        ("reached_partly", False, "abort"),
        ("failed", False, "abort"),
        ("aborted", True, "canceled"),
        ("aborted", False, "abort"),
        ("refused", False, "abort"),
    ],
)
def test_the_final_state_of_a_goal_follows_its_outcome(
    outcome: str, canceling: bool, state: str
) -> None:
    """`canceled` is for goals whose client asked for it, as ROS 2's design of actions has it."""
    handle: Any = Handle(canceling)
    server: Any = Handle(canceling)
    GoalClient(server, handle, ACTION, "map").end(final(outcome, "So."), GoalErrors())
    assert handle.done == [(state,)]
    ((_, told_handle, result),) = server.done
    assert told_handle is handle
    assert (result.error_code == 0) is (outcome == "reached")
