"""Every argument and option of `spacerobot bench` reaches the benchmark that it is for."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import pytest
from support.command_line import CliRunner

from spacerobot_ros.benchmarks import checkouts
from spacerobot_ros.cli.main import main

OTHER = Path("other") / "checkout"

CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "ticks 1234": ("ticks.ticks_benchmark", "", {"ticks": 1234}),
    "real-time 7.5 --rate 30 --rate 12.5": (
        "real_time.real_time_benchmark",
        "",
        {"duration": 7.5, "rates": (30.0, 12.5)},
    ),
    "soak 11.5": ("soak.soak_benchmark", "", {"duration": 11.5}),
    "viewer 6.5 --no-priorities": (
        "real_time.viewer_benchmark",
        "",
        {"seconds": 6.5, "priorities": False},
    ),
    "viewer 5.5": ("real_time.viewer_benchmark", "", {"seconds": 5.5, "priorities": True}),
    f"planning 3 --long-search 17 --against {OTHER}": (
        "planning.planning_benchmark",
        "",
        {"goals": 3, "other": OTHER, "starts": 17},
    ),
    f"first-plans --against {OTHER}": (
        "planning.first_plan_benchmark",
        "",
        {"other": OTHER},
    ),
    f"refusals 4 --against {OTHER}": (
        "planning.refusals_benchmark",
        "",
        {"goals": 4, "other": OTHER},
    ),
    "campaign": ("engines.lanes_benchmark", "", {}),
    f"campaign 300 --against {OTHER} --rounds 4": (
        "checkouts.compare",
        "measure campaign_times {'flights': 300}",
        {"other": OTHER, "rounds": 4},
    ),
    "environments 48": ("engines.environments_benchmark", "", {"lanes": 48}),
    f"ticks 222 --against {OTHER} --rounds 3": (
        "checkouts.compare",
        "measure tick_times {'ticks': 222}",
        {"other": OTHER, "rounds": 3},
    ),
    f"real-time 8 --rate 40 --against {OTHER} --rounds 2": (
        "checkouts.compare",
        "run ['-m', 'spacerobot_ros', 'bench', 'real-time', '8.0', '--rate=40.0', '--json']",
        {"other": OTHER, "rounds": 2},
    ),
}
"""Command lines: the function that is called, what it measures in a checkout, its arguments."""


class Checkout:
    """A checkout that writes down what is to be measured in it."""

    def __init__(self) -> None:
        self.asked = ""

    def measure(self, name: str, **arguments: Any) -> None:
        self.asked = f"measure {name} {arguments}"

    def run(self, words: list[str]) -> None:
        self.asked = f"run {words}"


def recorded(function: Callable[..., Any], calls: list[Mapping[str, Any]]) -> Callable[..., Any]:
    """Return a function that writes down its arguments by the names that the function has."""

    def call(*arguments: Any, **named: Any) -> dict[str, Any]:
        bound = inspect.signature(function).bind(*arguments, **named)
        calls.append(dict(bound.arguments))
        return {"flat": True, "measured": len(calls)}

    return call


@pytest.mark.parametrize("line", CASES)
def test_options_reach_the_benchmark(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, measured, expected = CASES[line]
    module_name, _, function_name = name.partition(".")
    module = import_module(f"spacerobot_ros.benchmarks.{module_name}")
    calls: list[Mapping[str, Any]] = []
    monkeypatch.setattr(module, function_name, recorded(getattr(module, function_name), calls))
    file = tmp_path / "figures.json"
    result = CliRunner().invoke(main, ["bench", *line.split(), "--json", str(file)])
    assert result.exit_code == 0, result.output
    (call,) = calls
    assert json.loads(file.read_text()) == {"flat": True, "measured": 1}
    found = {key: value for key, value in call.items() if key not in ("show", "measure")}
    if name == "soak.soak_benchmark":
        assert found.pop("picture") == file.with_suffix(".png")
    assert dict(sorted(found.items())) == dict(sorted(expected.items()))
    if measured:
        checkout = Checkout()
        call["measure"](checkout)
        assert checkout.asked == measured


def test_every_command_of_the_group_is_tried() -> None:
    context = click.Context(main)
    group = main.get_command(context, "bench")
    assert isinstance(group, click.Group)
    assert {line.split()[0] for line in CASES} | {"report"} == set(group.commands)


def test_a_report_of_some_rows_is_measured_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = {"rows": 2500.0, "report_peak_MB": 456.7, "report_cpu_s": 12.34}
    asked: list[tuple[str, dict[str, Any]]] = []

    def measure(self: checkouts.Checkout, name: str, **arguments: Any) -> Any:
        asked.append((name, arguments))
        assert self == checkouts.Checkout.pair(None)[0]
        return figures

    monkeypatch.setattr(checkouts.Checkout, "measure", measure)
    file = tmp_path / "figures.json"
    result = CliRunner().invoke(main, ["bench", "report", "2300", "--json", str(file)])
    assert result.exit_code == 0
    assert result.output == "2500 flights: 457 MB at most, 12.3 s of CPU time\n"
    assert asked == [("report_figures", {"rows": 2300})]
    assert json.loads(file.read_text()) == figures
