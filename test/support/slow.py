"""Parameters of tests of which a few are quick."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pytest


def some_fast(cases: Iterable[Any], *fast: Any, slow: Sequence[Any] | None = None) -> list[Any]:
    """Return parameters of which all but a few are left to the slow tests.

    ``fast`` are cases, or names of a mapping of cases, which become their ids. A tuple is a case of
    several parameters. If ``slow`` lists cases or names, the slow tests take these, and the study
    `more-cases` the rest.
    """

    def marks(case: Any) -> tuple[pytest.MarkDecorator, ...]:
        if case in fast:
            return ()
        return (pytest.mark.slow if slow is None or case in slow else pytest.mark.study,)

    if isinstance(cases, Mapping):
        return [pytest.param(case, id=name, marks=marks(name)) for name, case in cases.items()]
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=marks(case))
        for case in cases
    ]
