"""What `pip install .` and `colcon build` install, and that every file names one version."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import yaml
from catkin_pkg.package import Package, parse_package
from support.colcon import colcon_program, new_environment, run

import spacerobot_ros

ROOT = Path(__file__).resolve().parents[2]
NODES = sorted(path.name for path in (ROOT / "scripts").iterdir() if path.is_file())
# That of Ubuntu 24.04, the last that colcon takes, the newest.
SETUPTOOLS = ["setuptools==68.1.*", "setuptools<80", "setuptools"]

STUB = """
import json
import sys


def main():
    print(json.dumps({"module": __name__, "prefix": sys.prefix, "arguments": sys.argv[1:]}))
"""


def module_of(node: str) -> str:
    """Return the module that an executable runs."""
    modules = {
        "coordinated_control": "controller",
        "planner": "planner",
        "recorder": "recorder",
        "replay": "replay",
    }
    return f"spacerobot_ros.nodes.{modules.get(node, f'{node}.node')}"


@pytest.fixture
def manifest() -> Package:
    return parse_package(ROOT / "package.xml", warnings=[])


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return a copy of the project in which each node prints how it was called and ends."""
    project = tmp_path / "project"
    project.mkdir()
    for name in ("LICENSE", "package.xml", "pyproject.toml", "setup.cfg", "setup.py"):
        shutil.copy2(ROOT / name, project)
    for name in (
        *("bags", "config", "foxglove", "launch", "meshes", "resource", "rviz", "scripts", "urdf"),
    ):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, project / name)
    for folder in ("urdf/meshes", "config"):
        (project / folder).mkdir(parents=True, exist_ok=True)
        (project / folder / "packaging_test.txt").touch()
    for module in ("__init__", "cli/__init__", "cli/main", "nodes/__init__"):
        source = project / "spacerobot_ros" / f"{module}.py"
        source.parent.mkdir(parents=True, exist_ok=True)
        source.write_text(STUB)
    for node in NODES:
        source = project / f"{module_of(node).replace('.', '/')}.py"
        source.parent.mkdir(exist_ok=True)
        (source.parent / "__init__.py").touch()
        source.write_text(STUB)
    return project


def check_installed(prefix: Path) -> None:
    """Check everything that ROS 2 tools look for below `prefix`."""
    marker = prefix / "share/ament_index/resource_index/packages/spacerobot_ros"
    assert marker.is_file()
    share = prefix / "share" / "spacerobot_ros"
    assert (share / "package.xml").is_file()
    assert (share / "urdf" / "meshes" / "packaging_test.txt").is_file()
    assert (share / "config" / "packaging_test.txt").is_file()
    assert (share / "meshes" / "surveyor" / "bus.stl").is_file()
    for node in NODES:
        assert os.access(prefix / "lib" / "spacerobot_ros" / node, os.X_OK)


def test_the_manifest_is_a_package_of_format_3_that_colcon_builds(manifest: Package) -> None:
    warnings: list[str] = []
    manifest.validate(warnings=warnings)
    assert warnings == []
    assert manifest.package_format == 3
    assert manifest.get_build_type() == "ament_python"


def test_manifest_setup_and_module_say_the_same(manifest: Package) -> None:
    fields = ["name", "version", "description", "license", "maintainer", "maintainer-email"]
    options = [f"--{field}" for field in fields]
    said = run([sys.executable, "setup.py", *options], cwd=ROOT).splitlines()
    maintainer = manifest.maintainers[0]
    assert said == [
        manifest.name,
        manifest.version,
        manifest.description,
        manifest.licenses[0],
        maintainer.name,
        maintainer.email,
    ]
    assert spacerobot_ros.__version__ == manifest.version


def test_a_node_has_a_script_that_runs_its_module() -> None:
    assert {"plant", "planner", "recorder", "replay"} <= set(NODES)
    for node in NODES:
        script = ROOT / "scripts" / node
        assert os.access(script, os.X_OK)
        assert f'sys.exit(run_module("{module_of(node)}"))\n' in script.read_text()


def test_ctrl_c_during_the_first_import_of_a_node_ends_it_quietly(tmp_path: Path) -> None:
    package = tmp_path / "spacerobot_ros"
    package.mkdir()
    (package / "__init__.py").write_text("import signal\n\nsignal.raise_signal(signal.SIGINT)\n")
    given: Any = {"env": {"PYTHONPATH": str(tmp_path)}, "capture_output": True}
    for node in NODES:
        ended = subprocess.run([sys.executable, ROOT / "scripts" / node], check=False, **given)
        assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"", b"")


@pytest.mark.study
@pytest.mark.parametrize("setuptools", SETUPTOOLS)
def test_pip_installs_nodes_that_run_outside_an_active_environment(
    project: Path, tmp_path: Path, setuptools: str
) -> None:
    prefix = tmp_path / "prefix"
    python = new_environment(prefix)
    run([python, "-m", "pip", "install", "--upgrade", setuptools, "wheel"])
    run([python, "-m", "pip", "install", "--no-deps", "--no-build-isolation", project])
    check_installed(prefix)
    assert (prefix / "bin" / "spacerobot").is_file()
    for node in NODES:
        assert not (prefix / "bin" / node).exists()
        called = json.loads(run([prefix / "lib" / "spacerobot_ros" / node, "-r", "a:=b c"]))
        assert called == {
            "module": module_of(node),
            "prefix": str(prefix),
            "arguments": ["-r", "a:=b c"],
        }


@pytest.fixture(scope="module")
def colcon(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return colcon_program(tmp_path_factory.mktemp("colcon"))


@pytest.mark.study
@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copies", "symlinks"])
def test_colcon_builds_a_package_in_which_ros2_run_finds_the_nodes(
    project: Path, tmp_path: Path, colcon: Path, options: list[str]
) -> None:
    listed = run([colcon, "--log-base", os.devnull, "list", "--base-paths", project])
    assert listed.split() == ["spacerobot_ros", str(project), "(ros.ament_python)"]

    workspace = tmp_path / "workspace"
    workspace.mkdir()
    run([colcon, "build", "--base-paths", project, *options], cwd=workspace)
    install = workspace / "install"
    prefix = install / "spacerobot_ros"
    check_installed(prefix)
    assert os.access(prefix / "lib" / "spacerobot_ros" / "spacerobot", os.X_OK)

    for node in NODES:
        executable = prefix / "lib" / "spacerobot_ros" / node
        script = f". {install}/local_setup.sh && echo $AMENT_PREFIX_PATH && exec {executable} a"
        prefixes, called = run(
            ["sh", "-c", script], cwd=install, path=str(Path(sys.executable).parent)
        ).splitlines()
        assert str(prefix) in prefixes.split(os.pathsep)
        assert json.loads(called)["module"] == module_of(node)
        assert json.loads(called)["arguments"] == ["a"]


# -- files about the project -------------------------------------------------------------------

TARGETS = {
    *re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE),
    *yaml.safe_load((ROOT / "test/studies.yaml").read_text("utf-8")),
}
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def recipes() -> dict[str, list[str]]:
    """Return the files of every row of "To add X, touch these files"."""
    section = CONTRIBUTING.split("## To add something")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| **")]
    return {row[0].strip(" *"): re.findall(r"`([^`]+)`", row[1]) for row in rows}


def test_every_folder_with_modules_is_installed() -> None:
    folders = {each.parent for each in (ROOT / "spacerobot_ros").rglob("*.py")}
    assert [str(each) for each in folders if not (each / "__init__.py").exists()] == []


def test_one_version_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == spacerobot_ros.__version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (?:\[)?(\d+\.\d+\.\d+)", changes, re.MULTILINE)[0] == (
        spacerobot_ros.__version__
    )


@pytest.mark.parametrize("recipe", recipes())
def test_the_files_to_touch_exist(recipe: str) -> None:
    files = recipes()[recipe]
    assert files
    for file in files:
        # A new file stands as the folder that it goes into, and a name in capitals.
        existing = file.split("NEW")[0].rstrip("/")
        assert (ROOT / existing).exists(), file


def test_a_parameter_takes_two_files_and_a_topic_three() -> None:
    assert len(recipes()["parameter"]) <= 2
    assert len(recipes()["plant topic"]) <= 3


@pytest.mark.parametrize("document", ["README.md", "CONTRIBUTING.md"])
def test_make_targets_that_are_named_exist(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    named = set(re.findall(r"^(?:.*run: |\s*|.*`)make ([a-z][a-z-]*)", text, re.MULTILINE))
    assert named
    assert named <= TARGETS


def test_hooks_are_those_of_make_test() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["id"] for hook in hooks] == ["ruff-check", "ruff-format", "mypy"]


def test_the_manifest_declares_what_is_imported_of_ros() -> None:
    manifest = parse_package(ROOT / "package.xml", warnings=[])
    declared = {depend.name for depend in manifest.exec_depends}
    sources = [*ROOT.glob("spacerobot_ros/**/*.py"), *ROOT.glob("launch/*.py")]
    text = "\n".join(source.read_text("utf-8") for source in sources)
    imported = set(re.findall(r"^\s*(?:from|import) (\w+)", text, re.MULTILINE))
    kinds = re.compile(r"_msgs$|_interfaces$|^rcl|^launch|^rosidl")
    assert {name for name in imported if kinds.search(name)} <= declared
    # tf2_msgs was declared and never imported.
    messages = {name for name in declared if name.endswith("_msgs")}
    assert {name for name in messages if name not in text} == set()


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 110


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


@pytest.mark.slow
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


MANIFESTS = ("package.xml", "spacerobot_msgs/package.xml")
DISTRIBUTION, CODENAME = "jazzy", "noble"

KEPT = json.loads((ROOT / "test" / "expected" / "rosdep.json").read_text("utf-8"))
CHECKOUT = os.environ.get("SPACEROBOT_ROSDISTRO", "")


def keys_of(*manifests: str) -> list[str]:
    """Return the keys that manifests of the project depend on, sorted."""
    found = set()
    for path in manifests:
        package = parse_package(ROOT / path, warnings=[])
        found |= {
            depend.name
            for kind in ("build", "buildtool", "build_export", "exec", "test", "doc")
            for depend in getattr(package, f"{kind}_depends")
        }
    return sorted(found)


def resolved(keys: Iterable[str], checkout: Path) -> dict[str, str]:
    """Return by key what is installed: ``apt NAME ...`` or ``pip NAME ...``; empty: nothing is.

    A package that the distribution has released is ``apt ros-jazzy-...``.

    Parameters
    ----------
    keys
        Keys of rosdep.
    checkout
        A work tree of rosdistro, or its git directory.
    """
    rules: dict[str, Any] = {}
    for name in ("base", "python"):
        rules |= _document(checkout, f"rosdep/{name}.yaml")
    repositories = _document(checkout, f"{DISTRIBUTION}/distribution.yaml")["repositories"]
    released = {
        package
        for repository, about in repositories.items()
        if "version" in about.get("release", {})
        for package in about["release"].get("packages", [repository])
    }
    return {
        key: f"apt ros-{DISTRIBUTION}-{key.replace('_', '-')}"
        if key in released
        else installed(rules.get(key, {}).get("ubuntu"))
        for key in keys
    }


def installed(rule: Any) -> str:
    """Return what a rule for Ubuntu installs there; empty: nothing."""
    installers = {"apt", "pip"}
    if isinstance(rule, dict) and not installers & set(rule):
        rule = rule.get(CODENAME, rule.get("*"))
    if not rule:
        return ""
    if isinstance(rule, dict):
        (installer,) = installers & set(rule)
        return " ".join([installer, *rule[installer]["packages"]])
    return " ".join(["apt", *([rule] if isinstance(rule, str) else rule)])


def _document(checkout: Path, path: str) -> dict[str, Any]:
    file = checkout / path
    if file.is_file():
        text = file.read_text("utf-8")
    else:
        text = subprocess.run(
            ["git", "-C", str(checkout), "show", f"HEAD:{path}"],
            capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
    document = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    assert isinstance(document, dict)
    return document


def test_each_key_is_in_the_list() -> None:
    keys = keys_of(*MANIFESTS)
    assert keys == list(KEPT)
    assert {"rclpy", "rosidl_default_generators", "python3-pytest"} <= set(keys)
    for key, words in KEPT.items():
        assert words.split()[0] in ("apt", "pip"), f"{key} installs nothing"


def test_what_pip_installs_is_declared_for_pip_too() -> None:
    setup = (ROOT / "setup.py").read_text("utf-8")
    for words in KEPT.values():
        installer, *names = words.split()
        for name in names if installer == "pip" else []:
            assert f'"{name}' in setup or f"'{name}" in setup, name


@pytest.mark.study
@pytest.mark.skipif(not CHECKOUT, reason="SPACEROBOT_ROSDISTRO names no checkout of rosdistro")
def test_the_list_is_that_of_rosdistro() -> None:
    found = resolved(keys_of(*MANIFESTS), Path(CHECKOUT))
    for key, words in found.items():
        print(f"{key:28} {words or 'is not known'}")
    assert found == KEPT
    # Packages that the pages name, without which some doors are closed.
    more = ["control_msgs", "joint_state_topic_hardware_interface", "nav2_msgs", "ros2_control"]
    assert all(resolved([*more, "ros2_controllers"], Path(CHECKOUT)).values())
