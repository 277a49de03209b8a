"""Expands one xacro file, as a program of its own: ``python xacro_files.py FILE SECONDS``.

Robot files come from strangers, and the expressions of xacro are Python, which its own checks do
not confine. So :func:`spacerobot_ros.model.urdf.load_robot` runs this program with limits of time,
memory and files, and every expression is checked as a syntax tree before it is evaluated: numbers,
texts, lists, operators, and calls by plain names; nothing that reaches the interpreter. Only robot
and YAML files of the same package, or of installed packages that the file names, are read.

Nothing of the package is imported here: it starts quickly, and there is nothing to reach.
"""

from __future__ import annotations

import ast
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_MAX_MEMORY = 2**30
"""Limit of the address space, bytes."""

_MAX_OPEN_FILES = 64

_READABLE_SUFFIXES = (".xacro", ".urdf", ".xml", ".yaml", ".yml")
"""Suffixes of the files that xacro may read."""

_MAX_TEXT = 20_000_000
"""Longest expanded text, characters."""

_ALLOWED_SYNTAX = (
    *(ast.Expression, ast.Constant, ast.Name, ast.Attribute, ast.Load, ast.Call, ast.keyword),
    *(ast.List, ast.Tuple, ast.Dict, ast.Subscript, ast.Slice, ast.IfExp),
    *(ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare),
    *(ast.operator, ast.unaryop, ast.boolop, ast.cmpop),
)
"""Allowed syntax: no lambdas, comprehensions, formatted strings, or assignments."""

_REFUSED_NAMES = frozenset({"type", "vars", "format", "format_map", "mro", "getattr", "eval"})
"""Names that lead from values to the interpreter, beside those with a leading underscore."""


def check_expression(expression: str) -> None:
    """Refuse an expression that could call functions or reach the interpreter.

    Raises
    ------
    ValueError
        It has other syntax than :data:`_ALLOWED_SYNTAX`, or a refused name.
    SyntaxError
        It is not an expression of Python.
    """
    for node in ast.walk(ast.parse(expression.strip(), mode="eval")):
        if not isinstance(node, _ALLOWED_SYNTAX):
            raise ValueError(f"the expression '{expression}' has a {type(node).__name__}")
        name = {ast.Name: "id", ast.Attribute: "attr", ast.keyword: "arg"}.get(type(node))
        word = getattr(node, name) or "" if name else ""
        if word.startswith("_") or word in _REFUSED_NAMES:
            raise ValueError(f"the expression '{expression}' has the name '{word}'")


def package_root(file: Path) -> Path:
    """Return the nearest folder above a file that has a package.xml, else the file's own."""
    folder = file.resolve().parent
    packages = (each for each in (folder, *folder.parents) if (each / "package.xml").is_file())
    return next(packages, folder)


def _confine_xacro(xacro: Any, substitution: Any, file: Path) -> None:
    """Have xacro check every expression, and read no files but those of its packages."""
    roots = [package_root(file)]
    find = substitution._eval_find

    def checked(original: Callable[..., Any]) -> Callable[..., Any]:
        def evaluated(expression: str, *scope: Any) -> Any:
            check_expression(expression)
            return original(expression, *scope)

        return evaluated

    def found(package: str) -> str:
        share = str(find(package))
        roots.append(Path(share).resolve())
        return share

    def opened(path: str) -> Any:
        real = Path(path).resolve()
        root = next((each for each in roots if real.is_relative_to(each)), None)
        if root is None:
            raise ValueError(f"it reads {path}, which is outside of its package {roots[0]}")
        hidden = any(part.startswith(".") for part in real.relative_to(root).parts)
        if hidden or real.suffix not in _READABLE_SUFFIXES:
            raise ValueError(f"it reads {path}, which is no robot or YAML file")
        return open(path, encoding="utf-8")

    xacro.safe_eval = checked(xacro.safe_eval)
    substitution._eval = checked(substitution._eval)
    substitution._eval_find = substitution._eval_dict["find"] = found
    xacro.open = opened


def main(file: str, seconds: int) -> int:
    """Print the URDF text of a xacro file; return 1 with a reason on standard error if refused.

    ``seconds`` is the limit of processor time.
    """
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY, _MAX_MEMORY))
    resource.setrlimit(resource.RLIMIT_NOFILE, (_MAX_OPEN_FILES, _MAX_OPEN_FILES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    try:
        import xacro
        from xacro import substitution_args

        _confine_xacro(xacro, substitution_args, Path(file))
        text = str(xacro.process_file(file).toxml())
        if len(text) > _MAX_TEXT:
            raise ValueError(f"its text has {len(text)} characters, and at most {_MAX_TEXT}")
    except Exception as error:  # Of xacro, its expressions, the XML parser
        reason = " ".join(str(error).split()) or type(error).__name__
        print(f"REASON {reason}", file=sys.stderr)
        return 1
    sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.path.pop(0)  # Modules beside this file must not shadow xacro's modules.
    sys.dont_write_bytecode = True
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
