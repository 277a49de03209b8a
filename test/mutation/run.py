"""Put errors into the package, one at a time, and see whether the quick tests notice.

`make mutants` runs it. Cosmic Ray makes the errors; for each, only the tests that reach the changed
line are run, fastest first, until one fails. All happens in copies of the project.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import math
import queue
import secrets
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from difflib import SequenceMatcher
from pathlib import Path

from coverage import CoverageData
from mutation.mutants import (
    Mutant,
    described,
    mutants_of,
    sample,
    statement_lines,
    using_lines,
)
from support.fork_server import ForkServer, How, environment_of, limits_of, write_source
from support.forked import NotExchangedError, can_be_exchanged

PROJECT = Path(__file__).parents[2]

LEAST_SHARE = 70.0
"""Percent of the mutants of each folder that must be noticed, where several were drawn."""

SEVERAL = 10
"""So many mutants of a folder say something about its share."""

_LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "out", "build", "__pycache__", ".hypothesis", ".*_cache", "*.egg-info"
)

_FIRST = 12
"""So many tests are tried before the rest is imported: they notice most of what is noticed."""

_REPEATED = ("test/nodes/", "test/session/", "test/cli/", "test/examples/")
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
    how : str
        How it noticed: the value of a :class:`How`.
    run, tried, reaching : int
        Tests that were run; tests that there was time for; tests that reach the change.
    exact : bool
        Whether the tests ran as if the file had been imported anew.
    seconds : float
        Time that this took.
    """

    mutant: Mutant
    noticed: bool
    by: str
    how: str
    run: int
    tried: int
    reaching: int
    exact: bool
    seconds: float

    @property
    def complete(self) -> bool:
        """Whether no more can be done to notice it."""
        return self.exact and self.tried == self.reaching


@dataclass
class Reach:
    """Which tests reach which lines, and how long each takes.

    Attributes
    ----------
    seconds : dict[str, tuple[float, float]]
        CPU and wall time by node id, of tests that pass.
    lines : dict[str, dict[int, list[str]]]
        Node ids by file and line; "" for what is run when the file is imported.
    """

    seconds: dict[str, tuple[float, float]]
    lines: dict[str, dict[int, list[str]]] = field(default_factory=lambda: defaultdict(dict))

    @classmethod
    def read(cls, folder: Path) -> Reach:
        """Read what the workers of `measure` have written."""
        measured: dict[str, tuple[float, float, bool]] = {}
        for file in folder.glob("tests-*.json"):
            measured |= json.loads(file.read_text())
        found = cls({name: (cpu, wall) for name, (cpu, wall, passed) in measured.items() if passed})
        users: dict[str, list[str]] = defaultdict(list)
        for file in folder.glob("users-*.json"):
            for fixture, names in json.loads(file.read_text()).items():
                users[fixture] += names
        for file in folder.glob("lines-*"):
            data = CoverageData(str(file))
            data.read()
            for path in data.measured_files():
                here = found.lines["spacerobot_ros/" + path.rpartition("/spacerobot_ros/")[2]]
                for line, names in data.contexts_by_lineno(path).items():
                    tests = [test for name in names for test in users.get(name, [name])]
                    here[line] = list(dict.fromkeys([*here.get(line, []), *tests]))
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

    def tests_for(self, mutant: Mutant, source: str) -> tuple[list[str], bool]:
        """Return the tests that reach a change, fastest first.

        Also whether the change is executed while its file is imported.
        """
        lines = self.lines.get(mutant.path, {})
        reaching = set(lines.get(mutant.line, ()))
        if not reaching - {""}:
            for line in statement_lines(source, mutant.line):
                reaching |= set(lines.get(line, ()))
        imported = "" in reaching or not reaching
        users: set[str] = set()
        if imported:
            # Constants and defaults: whoever uses anything of the file may see them.
            reaching |= {name for names in lines.values() for name in names}
            folder = "test/" + mutant.path.split("/")[1] + "/"
            reaching |= {name for name in self.seconds if name.startswith((folder, *_ANYWHERE))}
            # First those that come to where it is used.
            users = {n for line in using_lines(source, mutant.line) for n in lines.get(line, ())}
        known = (name for name in reaching if name in self.seconds)
        return sorted(known, key=lambda n: (n not in users, self.seconds[n][0], n)), imported

    def within(self, tests: Sequence[str], limit: float) -> list[str]:
        """Return as many of some tests as take a time together (CPU, s)."""
        total = itertools.accumulate(self.seconds[name][0] for name in tests)
        return [name for name, sum_ in zip(tests, total, strict=True) if sum_ <= limit]


def measure(project: Path, folder: Path, cache: Path, tests: Sequence[str], workers: int) -> None:
    """Run the quick tests once, recording which line each reaches."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    environment = environment_of(project, cache) | {
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

    def __init__(
        self, folder: Path, project: Path, cache: Path, reach: Reach, tests: Sequence[str]
    ) -> None:
        self._project = folder / "project"
        self._folder, self._cache = folder, folder / "cache"
        self._filled_cache = cache
        self._reach = reach
        self._sound: dict[str, bool] = {}
        """Whether a test passes without any error, as far as that was asked."""
        self._noticing: dict[str, Counter[str]] = defaultdict(Counter)
        """How many errors each test has noticed, by file."""
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(project, self._project, ignore=_LEFT_OUT)
        self._server = self._serve("all", tests)
        if not self._server.ready:
            raise RuntimeError(f"the tests cannot be collected; see {folder}")

    def close(self) -> None:
        """End the process with the tests."""
        self._server.close()

    def judge(self, mutant: Mutant, limit: float, earlier: Verdict | None = None) -> Verdict:
        """Put an error in, run the tests that reach it, take it out.

        Parameters
        ----------
        limit
            CPU time (s) of the tests that may be run.
        earlier
            The verdict with a smaller limit: what was run then is not run again.
        """
        file = self._project / mutant.path
        source = file.read_text()
        reaching, imported = self._reach.tests_for(mutant, source)
        chosen = self._reach.within(reaching, limit)
        tests = chosen[earlier.tried :] if earlier is not None and earlier.exact else chosen[:]
        # What has noticed errors in this file may notice this one.
        tests.sort(key=lambda test: -self._noticing[mutant.path][test])
        begin = time.monotonic()
        changed = mutant.apply(source)
        assert changed is not None
        exact = not imported and can_be_exchanged(source, changed)
        write_source(file, changed)
        try:
            try:
                # First without importing the file anew, even where that is not quite the same.
                exchanged = exact or earlier is None
                by, how, run = self._run(tests, file, source, changed, exchanged)
            except NotExchangedError:
                exchanged, exact = False, True
                by, how, run = self._run(tests, file, source, changed, exchanged)
        finally:
            write_source(file, source)
        exact = exact or not exchanged
        seconds = time.monotonic() - begin + (0.0 if earlier is None else earlier.seconds)
        noticed = how is not None
        if not reaching:
            by = "no test reaches it"
        elif noticed:
            self._noticing[mutant.path][by] += 1
        elif len(chosen) < len(reaching):
            by = f"{len(reaching) - len(chosen)} slower tests were not run"
        word = how.value if how else ""
        run += 0 if earlier is None else earlier.run
        return Verdict(mutant, noticed, by, word, run, len(chosen), len(reaching), exact, seconds)

    def _run(
        self, tests: list[str], file: Path, source: str, changed: str, exchanged: bool
    ) -> tuple[str, How | None, int]:
        """Return which test failed and how, and how many were run."""
        run = 0
        stages = [tests] if exchanged else [tests[:_FIRST], tests[_FIRST:]]
        while stages:
            stage = stages.pop(0)
            if not stage:
                continue
            exchange = (str(file), source) if exchanged else None
            server = self._server
            if not exchanged:
                files = dict.fromkeys(name.split("::")[0] for name in stage)
                server = self._serve("one", list(files))
            try:
                if not server.ready:
                    return stage[0].split("::")[0], How.NOT_IMPORTED, run
                while stage:
                    by, how, begun = self._attempt(server, stage, exchange)
                    run += len(begun)
                    if how is None:
                        break
                    again = by.startswith(_REPEATED) or how is How.WAITED
                    if not again or self._attempt(server, [by], exchange)[1] is not None:
                        write_source(file, source)
                        sound = self._passes_without(by)
                        write_source(file, changed)
                        if sound:
                            return by, how, run
                    stage = stage[stage.index(by) + 1 :]
            finally:
                if server is not self._server:
                    server.close()
        return "", None, run

    def _passes_without(self, test: str) -> bool:
        """Whether a test fails by the error and not by itself."""
        if test not in self._sound:
            self._sound[test] = self._attempt(self._server, [test], None)[1] is None
        return self._sound[test]

    def _attempt(
        self, server: ForkServer, tests: Sequence[str], exchange: tuple[str, str] | None
    ) -> tuple[str, How | None, list[str]]:
        # What a mutant compiles or plans must not be found by the next one.
        shutil.rmtree(self._cache, ignore_errors=True)
        shutil.copytree(self._filled_cache, self._cache)
        seconds = self._reach.seconds
        return server.run({name: limits_of(*seconds[name]) for name in tests}, exchange)

    def _serve(self, name: str, files: Sequence[str]) -> ForkServer:
        folder = self._folder / name
        folder.mkdir(exist_ok=True)
        return ForkServer(folder, self._project, environment_of(self._project, self._cache), files)


_PYTEST = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider"]


def _text(path: Path) -> str:
    return path.read_text("utf-8") if path.exists() else ""


def judge_all(
    mutants: Sequence[Mutant],
    workers: Sequence[Worker],
    results: Path,
    limits: Sequence[float],
    known: Mapping[Mutant, Verdict],
) -> dict[Mutant, Verdict]:
    """Judge mutants, several at a time; write each verdict to a file at once.

    Parameters
    ----------
    limits
        CPU time (s) of the tests for one mutant: all mutants with the first, those that survive
        with the next.
    known
        What is known already.
    """
    verdicts = {mutant: known[mutant] for mutant in mutants if mutant in known}
    lock = threading.Lock()

    def work(worker: Worker, limit: float) -> None:
        while True:
            try:
                mutant = waiting.get_nowait()
            except queue.Empty:
                return
            verdict = worker.judge(mutant, limit, verdicts.get(mutant))
            with lock, results.open("a") as file:
                verdicts[mutant] = verdict
                file.write(json.dumps(asdict(verdict)) + "\n")
                noticed = sum(v.noticed for v in verdicts.values())
                print(f"{noticed}/{len(verdicts)} {_line(verdict)}", flush=True)

    for limit in limits:
        waiting: queue.SimpleQueue[Mutant] = queue.SimpleQueue()
        for mutant in mutants:
            verdict = verdicts.get(mutant)
            if verdict is None or not (verdict.noticed or verdict.complete):
                waiting.put(mutant)
        print(f"{waiting.qsize()} mutants, {limit:g} s of tests each", flush=True)
        threads = [threading.Thread(target=work, args=[worker, limit]) for worker in workers]
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
        f"[{mutant.before}] -> [{mutant.after}] {verdict.by} {verdict.how}"
    )


def interval(noticed: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share."""
    z = 1.959964
    p = noticed / total
    middle = (p + z * z / (2 * total)) / (1 + z * z / total)
    half = z * math.sqrt(p * (1 - p) / total + z * z / (4 * total**2)) / (1 + z * z / total)
    return middle - half, middle + half


def by_folder(verdicts: Iterable[Verdict]) -> dict[str, list[Verdict]]:
    """Return the verdicts of each folder of the package."""
    found: dict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        found[verdict.mutant.folder].append(verdict)
    return dict(sorted(found.items()))


def too_low(verdicts: Sequence[Verdict], more: Sequence[Verdict], wanted: float) -> list[str]:
    """Return the folders, or "all", of which too small a share was noticed.

    Parameters
    ----------
    verdicts
        On the sample.
    more
        On the further mutants of folders of which the sample has few: they count for these alone.
    """
    low = [
        folder
        for folder, some in by_folder([*verdicts, *more]).items()
        if len(some) >= SEVERAL and _percent(some) < LEAST_SHARE
    ]
    return [*low, "all"] if _percent(verdicts) < wanted else low


def _percent(verdicts: Sequence[Verdict]) -> float:
    return 100 * sum(v.noticed for v in verdicts) / len(verdicts)


def table(verdicts: Sequence[Verdict], more: Sequence[Verdict] = ()) -> str:
    """Return what was noticed, by folder, and what was not, as Markdown."""
    lines = ["| folder | mutants | noticed |", "|---|---|---|"]
    for folder, some in [*by_folder([*verdicts, *more]).items(), ("all", verdicts)]:
        count = sum(v.noticed for v in some)
        low, high = interval(count, len(some))
        share = f"{_percent(some):.1f} % ({100 * low:.0f} to {100 * high:.0f})"
        lines.append(f"| {folder} | {len(some)} | {count}, {share} |")
    if more:
        lines += ["", f"Folders with few of the sample have {len(more)} more of their own."]
    lines += ["", "| survivor | in | before | after | tests run |", "|---|---|---|---|---|"]
    for verdict in sorted([*verdicts, *more], key=lambda v: (v.mutant.path, v.mutant.line)):
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


def _known(results: Path) -> dict[Mutant, Verdict]:
    """Return the last verdict on each mutant of a file with results."""
    found = {}
    for line in _text(results).splitlines():
        verdict = json.loads(line)
        mutant = Mutant(**verdict.pop("mutant"))
        found[mutant] = Verdict(mutant, **verdict)
    return found


def _survivors(project: Path, results: Path, mutants: Sequence[Mutant]) -> list[Mutant]:
    """Find the survivors of an earlier run again, wherever they are by now."""
    known = _known(results).items()
    keys = {mutant.key for mutant, verdict in known if not verdict.noticed}
    places = {(path, definition, operator) for path, definition, operator, _, _ in keys}
    some = (m for m in mutants if (m.path, m.definition, m.operator) in places)
    return [m for m in (described(project, m) for m in some) if m is not None and m.key in keys]


def main() -> int:
    """Judge a sample of mutants; return 1 if fewer are noticed than wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, default=400)
    parser.add_argument(
        "--at-least",
        type=int,
        default=0,
        help="draw further mutants of folders with fewer, which count for their folder alone",
    )
    parser.add_argument("--seed", type=int, help="of the sample; another one each time if left out")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--limits",
        type=float,
        nargs="+",
        default=[5.0, 60.0],
        help="CPU time (s) of tests for one mutant, then for those that survive",
    )
    parser.add_argument("--wanted", type=float, default=80.0, help="%% that must be noticed")
    parser.add_argument("--out", type=Path, default=PROJECT / "out" / "mutants")
    parser.add_argument("--mutate", nargs="+", default=["."], help="folders of the package [all]")
    parser.add_argument("--tests", nargs="*", default=[], help="fewer than all quick tests")
    parser.add_argument("--resume", action="store_true", help="go on where a run was stopped")
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

    population = list(mutants_of(PROJECT, chosen.mutate, ()))
    seed = secrets.randbelow(10**6) if chosen.seed is None else chosen.seed
    if chosen.again is not None:
        drawn = _survivors(PROJECT, chosen.again, population)
        more: list[Mutant] = []
    else:
        drawn, more = sample(PROJECT, population, chosen.sample, seed, chosen.at_least)
    if not drawn:
        parser.error("no mutants; --mutate takes folders of the package, such as planning/core")
    print(
        f"{len(drawn)} of {len(population)} mutants and {len(more)} more, seed {seed}, "
        f"{len(reach.seconds)} tests"
    )
    workers = [
        Worker(out / f"worker{n}", PROJECT, cache, reach, chosen.tests)
        for n in range(chosen.workers)
    ]
    results = out / "results.jsonl"
    known = _known(results) if chosen.resume else {}
    if not chosen.resume and (chosen.again is None or chosen.again.resolve() != results):
        results.unlink(missing_ok=True)
    try:
        found = judge_all([*drawn, *more], workers, results, chosen.limits, known)
    finally:
        for worker in workers:
            worker.close()
    verdicts, others = [found[mutant] for mutant in drawn], [found[mutant] for mutant in more]
    text = f"Seed {seed}.\n\n{table(verdicts, others)}"
    (out / "survivors.md").write_text(text)
    print(text)
    low = too_low(verdicts, others, chosen.wanted)
    if low:
        print(f"Too few are noticed of: {', '.join(low)}.")
    return int(bool(low))


if __name__ == "__main__":
    sys.exit(main())
