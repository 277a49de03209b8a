"""Rows of pairs of links in C against those of CasADi, whose derivatives are its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spacerobot_ros.collision import CollisionGeometry, compiled_rows
from spacerobot_ros.collision.compiled_rows import CompiledRows
from spacerobot_ros.collision.rows import DistanceRows
from spacerobot_ros.model import compilation, load_robot
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.resources import robot_file

_LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.3"/></inertial>
  <visual><origin xyz="{at}" rpy="0.3 -0.2 0.5"/><geometry>{shape}</geometry></visual></link>"""

_JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{at}" rpy="0.4 -0.7 1.1"/><axis xyz="0.6 0 0.8"/>
  <limit lower="-2" upper="1.5" effort="9" velocity="1"/>{mimic}</joint>"""


def tree(folder: Path) -> RobotDescription:
    """Return a robot with a slider, a joint that follows another one, and all kinds of solids."""
    links = {
        "base": ("0 0 0.1", '<box size="0.5 0.4 0.3"/>'),
        "a1": ("0.2 0 0", '<cylinder radius="0.05" length="0.4"/>'),
        "a2": ("0.1 0.2 0", '<box size="0.3 0.2 0.25"/>'),
        "a3": ("0 0 0.2", '<sphere radius="0.08"/>'),
        "b1": ("0 0.1 0.2", '<box size="0.06 0.3 0.25"/>'),
        "b2": ("0.2 0.1 0", '<cylinder radius="0.06" length="0.5"/>'),
    }
    joints = [
        ("b_slide", "prismatic", "base", "b1", "0.1 0.5 0", ""),
        ("a_turn", "revolute", "base", "a1", "0.4 0 0.1", ""),
        ("a_slide", "prismatic", "a1", "a2", "0.5 0.1 0", ""),
        ("a_follow", "revolute", "a2", "a3", "0.3 0 0.2", "a_turn"),
        ("b_turn", "revolute", "b1", "b2", "0 0.4 0.1", ""),
    ]
    text = "".join(_LINK.format(name=k, at=at, shape=shape) for k, (at, shape) in links.items())
    for name, kind, parent, child, at, leader in joints:
        mimic = f'<mimic joint="{leader}" multiplier="-0.7" offset="0.2"/>' if leader else ""
        text += _JOINT.format(name=name, kind=kind, parent=parent, child=child, at=at, mimic=mimic)
    path = folder / "tree.urdf"
    path.write_text(f'<robot name="tree">{text}</robot>', encoding="utf-8")
    return load_robot(path)


def compare(geometry: CollisionGeometry, pairs: list[int], shapes: int) -> None:
    compiled = CompiledRows.of(geometry)
    assert compiled is not None
    robot, rng = geometry.robot, np.random.default_rng(5)
    low = np.maximum(robot.limits("lower"), -3.0)
    high = np.minimum(robot.limits("upper"), 3.0)
    for pair in pairs:
        ours, theirs = compiled.rows(pair), DistanceRows.of(geometry, [pair])
        assert not ours.of_obstacles
        for q in rng.uniform(low, high, (shapes, len(low))):
            assert float(ours.values(q)) == pytest.approx(float(theirs.values(q)), abs=1e-13)
            for mine, other in (
                (ours.jacobian(q), theirs.jacobian(q)),
                (ours.hessian(q, -1.7), theirs.hessian(q, -1.7)),
            ):
                found, wanted = mine.full(), other.full()
                assert found.shape == wanted.shape
                assert found == pytest.approx(wanted, abs=1e-10 * (1 + np.abs(wanted).max()))
        # Entries of other joints are not there, so that programs stay sparse. Only CasADi knows
        # that a rod which turns about its axis stays where it is.
        assert ours.jacobian.nnz_out(0) - theirs.jacobian.nnz_out(0) in (0, 1)
        assert ours.hessian.nnz_out(0) == ours.jacobian.nnz_out(0) ** 2


@pytest.mark.skipif(compilation.c_compiler() is None, reason="no C compiler")
def test_values_and_derivatives_are_those_of_casadi(tmp_path: Path) -> None:
    geometry = CollisionGeometry(tree(tmp_path))
    assert len(geometry.pairs) > 6
    compare(geometry, list(range(len(geometry.pairs))), 3)


@pytest.mark.slow
@pytest.mark.skipif(compilation.c_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["seven_joint_arm", "dual_arm", "surveyor", "quadruped"])
def test_pairs_of_robots_have_the_rows_of_casadi(name: str) -> None:
    geometry = CollisionGeometry(load_robot(robot_file(name)))
    compare(geometry, list(range(0, len(geometry.pairs), 5)), 5)


def test_without_a_compiler_there_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    assert CompiledRows.of(CollisionGeometry(tree(tmp_path))) is None


def test_wrong_functions_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A library whose first derivatives have the wrong sign is refused, with its reason."""
    if compilation.c_compiler() is None:
        pytest.skip("no C compiler")
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    right = compiled_rows._SOURCE.read_text("utf-8")
    wrong = tmp_path / "wrong.c"
    wrong.write_text(right.replace("field->gradient[i] = ", "field->gradient[i] = -"), "utf-8")
    assert wrong.read_text("utf-8") != right
    monkeypatch.setattr(compiled_rows, "_SOURCE", wrong)
    assert CompiledRows.of(CollisionGeometry(tree(tmp_path))) is None
