"""One message of every type that this package records, with a value in every field."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

# The generated message classes read it when they are imported.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")

import numpy as np
import pytest
from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Vector3, WrenchStamped
from nav_msgs.msg import Odometry, Path
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import (
    ColorRGBA,
    Float64MultiArray,
    Header,
    MultiArrayDimension,
    MultiArrayLayout,
    String,
)
from support.full_disk import Disk, MakeDisk
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

Sample = tuple[str, str, Any]


def _header(number: int) -> Header:
    return Header(stamp=Time(sec=1000 + number, nanosec=987_654_321), frame_id="world")


def _pose(number: int) -> PoseStamped:
    message = PoseStamped(header=_header(number))
    message.pose.position = Point(x=0.1 + number, y=-2.5, z=1e-300)
    message.pose.orientation = Quaternion(x=0.1, y=0.2, z=0.3, w=-0.9)
    return message


def _odometry() -> Odometry:
    message = Odometry(header=_header(1), child_frame_id="base_link")
    message.pose.pose = _pose(1).pose
    message.pose.covariance = np.linspace(0.0, 3.5, 36)
    message.twist.twist.linear = Vector3(x=1 / 3, y=-0.0, z=float("inf"))
    message.twist.twist.angular = Vector3(x=-1e300, y=5e-324, z=2.0)
    message.twist.covariance = np.linspace(-1.0, 1.0, 36)
    return message


def _trajectory() -> JointTrajectory:
    points = [
        JointTrajectoryPoint(
            positions=[0.1 * k, 0.2],
            velocities=[1.0, 2.0 * k],
            accelerations=[3.0, 4.0],
            effort=[5.0, 6.0],
            time_from_start=Duration(sec=k, nanosec=500_000_000),
        )
        for k in range(3)
    ]
    return JointTrajectory(header=_header(2), joint_names=["slider_1", "b"], points=points)


def _momentum() -> Float64MultiArray:
    labels = ("linear", "angular", "energy")
    dim = [MultiArrayDimension(label=label, size=3, stride=k) for k, label in enumerate(labels)]
    layout = MultiArrayLayout(dim=dim, data_offset=4)
    return Float64MultiArray(layout=layout, data=[0.5, -0.25, 1e-17])


def _status(number: int) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=DiagnosticStatus.STALE,
        name=f"planner {number}",
        message="beyond the stroke: Δq > 1 m",
        hardware_id="none",
        values=[KeyValue(key="residual", value="1e-9"), KeyValue(key="state", value="")],
    )


def _marker(number: int) -> Marker:
    return Marker(
        header=_header(3),
        ns="links",
        id=number,
        type=Marker.MESH_RESOURCE,
        pose=_pose(2).pose,
        scale=Vector3(x=1.0, y=2.0, z=3.0),
        color=ColorRGBA(r=0.25, g=0.5, b=0.75, a=1.0),
        lifetime=Duration(sec=-1, nanosec=1),
        frame_locked=True,
        points=[Point(x=1.0, y=2.0, z=3.0)] * number,
        colors=[ColorRGBA(a=0.125)] * number,
        text="link",
        mesh_resource="package://robot/base.stl",
        mesh_use_embedded_materials=True,
    )


@pytest.fixture
def samples() -> list[Sample]:
    """Topic, type and message, for every type that the nodes publish or take."""
    joints = JointState(
        header=_header(4),
        name=["slider_1", "slider_2"],
        position=[0.1, -0.2],
        velocity=[1.5, 2.5],
        effort=[-3.0, 4.0],
    )
    wrench = WrenchStamped(header=_header(5))
    wrench.wrench.force = Vector3(x=1.0, y=2.0, z=3.0)
    wrench.wrench.torque = Vector3(x=-1.0, y=-2.0, z=-3.0)
    diagnostics = DiagnosticArray(header=_header(7), status=[_status(1), _status(2)])
    return [
        ("/odom", "nav_msgs/msg/Odometry", _odometry()),
        ("/base_pose", "geometry_msgs/msg/PoseStamped", _pose(0)),
        ("/joint_states", "sensor_msgs/msg/JointState", joints),
        ("/momentum", "std_msgs/msg/Float64MultiArray", _momentum()),
        ("/gait_schedule", "trajectory_msgs/msg/JointTrajectory", _trajectory()),
        ("/planned_path", "nav_msgs/msg/Path", Path(header=_header(6), poses=[_pose(1), _pose(2)])),
        ("/base_wrench", "geometry_msgs/msg/WrenchStamped", wrench),
        ("/planner/status", "diagnostic_msgs/msg/DiagnosticStatus", _status(0)),
        ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", diagnostics),
        ("/robot_description", "std_msgs/msg/String", String(data="<robot name='µ'/>\n" * 50)),
        ("/markers", "visualization_msgs/msg/MarkerArray", MarkerArray(markers=[_marker(1)] * 2)),
        ("/clock", "rosgraph_msgs/msg/Clock", Clock(clock=Time(sec=12, nanosec=34))),
    ]


@pytest.fixture
def assert_same() -> Callable[[Any, Any], None]:
    """Compare a message with what a decoder made of it, field by field and exactly."""
    return _assert_same


def _assert_same(expected: Any, actual: Any) -> None:
    if hasattr(expected, "get_fields_and_field_types"):
        for name in expected.get_fields_and_field_types():
            _assert_same(getattr(expected, name), getattr(actual, name))
    elif isinstance(expected, bytes):
        # rclpy alone takes the type `byte` for one byte of bytes; others take it for a number.
        assert expected == (actual if isinstance(actual, bytes) else bytes([actual]))
    elif isinstance(expected, str | bool | int | float):
        assert expected == actual
    else:
        assert len(expected) == len(actual)
        for one, other in zip(expected, actual, strict=True):
            _assert_same(one, other)


@pytest.fixture
def prefix_with_package(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str, dict[str, str]], None]:
    """Install a message package, given its name and the texts of its messages, for one test.

    Actions and services have the paths of their files for names.
    """
    prefix = tmp_path_factory.mktemp("prefix")
    known = os.environ.get("AMENT_PREFIX_PATH")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(filter(None, (str(prefix), known))))

    def install(package: str, messages: dict[str, str]) -> None:
        index = prefix / "share/ament_index/resource_index/packages"
        folder = prefix / "share" / package / "msg"
        index.mkdir(parents=True, exist_ok=True)
        folder.mkdir(parents=True)
        (index / package).touch()
        for name, text in messages.items():
            path = folder.parent / name if "/" in name else folder / f"{name}.msg"
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(text.encode())

    return install


@pytest.fixture
def make_disk(monkeypatch: pytest.MonkeyPatch) -> MakeDisk:
    """Return what puts a small disk in place of the real one."""
    return lambda size: Disk(monkeypatch, size)
