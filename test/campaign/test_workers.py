"""Workers of a campaign: what they are given, sizes of tasks, and campaigns that they fly."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import Future, wait
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.campaigns import campaign

from spacerobot_ros.campaign.config import parse_campaign
from spacerobot_ros.campaign.dataset import Dataset, Row
from spacerobot_ros.campaign.draws import Draw, Draws
from spacerobot_ros.campaign.running import run_campaign
from spacerobot_ros.campaign.workers import (
    TaskDistributor,
    WorkerDeath,
    open_workers,
    serialise_campaign,
    this_code,
)
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.errors import ParameterError, SpaceRobotError

DISPERSED = {"plant.sensors.position_noise": {"uniform": [0.0, 0.001]}}

# -- distribution ---------------------------------------------------------------------------------


class Queue:
    """Workers whose tasks end when a test says so."""

    def __init__(self, count: int, tasks_per_worker: int) -> None:
        self._count, self.tasks_per_worker = count, tasks_per_worker
        self.open: list[tuple[list[int], str, bool]] = []
        self.draws: list[list[Draw]] = []
        self.tasks: list[Future[Any]] = []

    def count(self) -> int:
        return self._count

    def submit(
        self, packed: bytes, version: str, draws: list[Draw], engine: str, alone: bool
    ) -> Future[Any]:
        assert version == this_code()
        self.open.append(([draw.number for draw in draws], engine, alone))
        self.draws.append(draws)
        self.tasks.append(Future())
        return self.tasks[-1]

    def answer(self, task: int, rows: Any) -> None:
        self.tasks[task].set_result(rows)

    def result(self, task: Future[Any]) -> Any:
        if isinstance(answer := task.result(), Exception):
            raise answer
        return answer

    @property
    def cancelled(self) -> list[int]:
        return [number for number, task in enumerate(self.tasks) if task.cancelled()]


def test_workers_have_as_many_tasks_as_they_take_and_deaths_are_flown_one_at_a_time() -> None:
    made, stopped = campaign(flights=40), [False]
    draws, queue = Draws(made), Queue(2, 2)
    tasks = TaskDistributor(queue, made, draws, "flights", lambda: stopped[0])  # type: ignore[arg-type]
    found = tasks.rows(list(range(40)))
    assert next(found) == []  # Nothing has ended yet.
    assert queue.open == [
        (list(range(first, first + 4)), "flights", False) for first in (0, 4, 8, 12)
    ]
    queue.answer(1, WorkerDeath())
    assert next(found) == []
    assert next(found) == []
    for task, numbers, _ in ((k, *queue.open[k][:2]) for k in (0, 2, 3)):
        rows = [Row(draws[n], "reached", ".", wall_time=0.5) for n in numbers]
        queue.answer(task, rows)
        assert next(found) == rows
    next(found)
    # The four are flown again, one at a time and with nothing beside them.
    assert queue.open[4:] == [([4], "flights", True)]
    row = Row(draws[4], "reached", ".", wall_time=0.5)
    queue.answer(4, [row])
    assert next(found) == [row]
    next(found)
    assert queue.open[5:] == [([5], "flights", True)]
    queue.answer(5, WorkerDeath())
    (killed,) = next(found)
    assert (killed.draw.number, killed.outcome, killed.engine) == (5, "killed", "flights")
    assert killed.reason == "Its process died 2 times."
    next(found)
    assert queue.open[6:] == [([6], "flights", True)]
    stopped[0] = True
    assert list(found) == []
    assert queue.cancelled == [6]


def test_rows_of_tasks_that_finish_before_a_stop_is_noticed_are_kept() -> None:
    made, stopped = campaign(flights=8), [False]
    draws, queue = Draws(made), Queue(2, 1)
    tasks = TaskDistributor(queue, made, draws, "flights", lambda: stopped[0])  # type: ignore[arg-type]
    found = tasks.rows(list(range(8)))
    assert next(found) == []
    queue.answer(1, [Row(draws[n], "reached", ".", wall_time=0.5) for n in queue.open[1][0]])
    stopped[0] = True
    assert list(found) == [queue.tasks[1].result()]
    assert queue.cancelled == [0]


def test_fallbacks_go_before_what_waits_and_keep_their_reasons() -> None:
    made = campaign(flights=200)
    draws, queue = Draws(made), Queue(1, 1)
    tasks = TaskDistributor(queue, made, draws, "lanes", lambda: False)  # type: ignore[arg-type]
    found = tasks.rows(list(range(200)))
    next(found)
    assert queue.open == [(list(range(64)), "lanes", False)]
    flown = [Row(draws[n], "reached", ".", engine="lanes", wall_time=0.25) for n in range(62)]
    left = [replace(draws[n], fallback=f"reason {n}") for n in (62, 63)]
    queue.answer(0, [*flown, *left])
    assert next(found) == flown
    next(found)
    assert queue.open[1:] == [([62, 63], "flights", False)]
    rows = [Row(draw, "failed", ".", engine="flights", wall_time=0.5) for draw in queue.draws[1]]
    queue.answer(1, rows)
    assert [(row.draw.number, row.draw.fallback) for row in next(found)] == [
        (62, "reason 62"),
        (63, "reason 63"),
    ]
    next(found)
    # 62 flights took 15.5 s: 8 of them would take two, and 64 are the fewest that lanes want.
    assert queue.open[2:] == [(list(range(64, 128)), "lanes", False)]


@pytest.mark.parametrize(
    ("flight_time", "sizes"),
    [
        # Of two seconds: half of the way from the last size to it, and small ones at the end.
        (0.25, [4, 4, 6, 7, 8, 8, 8, 8, 8, 8, 8, 8, 8, 4, 2, 1]),
        (1.0, [4, 4, 3, 2, 2, 2]),
    ],
)
def test_tasks_take_two_seconds(flight_time: float, sizes: list[int]) -> None:
    made = campaign(flights=100)
    draws, queue, flown = Draws(made), Queue(2, 1), list[int]()
    tasks = TaskDistributor(queue, made, draws, "flights", lambda: False)  # type: ignore[arg-type]
    for rows in tasks.rows(list(range(100))):
        flown += [row.draw.number for row in rows]
        task = sum(each.done() for each in queue.tasks)
        if task < len(queue.open):
            numbers = queue.open[task][0]
            done = [Row(draws[n], "reached", ".", wall_time=flight_time) for n in numbers]
            queue.answer(task, done)
    found = [len(numbers) for numbers, _, _ in queue.open]
    assert found[: len(sizes)] == sizes
    assert sorted(flown) == list(range(100))
    assert found[-1] == 1


# -- workers that fly ---------------------------------------------------------------------------


@pytest.fixture
def scheduler() -> Iterator[Any]:
    """Return a scheduler of dask.distributed in this process, and its one worker."""
    distributed = pytest.importorskip("distributed")
    given = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "protocol": "inproc"}
    with distributed.LocalCluster(**given, dashboard_address=":0") as cluster:
        yield cluster


def test_a_scheduler_flies_the_rows_of_this_process(scheduler: Any, tmp_path: Path) -> None:
    made = campaign(flights=2, engine="flights", disperse=DISPERSED)
    run_campaign(made, tmp_path / "here")
    run_campaign(made, tmp_path / "there", scheduler=scheduler.scheduler_address)
    here, there = (Dataset(tmp_path / name).table().sort_by("flight") for name in ("here", "there"))
    same = [name for name in here.column_names if not name.startswith(("wall_", "plan_"))]
    assert str(there.select(same).to_pylist()) == str(here.select(same).to_pylist())
    assert len(here) == 2


class OwnLaw(TransposedJacobianLaw):
    """A law that only this process knows."""

    name = "own"


def test_a_process_of_this_machine_flies_a_task_and_says_what_is_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = campaign(flights=2)
    packed, draws = serialise_campaign(made), list(Draws(made))
    with open_workers(1, workers=2) as workers:
        assert workers.count() == 1, "no more workers than flights"

        def answer(version: str, packed: bytes = packed) -> Any:
            task = workers.submit(packed, version, draws[1:], "flights", True)
            wait([task])
            return workers.result(task)

        (row,) = answer(this_code())
        assert (row.draw.number, row.outcome) == (1, "reached")
        with pytest.raises(SpaceRobotError, match="A worker has spacerobot_ros"):
            answer("0.0.0")
        monkeypatch.setitem(LAWS, "own", OwnLaw)
        section = {"scenario": "coordinated_control", "method": "own", "flights": 2}
        with pytest.raises(ParameterError, match=r"refuses .*'law' is 'own'.* SPACEROBOT_PLUGINS"):
            answer(this_code(), serialise_campaign(parse_campaign("own", section)))


def test_workers_that_are_ended_leave_other_children_of_the_process_alone() -> None:
    made, mine = campaign(flights=2), None
    try:
        with open_workers(1, workers=1) as workers:
            mine = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60.0,))
            mine.start()
            task = workers.submit(
                serialise_campaign(made), this_code(), list(Draws(made)), "flights", True
            )
            wait([task])
            workers_of_campaign = set(multiprocessing.active_children()) - {mine}
            assert len(workers_of_campaign) == 1
        assert mine.is_alive()
        for each in workers_of_campaign:
            each.join(60.0)
            assert not each.is_alive()
    finally:
        if mine is not None:
            mine.kill()
            mine.join()
