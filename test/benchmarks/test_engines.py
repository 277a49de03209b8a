"""The benchmarks of the plant, SIMD lanes and MuJoCo: figures, and missing engines."""

from __future__ import annotations

import sys

import pytest

from spacerobot_ros.benchmarks import engines
from spacerobot_ros.model.compilation import c_compiler, cxx_compiler


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "_DYNAMICS_ROUNDS", 3)
    monkeypatch.setattr(engines, "_STEPS_PER_CALL", 100)


@pytest.mark.slow
def test_figures() -> None:
    figures = engines.dynamics_benchmark()
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
    figures = engines.dynamics_benchmark()
    assert set(figures) == {"compiler", "mujoco", "step_without_compiler_us"}
    assert "not installed" in str(figures["mujoco"])
    assert "none" in str(figures["compiler"])


@pytest.mark.slow
@pytest.mark.skipif(cxx_compiler() is None, reason="there is no C++ compiler")
def test_figures_of_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (
        ("_LANE_FLIGHTS", 400),
        ("_MUJOCO_FLIGHTS", 8),
        ("_LANE_ROUNDS", 3),
        ("_TIMED_FLIGHTS", 400),
    ):
        monkeypatch.setattr(engines, name, value)
    lines: list[str] = []
    figures = engines.lanes_benchmark(lines.append)
    assert "lanes" in str(figures["engine"])
    assert len(lines) == 6
    if "8 lanes" in str(figures["engine"]):
        # Half of what is promised, for machines that do other things meanwhile.
        assert float(figures["sliders velocity: ratio_to_plant"]) > 4.0
        assert float(figures["servicer effort: ratio_to_plant"]) > 2.5
        assert float(figures["servicer effort: ratio_to_mujoco"]) > 7.5
    for name in ("sliders velocity", "servicer velocity", "servicer effort", "sliders effort"):
        assert float(figures[f"{name}: largest_difference_to_plant"]) < 1e-12
