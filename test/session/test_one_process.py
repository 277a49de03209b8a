"""A stack of one process: its readers hear writers that have sent much before they came."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest
import rclpy

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.session import run

FILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, str]]:
    """Return the files of settings that ROS was started with."""
    started: list[dict[str, str]] = []

    def start(arguments: Any) -> None:
        started.append({name: os.environ[name] for name in FILES if name in os.environ})

    for name in FILES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(run, "start_ros", start)
    monkeypatch.setattr(run, "use_loopback_discovery", lambda: None)
    monkeypatch.setattr(rclpy, "try_shutdown", lambda: None)
    return started


def test_readers_in_one_process_have_settings_of_their_own(seen: list[dict[str, str]]) -> None:
    with run.ros(private=False, one_process=True):
        assert all(os.environ[name].endswith("session/one_process.xml") for name in FILES)
    with run.ros(private=False):
        pass
    own = str(run._ONE_PROCESS_SETTINGS)
    assert seen == [dict.fromkeys(FILES, own), {}]
    assert not any(name in os.environ for name in FILES)


@pytest.mark.parametrize("name", FILES)
def test_settings_of_the_user_are_kept(
    seen: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv(name, "/mine.xml")
    with run.ros(private=False, one_process=True):
        pass
    assert seen == [{name: "/mine.xml"}]
    assert os.environ[name] == "/mine.xml"


def test_settings_go_where_ros_does_not_start(
    seen: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(arguments: Any) -> None:
        raise SpaceRobotError("ROS 2 does not start.")

    monkeypatch.setattr(run, "start_ros", refuse)
    with (
        pytest.raises(SpaceRobotError, match="does not start"),
        run.ros(private=False, one_process=True),
    ):
        pass
    assert not any(name in os.environ for name in FILES)


_LATE_READER = """
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Int32
rclpy.init()
nodes, heard = [rclpy.create_node(name) for name in ("early", "late")], []
executor = SingleThreadedExecutor()
for node in nodes:
    executor.add_node(node)
def spin(count):
    for _ in range(count):
        executor.spin_once(0.005)
writer = nodes[0].create_publisher(Int32, "x", 10)
spin(20)
for number in range(5200):
    writer.publish(Int32(data=number))
nodes[1].create_subscription(Int32, "x", lambda message: heard.append(message.data), 10)
spin(50)
for number in range(5):
    writer.publish(Int32(data=number))
    spin(5)
print(heard)
"""


@pytest.mark.slow
@pytest.mark.usefixtures("own_domain")
def test_a_late_reader_hears_a_writer_of_its_process_by_these_settings() -> None:
    settings = {**os.environ, **dict.fromkeys(FILES, str(run._ONE_PROCESS_SETTINGS))}
    done = subprocess.run(
        [sys.executable, "-c", _LATE_READER],
        env=settings, capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    assert done.stdout == "[0, 1, 2, 3, 4]\n"
