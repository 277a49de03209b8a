"""What `pip install .` and `colcon build` install, and that every file names one version."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
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


@pytest.mark.slow
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


@pytest.mark.slow
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
