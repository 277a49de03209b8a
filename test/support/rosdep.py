"""What rosdep makes of the keys of a manifest on Ubuntu, by a checkout of ros/rosdistro."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from catkin_pkg.package import parse_package

ROOT = Path(__file__).resolve().parents[2]
MANIFESTS = ("package.xml", "spacerobot_msgs/package.xml")
DISTRIBUTION, CODENAME = "jazzy", "noble"


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
