"""The numbers of the documents are those that the program computes, and every one is used."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from docs_build.figures import FIGURES, figures

WRITTEN: dict[str, str] = json.loads(FIGURES.read_text(encoding="utf-8"))


def numbers(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", text)]


def test_every_number_is_known_and_used() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in FIGURES.parent.rglob("*.md"))
    assert set(re.findall(r"\{\{ value (\S+) \}\}", pages)) == set(WRITTEN)


@pytest.mark.slow
def test_the_file_is_what_make_figures_writes() -> None:
    found = figures()
    assert found.keys() == WRITTEN.keys()
    for key, text in found.items():
        # The last digit may round another way on another processor.
        digits = max((len(part) for part in re.findall(r"\.(\d+)", text)), default=0)
        unit = 1.01 * 10.0**-digits
        np.testing.assert_allclose(numbers(text), numbers(WRITTEN[key]), rtol=0, atol=unit)


@pytest.mark.parametrize(
    ("key", "recomputed", "tolerance"),
    [
        # Computed independently of this program, from the equations of the papers.
        ("lie_bracket.zf", [-2.378408, 1.687252, -1.377082], 1e-4),
        ("lie_bracket.c", [-0.047568, 0.033745, -0.027542], 1e-4),
        ("square_path.turn_of_step_1", [0.999503], 1e-6),
        ("square_path.wanted_phase", [0.571293], 1e-6),
        ("square_path.z_star", [1.130702], 1e-6),
        ("coordinated_control.transposed_jacobian.force_at_start", [5.5116, 59.3298], 1e-2),
        ("coordinated_control.model_based.force_at_start", [864.58, 642.76], 1e-2),
        # Runge-Kutta 4.
        ("integration.velocity_order", [4.0], 0.1),
        ("integration.effort_order", [4.0], 0.1),
        ("singularities.start", [2.000077, -0.002373], 1e-6),
        ("singularities.det_at_start", [0.373488], 1e-6),
        ("singularities.length", [1.583415], 1e-6),
        ("singularities.singular_after", [1.194983], 1e-6),
        ("singularities.singular_attitude", [-31.9510], 1e-4),
        ("singularities.singular_shape", [73.1295, 11.3449], 1e-4),
        ("singularities.singular_place", [1.622675, 1.131448], 1e-6),
        ("singularities.optimal", [3.00], 5e-3),
        ("singularities.optimal_with_clearance", [3.22], 1.1e-2),
        ("singularities.fixed_shape", [-1.4546, 54.5147], 1e-4),
        ("singularities.fixed_det", [0.8143], 1e-4),
        ("singularities.path_dependent", [0.35106, 0.55368, 1.43617, 2.28723], 1e-5),
        ("singularities.path_independent", [0.0, 0.35106, 0.55368, 1.43617], 1e-5),
    ],
)
def test_numbers_are_those_of_an_independent_computation(
    key: str, recomputed: list[float], tolerance: float
) -> None:
    np.testing.assert_allclose(numbers(WRITTEN[key]), recomputed, rtol=0, atol=tolerance)
