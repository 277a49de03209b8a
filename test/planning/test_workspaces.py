"""Path-dependent and path-independent workspaces, against singular shapes found otherwise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.workspaces import Workspaces, workspaces

Array = npt.NDArray[np.float64]

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


@pytest.mark.slow
def test_limits_of_the_joints_leave_less_of_both() -> None:
    text = urdf_of_pair().replace('type="continuous"', 'type="revolute"')
    text = text.replace("<limit ", '<limit lower="-1.9" upper="0.4" ')
    free, limited = workspaces(SpaceRobot.from_urdf(text), "tool")
    assert limited.within_limits
    q = np.linspace(-1.9, 0.4, 300)
    distance, det = planar_pair(*np.meshgrid(q, q, indexing="ij"))
    crossed = det[:, 1:] * det[:, :-1] <= 0
    assert limited.distance_range == pytest.approx((distance.min(), distance.max()), abs=1e-4)
    assert limited.distance_range[0] > free.distance_range[0] + 0.1
    (only,) = limited.path_dependent
    ends = distance[:, 1:][crossed].min(), distance[:, 1:][crossed].max()
    assert only == pytest.approx(ends, abs=0.01)


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
