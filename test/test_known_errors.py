"""The list of known errors fits the code."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
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
