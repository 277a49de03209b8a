"""Parameters of tests of which a few are quick."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pytest


def some_fast(cases: Iterable[Any], *fast: Any) -> list[Any]:
    """Return parameters of which all but a few are left to the slow tests.

    ``fast`` are cases, or names of a mapping of cases, which become their ids. A tuple is a case of
    several parameters.
    """
    if isinstance(cases, Mapping):
        marks = {name: () if name in fast else (pytest.mark.slow,) for name in cases}
        return [pytest.param(case, id=name, marks=marks[name]) for name, case in cases.items()]
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=() if case in fast else (pytest.mark.slow,),
        )
        for case in cases
    ]
