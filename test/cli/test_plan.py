"""`spacerobot plan`: schedules and paths without ROS, compared, drawn, for many goals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.command_line import CliRunner, Result

from spacerobot_ros import fly, load_scenario
from spacerobot_ros import plan as python_plan
from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning.execution.config import PlannerConfig

URDF = Path(__file__).parents[2] / "urdf"
QUICK = ("--set", "planner.optimal.answers=1", "--set", "planner.optimal.intervals=30")


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


def plan(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["plan", *arguments])


def test_schedule_and_path_are_written_and_drawn(tmp_path: Path) -> None:
    target, picture = tmp_path / "a" / "plan.json", tmp_path / "b" / "plan.png"
    result = plan(
        *("planar_chain", "--goal-rotvec", "0", "0", "0.7", "--method", "optimal", *QUICK),
        *("--json", str(target), "--picture", str(picture)),
    )
    assert result.exit_code == 0, result.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    written = json.loads(target.read_text())
    assert written["method"] == "optimal"
    assert written["succeeded"] is True
    assert written["goal"] == pytest.approx([0, 0, 0, 0, 0, np.sin(0.35), np.cos(0.35)])
    assert written["attitude_error_rad"] < 1e-6
    assert written["final_attitude_rotvec_rad"] == pytest.approx([0, 0, 0.7], abs=1e-6)
    positions = np.array(written["schedule"]["positions"])
    # The scenario's start and final shape.
    np.testing.assert_allclose(positions[0], [np.pi, -np.pi])
    np.testing.assert_allclose(positions[-1], [0, 0], atol=1e-9)
    period = written["schedule"]["tick_period_s"]
    assert (len(positions) - 1) * period == pytest.approx(written["manoeuvre_time_s"])
    assert np.abs(np.diff(positions, axis=0)).max() <= 2.0 * period * (1 + 1e-9)
    last = Rotation.from_quat(written["path"]["quaternion"][-1])
    assert last.as_rotvec() == pytest.approx([0, 0, 0.7], abs=1e-6)
    assert written["path"]["time_s"][-1] == pytest.approx(written["manoeuvre_time_s"])


@pytest.mark.parametrize(
    ("words", "key", "text"),
    [
        (("plan", "planar_chain", "--method", "square_path"), "schedule", "planned in"),
        (("analyze", "sliding_masses"), "robot", "sliding_masses"),
    ],
)
def test_json_on_standard_output_is_alone_there(
    words: tuple[str, ...], key: str, text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*words, "--json", "-"])
    out, err = capfd.readouterr()
    assert ended.value.code == 0, err
    assert key in json.loads(out)
    assert text in err
    assert not Path("-").exists()


def test_every_method_that_suits_is_compared() -> None:
    result = plan("planar_chain", "--compare", *QUICK)
    assert result.exit_code == 0, result.output
    rows = {line.split()[0]: line.split() for line in result.output.splitlines() if line}
    assert float(rows["square_path"][1]) == pytest.approx(24.0)
    assert float(rows["optimal"][1]) < 6.0
    assert float(rows["optimal"][3]) < 1e-6
    # The base's position is left as it comes by both.
    assert rows["optimal"][4].startswith("(")
    assert "slider" in " ".join(rows["lie_bracket"])


def test_a_robot_by_its_file_needs_no_scenario() -> None:
    result = plan(
        *(str(URDF / "planar_chain.urdf"), "--goal-rotvec", "0", "0", "-0.2", *QUICK),
        *("--set", "plant.initial_joint_positions=[0.3, 0.2]"),
    )
    assert result.exit_code == 0, result.output
    assert "optimal" in result.output or "auto" in result.output


@pytest.mark.parametrize("name", ["planar_chain", "faults/stuck_slider"])
def test_the_method_is_the_scenarios_in_plan_and_run_and_python(name: str, tmp_path: Path) -> None:
    """Their methods are square_path and lie_bracket, that of a robot alone is auto."""
    target = tmp_path / "plan.json"
    plan(name, "--json", str(target))
    written = json.loads(target.read_text())
    scenario = load_scenario(name)
    assert written["method"] == scenario.planner.method != PlannerConfig().method
    assert python_plan(scenario).method == written["method"]
    assert (
        fly(scenario.with_overrides("planner", {"max_corrections": 0})).method == written["method"]
    )


def test_the_method_of_a_robot_alone_is_chosen_in_plan_and_run_and_python(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chosen: list[str] = []

    def suitable(method: str, *_: Any, **__: Any) -> None:
        chosen.append(method)
        raise PlanningError("That is enough.")

    for module in ("flight.trials", "planning.api", "planning.execution.worker"):
        monkeypatch.setattr(f"spacerobot_ros.{module}.build_method", suitable)
    robot = URDF / "planar_chain.urdf"
    assert plan(str(robot), "--goal-rotvec", "0", "0", "-0.2").exit_code == 1
    with pytest.raises(PlanningError, match="enough"):
        python_plan(robot, rotvec=(0, 0, -0.2))
    with pytest.raises(PlanningError, match="enough"):
        fly(robot, rotvec=(0, 0, -0.2))
    assert chosen == ["auto"] * 3


def test_many_goals_are_counted() -> None:
    words = ("--method", "optimal", "--beside", "square_path")
    result = plan("planar_chain", "--random", "2", *words, *QUICK)
    assert result.exit_code == 0, result.output
    rows = {line.split()[0]: line.split() for line in result.output.splitlines()}
    assert rows["optimal"][1:5] == ["2", "2", "0", "0"]
    assert rows["square_path"][1:5] == ["2", "2", "0", "0"]
    assert float(rows["optimal"][6]) < float(rows["square_path"][6]) / 2


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere"], "There is no scenario 'nowhere'"),
        (["planar_chain", "--goal-rotvec", "nan", "0", "0"], "is not three finite numbers"),
        (["sliding_masses", "--set", "planner.optimal.speed=1"], "no parameter 'optimal.speed'"),
        (["sliding_masses", "--set", "planner.optimal.keep_axis=1"], "it must be a list"),
        (["sliding_masses", "--set", "planner.tick_rate=fast"], "it must be a number"),
        (["sliding_masses", "--set", "recorder.bag=x"], "plans nothing"),
    ],
)
def test_bad_input_is_exit_2_and_one_sentence(arguments: list[str], sentence: str) -> None:
    result = plan(*arguments)
    assert result.exit_code == 2, result.output
    assert sentence in result.output
    assert len(result.output.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["sliding_masses", "--goal", *"9000001"], "out of reach"),
        (["planar_chain", "--goal-rotvec", "0.3", "0", "0"], "off any rotation about the axis"),
        (["planar_chain", "--method", "lie_bracket"], "slider"),
    ],
)
def test_a_goal_that_cannot_be_reached_is_exit_1_and_one_sentence(
    arguments: list[str], sentence: str
) -> None:
    """As `run` ends with the same goals."""
    result = plan(*arguments)
    assert result.exit_code == 1, result.output
    assert sentence in result.output
    assert len(result.output.strip().splitlines()) == 1
