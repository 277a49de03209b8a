"""Flies the draws of a campaign, here or on a cluster, and writes a row for each."""

from __future__ import annotations

import logging
import math
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from spacerobot_ros.campaign.config import Campaign, parse_campaign
from spacerobot_ros.campaign.dataset import Dataset, self_contained
from spacerobot_ros.campaign.draws import Draw, Draws
from spacerobot_ros.campaign.engines import chosen_engine, engine_called, fly_all
from spacerobot_ros.campaign.extras import needed
from spacerobot_ros.campaign.rows import FLIGHTS, Fallback, Row
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.files import warn_once
from spacerobot_ros.version import __version__

TASK_TIME = 2.0
"""Wall s that a task shall take: the work of the scheduler for one is then small beside it."""

_FIRST, _MOST = 4, 2000
"""Numbers of flights in the first tasks, and in the largest."""

_AHEAD = 2
"""Tasks for each worker that are submitted before its present one ends, that one included."""

_MOST_DEATHS = 2
"""Workers that may die during a flight before it is reported and not flown again."""

_PACKAGE = "spacerobot_ros"

_LOOK_PERIOD = 0.2
"""Longest wall s between two looks at tasks, signals and the dataset."""

_ALONE = 5.0
"""Wall s without a worker before a warning says so."""

KILLED = "killed"
"""The outcome of a flight during which a worker died twice."""


@dataclass(frozen=True)
class Progress:
    """How far a campaign is.

    Attributes
    ----------
    done, total
        Flights.
    rate
        Flights a second of wall time, in this process.
    seconds
        Wall time so far.
    """

    done: int
    total: int
    rate: float
    seconds: float

    @property
    def left(self) -> float:
        """Wall time that is left, s; infinite before the first flight."""
        return (self.total - self.done) / self.rate if self.rate else float("inf")


@dataclass(frozen=True)
class Cluster:
    """Where flights are flown.

    Attributes
    ----------
    workers
        Processes on this machine; 0: this process alone.
    scheduler
        Address of a scheduler of dask.distributed whose workers fly; empty: those of this machine.
    """

    workers: int = 0
    scheduler: str = ""


def run_campaign(
    campaign: Campaign,
    folder: Path,
    *,
    engine: str = "auto",
    cluster: Cluster = Cluster(),
    show: Callable[[Progress], None] = lambda progress: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Progress:
    """Fly every draw of a campaign that is not in its folder yet.

    Parameters
    ----------
    campaign
        The campaign.
    folder
        The folder of its dataset.
    engine
        The name of an engine, or ``auto``.
    cluster
        The workers that fly.
    show
        Receives the progress after each task, and a few times a second.
    stopped
        Returns whether to end; called a few times a second. Rows of flights that have ended are
        kept.

    Returns
    -------
    Progress
        The progress at the end.

    Raises
    ------
    SpaceRobotError
        The engine cannot fly it, the folder holds another campaign, or a package is missing.
    """
    draws = Draws(campaign)
    wanted = campaign.engine if engine == "auto" else engine
    chosen = chosen_engine(campaign, wanted)
    dataset = Dataset(folder)
    done = dataset.begin(campaign)
    numbers = [number for number in range(len(draws)) if number not in done]
    began, before = time.monotonic(), len(draws) - len(numbers)

    def progress(flown: int) -> Progress:
        seconds = time.monotonic() - began
        rate = flown / seconds if seconds > 0 else 0.0
        return Progress(before + flown, len(draws), rate, seconds)

    flown = 0
    rows = _rows(campaign, draws, numbers, chosen.name, cluster, stopped)
    try:
        for batch in rows:
            dataset.add(batch)
            flown += len(batch)
            show(progress(flown))
    finally:
        dataset.close()
    return progress(flown)


def _rows(
    campaign: Campaign,
    draws: Draws,
    numbers: list[int],
    engine: str,
    cluster: Cluster,
    stopped: Callable[[], bool],
) -> Iterator[list[Row]]:
    """Yield the rows of draws as they are flown; none now and then, where others fly them."""
    if not numbers:
        return
    if not cluster.workers and not cluster.scheduler:
        for row in fly_all(engine_called(engine), campaign, _Chosen(draws, numbers), stopped):
            yield [row]
        return
    specification = _Specification(self_contained(campaign))
    with _client(cluster, len(numbers)) as client:
        yield from _Distribution(client, specification, draws, engine, stopped).rows(numbers)


class _Chosen(Sequence[Draw]):
    """Some draws by their place in a list of numbers, each made when it is used."""

    def __init__(self, draws: Draws, numbers: list[int]) -> None:
        self._draws, self._numbers = draws, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self._draws[number] for number in self._numbers[index]]
        return self._draws[self._numbers[index]]


# -- what a worker does -----------------------------------------------------------------------


class _Specification:
    """A campaign as it is sent to workers: the content of its file and its scenario."""

    def __init__(self, campaign: Campaign) -> None:
        self.name, self.section = campaign.name, dict(campaign.section)
        self.scenario = campaign.scenario
        self.version = __version__
        self.key = os.urandom(8).hex()

    def campaign(self) -> Campaign:
        """Return the campaign, parsed once in each process."""
        return _parsed(self)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Specification) and other.key == self.key


@lru_cache(maxsize=4)
def _parsed(specification: _Specification) -> Campaign:
    return parse_campaign(
        specification.name, specification.section, scenario=specification.scenario
    )


def fly_task(
    specification: _Specification, draws: list[Draw], engine: str, *, all_of_them: bool = False
) -> list[Row | Fallback]:
    """Fly some draws in a worker: a task of the scheduler.

    Parameters
    ----------
    specification, draws, engine
        What is flown by what.
    all_of_them
        What the engine leaves is flown here, too.

    Raises
    ------
    SpaceRobotError
        The worker has another version of this package.
    """
    if specification.version != __version__:
        raise SpaceRobotError(
            f"A worker has spacerobot_ros {__version__}, and this process {specification.version}: "
            "all need the same."
        )
    flying, campaign = engine_called(engine), specification.campaign()
    fly = partial(fly_all, flying) if all_of_them else flying.fly
    return list(fly(campaign, draws, lambda: False))


# -- the scheduler ----------------------------------------------------------------------------


@contextmanager
def _client(cluster: Cluster, flights: int) -> Iterator[Any]:
    """Yield a client of dask.distributed, with workers on this machine unless there is a scheduler.

    Raises
    ------
    SpaceRobotError
        dask.distributed is not installed, or nobody is at the address.
    """
    needed("distributed")
    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.scheduler.allowed-failures": 0,  # Who is to blame is found out here.
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.daemon": True,
        "distributed.admin.tick.limit": "1h",
        # Ctrl-C reaches the workers of a terminal, too: this process ends them.
        "distributed.worker.preload": [
            "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        ],
    }
    with dask.config.set(settings):
        if cluster.scheduler:
            # A sentence says what its tracebacks would.
            logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
            try:
                client = Client(cluster.scheduler, timeout="20s")
            except (OSError, TimeoutError, ValueError) as error:
                raise SpaceRobotError(
                    f"There is no scheduler at {cluster.scheduler}: {error}."
                ) from error
            with client:
                yield client
            return
        # Compilers and linear algebra of several workers would fight for the cores.
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        with (
            LocalCluster(
                n_workers=min(cluster.workers, max(1, flights)),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                # Without an address they would listen to the whole network, on port 8787.
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address="127.0.0.1:0",
                memory_limit=_memory(cluster.workers),
                env=threads,
                silence_logs=50,
            ) as workers,
            Client(workers) as client,
        ):
            yield client


def _memory(workers: int) -> int:
    """Return the memory of a worker, bytes: of this machine half, shared by all of them."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(512 * 2**20, total // (2 * max(1, workers)))


def _lost() -> SpaceRobotError:
    return SpaceRobotError(
        "The scheduler is gone. What was flown is kept: the same command goes on from there."
    )


@dataclass(frozen=True)
class _Task:
    """Draws that a worker flies now, by number, and the engine that flies them."""

    numbers: list[int]
    engine: str


class _Distribution:
    """Deals draws out to workers.

    What an engine leaves to the engine ``flights`` is dealt out anew, in tasks of fewer flights.

    When a worker dies, the scheduler reports all tasks that it had: the one that killed it, and
    others. Their flights are suspects: each is flown again in a task of its own, one suspect at a
    time. If a worker dies during such a task, its flight has killed two workers, and is reported.
    """

    def __init__(
        self,
        client: Any,
        specification: _Specification,
        draws: Draws,
        engine: str,
        stopped: Callable[[], bool],
    ) -> None:
        self._client, self._specification, self._draws = client, specification, draws
        self._engine, self._stopped = engine, stopped
        self._sizes = {
            name: float(max(_FIRST, engine_called(name).least)) for name in (engine, FLIGHTS)
        }
        """Flights of a task, by what flies it."""
        self._left: deque[int] = deque()
        """Draws that the engine has left to the engine ``flights``."""
        self._reasons: dict[int, str] = {}
        """Why it has left each of them."""
        self._running: dict[Any, _Task] = {}
        self._suspects: deque[int] = deque()
        self._deaths: Counter[int] = Counter()
        self._fit: set[str] = set()
        """Addresses of workers that have this package."""
        self._alone_since = math.inf
        """When it was seen that there is no worker, on the monotonic clock."""
        self._suspected: Any = None
        """The task of the suspect that is flown now."""

    def rows(self, numbers: list[int]) -> Iterator[list[Row]]:
        """Yield the rows of these draws as their tasks end."""
        waiting = deque(numbers)
        while (waiting or self._left or self._suspects or self._running) and not self._stopped():
            self._submit(waiting)
            ended = self._ended()
            if not ended:
                yield []
            for future in ended:
                yield self._taken(future)
        if self._running:
            self._client.cancel(list(self._running), force=True)

    def _submit(self, waiting: deque[int]) -> None:
        """Keep the workers busy."""
        if self._suspects and self._suspected is None:
            self._suspected = self._task([self._suspects.popleft()], self._engine, alone=True)
        workers = self._workers()
        while (self._left or waiting) and len(self._running) < _AHEAD * workers:
            queue, engine = (self._left, FLIGHTS) if self._left else (waiting, self._engine)
            # The last tasks are smaller, so that no worker is alone at the end.
            share = max(engine_called(engine).least, len(queue) / workers)
            count = min(len(queue), max(1, round(min(self._sizes[engine], share))))
            self._task([queue.popleft() for _ in range(count)], engine)

    def _workers(self) -> int:
        """Return how many workers there are, at least one: others may join later.

        Raises
        ------
        SpaceRobotError
            The scheduler is gone.
        """
        try:
            if self._client.status != "running":
                raise _lost()
            threads = self._client.nthreads()
            self._require_package(threads)
        except (OSError, AttributeError) as error:  # The client was about to notice it.
            raise _lost() from error
        workers = sum(threads.values())
        if workers:
            self._alone_since = math.inf
        elif time.monotonic() - self._alone_since > _ALONE:
            warn_once("The scheduler has no worker: the flights wait for one.")
        elif self._alone_since == math.inf:
            self._alone_since = time.monotonic()
        return max(1, workers)

    def _require_package(self, workers: Iterable[str]) -> None:
        """Refuse workers without this package, which a task would end again and again.

        Raises
        ------
        SpaceRobotError
            One that has joined has not got it.
        """
        joined = [address for address in workers if address not in self._fit]
        if not joined:
            return
        # A function of the standard library, which every worker can load.
        found = self._client.run(find_spec, _PACKAGE, workers=joined, on_error="return")
        for address, spec in found.items():
            if spec is None:
                raise SpaceRobotError(
                    f"The worker at {address} has no {_PACKAGE}: install it there."
                )
            if not isinstance(spec, Exception):  # It may be gone again.
                self._fit.add(address)

    def _task(self, numbers: list[int], engine: str, *, alone: bool = False) -> Any:
        draws = [self._draws[number] for number in numbers]
        future = self._client.submit(
            *(fly_task, self._specification, draws, engine),
            **{"all_of_them": alone, "pure": False, "retries": 0},
        )
        self._running[future] = _Task(numbers, engine)
        return future

    def _ended(self) -> list[Any]:
        """Return tasks that have ended, after a while none if there are none."""
        from distributed import wait

        try:
            wait(list(self._running), timeout=_LOOK_PERIOD, return_when="FIRST_COMPLETED")
        except TimeoutError:
            return []
        except CancelledError as error:
            raise _lost() from error
        return [future for future in self._running if future.done()]

    def _taken(self, future: Any) -> list[Row]:
        """Return the rows of a task; none where its worker died.

        Raises
        ------
        SpaceRobotError
            The scheduler is gone, or a worker cannot fly at all.
        """
        from distributed.scheduler import KilledWorker

        task = self._running.pop(future)
        alone = future is self._suspected
        if alone:
            self._suspected = None
        try:
            made: list[Row | Fallback] = future.result()
        except KilledWorker:
            return self._mourned(task.numbers, alone)
        except CancelledError as error:
            raise _lost() from error
        except (ImportError, RuntimeError) as error:
            # So dask.distributed calls what the scheduler cannot load.
            if isinstance(error, RuntimeError) and "deserialization" not in str(error):
                raise
            raise SpaceRobotError(
                "The scheduler or a worker cannot load what flies "
                f"({str(error).splitlines()[0]}): all of them need {_PACKAGE}[campaign] "
                f"{__version__}."
            ) from error
        rows = [each for each in made if isinstance(each, Row)]
        left = [each for each in made if isinstance(each, Fallback)]
        self._left += [each.draw.number for each in left]
        self._reasons |= {each.draw.number: each.reason for each in left}
        if not alone and rows:
            took = sum(row.wall_time for row in rows if row.wall_time == row.wall_time)
            if took > 0:
                size = 0.5 * self._sizes[task.engine] + 0.5 * len(rows) * TASK_TIME / took
                least = engine_called(task.engine).least
                self._sizes[task.engine] = max(least, min(_MOST, size))
        return [
            replace(row, fallback=self._reasons[number])
            if (number := row.draw.number) in self._reasons
            else row
            for row in rows
        ]

    def _mourned(self, numbers: list[int], alone: bool) -> list[Row]:
        """Make suspects of the flights of a task whose worker died; return rows of the guilty."""
        given_up = []
        for number in numbers:
            if alone or not self._deaths[number]:
                self._deaths[number] += 1
            if self._deaths[number] >= _MOST_DEATHS:
                reason = f"The process that flew it died {_MOST_DEATHS} times."
                row = Row(self._draws[number], KILLED, reason, engine=self._engine)
                given_up.append(row)
            else:
                self._suspects.append(number)
        return given_up
