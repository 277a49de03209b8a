"""Errors that are put into modules which are imported already: what is held of one has them."""

from __future__ import annotations

import gc
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.forked import NotExchangedError, exchange, live_functions

pytestmark = pytest.mark.slow
"""Only `make known-errors` needs it."""

TEXT = """\
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
    path.write_text(TEXT)
    spec = importlib.util.spec_from_file_location("to_be_exchanged", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[module.__name__]


def put_in(module: ModuleType, before: str, after: str) -> None:
    assert TEXT.count(before) == 1
    path = str(module.__file__)
    exchange(TEXT, TEXT.replace(before, after), path, live_functions()[path])


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


def test_functions_that_are_no_garbage_any_more_are_found_too(module: Any) -> None:
    gc.freeze()  # As conftest.py does with all that was collected.
    put_in(module, "x + by < LIMIT", "x + by <= LIMIT")
    assert module.below(3)


def test_a_difference_that_reaches_no_live_function_needs_an_import(module: Any) -> None:
    changed = TEXT.replace("x + by < LIMIT", "x + by <= LIMIT")
    with pytest.raises(NotExchangedError, match="alive"):
        exchange(TEXT, changed, str(module.__file__), {})


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


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("ONE = 1", "ONE = 2"),
        ("@lru_cache\n", ""),
        ("frozen=True", "frozen=False"),
        ("Kind(Enum)", "Kind(int, Enum)"),
        ("LIMIT = 3\n", "LIMIT = object()\n"),
        ("LIMIT = 3\n", "LIMIT = 3\nMORE = 4\n"),
        ("LIMIT = 3\n", "LIMIT: int\n"),
    ],
)
def test_other_differences_need_an_import(module: Any, before: str, after: str) -> None:
    with pytest.raises((NotExchangedError, KeyError)):
        put_in(module, before, after)
