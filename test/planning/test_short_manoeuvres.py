"""Manoeuvres of a few control periods, and robots of one joint or two."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.test_optimal import FOLDER, PERIOD, assert_within, momentum_attitude
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.urdf_text import link

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import plan
from spacerobot_ros.planning.methods.optimal.search import ManoeuvreSearch

ASKED: dict[str, Any] = {"cache": 0, "answers": 1, "intervals": 20, "control_period": PERIOD}


def hinged(*axes: str, height: float = 0.1) -> str:
    """Return a base with a chain of links that are hinged about these axes, as URDF."""
    parts = [link("l0", 100.0, np.diag([8.0, 9.0, 10.0]), np.array([0.05, 0.0, 0.0]))]
    for k, axis in enumerate(axes, start=1):
        parts.append(link(f"l{k}", 15.0, np.eye(3), np.array([0.6, 0.1, height])))
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="l{k - 1}"/><child link="l{k}"/>'
            f'<origin xyz="0.5 0.1 {height}"/><axis xyz="{axis}"/>'
            '<limit lower="-1.5" upper="2" velocity="0.7" effort="50"/></joint>'
        )
    return f'<robot name="hinged">{"".join(parts)}</robot>'


CHAIN = (FOLDER / "planar_chain.urdf").read_text(encoding="utf-8")
ARM = (FOLDER / "three_joint_arm.urdf").read_text(encoding="utf-8")
ONE, TWO = hinged("0 0 1", height=0.0), hinged("0 0 1", "0 1 0")


@pytest.mark.parametrize(
    ("urdf", "turn", "final", "most"),
    [
        (ONE, [0, 0, 1e-4], None, 2),
        (CHAIN, [0, 0, 1e-4], None, 2),
        (CHAIN, [0, 0, 0.02], None, 4),
        (CHAIN, [0, 0, 2e-4], [0.401, -0.301], 16),
        (TWO, [0, 0, 1e-4], None, 5),
        (TWO, [0.001, -0.002, 0.001], None, 12),
        (ARM, [2e-4, -1e-4, 2e-4], None, 8),
    ],
)
def test_small_goals_take_few_control_periods(
    urdf: str, turn: npt.ArrayLike, final: list[float] | None, most: int
) -> None:
    robot = SpaceRobot.from_urdf(urdf)
    start = np.linspace(0.4, -0.3, robot.n)
    schedule = plan(robot, rotvec=turn, start=start, joint_positions=final, **ASKED)
    assert 2 <= schedule.ticks <= most
    reached = momentum_attitude(PinocchioOracle(urdf, robot.joint_names), schedule)
    # Pinocchio's chords are of order four, and long.
    assert (reached.inv() * Rotation.from_rotvec(turn)).magnitude() <= 1e-7
    assert_within(schedule, robot.velocity_limit, robot.velocity_limit / 0.5)
    if final is not None:
        np.testing.assert_allclose(schedule.positions[-1], final, atol=1e-9)


def test_a_coarse_control_period_is_no_reason_to_take_long() -> None:
    robot = SpaceRobot.from_urdf(TWO)
    slow, quick = (
        plan(robot, rotvec=[0.1, 0.0, 0.1], **{**ASKED, "control_period": period})
        for period in (0.5, 0.05)
    )
    assert slow.ticks < 10
    assert slow.duration <= quick.duration + 2 * 0.5


def test_a_closed_loop_has_three_corners() -> None:
    """Out and back, in two control periods, turns nothing."""
    start = [1.5, -1.4]
    asked: dict[str, Any] = {**ASKED, "control_period": 0.5, "starts": 1}
    schedule = plan(
        "planar_chain", rotvec=[0, 0, 1e-5], joint_positions=start, start=start, **asked
    )
    assert 3 <= schedule.ticks <= 5
    assert abs(2 * schedule.path.quaternion[-1, 2] - 1e-5) <= 1e-8
    np.testing.assert_allclose(schedule.positions[-1], start, atol=1e-9)


def test_what_one_joint_cannot_reach_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, oracle = SpaceRobot.from_urdf(ONE), PinocchioOracle(ONE, ["j1"])
    # The base turns by the integral of the momentum's ratio, over the joint's travel from 0.3.
    shapes = np.linspace(0.3, 2.0, 400)
    middle = (shapes[1:] + shapes[:-1]) / 2
    rates = [-oracle.connection(np.array([q]))[5, 0] for q in middle]
    farthest = float(np.sum(rates) * (shapes[1] - shapes[0]))
    inside = plan(robot, rotvec=[0, 0, farthest * 0.999], start=[0.3], **ASKED)
    assert inside.positions[-1, 0] == pytest.approx(2.0, abs=0.01)

    def searching(*arguments: Any, **options: Any) -> None:
        raise AssertionError("searched")

    monkeypatch.setattr(ManoeuvreSearch, "search", searching)
    sentence = rf"joint 'j1', which is the only one, .* {farthest:.3f}\d* to .* rad from here"
    with pytest.raises(PlanningError, match=sentence):
        plan(robot, rotvec=[0, 0, farthest * 1.001], start=[0.3], **ASKED)
