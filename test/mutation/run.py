"""Put errors into the package, one at a time, and see whether the quick tests notice.

`make mutants` runs it. Cosmic Ray makes the errors; for each, only the tests that reach the changed
line are run, fastest first, until one fails. All happens in copies of the project.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from difflib import SequenceMatcher
from pathlib import Path
from typing import ClassVar

from coverage import CoverageData
from mutation.mutants import Mutant, described, mutants_of, sample, statement_lines

PROJECT = Path(__file__).parents[2]

MUTATED = ("control", "simulation", "planning", "verification", "bag")
NOT_MUTATED = ("planning/methods/optimal",)
"""Folders of the package."""

_LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "out", "build", "__pycache__", ".hypothesis", ".*_cache", "*.egg-info"
)

_FIRST = 12
"""So many tests are tried before the rest is imported: they notice most of what is noticed."""

_REPEATED = ("test/nodes/", "test/session/", "test/cli/", "test/benchmarks/", "test/examples/")
"""Tests whose failure is tried again: on a loaded machine one may fail by itself."""


_ANYWHERE = (
    "test/packaging/test_layers.py",
    "test/test_expected.py",
    "test/docs/test_reference.py",
)
"""Tests of the text of the package and of what it declares: they reach no line."""


@dataclass(frozen=True)
class Verdict:
    """What became of one mutant.

    Attributes
    ----------
    noticed : bool
        Whether a test failed, or hung.
    by : str
        That test, or why there is none.
    run, reaching : int
        Tests that were run; tests that reach the change.
    seconds : float
        Time that this took.
    """

    mutant: Mutant
    noticed: bool
    by: str
    run: int
    reaching: int
    seconds: float


@dataclass
class Reach:
    """Which tests reach which lines, and how long each takes.

    Attributes
    ----------
    seconds : dict[str, float]
        By node id, of tests that pass.
    lines : dict[str, dict[int, list[str]]]
        Node ids by file and line; "" for what is run when the file is imported.
    """

    seconds: dict[str, float]
    lines: dict[str, dict[int, list[str]]] = field(default_factory=lambda: defaultdict(dict))

    @classmethod
    def read(cls, folder: Path) -> Reach:
        """Read what the workers of `measure` have written."""
        measured: dict[str, tuple[float, bool]] = {}
        for file in folder.glob("tests-*.json"):
            measured |= json.loads(file.read_text())
        found = cls({name: seconds for name, (seconds, passed) in measured.items() if passed})
        for file in folder.glob("lines-*"):
            data = CoverageData(str(file))
            data.read()
            for path in data.measured_files():
                here = found.lines["spacerobot_ros/" + path.rpartition("/spacerobot_ros/")[2]]
                for line, names in data.contexts_by_lineno(path).items():
                    here[line] = [*here.get(line, []), *names]
        return found

    def moved_to(self, old: Path, new: Path) -> Reach:
        """Return the same for a project whose code has changed a little since it was measured."""
        moved = Reach(dict(self.seconds))
        for file, lines in self.lines.items():
            before, after = _text(old / file), _text(new / file)
            matcher = SequenceMatcher(None, before.splitlines(), after.splitlines(), False)
            for tag, a, b, c, d in matcher.get_opcodes():
                around = [name for k in range(a, b + 2) for name in lines.get(k, ())]
                for k in range(c, d):
                    there = lines.get(a + k - c + 1, []) if tag == "equal" else around
                    moved.lines[file][k + 1] = there
        return moved

    def with_changed(self, changed: Reach, files: Sequence[str]) -> Reach:
        """Return the same, where what the tests of some files reach was measured again."""

        def kept(name: str) -> bool:
            return name.split("::")[0] not in files

        both = Reach({n: s for n, s in self.seconds.items() if kept(n)} | changed.seconds)
        for file in self.lines.keys() | changed.lines.keys():
            here, more = self.lines.get(file, {}), changed.lines.get(file, {})
            for line in here.keys() | more.keys():
                names = [name for name in here.get(line, ()) if kept(name)]
                both.lines[file][line] = [*names, *more.get(line, ())]
        return both

    def tests_for(self, mutant: Mutant, source: str, limit: float) -> list[str]:
        """Return the tests that reach a change, fastest first, as many as fit into a time (s)."""
        lines = self.lines.get(mutant.path, {})
        reaching = set(lines.get(mutant.line, ()))
        if not reaching - {""}:
            for line in statement_lines(source, mutant.line):
                reaching |= set(lines.get(line, ()))
        if "" in reaching or not reaching:
            # Constants and defaults: whoever uses anything of the file may see them.
            reaching |= {name for names in lines.values() for name in names}
            folder = "test/" + mutant.path.split("/")[1] + "/"
            reaching |= {name for name in self.seconds if name.startswith((folder, *_ANYWHERE))}
        known = sorted((n for n in reaching if n in self.seconds), key=self.seconds.__getitem__)
        chosen, total = [], 0.0
        for name in known:
            total += self.seconds[name]
            if total > limit:
                break
            chosen.append(name)
        return chosen


def measure(project: Path, folder: Path, cache: Path, tests: Sequence[str], workers: int) -> None:
    """Run the quick tests once, recording which line each reaches."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    environment = _environment(project, cache) | {
        "SPACEROBOT_REACH": str(folder),
        "SPACEROBOT_REACH_SOURCE": str(project / "spacerobot_ros"),
    }
    subprocess.run(
        [*_PYTEST, "-n", str(workers), "-p", "mutation.reach", *tests],
        cwd=project,
        env=environment,
        check=False,
    )


class Worker:
    """A copy of the project in which mutants are judged, one after the other."""

    _sound: ClassVar[dict[str, bool]] = {}
    """Whether a test passes without any error, as far as that was asked."""
    _sound_lock = threading.Lock()

    def __init__(
        self, folder: Path, project: Path, cache: Path, reach: Reach, limit: float
    ) -> None:
        self._project, self._original = folder / "project", project
        self._folder = folder
        self._filled_cache = cache
        self._reach = reach
        self._limit = limit
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(project, self._project, ignore=_LEFT_OUT)

    def judge(self, mutant: Mutant) -> Verdict:
        """Put an error in, run the tests that reach it, take it out."""
        file = self._project / mutant.path
        source = file.read_text()
        tests = self._reach.tests_for(mutant, source, self._limit)
        begin = time.monotonic()
        changed = mutant.apply(source)
        assert changed is not None
        try:
            _write(file, changed)
            noticed, by, run = self._run(tests)
        finally:
            _write(file, source)
        return Verdict(mutant, noticed, by, run, len(tests), time.monotonic() - begin)

    def _run(self, tests: list[str]) -> tuple[bool, str, int]:
        """Return whether a test failed, which one, and how many were run."""
        done: list[str] = []
        until = time.monotonic() + 60 + 4 * self._limit
        stages = [tests[:_FIRST], tests[_FIRST:]]
        while stages:
            stage = stages.pop(0)
            if not stage:
                continue
            code, ran = self._pytest(stage, until - time.monotonic())
            done += ran
            if code is None:
                return False, "the time was over", len(done)
            if code in (0, 5):
                continue
            if not ran:
                return True, "collection", len(done)
            if self._notices(ran[-1]):
                return True, ran[-1], len(done)
            stages.insert(0, [name for name in stage if name not in done])
        return False, "" if tests else "no test reaches it", len(done)

    def _notices(self, test: str) -> bool:
        """Whether a test that failed fails by the error and not by itself."""
        if test.startswith(_REPEATED) and self._pytest([test], 300)[0] == 0:
            return False
        with self._sound_lock:
            if test not in self._sound:
                mutated, self._project = self._project, self._original
                try:
                    self._sound[test] = self._pytest([test], 300)[0] == 0
                finally:
                    self._project = mutated
            return self._sound[test]

    def _pytest(self, tests: list[str], timeout: float) -> tuple[int | None, list[str]]:
        """Return pytest's exit code (None: time over) and the tests that were begun."""
        log, limits, cache = (self._folder / n for n in ("log", "limits.json", "cache"))
        log.write_text("")
        seconds = self._reach.seconds
        limits.write_text(json.dumps({n: 20 + 8 * seconds[n] for n in tests}))
        # What a mutant compiles or plans must not be found by the next one.
        shutil.rmtree(cache, ignore_errors=True)
        shutil.copytree(self._filled_cache, cache)
        mark = f"{os.getpid()}-{id(self)}-{time.monotonic_ns()}"
        environment = _environment(self._project, cache) | {
            "SPACEROBOT_MUTANT_TESTS": str(limits),
            "SPACEROBOT_MUTANT_LOG": str(log),
            "SPACEROBOT_MUTANT": mark,
        }
        files = list(dict.fromkeys(name.split("::")[0] for name in tests))
        temporary = f"--basetemp={self._folder / 'tmp'}"
        process = subprocess.Popen(
            [*_PYTEST, "-x", "-p", "mutation.one_mutant", temporary, *files],
            cwd=self._project,
            env=environment,
            stdout=(self._folder / "output").open("w"),
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        code: int | None = None
        try:
            code = process.wait(max(1.0, timeout))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        finally:
            _end_what_is_left(mark)
        return code, log.read_text().splitlines()


_PYTEST = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider"]


def _text(path: Path) -> str:
    return path.read_text("utf-8") if path.exists() else ""


def _environment(project: Path, cache: Path) -> dict[str, str]:
    paths = os.pathsep.join((str(project), str(project / "test")))
    return os.environ | {"PYTHONPATH": paths, "SPACEROBOT_CACHE_DIR": str(cache)}


def _write(file: Path, source: str) -> None:
    """Write a file such that Python cannot take bytecode of the one before for it."""
    file.write_text(source)
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        compiled.unlink()


def _end_what_is_left(mark: str) -> None:
    """End processes that a test has started and a mutant has kept from ending."""
    wanted = f"SPACEROBOT_MUTANT={mark}".encode()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if wanted in (entry / "environ").read_bytes().split(b"\0"):
                os.kill(int(entry.name), signal.SIGKILL)
        except OSError:
            continue


def judge_all(mutants: Sequence[Mutant], workers: Sequence[Worker], results: Path) -> list[Verdict]:
    """Judge mutants, several at a time; write each verdict to a file at once."""
    waiting: queue.SimpleQueue[Mutant] = queue.SimpleQueue()
    for mutant in mutants:
        waiting.put(mutant)
    verdicts: list[Verdict] = []
    lock = threading.Lock()

    def work(worker: Worker) -> None:
        while True:
            try:
                mutant = waiting.get_nowait()
            except queue.Empty:
                return
            verdict = worker.judge(mutant)
            with lock, results.open("a") as file:
                verdicts.append(verdict)
                file.write(json.dumps(asdict(verdict)) + "\n")
                print(f"{len(verdicts)}/{len(mutants)} {_line(verdict)}", flush=True)

    threads = [threading.Thread(target=work, args=[worker]) for worker in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return verdicts


def _line(verdict: Verdict) -> str:
    mutant = verdict.mutant
    state = "noticed" if verdict.noticed else "SURVIVED"
    return (
        f"{verdict.seconds:5.1f} s {state} {mutant.path}:{mutant.line} "
        f"[{mutant.before}] -> [{mutant.after}] {verdict.by}"
    )


def interval(noticed: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share."""
    z = 1.959964
    p = noticed / total
    middle = (p + z * z / (2 * total)) / (1 + z * z / total)
    half = z * math.sqrt(p * (1 - p) / total + z * z / (4 * total**2)) / (1 + z * z / total)
    return middle - half, middle + half


def table(verdicts: Iterable[Verdict]) -> str:
    """Return what was noticed, by folder, and what was not, as Markdown."""
    verdicts = sorted(verdicts, key=lambda v: (v.mutant.path, v.mutant.line))
    by_folder: dict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        by_folder[verdict.mutant.path.split("/")[1]].append(verdict)
    lines = ["| folder | mutants | noticed |", "|---|---|---|"]
    for folder, some in [*sorted(by_folder.items()), ("all", verdicts)]:
        count = sum(v.noticed for v in some)
        low, high = interval(count, len(some))
        share = f"{100 * count / len(some):.1f} % ({100 * low:.0f} to {100 * high:.0f})"
        lines.append(f"| {folder} | {len(some)} | {share} |")
    lines += ["", "| survivor | in | before | after | tests run |", "|---|---|---|---|---|"]
    for verdict in verdicts:
        if not verdict.noticed:
            m = verdict.mutant
            cells = [f"{m.path}:{m.line}", m.definition, f"`{m.before}`", f"`{m.after}`"]
            why = f" ({verdict.by})" if verdict.by else ""
            lines.append("| " + " | ".join([*cells, f"{verdict.run}{why}"]) + " |")
    return "\n".join(lines) + "\n"


def _changed_tests(old: Path, new: Path, folders: Sequence[str]) -> list[str]:
    """Return the files with tests of some folders that have changed."""
    files = [path for folder in folders for path in (new / "test" / folder).rglob("test_*.py")]
    names = [str(path.relative_to(new)) for path in (*files, new / "test" / "test_expected.py")]
    return sorted(name for name in names if _text(old / name) != _text(new / name))


def _fingerprint(project: Path, tests: Sequence[str]) -> str:
    digest = hashlib.sha256(json.dumps(list(tests)).encode())
    for folder in ("spacerobot_ros", "test"):
        for file in sorted((project / folder).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _survivors(project: Path, results: Path, mutants: Sequence[Mutant]) -> list[Mutant]:
    """Find the survivors of an earlier run again, wherever they are by now."""
    keys = set()
    for line in results.read_text().splitlines():
        verdict = json.loads(line)
        if not verdict["noticed"]:
            keys.add(Mutant(**verdict["mutant"]).key)
    places = {(path, definition, operator) for path, definition, operator, _, _ in keys}
    some = (m for m in mutants if (m.path, m.definition, m.operator) in places)
    return [m for m in (described(project, m) for m in some) if m is not None and m.key in keys]


def main() -> int:
    """Judge a sample of mutants; return 1 if fewer are noticed than wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit", type=float, default=60.0, help="s of tests for one mutant")
    parser.add_argument("--wanted", type=float, default=85.0, help="%% that must be noticed")
    parser.add_argument("--out", type=Path, default=PROJECT / "out" / "mutants")
    parser.add_argument("--mutate", nargs="+", default=MUTATED, help="folders of the package")
    parser.add_argument("--tests", nargs="*", default=[], help="fewer than all quick tests")
    parser.add_argument("--again", type=Path, help="results whose survivors are judged again")
    parser.add_argument(
        "--keep-reach", action="store_true", help="although the code has changed a little"
    )
    chosen = parser.parse_args()

    out = chosen.out.resolve()
    base, cache, reached = out / "project", out / "cache", out / "reach"
    mark = reached / "fingerprint"
    fingerprint = _fingerprint(PROJECT, chosen.tests)
    if not (mark.exists() and (chosen.keep_reach or mark.read_text() == fingerprint)):
        print("Which test reaches which line? All quick tests are run once.", flush=True)
        shutil.rmtree(base, ignore_errors=True)
        shutil.copytree(PROJECT, base, ignore=_LEFT_OUT)
        cache.mkdir(parents=True, exist_ok=True, mode=0o700)
        measure(base, reached, cache, chosen.tests, chosen.workers)
        mark.write_text(fingerprint)
    reach = Reach.read(reached)
    if chosen.keep_reach:
        changed = _changed_tests(base, PROJECT, chosen.mutate)
        print(f"{len(changed)} files of tests have changed: they are run once.", flush=True)
        reach = reach.moved_to(base, PROJECT)
        if changed:
            measure(PROJECT, out / "changed", cache, changed, chosen.workers)
            reach = reach.with_changed(Reach.read(out / "changed"), changed)

    population = list(mutants_of(PROJECT, chosen.mutate, NOT_MUTATED))
    if chosen.again is not None:
        drawn = _survivors(PROJECT, chosen.again, population)
    else:
        drawn = sample(PROJECT, population, chosen.sample, chosen.seed)
    print(f"{len(drawn)} of {len(population)} mutants, {len(reach.seconds)} tests", flush=True)
    workers = [
        Worker(out / f"worker{n}", PROJECT, cache, reach, chosen.limit)
        for n in range(chosen.workers)
    ]
    results = out / "results.jsonl"
    if chosen.again is None or chosen.again.resolve() != results:
        results.unlink(missing_ok=True)
    verdicts = judge_all(drawn, workers, results)
    text = table(verdicts)
    (out / "survivors.md").write_text(text)
    print(text)
    return int(100 * sum(v.noticed for v in verdicts) < chosen.wanted * len(verdicts))


if __name__ == "__main__":
    sys.exit(main())
