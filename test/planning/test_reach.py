"""What is out of reach by proof, and the workspaces of a link."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.sliding_robots import random_sliding_robot
from scipy.spatial.transform import Rotation
from support.hand_motion import attitude_after
from support.oracles import PinocchioOracle
from support.planar_trees import random_tree
from support.random_robots import random_chain_urdf, random_robot_urdf

from spacerobot_ros.errors import NotFoundError, PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import (
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
    build_method,
    method_options,
    plan,
)
from spacerobot_ros.planning.analysis import Workspaces, workspaces
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait
from spacerobot_ros.planning.methods.optimal.goal_specification import GoalSpecification
from spacerobot_ros.planning.methods.optimal.motion_bounds import CenterReach
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, OptimalOptions

TOLERANCE = Tolerance(1e-4, 1e-4, 1e-4)
SEEDS = st.integers(0, 10**6)


def some_robot(kind: str, rng: np.random.Generator) -> tuple[SpaceRobot, PinocchioOracle]:
    match kind:
        case "tree":
            urdf = random_robot_urdf(rng, int(rng.integers(1, 6)))
        case "chain":
            urdf = random_chain_urdf(rng, int(rng.integers(1, 6)))
        case "planar":
            urdf = random_tree(rng, int(rng.integers(2, 5))).urdf
        case _:
            urdf = random_sliding_robot(rng, int(rng.integers(3, 6))).urdf
    robot = SpaceRobot.from_urdf(urdf)
    return robot, PinocchioOracle(urdf, robot.joint_names)


def some_shape(robot: SpaceRobot, rng: np.random.Generator) -> Array:
    lower, upper = robot.description.shape_box
    # Ends of travel are likely, and the hardest.
    return np.asarray(lower + (upper - lower) * np.clip(rng.uniform(-0.3, 1.3, robot.n), 0.0, 1.0))


def moved(
    oracle: PinocchioOracle, robot: SpaceRobot, state: RobotState, rng: np.random.Generator
) -> tuple[Rotation, Array, Array]:
    """Return attitude, position and shape after a random motion, by Pinocchio's momentum."""
    shapes = np.array([state.q, some_shape(robot, rng), some_shape(robot, rng)])
    start = Rotation.from_quat(state.quaternion)
    attitude = attitude_after(oracle, shapes, start, parts=16)
    center = state.position + start.apply(oracle.center_of_mass(state.q))
    return attitude, center - attitude.apply(oracle.center_of_mass(shapes[-1])), shapes[-1]


def refusal(robot: SpaceRobot, state: RobotState, goal: Goal, **options: Any) -> str:
    """Return why a goal is no boundary condition of ``optimal``; "" if it is one.

    Fails where it is called unreachable.
    """
    chosen = OptimalOptions(**options)
    # The integrator is some 1e-4 rad off.
    request = PlanRequest(state, goal, Tolerance(1e-3, 2e-3, 1e-3))
    try:
        GoalSpecification.of(robot, chosen).boundary_conditions(
            request, goal.joint_positions, MotionLimits.of(robot, chosen)
        )
    except UnreachableError as error:
        pytest.fail(f"{error}")
    except PlanningError as error:
        return str(error)
    return ""


KINDS = ["tree", "chain", "planar", "sliders"]


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(seed=SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_what_many_random_motions_reach_is_never_called_unreachable(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot, oracle = some_robot(kind, rng)
    start = Rotation.random(random_state=rng).as_quat()
    state = RobotState(rng.normal(size=3), start, some_shape(robot, rng))
    attitude, position, q = moved(oracle, robot, state, rng)
    turned = Goal.checked(np.zeros(3), attitude.as_quat())
    refusal(robot, state, turned, base_position=2)
    refusal(robot, state, replace(turned, joint_positions=q), base_position=2)
    placed = replace(turned, position=position)
    refused = refusal(robot, state, placed, base_position=1)
    # A search of shapes may fail, and says so; with sliders alone it does not.
    assert not refused or kind != "sliders", refused
    assert "out of reach" not in refused
    refusal(robot, state, replace(placed, joint_positions=q), base_position=1)
    if kind == "sliders":
        gait = LieBracketGait(robot, 0.25)
        final = gait.final_shape(state, placed)
        center = attitude.apply(oracle.center_of_mass(q) - oracle.center_of_mass(final))
        assert np.linalg.norm(center) < 1e-6


@settings(max_examples=3, deadline=None)
@given(seed=SEEDS)
@pytest.mark.parametrize("kind", ["tree", "chain", "sliders"])
def test_the_bound_holds_every_centre_of_mass(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot, oracle = some_robot(kind, rng)
    reach = CenterReach.of(robot, *robot.description.shape_box)
    centres = [oracle.center_of_mass(some_shape(robot, rng)) for _ in range(20)]
    assert max(reach.distance_outside(center) for center in centres) < 1e-9
    # It is no empty claim: half again as far off is out of reach.
    far = np.array(centres) - reach.origin
    spread = reach.radius + np.abs(reach.slider_directions).sum() * 10
    outward = far[0] / max(float(np.linalg.norm(far[0])), 1e-9)
    assert reach.distance_outside(reach.origin + 1.5 * spread * outward) > 0.4 * reach.radius


@pytest.mark.parametrize("seed", range(4))
def test_of_sliders_the_bound_is_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = SpaceRobot.from_urdf(random_sliding_robot(rng, 4).urdf)
    lower, upper = robot.description.shape_box
    reach = CenterReach.of(robot, lower, upper)
    for direction in rng.normal(size=(5, 3)):
        direction = direction / np.linalg.norm(direction)
        # The farthest centre of mass in a direction is that of a corner of the box of shapes.
        slots = [
            direction @ (robot.center_of_mass(unit) - robot.center_of_mass(np.zeros(robot.n)))
            for unit in np.eye(robot.n)
        ]
        corner = robot.center_of_mass(np.where(np.array(slots) > 0, upper, lower))
        assert reach.distance_outside(corner) < 1e-9
        assert reach.distance_outside(corner - 1e-6 * direction) < 1e-6
        assert reach.distance_outside(corner + 0.01 * direction) == pytest.approx(0.01, rel=1e-6)


@pytest.mark.parametrize(
    ("robot", "asked", "proof", "sentence"),
    [
        ("sliding_masses", {"position": (0.4, 0, 0)}, "LIMITS", "bring the base no closer to it"),
        ("sliding_masses", {"position": (9, 0, 0)}, "LIMITS", "out of reach"),
        (
            "sliding_masses",
            {"position": (0.1, 0, 0), "joint_positions": (0, 0, 0)},
            "MOMENTUM",
            "put the base 0.1 m from the goal position.*centre of mass stays",
        ),
        (
            "planar_chain",
            {"rotvec": (0, 0.1, 1)},
            "RANK",
            r"away from any rotation about the axis \[0.0, 0.0, 1.0\]",
        ),
        (
            "three_joint_arm",
            {"joint_positions": (9, 0, 0)},
            "LIMITS",
            "violates joint limits: joint 'shoulder_yaw'",
        ),
        (
            "three_joint_arm",
            {"position": (2, 0, 0), "base_position": 1},
            "LIMITS",
            "the goal position is out of reach.*no closer to it than",
        ),
    ],
)
def test_goals_out_of_reach_are_refused_with_the_kind_of_proof(
    robot: str, asked: dict[str, Any], proof: str, sentence: str
) -> None:
    with pytest.raises(UnreachableError, match="(?i)" + sentence) as refusal:
        plan(robot, **asked)
    assert refusal.value.proof is Proof[proof]


def test_a_proof_and_a_search_in_vain_are_two_things() -> None:
    # Within the ball round the shoulder, but the upper arm does not go through the spacecraft.
    with pytest.raises(NotFoundError, match=r"was found from 8 starts.*may help"):
        plan("three_joint_arm", base_position=1, position=(0.08, -0.04, 0.02))
    with pytest.raises(PlanningError, match="has 2 joints"):
        plan("planar_chain", joint_positions=[0.0])
    budgets: list[tuple[dict[str, Any], str]] = [({}, "longest"), ({"duration": 2.0}, "duration")]
    for given_time, option in budgets:
        with pytest.raises(NotFoundError, match=rf"from . start.*a longer optimal\.{option}, or"):
            plan("planar_chain", rotvec=(0, 0, 1.0), starts=1, iterations=1, cache=0, **given_time)


def test_a_longest_manoeuvre_below_two_control_periods_is_refused() -> None:
    asked: dict[str, Any] = {"rotvec": (0, 0, 0.5), "longest": 1.0, "starts": 1, "cache": 0}
    with pytest.raises(PlanningError, match=r"2 control periods of 1 s, .*longest = 1 s"):
        plan("planar_chain", control_period=1.0, **asked)


def test_auto_has_the_proof_of_any_method() -> None:
    few = method_options("optimal", {"starts": 1, "iterations": 1, "cache": 0})
    arm = SpaceRobot.from_file(Path(__file__).parents[2] / "urdf" / "three_joint_arm.urdf")
    loops = method_options("area_loop", {"most_cycles": 1})
    auto = build_method("auto", arm, 0.05, 0.01, {"optimal": few, "area_loop": loops})
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, -0.8, 1.5]))
    turned = Goal.checked(np.zeros(3), Rotation.from_rotvec([0.0, 0.4, 1.0]).as_quat())
    with pytest.raises(NotFoundError, match="No method can plan"):
        auto.plan(PlanRequest(state, turned, TOLERANCE))
    beyond = replace(turned, joint_positions=np.array([9.0, 0.0, 0.0]))
    with pytest.raises(UnreachableError, match=r"^The goal shape violates joint limits") as refused:
        auto.plan(PlanRequest(state, beyond, TOLERANCE))
    assert refused.value.proof is Proof.LIMITS


def test_a_goal_a_little_beyond_the_reach_is_aimed_at_as_near_as_it_gets() -> None:
    # 2.5 m of stroke of 2 kg moves 16 kg by 0.3125 m.
    for beyond, position_tolerance in ((0.004, 0.01), (0.006, 0.01)):
        asked: dict[str, Any] = {
            "position": (0.3125 + beyond, 0.0, 0.0),
            "tolerance": Tolerance(position_tolerance, 1e-3),
            "cache": 0,
            "starts": 2,
            "answers": 1,
        }
        if beyond > position_tolerance / 2:
            with pytest.raises(
                UnreachableError, match=r"out of reach: .* no closer to it than 0\.006 m"
            ):
                plan("sliding_masses", **asked)
            continue
        path = plan("sliding_masses", **asked).path
        assert path.position[-1] == pytest.approx([0.3125, 0.0, 0.0], abs=1e-6)
        for option in ("cache", "starts", "answers"):
            del asked[option]
        path = plan("sliding_masses", method="lie_bracket", **asked).path
        assert path.position[-1] == pytest.approx([0.3125, 0.0, 0.0], abs=1e-6)


def test_the_shape_of_one_joint_that_turns_its_base_decides_the_attitude() -> None:
    """Its loops turn nothing: a shape is reached with the attitude that goes with it, or not."""
    robot = SpaceRobot.from_urdf(random_tree(np.random.default_rng(3), 2).urdf)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(1))
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    final = np.array([0.7])
    attitude = attitude_after(oracle, np.array([state.q, final]), parts=50)
    quick: dict[str, Any] = {"start": state, "cache": 0, "starts": 2, "answers": 1}
    goal = Goal.checked(np.zeros(3), attitude.as_quat(), final)
    schedule = plan(robot, goal, tolerance=Tolerance(1.0, 1e-3, 1e-3), **quick)
    np.testing.assert_allclose(schedule.positions[-1], final, atol=1e-3)
    other = replace(goal, joint_positions=-final)
    with pytest.raises(UnreachableError, match="loops of its joints do not rotate its base"):
        plan(robot, other, tolerance=Tolerance(1.0, 1e-3, 1e-3), **quick)


# -- path-dependent and path-independent workspaces, against singular shapes found ---------------


FOLDER = Path(__file__).parents[2] / "urdf"

MASSES, MOMENTS = np.array([30.0, 5.0, 2.0]), np.array([4.0, 0.6, 0.2])
FIRST, UPPER, LOWER, TOOL = (0.3, -0.4), (0.9, 0.2), (0.1, 0.7), (0.6, 0.0)
"""Of a planar robot: r from the base to the shoulder, to the elbow, to the tool's mount, to it."""
OFF_CENTER = np.array([[0.1, 0.05], [0.5, -0.1], [-0.05, 0.4]])

URDF = """
<robot name="pair">
  <link name="hull">{0}</link>
  <link name="lower">{2}</link>
  <link name="upper">{1}</link>
  <link name="tool"/>
  <joint name="elbow" type="continuous">
    <parent link="upper"/><child link="lower"/><origin xyz="{upper[0]} {upper[1]} 0"/>
    <axis xyz="0 0 1"/><limit velocity="1" effort="1"/>
  </joint>
  <joint name="shoulder" type="continuous">
    <parent link="hull"/><child link="upper"/><origin xyz="{first[0]} {first[1]} 0"/>
    <axis xyz="0 0 1"/><limit velocity="1" effort="1"/>
  </joint>
  <joint name="mount" type="fixed">
    <parent link="lower"/><child link="tool"/><origin xyz="{x} {y} 0"/>
  </joint>
</robot>
"""


def urdf_of_pair() -> str:
    inertials = [
        f'<inertial><origin xyz="{c[0]} {c[1]} 0"/><mass value="{m}"/>'
        f'<inertia ixx="{I}" iyy="{I}" izz="{I}" ixy="0" ixz="0" iyz="0"/></inertial>'
        for m, I, c in zip(MASSES, MOMENTS, OFF_CENTER, strict=True)
    ]
    tool = np.add(LOWER, TOOL)
    return URDF.format(*inertials, first=FIRST, upper=UPPER, x=tool[0], y=tool[1])


def rotated(angle: Array, v: npt.ArrayLike) -> Array:
    x, y = np.asarray(v, dtype=float)
    return np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])


def planar_pair(q1: Array, q2: Array) -> tuple[Array, Array]:
    """Return the distance of the tool and det J*, by the plane's moments of momentum."""
    zero = np.zeros_like(q1)
    elbow = np.array(FIRST)[:, None, None] + rotated(q1, UPPER)
    tool = elbow + rotated(q1 + q2, np.add(LOWER, TOOL))
    shoulder = np.array(FIRST)[:, None, None] + np.zeros_like(elbow)
    centers = [
        rotated(zero, OFF_CENTER[0]),
        shoulder + rotated(q1, OFF_CENTER[1]),
        elbow + rotated(q1 + q2, OFF_CENTER[2]),
    ]
    total = MASSES.sum()
    center = sum(m * c for m, c in zip(MASSES, centers, strict=True)) / total

    def turned(about: Array, bodies: tuple[int, ...]) -> tuple[Array, Array]:
        """Return momentum of moment, and the tool's velocity, as bodies turn with 1 rad/s."""
        rates = [
            np.stack([about[1] - c[1], c[0] - about[0]]) * (k in bodies)
            for k, c in enumerate(centers)
        ]
        drift = sum(m * v for m, v in zip(MASSES, rates, strict=True)) / total
        L = sum(
            m * ((c - center)[0] * v[1] - (c - center)[1] * v[0]) + I * (k in bodies)
            for k, (m, I, c, v) in enumerate(zip(MASSES, MOMENTS, centers, rates, strict=True))
        )
        return np.asarray(L), np.stack([about[1] - tool[1], tool[0] - about[0]]) - drift

    L0, v0 = turned(zero[None] + np.zeros_like(elbow), (0, 1, 2))
    (L1, v1), (L2, v2) = turned(shoulder, (1, 2)), turned(elbow, (2,))
    # The base turns so that the moment of momentum stays zero.
    first, second = v1 - v0 * L1 / L0, v2 - v0 * L2 / L0
    det = first[0] * second[1] - first[1] * second[0]
    return np.hypot(*(tool - center)), det


def covered(found: Workspaces, radii: Array, gap: float = 5e-3) -> Array:
    """Return whether distances (K,) lie in path-dependent intervals."""
    inside = [(a - gap <= radii) & (radii <= b + gap) for a, b in found.path_dependent]
    return np.any(inside, axis=0)


def test_a_planar_pair_has_the_workspaces_of_its_determinant() -> None:
    (found,) = workspaces(SpaceRobot.from_urdf(urdf_of_pair()), "tool")
    q = np.linspace(-np.pi, np.pi, 500)
    distance, det = planar_pair(*np.meshgrid(q, q, indexing="ij"))
    crossed = det[:, 1:] * det[:, :-1] <= 0
    radii = np.sort(distance[:, 1:][crossed])
    step = 0.02
    assert covered(found, radii, step).all()
    ends = np.flatnonzero(np.diff(radii) > step)
    low, high = radii[np.append(0, ends + 1)], radii[np.append(ends, -1)]
    np.testing.assert_allclose(found.path_dependent, np.column_stack([low, high]), atol=step)
    assert found.distance_range == pytest.approx((distance.min(), distance.max()), abs=step)
    assert not found.within_limits
    assert found.dimensions == 2
    # Together the two kinds of workspaces are the reach.
    both = sorted([*found.path_dependent, *found.path_independent])
    assert [both[0][0], both[-1][1]] == pytest.approx(found.distance_range, abs=1e-9)
    np.testing.assert_allclose([a for a, _ in both[1:]], [b for _, b in both[:-1]])


@pytest.mark.slow
def test_singular_shapes_of_a_spatial_arm_lie_in_the_path_dependent_workspace() -> None:
    robot = SpaceRobot.from_file(FOLDER / "three_joint_arm.urdf")
    found = workspaces(robot, "end_effector")
    rng, radii = np.random.default_rng(8), []

    def det(q: Array) -> float:
        return float(np.linalg.det(robot.generalised_jacobian("end_effector", q)[:3]))

    for _ in range(60):
        a, b = rng.uniform(robot.lower, robot.upper, (2, 3))
        if det(a) * det(b) > 0:
            continue
        for _ in range(30):
            middle = (a + b) / 2
            a, b = (middle, b) if det(middle) * det(a) > 0 else (a, middle)
        r = robot.link_pose("end_effector", a)[1] - robot.center_of_mass(a)
        radii.append(np.linalg.norm(r))
    assert len(radii) > 15
    free, limited = found
    assert covered(limited, np.array(radii)).all()
    assert covered(free, np.array(radii)).all()
    assert limited.path_independent, "else the test would be of nothing"


def test_sliders_have_no_singular_shape_and_one_joint_has_no_other() -> None:
    sliders = SpaceRobot.from_file(FOLDER / "sliding_masses.urdf")
    (found,) = workspaces(sliders, "mass_1")
    assert found.path_dependent == ()
    assert found.path_independent == (found.distance_range,)
    one = urdf_of_pair().replace(
        '<joint name="elbow" type="continuous">', '<joint name="elbow" type="fixed">'
    )
    (alone,) = workspaces(SpaceRobot.from_urdf(one), "tool")
    assert alone.path_dependent == (alone.distance_range,)
    assert alone.path_independent == ()


def test_the_link_must_exist() -> None:
    with pytest.raises(KeyError):
        workspaces(SpaceRobot.from_file(FOLDER / "three_joint_arm.urdf"), "nobody")
