"""The generated references list what there is, with its defaults."""

from __future__ import annotations

import re

import click
import pytest

from docs_build import clone, reference
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
