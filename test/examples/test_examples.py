"""Every example runs as its first lines say, is short, and says what it did."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run(folder: Path, *arguments: str | Path) -> str:
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
        "PYTHONWARNINGS": "error,ignore:module 'sre_:DeprecationWarning",
    }
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
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
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(example: Path, tmp_path: Path) -> None:
    if example.stem.startswith("test_"):
        said = run(tmp_path, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "-c", os.devnull,
                   example)  # fmt: skip
        assert "1 passed" in said
        return
    said = run(tmp_path, example)
    assert len(said.splitlines()) >= 3


def test_the_bag_example_draws_a_picture(tmp_path: Path) -> None:
    bag = ROOT / "bags" / "planar_chain.mcap"
    run(tmp_path, ROOT / "examples" / "read_bag_and_plot.py", bag, tmp_path / "mine.png")
    assert (tmp_path / "mine.png").stat().st_size > 10_000
