"""The mutants of a file: what Cosmic Ray changes, without what no test could notice."""

from __future__ import annotations

import ast
import random
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.ast.ast_query import ASTQuery
from cosmic_ray.mutating import mutate_code

_ARITHMETIC = (
    ("Add", "Sub"),
    ("Sub", "Add"),
    ("Mul", "Div"),
    ("Div", "Mul"),
    ("FloorDiv", "Div"),
    ("Mod", "Mul"),
    ("Pow", "Mul"),
    ("BitOr", "BitAnd"),
    ("BitAnd", "BitOr"),
)
"""One change an operator: most of Cosmic Ray's others (`+` to `<<`) fail wherever they are run, and
would only make the share that is noticed look better."""

_ORDER = ("Lt", "LtE", "Gt", "GtE")

OPERATORS = (
    *(f"core/ReplaceBinaryOperator_{a}_{b}" for a, b in _ARITHMETIC),
    *(f"core/ReplaceComparisonOperator_{a}_{b}" for a, b in permutations(_ORDER, 2)),
    "core/ReplaceComparisonOperator_Eq_NotEq",
    "core/ReplaceComparisonOperator_NotEq_Eq",
    "core/ReplaceComparisonOperator_Is_IsNot",
    "core/ReplaceComparisonOperator_IsNot_Is",
    "core/ReplaceUnaryOperator_USub_UAdd",
    "core/ReplaceUnaryOperator_Delete_Not",
    "core/AddNot",
    "core/ReplaceTrueWithFalse",
    "core/ReplaceFalseWithTrue",
    "core/ReplaceAndWithOr",
    "core/ReplaceOrWithAnd",
    "core/ReplaceBreakWithContinue",
    "core/ReplaceContinueWithBreak",
    "core/ExceptionReplacer",
    "core/NumberReplacer",
    "core/RemoveDecorator",
    "core/ZeroIterationForLoop",
)

Position = tuple[int, int]


@dataclass(frozen=True)
class Mutant:
    """One error in one file.

    Attributes
    ----------
    path : str
        The file, relative to the project.
    operator, occurrence
        What Cosmic Ray changes: its operator, and which of the places that it suits.
    line : int
        Where, from 1.
    definition : str
        The function or class around it, or "".
    before, after : str
        The changed lines of the file.
    """

    path: str
    operator: str
    occurrence: int
    line: int
    definition: str
    before: str
    after: str

    @property
    def key(self) -> tuple[str, ...]:
        """What tells a mutant from others when lines elsewhere in the file have moved."""
        return (self.path, self.definition, self.operator, self.before, self.after)

    @property
    def folder(self) -> str:
        """The package's folder that it lies in; modules outside of any are together."""
        folder = self.path.split("/")[1]
        return "modules of no folder" if folder.endswith(".py") else folder

    def apply(self, source: str) -> str | None:
        """Return the file with the error in it, or None where that changes nothing."""
        return _mutated(source, self.operator, self.occurrence)


def mutants_of(project: Path, paths: Sequence[str], exclude: Sequence[str]) -> Iterator[Mutant]:
    """List all mutants of the Python files in folders, except those in other folders.

    Parameters
    ----------
    project : Path
        The project's folder.
    paths, exclude : Sequence[str]
        Files or folders of its package.

    Yields
    ------
    Mutant
        In the order of files, operators and lines; not yet with its lines, which `described`
        computes.
    """
    for path in _files(project, paths, exclude):
        source = (project / path).read_text()
        hidden = _unnoticeable(source)
        nodes = list(ast_nodes(get_ast(source)))
        for name in OPERATORS:
            operator = cosmic_ray.plugins.get_operator(name)()
            places = ((node, a, b) for node in nodes for a, b in operator.mutation_positions(node))
            for occurrence, (node, start, _) in enumerate(places):
                if not any(first <= start < last for first, last in hidden):
                    where = ASTQuery(node).get_definition_name() or ""
                    yield Mutant(path, name, occurrence, start[0], where, "", "")


def sample(
    project: Path, mutants: Sequence[Mutant], size: int, seed: int, at_least: int = 0
) -> tuple[list[Mutant], list[Mutant]]:
    """Draw mutants at random, leaving out those that are no Python or no change.

    Returns
    -------
    sample : list[Mutant]
        As many as asked for.
    more : list[Mutant]
        Further ones of the folders of which the sample has fewer than `at_least`.
    """
    order = list(mutants)
    random.Random(seed).shuffle(order)
    drawn: list[Mutant] = []
    more: list[Mutant] = []
    count: Counter[str] = Counter()
    for mutant in order:
        full = len(drawn) == size
        if full and count[mutant.folder] >= at_least:
            continue
        if (whole := described(project, mutant)) is not None:
            (more if full else drawn).append(whole)
            count[mutant.folder] += 1
    return drawn, more


def described(project: Path, mutant: Mutant) -> Mutant | None:
    """Return a mutant with the lines that it changes, or None if there is no such error."""
    source = (project / mutant.path).read_text()
    changed = mutant.apply(source)
    if changed is None:
        return None
    try:
        if ast.dump(ast.parse(changed)) == ast.dump(ast.parse(source)):
            return None
    except SyntaxError:
        return None
    old, new = source.splitlines(), changed.splitlines()
    first = next((i for i, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), 0)
    more = len(old) - len(new)
    last = next(
        (i for i in range(len(old), first, -1) if i - more < 1 or old[i - 1] != new[i - 1 - more]),
        first + 1,
    )
    return Mutant(
        mutant.path,
        mutant.operator,
        mutant.occurrence,
        mutant.line,
        mutant.definition,
        " ".join(" ".join(old[first:last]).split()),
        " ".join(" ".join(new[first : max(first, last - more)]).split()),
    )


def statement_lines(source: str, line: int) -> range:
    """Return the lines of the innermost statement around a line, without its body."""
    found = range(line, line + 1)
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, (ast.stmt, ast.excepthandler, ast.match_case)):
            continue
        body = getattr(node, "body", None)
        start = node.pattern.lineno if isinstance(node, ast.match_case) else node.lineno
        end = body[0].lineno - 1 if body else getattr(node, "end_lineno", None) or start
        for decorator in getattr(node, "decorator_list", []):
            start = min(start, decorator.lineno)
        if start <= line <= max(start, end):
            found = range(start, max(start, end) + 1)
    return found


def using_lines(source: str, line: int) -> set[int]:
    """Return the lines that use what the statement at a line defines.

    Of a constant, an attribute or a class those that mention its name, of a function its body.
    """
    tree, statement = ast.parse(source), statement_lines(source, line)
    names: set[str] = set()
    found: set[int] = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.stmt) or node.lineno not in statement:
            continue
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            found |= set(range(node.body[0].lineno, (node.end_lineno or node.lineno) + 1))
        elif isinstance(node, ast.ClassDef):
            names.add(node.name)
        else:
            stored = (each for each in ast.walk(node) if isinstance(each, ast.Name))
            names |= {each.id for each in stored if isinstance(each.ctx, ast.Store)}
    for node in ast.walk(tree):
        name = getattr(node, "id", None) or getattr(node, "attr", None)
        if isinstance(node, (ast.Name, ast.Attribute)) and name in names:
            found.add(node.lineno)
    return found - set(statement)


def _files(project: Path, paths: Sequence[str], exclude: Sequence[str]) -> list[str]:
    package = project / "spacerobot_ros"
    out = [package / path for path in exclude]
    found: set[Path] = set()
    for path in paths:
        whole = package / path
        found |= {whole} if whole.is_file() else set(whole.rglob("*.py"))
    kept = (f for f in found if not any(f == o or o in f.parents for o in out))
    return sorted(str(f.relative_to(project)) for f in kept)


def _unnoticeable(source: str) -> list[tuple[Position, Position]]:
    """Annotations, which nobody evaluates, and imports for them."""
    spans = []
    for node in ast.walk(ast.parse(source)):
        hidden: list[ast.expr | ast.stmt | None] = []
        match node:
            case ast.arg() | ast.AnnAssign():
                hidden = [node.annotation]
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                hidden = [node.returns]
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                hidden = [node]
        spans += [
            ((h.lineno, h.col_offset), (h.end_lineno or 0, h.end_col_offset or 0))
            for h in hidden
            if h is not None
        ]
    return spans


def _mutated(source: str, operator: str, occurrence: int) -> str | None:
    try:
        changed = mutate_code(source, cosmic_ray.plugins.get_operator(operator)(), occurrence)
    except AttributeError:
        return None  # Its ExceptionReplacer takes no names with dots.
    return None if changed is None else str(changed)
