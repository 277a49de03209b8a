"""Tasks of workers by stand-ins for them: their sizes, what they pass on, and deaths."""

from __future__ import annotations

from typing import Any

import pytest
from support.campaigns import campaign

from spacerobot_ros.campaign.draws import Draw, Draws
from spacerobot_ros.campaign.rows import Fallback, Row
from spacerobot_ros.campaign.workers import TaskDistributor, WorkerDeath


class Workers:
    """Two workers, of which each task ends at once; a flight takes some wall time, s.

    Attributes
    ----------
    dealt
        Engine, number of flights and whether they are alone, of each task.
    """

    tasks_per_worker = 1

    def __init__(self, flight_time: float, deadly: set[int], passed_on: set[int]) -> None:
        self.flight_time, self.deadly, self.passed_on = flight_time, deadly, passed_on
        self.dealt: list[tuple[str, int, bool]] = []
        self.tasks: list[tuple[list[Draw], str]] = []

    def count(self) -> int:
        return 2

    def submit(
        self, packed: bytes, version: str, draws: list[Draw], engine: str, alone: bool
    ) -> int:
        self.dealt.append((engine, len(draws), alone))
        self.tasks.append((draws, engine))
        return len(self.tasks) - 1

    def ended(self, tasks: list[int]) -> list[int]:
        return tasks[:1]

    def result(self, task: int) -> list[Row | Fallback]:
        draws, engine = self.tasks[task]
        if self.deadly & {draw.number for draw in draws}:
            raise WorkerDeath
        wall = self.flight_time
        return [
            Fallback(draw, "needed corrections")
            if draw.number in self.passed_on and engine == "lanes"
            else Row(draw, "reached", ".", {}, True, engine, "", wall)
            for draw in draws
        ]


def distributed(
    engine: str, count: int, flight_time: float, deadly: tuple[int, ...] = (), **others: Any
) -> tuple[Workers, list[Row]]:
    made = campaign(flights=count)
    workers = Workers(flight_time, set(deadly), set(others.get("passed_on", ())))
    tasks = TaskDistributor(workers, made, Draws(made), engine, lambda: False)  # type: ignore[arg-type]
    return workers, [row for rows in tasks.rows(list(range(count))) for row in rows]


@pytest.mark.parametrize(
    ("flight_time", "sizes"),
    [
        # Of two seconds: half of the way from the last size to it, and small ones at the end.
        (0.25, [4, 4, 6, 7, 8, 8, 8, 8, 8, 8, 8, 8, 8, 4, 2, 1]),
        (1.0, [4, 4, 3, 2, 2, 2]),
    ],
)
def test_tasks_take_two_seconds(flight_time: float, sizes: list[int]) -> None:
    workers, rows = distributed("flights", 100, flight_time)
    found = [count for _, count, _ in workers.dealt]
    assert found[: len(sizes)] == sizes
    assert sorted(row.draw.number for row in rows) == list(range(100))
    assert sum(found) == 100
    assert found[-1] == 1


def test_what_an_engine_passes_on_is_flown_and_says_why() -> None:
    workers, rows = distributed("lanes", 40, 0.01, passed_on=(3, 17))
    assert {engine for engine, _, _ in workers.dealt} == {"lanes", "flights"}
    left = {row.draw.number: (row.engine, row.fallback) for row in rows if row.fallback}
    assert left == dict.fromkeys((3, 17), ("flights", "needed corrections"))
    assert len(rows) == 40


def test_a_flight_that_kills_two_workers_is_reported_and_the_others_are_flown() -> None:
    workers, rows = distributed("flights", 12, 0.25, deadly=(5,))
    killed = [row for row in rows if row.outcome == "killed"]
    assert [row.draw.number for row in killed] == [5]
    assert killed[0].reason == "The process that flew it died 2 times."
    assert killed[0].engine == "flights"
    assert len(rows) == 12
    assert sum(count for _, count, alone in workers.dealt if alone) >= 4
    assert {count for _, count, alone in workers.dealt if alone} == {1}
