"""Rows of pairs of links in C against those of CasADi, whose derivatives are its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.branched_robot import branched_robot

from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.collision import rows as rows_module
from spacerobot_ros.collision.rows import CompiledRows, DistanceRows
from spacerobot_ros.model import compilation, load_robot
from spacerobot_ros.resources import robot_file


def compare(geometry: CollisionGeometry, pairs: list[int], shapes: int) -> None:
    compiled = CompiledRows.of(geometry)
    assert compiled is not None
    robot, rng = geometry.robot, np.random.default_rng(5)
    low = np.maximum(robot.limits("lower"), -3.0)
    high = np.minimum(robot.limits("upper"), 3.0)
    for pair in pairs:
        ours, theirs = compiled.rows(pair), DistanceRows.of(geometry, [pair])
        assert not ours.is_of_obstacle
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
    geometry = CollisionGeometry(branched_robot(tmp_path))
    assert len(geometry.pairs) > 6
    compare(geometry, [1, len(geometry.pairs) - 1], 3)


@pytest.mark.slow
@pytest.mark.skipif(compilation.c_compiler() is None, reason="no C compiler")
def test_all_pairs_have_the_rows_of_casadi(tmp_path: Path) -> None:
    geometry = CollisionGeometry(branched_robot(tmp_path))
    compare(geometry, list(range(len(geometry.pairs))), 3)


@pytest.mark.slow
@pytest.mark.skipif(compilation.c_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["seven_joint_arm", "dual_arm", "surveyor", "quadruped"])
def test_pairs_of_robots_have_the_rows_of_casadi(name: str) -> None:
    geometry = CollisionGeometry(load_robot(robot_file(name)))
    compare(geometry, list(range(0, len(geometry.pairs), 5)), 5)


def test_without_a_compiler_there_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    monkeypatch.setattr(rows_module, "DistanceRows", None)  # Nothing is derived in vain.
    assert CompiledRows.of(CollisionGeometry(branched_robot(tmp_path))) is None


def test_rows_from_the_cache_derive_none_for_a_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if compilation.c_compiler() is None:
        pytest.skip("no C compiler")
    geometry = CollisionGeometry(branched_robot(tmp_path))
    first = CompiledRows.of(geometry)
    monkeypatch.setattr(rows_module, "_rows_of_pair", None)
    again = CompiledRows.of(geometry)
    assert first is not None
    assert again is not None
    q = np.linspace(-0.4, 0.7, len(geometry.robot.joint_names))
    assert float(again.rows(3).values(q)) == float(first.rows(3).values(q))


@pytest.mark.slow
def test_wrong_functions_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A library whose first derivatives have the wrong sign is refused, with its reason."""
    if compilation.c_compiler() is None:
        pytest.skip("no C compiler")
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    right = rows_module._SOURCE.read_text("utf-8")
    wrong = tmp_path / "wrong.c"
    wrong.write_text(right.replace("field->gradient[i] = ", "field->gradient[i] = -"), "utf-8")
    assert wrong.read_text("utf-8") != right
    monkeypatch.setattr(rows_module, "_SOURCE", wrong)
    assert CompiledRows.of(CollisionGeometry(branched_robot(tmp_path))) is None
