"""What builds the documentation: marks of blocks, placeholders, equations, diagrams."""

from __future__ import annotations

import json
import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.chromium import Browser, browser, chromium
from support.command_line import finished

from docs_build import notebook
from docs_build.blocks import blocks, replace_blocks
from docs_build.diagrams import diagram
from docs_build.equations import characters, with_equations
from docs_build.figures import FIGURES, figures
from docs_build.hooks import prepared

ROOT = Path(__file__).resolve().parents[2]

PAGE = """Text.

```sh run exit=2
spacerobot run nowhere
```

```yaml file=mine.yaml
a: 1
```

- in a list:

    ```python run slow
    if True:
        print(1)
    ```

```
no language, {{ no placeholder either
```
"""


def test_marks_of_a_block_are_read() -> None:
    command, file, listed = blocks(PAGE)
    assert (command.language, command.text, command.line) == ("sh", "spacerobot run nowhere", 4)
    assert (command.run, command.slow, command.exit_code) == (True, False, 2)
    assert (file.file, file.text, file.run) == ("mine.yaml", "a: 1", False)
    assert listed.text == "if True:\n    print(1)"
    assert (listed.run, listed.slow) == (True, True)


def test_an_unknown_mark_is_refused() -> None:
    with pytest.raises(ValueError, match="Line 1: a block has the unknown mark 'runn'"):
        blocks("```sh runn\ntrue\n```")


def test_a_block_without_a_language_is_shown_as_it_stands() -> None:
    page = "````\n```sh run\nspacerobot scenarios\n```\n````\n```sh\ntrue\n```"
    assert [block.text for block in blocks(page)] == ["true"]
    assert replace_blocks(page, lambda block: None) == page


def test_marks_are_not_on_the_page() -> None:
    page = prepared(PAGE)
    assert "```sh\nspacerobot run nowhere\n```" in page
    assert '```yaml title="mine.yaml"\na: 1\n```' in page
    assert "    ```python\n    if True:\n        print(1)\n    ```" in page
    assert page.count("```") == PAGE.count("```")


def test_an_unknown_placeholder_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\{\{ numbers \}\} is unknown"):
        prepared("{{ numbers }}")


@pytest.mark.parametrize(
    "latex",
    [
        r"\begin{bmatrix} v \\ \omega \end{bmatrix}_B = -A(q)\,\dot q",
        r"r = r_0 - R \sum_i \frac{m_i}{M} p_i(z) + R_0 \sum_i \frac{m_i}{M} p_i(z_0) \tag{2}",
        r"\omega_{[F_i, F_j]} = \tilde F_j \times \tilde F_i"
        r" + \frac{\partial \tilde F_i}{\partial z_j} - \frac{\partial \tilde F_j}{\partial z_i}",
        r"\begin{aligned} H^+ \ddot z + C^+ &= Q \\"
        r" |d_1| &= \sqrt{|S_{12} S_{31} / S_{23}|} \end{aligned}",
        r"\Delta\theta = -\oint s(\psi)^{\mathsf T}\,\mathrm d\psi",
    ],
)  # fmt: skip
def test_equations_of_the_papers_become_mathml(latex: str) -> None:
    page = with_equations(rf'<div class="arithmatex">\[{latex.replace("&", "&amp;")}\]</div>')
    math = ET.fromstring(page).find("math")
    assert math is not None
    assert math.get("display") == "block"
    assert "\\" not in "".join(math.itertext())
    assert characters(page) >= set("".join(math.itertext())) - {"\n"}


def test_an_equation_with_an_unknown_command_is_refused() -> None:
    with pytest.raises(ValueError, match=r"No LaTeX .*: \\omgea"):
        with_equations(r'<span class="arithmatex">\(\omgea\)</span>')


def test_a_diagram_is_one_line_of_svg_that_asks_nobody() -> None:
    figure = diagram("stateDiagram-v2\n    [*] --> Idle\n    Idle --> Planning: new goal")
    assert "\n" not in figure
    assert "new goal" in figure
    assert "<script" not in figure


@pytest.mark.slow
def test_the_notebook_shows_what_its_cells_make(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = notebook.executed(ROOT / "docs" / "notebooks" / "first_flight.py")
    plan, flight = (each.partition("\n```")[0] for each in page.split("```text\n")[1:3])
    # The paper's goal, in the least time that the limits of the scenario allow.
    assert plan == "optimal: 39.45 s in 789 ticks"
    assert flight.startswith("<Flight of sliding_masses by optimal: reached after 39.45 s")
    assert page.count('<img alt="Output of the cell"') == 1
    assert "<th>39.45</th>" in page
    assert page.count("data:image/png;base64") == 1 + 12
    assert (tmp_path / "out" / "first_flight.mcap").is_file()


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


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    built = finished(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return folder


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    """Return a page in a browser."""
    if chromium() is None:
        pytest.skip("no Chromium")
    with browser(tmp_path / "profile") as opened:
        yield opened


@pytest.mark.slow
def test_every_page_opens_without_an_error_a_foreign_request_or_a_dead_link(
    site: Path, page: Browser
) -> None:
    pages = sorted(path for path in site.rglob("*.html") if path.name != "404.html")
    assert len(pages) > 20
    ids: dict[str, set[str]] = {}
    links: list[tuple[str, str]] = []
    for path in pages:
        page.open(path)
        name = path.as_uri()
        ids[name] = set(page.evaluate("Array.from(document.querySelectorAll('[id]'), e => e.id)"))
        hrefs = page.evaluate("Array.from(document.querySelectorAll('a[href]'), e => e.href)")
        links += [(name, href) for href in hrefs]
        assert page.complaints == [], path.name
        assert (
            page.evaluate("document.querySelectorAll('merror, .arithmatex:not(:has(math))').length")
            == 0
        ), path.name
        broken = "Array.from(document.images).filter(i => !i.naturalWidth).map(i => i.src)"
        assert page.evaluate(broken) == [], path.name
    assert [url for url in page.requests if not url.startswith(("file:///", "data:"))] == []

    dead = []
    for source, href in links:
        target, _, anchor = href.partition("#")
        if not target.startswith("file:"):
            continue
        exists = target in ids or Path(target.removeprefix("file://")).is_file()
        if not exists or (anchor and target in ids and anchor not in ids[target]):
            dead.append((source, href))
    assert dead == []


@pytest.mark.slow
def test_a_search_finds_a_parameter(site: Path, page: Browser) -> None:
    page.open(site / "index.html")
    page.wait_for("window.Worker !== undefined && document.readyState === 'complete'")
    page.evaluate(
        "document.querySelector('#__search').click();"
        "const query = document.querySelector('.md-search__input');"
        "query.focus(); query.value = 'latched_faults';"
        "query.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true}));"
        "query.dispatchEvent(new Event('input', {bubbles: true}))"
    )
    found = "Array.from(document.querySelectorAll('.md-search-result__link'), e => e.href)"
    page.wait_for(f"({found}).length > 0")
    assert any("reference/parameters.html" in href for href in page.evaluate(found))
    assert page.complaints == []
