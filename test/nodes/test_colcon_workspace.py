"""The package in a colcon workspace: built as it is, sourced, its nodes started from there."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry
from rclpy.client import Client
from support.colcon import colcon_program, run
from support.command_line import finished
from support.ros_harness import Harness

from spacerobot_ros.bag import read_bag
from spacerobot_ros.flight.verification import verify_bag

ROOT = Path(__file__).resolve().parents[2]
START = 120.0
NODES = {
    "recorder": ["-p", "bag:=flight.mcap"],
    "planner": [],
    "coordinated_control": ["-p", "robot:=servicer", "-r", "__ns:=/other"],
    "plant": ["-p", "robot:=surveyor", "-p", "tick_rate:=20.0"],
}
"""The nodes and what they are started with, the plant last; the controller flies nothing."""


@dataclass
class Workspace:
    """A built workspace: its folder, that of the package in it, and what runs in it."""

    folder: Path
    prefix: Path
    domain: int
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def words(self, line: str) -> list[str]:
        return ["sh", "-e", "-c", f". {self.folder}/install/local_setup.sh; {line}"]

    @property
    def environment(self) -> dict[str, str]:
        """Nothing of the checkout: what is imported is what has been built."""
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        return {**kept, "PATH": path, "ROS_DOMAIN_ID": str(self.domain)}

    def output(self, line: str) -> str:
        """Return what a line of the terminal prints in the sourced workspace."""
        done = finished(self.words(line), cwd=self.folder, env=self.environment)
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def start(self, node: str, arguments: list[str]) -> None:
        """Start an executable of the package as `ros2 run` does, by its place."""
        program = self.prefix / "lib" / "spacerobot_ros" / node
        line = " ".join([f"exec {program} --ros-args", *arguments])
        with (self.folder / f"{node}.txt").open("wb") as said:
            self.processes[node] = subprocess.Popen(
                self.words(line),
                cwd=self.folder,
                env=self.environment,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )


@pytest.fixture
def workspace(tmp_path: Path, ros_domain: int) -> Iterator[Workspace]:
    source = tmp_path / "src" / "spacerobot_ros"
    left_out = shutil.ignore_patterns(".*", "out", "build", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, source, ignore=left_out)
    program = colcon_program(tmp_path / "colcon")
    found = run([program, "--log-base", os.devnull, "list", "--base-paths", source])
    assert found.split() == ["spacerobot_ros", str(source), "(ros.ament_python)"]
    run([program, "build", "--base-paths", "src"], cwd=tmp_path)
    shutil.rmtree(source)  # What runs is what is installed.
    built = Workspace(tmp_path, tmp_path / "install" / "spacerobot_ros", ros_domain)
    yield built
    for process in built.processes.values():
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(timeout=START)


def is_up_or_ended(process: subprocess.Popen[bytes], client: Client) -> bool:
    return process.poll() is not None or client.service_is_ready()


@pytest.mark.study
def test_the_built_package_is_found_and_its_nodes_fly(
    workspace: Workspace, harness: Harness
) -> None:
    share = workspace.prefix / "share" / "spacerobot_ros"
    lookup = "from ament_index_python.packages import get_package_share_directory as g; "
    where = "import spacerobot_ros as s; print(g('spacerobot_ros')); print(s.__file__)"
    found, module = workspace.output(f'python3 -c "{lookup}{where}"').splitlines()
    assert Path(found) == share
    assert Path(module).is_relative_to(workspace.prefix)
    for name in (
        *("package.xml", "config/servicer.yaml", "urdf/surveyor.urdf", "rviz/spacerobot.rviz"),
        *("meshes/surveyor/bus.stl", "launch/flight_stack.launch.py", "foxglove/spacerobot.json"),
    ):
        assert (share / name).is_file(), name

    probe = harness.probe({"odom": Odometry, "planner/status": DiagnosticStatus})
    for node, arguments in NODES.items():
        workspace.start(node, arguments)
    for node in NODES:
        namespace = "/other" if node == "coordinated_control" else ""
        client = probe.create_client(GetState, f"{namespace}/{node}/get_state")
        process = workspace.processes[node]
        harness.spin_until(partial(is_up_or_ended, process, client), f"{node} is up", START)
        said = workspace.folder / f"{node}.txt"
        assert process.poll() is None, said.read_text()
        state = harness.call(client, GetState.Request()).current_state
        assert state.label == "active", said.read_text()
    harness.spin_until(lambda: probe.count("odom") > 20, "the plant's states", timeout=START)
    for node, process in workspace.processes.items():
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=START) == 0, (workspace.folder / f"{node}.txt").read_text()
    # The recorder was the first to end.
    bag = read_bag(workspace.folder / "flight.mcap")
    assert len(bag["/odom"]) > 0
    urdf = next(data for name, data in bag.attachments.items() if name.endswith(".urdf"))
    assert b"package://spacerobot_ros/meshes/surveyor/bus.stl" in urdf


@pytest.mark.study
def test_the_built_command_flies_and_its_bag_verifies(workspace: Workspace) -> None:
    # The script asks for the Python that colcon runs with, which here has nothing but colcon.
    command = f"python3 {workspace.prefix / 'lib' / 'spacerobot_ros' / 'spacerobot'}"
    assert "surveyor" in workspace.output(f"{command} robots")
    workspace.output(f"{command} run planar_chain --bag chain.mcap")
    assert verify_bag(workspace.folder / "chain.mcap").difference is None
