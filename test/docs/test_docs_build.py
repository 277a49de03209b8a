"""What builds the documentation: marks of blocks, placeholders, equations, diagrams."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from docs_build import notebook
from docs_build.blocks import blocks, replace_blocks
from docs_build.diagrams import diagram
from docs_build.equations import characters, with_equations
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
