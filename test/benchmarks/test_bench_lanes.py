"""The benchmark of flights in lanes: its figures, and what line by line is promised of them."""

from __future__ import annotations

import pytest

from spacerobot_ros.benchmarks import lanes
from spacerobot_ros.model.compilation import cxx_compiler


@pytest.mark.slow
@pytest.mark.skipif(cxx_compiler() is None, reason="there is no C++ compiler")
def test_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_COUNT", 400), ("_ROLLED", 8), ("_ROUNDS", 3), ("_MANY", 400)):
        monkeypatch.setattr(lanes, name, value)
    lines: list[str] = []
    figures = lanes.lanes_benchmark(lines.append)
    assert "lanes" in str(figures["engine"])
    assert len(lines) == 6
    if "8 lanes" in str(figures["engine"]):
        # Half of what is promised, for machines that do other things meanwhile.
        assert float(figures["sliders velocity: ratio_to_plant"]) > 4.0
        assert float(figures["servicer effort: ratio_to_plant"]) > 2.5
        assert float(figures["servicer effort: ratio_to_mujoco"]) > 7.5
    for name in ("sliders velocity", "servicer velocity", "servicer effort", "sliders effort"):
        assert float(figures[f"{name}: largest_difference_to_plant"]) < 1e-12
