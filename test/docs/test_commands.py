"""What the documents tell a reader to run is run: commands, Python, and the files they need."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from support.command_line import finished
from support.warm_python import WarmPython

from docs_build.blocks import Block, blocks

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    str(path.relative_to(ROOT)): blocks(path.read_text(encoding="utf-8"))
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md")))
    if path.is_file()
}
NEEDED = ("bags", "config", "examples", "foxglove", "launch", "rviz", "urdf")
"""Folders of the repository that commands may name; they are not to be written to."""


@pytest.fixture
def folder(tmp_path: Path, warm_python: WarmPython) -> Path:
    """Return a folder as a reader has it who has cloned the repository and run `make demo`."""
    for name in NEEDED:
        if (ROOT / name).exists():
            (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "out").mkdir()
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    warm_python.script(programs / "spacerobot", "-m", "spacerobot_ros.cli.main")
    warm_python.script(programs / "python3")
    (programs / "python").symlink_to("python3")
    return tmp_path


def run(block: Block, folder: Path, page: str) -> None:
    # Python has an interpreter of its own: it may decide on what is imported first.
    program = ["sh", "-e"] if block.language in ("sh", "bash") else [sys.executable, "-"]
    programs = folder / ".venv" / "bin"
    environment = {
        **os.environ,
        "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
        "MPLBACKEND": "agg",
    }
    done = finished(program, input=block.text, cwd=folder, env=environment, timeout=1800)
    assert done.returncode == block.exit_code, (
        f"{page}, line {block.line}: {block.text}\n{done.stdout}\n{done.stderr}"
    )


def run_page(page: str, folder: Path, slow: bool) -> None:
    for block in PAGES[page]:
        if block.file:
            path = folder / block.file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text + "\n")
        if block.run and (slow or not block.slow):
            run(block, folder, page)


@pytest.mark.parametrize(
    "page", [name for name, found in PAGES.items() if any(b.run and not b.slow for b in found)]
)
@pytest.mark.usefixtures("own_domain")
def test_commands_of_a_page_do_what_it_says(page: str, folder: Path) -> None:
    run_page(page, folder, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", [n for n, found in PAGES.items() if any(b.slow for b in found)])
@pytest.mark.usefixtures("own_domain")
def test_slow_commands_of_a_page_do_what_it_says(page: str, folder: Path) -> None:
    # Campaigns, dask and pyarrow begin threads: each command has an interpreter of its own.
    command = folder / ".venv" / "bin" / "spacerobot"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m spacerobot_ros "$@"\n')
    run_page(page, folder, slow=True)
