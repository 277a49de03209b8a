"""Obstacles on a topic: plans stop before them, and the plant measures distances to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nodes.test_end_effector_goals import ATTITUDE, NAMES, PLACE, START, URDF, flight_of, place
from nodes.test_verified_flights import Flight as RecordedFlight
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.hand_motion import end_of_motion
from support.planner_flight import values_of
from support.ros_harness import Harness

from spacerobot_ros.flight.reading import open_flight_bag, read_flight
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.report import write_report

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
HAND = "end_effector"


def box_at(position: npt.NDArray[np.float64]) -> String:
    """Return a URDF with a cube of 6 cm about a place in the world."""
    xyz = " ".join(map(repr, position.tolist()))
    return String(
        data='<robot name="w"><link name="w"/><link name="crate"><collision><geometry>'
        '<box size="0.06 0.06 0.06"/></geometry></collision></link>'
        f'<joint name="j" type="fixed"><parent link="w"/><child link="crate"/>'
        f'<origin xyz="{xyz}"/></joint></robot>'
    )


def test_obstacles_that_come_in_flight_stop_it_and_may_go_again(harness: Harness) -> None:
    flight = flight_of(
        harness,
        method="resolved_rate",
        abort_time=0.3,
        **{"resolved_rate.max_velocity": [0.06] * 3},
    )
    probe = flight.probe
    goals = probe.create_publisher(PoseStamped, "end_effector/goal_pose", 10)
    obstacles = probe.create_publisher(String, "obstacles", LATCHED)
    probe.watch("clearance", DiagnosticStatus)
    harness.connect()
    flight.start()
    urdf = URDF.read_text("utf-8")
    start = end_of_motion(urdf, NAMES, np.array([START]), [HAND], PLACE, ATTITUDE)[HAND][0]
    goal = start + np.array([0.14, -0.12, 0.05])
    goals.publish(place(goal, 1))
    flight.wait("executing")
    obstacles.publish(box_at(goal))
    status = flight.wait("failed")
    said = [each.message for each in probe.messages["planner/status"]]
    (braking,) = [each for each in said if "the joints brake" in each]
    assert braking.startswith("Link '")
    assert "and obstacle 'crate' " in braking
    assert braking.endswith(": the joints brake, and the remaining motion is planned again.")
    assert "The goal is not reached: " in status.message
    assert "On the way link '" in status.message
    assert "planner.clearance is 0.01 m" in status.message
    # The plant measures the distance to the crate, and the hand has stopped before it.
    flight.ticks(21)
    near = values_of(probe.last("clearance"))
    assert (near["second"], near["second_is"]) == ("crate", "obstacle")
    assert float(near["distance"]) > 0.01
    # Without obstacles the goal is reached.
    obstacles.publish(String(data=""))
    flight.ticks(2)
    goals.publish(place(goal, 2))
    assert values_of(flight.wait("reached"))["goal_id"] == "2.000000000"
    flight.ticks(21)
    assert "second_is" not in values_of(probe.last("clearance"))


@pytest.mark.slow
def test_a_bag_whose_obstacles_changed_is_verified_and_reported(
    harness: Harness, tmp_path: Path
) -> None:
    names = ["slider_1", "slider_2", "slider_3"]

    def answer(tick: int) -> Sequence[Any]:
        if tick in (13, 37):
            obstacles.publish(box_at(np.array([0.01 * tick, 0.0, 0.2])))
        flight.recorder.scan()
        return [JointState(name=names, velocity=[0.1, -0.05, 0.02])]

    plant = {"robot": "sliding_masses", "tick_rate": 20.0, "linear_momentum": [0.1, 0.0, -0.2]}
    flight = RecordedFlight(harness, tmp_path / "flown.mcap", plant, answer)
    obstacles = flight.probe.create_publisher(String, "obstacles", LATCHED)

    def heard() -> bool:
        flight.recorder.scan()
        return "/obstacles" in flight.recorder.topics

    harness.spin_until(heard, "the recorder hears obstacles")
    path = flight.fly()
    result = verify_bag(path)
    assert result.difference is None
    assert result.largest < 1e-12
    bag = open_flight_bag(path)
    assert bag.obstacles_change
    world = bag.obstacles[-1][1]
    assert world is not None
    np.testing.assert_allclose(world.frames["crate"][1].r, [0.37, 0.0, 0.2])
    assert read_flight(bag).clearance is None
    distances = [values_of(message) for _, message in bag.messages("clearance")]
    assert {each.get("second") for each in distances if "second_is" in each} == {"crate"}
    write_report(path, tmp_path / "report.html")
    assert "/obstacle 0 crate" in (tmp_path / "report.html").read_text("utf-8")
