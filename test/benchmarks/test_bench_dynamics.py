"""The benchmark of the dynamics: its figures, and what it says when something is not there."""

from __future__ import annotations

import sys

import pytest

from spacerobot_ros.benchmarks import dynamics
from spacerobot_ros.model.compilation import c_compiler


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dynamics, "_ROUNDS", 3)
    monkeypatch.setattr(dynamics, "_STEPS", 100)


@pytest.mark.slow
def test_figures() -> None:
    figures = dynamics.dynamics_benchmark()
    with_compiler = c_compiler() is not None
    assert ("step_us" in figures) == ("ratio_to_mujoco" in figures) == with_compiler
    for ratio, name in (
        ("ratio_to_mujoco", "step_us"),
        ("ratio_to_mujoco_without_compiler", "step_without_compiler_us"),
    ):
        if ratio in figures:
            quotient = float(figures["mujoco_step_us"]) / float(figures[name])
            assert figures[ratio] == pytest.approx(quotient)
            assert quotient > 0


def test_without_mujoco_and_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    figures = dynamics.dynamics_benchmark()
    assert set(figures) == {"compiler", "mujoco", "step_without_compiler_us"}
    assert "not installed" in str(figures["mujoco"])
    assert "none" in str(figures["compiler"])
