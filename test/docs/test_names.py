"""Files and tests that the documents name exist."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from docs_build.blocks import blocks

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*sorted(ROOT.glob("docs/**/*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
_FENCED = re.compile(r"^ *```.*?^ *```", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`([^`\n]+)`")
_FILE = re.compile(r"(?:[\w.-]+/)*[\w.-]+\.(?:py|js|urdf|yaml|json|rviz)|(?:[\w-]+/)+")

_OTHERS = {
    *("examples/", "out/", "figures.json", "robot_description.urdf"),
    *("my_robot.yaml", "my_robot.urdf"),
}
"""What the program makes, and a reader writes."""


def named(page: Path) -> list[str]:
    """Return what stands between single backticks."""
    return _CODE.findall(_FENCED.sub("", page.read_text(encoding="utf-8")))


def exists(name: str) -> bool:
    """Whether a file or folder of the repository or the package is meant."""
    if any((top / name).exists() for top in (ROOT, ROOT / "spacerobot_ros")):
        return True
    inside = (ROOT / "spacerobot_ros", ROOT / "test")
    return "/" not in name.rstrip("/") and any(any(top.rglob(name.rstrip("/"))) for top in inside)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_a_page_names_exist(page: Path) -> None:
    written = {block.file for block in blocks(page.read_text(encoding="utf-8"))}
    own = written | _OTHERS
    files = {name for name in named(page) if _FILE.fullmatch(name) and "NEW" not in name}
    missing = sorted(
        name for name in files if not {name, name.rsplit("/", 1)[-1]} & own and not exists(name)
    )
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = _FENCED.sub("", page.read_text(encoding="utf-8"))
    targets = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", text)
    assert [target for target in targets if not (page.parent / target).exists()] == []


def test_classes_that_the_page_of_the_architecture_names_exist() -> None:
    package = "\n".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "spacerobot_ros").rglob("*.py")
    )
    foreign = {"PoseStamped", "JointState", "EventsExecutor"}
    found = {
        match[0]: match
        for name in named(ROOT / "docs" / "architecture.md")
        if (match := re.match(r"([A-Z][a-z]\w+)(?:\.(\w+))?", name)) and match[1] not in foreign
    }
    assert len(found) > 20
    missing = [
        name
        for name, match in found.items()
        if not re.search(rf"^class {match[1]}\b", package, re.MULTILINE)
        or (match[2] and f"def {match[2]}(" not in package)
    ]
    assert missing == []


def test_tests_that_the_page_of_faults_names_exist() -> None:
    text = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    source = (ROOT / "test" / "nodes" / "test_faults_flight.py").read_text(encoding="utf-8")
    table = text[text.index("## Response of the stack") :]
    names = re.findall(r"(?:F |, )`(\w+)(?:\.\.\.)?`", table)
    flights = [name for name in names if not (ROOT / "config" / "faults" / f"{name}.yaml").exists()]
    assert len(flights) > 10
    assert [name for name in flights if f"def test_{name}" not in source] == []


def test_the_first_picture_is_a_short_animation() -> None:
    """It moves, ends elsewhere than it begins, and is small."""
    path = ROOT / "docs" / "images" / "turning.gif"
    assert path.stat().st_size < 400_000
    for page in (ROOT / "README.md", ROOT / "docs" / "index.md"):
        first = re.search(r"!\[[^]]+\]\(([^)]+)\)", page.read_text(encoding="utf-8"))
        assert first is not None
        assert (page.parent / first[1]).resolve() == path
    with Image.open(path) as opened:
        pictures, times = [], []
        for frame in ImageSequence.Iterator(opened):
            pictures.append(np.asarray(frame.convert("L"), float))
            times.append(frame.info["duration"])
    assert 3000 < sum(times) < 20_000
    assert len(pictures) > 40
    changed = [float(np.abs(a - b).mean()) for a, b in itertools.pairwise(pictures)]
    assert min(changed) > 0
    assert np.abs(pictures[-1] - pictures[0]).mean() > 5 * np.median(changed)
