"""Values that get lost between a user and their reader, for tests that have to notice it.

With ``SPACEROBOT_TEST_LOSS="option run --goal"`` a command ignores that option, in this process and
in programs that :class:`support.warm_python.WarmPython` runs: its default is taken. With
``"parameter recorder.compression"`` a node does so with a parameter. The table
``test/passage/lost_values.yaml`` names for each option and parameter a test that fails then.

With ``SPACEROBOT_TEST_USES=FILE`` the tests that give a value are written to that file. Run as a
module this finds tests for values that have none in the table, among the quick tests of some
folders or of all: ``PYTHONPATH=.:test python -m support.lost_values test/viewer``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import yaml

LOSS = "SPACEROBOT_TEST_LOSS"
USES = "SPACEROBOT_TEST_USES"

TESTS = Path(__file__).resolve().parents[1]
FILE = TESTS / "passage" / "lost_values.yaml"

_EXTREME_STARTS = 8
"""Tests that are tried for a value before it is left without one."""

_OF_OTHER_NODES = (
    *("plant.tf_period", "plant.tf_links", "coordinated_control.world_frame"),
    *(
        f"{n}.{p}"
        for n in ("planner", "coordinated_control")
        for p in ("stop_when_decided", "watchdog_timeout")
    ),
)
"""Parameters of nodes that fly, which no flight without ROS shows; the others: support.passage."""

_NODES = {
    "PlantConfig": "plant",
    "PlannerConfig": "planner",
    "ControllerConfig": "coordinated_control",
    "RecorderConfig": "recorder",
    "ReplayConfig": "replay",
    "ViewerConfig": "viewer",
}
"""Nodes by the names of their configurations."""

_COLUMNS = (
    *("flight", "seed", "passed", "outcome", "reason", "draw"),
    *("wall_time_s", "plan_time_s", "engine", "fallback", "versions"),
)
"""Columns of a campaign's dataset beside its metrics."""

_applied = False


def apply() -> None:
    """Lose the value that the environment names, and write down which values are given."""
    global _applied
    if _applied or not (os.environ.get(LOSS) or os.environ.get(USES)):
        return
    _applied = True
    _change_click()
    _change_parameters()
    _change_columns()


def _change_click() -> None:
    import click

    parse = click.Parameter.handle_parse_result

    def handle_parse_result(self: Any, ctx: click.Context, opts: Any, args: list[str]) -> Any:
        name = f"option {_option_name(ctx, self)}"
        if opts.get(self.name) is not None:
            _write_use(name)
            if os.environ.get(LOSS) == name:
                opts = {key: value for key, value in opts.items() if key != self.name}
        return parse(self, ctx, opts, args)

    click.Parameter.handle_parse_result = handle_parse_result  # type: ignore[method-assign]


def _option_name(ctx: Any, option: Any) -> str:
    words: list[str] = []
    while ctx is not None and type(ctx.command).__name__ != "CommandGroup":
        words.insert(0, str(ctx.command.name))
        ctx = ctx.parent
    return " ".join([*words, _display_name(option)])


def _display_name(option: Any) -> str:
    import click

    return option.opts[0] if isinstance(option, click.Option) else str(option.name).upper()


def _change_parameters() -> None:
    from spacerobot_ros import parameters

    reconfigure = parameters._reconfigured

    def reconfigured(config: Any, defaults: Any, values: Mapping[str, Any], prefix: str) -> Any:
        node = _NODES.get(type(config).__name__)
        if node and not prefix:
            usual = parameters.values_of(defaults)
            for name, value in values.items():
                if usual.get(name) != value:
                    _write_use(f"parameter {node}.{name}")
            lost = os.environ.get(LOSS, "")
            values = {k: v for k, v in values.items() if f"parameter {node}.{k}" != lost}
        return reconfigure(config, defaults, values, prefix)

    parameters._reconfigured = reconfigured


def _change_columns() -> None:
    from dataclasses import replace

    from spacerobot_ros import measures
    from spacerobot_ros.campaign import dataset

    lost = os.environ.get(LOSS, "")
    for name, metric in measures.METRICS.items():
        if lost == f"unit of column {name}":
            measures.METRICS[name] = replace(metric, unit="lost")
        evaluate = partial(_evaluate_metric, name, metric.evaluate)
        measures.METRICS[name] = replace(measures.METRICS[name], evaluate=evaluate)
    columns_of = dataset._columns_of_rows

    def columns_of_rows(rows: Any, names: Any) -> dict[str, list[Any]]:
        columns = columns_of(rows, names)
        for column, values in columns.items():
            name = column.partition(".")[0]
            _write_use(f"column {name}")
            if lost == f"column {name}" and name not in measures.METRICS:
                columns[column] = [_other_value(value) for value in values]
        return columns

    dataset._columns_of_rows = columns_of_rows


def _evaluate_metric(name: str, evaluate: Any, *arguments: Any) -> Any:
    _write_use(f"column {name}")
    value = evaluate(*arguments)
    return 2 * value + 1 if os.environ.get(LOSS) == f"column {name}" else value


def _other_value(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    return value + "lost" if isinstance(value, str) else value * 2 + 1


def _write_use(name: str) -> None:
    file, test = os.environ.get(USES), os.environ.get("PYTEST_CURRENT_TEST", "")
    if file and test:
        with open(file, "a") as uses:
            uses.write(f"{name}\t{test.rpartition(' ')[0]}\n")


def options() -> list[str]:
    """Return the names of all options and arguments of all commands: ``run --goal``."""
    import click

    from spacerobot_ros.cli.main import COMMANDS, main

    def walk(command: click.Command, words: tuple[str, ...]) -> Iterator[str]:
        if isinstance(command, click.Group):
            for name in command.commands:
                yield from walk(command.commands[name], (*words, name))
        for option in command.params:
            yield " ".join([*words, _display_name(option)])

    found: list[str] = []
    for name in COMMANDS:
        command = main.get_command(click.Context(main), name)
        assert command is not None
        found += walk(command, (name,))
    return found


def losses() -> list[str]:
    """Return every option of a command, and every parameter of a node that flies nothing."""
    from spacerobot_ros.bag.config import RecorderConfig, ReplayConfig
    from spacerobot_ros.measures import METRICS
    from spacerobot_ros.parameters import declared
    from spacerobot_ros.viewer.server import ViewerConfig

    nodes = {"recorder": RecorderConfig, "replay": ReplayConfig, "viewer": ViewerConfig}
    return [
        *(f"option {name}" for name in options()),
        *(f"parameter {n}.{each.name}" for n, kind in nodes.items() for each in declared(kind)),
        *(f"parameter {name}" for name in _OF_OTHER_NODES),
        *(f"column {name}" for name in (*_COLUMNS, *METRICS)),
        *(f"unit of column {name}" for name, metric in METRICS.items() if metric.unit),
    ]


def table() -> dict[str, str]:
    """Return the test that notices each loss."""
    return dict(yaml.safe_load(FILE.read_text("utf-8")) or {}) if FILE.exists() else {}


def notices(test: str, loss: str) -> bool:
    """Return whether a test fails when a value gets lost."""
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", ""]
    done = subprocess.run(
        [*words, f"test/{test}"],
        cwd=TESTS.parent,
        env=os.environ | {LOSS: loss},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode in (0, 1), done.stdout[-2000:] + done.stderr[-2000:]
    return done.returncode == 1


def _uses(folder: Path, paths: list[str]) -> dict[str, list[str]]:
    """Return the quick tests of some folders that give each value, by running all of them."""
    file = folder / "uses"
    words = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "no:cacheprovider", *paths]
    subprocess.run(words, cwd=TESTS.parent, env=os.environ | {USES: str(file)}, check=False)
    found: dict[str, list[str]] = {}
    for line in file.read_text().splitlines():
        loss, _, test = line.partition("\t")
        found.setdefault(loss, []).append(test.removeprefix("test/"))
    return found


def _shows_no_effect(test: str) -> bool:
    """Return whether a test is about input that is refused, of which nothing else follows."""
    return any(word in test for word in ("bad_", "refus", "wrong", "exit_2", "sentence"))


def main() -> None:
    """Find a test for each value that has none, among those that give it; some stay without."""
    entries = table()
    with tempfile.TemporaryDirectory() as folder:
        uses = _uses(Path(folder), sys.argv[1:])
    for loss in losses():
        if loss not in entries:
            used = uses.get(loss.removeprefix("unit of "), [])
            tests = sorted(dict.fromkeys(used), key=_shows_no_effect)
            found = next((test for test in tests[:_EXTREME_STARTS] if notices(test, loss)), "")
            if not found:
                continue
            entries[loss] = found
            print(loss, found, sep=": ", flush=True)
            FILE.write_text(yaml.safe_dump(entries, width=100), "utf-8")


if __name__ == "__main__":
    main()
