"""Interface packages that are not among ROS's wheels, built with the wheels' generators."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import venv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]

_GENERATORS = (
    "ament-cmake", "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-include-directories",
    "ament-cmake-pytest", "ament-cmake-ros", "ament-package", "common-interfaces",
    "python-cmake-module", "rclpy[fastrtps]", "rosidl-core-generators", "rosidl-default-generators",
)  # fmt: skip

_CMAKE = """
cmake_minimum_required(VERSION 3.8)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{found}
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {depends})
ament_package()
"""

_MANIFEST = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name><version>0.0.0</version><description>Interfaces.</description>
  <maintainer email="a@b.org">a</maintainer><license>BSD</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""


@dataclass(frozen=True)
class InterfacePackage:
    """Name and files, by path, of a package."""

    name: str
    files: Mapping[str, str]

    @classmethod
    def of(
        cls, name: str, interfaces: Mapping[str, str], depends: Sequence[str]
    ) -> InterfacePackage:
        """Return a package of interface files."""
        cmake = _CMAKE.format(
            name=name,
            found="\n".join(f"find_package({each} REQUIRED)" for each in depends),
            files=" ".join(f'"{path}"' for path in interfaces),
            depends=" ".join(depends),
        )
        named = "".join(f"<depend>{each}</depend>" for each in depends)
        manifest = _MANIFEST.format(name=name, depends=named)
        return cls(name, {**interfaces, "CMakeLists.txt": cmake, "package.xml": manifest})


TF2_MSGS = InterfacePackage.of(
    "tf2_msgs",
    {"msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n"},
    ["geometry_msgs"],
)

NAV2_MSGS = InterfacePackage.of(
    "nav2_msgs",
    {
        "action/NavigateToPose.action": """\
geometry_msgs/PoseStamped pose
string behavior_tree
---
uint16 NONE=0
uint16 UNKNOWN=9000
uint16 FAILED_TO_LOAD_BEHAVIOR_TREE=9001
uint16 TF_ERROR=9002
uint16 error_code
string error_msg
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
"""
    },
    ["builtin_interfaces", "geometry_msgs"],
)
"""The action of nav2_msgs that the nodes serve, with the fields of ROS 2 Jazzy."""

CONTROL_MSGS = InterfacePackage.of(
    "control_msgs",
    {
        "msg/JointTolerance.msg": """\
string name
float64 position
float64 velocity
float64 acceleration
""",
        "msg/JointComponentTolerance.msg": """\
string joint_name
uint16 component
float64 position
float64 velocity
float64 acceleration
""",
        "action/FollowJointTrajectory.action": """\
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
JointTolerance[] path_tolerance
JointComponentTolerance[] component_path_tolerance
JointTolerance[] goal_tolerance
JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 error_code
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
""",
    },
    ["builtin_interfaces", "std_msgs", "trajectory_msgs"],
)
"""The action of control_msgs that the planner is a client of, with the fields that it has."""

SPACEROBOT_MSGS = InterfacePackage(
    "spacerobot_msgs",
    {
        str(path.relative_to(ROOT / "spacerobot_msgs")): path.read_text(encoding="utf-8")
        for path in sorted((ROOT / "spacerobot_msgs").rglob("*"))
        if path.is_file()
    },
)
"""The project's own package, with its own files."""


def with_interfaces(*packages: InterfacePackage) -> dict[str, str]:
    """Build packages, or find them built; return the environment variables that have them."""
    text = repr((sys.version, _GENERATORS, packages))
    cache = Path(tempfile.gettempdir()) / f"spacerobot-interfaces-{os.getuid()}"
    prefix = cache / hashlib.sha256(text.encode()).hexdigest()[:16]
    if not prefix.exists():
        cache.mkdir(mode=0o700, exist_ok=True)
        assert cache.stat().st_uid == os.getuid()
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            _build(packages, Path(folder))
            shutil.rmtree(prefix, ignore_errors=True)
            (Path(folder) / "install").rename(prefix)
    (module,) = prefix.glob("lib/python3*/site-packages")
    # The wheels have set their folder of libraries for this process, and do so once.
    libraries = [str(prefix / "lib"), os.environ.get("LD_LIBRARY_PATH", ""), f"{sys.prefix}/lib"]
    return {
        "AMENT_PREFIX_PATH": f"{prefix}:{sys.prefix}",
        "PYTHONPATH": f"{module}:{os.environ.get('PYTHONPATH', '')}",
        "LD_LIBRARY_PATH": ":".join(libraries),
    }


def generators(tools: Path, *others: str) -> dict[str, str]:
    """Install the wheels' generators of interfaces, and other wheels, into a new environment.

    Returns the environment variables by which CMake finds them.
    """
    venv.create(tools, with_pip=True)
    python = str(tools / "bin" / "python3")
    wheels = [f"ros-jazzy-{name}" for name in _GENERATORS]
    _run(python, "-m", "pip", "install", "-q", "numpy", "catkin_pkg", *wheels, *others)
    # The exported targets name the Python of the machine that the wheels were made on.
    here = {
        "/numpy/_core/include": np.get_include(),
        f"/include/python3.{sys.version_info[1]}": sysconfig.get_paths()["include"],
    }
    for file in (tools / "share").glob("*/cmake/export_*__rosidl_generator_pyExport.cmake"):
        words = file.read_text().split('"')
        for i, word in enumerate(words):
            paths = word.split(";")
            for old, new in here.items():
                paths = [new if p.startswith("/opt/") and p.endswith(old) else p for p in paths]
            words[i] = ";".join(paths)
        file.write_text('"'.join(words))
    return {
        "AMENT_PREFIX_PATH": str(tools),
        "CMAKE_PREFIX_PATH": str(tools),
        "LD_LIBRARY_PATH": str(tools / "lib"),
        "PATH": f"{tools / 'bin'}:{os.environ['PATH']}",
    }


def _build(packages: Sequence[InterfacePackage], folder: Path) -> None:
    """Build and install packages into ``install`` below a folder."""
    found, prefix = generators(folder / "tools"), folder / "install"
    python = str(folder / "tools" / "bin" / "python3")
    options = [f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DBUILD_TESTING=OFF"]
    options.append(f"-DPython3_EXECUTABLE={python}")
    for package in packages:
        source, build = folder / "src" / package.name, str(folder / "build" / package.name)
        for path, text in package.files.items():
            (source / path).parent.mkdir(parents=True, exist_ok=True)
            (source / path).write_text(text, encoding="utf-8")
        _run("cmake", "-S", str(source), "-B", build, *options, **found)
        _run("cmake", "--build", build, **found)
        _run("cmake", "--install", build, **found)


def _run(*words: str, **environment: str) -> None:
    done = subprocess.run(
        words, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
