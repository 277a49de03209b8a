"""Errors that the tests are known to notice: each put into a copy of the package, and tried.

The list is ``test/known_errors/``, a file for each folder of the package; its README says how an
entry looks. ``make known-errors`` runs this module.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "test" / "known_errors"

_COPIED = (
    *("spacerobot_ros", "test", "config", "urdf", "meshes", "bags", "docs", "docs_build"),
    "examples",
)
_AT_ONCE = 2
_TIME_LIMIT = 240.0
"""Wall time for the tests of one error, s."""

_KEEPS_RESULTS = ("spacerobot_ros/model/", "spacerobot_ros/planning/")
"""What is planned here is kept in a cache: an error in it gets a cache of its own, without plans.

What is compiled is kept under a hash of its source, in which an error shows.
"""


@dataclass(frozen=True)
class KnownError:
    """One entry of the list: a text of a file, what takes its place, and the tests that fail."""

    source: str
    file: str
    before: str
    after: str
    error: str
    noticed_by: tuple[str, ...]

    @property
    def line(self) -> str:
        """Return the entry for a message."""
        return f"{self.file}: {self.error}"

    def put_into(self, text: str, *, parse: bool = True) -> str:
        """Return the text of the file with the error in it.

        Raises
        ------
        ValueError
            The text before is not there exactly once, or the file is no Python afterwards (unless
            it is not to be parsed: that takes most of a test).
        """
        pattern = _pattern(self.before)
        found = [match.start() for match in pattern.finditer(text)]
        if len(found) != 1:
            raise ValueError(f"{self.line} The text before occurs {len(found)} times.")

        def replacement(match: re.Match[str]) -> str:
            indent = match["indent"] if "indent" in pattern.groupindex else ""
            return indent + self.after.replace("\n", f"\n{indent}")

        changed = pattern.sub(replacement, text)
        if changed == text:
            raise ValueError(f"{self.line} It changes nothing.")
        if parse and self.file.endswith(".py"):
            try:
                ast.parse(changed)
            except SyntaxError as error:
                raise ValueError(f"{self.line} The file is no Python afterwards: {error}") from None
        return changed


def _pattern(before: str) -> re.Pattern[str]:
    """Return what finds a text: within a line as it is; several lines at whatever indent."""
    first, *others = before.split("\n")
    if not others:
        return re.compile(re.escape(first))
    lines = [rf"\n(?P=indent){re.escape(line)}" if line else r"\n" for line in others]
    return re.compile(rf"^(?P<indent>[ ]*){re.escape(first)}" + "".join(lines) + "$", re.MULTILINE)


class _Loader(yaml.SafeLoader):
    """Refuses a key that is there twice, as a merge may leave it."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        if len(set(keys)) < len(keys):
            raise ValueError(f"There is a key twice{node.start_mark}.")
        return super().construct_mapping(node, deep)


def known_errors(folder: Path = FOLDER) -> list[KnownError]:
    """Read the list.

    Raises
    ------
    ValueError
        An entry lacks a key, has one too many, or one twice.
    """
    return [
        _entry(path.name, entry)
        for path in sorted(folder.glob("*.yaml"))
        for entry in yaml.load(path.read_text("utf-8"), _Loader) or ()
    ]


def _entry(source: str, entry: dict[str, Any]) -> KnownError:
    keys = {each.name for each in fields(KnownError)} - {"source"}
    if set(entry) != keys:
        raise ValueError(f"{source}: {entry} has not the keys {', '.join(sorted(keys))}.")
    named = entry["noticed_by"]
    tests = (named,) if isinstance(named, str) else tuple(named)
    texts = {key: entry[key].rstrip("\n") for key in ("before", "after")}
    return KnownError(source, **{**entry, **texts, "noticed_by": tests})


# -- trying them ------------------------------------------------------------------------------


class Outcome(Enum):
    """What the tests make of an error."""

    NOTICED = "noticed"
    NOT_NOTICED = "NOT NOTICED"
    NOT_RUN = "NOT RUN"


class Workplace:
    """A copy of the project, in which one error is tried at a time.

    Parameters
    ----------
    folder
        That of the copy, which is made.
    shared_cache
        What is compiled is kept there.
    """

    def __init__(self, folder: Path, shared_cache: Path) -> None:
        self._folder, self._cache = folder, shared_cache
        self._own_cache = folder / "own_cache"
        self._changes = 0
        ignored = shutil.ignore_patterns("__pycache__", ".*")
        folder.mkdir(parents=True)
        shared_cache.mkdir(exist_ok=True, mode=0o700)
        for path in ROOT.iterdir():
            if path.is_file():
                shutil.copy(path, folder)
            elif path.name in _COPIED:
                shutil.copytree(path, folder / path.name, ignore=ignored)

    def try_error(self, error: KnownError) -> tuple[Outcome, str]:
        """Return what its tests make of an error, and their output where they did not run."""
        path = self._folder / error.file
        text = path.read_text("utf-8")
        try:
            changed = error.put_into(text)
        except ValueError as problem:
            return Outcome.NOT_RUN, str(problem)
        self._write(path, changed)
        try:
            if error.file.startswith(_KEEPS_RESULTS):
                # Plans of the code as it is, under the names of those that it would make now.
                without_plans = shutil.ignore_patterns("plans")
                shutil.copytree(self._cache, self._own_cache, ignore=without_plans)
            code, output = self.test(error.noticed_by)
        finally:
            self._write(path, text)
            shutil.rmtree(self._own_cache, ignore_errors=True)
        known = {0: Outcome.NOT_NOTICED, 1: Outcome.NOTICED}
        return (known[code], "") if code in known else (Outcome.NOT_RUN, output)

    def _write(self, path: Path, text: str) -> None:
        path.write_text(text, "utf-8")
        # A compiled module is taken for up to date by the second in which its source changed.
        self._changes += 1
        os.utime(path, (self._changes, self._changes))

    def test(
        self, tests: Iterable[str], time_limit: float | None = _TIME_LIMIT
    ) -> tuple[int | None, str]:
        """Run tests in the copy; return pytest's exit code, None out of time, and its output."""
        # Some of the tests that are named have become slow.
        options = ("-q", "-x", "-p", "no:cacheprovider", "--tb=line", "-m", "slow or not slow")
        paths = os.pathsep.join((str(self._folder), str(self._folder / "test")))
        cache = self._own_cache if self._own_cache.exists() else self._cache
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=self._folder,
            env=os.environ | {"PYTHONPATH": paths, "SPACEROBOT_CACHE_DIR": str(cache)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=time_limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            return None, f"{output}\nThe tests took longer than {_TIME_LIMIT:g} s."
        return process.returncode, output


def main(words: list[str]) -> int:
    """Try the errors, or those whose file or sentence contains a text; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("only", nargs="*", help="errors whose line contains one of these")
    only = parser.parse_args(words).only
    errors = [
        error
        for error in known_errors()
        if not only or any(text in f"{error.source} {error.line}" for text in only)
    ]
    if not errors:
        print("No known error is called so.")
        return 2
    tests = sorted({test for error in errors for test in error.noticed_by})
    with (
        tempfile.TemporaryDirectory(prefix="spacerobot_ros_known_errors_") as folder,
        ThreadPoolExecutor(_AT_ONCE) as pool,
    ):
        root = Path(folder)
        workplaces = [Workplace(root / str(i), root / f"cache{i}") for i in range(_AT_ONCE)]
        shares = [share for i in range(_AT_ONCE) if (share := tests[i::_AT_ONCE])]
        for code, output in pool.map(Workplace.test, workplaces, shares, [None] * len(shares)):
            if code != 0:
                print(f"Without any error in the package the tests do not pass:\n{output}")
                return 1
        free: SimpleQueue[Workplace] = SimpleQueue()
        for workplace in workplaces:
            free.put(workplace)

        def attempt(error: KnownError) -> Outcome:
            workplace = free.get()
            try:
                outcome, output = workplace.try_error(error)
            finally:
                free.put(workplace)
            print(f"{outcome.value:<12} {error.line}", flush=True)
            if output:
                print(output, flush=True)
            return outcome

        outcomes = list(pool.map(attempt, errors))
    noticed = outcomes.count(Outcome.NOTICED)
    print(f"{noticed} of {len(errors)} known errors were noticed.")
    return 0 if noticed == len(errors) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
