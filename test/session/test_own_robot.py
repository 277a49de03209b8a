"""Notes on robots of users, their first shape and turn, with stand-ins for robots."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.session import own_robot
from spacerobot_ros.session.own_robot import first_problem, first_shape, first_turn, urdf_remarks
from spacerobot_ros.simulation.config import PlantConfig


def joint(**limits: Any) -> Any:
    """Return a joint with usual limits, but for the given ones."""
    usual = {"lower": -1.0, "upper": 2.0, "velocity": 1.0, "effort": 5.0}
    unit = limits.pop("unit", "rad")
    return SimpleNamespace(name="elbow", unit=unit, limits=SimpleNamespace(**(usual | limits)))


def described(base: float = 30.0, total: float = 40.0, about_com: Any = None, **parts: Any) -> Any:
    inertia = SimpleNamespace(mass=base, about_com=np.eye(3) if about_com is None else about_com)
    shape = SimpleNamespace(kind="box", resource="")
    link = SimpleNamespace(name="base", shapes=[shape], inertia=inertia)
    usual: dict[str, Any] = {"movable_joints": [], "links": [link], "end": "hand"}
    usual |= parts
    return SimpleNamespace(
        total_mass=total, bodies=[SimpleNamespace(inertia=inertia)], base_link="base",
        movable_joints=usual["movable_joints"], links=usual["links"],
        end_effector=lambda: usual["end"],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("robot", "note"),
    [
        (described(), None),
        (described(base=2.0, total=12.0), None),
        (described(base=1.9, total=11.9), "has 1.9 kg and carries 10 kg: it moves more"),
        (described(base=500.0, total=501.0), None),
        (described(base=501.0, total=502.0), "has 501 kg, 501 times its load: the joints hardly"),
        (described(base=1.0, total=1.0), None),
        (described(about_com=np.zeros((3, 3))), "is a point mass"),
        (described(base=0.0, total=0.0, about_com=np.zeros((3, 3))), None),
        (described(movable_joints=[joint()]), None),
        (described(movable_joints=[joint(velocity=0.0)]),
         'cannot move: give <limit velocity="..."/> in rad/s.'),
        (described(movable_joints=[joint(velocity=1e-3)]), None),
        (described(movable_joints=[joint(velocity=9e-4, unit="m")]), "moves at up to 0.0009 m/s"),
        (described(movable_joints=[joint(velocity=50.0)]), None),
        (described(movable_joints=[joint(velocity=50.1)]), "moves at up to 50.1 rad/s"),
        (described(movable_joints=[joint(velocity=math.inf)]),
         'has no velocity limit, within which gaits are planned: give <limit velocity="..." '
         'effort="..."/> in rad/s and N m.'),
        (described(movable_joints=[joint(upper=12.5)]), None),
        (described(movable_joints=[joint(upper=12.6)]), "turns from -1 to 12.6 rad"),
        (described(movable_joints=[joint(lower=-90.0)]), "turns from -90 to 2 rad"),
        (described(movable_joints=[joint(upper=90.0, unit="m")]), None),
        (described(movable_joints=[joint(lower=-math.inf, upper=math.inf)]), None),
        (described(movable_joints=[joint(effort=0.0)]), "the effort limit 0"),
        (described(end=None), "No link is called 'end_effector'"),
    ],
)  # fmt: skip
def test_unusual_values_are_told(robot: Any, note: str | None) -> None:
    notes = list(urdf_remarks(robot))
    assert len(notes) == (note is not None)
    for each in notes:
        assert note is not None
        assert note in each


@pytest.mark.parametrize(("others", "said"), [
    (0, "not in degrees."),
    (1, "not in degrees. The same holds for 1 other joint."),
    (5, "not in degrees. The same holds for 5 other joints."),
])  # fmt: skip
def test_a_note_on_many_joints_is_told_once(others: int, said: str) -> None:
    joints = [joint(), *(joint(upper=90.0) for _ in range(others + 1))]
    (note,) = urdf_remarks(described(movable_joints=joints))
    assert note.endswith(said)


@pytest.mark.parametrize(("missing", "said"), [(1, "'mesh 0' was"), (3, "'mesh 0' and 2 more was")])
def test_meshes_that_are_missing_are_counted(
    monkeypatch: pytest.MonkeyPatch, missing: int, said: str
) -> None:
    monkeypatch.setattr(
        own_robot, "mesh_file", lambda name: Path(name) if name == "there" else None
    )
    names = ["there", *(f"mesh {i}" for i in range(missing))]
    shapes = [SimpleNamespace(kind="mesh", resource=name) for name in names]
    robot = described()
    robot.links[0].shapes = shapes
    (note,) = urdf_remarks(robot)
    assert note.startswith(f"The mesh {said} not found")
    robot.links[0].shapes = []
    (note,) = urdf_remarks(robot)
    assert note.startswith("No link has a <visual>")


INF = math.inf


def test_the_first_shape_is_far_from_all_limits() -> None:
    limits = np.array([
        # lower, upper, and where the joint is: zero unless it is within a third of the range.
        [-1.0, 1.9, 0.0], [-1.0, 2.1, 0.55], [-2.1, 1.0, -0.55], [-1.9, 1.0, 0.0],
        [1.0, 2.5, 1.75], [0.0, 4.0, 2.0], [-0.001, 0.0018, 0.0],
        [-INF, INF, 0.0], [0.25, INF, 0.25], [-INF, -0.5, -0.5], [0.12345, 0.12347, 0.123],
    ])  # fmt: skip
    robot: Any = SimpleNamespace(lower=limits[:, 0], upper=limits[:, 1])
    np.testing.assert_allclose(first_shape(robot), limits[:, 2], atol=1e-12)


def robot_with(F: Any, lower: Any, upper: Any) -> Any:
    """Return a robot whose joints turn the base by F (3, n)."""
    whole = np.vstack([np.full((3, np.shape(F)[1]), 7.0), F])
    return SimpleNamespace(
        connection=lambda shape: whole, lower=np.array(lower), upper=np.array(upper)
    )


DEG = math.radians(1.0)


@pytest.mark.parametrize(
    ("F", "lower", "upper", "turn"),
    [
        # About z if that is possible within half of the room, ...
        (np.diag([1.0, 1.0, 0.2]), [-1.0] * 3, [1.0] * 3, [0, 0, 5]),
        # ... else about y or x, in this order; more than one rad of room does not count.
        (np.diag([1.0, 0.18, 0.17]), [-1.0] * 3, [1.0] * 3, [0, 5, 0]),
        (np.diag([0.18, 0.17, 0.17]), [-9.0] * 3, [9.0] * 3, [5, 0, 0]),
        (np.diag([1.0, 0.2, 0.4]), [-1.0, -1.0, -1.0], [1.0, 1.0, 0.44], [0, 0, 5]),
        (np.diag([1.0, 0.2, 0.4]), [-1.0, -1.0, -0.43], [1.0, 1.0, 1.0], [0, 5, 0]),
        # Light arms: as far as half of their room turns it, about the axis that is turned most.
        (np.diag([0.03, 0.02, 0.01]), [-1.0] * 3, [1.0] * 3, [0.86, 0, 0]),
        (np.diag([0.01, -0.04, 0.01]), [-1.0] * 3, [1.0] * 3, [0, 1.1, 0]),
        # And not at all: then as usual.
        (np.diag([0.005, 0.001, 0.001]), [-1.0] * 3, [1.0] * 3, [0, 0, 5]),
    ],
)
def test_the_first_turn_needs_half_of_the_room(
    F: Any, lower: list[float], upper: list[float], turn: list[float]
) -> None:
    found = first_turn(robot_with(F, lower, upper), np.zeros(3), np.eye(3))
    np.testing.assert_allclose(found, np.array(turn) * DEG, atol=1e-9)


def test_a_robot_with_one_axis_turns_about_it() -> None:
    axis = np.array([[0.6, 0.0, 0.8]])
    robot = robot_with(axis.T * [[0.5, 0.25]], [-1.0, -1.0], [1.0, 1.0])
    found = first_turn(robot, np.zeros(2), axis)
    np.testing.assert_allclose(found, 5 * DEG * axis[0], atol=1e-9)


@pytest.mark.parametrize(
    ("moves", "how"), [(True, "only to and fro along one curve"), (False, "not at all")]
)
def test_a_robot_whose_joints_do_not_turn_it_has_no_first_flight(
    monkeypatch: pytest.MonkeyPatch, moves: bool, how: str
) -> None:
    turning = SimpleNamespace(of=lambda robot: SimpleNamespace(axes=[], turns_base=moves))
    monkeypatch.setattr(own_robot, "BaseRotations", turning)
    robot: Any = SimpleNamespace(description=SimpleNamespace(name="fixed"))
    with pytest.raises(PlanningError, match=f"'fixed' turn its base {how}"):
        first_problem("a", robot, Path("a.urdf"))


@pytest.mark.parametrize(("degrees", "tolerance"), [(5.0, 1e-3), (0.3, 1e-4), (0.51, 2e-4)])
def test_the_tolerance_is_a_fiftieth_of_a_small_turn(
    monkeypatch: pytest.MonkeyPatch, degrees: float, tolerance: float
) -> None:
    axes = np.eye(3)
    turning = SimpleNamespace(of=lambda robot: SimpleNamespace(axes=axes, turns_base=True))
    monkeypatch.setattr(own_robot, "BaseRotations", turning)
    turn = np.array([0.6, 0.0, -0.8]) * degrees * DEG
    monkeypatch.setattr(own_robot, "first_turn", lambda robot, shape, axes: turn)
    robot: Any = SimpleNamespace(
        lower=np.array([-1.0, 0.0]), upper=np.array([1.0, 1.0]), n=2, joint_names=["a", "b"],
        description=SimpleNamespace(name="mine", size=1.0),
    )  # fmt: skip
    problem = first_problem("first", robot, Path("mine.urdf"))
    assert problem.config.attitude_tolerance == pytest.approx(
        min(tolerance, PlannerConfig().attitude_tolerance)
    )
    assert problem.config.robot == "mine.urdf"
    assert problem.goal.position.tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(rotvec_from_quaternion(problem.goal.quaternion), turn, atol=1e-12)
    assert problem.initial.joint_positions is not None
    np.testing.assert_allclose(problem.initial.joint_positions, [0.0, 0.5])
    text = own_robot.scenario_text(problem, "optimal", "../mine.urdf")
    assert f"    # {degrees:.3g} deg about (0.6, 0, -0.8)\n" in text
    assert "    initial_joint_positions: [0.0, 0.5]   # a, b\n" in text
    read = {key: value["ros__parameters"] for key, value in yaml.safe_load(text).items()}
    goal = Goal.checked([0.0, 0.0, 0.0], read["scenario"]["goal_orientation"])
    np.testing.assert_allclose(goal.quaternion, problem.goal.quaternion, atol=1e-15)
    assert read["/**/plant"]["initial_joint_positions"] == [0.0, 0.5]
    assert read["/**/planner"]["method"] == "optimal"
    assert read["/**/planner"]["attitude_tolerance"] == problem.config.attitude_tolerance
    for node in ("/**/plant", "/**/planner"):
        assert read[node]["robot"] == "../mine.urdf"
    assert read["/**/plant"]["tick_rate"] == PlantConfig().tick_rate
    robot.n = 0
    assert "initial_joint" not in own_robot.scenario_text(problem, "optimal", "a")
