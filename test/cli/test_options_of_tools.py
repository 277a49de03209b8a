"""Options of `figures`, `export`, `verify` and `campaign` reach the functions behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from spacerobot_ros.cli.options import beside, numbers
from spacerobot_ros.cli.terminal import sentences
from spacerobot_ros.errors import GoalError, ParameterError, PlanningError


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


def test_files_beside_a_bag_have_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flight.1").mkdir()
    assert beside(tmp_path / "a.b.mcap", ".html") == tmp_path / "a.b.html"
    assert beside(tmp_path / "flight.1", ".html") == tmp_path / "flight.1.html"
    monkeypatch.chdir(tmp_path / "flight.1")
    assert beside(Path("."), "_figures") == tmp_path / "flight.1_figures"
    assert numbers([1.0, -0.123456]) == "1.00000, -0.12346"
