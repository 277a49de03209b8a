"""Tests without optional packages: modules are skipped, and nothing follows the summary."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_documentation_has_the_packages_of_its_notebook() -> None:
    tree = ast.parse((ROOT / "setup.py").read_text("utf-8"))
    (extras,) = [
        keyword.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg == "extras_require"
    ]
    assert isinstance(extras, ast.Dict)
    by_name = {
        ast.literal_eval(key): value
        for key, value in zip(extras.keys, extras.values, strict=True)
        if key is not None
    }
    named = {each.id for each in ast.walk(by_name["docs"]) if isinstance(each, ast.Name)}
    assert named == {"DOCS", "DATA"}
    notebook = (ROOT / "docs" / "notebooks" / "first_flight.py").read_text("utf-8")
    assert "to_pandas" in notebook


WITHOUT_ROS = """
import sys

class Finder:
    def find_spec(self, name, path=None, target=None):
        package = name.partition(".")[0]
        if package.startswith(("rcl", "rosidl_", "ament_")) or package.endswith("_msgs"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

sys.meta_path.insert(0, Finder())

if __name__ == "__main__":
    from spacerobot_ros.cli import start

    start()
"""


def test_flights_need_no_ros(tmp_path: Path) -> None:
    """Commands that fly without nodes work; the others say in one sentence what is missing."""
    (tmp_path / "command.py").write_text(WITHOUT_ROS)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def command(line: str) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "command.py", *line.split()]
        return subprocess.run(
            words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )

    for line in (
        "run faults/weak_motors --longest 2 --bag a.mcap",
        "verify a.mcap",
        "report a.mcap",
        "plan sliding_masses --method lie_bracket",
        f"campaign fly {ROOT}/examples/campaigns/first.yaml --flights 1 --workers 0 --out flown",
    ):
        done = command(line)
        assert done.returncode == (line.startswith("run")), done.stderr
    for line in ("run sliding_masses --nodes", "up sliding_masses"):
        done = command(line)
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert "ROS 2 was not found" in done.stderr
        assert "[jazzy]" in done.stderr
