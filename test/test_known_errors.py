"""The list of known errors fits the code; what tries them is itself tried on a small project."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.forked import exchange, live_functions
from support.known_errors import ROOT, KnownError, known_errors


@cache
def content(file: str) -> str:
    return (ROOT / file).read_text("utf-8")


def test_every_known_error_can_be_put_in_and_names_tests_that_exist() -> None:
    errors = known_errors()
    assert errors
    problems = []
    for error in errors:
        try:
            # To parse every file takes most of a test; a part of a line changes no indent.
            several = "\n" in error.before + error.after
            (error.put_into if several else error.replaced)(content(error.file))
        except ValueError as problem:
            problems.append(f"{error.source}: {problem}")
        if not error.noticed_by:
            problems.append(f"{error.source}: {error.line} No test notices it.")
        for test in error.noticed_by:
            file, *names = re.sub(r"\[.*", "", test).split("::")
            if not (ROOT / file).is_file():
                problems.append(f"{error.source}: there is no {file}.")
            elif not all(re.search(rf"(def|class) {name}\b", content(file)) for name in names):
                problems.append(f"{error.source}: {file} has no {'::'.join(names)}.")
    assert not problems, "\n".join(problems)


def test_no_error_is_listed_twice() -> None:
    seen = [(error.file, error.before, error.after) for error in known_errors()]
    assert len(seen) == len(set(seen))


TEXT = """\
def f(x):
    if x > 0:
        return 1

    return x > 2
"""


def error(before: str, after: str) -> KnownError:
    return KnownError("x.yaml", "x.py", before, after, "an error", ("test_x.py",))


def test_a_text_within_a_line_is_replaced() -> None:
    assert error("x > 0", "x >= 0").put_into(TEXT) == TEXT.replace("x > 0", "x >= 0")


def test_lines_are_found_at_their_indent() -> None:
    changed = error("if x > 0:\n    return 1\n\nreturn x > 2", "return 1\nreturn x").put_into(TEXT)
    assert changed == "def f(x):\n    return 1\n    return x\n"


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ("x > 1", "x", "occurs 0 times"),
        ("x > ", "x < ", "occurs 2 times"),
        ("x > 0", "x > 0", "changes nothing"),
        ("x > 0", "x > (", "is no Python"),
        ("if x > 0:\nreturn 1", "pass", "occurs 0 times"),
    ],
)
def test_what_does_not_fit_is_refused(before: str, after: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        error(before, after).put_into(TEXT)


def test_an_entry_without_a_key_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("- {file: x.py, before: a, after: b}\n", "utf-8")
    with pytest.raises(ValueError, match="has not the keys"):
        known_errors(tmp_path)
    (tmp_path / "x.yaml").write_text("- {file: x.py, before: a, before: b}\n", "utf-8")
    with pytest.raises(ValueError, match="a key twice"):
        known_errors(tmp_path)


# -- errors that are put into modules which are imported already -------------------------------

MODULE = """\
from dataclasses import dataclass, field
from enum import Enum
from functools import lru_cache

LIMIT = 3

def below(x, by=0):
    return x + by < LIMIT

@lru_cache
def twice(x):
    return 2 * x

def adder(n):
    def add(x):
        return x + n
    return add

class Kind(Enum):
    ONE = 1

@dataclass(frozen=True)
class Value:
    width: float = 1.5
    names: list = field(default_factory=list)
    SCALE = 4

    @property
    def area(self):
        return self.width * self.SCALE

    def near(self, other, by=0.5):
        return abs(other - self.width) < by
"""


@pytest.fixture
def module(tmp_path: Path) -> Iterator[Any]:
    path = tmp_path / "to_be_exchanged.py"
    path.write_text(MODULE)
    spec = importlib.util.spec_from_file_location("to_be_exchanged", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[module.__name__]


def put_in(module: ModuleType, before: str, after: str) -> None:
    assert MODULE.count(before) == 1
    path = str(module.__file__)
    exchange(MODULE, MODULE.replace(before, after), path, live_functions()[path])


@pytest.mark.slow
def test_bodies_of_functions_are_exchanged_for_who_holds_them_already(module: Any) -> None:
    below, add, value, near = module.below, module.adder(3), module.Value(), module.Value.near
    put_in(module, "x + by < LIMIT", "x + by <= LIMIT")
    assert below(3)
    put_in(module, "return x + n", "return x - n")
    assert add(1) == -2
    put_in(module, "self.width * self.SCALE", "self.width + self.SCALE")
    assert value.area == 5.5
    put_in(module, "abs(other - self.width)", "abs(other + self.width)")
    assert near(value, -1.5)
    put_in(module, "return 2 * x", "return 3 * x")
    assert module.twice(2) == 6


@pytest.mark.slow
def test_defaults_and_constants_are_exchanged(module: Any) -> None:
    below, kind = module.below, module.Value
    other = ModuleType("which_imports_from_it")
    other.LIMIT = module.LIMIT = 300  # type: ignore[attr-defined]
    sys.modules[other.__name__] = other
    try:
        put_in(module, "LIMIT = 3\n", "LIMIT = 400\n")
        assert other.LIMIT == module.LIMIT == 400
    finally:
        del sys.modules[other.__name__]
    put_in(module, "by=0)", "by=1000)")
    assert not below(1)
    put_in(module, "width: float = 1.5", "width: float = 2.5")
    assert kind().width == 2.5
    assert kind.__dataclass_fields__["width"].default == 2.5
    put_in(module, "SCALE = 4", "SCALE = 5")
    assert kind().area == 12.5
    put_in(module, "by=0.5)", "by=1.5)")
    assert kind().near(3.5)
