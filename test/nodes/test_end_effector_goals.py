"""Goals of end-effectors on topics: reached by another engine's account of the joint motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import PoseStamped
from scipy.spatial.transform import Rotation
from support.hand_motion import end_of_motion
from support.planner_flight import Flight, values_of
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, GoalFile, IdentifiedGoal
from spacerobot_ros.topics import goal_topic

URDF = Path(__file__).parents[2] / "urdf" / "three_joint_arm.urdf"
NAMES = ("shoulder_yaw", "shoulder_pitch", "elbow_pitch")
START, END = [0.4, -0.9, 1.1], [-0.2, -0.5, 1.6]
PLACE, ATTITUDE = [0.4, -0.3, 0.2], Rotation.from_rotvec([0.3, -0.5, 0.4])
TOLERANCE = 1e-6


def flight_of(harness: Harness, **planner: object) -> Flight:
    quick = {"optimal.answers": 1, "optimal.intervals": 30, "optimal.cache": 0}
    near = {"position_tolerance": TOLERANCE, "attitude_tolerance": TOLERANCE}
    start = {
        "initial_joint_positions": START,
        "initial_position": PLACE,
        "initial_orientation": ATTITUDE.as_quat().tolist(),
    }
    robot = {"robot": "three_joint_arm"}
    return Flight(
        harness,
        {**robot, **quick, **near, "method": "optimal", "end_effectors": ["link_3"], **planner},
        {**robot, **start},
    )


def reachable(link: str, end: npt.ArrayLike = END) -> npt.NDArray[np.float64]:
    way = START + np.linspace(0, 1, 40)[:, np.newaxis] * (np.asarray(end) - START)
    urdf = URDF.read_text("utf-8")
    return end_of_motion(urdf, NAMES, way, [link], PLACE, ATTITUDE)[link][0]


def place(position: npt.ArrayLike, sec: int = 0) -> PoseStamped:
    """Return a goal position; the orientation of zeros asks for no attitude."""
    message = PoseStamped()
    message.header.frame_id, message.header.stamp.sec = "world", sec
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = np.asarray(position).tolist()
    o.x = o.y = o.z = o.w = 0.0
    return message


def flown_to(flight: Flight, link: str) -> npt.NDArray[np.float64]:
    """Return where the joint states that were published put a link."""
    shapes = [
        [dict(zip(m.name, m.position, strict=True))[name] for name in NAMES]
        for m in flight.probe.messages["joint_states"]
    ]
    urdf = URDF.read_text("utf-8")
    return end_of_motion(urdf, NAMES, np.array(shapes), [link], PLACE, ATTITUDE)[link][0]


def await_reached(flight: Flight, goal_id: str) -> None:
    def is_reached() -> bool:
        found = [values_of(each) for each in flight.probe.messages["planner/status"]]
        return any(v.get("goal_id") == goal_id and v["state"] == "reached" for v in found)

    flight.harness.spin_until(is_reached, f"goal {goal_id} is reached")


def test_positions_on_the_topics_of_links_are_reached_one_after_the_other(harness: Harness) -> None:
    flight = flight_of(harness)
    aims = {
        "end_effector": reachable("end_effector"),
        "link_3": reachable("link_3", [0.5, -1.2, 0.6]),
    }
    topics = {
        link: flight.probe.create_publisher(PoseStamped, goal_topic(link), 10) for link in aims
    }
    harness.connect()
    flight.start()
    for number, (link, aim) in enumerate(aims.items(), 1):
        topics[link].publish(place(aim, number))
        await_reached(flight, f"{number}.000000000")
        np.testing.assert_allclose(flown_to(flight, link), aim, atol=1e-6)
        values = values_of(flight.probe.last("planner/status"))
        assert [float(x) for x in values[f"goal_of_{link}"].split()] == [
            float(f"{x:.9g}") for x in aim
        ]
        assert float(values["end_effector_position_error_m"]) <= TOLERANCE
        assert "goal" not in values, "the base is free"
        assert "position_error_m" not in values


def test_goals_of_one_stamp_are_one_goal(harness: Harness) -> None:
    flight = flight_of(harness)
    hand = flight.probe.create_publisher(PoseStamped, "end_effector/goal_pose", 10)
    link = flight.probe.create_publisher(PoseStamped, "link_3/goal_pose", 10)
    harness.connect()
    # Each could be reached, in another shape than the other.
    hand.publish(place(reachable("end_effector"), 7))
    link.publish(place(reachable("link_3", [0.5, -1.2, 0.6]), 7))
    harness.settle(flight.probe)
    flight.start()
    status = flight.wait("refused")
    assert values_of(status)["goal_id"] == "7.000000000"
    assert_one_sentence(status.message, "'end_effector' and 'link_3'", "independent coordinates")
    # Both parts are bound to each other; one alone is no such goal.
    hand.publish(place(reachable("end_effector"), 8))
    assert values_of(flight.wait("reached"))["goal_id"] == "8.000000000"
    aims = {each: reachable(each, [0.3, -1.0, 0.9]) for each in ("end_effector", "link_3")}
    hand.publish(place(aims["end_effector"], 9))
    link.publish(place(aims["link_3"], 9))
    await_reached(flight, "9.000000000")
    for each, aim in aims.items():
        np.testing.assert_allclose(flown_to(flight, each), aim, atol=1e-6)


def test_a_goal_of_a_link_goes_on_after_a_restart(harness: Harness, tmp_path: Path) -> None:
    path, aim = tmp_path / "goal.json", reachable("link_3")
    goal = Goal.of_end_effectors([EndEffectorGoal("link_3", aim)])
    GoalFile(str(path)).save({BASE_GOAL_KEY: IdentifiedGoal(goal, "7.000000000")})
    flight = flight_of(harness, resume_file=str(path))
    flight.start()
    assert values_of(flight.wait("reached"))["goal_id"] == "7.000000000"
    np.testing.assert_allclose(flown_to(flight, "link_3"), aim, atol=1e-6)
    assert not path.exists()


def test_a_planner_for_a_controller_leaves_the_end_effector_to_it(harness: Harness) -> None:
    flight = flight_of(harness, output="reference", end_effectors=[])
    assert flight.probe.count_subscribers("end_effector/goal_pose") == 0
