"""The keys of the manifests are known to rosdep, and name what an Ubuntu with ROS 2 Jazzy has.

``test/expected/rosdep.json`` has what each installs; `make rosdep-keys ROSDISTRO=PATH` compares it
with a checkout of https://github.com/ros/rosdistro (a work tree or a git directory).
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import yaml
from catkin_pkg.package import parse_package

ROOT = Path(__file__).resolve().parents[2]
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


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        (None, ""),
        (["python3-click"], "apt python3-click"),
        ("python3-click", "apt python3-click"),
        ({"noble": ["one", "two"], "*": ["three"]}, "apt one two"),
        ({"focal": ["one"], "*": ["three"]}, "apt three"),
        ({"noble": None, "*": ["three"]}, ""),
        ({"focal": ["one"]}, ""),
        ({"pip": {"packages": ["casadi"]}}, "pip casadi"),
        ({"*": {"pip": {"packages": ["casadi"]}}}, "pip casadi"),
        ({"noble": {"apt": {"packages": ["one"]}}}, "apt one"),
    ],
)
def test_rules_of_rosdep_are_those_of_its_format(rule: Any, words: str) -> None:
    assert installed(rule) == words


def test_packages_of_the_distribution_are_debian_packages(tmp_path: Path) -> None:
    for path, text in {
        "rosdep/base.yaml": "cmake: {ubuntu: [cmake]}\nold: {fedora: [old]}\n",
        "rosdep/python.yaml": "casadi-pip: {ubuntu: {pip: {packages: [casadi]}}}\n",
        "jazzy/distribution.yaml": """\
repositories:
  common: {release: {packages: [one_msgs, two_msgs], version: 1.0.0-1}}
  alone: {release: {version: 2.0.0-1}}
  planned: {release: {packages: [three_msgs]}}
  source_only: {source: {type: git}}
""",
    }.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text)
    keys = ["two_msgs", "alone", "three_msgs", "source_only", "cmake", "old", "casadi-pip", "none"]
    assert resolved(keys, tmp_path) == {
        "two_msgs": "apt ros-jazzy-two-msgs",
        "alone": "apt ros-jazzy-alone",
        "three_msgs": "",
        "source_only": "",
        "cmake": "apt cmake",
        "old": "",
        "casadi-pip": "pip casadi",
        "none": "",
    }


@pytest.mark.slow
@pytest.mark.skipif(not CHECKOUT, reason="SPACEROBOT_ROSDISTRO names no checkout of rosdistro")
def test_the_list_is_that_of_rosdistro() -> None:
    found = resolved(keys_of(*MANIFESTS), Path(CHECKOUT))
    for key, words in found.items():
        print(f"{key:28} {words or 'is not known'}")
    assert found == KEPT
    # Packages that the pages name, without which some doors are closed.
    more = ["control_msgs", "joint_state_topic_hardware_interface", "nav2_msgs", "ros2_control"]
    assert all(resolved([*more, "ros2_controllers"], Path(CHECKOUT)).values())
