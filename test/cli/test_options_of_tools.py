"""Options of `figures`, `export`, `verify` and `campaign` reach the functions behind."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from support.command_line import CliRunner, Result

import spacerobot_ros.bag
import spacerobot_ros.flight.verification as verification
import spacerobot_ros.report
import spacerobot_ros.session.viewing as viewing
from spacerobot_ros.cli import campaign
from spacerobot_ros.cli.main import main
from spacerobot_ros.cli.options import beside, numbers, viewer_if_requested
from spacerobot_ros.cli.terminal import sentences
from spacerobot_ros.errors import GoalError, ParameterError, PlanningError
from spacerobot_ros.report.figures import PictureFormat


def call(*words: object) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


@pytest.mark.parametrize(
    ("text", "width"),
    [
        ("88mm", 88.0),
        ("90", 90.0),
        (" 8.8 CM ", 88.0),
        (".5in", 12.7),
        ("72 pt", 25.4),
        ("-3mm", None),
        ("3km", None),
        ("3.mm", None),
    ],
)
def test_widths_of_figures_are_taken_in_any_unit(
    monkeypatch: pytest.MonkeyPatch, text: str, width: float | None
) -> None:
    drawn: list[Any] = []

    def draw(bag: Path, folder: Path, names: list[str], **options: Any) -> dict[str, Any]:
        drawn.append((bag, folder, names, options))
        return {"pose": Path("pose.pdf"), "joints": "The bag has none."}

    monkeypatch.setattr(spacerobot_ros.report, "write_figures", draw)
    done = call("figures", "a.mcap", "b.mcap", "c.mcap", "--width", text)
    if width is None:
        assert done.exit_code == 2
        assert f"'{text}' is not a length such as 88mm, 18cm, 3.5in or 246pt." in done.stderr
        return
    assert done.exit_code == 0
    assert done.stdout == "pose        pose.pdf\n"
    ((bag, folder, names, options),) = drawn
    assert (bag, folder, names) == (Path("a.mcap"), Path("a_figures"), [])
    assert options.pop("width") == pytest.approx(width)
    assert options == {
        **{"format": PictureFormat.PDF, "style": None, "events": False, "namespace": None},
        **{"degrees": False, "beside": (Path("b.mcap"), Path("c.mcap"))},
    }


@pytest.mark.parametrize(
    ("only", "results", "out", "err", "code"),
    [
        ("", {"pose": "It has none."}, "", "pose        none: It has none.\n", 1),
        ("pose", {"pose": Path("p")}, "pose        p\n", "", 0),
        (
            " Pose, x",
            {"pose": Path("p"), "x": "No."},
            "pose        p\n",
            "x           none: No.\n",
            1,
        ),
    ],
)
def test_figures_that_were_asked_for_and_not_drawn_fail(
    monkeypatch: pytest.MonkeyPatch,
    only: str,
    results: dict[str, Any],
    out: str,
    err: str,
    code: int,
) -> None:
    monkeypatch.setattr(spacerobot_ros.report, "write_figures", lambda *words, **options: results)
    done = call("figures", "a.mcap", "--only", only, "--format", "SVG")
    assert (done.stdout, done.stderr, done.exit_code) == (out, err, code)


def test_a_verified_bag_and_one_that_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    result = SimpleNamespace(
        **{"ticks": 40, "duration": 2.0, "messages": 120, "topics": ["odom", "momentum"]},
        **{"largest": 1.25e-10, "difference": None, "missing": None, "second_opinion": None},
        largest_at=SimpleNamespace(field="pose", topic="odom", time=0.35),
    )

    def verify(bag: Path, tolerance: float, *, mujoco: bool) -> Any:
        assert not mujoco
        asked.append((bag, tolerance))
        return result

    monkeypatch.setattr(verification, "verify_bag", verify)
    done = call("verify", "a.mcap")
    lines = [
        "flown again 40 ticks, 2 s",
        "compared    120 messages on odom, momentum",
        "largest     1.25e-10, pose of odom at 0.35 s",
    ]
    last = "verified    every published state follows from the commands"
    assert (done.exit_code, done.stdout.splitlines()) == (0, [*lines, last])
    for name, text in (("missing", "It lacks one."), ("difference", "It is not so.")):
        setattr(result, name, text)
        done = call("verify", "a.mcap", "--tolerance", "0")
        assert (done.exit_code, done.stdout.splitlines()) == (1, lines)
        assert done.stderr.endswith(f"{text}\n")
    assert asked == [(Path("a.mcap"), 1e-9), *[(Path("a.mcap"), 0.0)] * 2]
    assert call("verify", "a.mcap", "--tolerance", "-1e-9").exit_code == 2
    result.difference = result.missing = result.largest_at = None
    assert call("verify", "a.mcap").stdout.splitlines()[2] == "largest     1.25e-10"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (PlanningError("No way."), 1),
        (GoalError("No goal."), 2),
        (ParameterError("No number."), 2),
        (ImportError("No module named 'rclpy'", name="rclpy.node"), 2),
        (ImportError("No module named 'other'", name="other"), None),
        (ImportError("It is broken."), None),
        (KeyError("x"), None),
    ],
)
def test_exceptions_are_exit_codes_and_errors_of_programs_are_not(
    capsys: pytest.CaptureFixture[str], error: Exception, code: int | None
) -> None:
    with pytest.raises(type(error) if code is None else SystemExit) as raised, sentences():
        raise error
    if isinstance(raised.value, SystemExit):
        assert raised.value.code == code
        text = capsys.readouterr().err
        assert text == f"{error}\n" or text.startswith(f"ROS 2 was not found ({error}); source its")


def test_the_progress_of_a_campaign_is_shown_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[tuple[int, str]] = []

    @contextmanager
    def bar(**options: Any) -> Iterator[Any]:
        assert (options["length"], options["label"]) == (1000, "flights")
        made = SimpleNamespace(pos=0)

        def update(step: int, text: str) -> None:
            made.pos += step
            shown.append((made.pos, text))

        made.update = update
        yield made

    monkeypatch.setattr(click, "progressbar", bar)

    def report(terminal: bool) -> None:
        monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
        with campaign._progress_bar("flights") as show:
            for done, left in ((1, math.inf), (2, 3725.4), (2, 59.6), (1, 1.0), (4, 0.0)):
                now: Any = SimpleNamespace(flown=done, total=4, seconds_left=left)
                now.flights_per_second = 0.12345
                show(now)

    report(terminal=False)
    assert shown == []
    report(terminal=True)
    assert shown == [
        (250, "1/4, 0.123/s, ? left"),
        (500, "2/4, 0.123/s, 1:02:05 left"),
        (500, "2/4, 0.123/s, 0:01:00 left"),
        (500, "1/4, 0.123/s, 0:00:01 left"),
        (1000, "4/4, 0.123/s, 0:00:00 left"),
    ]


def test_a_viewer_runs_beside_a_command_that_asks_for_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []

    @contextmanager
    def view(parameters: Any, show: Any, namespace: str) -> Iterator[None]:
        asked.append((parameters, namespace))
        show("at this address")
        yield

    monkeypatch.setattr(viewing, "viewing", view)
    for wanted in (False, True):
        with viewer_if_requested(wanted, {"port": 0}, "left"):
            assert len(asked) == wanted
    assert asked == [({"port": 0}, "left")]
    assert capsys.readouterr().err == "at this address\n"


def test_files_beside_a_bag_have_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flight.1").mkdir()
    assert beside(tmp_path / "a.b.mcap", ".html") == tmp_path / "a.b.html"
    assert beside(tmp_path / "flight.1", ".html") == tmp_path / "flight.1.html"
    monkeypatch.chdir(tmp_path / "flight.1")
    assert beside(Path("."), "_figures") == tmp_path / "flight.1_figures"
    assert numbers([1.0, -0.123456]) == "1.00000, -0.12346"
