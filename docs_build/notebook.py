"""Notebooks of the documentation: Python files in cells, executed while the site is built.

A cell begins with ``# %%``, a text with ``# %% [markdown]``, as editors have it. Each cell is shown
with what it prints, and what its last expression is: as HTML, as a picture, or as text.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import re
from functools import cache
from pathlib import Path
from typing import Any

_CELL = re.compile(r"^# %%(?P<kind>[^\n]*)\n", re.MULTILINE)


@cache
def executed(path: Path) -> str:
    """Return a notebook as Markdown, with what came of its cells."""
    text = path.read_text(encoding="utf-8")
    starts = list(_CELL.finditer(text))
    ends = [each.start() for each in starts[1:]] + [len(text)]
    names: dict[str, Any] = {"__name__": "__main__"}
    parts = []
    for start, end in zip(starts, ends, strict=True):
        source = text[start.end() : end].strip()
        if "[markdown]" in start["kind"]:
            parts.append(re.sub(r"^# ?", "", source, flags=re.MULTILINE))
            continue
        shown = re.sub(r"  # noqa[^\n]*", "", source)
        parts += [f"```python\n{shown}\n```", *_outputs(source, names)]
    return "\n\n".join(parts)


def _outputs(source: str, names: dict[str, Any]) -> list[str]:
    """Execute a cell; return what it prints, and its last expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "<cell>", "exec"), names)
        value = None
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
    found = [f"```text\n{printed.getvalue().rstrip()}\n```"] if printed.getvalue() else []
    return found if value is None else [*found, _shown(value)]


def _shown(value: Any) -> str:
    for name in ("_repr_html_", "_repr_png_"):
        made = getattr(value, name, lambda: None)()
        if isinstance(made, bytes):
            data = base64.b64encode(made).decode()
            return f'<img alt="Output of the cell" src="data:image/png;base64,{data}">'
        if made:
            # A line that is empty would end the HTML for Markdown.
            return "<div>" + re.sub(r"\n\s*\n", "\n", made) + "</div>"
    return f"```text\n{value!r}\n```"
