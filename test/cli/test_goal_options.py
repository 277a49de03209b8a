"""Goals as the command line gives them, and what is said of them."""

from __future__ import annotations

import math
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from support.command_line import CliRunner, spacerobot
from support.warm_python import WarmPython

import spacerobot_ros.cli.bags as bags
import spacerobot_ros.cli.flights as flights
import spacerobot_ros.nodes
import spacerobot_ros.nodes.common.process as process
import spacerobot_ros.report
import spacerobot_ros.session.live as session
from spacerobot_ros.cli import terminal
from spacerobot_ros.cli.options import (
    GoalCommand,
    GoalOptions,
    beside,
    end_effector_goals,
    goal_options,
)
from spacerobot_ros.cli.terminal import sentences
from spacerobot_ros.errors import GoalError, ParameterError, PlanningError
from spacerobot_ros.planning.api import plan
from spacerobot_ros.planning.core.goal import warn_of_large_angles
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.termination import Terminated

POSE = (1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8)
HAND = (4.0, 5.0, 6.0)


@pytest.mark.parametrize(
    ("pose", "rotvec", "rpy_deg", "base"),
    [
        (None, None, None, []),
        (POSE, None, None, ["attitude", "position"]),
        (POSE, (0.0, 0.0, 1.0), None, ["attitude", "position"]),
        (POSE[:3], None, None, ["position"]),
        (POSE[:3], None, (0.0, 0.0, 1.0), ["attitude", "position"]),
        (None, (0.0, 0.0, 1.0), None, ["attitude"]),
        (None, None, (0.0, 0.0, 1.0), ["attitude"]),
    ],
)
def test_beside_goals_of_end_effectors_the_base_has_what_is_asked(
    pose: Any, rotvec: Any, rpy_deg: Any, base: list[str]
) -> None:
    hands = end_effector_goals((), (HAND,), ("link_7",))
    goal = load_scenario("reach").with_goal(pose, rotvec, rpy_deg, end_effectors=hands).goal
    assert ([hand.link for hand in goal.end_effectors], sorted(goal.base)) == (["link_7"], base)
    if pose is not None:
        np.testing.assert_array_equal(goal.position, pose[:3])


def test_end_effectors_have_names_in_the_order_of_poses_then_positions() -> None:
    found = end_effector_goals((POSE,), (HAND,), ("left", "right"))
    assert [(each.link, tuple(each.position)) for each in found] == [
        ("left", POSE[:3]),
        ("right", HAND),
    ]
    assert [each.quaternion is None for each in found] == [False, True]
    (found_one,) = end_effector_goals((), (HAND,))
    assert found_one.link == ""
    assert end_effector_goals() == []


@pytest.mark.parametrize(
    ("poses", "positions", "links", "counts"),
    [
        ((POSE,), (HAND,), ("left",), "2 end-effector goals and 1 name"),
        ((POSE,), (), ("left", "right"), "1 end-effector goal and 2 names"),
        ((), (), ("left",), "0 end-effector goals and 1 name"),
        ((POSE, POSE), (), (), "2 end-effector goals and 0 names"),
    ],
)
def test_end_effectors_with_more_or_fewer_names_are_refused(
    poses: Any, positions: Any, links: Any, counts: str
) -> None:
    with pytest.raises(click.UsageError) as refused:
        end_effector_goals(poses, positions, links)
    assert refused.value.message == (
        f"{counts}: give one --end-effector for each --end-effector-goal, then for each "
        "--end-effector-position, then for each --end-effector-path."
    )


@pytest.mark.parametrize(
    ("rotvec", "turn"),
    [
        ((0.0, 0.0, 2 * math.pi), ""),
        ((0.0, 0.0, math.inf), ""),
        ((math.nan, 0.0, 0.0), ""),
        ((0.0, -30.0, 40.0), "50 rad, which is 7.96 revolutions"),
        ((6.5, 0.0, 0.0), "6.5 rad, which is 1.03 revolutions"),
    ],
)
def test_a_rotation_of_more_than_a_turn_is_noted(
    rotvec: tuple[float, float, float], turn: str, caplog: pytest.LogCaptureFixture
) -> None:
    advice = "Rotation vectors are in rad; --goal-rpy-deg takes degrees."
    said = f"The goal rotates by {turn}: only the final attitude matters. {advice}"
    warn_of_large_angles(rotvec)
    assert caplog.messages == ([said] if turn else [])


def test_degrees_in_a_file_or_in_python_are_noted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "degrees.yaml"
    file.write_text("scenario: {ros__parameters: {goal_rotvec: [0, 0, 20]}}", "utf-8")
    load_scenario(str(file)).with_goal(rotvec=(0, 0, 30))
    with pytest.raises(PlanningError, match="lie_bracket needs three sliders"):
        plan("planar_chain", rotvec=(0, 0, 40), method="lie_bracket")
    noted = [message.partition(" rad, which is ")[0] for message in caplog.messages]
    assert noted == [f"The goal rotates by {angle}" for angle in (20, 30, 40)]


# -- how commands end -----------------------------------------------------------------------------


def test_a_signal_ends_a_command_with_its_code_whatever_a_library_makes_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ending = Terminated(signal.SIGTERM)
    monkeypatch.setattr(terminal, "termination", lambda: ending)
    with pytest.raises(SystemExit) as ended, sentences():
        raise RuntimeError("The solver was interrupted.")
    assert ended.value.code == 143
    with pytest.raises(SystemExit) as ended, sentences():
        raise Terminated(signal.SIGINT)
    assert ended.value.code == 130
    with pytest.raises(SystemExit) as ended:
        terminal.exit_if_terminated()
    assert ended.value.code == 143
    assert capsys.readouterr() == ("", "Terminated.\nInterrupted.\nTerminated.\n")
    monkeypatch.setattr(terminal, "termination", lambda: None)
    terminal.exit_if_terminated()
    with pytest.raises(RuntimeError, match="itself"), sentences():
        raise RuntimeError("itself")


def test_paths_of_end_effectors_are_read_from_files(tmp_path: Path) -> None:
    """After poses and positions; comments, commas and empty lines are left out."""
    places, poses = tmp_path / "places.txt", tmp_path / "poses.csv"
    places.write_text("# x y z\n1.5 0.7 1.3\n\n1.3, -0.9 0.8  # the goal\n", encoding="utf-8")
    poses.write_text("0.1,0.2,0.3,0,0,0,2\n0.4,0.5,0.6,0,0.6,0,0.8\n", encoding="utf-8")
    goals = end_effector_goals((), (HAND,), ("tip", "left", "right"), (places, poses))
    found = {each.link: each for each in goals}
    assert found["tip"].waypoints is None
    assert found["left"].path_values.tolist() == [[1.5, 0.7, 1.3], [1.3, -0.9, 0.8]]
    assert found["right"].values == (0.4, 0.5, 0.6, 0.0, 0.6, 0.0, 0.8)
    assert found["right"].waypoints is not None
    assert found["right"].waypoints.tolist() == [[0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 three\n", "three"),
        ("1 2 3\n1 2 3 0 0 0 1\n", "lines with [3, 7] numbers"),
        ("# nothing\n", "lines with [] numbers"),
        (None, "No such file"),
    ],
)
def test_files_that_are_no_paths_are_refused(tmp_path: Path, text: str | None, words: str) -> None:
    file = tmp_path / "way.txt"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    with pytest.raises(click.BadParameter) as refused:
        end_effector_goals((), (), (), (file,))
    assert f"The path {file}" in refused.value.message
    assert words in refused.value.message
    assert "a position and a quaternion" in refused.value.message


@pytest.mark.parametrize("words", [["0.25", "-0.5", "1e-1"], ["0.25", "-0.5", ".1", *"0001"]])
def test_a_goal_of_the_command_line_is_a_position_or_a_pose(
    words: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Three numbers keep the attitude of the scenario; negative ones are no options."""
    found: list[Any] = []

    @click.command(cls=GoalCommand)
    @click.argument("scenario")
    @goal_options
    def fly(scenario: str, goal: GoalOptions) -> None:
        found.append(goal(load_scenario(scenario)).goal)

    angle = 10 + len(words)
    options = ["--goal-rotvec", "0", "0", str(angle)]
    assert CliRunner().invoke(fly, ["sliding_masses", *options]).exit_code == 0
    assert f"The goal rotates by {angle} rad" in caplog.text
    found.clear()
    result = CliRunner().invoke(fly, ["sliding_masses", "--goal", *words])
    assert result.exit_code == 0, result.output
    (goal,) = found
    np.testing.assert_allclose(goal.position, [0.25, -0.5, 0.1])
    kept = load_scenario("sliding_masses").goal.quaternion
    assert np.linalg.norm(kept[:3]) > 0.1
    np.testing.assert_array_equal(goal.quaternion, kept if len(words) == 3 else [0, 0, 0, 1])
    twice = [*"1230001", "--goal-position", *"456"]
    for wrong, told in (
        (words[:2], "A goal is X Y Z, or"),
        ([*words, "1"], "A goal is X Y Z, or" if len(words) == 3 else "unexpected extra"),
        (twice, "The goal is given twice"),
    ):
        refused = CliRunner().invoke(fly, ["sliding_masses", "--goal", *wrong])
        assert refused.exit_code == 2
        assert told in refused.output


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_an_output_without_space_is_bad_input_and_no_verdict(warm_python: WarmPython) -> None:
    words = ["-m", "spacerobot_ros", "robots"]
    with (
        Path("/dev/full").open("w") as full,
        warm_python.start(
            words, Path.cwd(), os.environ, stdout=full, stderr=subprocess.PIPE
        ) as shown,
    ):
        assert shown.stderr is not None
        told = shown.stderr.read()
        assert shown.wait(60) == 2
    assert told == "Standard output cannot be written: no space is left on its device.\n"


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


# -- stacks -------------------------------------------------------------------------------------


class _Viewer:
    """A viewer that is not started; its supervision returns the limit of its restarts."""

    restarts = 0

    def supervise(self) -> int:
        return self.restarts


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, str]]:
    """Return whether pages are served, and the namespaces of their stacks."""
    found: list[tuple[bool, str]] = []

    @contextmanager
    def viewer_if_requested(
        view: bool, parameters: Mapping[str, Any], namespace: str = "", settings: Any = ()
    ) -> Iterator[Any]:
        found.append((view, namespace))
        yield _Viewer() if view else None

    monkeypatch.setattr(flights, "viewer_if_requested", viewer_if_requested)
    return found


def test_options_of_a_stack_that_stays_up(
    monkeypatch: pytest.MonkeyPatch, views: list[tuple[bool, str]]
) -> None:
    kept: list[Any] = []

    def run_until_stopped(scenario: Any, bag: Path | None, show: Any, **named: Any) -> Path | None:
        kept.append((scenario, bag, named))
        return bag

    monkeypatch.setattr(session, "run_until_stopped", run_until_stopped)
    line = "up planar_chain --rate 2.5 --bag b.mcap --namespace left --view --restarts 5"
    result = spacerobot(*line.split(), "--set", "planner.tick_rate=12.5")
    assert result.output.split() == ["bag", "b.mcap"]
    spacerobot("up", "planar_chain")
    (given, bag, named), (usual, none, by_default) = kept[:2]
    assert given.parameters("plant")["real_time_factor"] == 2.5
    assert usual.parameters("plant")["real_time_factor"] == 1.0
    assert given.parameters("planner")["tick_rate"] == 12.5
    assert (bag, none) == (Path("b.mcap"), None)
    assert named.pop("supervise")() == 5
    assert named == {"namespace": "left", "restarts": 5}
    assert by_default.pop("supervise")() is None
    assert by_default == {"namespace": "", "restarts": 3}
    # Stacks that stay up are always of the nodes.
    for word in ("--nodes", "--processes"):
        spacerobot("up", "planar_chain", word)
    assert views == [(True, "left"), *[(False, "")] * 3]


# -- bags ---------------------------------------------------------------------------------------


@pytest.fixture
def replayed(monkeypatch: pytest.MonkeyPatch) -> list[Mapping[str, Any]]:
    """Return the parameters of the nodes that are to replay, and whether a page is served."""
    found: list[Mapping[str, Any]] = []
    views: list[bool] = []

    @contextmanager
    def viewer_if_requested(view: bool, parameters: Mapping[str, Any]) -> Iterator[None]:
        views.append(view)
        yield

    def node(*, parameter_overrides: list[Any]) -> None:
        found.append({each.name: each.value for each in parameter_overrides} | {"view": views[-1]})

    def run_node(make: Callable[[], None], words: list[str]) -> int:
        make()
        return 3

    monkeypatch.setattr(bags, "viewer_if_requested", viewer_if_requested)
    monkeypatch.setattr(spacerobot_ros.nodes, "ReplayNode", node)
    monkeypatch.setattr(process, "run_node", run_node)
    return found


def test_options_of_a_replay_are_parameters_of_its_node(replayed: list[Mapping[str, Any]]) -> None:
    line = "replay a.mcap --rate 2.5 --start 1.5 --duration 4 --loop --topic /odom --topic /tf"
    line += " --remap /odom:=/old --remap /tf:=/tf_old --clock 30 --paused --view --wait 0.5"
    spacerobot(*line.split(), code=3)
    spacerobot("replay", "b.mcap", code=3)
    spacerobot("replay", "b.mcap", "--clock", code=3)
    given, usual, clock = replayed
    assert given == {
        **{"bag": "a.mcap", "rate": 2.5, "start": 1.5, "duration": 4.0, "loop": True},
        **{"topics": "/odom /tf", "remap": "/odom:=/old /tf:=/tf_old", "clock": 30.0},
        **{"paused": True, "hold": True, "view": True, "wait": 0.5},
    }
    assert usual == {
        **{"bag": "b.mcap", "rate": 1.0, "start": 0.0, "duration": 0.0, "loop": False},
        **{"topics": "", "remap": "", "clock": 0.0},
        **{"paused": False, "hold": False, "view": False, "wait": 3.0},
    }
    assert clock == {**usual, "clock": 100.0}


def test_options_of_a_report_reach_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    for name in ("write_report", "write_picture"):
        monkeypatch.setattr(
            spacerobot_ros.report,
            name,
            lambda *arguments, _name=name, **named: made.append((_name, arguments, named)),
        )
    line = "report a.mcap --out r.html --picture p.svg --beside b.mcap --beside c.mcap"
    spacerobot(*line.split(), "--namespace", "left")
    others = (Path("b.mcap"), Path("c.mcap"))
    assert made == [
        ("write_report", (Path("a.mcap"), Path("r.html"), others), {"namespace": "left"}),
        ("write_picture", (Path("a.mcap"), Path("p.svg")), {"namespace": "left"}),
    ]
