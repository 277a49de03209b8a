"""Size and wording of the package, here and in other checkouts: ``make structure AGAINST=PATH``.

Counted are lines, lines of code (without comments, docstrings and blank lines), Python files,
modules (files without the ``__init__`` of folders), modules that exactly one other module imports,
the lines of the modules that draw a robot, docstrings that begin with "What", and clauses such as
"what is", for which a noun is plainer.

``--sample SEED`` prints names and texts drawn at random, for a reader who judges whether they can
be understood without looking anything up.
"""

from __future__ import annotations

import argparse
import ast
import io
import random
import re
import tokenize
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

PACKAGE = "spacerobot_ros"
ROOT = Path(__file__).resolve().parents[1]

DRAWING = {
    "robot in pages": ("report/player.py",),
    "robot in pictures, and shared": ("report/scene.py", "model/meshes.py"),
}
"""The modules that draw a robot; viewers use the shared one, too."""

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
        "files": len(texts),
        "modules": len(modules),
        "modules imported once": sum(importers[module] == 1 for module in modules),
        **{part: lines_of(names, checkout) for part, names in DRAWING.items()},
    }


def lines_of(names: Sequence[str], checkout: Path = ROOT) -> int:
    """Return the number of lines of some files of the package, without those that do not exist."""
    files = [checkout / PACKAGE / name for name in names]
    return sum(len(file.read_text("utf-8").splitlines()) for file in files if file.exists())


# -- words ------------------------------------------------------------------------------------

_CLAUSE = re.compile(r"\bwhat (is|was|were|are|has|have|had|a|an|the|it|they)\b", re.IGNORECASE)
_WHAT = re.compile(r"\s*What\b")
DOCUMENTS = ("README.md", "CONTRIBUTING.md", "docs/**/*.md")


def words(checkout: Path) -> dict[str, int]:
    """Return how often texts of a checkout have "what" in place of a noun."""
    sources = [path.read_text("utf-8") for path in (checkout / PACKAGE).rglob("*.py")]
    pages = [path.read_text("utf-8") for pattern in DOCUMENTS for path in checkout.glob(pattern)]
    return {
        '"What ..." docstrings': sum(
            bool(_WHAT.match(text)) for source in sources for text in docstrings(source)
        ),
        '"what is ..." in code': sum(len(_CLAUSE.findall(source)) for source in sources),
        '"what is ..." in pages': sum(len(_CLAUSE.findall(page)) for page in pages),
    }


def docstrings(source: str) -> Iterator[str]:
    """Yield the docstrings of a module: its own, those of classes, functions and attributes."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            text = node.value.value
            if isinstance(text, str):
                yield text


def sample(checkout: Path, seed: int, names: int = 60, texts: int = 40) -> str:
    """Return names (with signature or value) and sentences drawn at random, one a line.

    Names are of classes, functions, methods, attributes and constants, private ones too; sentences
    are first sentences of docstrings, comments, and texts of f-strings and messages for users.
    """
    found_names: list[str] = []
    found_texts: list[str] = []
    for path in sorted((checkout / PACKAGE).rglob("*.py")):
        source = path.read_text("utf-8")
        where = str(path.relative_to(checkout / PACKAGE))
        found_names += [f"{where}: {name}" for name in _names(ast.parse(source))]
        found_texts += [f"{where}: {text}" for text in _texts(source)]
    pages = [path for pattern in DOCUMENTS for path in sorted(checkout.glob(pattern))]
    for path in pages:
        prose = re.sub(r"^ *```.*?^ *```", "", path.read_text("utf-8"), flags=re.M | re.S)
        lines = [line.strip() for line in prose.splitlines()]
        found_texts += [
            f"{path.name}: {line}"
            for line in lines
            if len(line.split()) > 5 and line[0] not in "|#<"
        ]
    draw = random.Random(seed)
    return "\n".join(
        (
            f"names, seed {seed}",
            *(f"  {name}" for name in draw.sample(found_names, names)),
            f"texts, seed {seed}",
            *(f"  {text}" for text in draw.sample(found_texts, texts)),
        )
    )


def _names(tree: ast.Module) -> Iterator[str]:
    """Yield every name that a module defines, functions with their signatures."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            returns = "" if node.returns is None else f" -> {ast.unparse(node.returns)}"
            if not node.name.startswith("__"):
                yield f"def {node.name}({ast.unparse(node.args)}){returns}"
        elif isinstance(node, ast.ClassDef):
            bases = ", ".join(map(ast.unparse, node.bases))
            yield f"class {node.name}" + (f"({bases})" if bases else "")
            for line in node.body:
                if isinstance(line, ast.AnnAssign):
                    yield f"{node.name}.{ast.unparse(line.target)}: {ast.unparse(line.annotation)}"
    for line in tree.body:
        if isinstance(line, ast.Assign | ast.AnnAssign):
            yield ast.unparse(line).splitlines()[0][:100]


def _texts(source: str) -> Iterator[str]:
    """Yield first sentences of docstrings, comments, and messages of five words or more."""
    strings, parts = set(), set()
    for node in ast.walk(ast.parse(source)):  # An f-string comes before its parts.
        if isinstance(node, ast.JoinedStr):
            strings.add(ast.unparse(node))
            parts |= set(node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in parts:
            strings.add(" ".join(re.split(r"(?<=[.:])\s", node.value.strip())[0].split()))
    yield from sorted(text for text in strings if len(text.split()) > 4)
    comments = [
        token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    ]
    yield from (comment for comment in comments if len(comment.split()) > 4 and comment[0] != "-")


def main() -> None:
    """Print the counts of this checkout and of others side by side, or a sample of its words."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkouts", nargs="*", type=Path, help="other checkouts to compare with")
    parser.add_argument("--sample", type=int, metavar="SEED", help="print names and texts instead")
    given = parser.parse_args()
    if given.sample is not None:
        print(sample(ROOT, given.sample))
        return
    folders = [ROOT, *given.checkouts]
    counts = [structure(folder) | words(folder) for folder in folders]
    for counted in counts[0]:
        print(f"{counted:<24}" + "".join(f"{each[counted]:>10}" for each in counts))


if __name__ == "__main__":
    main()
