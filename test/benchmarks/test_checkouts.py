"""Measurements of two checkouts in turns, with a stand-in for either."""

from __future__ import annotations

from pathlib import Path

import pytest

from spacerobot_ros.benchmarks import checkouts
from spacerobot_ros.benchmarks.checkouts import Checkout, compare
from spacerobot_ros.benchmarks.measurements import tick_times
from spacerobot_ros.errors import ParameterError, SpaceRobotError

MEASUREMENT = """
import json, sys
from pathlib import Path

import spacerobot_ros

log = Path({log!r})
log.open("a").write({name!r})
count = log.read_text().count({name!r})
assert Path(spacerobot_ros.__file__).parents[1].name == {name!r}
figures = {{"tick_us": {values}[count - 1], "compiler": "cc", **{own}}}
Path(sys.argv[-1]).write_text(json.dumps(figures))
"""


def checkout(folder: Path, name: str) -> Path:
    """Return a checkout with an empty package."""
    (folder / name / "spacerobot_ros").mkdir(parents=True)
    (folder / name / "spacerobot_ros" / "__init__.py").touch()
    return folder / name


def test_medians_of_common_figures_measured_in_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = {
        "a": ([100.0, 130.0, 110.0], {"new_us": 3.0, "zero": 0.0}),
        "b": ([99.0, 121.0, 300.0], {"old_us": 3.0, "zero": 1.0}),
    }
    folders = [checkout(tmp_path, name) for name in figures]

    def measured(there: Checkout) -> dict[str, float]:
        name = there.folder.name
        values, own = figures[name]
        log = str(tmp_path / "log")
        code = MEASUREMENT.format(values=values, log=log, name=name, own=own)
        result: dict[str, float] = there.run(["-c", code])
        return result

    pair = (Checkout(folders[0]), Checkout(folders[1]))
    monkeypatch.setattr(checkouts.Checkout, "pair", classmethod(lambda cls, other: pair))
    lines: list[str] = []
    found = compare(folders[1], measured, lines.append, 3)
    assert (tmp_path / "log").read_text() == "abbaab"
    assert lines[-1].split() == ["tick_us", "110", "121", "1.100"]
    assert found["there_to_here"] == {"tick_us": pytest.approx(1.1)}
    assert found["here"] == {"tick_us": 110.0, "new_us": 3.0, "zero": 0.0}


def test_this_checkout_is_the_one_that_runs() -> None:
    root = Path(__file__).parents[2]
    ours, other = Checkout.pair(root)
    assert ours == other == Checkout(root)


def test_a_folder_without_a_checkout_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="There is no checkout in"):
        compare(tmp_path, lambda there: {}, print, 1)


@pytest.mark.parametrize("forbidden", ["1", None])
def test_a_measurement_has_a_cache_and_byte_code_of_its_own(
    forbidden: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The byte code of the measured package is there after one process, also where it is not to be
    written.
    """
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
    if forbidden is not None:
        monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", forbidden)
    folder, program = checkout(tmp_path, "a"), tmp_path / "measurements.py"
    program.write_text(
        "import json, os, sys\nimport spacerobot_ros\n"
        "found = [*sys.argv[1:3], os.environ['SPACEROBOT_CACHE_DIR']]\n"
        "open(sys.argv[-1], 'w').write(json.dumps(found))"
    )
    monkeypatch.setattr("spacerobot_ros.benchmarks.measurements.__file__", str(program))
    code = tmp_path / "code"
    found = Checkout(folder).measure("first_plan", cache="/there", byte_code=str(code), urdf="x")
    assert found == ["first_plan", '{"urdf": "x"}', "/there"]
    assert [each.name.split(".")[0] for each in code.rglob("spacerobot_ros/*.pyc")] == ["__init__"]


def test_a_measurement_that_fails_is_one_sentence(tmp_path: Path) -> None:
    empty = Checkout(checkout(tmp_path, "c"))
    with pytest.raises(SpaceRobotError, match=r"The benchmark of .* failed: Module") as caught:
        empty.measure("tick_times", ticks=100)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_ticks_and_plans_have_cpu_times(ros_domain: int) -> None:
    found = Checkout.pair(None)[0].measure("tick_times", ticks=400)
    names = {"stack_us", "controlled_stack_us", "servicer_stack_us"}
    names |= {"loop_us", "controlled_loop_us", "import_plant_ms"}
    plans = {f"plan_{name}_ms" for name in ("lie_bracket", "area_loop", "square_path", "optimal")}
    assert found.keys() == names | plans
    assert tick_times.__doc__ is not None
    assert all(name in tick_times.__doc__ for name in names)
    assert all(1.0 < value < 2000.0 for value in found.values()), found
    assert found["loop_us"] < found["stack_us"], "the recorder and messages are extra"
