"""The files about the project name one version, existing files, existing targets."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from catkin_pkg.package import parse_package

import spacerobot_ros

ROOT = Path(__file__).resolve().parents[2]
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
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 170
