"""Benchmarks of two checkouts in turns, with a stand-in for either."""

from __future__ import annotations

from pathlib import Path

import pytest

from spacerobot_ros.benchmarks import against
from spacerobot_ros.benchmarks.against import Checkout, compare_checkouts
from spacerobot_ros.errors import ParameterError, SpaceRobotError

COMMAND = """
import json, sys
from pathlib import Path

VALUES = {values}

def start(prog_name):
    log = Path({log!r})
    log.open("a").write({name!r})
    count = log.read_text().count({name!r})
    assert sys.argv[1:3] == ["bench", "--ticks"], sys.argv
    target = sys.argv[sys.argv.index("--json") + 1]
    figures = {{"ticks_per_s": VALUES[count - 1], "compiler": "cc", **{own}}}
    Path(target).write_text(json.dumps(figures))
"""


def checkout(folder: Path, name: str, values: list[float], own: dict[str, float]) -> Path:
    """Return a checkout whose benchmark writes one value after the other."""
    (folder / name / f"package_{name}").mkdir(parents=True)
    code = COMMAND.format(values=values, log=str(folder / "log"), name=name, own=own)
    (folder / name / f"package_{name}" / "entry.py").write_text(code)
    (folder / name / "setup.py").write_text(
        f'entry_points={{"console_scripts": ["spacerobot = package_{name}.entry:start"]}}'
    )
    return folder / name


def test_medians_of_what_both_measure_in_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = checkout(tmp_path, "a", [100.0, 130.0, 110.0], {"new_us": 3.0, "zero": 1.0})
    other = checkout(tmp_path, "b", [90.0, 100.0, 300.0], {"old_us": 3.0, "zero": 0.0})
    monkeypatch.setattr(against.Checkout, "ours", classmethod(lambda cls: cls.at(ours)))
    lines: list[str] = []
    found = compare_checkouts(other, ["--ticks", "100"], lines.append, 3)
    assert (tmp_path / "log").read_text() == "abbaab"
    assert lines[-1].split() == ["ticks_per_s", "110", "100", "1.100"]
    assert found["ratio"] == {"ticks_per_s": pytest.approx(1.1)}
    assert found["here"] == {"ticks_per_s": 110.0, "new_us": 3.0, "zero": 1.0}


def test_this_checkout_is_the_one_that_runs() -> None:
    root = Path(__file__).parents[2]
    assert Checkout.ours() == Checkout.at(root)


@pytest.mark.parametrize(
    ("declaration", "sentence"),
    [(None, "has no setup.py"), ("setup()", "declares no command 'spacerobot'")],
)
def test_a_folder_without_a_checkout_is_refused(
    tmp_path: Path, declaration: str | None, sentence: str
) -> None:
    if declaration is not None:
        (tmp_path / "setup.py").write_text(declaration)
    with pytest.raises(ParameterError, match=sentence):
        compare_checkouts(tmp_path, [], print, 1)


def test_a_benchmark_that_fails_is_one_sentence(tmp_path: Path) -> None:
    broken = checkout(tmp_path, "c", [], {})
    with pytest.raises(SpaceRobotError, match=r"The benchmark of .* failed: IndexError") as caught:
        Checkout.at(broken).measure(["--ticks", "100"])
    assert "\n" not in str(caught.value)
