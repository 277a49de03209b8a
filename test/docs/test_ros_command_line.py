"""The blocks for a ROS machine, as printed, with the command line of ROS where there is one."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support.command_line import finished
from support.planner_flight import values_of
from support.ros_harness import Harness, Probe

from docs_build.blocks import blocks
from spacerobot_ros.bag import read_bag

ROOT = Path(__file__).resolve().parents[2]
STAYS = ("ros2 run ", "ros2 launch ", "spacerobot up ")
"""What commands begin with that go on until Ctrl-C."""

LONGEST = 120.0
STATUSES = ("planner/status", "controller/status", "plant/status")

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(shutil.which("ros2") is None, reason="the command ros2 is not installed"),
]


def commands(page: str, *words: str) -> list[str]:
    """Return the commands of the first block of a page with some words, each on one line."""
    texts = [each.text for each in blocks((ROOT / page).read_text("utf-8"))]
    text = next(each for each in texts if all(word in each for word in words))
    found, open_quote = [""], False
    for line in text.splitlines():
        if not open_quote:
            line = re.sub(r"\s+#.*|^#.*", "", line)
        found[-1] += line.removesuffix("\\")
        open_quote = found[-1].count("'") % 2 == 1
        if open_quote:
            found[-1] += "\n"
        elif not line.endswith("\\"):
            found.append("")
    return [each for each in found if each.strip()]


class Terminals:
    """Commands in terminals of their own, each a process group; Ctrl-C reaches all of a group."""

    def __init__(self, harness: Harness, folder: Path, domain: int) -> None:
        self.harness, self.folder = harness, folder
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "")
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            # Installed by pip, the package lies in the prefix of Python.
            "AMENT_PREFIX_PATH": os.pathsep.join(filter(None, (sys.prefix, prefixes))),
        }
        self.staying: dict[str, subprocess.Popen[bytes]] = {}
        self.logs: list[Path] = []

    def do(self, command: str) -> None:
        """Start a command that stays, or do another one to its end, which is to be good."""
        if command.startswith(STAYS):
            log = self.folder / f"{len(self.logs)}.txt"
            self.logs.append(log)
            with log.open("wb") as said:
                self.staying[command] = subprocess.Popen(
                    ["bash", "-c", f"exec {command}"],
                    cwd=self.folder,
                    env=self.environment,
                    stdout=said,
                    stderr=said,
                    start_new_session=True,
                )
            return
        done = finished(
            ["bash", "-e", "-c", command], cwd=self.folder, env=self.environment, timeout=LONGEST
        )
        assert done.returncode == 0, (command, done.stdout, done.stderr, self.said)

    def wait(self, predicate: Callable[[], Any], what: str) -> None:
        """Wait for something that a probe hears."""
        try:
            self.harness.spin_until(predicate, what, LONGEST)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.said}") from None

    @property
    def said(self) -> str:
        return "\n".join(f"--- {log.stem}\n{log.read_text()}" for log in self.logs)

    @property
    def complaints(self) -> list[str]:
        return [
            line
            for line in self.said.splitlines()
            if re.search(r"\[(WARN|ERROR|FATAL)\]|Traceback", line)
        ]

    def interrupt(self) -> dict[str, int]:
        """Press Ctrl-C in every terminal, and return the exit codes by command."""
        for command, process in self.staying.items():
            # Without a terminal launch passes the signal on: nodes would have two.
            alone = command.startswith("ros2 launch")
            (os.kill if alone else os.killpg)(process.pid, signal.SIGINT)
        codes = {name: process.wait(LONGEST) for name, process in self.staying.items()}
        self.staying.clear()
        return codes

    def close(self) -> None:
        for process in self.staying.values():
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(LONGEST)
        subprocess.run(
            ["ros2", "daemon", "stop"], env=self.environment, capture_output=True, check=False
        )


@pytest.fixture
def terminals(harness: Harness, tmp_path: Path, ros_domain: int) -> Iterator[Terminals]:
    opened = Terminals(harness, tmp_path, ros_domain)
    yield opened
    opened.close()


@pytest.fixture
def probe(harness: Harness) -> Probe:
    return harness.probe(
        {"odom": Odometry, **dict.fromkeys(STATUSES, DiagnosticStatus)}, latched=STATUSES
    )


def state(probe: Probe, topic: str) -> str:
    kept = probe.messages[topic]
    return values_of(kept[-1]).get("state", "") if kept else ""


def goal(x: float) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = "world"
    message.pose.position.x, message.pose.orientation.w = x, 1.0
    message.header.stamp.sec = int(time.time())
    return message


@pytest.mark.parametrize("page", ["README.md", "docs/operation.md"])
@pytest.mark.parametrize(
    ("node", "topic", "x"),
    [("planner", "planner/status", 0.05), ("coordinated_control", "controller/status", 0.2)],
)
def test_nodes_that_are_run_one_by_one_fly_to_a_goal(
    terminals: Terminals, probe: Probe, page: str, node: str, topic: str, x: float
) -> None:
    for line in commands(page, "ros2 topic pub", f"spacerobot_ros {node}\n"):
        terminals.do(line)
    terminals.wait(
        lambda: state(probe, topic) in ("reached", "failed", "refused", "aborted"), "a decision"
    )
    assert state(probe, topic) == "reached", terminals.said
    terminals.wait(lambda: probe.count("odom") > 0, "the base where it has come to")
    assert abs(probe.last("odom").pose.pose.position.x - x) < 2e-3
    # `ros2 run` ends as its node, or by the signal that the terminal has sent it, too.
    assert set(terminals.interrupt().values()) <= {0, -signal.SIGINT}, terminals.said
    assert terminals.complaints == [], terminals.said
    (bag,) = terminals.folder.glob("*.mcap")
    assert len(read_bag(bag)["/odom"]) > 10
    if page == "README.md":
        replay = "ros2 run spacerobot_ros replay --ros-args -p bag:=flight.mcap"
        assert f"`{replay}`" in (ROOT / page).read_text("utf-8")
        heard = probe.count("odom")
        terminals.do(replay)
        terminals.wait(lambda: probe.count("odom") > heard + 10, "the bag")


def test_the_launch_file_starts_a_scenario(terminals: Terminals, probe: Probe) -> None:
    (line,) = commands("docs/operation.md", "scenario:=coordinated_control")
    assert f"`{line}`" in (ROOT / "README.md").read_text("utf-8")
    terminals.do(line)
    terminals.wait(
        lambda: state(probe, "controller/status") == "holding" and probe.count("odom") > 200,
        "the robot is held",
    )
    (code,) = terminals.interrupt().values()
    assert code == 0, terminals.said
    assert terminals.complaints == []


def test_two_launches_fly_in_namespaces(terminals: Terminals, harness: Harness) -> None:
    lines = commands("docs/reference/operation.md", "namespace:=robot_1", "namespace:=robot_2")
    topics = {f"/{name}/odom": Odometry for name in ("robot_1", "robot_2")}
    status = {"/robot_1/planner/status": DiagnosticStatus}
    both = harness.probe({**topics, **status}, latched=tuple(status), name="both")
    goals = both.create_publisher(PoseStamped, "/robot_1/goal_pose", 10)
    for line in lines:
        if line.startswith("ros2 launch"):
            terminals.do(line)
    terminals.wait(lambda: all(both.count(topic) > 20 for topic in topics), "states")
    goals.publish(goal(0.05)) if harness.matched(goals, 2) else None
    terminals.wait(lambda: state(both, "/robot_1/planner/status") == "reached", "the goal")
    assert abs(both.last("/robot_2/odom").pose.pose.position.x) < 0.02
    assert set(terminals.interrupt().values()) == {0}, terminals.said


def test_a_stack_without_the_ros_command_flies_in_a_namespace(
    terminals: Terminals, harness: Harness
) -> None:
    lines = commands("docs/reference/operation.md", "namespace:=robot_1", "namespace:=robot_2")
    for line in lines:
        if line.startswith("spacerobot"):
            terminals.do(line)
    assert set(terminals.interrupt().values()) == {0}, terminals.said


def test_parameters_are_set_between_two_lives(
    terminals: Terminals, harness: Harness, probe: Probe
) -> None:
    terminals.do("ros2 run spacerobot_ros plant --ros-args -p robot:=sliding_masses")
    probe.watch("joint_states", JointState)
    terminals.wait(lambda: probe.count("joint_states") > 0, "states")
    assert len(probe.last("joint_states").name) == 3
    # The command looks for the node for half a second, in which a busy machine does not find it.
    terminals.do("until ros2 param dump /plant; do :; done")
    for line in commands("docs/reference/operation.md", "ros2 lifecycle set", "ros2 param set"):
        terminals.do(line)
    terminals.wait(lambda: len(probe.last("joint_states").name) == 6, "states of the other robot")
    assert set(terminals.interrupt().values()) <= {0, -signal.SIGINT}, terminals.said


def test_a_planner_is_run_beside_a_trajectory_controller(
    terminals: Terminals, harness: Harness, probe: Probe
) -> None:
    from trajectory_msgs.msg import JointTrajectory

    topic = "/joint_trajectory_controller/joint_trajectory"
    probe.watch(topic, JointTrajectory, latched=True)
    (line,) = commands("docs/reference/operation.md", "-r gait_schedule:=")
    terminals.do("ros2 run spacerobot_ros plant --ros-args -p robot:=sliding_masses")
    terminals.do(line)
    goals = probe.create_publisher(PoseStamped, "goal_pose", 10)
    terminals.wait(lambda: goals.get_subscription_count() > 0, "the planner")
    goals.publish(goal(0.05))
    terminals.wait(lambda: probe.count(topic) > 0, "a schedule")
    assert len(probe.last(topic).points) > 2
    assert set(terminals.interrupt().values()) <= {0, -signal.SIGINT}, terminals.said


def test_a_goal_is_sent_as_an_action(terminals: Terminals, harness: Harness, probe: Probe) -> None:
    from support.interface_package import SPACEROBOT_MSGS, with_interfaces

    built = with_interfaces(SPACEROBOT_MSGS)
    for name, path in built.items():
        before = terminals.environment.get(name, "")
        terminals.environment[name] = os.pathsep.join(filter(None, (path, before)))
    terminals.do("ros2 run spacerobot_ros plant --ros-args -p robot:=sliding_masses")
    terminals.do("ros2 run spacerobot_ros planner")
    terminals.wait(lambda: state(probe, "planner/status") == "idle", "the planner")
    (line,) = commands("docs/actions.md", "ros2 action send_goal")
    terminals.do(line)
    terminals.wait(lambda: state(probe, "planner/status") == "reached", "the goal")
    assert set(terminals.interrupt().values()) <= {0, -signal.SIGINT}, terminals.said


@pytest.mark.parametrize(
    ("page", "topic", "key"),
    [
        ("docs/faults.md", "/fault_injection", "faults"),
        ("docs/disturbances.md", "/disturbance_injection", "disturbances"),
    ],
)
def test_lines_that_are_published_act_on_the_plant(
    terminals: Terminals, probe: Probe, page: str, topic: str, key: str
) -> None:
    for line in commands(page, "ros2 run", topic):
        terminals.do(line)
    terminals.wait(
        lambda: any(
            "until 60" in values_of(status).get(key, "")
            for status in probe.messages["plant/status"]
        ),
        f"the plant's {key}",
    )
    assert set(terminals.interrupt().values()) <= {0, -signal.SIGINT}, terminals.said
