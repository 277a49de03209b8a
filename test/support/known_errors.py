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
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "test" / "known_errors"

_COPIED = ("spacerobot_ros", "test", "config", "urdf", "bags", "docs", "docs_build", "examples")
_AT_ONCE = 2
_TIME_LIMIT = 240.0
"""Wall time for the tests of one error, s."""

_KEEPS_RESULTS = ("spacerobot_ros/model/", "spacerobot_ros/planning/")
"""What is compiled or planned here is kept in a cache: an error in it gets a cache of its own."""


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

    def put_into(self, text: str) -> str:
        """Return the text of the file with the error in it.

        Raises
        ------
        ValueError
            The text before is not there exactly once, or the file is no Python afterwards.
        """
        changed = self.replaced(text)
        if self.file.endswith(".py"):
            try:
                ast.parse(changed)
            except SyntaxError as error:
                raise ValueError(f"{self.line} The file is no Python afterwards: {error}") from None
        return changed

    def replaced(self, text: str) -> str:
        """Return the text of the file with the error in it, not parsed: that takes most of a test.

        Raises
        ------
        ValueError
            The text before is not there exactly once.
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
    keys = {"file", "before", "after", "error", "noticed_by"}
    if set(entry) != keys:
        raise ValueError(f"{source}: {entry} has not the keys {', '.join(sorted(keys))}.")
    named = entry["noticed_by"]
    return KnownError(
        source,
        entry["file"],
        entry["before"].rstrip("\n"),
        entry["after"].rstrip("\n"),
        entry["error"],
        (named,) if isinstance(named, str) else tuple(named),
    )


# -- trying them ------------------------------------------------------------------------------


class Outcome(Enum):
    """What the tests make of an error."""

    NOTICED = "noticed"
    NOT_NOTICED = "NOT NOTICED"
    NOT_RUN = "NOT RUN"


class Workplace:
    """A copy of the project, in which one error is tried at a time."""

    def __init__(self, folder: Path, shared_cache: Path, project: Path = ROOT) -> None:
        self._folder, self._cache = folder, shared_cache
        ignored = shutil.ignore_patterns("__pycache__", ".*")
        folder.mkdir(parents=True)
        for path in project.iterdir():
            if path.is_file():
                shutil.copy(path, folder)
            elif path.name in _COPIED:
                shutil.copytree(path, folder / path.name, ignore=ignored)

    def pytest(self, words: Iterable[str], cache: Path | None = None) -> tuple[int | None, str]:
        """Run tests in the copy; return pytest's exit code, None out of time, and its output."""
        environment = os.environ | {
            "PYTHONPATH": str(self._folder),
            # A compiled module is taken for up to date by the second in which its source changed.
            "PYTHONDONTWRITEBYTECODE": "1",
            "SPACEROBOT_CACHE_DIR": str(cache or self._cache),
        }
        options = ("-q", "-x", "-p", "no:cacheprovider", "--tb=line")
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, *words],
            cwd=self._folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=_TIME_LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            return None, output
        return process.returncode, output

    def try_error(self, error: KnownError) -> tuple[Outcome, str]:
        """Return what its tests make of an error, and their output where they did not run."""
        path = self._folder / error.file
        text = path.read_text("utf-8")
        own = self._folder / "own_cache" if error.file.startswith(_KEEPS_RESULTS) else None
        path.write_text(error.put_into(text), "utf-8")
        try:
            code, output = self.pytest(error.noticed_by, own)
        finally:
            path.write_text(text, "utf-8")
            shutil.rmtree(self._folder / "own_cache", ignore_errors=True)
        match code:
            case 0:
                return Outcome.NOT_NOTICED, ""
            case 1:
                return Outcome.NOTICED, ""
            case None:
                return Outcome.NOT_RUN, f"They took longer than {_TIME_LIMIT:g} s."
        return Outcome.NOT_RUN, output


@contextmanager
def _workplaces() -> Iterator[list[Workplace]]:
    with tempfile.TemporaryDirectory(prefix="spacerobot_ros_known_errors_") as folder:
        root = Path(folder)
        yield [Workplace(root / str(i), root / "cache") for i in range(_AT_ONCE)]


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
    with _workplaces() as workplaces:
        tests = sorted({test for error in errors for test in error.noticed_by})
        code, output = workplaces[0].pytest(["-n", str(_AT_ONCE), *tests])
        if code != 0:
            print(f"Without any error in the package its tests do not pass:\n{output}")
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

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            outcomes = list(pool.map(attempt, errors))
    noticed = outcomes.count(Outcome.NOTICED)
    print(f"{noticed} of {len(errors)} known errors were noticed.")
    return 0 if noticed == len(errors) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
