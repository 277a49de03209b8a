"""How large the package is, here and in other checkouts: ``make structure AGAINST=PATH``.

Counted are lines, lines of code (without comments, docstrings and blank lines), modules (without
the ``__init__`` of folders), modules that exactly one other module imports, and the lines of what
draws a robot.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

PACKAGE = "spacerobot_ros"
ROOT = Path(__file__).resolve().parents[1]

DRAWING = {
    "robot in pictures": ("report/solids.py",),
    "robot in pages": ("report/scene.py", "report/meshcat.py"),
    "robot, shared by both": ("model/visuals.py",),
}
"""The modules that draw a robot; viewers take the shared one, too."""

_NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE),
    *(tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER),
}


def lines_of_code(text: str) -> int:
    """Return how many lines of a module hold code."""
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            code -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(code)


def imported(text: str, modules: set[str]) -> set[str]:
    """Return which of some modules a module imports, anywhere in its text."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (names & modules) or {node.module}
    return found & modules


def structure(checkout: Path) -> dict[str, int]:
    """Return the counts of the package in a checkout, by what was counted."""
    texts = {
        ".".join(path.relative_to(checkout).with_suffix("").parts): path.read_text("utf-8")
        for path in (checkout / PACKAGE).rglob("*.py")
    }
    modules = {name for name in texts if not name.endswith(".__init__")}
    importers = Counter(
        module for name, text in texts.items() for module in imported(text, modules - {name})
    )
    return {
        "lines": sum(len(text.splitlines()) for text in texts.values()),
        "lines of code": sum(map(lines_of_code, texts.values())),
        "modules": len(modules),
        "modules imported once": sum(importers[module] == 1 for module in modules),
        **{what: lines_of(names, checkout) for what, names in DRAWING.items()},
    }


def lines_of(names: Sequence[str], checkout: Path = ROOT) -> int:
    """Return how many lines those of some files of the package that are there have together."""
    files = [checkout / PACKAGE / name for name in names]
    return sum(len(file.read_text("utf-8").splitlines()) for file in files if file.exists())


if __name__ == "__main__":
    found = [structure(folder) for folder in (ROOT, *map(Path, sys.argv[1:]))]
    for what in found[0]:
        print(f"{what:<24}" + "".join(f"{counts[what]:>10}" for counts in found))
