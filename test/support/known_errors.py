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
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import yaml
from support.fork_server import ForkServer, How, environment_of, write_source
from support.forked import NotExchangedError

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "test" / "known_errors"

_COPIED = (
    *("spacerobot_ros", "test", "config", "urdf", "meshes", "bags", "docs", "docs_build"),
    "examples",
)
_AT_ONCE = 2
_TIME_LIMIT = 240.0
"""Wall time for the tests of one error, s."""

_LIMITS = (60.0, _TIME_LIMIT)
"""CPU and wall time of a test in a fork, s."""

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
    """A copy of the project, in which one error is tried at a time.

    Most errors are tried in a fork of a process that has collected the tests already, where the
    functions that differ are exchanged. An error in what is executed while its file is imported,
    and one that is not noticed so, is tried by a pytest of its own.

    Parameters
    ----------
    folder
        That of the copy, which is made.
    shared_cache
        What is compiled is kept there.
    project
        Where the original is.
    files
        Files with tests that the process with the forks collects; none: there is no such process.
    """

    def __init__(
        self,
        folder: Path,
        shared_cache: Path,
        project: Path = ROOT,
        files: Iterable[str] = (),
    ) -> None:
        self._folder, self._cache = folder, shared_cache
        self._own_cache = folder / "own_cache"
        ignored = shutil.ignore_patterns("__pycache__", ".*")
        folder.mkdir(parents=True)
        shared_cache.mkdir(exist_ok=True, mode=0o700)
        for path in project.iterdir():
            if path.is_file():
                shutil.copy(path, folder)
            elif path.name in _COPIED:
                shutil.copytree(path, folder / path.name, ignore=ignored)
        named = tuple(files)
        self._server = self._serve(named) if named else None

    def _serve(self, files: Sequence[str]) -> ForkServer:
        server = ForkServer(self._folder / "forks", self._folder, self._environment(), files)
        if not server.ready:
            output = (self._folder / "forks" / "output").read_text("utf-8")
            raise RuntimeError(f"The tests cannot be collected:\n{output}")
        return server

    def close(self) -> None:
        """End the process with the forks."""
        if self._server is not None:
            self._server.close()

    def failing(self, tests: Iterable[str]) -> str:
        """Return the first test that fails in a fork though there is no error; "": none does."""
        assert self._server is not None
        return self._server.run(dict.fromkeys(tests, _LIMITS))[0]

    def try_error(self, error: KnownError) -> tuple[Outcome, str]:
        """Return what its tests make of an error, and their output where they did not run."""
        path = self._folder / error.file
        text = path.read_text("utf-8")
        try:
            changed = error.put_into(text)
        except ValueError as problem:
            return Outcome.NOT_RUN, str(problem)
        own = error.file.startswith(_KEEPS_RESULTS)
        write_source(path, changed)
        try:
            if own:
                # Plans of the code as it is, under the names of those that it would make now.
                shutil.copytree(
                    self._cache, self._own_cache, ignore=shutil.ignore_patterns("plans")
                )
            if self._noticed_in_a_fork(error, path, text):
                return Outcome.NOTICED, ""
            code, output = self._pytest(error.noticed_by)
        finally:
            write_source(path, text)
            shutil.rmtree(self._own_cache, ignore_errors=True)
        match code:
            case 0:
                return Outcome.NOT_NOTICED, ""
            case 1:
                return Outcome.NOTICED, ""
            case None:
                return Outcome.NOT_RUN, f"They took longer than {_TIME_LIMIT:g} s."
        return Outcome.NOT_RUN, output

    def _noticed_in_a_fork(self, error: KnownError, path: Path, text: str) -> bool:
        if self._server is None:
            return False
        exchange = (str(path), text) if path.suffix == ".py" else None
        limits = dict.fromkeys(error.noticed_by, _LIMITS)
        cache = {"SPACEROBOT_CACHE_DIR": str(self._cache_in_use)}
        try:
            return self._server.run(limits, exchange, **cache)[1] is How.FAILED
        except NotExchangedError:
            return False

    def _pytest(self, words: Iterable[str]) -> tuple[int | None, str]:
        """Run tests in the copy; return pytest's exit code, None out of time, and its output."""
        # Some of the tests that are named have become slow.
        options = ("-q", "-x", "-p", "no:cacheprovider", "--tb=line", "-m", "slow or not slow")
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, *words],
            cwd=self._folder,
            env=self._environment(),
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

    @property
    def _cache_in_use(self) -> Path:
        return self._own_cache if self._own_cache.exists() else self._cache

    def _environment(self) -> dict[str, str]:
        # A compiled module is taken for up to date by the second in which its source changed.
        return environment_of(self._folder, self._cache_in_use) | {"PYTHONDONTWRITEBYTECODE": "1"}


@contextmanager
def _workplaces(files: Sequence[str]) -> Iterator[list[Workplace]]:
    with tempfile.TemporaryDirectory(prefix="spacerobot_ros_known_errors_") as folder:
        root, places = Path(folder), list[Workplace]()
        try:
            for i in range(_AT_ONCE):
                places.append(Workplace(root / str(i), root / f"cache{i}", files=files))
            yield places
        finally:
            for place in places:
                place.close()


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
    files = sorted({test.split("::")[0] for test in tests})
    with _workplaces(files) as workplaces, ThreadPoolExecutor(_AT_ONCE) as pool:
        shares = [tests[i::_AT_ONCE] for i in range(_AT_ONCE)]
        for failing in pool.map(Workplace.failing, workplaces, shares):
            if failing:
                print(f"Without any error in the package this test does not pass: {failing}")
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
