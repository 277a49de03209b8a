"""README and tutorial in a fresh clone, in one go and in order, after `make demo` alone."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from support.command_line import finished

from docs_build.blocks import Block, blocks

ROOT = Path(__file__).resolve().parents[2]
LONGEST = 900.0
STAYS = "spacerobot up "
"""Words of a command that goes on until Ctrl-C: the commands after it talk to it."""

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a clone of the repository"),
]


def environment(folder: Path, domain: int, *, activated: bool) -> dict[str, str]:
    """Return the environment of a user, with or without `. .venv/bin/activate`."""
    found = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PYTHON", "AMENT", "COLCON", "_ROS", "VIRTUAL_ENV"))
        and key not in ("LD_LIBRARY_PATH", "ROS_PYTHON_CHECK_FIELDS", "MAKEFLAGS")
    }
    found["ROS_DOMAIN_ID"] = str(domain)
    if activated:
        found["PATH"] = f"{folder / '.venv' / 'bin'}{os.pathsep}{found['PATH']}"
    return found


def do(block: Block, folder: Path, environment: dict[str, str]) -> None:
    """Run a block as it stands; Python with the interpreter of the environment."""
    program = ["sh", "-e"] if block.language == "sh" else [str(folder / ".venv/bin/python3"), "-"]
    done = finished(program, input=block.text, cwd=folder, env=environment, timeout=LONGEST)
    assert done.returncode == block.exit_code, (block.text, done.stdout, done.stderr)


def talk(commands: list[str], folder: Path, environment: dict[str, str]) -> None:
    """Start the first command, which stays, and do the others beside it."""
    with (folder / "up.txt").open("w") as log:
        stack = subprocess.Popen(
            shlex.split(commands[0]), cwd=folder, env=environment, stdout=log, stderr=log
        )
    try:
        for command in commands[1:]:
            done = finished(shlex.split(command), cwd=folder, env=environment, timeout=LONGEST)
            said = (command, done.stdout, done.stderr, (folder / "up.txt").read_text())
            assert done.returncode == 0, said
            assert "The goal is reached" in done.stdout, said
    finally:
        stack.send_signal(signal.SIGINT)
        code = stack.wait(30)
    assert code == 0, (folder / "up.txt").read_text()


@pytest.mark.skipif(shutil.which("git") is None, reason="no git")
def test_readme_and_tutorial_after_make_demo(tmp_path: Path, ros_domain: int) -> None:
    folder = tmp_path / "clone"
    subprocess.run(["git", "clone", "-q", str(ROOT), str(folder)], check=True)
    plain = environment(folder, ros_domain, activated=False)
    subprocess.run(["make", "demo"], cwd=folder, env=plain, check=True, timeout=LONGEST)
    activated = environment(folder, ros_domain, activated=True)
    run, stacks = 0, 0
    for page, given in (("README.md", plain), ("docs/tutorial.md", activated)):
        waiting: list[str] = []
        for block in blocks((folder / page).read_text("utf-8")):
            if block.file:
                (folder / block.file).write_text(block.text + "\n", "utf-8")
            if block.run:
                do(block, folder, given)
                run += 1
                continue
            for line in block.text.splitlines() if block.language == "sh" else ():
                if STAYS in line or (waiting and "spacerobot goal" in line):
                    waiting.append(line)
        talk(waiting, folder, given)
        stacks += len(waiting) > 1
    assert run >= 9
    assert stacks == 2
