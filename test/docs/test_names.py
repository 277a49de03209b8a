"""Files and tests that the documents name exist."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import click
import numpy as np
import pytest
from PIL import Image, ImageSequence

from docs_build import clone, reference
from docs_build.blocks import blocks
from docs_build.hooks import prepared
from spacerobot_ros.cli.main import COMMANDS, main
from spacerobot_ros.nodes import (
    CoordinatedControlNode,
    FlightNode,
    PlannerNode,
    PlantNode,
    RecorderNode,
    ReplayNode,
)
from spacerobot_ros.nodes.common.node import AUTOSTART
from spacerobot_ros.parameters import declared
from spacerobot_ros.topics import TOPICS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*sorted(ROOT.glob("docs/**/*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
DESIGN = [
    *(ROOT / "docs" / name for name in ("architecture.md", "choosing.md")),
    *(ROOT / "docs" / "planner_state_machine.md", *sorted(ROOT.glob("docs/theory/*.md"))),
]
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


@pytest.mark.parametrize("page", DESIGN, ids=lambda page: page.name)
def test_classes_that_a_page_of_the_design_names_exist_with_their_methods(page: Path) -> None:
    package = "\n".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "spacerobot_ros").rglob("*.py")
    )
    foreign = {"PoseStamped", "JointState", "EventsExecutor"}
    missing = [
        match[0]
        for name in named(page)
        if (match := re.match(r"([A-Z][a-z]\w+)(?:\.(\w+))?", name))
        and match[1] not in foreign
        and not (
            re.search(rf"^class {match[1]}\b", package, re.MULTILINE)
            and re.search(rf"def {match[2]}\(|^    {match[2]}:" if match[2] else "", package, re.M)
        )
    ]
    assert missing == []


def test_tests_that_the_page_of_faults_names_exist() -> None:
    text = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    source = (ROOT / "test" / "session" / "test_scenario_flights.py").read_text(encoding="utf-8")
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


def rows_of(markdown: str) -> list[list[str]]:
    """Return the cells of a table whose rows begin with a code span."""
    return [
        [cell.strip().strip("`").replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in markdown.splitlines()
        if line.startswith("| `")
    ]


@pytest.mark.parametrize(
    ("heading", "node"),
    [
        ("plant", PlantNode),
        ("planner", PlannerNode),
        ("coordinated_control", CoordinatedControlNode),
        ("recorder", RecorderNode),
        ("replay", ReplayNode),
    ],
)
def test_parameters_are_documented_with_their_defaults(
    heading: str, node: type[FlightNode]
) -> None:
    page = prepared((reference.DOCS / "reference" / "parameters.md").read_text(encoding="utf-8"))
    section = page.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    documented = {row[0]: row for row in rows_of(section)}
    for spec in (AUTOSTART, *declared(node.Config)):
        default: object = spec.default
        if isinstance(default, bool):
            default = str(default).lower()
        elif isinstance(default, tuple):
            default = list(default)
        row = documented.pop(spec.name)
        assert row[2] == (str(default) or "''"), spec.name
        assert row[3] == spec.unit
        for choice in spec.choices:
            assert f"`{choice}`" in f"`{row[4]}`"
        assert row[5].startswith(spec.description.replace("<", "&lt;"))
    assert documented == {}


def test_every_command_and_option_is_documented() -> None:
    headings = r"^#{2,3} (.+?)\n(.*?)(?=^#{2,3} |\Z)"
    sections = dict(re.findall(headings, reference.command_line(), re.MULTILINE | re.DOTALL))
    commands: dict[str, click.Command] = {}
    for name in COMMANDS:
        command = main.get_command(click.Context(main, **main.context_settings), name)
        assert command is not None
        commands[name] = command
        if isinstance(command, click.Group):
            commands |= {f"{name} {below}": each for below, each in command.commands.items()}
    assert list(sections) == list(commands)
    for words, command in commands.items():
        for parameter in command.params:
            for option in (*parameter.opts, *parameter.secondary_opts):
                assert option in sections[words] or parameter.human_readable_name in sections[words]


@pytest.mark.parametrize("name", clone.references())
def test_the_references_in_the_clone_are_those_of_make_reference(name: str) -> None:
    assert (clone.FOLDER / name).read_text("utf-8") == clone.references()[name]


def test_every_topic_is_documented() -> None:
    rows = {row[0]: row for row in rows_of(reference.topics())}
    assert list(rows) == list(TOPICS)
    for name, topic in TOPICS.items():
        assert rows[name][1].startswith(topic.short_type)
        assert ("latched" in rows[name][1]) == topic.latched


def test_every_service_is_documented_with_its_type() -> None:
    page = (reference.DOCS / "reference" / "topics.md").read_text(encoding="utf-8")
    documented = {(row[0], row[1]) for row in rows_of(page.split("## Services")[1])}
    found = set()
    nodes = reference.DOCS.parent / "spacerobot_ros" / "nodes"
    for path in nodes.rglob("*.py"):
        relative = path.relative_to(nodes)
        folder = relative.parts[0] if len(relative.parts) > 1 else path.stem
        names = {
            "controller": ("coordinated_control",),
            "common": ("planner", "coordinated_control") if path.stem == "commander" else ("NODE",),
        }.get(folder, (folder,))
        source = path.read_text(encoding="utf-8")
        for kind, name in re.findall(r'create_service\((\w+), "~/(\w+)"', source):
            found |= {(f"{node}/{name}", f"std_srvs/{kind}") for node in names}
        for name in re.findall(r'self.offer\("~/(\w+)"', source):
            found |= {(f"{node}/{name}", "std_srvs/Trigger") for node in names}
    assert len(found) >= 9
    assert documented == found
