"""Tests without optional packages: modules are skipped, and nothing follows the summary."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

WITHOUT_PANDAS = """
import sys

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "pandas":
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

sys.meta_path.insert(0, Finder())
"""


LATER = """
import pytest
from spacerobot_ros.errors import SpaceRobotError

def test_import():
    import pandas

@pytest.fixture
def table():
    raise SpaceRobotError("Tables need pandas, which is not installed: pip install it.")

def test_fixture(table):
    pass

def test_required_package():
    raise SpaceRobotError("Tables need numpy, which is not installed.")
"""


def run_tests(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the tests of a folder in a process that finds no pandas."""
    (folder / "without_pandas.py").write_text(WITHOUT_PANDAS)
    folders = os.pathsep.join(str(each) for each in (folder, ROOT / "test", ROOT))
    words = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(folder), "-p", "without_pandas"]
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *words, "-p", "conftest", str(folder)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": folders},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_a_module_without_its_package_is_skipped_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "test_tables.py").write_text("import pandas.api\n\ndef test_table(): pass\n")
    (tmp_path / "test_other.py").write_text(
        "import atexit, sys\n\ndef test_other():\n"
        "    atexit.register(print, 'leaked', file=sys.__stderr__, flush=True)\n"
    )
    (tmp_path / "test_wrong.py").write_text("import pandaz\n")
    run = run_tests(tmp_path)
    assert run.returncode == 2, run.stdout + run.stderr
    assert "leaked" not in run.stderr
    (line,) = [line for line in run.stdout.splitlines() if line.startswith("SKIPPED")]
    assert line.endswith("pandas is not installed (pip install 'spacerobot_ros[test]')")
    assert "test_tables.py" in line
    assert "ERROR test_wrong.py" in run.stdout, "only optional packages may be missing"


def test_a_test_that_asks_for_a_package_is_skipped_too(tmp_path: Path) -> None:
    (tmp_path / "test_later.py").write_text(LATER)
    run = run_tests(tmp_path)
    lines = run.stdout.splitlines()
    skipped = [line for line in lines if line.startswith("SKIPPED")]
    assert len(skipped) == 2
    for line in skipped:
        assert "test_later.py" in line
        assert line.endswith("pandas is not installed (pip install 'spacerobot_ros[test]')")
    (failed,) = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    assert "test_required_package" in failed
    assert lines[-1].startswith("1 failed, 2 skipped")


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
