"""The list of known errors fits the code."""

from __future__ import annotations

import re
from functools import cache

from support.known_errors import ROOT, known_errors


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
            error.put_into(content(error.file), parse="\n" in error.before + error.after)
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
