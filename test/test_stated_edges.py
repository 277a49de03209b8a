"""Edges of small functions: the last value on one side and the first one on the other."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.campaign.statistics import influences
from spacerobot_ros.collision.distances import Solid
from spacerobot_ros.collision.geometry import _solid_in_world
from spacerobot_ros.collision.rounded_box import RoundedBox
from spacerobot_ros.commanding.planner import PlannerCommander
from spacerobot_ros.measures import METRICS
from spacerobot_ros.model.description import Pose, Shape
from spacerobot_ros.nodes.viewer import node as viewer_node
from spacerobot_ros.nodes.viewer.node import ViewerNode
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.methods.square_path import SquarePathGait
from spacerobot_ros.report import scene
from spacerobot_ros.times import LATEST_NS, SECOND, first_time_ns
from spacerobot_ros.viewer import content


def test_the_volume_of_a_rounded_box_is_that_of_its_parts() -> None:
    """Of boxes of equal edges with every corner and edge rounded, by counting points."""
    box = RoundedBox(Pose(), np.array([0.5, 0.3, 0.2]), 0.25)
    ends = box.half + box.radius
    points = np.random.default_rng(4).uniform(-ends, ends, (200_000, 3))
    beyond = np.maximum(np.abs(points) - box.half, 0.0)
    share = np.mean(np.linalg.norm(beyond, axis=1) <= box.radius)
    assert box.volume == pytest.approx(share * 8 * np.prod(ends), rel=6e-3)


def test_times_at_the_beginning_of_messages_are_limited_to_those_of_stamps() -> None:
    def of(seconds: int, nanoseconds: int) -> int:
        head = b"\x00\x01\x00\x00"
        return first_time_ns(
            head + seconds.to_bytes(4, "little", signed=True) + nanoseconds.to_bytes(4, "little")
        )

    assert of(3, 7) == 3 * SECOND + 7
    assert of(-1, 5) == 0
    assert of(2**31 - 1, 999_999_999) == LATEST_NS
    assert of(2**31 - 1, 999_999_998) == LATEST_NS - 1
    assert of(2**31 - 1, 2**32 - 1) == LATEST_NS


def test_metrics_whose_smallest_number_is_the_worst_are_margins_and_distances() -> None:
    assert {name for name, each in METRICS.items() if each.smallest_is_worst} == {
        name for name in METRICS if name.endswith(("_margin", "clearance_m"))
    }


def test_dispersions_that_do_not_vary_are_passed_over_and_the_next_ones_are_not() -> None:
    x = np.array([0.3, 0.1, 0.4, 0.2, 0.6])
    causes = {"still": np.ones(5), "moving": x, "turned": -x}
    metrics = {"none": np.full(5, np.nan), "same": np.zeros(5), "twice": 2 * x}
    found: list[Any] = [
        (each.cause, each.metric, each.correlation) for each in influences(causes, metrics)
    ]
    assert found == [
        ("moving", "twice", pytest.approx(1.0)),
        ("turned", "twice", pytest.approx(-1.0)),
    ]


@pytest.mark.parametrize(
    ("left", "duration", "share"),
    [(2.0, 5.0, 0.75), (9.0, 5.0, 0.0), (None, 5.0, None), (2.0, 0.0, None), (2.0, None, None)],
)
def test_there_is_no_share_where_nothing_is_flown(
    left: float | None, duration: float | None, share: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(content, "time_to_go", lambda state: left)
    planner = (
        None if duration is None else SimpleNamespace(manoeuvre_time_s=duration, remaining_s=3.0)
    )
    state: Any = SimpleNamespace(planner=planner)
    assert content.progress(state) == share


def test_the_page_asks_for_the_parameters_of_a_node_that_changed_and_that_it_knows() -> None:
    keys = list(viewer_node._NODES_WITH_PARAMETERS)[:2]
    asked: list[str] = []
    made: Any = SimpleNamespace(
        _full_names={keys[0]: "/ns/one", keys[1]: "/ns/two"},
        _remote_values={keys[0]: {}},
        _request_parameters=asked.append,
    )
    for name in ("/ns/two", "/ns/other", "/ns/one"):
        ViewerNode._on_parameter_change(made, SimpleNamespace(node=name))
    assert asked == [keys[0]]


@pytest.mark.parametrize("angle", [0.4, -0.4, 3.1, -3.1, 4.0, -2.5])
def test_the_angle_about_the_axis_is_the_shorter_way(angle: float) -> None:
    axis = np.array([0.0, 0.6, 0.8])
    start = Rotation.from_rotvec([0.2, -0.3, 0.5])
    made: Any = SimpleNamespace(_phase=SimpleNamespace(axis=axis), robot=None)
    state = RobotState(np.zeros(3), start.as_quat(), np.zeros(2))
    for sign in (1.0, -1.0):
        end = sign * (start * Rotation.from_rotvec(angle * axis)).as_quat()
        request = PlanRequest(state, Goal(np.zeros(3), end), Tolerance(1e-3, 1e-3))
        found = SquarePathGait._requested_turn(made, request)
        assert found == pytest.approx(math.remainder(angle, 2 * math.pi))


def test_vertices_of_an_obstacle_are_moved_with_its_pose() -> None:
    shape = Shape("mesh", (1.0, 1.0, 1.0), Pose())
    vertices = np.array([[0.1, 0.2, -0.3], [0.5, -0.1, 0.4], [0.0, 0.3, 0.2], [0.2, 0.2, 0.1]])
    box = RoundedBox(Pose(r=np.array([0.2, 0.0, 0.1])), np.array([0.3, 0.2, 0.4]), 0.05)
    R = Rotation.from_rotvec([0.3, -0.7, 0.4])
    pose = Pose(R.as_matrix(), np.array([1.5, -0.4, 0.9]))
    found = _solid_in_world(Solid("rock", 0, shape, box, vertices), pose)
    assert found.vertices is not None
    np.testing.assert_allclose(found.vertices, R.apply(vertices) + pose.r)
    np.testing.assert_allclose(found.enclosure.pose.r, R.apply([0.2, 0.0, 0.1]) + pose.r)
    np.testing.assert_allclose(found.shape.pose.r, pose.r)
    assert found.is_obstacle


@pytest.mark.parametrize(
    ("controls", "turned"),
    [([0, 1, 2], False), ([3], True), ([4], True), ([5], True), ([0, 4], True)],
)
def test_the_goal_of_an_end_effector_has_axes_where_an_angle_counts(
    controls: list[int], turned: bool
) -> None:
    goal = SimpleNamespace(position=np.array([0.3, 0.2, 0.1]), quaternion=np.array([0, 0, 0, 1.0]))
    report: Any = SimpleNamespace(
        base_goal=None,
        tool_targets=[SimpleNamespace(goal=goal)],
        link_goals={},
        controls=lambda part: controls if part == "end_effector" else [],
    )
    robot: Any = None
    commands = scene._goal_commands(report, robot, 2.0)
    axes = [each["path"] for each in commands if each["path"].endswith(("/x", "/y", "/z"))]
    assert len(set(axes)) == 3 * turned


@pytest.mark.parametrize("lost", ["executive", "robot"])
def test_twists_without_a_robot_are_told(lost: str) -> None:
    told: list[Any] = []
    made: Any = SimpleNamespace(
        active=True,
        plant=SimpleNamespace(refusal_of_goals=""),
        executive="executive",
        robot="robot",
        _log_fault=lambda *words: told.append(words),
    )
    setattr(made, lost, None)
    PlannerCommander.receive_twist(made, "hand", "world", np.zeros(3), np.zeros(3))
    ((key, sentence),) = told
    assert key == "twist"
    assert sentence.endswith("There is no robot on robot_description yet.")
