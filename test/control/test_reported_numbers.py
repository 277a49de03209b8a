"""Numbers in the statuses of a controller: each kind is another, so that none is taken for one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.executive_loop import (
    PERIOD,
    SHAPE,
    SHAPE_IS_CONTROLLED,
    TIP,
    ExecutiveLoop,
    goal_at,
)

from spacerobot_ros.control import OutputSelection
from spacerobot_ros.control.executive import _command_report
from spacerobot_ros.control.limits import Saturated
from spacerobot_ros.control.state import Actuation
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal


def test_what_actuators_lose_is_reported_by_kind() -> None:
    loop = ExecutiveLoop()
    loop.answer()
    nothing = Actuation(np.zeros(6), np.zeros(2))
    lost = Actuation(np.array([3.0, 4.0, 12.0, -8.0, 9.0, 12.0]), np.array([0.5, -2.5]))
    report = _command_report(loop.executive.controller, Saturated(nothing, lost))
    assert report.lost_force_N == pytest.approx(13.0)
    assert report.lost_torque_Nm == pytest.approx(17.0)
    assert report.lost_effort == 2.5


def test_the_distances_of_a_message_are_euclidean_and_each_of_its_kind() -> None:
    loop = ExecutiveLoop(settle_time=0.02, time_limit=0.05, attitude_tolerance=0.002)
    loop.answer()
    loop.place = np.array([0.03, -0.04, 0.0])
    loop.answer(3)
    assert loop.status.message == "Waiting for a goal; holding, 0.05 m, 0 rad from the reference."
    loop.place = np.zeros(3)
    loop.aim(base=goal_at([0.3, 0.4, 0.0]), end_effector=goal_at(TIP))
    loop.answer()
    assert loop.status.message == "Flying to the goal; 0.5 m, 0 rad from the reference."
    loop.answer(8)
    left = "0.5 m, 0 rad from it (tolerance 0.001 m, 0.002 rad)"
    assert loop.status.message == f"The goal is not reached in time: {left}."


def test_a_goal_that_is_missed_is_as_far_as_the_goal_and_not_as_the_reference() -> None:
    """A smooth reference has hardly left the start when the time is over."""
    settings: dict[str, Any] = {"profile": "quintic", **SHAPE_IS_CONTROLLED}
    loop = ExecutiveLoop(time_limit=0.05, joint_tolerance=0.003, **settings)
    turned = np.array([0.0, 0.0, np.sin(0.1), np.cos(0.1)])
    goal = Goal(np.array([0.6, -0.8, 0.0]), turned, SHAPE + np.array([0.1, -0.3]))
    loop.aim(base=IdentifiedGoal(goal))
    loop.answer()
    assert loop.status.message.startswith("Flying to the goal; 0 m, ")
    loop.answer(8)
    left = "1 m, 0.2 rad, 0.3 at the joints"
    tolerance = "0.001 m, 0.001 rad, 0.003 at the joints"
    words = f"The goal is not reached in time: {left} from it (tolerance {tolerance})."
    assert loop.status.message == words


def test_the_distance_of_poses_is_the_larger_one_in_the_axes_that_are_controlled() -> None:
    selection = OutputSelection(("x", "rz", "y"), ("rx", "z", "ry"), ("elbow",), "tip")
    found = selection.distance(np.array([3.0, -0.5, 4.0, 0.6, -4.9, 0.8, -2.0]))
    assert (found.position, found.attitude, found.joints) == pytest.approx((5.0, 1.0, 2.0))
    assert str(found) == "5 m, 1 rad, 2 at the joints"
    joints = OutputSelection(joints=("elbow", "wrist")).distance(np.array([0.25, -0.5]))
    assert str(joints) == "0.5 at the joints"


def test_outputs_of_one_distance_are_grouped_by_frame_and_kind() -> None:
    selection = OutputSelection(("x", "rz", "y"), ("rx", "z", "ry"), ("elbow", "wrist"), "tip")
    assert selection.distances == (
        *(("position", (0, 2)), ("attitude", (1,)), ("position", (4,)), ("attitude", (3, 5))),
        *(("joints", (6,)), ("joints", (7,))),
    )
    assert OutputSelection(base=("rz",)).distances == (("attitude", (0,)),)


@pytest.mark.parametrize(("tolerance", "state"), [(0.049, "tracking"), (0.051, "reached")])
def test_a_goal_is_reached_by_the_distance_and_not_by_each_of_its_components(
    tolerance: float, state: str
) -> None:
    loop = ExecutiveLoop(settle_time=0.02, position_tolerance=tolerance)
    loop.place = np.array([0.27, 0.44, 0.0])  # 0.03 and -0.04 m off
    loop.aim(base=goal_at([0.3, 0.4, 0.0]), end_effector=goal_at(TIP + loop.place))
    loop.answer(8)
    assert loop.state == state
    errors = loop.executive.controller.errors()
    assert (errors.position, errors.attitude) == pytest.approx((0.05, 0.0))


def test_the_time_without_a_base_is_reported() -> None:
    loop = ExecutiveLoop(estimation_time=1.0)
    loop.answer(2)
    loop.answer(measured=False)
    assert loop.state == "holding", "one pose may be late"
    for count in (2, 3):
        loop.answer(measured=False)
        words = f"it is estimated since {count * PERIOD:.3g} s."
        assert loop.status.message.endswith(words)


@pytest.mark.parametrize(
    ("rate", "gap", "jumped"),
    [(100.0, 0.98, False), (100.0, 1.5, True), (2.0, 4.9, False), (2.0, 5.2, True)],
)
def test_a_gap_of_a_second_or_ten_periods_is_time_that_passes(
    rate: float, gap: float, jumped: bool
) -> None:
    loop = ExecutiveLoop(tick_rate=rate, settle_time=0.05, time_limit=0.5)
    loop.aim(base=goal_at([3.0, 0.0, 0.0]))
    loop.answer(3)
    assert loop.state == "tracking"
    loop.tick += round(gap / PERIOD)
    loop.answer()
    assert loop.state == ("tracking" if jumped else "failed")
