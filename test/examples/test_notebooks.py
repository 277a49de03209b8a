"""The notebooks among the examples run from the first cell to the last."""

from __future__ import annotations

import ast
import contextlib
import io
import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOKS = Path(__file__).resolve().parents[2] / "examples"
PRINTS = {
    "flight_in_python": ("optimal: 39.45 s in 789 ticks", "fly: The goal position is out of reach"),
    "law_and_sweep": ("transposed_jacobian reached", "soft reached"),
}


def cells(name: str) -> list[str]:
    """Return the code of a notebook, by cells; its outputs are not kept in the file."""
    content: Any = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text("utf-8"))
    assert content["nbformat"] == 4
    code = [each for each in content["cells"] if each["cell_type"] == "code"]
    assert not any(each["outputs"] for each in code)
    return ["".join(each["source"]) for each in code]


def test_every_notebook_is_run_here() -> None:
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(PRINTS)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRINTS)
def test_a_notebook_runs_to_its_end(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__main__"}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        for source in cells(name):
            exec(compile(ast.parse(source), f"{name}.ipynb", "exec"), names)
    for words in PRINTS[name]:
        assert words in printed.getvalue()
    if name == "flight_in_python":
        assert (tmp_path / "out" / "flight_in_python.mcap").is_file()
        assert len(names["table"]) == len(names["flight"].time)
    else:
        assert len(names["rows"]) == 4
