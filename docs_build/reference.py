"""The generated references, as Markdown: parameters, command line, Python API."""

from __future__ import annotations

import importlib
import inspect
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import click

from spacerobot_ros.cli.main import main
from spacerobot_ros.nodes import NODE_TYPES, ReplayNode
from spacerobot_ros.nodes.common.node import AUTOSTART
from spacerobot_ros.parameters import Parameter, declared
from spacerobot_ros.topics import TOPICS, state_topics

DOCS = Path(__file__).resolve().parents[1] / "docs"
"""The texts."""

NODES: dict[str, Any] = {**NODE_TYPES, "replay": ReplayNode}
"""Nodes by the names that parameter files give them."""


def parameters(node: str) -> str:
    """Return the table of a node's parameters."""
    return parameter_table((AUTOSTART, *declared(NODES[node].Config)))


def parameter_table(declarations: Iterable[Parameter]) -> str:
    """Return a table of parameters: name, type, default, unit, range, description."""
    header = ("parameter", "type", "default", "unit", "range", "description")
    return table(header, [_row(declaration) for declaration in declarations])


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
        for cells in (header, ["---"] * len(header), *rows)
    )


def default_text(value: Any) -> str:
    """Return a default as a parameter file writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(default_text(each) for each in value) + "]"
    return str(value) or "''"


def topics() -> str:
    """Return the table of the stack's topics."""
    rows = []
    for topic in TOPICS.values():
        names = [node if node != "user" else "you" for node in topic.publishers]
        latched = ", latched" if topic.latched else ""
        condition = f" If {topic.condition}." if topic.condition else ""
        rows.append(
            (
                f"`{topic.name}`",
                f"{topic.short_type}{latched}",
                ", ".join(names),
                f"{topic.meaning}.{condition}",
            )
        )
    return table(("topic", "type", "from", "meaning"), rows)


def state_fields() -> str:
    """Return the table of the numbers that the plant's state topics carry."""
    rows = []
    for topic in state_topics():
        for field in topic.state:
            numbers = ", ".join(f"`{each}`" for each in field.members or field.array_entry_names)
            numbers = numbers or f"one for each of the {topic.array_entries_of}"
            rows.append((f"`{topic.name}`", f"`{field.path}`", numbers))
    return table(("topic", "field", "numbers"), rows)


def foreign_robots() -> str:
    """Return the table of random goals of robots that are in no paper: `make foreign-robots`."""
    header = (
        "robot",
        "what it is like",
        "joints",
        "mass ratio",
        "goals",
        "reached",
        "refused or missed",
        "duration (s)",
        "CPU (s)",
    )
    rows = json.loads((DOCS / "foreign_robots.json").read_text(encoding="utf-8"))
    return table(header, [_foreign_row(row) for row in rows])


def _foreign_row(row: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of one robot."""
    names = {"refused": "method"}
    refused = ", ".join(f"{names.get(why, why)} {n}" for why, n in row["refused"].items())
    others = ", ".join(f"{n} by `{name}`" for name, n in row["methods"].items())
    return (
        f"`{row['robot']}`",
        row["what"],
        str(row["joints"]),
        f"{row['mass_ratio']:.2g}",
        str(row["goals"]),
        f"{row['met']} ({others})" if row["met"] else "0",
        refused or "none",
        f"{row['median_duration']:.3g}",
        f"{row['median_cpu']:.2g}",
    )


def _row(declaration: Parameter) -> tuple[str, ...]:
    changes = "" if declaration.read_only else " *May change while the node runs.*"
    return (
        f"`{declaration.name}`",
        _type(declaration),
        f"`{default_text(declaration.default)}`",
        declaration.unit,
        _range(declaration),
        declaration.description.replace("<", "&lt;") + changes,
    )


def _type(declaration: Parameter) -> str:
    value = declaration.default
    if isinstance(value, tuple):
        return "texts" if declaration.texts else "numbers"
    return {"bool": "true or false", "int": "whole number", "float": "number", "str": "text"}[
        type(value).__name__
    ]


def _range(declaration: Parameter) -> str:
    if declaration.choices:
        return ", ".join(f"`{choice}`" for choice in declaration.choices)
    parts = []
    if declaration.length is not None:
        parts.append(f"{declaration.length} entries, or none")
    low, high = declaration.minimum, declaration.maximum
    if math.isfinite(low) and math.isfinite(high):
        parts.append(f"{low:g} to {high:g}")
    elif math.isfinite(low):
        parts.append(f"at least {low:g}")
    elif math.isfinite(high):
        parts.append(f"at most {high:g}")
    return "; ".join(parts)


def command_line() -> str:
    """Return a section for every command: what it does, its usage, its options."""
    context = click.Context(main, info_name="spacerobot", **main.context_settings)
    sections = []
    for name in main.list_commands(context):
        command = main.get_command(context, name)
        assert command is not None
        sections.append(_command("##", name, command, context))
        if isinstance(command, click.Group):
            inner = click.Context(command, info_name=name, parent=context)
            sections += [
                _command("###", f"{name} {below}", each, inner)
                for below, each in command.commands.items()
            ]
    return "\n\n".join(sections)


def _command(level: str, words: str, command: click.Command, parent: click.Context) -> str:
    """Return the section of a command that is called by ``words``."""
    context = click.Context(command, info_name=words.split()[-1], parent=parent)
    usage = " ".join(command.collect_usage_pieces(context))
    rows = [
        (f"`{record[0]}`", record[1])
        for parameter in command.get_params(context)
        if (record := parameter.get_help_record(context)) is not None and record[1]
    ]
    parts = [
        f"{level} {words}",
        inspect.cleandoc(command.help or "").replace("\f", ""),
        f"```text\nspacerobot {words} {usage}\n```",
        table(("option", "meaning"), rows),
    ]
    return "\n\n".join(part for part in parts if part)


def python_api(package: str) -> str:
    """Return the instructions that have mkdocstrings document all public names of a package."""
    module = importlib.import_module(package)
    lines = [inspect.cleandoc(module.__doc__ or "")]
    for name in module.__all__:
        if name.startswith("__"):
            continue
        lines.append(f"::: {package}.{name}")
    return "\n\n".join(lines)
