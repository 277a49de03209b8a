"""Flights of executables with nothing but a robot: reached, without a warning, recorded whole."""

from __future__ import annotations

import math
import os
import re
import sys
from pathlib import Path

import pytest
from support.command_line import finished
from support.interface_package import SPACEROBOT_MSGS, with_interfaces
from support.nodes_apart import NodesApart
from support.planner_flight import Place, values_of
from support.slow import some_fast
from support.warm_python import WarmPython

ROOT = Path(__file__).parents[2]
COMMAND = ("-m", "spacerobot_ros.cli.main")

FREE_FLYER = """<robot name="cube">
  <link name="hull"><inertial><mass value="12"/>
    <inertia ixx="0.2" iyy="0.25" izz="0.3" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""
"""A spacecraft without joints."""

ANYWHERE = [math.nan] * 3
"""A position that is not asked for."""

PLANNED: dict[str, Place] = {
    "sliding_masses": ([0.05, 0.0, 0.0], [0.0, 0.0, 0.0]),
    "three_joint_arm": (ANYWHERE, [0.02, 0.01, 0.05]),
    "planar_chain": (ANYWHERE, [0.0, 0.0, 0.3]),
    "surveyor": (ANYWHERE, [0.0, 0.0, 0.1]),
    "seven_joint_arm": (ANYWHERE, [0.05, 0.0, 0.05]),
}
CONTROLLED: dict[str, Place] = {
    "planar_manipulator": ([0.2, 0.1, 0.0], [0.0, 0.0, 0.2]),
    "servicer": ([0.2, 0.0, 0.0], [0.0, 0.0, 0.0]),
    "three_joint_arm": ([0.1, 0.1, 0.0], [0.0, 0.0, 0.2]),
    "cube": ([0.2, -0.1, 0.1], [0.1, 0.0, 0.2]),
}
FLIGHTS = [
    *(("planner", robot) for robot in PLANNED),
    *(("coordinated_control", robot) for robot in CONTROLLED),
]
FURTHER: dict[str, Place] = dict.fromkeys(
    ("free_flyer", "dual_arm", "seven_joint_arm", "planar_chain", "tender"),
    ([0.1, 0.05, 0.0], [0.0, 0.0, 0.1]),
)
"""Robots that are flown by coordinated control to a goal on the topic alone."""

CONTROLLED |= FURTHER
TOPIC_FLIGHTS = [*FLIGHTS, *(("coordinated_control", robot) for robot in FURTHER)]
QUICK = ("planner", "sliding_masses")
SLOW = [
    *(("coordinated_control", name) for name in ("planar_manipulator", "servicer")),
    ("planner", "surveyor"),
]


def begin(apart: NodesApart, node: str, robot: str) -> None:
    """Start a commander and a recorder with a robot of the package, or with that of a file."""
    file = apart.folder / "cube.urdf"
    file.write_text(FREE_FLYER)
    apart.start("plant", robot=file if robot == "cube" else robot)
    apart.start(node)
    apart.start("recorder")


def check_record(apart: NodesApart, python: WarmPython) -> None:
    """Report, draw and replay the only bag in the folder; verification says that it cannot."""
    (bag,) = apart.folder.glob("*.mcap")
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(apart.domain),
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "agg",
    }

    def spacerobot(*words: str, code: int = 0) -> str:
        done = python.run([*COMMAND, *words], apart.folder, environment, timeout=300.0)
        assert done.returncode == code, (words, done.stdout, done.stderr)
        return done.stdout + done.stderr

    # Nothing records which command a plant held in which tick of the wall clock.
    assert "only lockstep flights can be verified" in spacerobot("verify", bag.name, code=2)
    spacerobot("report", bag.name)
    assert bag.with_suffix(".html").stat().st_size > 10_000
    spacerobot("figures", bag.name, "--format", "svg", "--out", "figures")
    assert list((apart.folder / "figures").glob("*.svg"))
    heard = apart.probe.count("odom")
    spacerobot("replay", bag.name, "--rate", "20")
    apart.wait(lambda: apart.probe.count("odom") > heard + 10, "the bag's states have come again")


@pytest.mark.parametrize(("node", "robot"), some_fast(TOPIC_FLIGHTS, QUICK, slow=SLOW))
def test_a_goal_on_the_topic_is_reached(
    apart: NodesApart, warm_python: WarmPython, node: str, robot: str
) -> None:
    begin(apart, node, robot)
    place = (PLANNED if node == "planner" else CONTROLLED)[robot]
    apart.fly(node, place)
    apart.end()
    assert apart.complaints == []
    check_record(apart, warm_python)


@pytest.mark.study
@pytest.mark.parametrize(("node", "robot"), FLIGHTS)
def test_a_goal_of_an_action_is_reached(
    apart: NodesApart, warm_python: WarmPython, node: str, robot: str
) -> None:
    apart.environment = with_interfaces(SPACEROBOT_MSGS)
    begin(apart, node, robot)
    client = apart.folder / "client.py"
    client.write_text(CLIENT)
    position, rotvec = (PLANNED if node == "planner" else CONTROLLED)[robot]
    done = finished(
        [sys.executable, client.name, f"{node}/fly_to", *map(str, [*position, *rotvec])],
        cwd=apart.folder,
        env={**os.environ, **apart.environment, "ROS_DOMAIN_ID": str(apart.domain)},
        timeout=300,
    )
    assert done.returncode == 0, (done.stderr, apart.said)
    feedback, outcome = done.stdout.split()
    assert outcome == "reached", (done.stdout, apart.said)
    assert int(feedback) > 0
    apart.end()
    assert apart.complaints == []
    check_record(apart, warm_python)
    (bag,) = apart.folder.glob("*.mcap")
    assert f"/{node}/fly_to/_action/feedback".encode() in bag.read_bytes()


CLIENT = """
import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from scipy.spatial.transform import Rotation
from spacerobot_msgs.action import FlyTo

rclpy.init()
node = rclpy.create_node("client")
client = ActionClient(node, FlyTo, sys.argv[1])
client.wait_for_server()
x, y, z, *rotvec = map(float, sys.argv[2:])
pose = PoseStamped()
pose.header.frame_id = "world"
pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = x, y, z
o = pose.pose.orientation
o.x, o.y, o.z, o.w = Rotation.from_rotvec(rotvec).as_quat().tolist()
heard = []
sent = client.send_goal_async(FlyTo.Goal(base_pose=[pose]), feedback_callback=heard.append)
rclpy.spin_until_future_complete(node, sent)
result = sent.result().get_result_async()
rclpy.spin_until_future_complete(node, result)
print(result.result().result.message, file=sys.stderr)
print(len(heard), result.result().result.outcome)
"""
"""A program of another that sends a goal by the action, and prints what becomes of it."""


COMMAND_TIMEOUT = 0.5
"""s without a command after which a plant rests, by default."""


def turned(k: int) -> Place:
    """Return a place that is none of the others, and far from the one before."""
    sign = 1.0 if k % 2 else -1.0
    return (ANYWHERE, [0.03 * sign + 0.001 * k, 0.0, 0.04 * sign])


def slid(k: int) -> Place:
    sign = 1.0 if k % 2 else -1.0
    return ([0.1 * sign + 0.001 * k, 0.02 * sign, 0.0], [0.0, 0.0, 0.0])


def replace_in_motion(apart: NodesApart, first: Place, second: Place) -> None:
    """Send a goal while the robot moves to another; the second is flown, the first replaced."""
    began = apart.send(first)
    apart.wait(
        lambda: any(state == "executing" for state, _ in apart.told("planner", began)),
        "the robot moves",
    )
    then = apart.send(second)
    state, message = apart.decision("planner", then)
    assert state == "reached", f"{message}\n{apart.said}"

    def replaced() -> bool:
        heard = [*apart.probe.messages["planner/status"], *apart.probe.messages["events"]]
        return any("replace" in m.message and values_of(m).get("goal_id") == began for m in heard)

    apart.wait(replaced, "the first goal is reported as replaced", 5.0)


@pytest.mark.parametrize(
    ("robot", "count"),
    [
        pytest.param("sliding_masses", 1, marks=pytest.mark.slow),
        pytest.param("sliding_masses", 10, marks=pytest.mark.study),
        pytest.param("seven_joint_arm", 10, marks=pytest.mark.study),
    ],
)
def test_second_goals_in_motion_are_flown(apart: NodesApart, robot: str, count: int) -> None:
    """By a robot whose plans are quick, and by one whose plans take seconds."""
    place = slid if robot == "sliding_masses" else turned
    apart.start("plant", robot=robot)
    apart.start("planner")
    for k in range(count):
        replace_in_motion(apart, place(2 * k + 1), place(2 * k + 2))
    if robot == "seven_joint_arm":
        took = re.findall(r"Planned in ([\d.e-]+) s", apart.said)
        assert max(map(float, took)) > COMMAND_TIMEOUT
    apart.end()
    # The planner may say that a plan was late; the plant has never been without commands.
    complaints = [line for line in apart.complaints if "replaced" not in line]
    assert [line for line in complaints if count == 1 or line.startswith("/plant")] == []


SLIDE: Place = ([0.05, 0.0, 0.0], [0.0, 0.0, 0.0])
TURN: Place = ([0.1, 0.05, 0.0], [0.0, 0.0, 0.1])
SLIDE_AND_TURN = {
    "planner": ("sliding_masses", SLIDE),
    "coordinated_control": ("planar_manipulator", TURN),
}
RATES = [(node, rate) for node in SLIDE_AND_TURN for rate in (5.0, 10.0, 50.0, 200.0)]


@pytest.mark.parametrize(
    ("node", "rate"),
    some_fast(
        RATES,
        slow=[("planner", 10.0), ("planner", 200.0)]
        + [("coordinated_control", rate) for rate in (5.0, 50.0)],
    ),
)
def test_a_plant_of_any_rate_is_followed(apart: NodesApart, node: str, rate: float) -> None:
    robot, place = SLIDE_AND_TURN[node]
    apart.start("plant", robot=robot, tick_rate=rate)
    apart.start(node)
    apart.start("recorder")
    apart.fly(node, place)
    assert apart.status("plant")["tick_rate_hz"] == f"{rate:g}"
    apart.end()
    assert apart.complaints == []
