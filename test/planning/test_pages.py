"""The pages of planning name classes, methods and options that exist."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.planner_loop import robot_of

from spacerobot_ros.planning.methods.geometric_phase import PlanarPhase

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *(ROOT / "docs" / name for name in ("choosing.md", "planner_state_machine.md")),
    *(
        ROOT / "docs" / "theory" / f"{name}.md"
        for name in (
            "area_loop",
            "controllability",
            "lie_bracket",
            "optimal",
            "singularities",
            "square_path",
        )
    ),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_classes_that_a_page_names_exist_with_their_methods(page: Path) -> None:
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text("utf-8"), flags=re.M | re.S)
    package = "\n".join(path.read_text("utf-8") for path in ROOT.glob("spacerobot_ros/**/*.py"))
    for name, member in re.findall(r"`([A-Z][a-z]+(?:[A-Z][a-z]+)*)(?:\.(\w+))?[(`]", text):
        assert re.search(rf"^class {name}\b", package, re.M), name
        assert not member or re.search(rf"(def {member}\(|^    {member}:)", package, re.M), member


@pytest.mark.parametrize("profile", [lambda s: s, lambda s: s**2, lambda s: np.sin(np.pi * s / 2)])
def test_any_law_of_proportional_joints_turns_the_base_alike_in_step_1(profile: object) -> None:
    """The turn of paper 3's step 1 is that of the straight line, whatever its legible half is."""
    assert callable(profile)
    phase = PlanarPhase(robot_of("planar_chain"))
    along = np.asarray(profile(np.linspace(0.0, 1.0, 400)))[:, np.newaxis]
    shapes = (1 - along) * [np.pi, -np.pi]
    turn = phase.turns_by_legs(shapes[:-1], shapes[1:]).sum()
    assert turn == pytest.approx(np.pi / 2 - 0.571293, abs=1e-6)
    assert abs(np.pi / 2 - turn - 0.39) > 0.1
