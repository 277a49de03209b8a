"""What mkdocs calls while it builds the site."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError

from docs_build import diagrams, equations, notebook, reference
from docs_build.blocks import Block, replace_blocks

_characters: set[str] = set()
"""Of all equations of the site."""

_IN_CLONE = re.compile(r"^> In the clone: .*\n\n", re.MULTILINE)
"""A link to a file outside of the site, for readers of the repository."""

_PLACEHOLDER = re.compile(r"\{\{ *(?P<kind>\w+)(?: +(?P<argument>[^{}]+?))? *\}\}")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Draw diagrams, take the marks off blocks, put in generated references and numbers."""
    try:
        return prepared(markdown)
    except (ValueError, KeyError) as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from error


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Turn LaTeX into MathML."""
    try:
        content = equations.with_equations(html)
    except ValueError as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from error
    _characters.update(equations.characters(content))
    return content


def on_post_build(config: Any, **_: Any) -> None:
    """Add the font of the equations."""
    equations.write_font(Path(config.site_dir) / "stylesheets" / "math.woff", _characters)


def prepared(markdown: str) -> str:
    """Return the Markdown text of a page as mkdocs is to read it.

    ``{{ value KEY }}``
        A number of ``docs/figures.json``, with the digits that it has there.
    ``{{ parameters NODE }}``, ``{{ topics }}``, ``{{ state_fields }}``, ``{{ cli }}``,
    ``{{ api PACKAGE }}``, ``{{ foreign_robots }}``
        Generated references.
    ``{{ notebook FILE }}``
        A Python file in cells, executed, with what comes of it.

    Raises
    ------
    ValueError, KeyError
        A placeholder, a key of a number, or the mark of a block is unknown.
    """
    page = _IN_CLONE.sub("", markdown)
    return _PLACEHOLDER.sub(_replacement, replace_blocks(page, _drawn))


@cache
def figures() -> dict[str, str]:
    """Return the numbers of the documents by key."""
    return dict(json.loads((reference.DOCS / "figures.json").read_text(encoding="utf-8")))


def _drawn(block: Block) -> str | None:
    return diagrams.diagram(block.text) if block.language == "mermaid" else None


def _replacement(found: re.Match[str]) -> str:
    argument = found["argument"] or ""
    match found["kind"]:
        case "value":
            return figures()[argument]
        case "parameters":
            return reference.parameters(argument)
        case "topics":
            return reference.topics()
        case "state_fields":
            return reference.state_fields()
        case "foreign_robots":
            return reference.foreign_robots()
        case "cli":
            return reference.command_line()
        case "notebook":
            return notebook.executed(reference.DOCS.parent / argument)
        case "api":
            return reference.python_api(argument)
    raise ValueError(f"The placeholder {found[0]} is unknown.")
