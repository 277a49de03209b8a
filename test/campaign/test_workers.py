"""Workers of a campaign by stand-ins: processes of this machine, and those of a scheduler."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from support.campaigns import campaign

from spacerobot_ros import termination
from spacerobot_ros.campaign import workers as module
from spacerobot_ros.campaign.draws import Draw, Draws
from spacerobot_ros.campaign.rows import Fallback, Row
from spacerobot_ros.campaign.workers import (
    Cluster,
    DaskWorkers,
    LocalWorkers,
    TaskDistributor,
    WorkerDeath,
    fly_task,
    open_workers,
)
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.version import __version__

workers: Any = module
GONE = "The scheduler is gone. Finished flights are kept: the same command goes on from there."


class Process:
    """A process that is not started."""

    def __init__(self, number: int = 0) -> None:
        self.pid, self.calls = number, list[str]()
        self.alive = True

    def is_alive(self) -> bool:
        return self.alive

    def start(self) -> None:
        self.calls.append("start")

    def kill(self) -> None:
        self.calls.append("kill")

    def join(self) -> None:
        self.calls.append("join")


class Pipe:
    """An end of a pipe, with the answers that come through it."""

    def __init__(self, *answers: Any) -> None:
        self.answers, self.sent = list(answers), list[Any]()
        self.closed = False

    def send(self, content: Any) -> None:
        if self.closed:
            raise BrokenPipeError
        self.sent.append(content)

    def recv(self) -> Any:
        if not self.answers:
            raise EOFError
        return self.answers.pop(0)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the workers that are made, none of which is a process."""
    found: list[Any] = []

    class Worker:
        def __init__(self) -> None:
            self.process, self.connection, self.busy = Process(len(found)), Pipe(), False
            self.closed = False
            found.append(self)

        def close(self) -> None:
            self.closed = True

    monkeypatch.setattr(workers, "_LocalWorker", Worker)
    return found


# -- processes of this machine --------------------------------------------------------------------


def test_a_task_goes_to_the_first_idle_worker(made: list[Any]) -> None:
    local: Any = LocalWorkers(3)
    assert local.count() == len(made) == 3
    first, second = local.submit("a", 1), local.submit("b")
    assert [first, second] == made[:2]
    assert [worker.busy for worker in made] == [True, True, False]
    assert [worker.connection.sent for worker in made] == [[("a", 1)], [("b",)], []]
    made[0].connection.answers.append([1, 2])
    assert local.result(made[0]) == [1, 2]
    assert [worker.busy for worker in made] == [False, True, False]
    assert local.submit("c") is made[0]
    local.close()
    assert [worker.closed for worker in made] == [True] * 3


def test_a_worker_that_is_dead_is_replaced_before_its_next_task(made: list[Any]) -> None:
    local: Any = LocalWorkers(2)
    local.submit("a")
    made[1].process.alive = False
    assert local.submit("b") is made[2]
    assert (made[1].closed, made[0].closed, made[2].closed) == (True, False, False)
    assert made[2].connection.sent == [("b",)]
    # One that dies while it is given a task says so by the end of its pipe.
    made[0].busy = False
    made[0].connection.closed = True
    assert local.submit("c") is made[0]
    with pytest.raises(WorkerDeath):
        local.result(made[0])
    assert made[0].process.calls == ["join"]
    assert not made[0].busy


def test_an_error_of_a_task_is_raised_here(made: list[Any]) -> None:
    local: Any = LocalWorkers(1)
    made[0].connection.answers.append(SpaceRobotError("No."))
    with pytest.raises(SpaceRobotError, match=r"No\."):
        local.result(local.submit("a"))


def test_tasks_whose_pipes_are_ready_have_ended(
    made: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    local: Any = LocalWorkers(3)
    monkeypatch.setattr(workers, "wait", lambda pipes, timeout: pipes[1:])
    assert local.ended(made) == made[1:]


def test_a_worker_starts_with_one_thread_and_without_ctrl_c(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    process, pipes, masks = Process(), [Pipe(), Pipe()], list[Any]()
    seen: dict[str, str | None] = {}

    def started() -> None:
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        seen.update({name: os.environ.get(name) for name in names})

    process.start = started  # type: ignore[method-assign]
    asked: list[Any] = []

    def make(**given: Any) -> Process:
        asked.append(given)
        return process

    context = SimpleNamespace(Pipe=lambda: pipes, Process=make)
    monkeypatch.setattr(workers.multiprocessing, "get_context", {"spawn": context}.__getitem__)
    monkeypatch.setattr(workers.resource_tracker, "ensure_running", lambda: masks.append("tracker"))

    def masked(*mask: Any) -> str:
        masks.append(mask)
        return "before"

    monkeypatch.setattr(workers.signal, "pthread_sigmask", masked)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    worker = workers._LocalWorker()
    assert asked == [{"target": workers._run_worker, "args": (pipes[1],), "daemon": True}]
    assert seen == {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ
    signals = workers.signal
    block = (signals.SIG_BLOCK, {signals.SIGINT})
    assert masks == ["tracker", block, (signals.SIG_SETMASK, "before")]
    assert (worker.busy, pipes[0].closed, pipes[1].closed) == (False, False, True)
    worker.close()
    assert process.calls == ["kill", "join"]
    assert pipes[0].closed


def test_a_worker_answers_until_its_pipe_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[Any] = []

    def thread(**given: Any) -> Any:
        threads.append(given)
        return SimpleNamespace(start=lambda: threads.append("started"))

    def fly(*arguments: Any) -> list[Any]:
        if arguments == ("bad",):
            raise ValueError("no")
        return [arguments]

    monkeypatch.setattr(workers, "Thread", thread)
    monkeypatch.setattr(workers, "fly_task", fly)
    pipe: Any = Pipe(("a", 1), ("bad",), ("b",))
    workers._run_worker(pipe)
    one, error, two = pipe.sent
    assert (one, two) == ([("a", 1)], [("b",)])
    assert isinstance(error, ValueError)
    assert threads == [{"target": termination.end_with_parent, "daemon": True}, "started"]


def test_a_worker_ends_with_its_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    parent, codes = Process(), list[int]()
    monkeypatch.setattr("multiprocessing.parent_process", lambda: parent)
    monkeypatch.setattr(os, "_exit", codes.append)
    termination.end_with_parent()
    assert (parent.calls, codes) == (["join"], [1])


# -- workers of a scheduler -----------------------------------------------------------------------


class Client:
    """A client of a scheduler with some workers, by address; those named have no package."""

    def __init__(self, threads: dict[str, int], without: tuple[str, ...] = ()) -> None:
        self.threads, self.without, self.status = threads, without, "running"
        self.asked: list[Any] = []

    def nthreads(self) -> dict[str, int]:
        return self.threads

    def run(self, function: Any, name: str, workers: list[str], on_error: str) -> dict[str, Any]:
        assert (name, on_error) == ("spacerobot_ros", "return")
        assert function(name) is not None
        self.asked.append(workers)
        gone = OSError("gone")
        return {
            each: None if each in self.without else gone if each == "leaving" else "spec"
            for each in workers
        }

    def submit(self, *given: Any, **options: Any) -> Any:
        return given, options

    def cancel(self, tasks: list[Any], force: bool) -> None:
        self.asked.append((tasks, force))


def test_workers_of_a_scheduler_are_counted_and_asked_once() -> None:
    client = Client({"a": 2, "b": 3})
    dask: Any = DaskWorkers(client)
    assert dask.count() == 5
    assert dask.count() == 5
    client.threads = {"a": 2, "c": 4, "leaving": 1}
    assert dask.count() == 7
    assert dask.count() == 7
    # Of one that could not answer nothing is known yet.
    assert client.asked == [["a", "b"], ["c", "leaving"], ["leaving"]]
    assert dask.submit(1, 2) == ((fly_task, 1, 2), {"pure": False, "retries": 0})
    dask.cancel(["task"])
    assert client.asked[-1] == (["task"], True)
    assert (DaskWorkers.tasks_per_worker, LocalWorkers.tasks_per_worker) == (2, 1)


def test_a_worker_of_a_scheduler_without_the_package_is_refused() -> None:
    dask: Any = DaskWorkers(Client({"a": 1, "b": 1}, without=("b",)))
    with pytest.raises(SpaceRobotError) as refused:
        dask.count()
    assert str(refused.value) == "The worker at b has no spacerobot_ros: install it there."


def test_a_scheduler_without_workers_is_said_after_five_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[str] = []
    now = [100.0]
    monkeypatch.setattr(workers.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(workers, "warn_once", said.append)
    client = Client({})
    dask: Any = DaskWorkers(client)
    for time, threads, count in (
        *((100.0, 0, 0), (105.0, 0, 0), (105.5, 0, 1)),
        *((106.0, 1, 1), (110.0, 0, 1), (114.5, 0, 1), (115.25, 0, 2)),
    ):
        now[0], client.threads = time, {"a": 3} if threads else {}
        assert dask.count() == (3 if threads else 1)
        assert len(said) == count, time
    assert set(said) == {"The scheduler has no worker: the flights wait for one."}


def test_a_scheduler_that_is_gone_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    client = Client({"a": 1})
    client.status = "closed"
    with pytest.raises(SpaceRobotError) as gone:
        DaskWorkers(client).count()
    assert str(gone.value) == GONE
    for error in (OSError(), AttributeError()):
        client = Client({"a": 1})
        monkeypatch.setattr(client, "nthreads", lambda error=error: (_ for _ in ()).throw(error))
        with pytest.raises(SpaceRobotError, match="The scheduler is gone"):
            DaskWorkers(client).count()


class KilledWorker(Exception):  # noqa: N818
    """Stands for the error of dask.distributed."""


@pytest.fixture
def distributed(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a module that stands for dask.distributed."""
    module: Any = ModuleType("distributed")
    module.scheduler = ModuleType("distributed.scheduler")
    module.scheduler.KilledWorker = KilledWorker
    monkeypatch.setitem(sys.modules, "distributed", module)
    monkeypatch.setitem(sys.modules, "distributed.scheduler", module.scheduler)
    return module


def raising(error: Exception) -> Any:
    def raises(*given: Any, **options: Any) -> Any:
        raise error

    return raises


def test_tasks_of_a_scheduler_that_are_done_have_ended(distributed: Any) -> None:
    asked: list[Any] = []
    distributed.wait = lambda tasks, **options: asked.append((tasks, options))
    tasks = [SimpleNamespace(done=lambda done=done: done) for done in (True, False, True)]
    dask: Any = DaskWorkers(Client({}))
    assert dask.ended(tasks) == [tasks[0], tasks[2]]
    assert asked == [(tasks, {"timeout": 0.2, "return_when": "FIRST_COMPLETED"})]
    distributed.wait = raising(TimeoutError())
    assert dask.ended(tasks) == []
    distributed.wait = raising(CancelledError())
    with pytest.raises(SpaceRobotError, match="The scheduler is gone"):
        dask.ended(tasks)


@pytest.mark.usefixtures("distributed")
@pytest.mark.parametrize(
    ("error", "kind", "sentence"),
    [
        (KilledWorker(), WorkerDeath, ""),
        (CancelledError(), SpaceRobotError, GONE),
        (RuntimeError("of a flight"), RuntimeError, "of a flight"),
        *(
            (
                error,
                SpaceRobotError,
                f"The scheduler or a worker cannot load the task ({error.args[0].splitlines()[0]}):"
                f" all of them need spacerobot_ros[campaign] {__version__}.",
            )
            for error in (
                ImportError("No module named x\nat all"),
                RuntimeError("Error during deserialization of the task\nmore"),
            )
        ),
    ],
)
def test_what_became_of_a_task_of_a_scheduler(
    error: Exception, kind: type[Exception], sentence: str
) -> None:
    dask: Any = DaskWorkers(Client({}))
    with pytest.raises(kind) as raised:
        dask.result(SimpleNamespace(result=raising(error)))
    assert type(raised.value) is kind
    assert str(raised.value) == sentence
    assert dask.result(SimpleNamespace(result=lambda: [1])) == [1]


@pytest.mark.parametrize(
    ("wanted", "flights", "count"), [(3, 8, 3), (3, 2, 2), (3, 3, 3), (2, 0, 1)]
)
def test_there_are_no_more_workers_than_flights(
    wanted: int, flights: int, count: int, made: list[Any]
) -> None:
    with open_workers(Cluster(workers=wanted), flights) as opened:
        assert isinstance(opened, LocalWorkers)
        assert opened.count() == count
    assert all(worker.closed for worker in made)


def test_a_scheduler_is_opened_with_its_settings(
    distributed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: dict[str, Any] = {}

    @contextmanager
    def settings(given: dict[str, Any]) -> Iterator[None]:
        found["settings"] = given
        yield
        found["closed"] = True

    class OpenClient:
        def __init__(self, address: str, timeout: str) -> None:
            found["client"] = address, timeout
            if address == "nowhere":
                raise OSError("refused")

        def __enter__(self) -> None:
            found["entered"] = True

        def __exit__(self, *of: object) -> None:
            found["left"] = True

    distributed.Client = OpenClient
    dask: Any = ModuleType("dask")
    dask.config = SimpleNamespace(set=settings)
    monkeypatch.setitem(sys.modules, "dask", dask)
    with open_workers(Cluster(scheduler="tcp://here:1"), 5) as opened:
        assert isinstance(opened, DaskWorkers)
        assert found == {
            "settings": {
                "distributed.scheduler.allowed-failures": 0,
                "distributed.scheduler.worker-saturation": 1.0,
                "distributed.admin.tick.limit": "1h",
            },
            "client": ("tcp://here:1", "20s"),
            "entered": True,
        }
    assert found["left"]
    assert found["closed"]
    with (
        pytest.raises(SpaceRobotError) as refused,
        open_workers(Cluster(scheduler="nowhere"), 5),
    ):
        pass
    assert str(refused.value) == "There is no scheduler at nowhere: refused."


# -- distribution ---------------------------------------------------------------------------------


class Queue:
    """Workers whose tasks end when a test says so."""

    def __init__(self, count: int, tasks_per_worker: int) -> None:
        self._count, self.tasks_per_worker = count, tasks_per_worker
        self.open: list[tuple[list[int], str, bool]] = []
        self.answers: dict[int, Any] = {}
        self.cancelled: list[Any] = []

    def count(self) -> int:
        return self._count

    def submit(
        self, packed: bytes, version: str, draws: list[Draw], engine: str, alone: bool
    ) -> int:
        assert version == __version__
        self.open.append(([draw.number for draw in draws], engine, alone))
        return len(self.open) - 1

    def ended(self, tasks: list[int]) -> list[int]:
        return [task for task in tasks if task in self.answers]

    def result(self, task: int) -> Any:
        answer = self.answers[task]
        if isinstance(answer, Exception):
            raise answer
        return answer

    def cancel(self, tasks: list[int]) -> None:
        self.cancelled += tasks


def test_workers_have_as_many_tasks_as_they_take_and_deaths_are_flown_one_at_a_time() -> None:
    made, stopped = campaign(flights=40), [False]
    draws, queue = Draws(made), Queue(2, 2)
    tasks = TaskDistributor(queue, made, draws, "flights", lambda: stopped[0])  # type: ignore[arg-type]
    found = tasks.rows(list(range(40)))
    assert next(found) == []  # Nothing has ended yet.
    assert queue.open == [
        (list(range(first, first + 4)), "flights", False) for first in (0, 4, 8, 12)
    ]
    queue.answers[1] = WorkerDeath()
    assert next(found) == []
    assert next(found) == []
    # One of the four is flown alone, and nothing beside it takes its place.
    assert queue.open[4:] == [([4], "flights", True)]
    row = Row(draws[4], "reached", ".", wall_time=0.5)
    queue.answers[4] = [row]
    assert next(found) == [row]
    next(found)
    assert queue.open[5:] == [([5], "flights", True)]
    queue.answers[5] = WorkerDeath()
    (killed,) = next(found)
    assert (killed.draw.number, killed.outcome, killed.engine) == (5, "killed", "flights")
    assert killed.reason == "The process that flew it died 2 times."
    next(found)
    assert queue.open[6:] == [([6], "flights", True)]
    stopped[0] = True
    assert list(found) == []
    assert queue.cancelled == [0, 2, 3, 6]


def test_fallbacks_go_before_what_waits_and_keep_their_reasons() -> None:
    made = campaign(flights=200)
    draws, queue = Draws(made), Queue(1, 1)
    tasks = TaskDistributor(queue, made, draws, "lanes", lambda: False)  # type: ignore[arg-type]
    found = tasks.rows(list(range(200)))
    next(found)
    assert queue.open == [(list(range(64)), "lanes", False)]
    flown = [Row(draws[n], "reached", ".", engine="lanes", wall_time=0.25) for n in range(62)]
    queue.answers[0] = [*flown, *(Fallback(draws[n], f"reason {n}") for n in (62, 63))]
    assert next(found) == flown
    next(found)
    assert queue.open[1:] == [([62, 63], "flights", False)]
    rows = [Row(draws[n], "failed", ".", engine="flights", wall_time=0.5) for n in (62, 63)]
    queue.answers[1] = rows
    assert [(row.draw.number, row.fallback) for row in next(found)] == [
        (62, "reason 62"),
        (63, "reason 63"),
    ]
    next(found)
    # 62 flights took 15.5 s: 8 of them would take two, and 64 are the fewest that lanes want.
    assert queue.open[2:] == [(list(range(64, 128)), "lanes", False)]
