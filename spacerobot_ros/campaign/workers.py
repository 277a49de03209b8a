"""Engines by name, and the workers that run them: local processes, or a dask.distributed cluster.

All engines fly the same flight for the same draw. :meth:`TaskDistributor.rows` distributes the
draws in tasks of about :data:`TARGET_TASK_TIME`, and yields the rows of each task when it finishes.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from importlib.util import find_spec
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from threading import Thread
from typing import Any

from spacerobot_ros.batch.targets import device_named
from spacerobot_ros.campaign.config import FLIGHTS, Campaign, parse_campaign
from spacerobot_ros.campaign.dataset import Row
from spacerobot_ros.campaign.draws import Draw, Draws, require_module
from spacerobot_ros.campaign.lanes import LanesEngine
from spacerobot_ros.campaign.one_by_one import FlightsEngine
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.files import warn_once
from spacerobot_ros.registry import PLUGINS_VARIABLE
from spacerobot_ros.resources import __version__, source_hash
from spacerobot_ros.termination import end_with_parent

TARGET_TASK_TIME = 2.0
"""Desired wall time of a task, s; it is long enough to keep the distribution overhead small."""

_MIN_FIRST_TASK_FLIGHTS, _MAX_TASK_FLIGHTS = 4, 2000
"""Smallest number of flights in the first tasks, and largest number in any task."""

_POLL_PERIOD = 0.2
"""Longest wall time between checks of tasks, signals and the dataset, s."""

_NO_WORKER_WARNING_DELAY = 5.0
"""Wall time without workers after which a warning is printed, s."""

_PACKAGE_NAME = "spacerobot_ros"

_THREAD_COUNT_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")

_Task = Future[list[Row | Draw]]

_FLIGHTS_WORTH_A_DEVICE = 100_000
"""Minimum number of flights under coordinated control for which a device saves more time than its
program takes to compile; other campaigns spend most of their time planning."""

# -- engines ----------------------------------------------------------------------------------


Engine = LanesEngine | FlightsEngine


def select_engine(campaign: Campaign, engine_name: str, *, local: bool = True) -> Engine:
    """Return the engine ``engine_name``; ``auto`` selects the first engine that can fly the
    campaign, including devices if the flights are ``local``.

    Raises
    ------
    SpaceRobotError
        The engine cannot fly the campaign, or no engine can; the message states the reason.
    """
    reasons, names = [], [engine_name]
    if engine_name == "auto":
        names = [*["cuda"] * (local and _is_worth_a_device(campaign)), "lanes", FLIGHTS]
    for name in names:
        engine = engine_by_name(name)
        reason = engine.refusal(campaign)
        if not reason:
            return engine
        reasons.append(f"The engine '{name}' cannot fly this campaign: {reason}")
    raise SpaceRobotError(" ".join(reasons))


def _is_worth_a_device(campaign: Campaign) -> bool:
    is_large = campaign.flights >= _FLIGHTS_WORTH_A_DEVICE
    if not is_large or "planner" in campaign.scenario.commanders or not find_spec("cupy"):
        return False
    try:
        device_named("cuda")
    except SpaceRobotError:
        return False
    return True


@cache
def engine_by_name(name: str) -> Engine:
    """Return an engine by name: one instance per process, so that its models are reused."""
    return FlightsEngine() if name == FLIGHTS else LanesEngine(name)


def fly_all(
    engine: Engine, campaign: Campaign, draws: Iterable[Draw], stopped: Callable[[], bool]
) -> Iterator[Row]:
    """Yield a row for each draw; fallbacks are flown last."""
    fallbacks: list[Draw] = []
    for made in engine.fly(campaign, draws, stopped):
        if isinstance(made, Row):
            yield made
        else:
            fallbacks.append(made)
    yield from FlightsEngine().fly(campaign, fallbacks, stopped)


KILLED = "killed"
"""Outcome of a flight during which a worker died twice."""


# -- a task in a worker -----------------------------------------------------------------------


def serialise_campaign(campaign: Campaign) -> bytes:
    """Return a campaign serialised for workers: its file content and its scenario."""
    return pickle.dumps((campaign.name, dict(campaign.section), Path(), campaign.scenario))


@lru_cache(maxsize=4)
def _deserialise_campaign(packed: bytes) -> Campaign:
    try:
        return parse_campaign(*pickle.loads(packed))
    except ParameterError as error:
        raise ParameterError(
            f"A worker refuses the campaign: {error} If a law, method or metric is your own, name "
            f"its file in {PLUGINS_VARIABLE}, or use no workers."
        ) from error


def this_code() -> str:
    """Return the package version and code hash."""
    return f"{__version__} ({source_hash()})"


def fly_task(
    packed: bytes, code: str, draws: list[Draw], engine: str, include_fallbacks: bool
) -> list[Row | Draw]:
    """Fly some draws: a worker task.

    Parameters
    ----------
    packed, code
        Result of :func:`serialise_campaign`, and of :func:`this_code` in the same process.
    draws, engine
        Draws, and engine name.
    include_fallbacks
        Whether this task also flies the fallbacks of the engine.

    Raises
    ------
    SpaceRobotError
        The worker has a different version of this package.
    """
    if code != this_code():
        raise SpaceRobotError(
            f"A worker has spacerobot_ros {this_code()}, and this process has {code}: all "
            "processes must run the same code."
        )
    flying, campaign = engine_by_name(engine), _deserialise_campaign(packed)
    fly = partial(fly_all, flying) if include_fallbacks else flying.fly
    return list(fly(campaign, draws, lambda: False))


# -- workers ----------------------------------------------------------------------------------


class WorkerDeath(Exception):  # noqa: N818
    """A worker died during a task."""


class _RecordingContext(SpawnContext):
    """Starts processes anew, and remembers them."""

    def __init__(self) -> None:
        super().__init__()
        self.made: list[SpawnProcess] = []

    def Process(self, *arguments: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]
        process = SpawnProcess(*arguments, **options)
        self.made.append(process)
        return process


class LocalWorkers:
    """Processes on this machine, each connected by anonymous pipes that no other process can
    access.

    Parameters
    ----------
    count
        The number of processes.
    """

    tasks_per_worker = 1

    def __init__(self, count: int) -> None:
        self._count, self._context = count, _RecordingContext()
        self._pool = self._make_pool()

    def _make_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(self._count, self._context, _end_with_campaign)

    def count(self) -> int:
        """Return the number of workers."""
        return self._count

    def submit(self, *arguments: Any) -> _Task:
        """Queue a task; the arguments are those of :func:`fly_task`."""
        with _settings_of_workers():
            try:
                return self._pool.submit(fly_task, *arguments)
            except BrokenProcessPool:
                self._pool = self._make_pool()
                return self._pool.submit(fly_task, *arguments)

    def result(self, task: _Task) -> list[Row | Draw]:
        """Return the result of a finished task, or raise its exception."""
        try:
            return task.result()
        except BrokenProcessPool as error:
            raise WorkerDeath from error

    def close(self) -> None:
        """End the processes, but no other child of this process."""
        for process in self._context.made:
            if process.is_alive():
                process.kill()
        self._pool.shutdown(cancel_futures=True)


@contextmanager
def _settings_of_workers() -> Iterator[None]:
    """Limit processes started here to one thread and block Ctrl-C, after which they are ended."""
    before = {name: os.environ[name] for name in _THREAD_COUNT_VARIABLES if name in os.environ}
    os.environ.update(dict.fromkeys(_THREAD_COUNT_VARIABLES, "1"))
    # The resource tracker would unblock the signal when it starts.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name in _THREAD_COUNT_VARIABLES:
            del os.environ[name]
        os.environ.update(before)


def _end_with_campaign() -> None:
    Thread(target=end_with_parent, daemon=True).start()


class DaskWorkers:
    """Workers of a dask.distributed scheduler.

    A scheduler runs code from anyone who can reach its port: protect it with a private network or
    TLS.

    Parameters
    ----------
    client
        A client of dask.distributed.
    """

    tasks_per_worker = 2  # The running task, and one that can follow without a round trip.

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False, retries=0)
        self._checked: set[str] = set()
        self._empty_since = math.inf
        """Monotonic time at which the scheduler lost its last worker; infinite if it has a
        worker."""

    def count(self) -> int:
        """Return the number of workers, at least 1 because workers may join later.

        Raises
        ------
        SpaceRobotError
            The scheduler is no longer available, or a worker does not have this package.
        """
        try:
            if self._client.status != "running":
                raise _lost_scheduler_error()
            threads = self._client.nthreads()
            self._require_package(threads)
        except (OSError, AttributeError) as error:  # The client has not noticed it yet.
            raise _lost_scheduler_error() from error
        workers = sum(threads.values())
        now = time.monotonic()
        self._empty_since = math.inf if workers else min(self._empty_since, now)
        if now - self._empty_since > _NO_WORKER_WARNING_DELAY:
            warn_once("The scheduler has no workers: the flights are waiting for a worker.")
        return max(1, workers)

    def submit(self, *arguments: Any) -> _Task:
        """Queue a task; the arguments are those of :func:`fly_task`."""
        return self._executor.submit(fly_task, *arguments)

    def result(self, task: _Task) -> list[Row | Draw]:
        """Return the result of a finished task.

        Raises
        ------
        WorkerDeath
            The worker died.
        SpaceRobotError
            The scheduler is no longer available, or cannot load the task.
        """
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

        try:
            return task.result()
        except KilledWorker as error:
            raise WorkerDeath from error
        except (CancelledError, CommClosedError) as error:
            raise _lost_scheduler_error() from error
        except (ImportError, RuntimeError) as error:
            # dask.distributed raises these for a task that cannot be loaded.
            if isinstance(error, RuntimeError) and "deserialization" not in str(error):
                raise
            raise SpaceRobotError(
                "The scheduler or a worker cannot load the task "
                f"({str(error).splitlines()[0]}): the scheduler and all workers require "
                f"spacerobot_ros[campaign] {__version__}."
            ) from error

    def _require_package(self, workers: Iterable[str]) -> None:
        """Refuse workers without this package, which would end when they receive a task."""
        joined = [address for address in workers if address not in self._checked]
        if not joined:
            return
        # A function of the standard library, which every worker can load.
        found = self._client.run(find_spec, _PACKAGE_NAME, workers=joined, on_error="return")
        for address, spec in found.items():
            if spec is None:
                raise SpaceRobotError(
                    f"The worker at {address} does not have {_PACKAGE_NAME}: install it there."
                )
            if not isinstance(spec, Exception):  # The worker may have left again.
                self._checked.add(address)


def _lost_scheduler_error() -> SpaceRobotError:
    return SpaceRobotError(
        "The scheduler is gone. Finished flights are kept; repeat the command to continue."
    )


Workers = LocalWorkers | DaskWorkers


@contextmanager
def open_workers(flights: int, workers: int, scheduler: str = "") -> Iterator[Workers]:
    """Yield ``workers`` processes on this machine, at most one per flight, or the workers of a
    dask.distributed ``scheduler``.

    Raises
    ------
    SpaceRobotError
        dask.distributed is not installed, or there is no scheduler at the address.
    """
    if not scheduler:
        local = LocalWorkers(min(workers, max(1, flights)))
        try:
            yield local
        finally:
            local.close()
        return
    require_module("distributed")
    import dask
    from distributed import Client

    # Worker deaths are counted here.
    settings = {
        "distributed.scheduler.allowed-failures": 0,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.admin.tick.limit": "1h",
    }
    # The errors below replace its tracebacks.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    with dask.config.set(settings):
        try:
            client = Client(scheduler, timeout="20s")
        except (OSError, TimeoutError, ValueError) as error:
            raise SpaceRobotError(f"There is no scheduler at {scheduler}: {error}.") from error
        with client:
            yield DaskWorkers(client)


# -- distribution -----------------------------------------------------------------------------


@dataclass(frozen=True)
class _SubmittedTask:
    """Draws of a task that a worker is flying, the engine name, and whether the task is a single
    flight, repeated alone after the death of a worker.
    """

    draws: list[Draw]
    engine: str
    runs_alone: bool


class TaskDistributor:
    """Distributes draws to workers.

    The fallbacks of an engine are passed to engine ``flights``, in tasks with fewer flights.

    If a worker dies, each flight in its lost tasks is repeated alone, while no other task runs.
    If a worker dies again, the flight that it was flying is the cause and is reported.

    Parameters
    ----------
    workers
        The workers.
    campaign, draws, engine
        The campaign, its draws, and the engine name.
    stopped
        Function that returns whether to stop; it is called a few times per second.
    """

    def __init__(
        self,
        workers: Workers,
        campaign: Campaign,
        draws: Draws,
        engine: str,
        stopped: Callable[[], bool],
    ) -> None:
        self._workers, self._packed = workers, serialise_campaign(campaign)
        self._draws, self._engine, self._stopped = draws, engine, stopped
        self._sizes = {
            name: float(max(_MIN_FIRST_TASK_FLIGHTS, engine_by_name(name).efficient_flights))
            for name in (engine, FLIGHTS)
        }
        """Number of flights per task, by engine."""
        self._fallbacks: deque[Draw] = deque()
        """Draws that the engine has passed on to engine ``flights``."""
        self._running: dict[_Task, _SubmittedTask] = {}
        self._retry_alone: deque[Draw] = deque()
        """Draws in tasks whose worker has died."""

    def rows(self, numbers: list[int]) -> Iterator[list[Row]]:
        """Yield the rows of draws as their tasks finish; empty lists while none finishes."""
        waiting = deque(numbers)
        queues = waiting, self._fallbacks, self._retry_alone, self._running
        while any(queues) and not self._stopped():
            self._submit_tasks(waiting)
            yield from self._finished_rows(_POLL_PERIOD) or [[]]
        # Tasks that have finished since.
        yield from self._finished_rows(0.0)
        for task in self._running:
            task.cancel()

    def _finished_rows(self, patience: float) -> list[list[Row]]:
        """Return the rows of each finished task, after at most ``patience`` s of wall time."""
        finished = wait(self._running, patience, FIRST_COMPLETED).done
        return [self._collect_rows(task) for task in finished]

    def _submit_tasks(self, waiting: deque[int]) -> None:
        workers = self._workers.count()
        most = workers * self._workers.tasks_per_worker
        if self._retry_alone and not self._running:
            self._submit_task([self._retry_alone.popleft()], self._engine, alone=True)
        alone = self._retry_alone or any(task.runs_alone for task in self._running.values())
        while not alone and (self._fallbacks or waiting) and len(self._running) < most:
            engine = FLIGHTS if self._fallbacks else self._engine
            left = len(self._fallbacks or waiting)
            # The last tasks are smaller, so that all workers finish at about the same time.
            share = max(engine_by_name(engine).efficient_flights, left / workers)
            count = min(left, max(1, round(min(self._sizes[engine], share))))
            if self._fallbacks:
                draws = [self._fallbacks.popleft() for _ in range(count)]
            else:
                draws = [self._draws[waiting.popleft()] for _ in range(count)]
            self._submit_task(draws, engine)

    def _submit_task(self, draws: list[Draw], engine: str, *, alone: bool = False) -> None:
        task = self._workers.submit(self._packed, this_code(), draws, engine, alone)
        self._running[task] = _SubmittedTask(draws, engine, alone)

    def _collect_rows(self, ended: _Task) -> list[Row]:
        """Return the rows of a task; if its worker died, that of a flight that was alone. The
        flights of other tasks are then repeated one at a time."""
        task = self._running.pop(ended)
        try:
            made = self._workers.result(ended)
        except WorkerDeath:
            if not task.runs_alone:
                self._retry_alone += task.draws
                return []
            draw = replace(task.draws[0], fallback="")
            return [Row(draw, KILLED, "Its process died 2 times.", engine=self._engine)]
        rows = [each for each in made if isinstance(each, Row)]
        self._fallbacks += (each for each in made if isinstance(each, Draw))
        if not task.runs_alone and rows:
            took = sum(row.wall_time for row in rows if not math.isnan(row.wall_time))
            if took > 0:
                size = 0.5 * self._sizes[task.engine] + 0.5 * len(rows) * TARGET_TASK_TIME / took
                least = engine_by_name(task.engine).efficient_flights
                self._sizes[task.engine] = max(least, min(_MAX_TASK_FLIGHTS, size))
        return rows
