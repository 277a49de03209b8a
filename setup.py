"""Installation by `pip install .` and, in a ROS 2 workspace, by `colcon build`."""

import os
import re
from glob import glob

from setuptools import find_packages, setup

NAME = "spacerobot_ros"

# Stands in package.xml, where ROS's tools read it.
with open("package.xml", encoding="utf-8") as manifest:
    VERSION = re.findall("<version>(.*)</version>", manifest.read())[0]


def files(pattern: str) -> list[str]:
    """Return the regular files that match `pattern`; hidden files and byte code are left out."""
    return sorted(
        path
        for path in glob(pattern, recursive=True)
        if os.path.isfile(path) and not path.endswith(".pyc")
    )


def share(folder: str) -> list[tuple[str, list[str]]]:
    """Return the `data_files` entries that copy `folder`, with its subfolders, to the share."""
    contents: dict[str, list[str]] = {}
    for path in files(f"{folder}/**"):
        contents.setdefault(f"share/{NAME}/{os.path.dirname(path)}", []).append(path)
    return sorted(contents.items())


# The documentation site, whose pages ask no server for anything.
DOCS = [
    "fonttools",
    "math-core",
    "mermaidx",
    "mkdocs-material>=9.5",
    "mkdocstrings[python]>=0.26",
    "ziamath",
]

# Kinds of meshes other than STL and OBJ, which need nothing.
MESHES = ["pycollada", "trimesh"]

# Tables for pandas and xarray, and in Parquet.
DATA = ["pandas>=2.1", "pyarrow", "xarray"]

# The live page.
VIEWER = ["viser>=1.1"]

# Many flights: workers on this machine or on others, datasets, Sobol indices.
CAMPAIGN = ["dask", "distributed", "pandas>=2.1", "pyarrow", "SALib"]

# Learning environments.
RL = ["gymnasium>=1.4"]

setup(
    name=NAME,
    version=VERSION,
    description=(
        "A ROS 2 flight stack for free-floating space robots: "
        "plant, gait planner, coordinated control, MCAP recorder."
    ),
    maintainer="spacerobot_ros developers",
    maintainer_email="maintainers@spacerobot.example.org",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=find_packages(include=["spacerobot_ros*"]),
    package_data={
        NAME: [
            "py.typed",
            "batch/*.hpp",
            "nodes/common/*.xml",
            "report/*.css",
            "report/*.js",
            "viewer/*.js",
            "report/*.mplstyle",
            "report/vendor/*",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *share("urdf"),
        *share("meshes"),
        *share("config"),
        *share("launch"),
        *share("bags"),
        *share("foxglove"),
        *share("ros2_control"),
        *share("rviz"),
        # The nodes are files and not console scripts because pip puts every console script into
        # bin/, where `ros2 run` does not look and a command called `plant` is out of place. As
        # files they are in lib/spacerobot_ros/ with pip and with colcon.
        (f"lib/{NAME}", files("scripts/*")),
    ],
    entry_points={"console_scripts": ["spacerobot = spacerobot_ros.cli:start"]},
    # rclpy and the messages are no requirement: where ROS 2 is installed they are the system's;
    # elsewhere the extra `jazzy` brings them.
    install_requires=[
        "casadi",
        "click",
        "lz4",
        "matplotlib",
        "mcap>=1.5",
        "numpy>=1.26",
        "PyYAML",
        "rosbags>=0.10.4",
        # In 1.12 to 1.14 nnls may fail, and in 1.15 it stops early: thrusters would take up to 35
        # times the propellant.
        "scipy!=1.12.*,!=1.13.*,!=1.14.*,!=1.15.*",
        "typing_extensions",
        "xacro",
        "zstandard",
    ],
    extras_require={
        "jazzy": ["ros-jazzy-common-interfaces", "ros-jazzy-rclpy[fastrtps]"],
        # Exact distances between links; pin, which the tests use, brings it as well.
        "collision": ["coal"],
        # A second engine: spacerobot verify --engine mujoco.
        "mujoco": ['mujoco>=4; python_version >= "3.11"'],
        # The 3D view of reports is MeshCat's. Only its script is used, but the package brings much.
        "viewer": ["meshcat", *MESHES, *VIEWER],
        "campaign": CAMPAIGN,
        "data": DATA,
        "rl": RL,
        "sb3": [*RL, "stable-baselines3"],
        # Flights on a GPU; ctk brings NVRTC, which compiles them.
        "cuda": ["cupy-cuda12x[ctk]"],
        "docs": [*DOCS, *DATA],  # The notebook makes tables.
        "test": [
            *CAMPAIGN,
            *DATA,
            *DOCS,
            "catkin_pkg",
            "hypothesis",
            "mcap-ros2-support",
            "meshcat",
            *MESHES,
            *RL,
            *VIEWER,
            'mujoco>=4; python_version >= "3.11"',
            "mypy",
            "pin",
            "pypdf",
            "pytest>=8",
            "pytest-timeout",
            "pytest-xdist",
            "ruff",
            "setuptools",
            "types-PyYAML",
        ],
        # What `make demo` adds for tests of your own nodes.
        "pytest": ["pytest>=8"],
        "bench": ["psutil", "pytest>=8", "pytest-benchmark>=5"],
    },
)
