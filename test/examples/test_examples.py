"""Every example and the notebook run as their first lines say, are short, and say what they did."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from support.command_line import finished
from support.slow import some_fast
from support.warm_python import WarmPython

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


LONG = "compare_", "fly_", "test_", "train_"
"""Beginnings of the names of examples that take longer than others."""

ENVIRONMENT = {
    "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    "PYTHONWARNINGS": "error,ignore:module 'sre_:DeprecationWarning",
    # An example of a test needs no plugin.
    "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
}


def run(python: WarmPython, folder: Path, *arguments: str | Path) -> str:
    done = python.run(arguments, folder, {**os.environ, **ENVIRONMENT}, timeout=300.0)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_there_are_enough() -> None:
    assert len(EXAMPLES) >= 6


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_what_it_is(example: Path) -> None:
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80
    doc = ast.get_docstring(ast.parse(text)) or ""
    assert f"examples/{example.name}" in doc


@pytest.mark.usefixtures("own_domain")
@pytest.mark.parametrize(
    "example",
    some_fast(
        {each.stem: each for each in EXAMPLES},
        *(each.stem for each in EXAMPLES if not each.stem.startswith(LONG)),
        # The one plans for minutes; for the other a busy machine does not keep real time.
        slow=[
            each.stem for each in EXAMPLES if each.stem not in ("compare_policy", "fly_own_robot")
        ],
    ),
)
def test_an_example_runs(example: Path, tmp_path: Path, warm_python: WarmPython) -> None:
    if example.stem.startswith("test_"):
        words = ("-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "-c", os.devnull)
        done = finished(
            [sys.executable, *words, example],
            cwd=tmp_path,
            env={**os.environ, **ENVIRONMENT},
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert "1 passed" in done.stdout
        return
    given: list[str] = []
    if example.stem == "train_policy":
        pytest.importorskip("stable_baselines3")
        given += ["200000"]
    if example.stem == "train_on_device":
        pytest.importorskip("torch")
        given += ["host", "200000"]
    said = run(warm_python, tmp_path, example, *given)
    assert len(said.splitlines()) >= 3
    if example.stem == "compare_policy":
        assert " 0.0%" not in said, said


def test_the_bag_example_draws_a_picture(tmp_path: Path, warm_python: WarmPython) -> None:
    bag = ROOT / "bags" / "planar_chain.mcap"
    example = ROOT / "examples" / "read_bag_and_plot.py"
    run(warm_python, tmp_path, example, bag, tmp_path / "mine.png")
    assert (tmp_path / "mine.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.usefixtures("own_domain")
def test_a_policy_flies_through_ros_as_in_its_environment(
    tmp_path: Path, warm_python: WarmPython
) -> None:
    said = run(warm_python, tmp_path, ROOT / "examples" / "fly_policy.py")
    assert float(said.rstrip().rpartition(": ")[2]) < 1e-12


# -- the notebook ---------------------------------------------------------------------------------


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
