"""Feedback and results of actions as messages, whose types need not be built."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration

from spacerobot_ros.commanding.fly_to import FlyToResult, GoalErrors, Progress
from spacerobot_ros.nodes.common.fly_to import NavigateToPoseAction


class Feedback(SimpleNamespace):
    """As nav2_msgs/action/NavigateToPose has it."""

    def __init__(self) -> None:
        super().__init__(
            current_pose=None,
            navigation_time=Duration(),
            estimated_time_remaining=Duration(),
            distance_remaining=-1.0,
        )


class Result(SimpleNamespace):
    """As that of ROS 2 Jazzy."""

    def __init__(self) -> None:
        super().__init__(error_code=7, error_msg="")


ACTION = NavigateToPoseAction(SimpleNamespace(Feedback=Feedback, Result=Result))
POSE = np.array([0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8])


def seconds(duration: Any) -> float:
    return float(duration.sec + duration.nanosec / 1e9)


def test_the_course_of_a_goal_of_nav2() -> None:
    progress = Progress("executing", 12.5, 3.25, 4_500_000_000, POSE, GoalErrors(position=0.75))
    message = ACTION.feedback(progress, "map")
    assert seconds(message.navigation_time) == 3.25
    assert seconds(message.estimated_time_remaining) == 12.5
    assert message.distance_remaining == 0.75
    here = message.current_pose
    assert (here.header.frame_id, seconds(here.header.stamp)) == ("map", 4.5)
    place, turn = here.pose.position, here.pose.orientation
    found = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
    assert found == pytest.approx(POSE.tolist())


def test_what_is_not_known_is_zero() -> None:
    message = ACTION.feedback(Progress("planning", None, 1.0, 0, None, GoalErrors()), "map")
    assert seconds(message.estimated_time_remaining) == message.distance_remaining == 0.0
    assert message.current_pose is None


def test_the_result_of_a_goal_of_nav2() -> None:
    reached = ACTION.result(FlyToResult("reached", "There.", GoalErrors()))
    assert (reached.error_code, reached.error_msg) == (0, "")
    failed = ACTION.result(FlyToResult("failed", "Not there.", GoalErrors()))
    assert failed.error_code > 0
    assert failed.error_msg == "Not there."
