"""Options of commands reach the functions that they are for, in the right units."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.command_line import CliRunner, Result

import spacerobot_ros.cli.bags as bags
import spacerobot_ros.cli.flights as flights
import spacerobot_ros.nodes
import spacerobot_ros.nodes.common.process as process
import spacerobot_ros.report
import spacerobot_ros.session.live as session
from spacerobot_ros.cli.main import main
from spacerobot_ros.measures import Outcome

RPY = (20.0, -35.0, 50.0)
"""Roll, pitch and yaw whose order matters, deg."""


def call(*words: object) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def attitude_of_rpy() -> Rotation:
    """Turns about the fixed axes x, y, z in this order."""
    x, y, z = (Rotation.from_rotvec(np.radians(a) * e) for a, e in zip(RPY, np.eye(3), strict=True))
    return z * y * x


# -- goals --------------------------------------------------------------------------------------


def test_the_attitude_of_a_goal_that_is_sent_is_given_in_degrees(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[Any] = []

    def send_goal(goal: Any, show: Callable[[str], None], **named: Any) -> Outcome:
        sent.append((goal, named))
        return Outcome.REACHED if len(sent) == 1 else Outcome.FAILED

    monkeypatch.setattr(session, "send_goal", send_goal)
    words = ("goal", 0.1, -0.2, 0.3, "--goal-rpy-deg", *RPY, "--namespace", "left")
    assert call(*words, "--timeout", 2.5).exit_code == 0
    ((goal, named),) = sent
    np.testing.assert_array_equal(goal.position, [0.1, -0.2, 0.3])
    assert (Rotation.from_quat(goal.quaternion).inv() * attitude_of_rpy()).magnitude() < 1e-12
    assert named == {"namespace": "left", "timeout": 2.5}
    assert call("goal", 0.1, -0.2, 0.3).exit_code == 1
    assert sent[1][1] == {"namespace": "", "timeout": 0.0}


# -- stacks -------------------------------------------------------------------------------------


class _Viewer:
    """A viewer that is not started; its supervision returns the limit of its restarts."""

    def restart_within(self, restarts: int) -> None:
        self.supervise = lambda: restarts


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, str]]:
    """Return whether pages are served, and the namespaces of their stacks."""
    found: list[tuple[bool, str]] = []

    @contextmanager
    def viewer_if_requested(
        view: bool, parameters: Mapping[str, Any], namespace: str = ""
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
    result = call(*line.split(), "--set", "planner.tick_rate=12.5")
    assert result.output.split() == ["bag", "b.mcap"]
    assert call("up", "planar_chain").exit_code == 0
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
        assert call("up", "planar_chain", word).exit_code == 0
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
    assert call(*line.split()).exit_code == 3
    assert call("replay", "b.mcap").exit_code == 3
    assert call("replay", "b.mcap", "--clock").exit_code == 3
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
    assert call(*line.split(), "--namespace", "left").exit_code == 0
    others = (Path("b.mcap"), Path("c.mcap"))
    assert made == [
        ("write_report", (Path("a.mcap"), Path("r.html"), others), {"namespace": "left"}),
        ("write_picture", (Path("a.mcap"), Path("p.svg")), {"namespace": "left"}),
    ]
