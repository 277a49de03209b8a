"""colcon, in an environment of its own where the machine has none."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

COLCON = [
    "catkin_pkg",
    "colcon-core",
    "colcon-library-path",
    "colcon-metadata",
    "colcon-package-information",
    "colcon-parallel-executor",
    "colcon-python-setup-py",
    "colcon-recursive-crawl",
    "colcon-ros",
    "setuptools<80",
]


def run(command: list[str | Path], cwd: Path | None = None, path: str = "") -> str:
    """Return the output of `command` in an environment that nothing has been sourced in."""
    kept = {"HOME", "LANG", "LC_ALL", "TMPDIR"}
    environment = {
        name: value
        for name, value in os.environ.items()
        if name in kept or name.startswith(("PIP_", "SSL_"))
    }
    environment["PATH"] = os.pathsep.join(filter(None, [path, os.defpath]))
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{command}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def new_environment(prefix: Path) -> Path:
    """Create a virtual environment and return its Python."""
    run([sys.executable, "-m", "venv", prefix])
    return prefix / "bin" / "python3"


def colcon_program(prefix: Path) -> Path:
    """Return the machine's colcon, or else one that is installed below a folder."""
    found = shutil.which("colcon")
    if found:
        return Path(found)
    run([new_environment(prefix), "-m", "pip", "install", *COLCON])
    return prefix / "bin" / "colcon"
