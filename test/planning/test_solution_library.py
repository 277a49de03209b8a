"""Libraries of manoeuvres: guesses for goals nearby, of one robot and no other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planning.test_optimal import FOLDER
from support.command_line import CliRunner

from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import GaitSchedule, plan
from spacerobot_ros.planning.methods.optimal.initial_guesses import SolutionLibrary
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits

QUICK = {"cache": 0, "intervals": 20, "answers": 2}


def of_chain(robot: SpaceRobot | str = "planar_chain", **options: Any) -> GaitSchedule:
    return plan(robot, rotvec=[0, 0, 0.9], **{**QUICK, **options})


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a library of two goals by the command."""
    path = tmp_path_factory.mktemp("library") / "chain.npz"
    settings = [f"--set=planner.optimal.{name}={value}" for name, value in QUICK.items()]
    words = ["library", "planar_chain", "--count", "2", "--out", str(path)]
    # Of the robot alone: the scenario of its name begins elsewhere.
    words[1] = str(FOLDER / "planar_chain.urdf")
    result = CliRunner().invoke(main, [*words, *settings])
    assert result.exit_code == 0, result.output
    assert "(2 of 2 goals)" in result.output
    assert path.stat().st_mode & 0o777 == 0o600
    return path


@pytest.mark.slow
def test_a_library_gives_the_first_guesses(library: Path) -> None:
    without, with_it = of_chain(), of_chain(library=str(library))
    assert with_it.positions.tobytes() == of_chain(library=str(library)).positions.tobytes()
    assert with_it.duration <= 1.05 * without.duration
    assert float(str(with_it.notes["starts"])) <= 3


@pytest.mark.slow
def test_the_nearest_manoeuvres_are_bent_to_the_ends(library: Path) -> None:
    found = SolutionLibrary.from_bytes(library.read_bytes())
    start, final = np.array([0.2, -0.1]), np.array([0.3, 0.4])
    boundary = BoundaryConditions(start, found.turns[1], final, final)
    wide = np.full(2, 3.0)
    limits = MotionLimits(-wide, wide, wide, wide)
    first, second = found.nearest(boundary, limits)
    for shapes in (first, second):
        np.testing.assert_allclose(shapes[[0, -1]], [start, final], atol=1e-12)
    middle = len(first) // 2
    own = found.shapes[1]
    shifted = own[middle] + (start - own[0] + final - own[-1]) / 2
    np.testing.assert_allclose(first[middle], shifted, atol=1e-12)


def test_a_library_of_another_robot_is_refused(library: Path) -> None:
    heavier = (FOLDER / "planar_chain.urdf").read_text().replace('"120"', '"121"')
    with pytest.raises(ParameterError, match="is of another robot, or of other limits"):
        of_chain(SpaceRobot.from_urdf(heavier), library=str(library))
    with pytest.raises(ParameterError, match="is of another robot, or of other limits"):
        of_chain(library=str(library), max_velocity=(0.5, 0.5))


@pytest.mark.parametrize("content", [b"", b"PK", b"\x80\x04K\x01."])
def test_what_is_no_library_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "library.npz"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(ParameterError, match="cannot be used: it holds no library"):
        of_chain(library=str(path))


def test_a_library_that_others_may_write_is_refused(library: Path, tmp_path: Path) -> None:
    path = tmp_path / "library.npz"
    path.write_bytes(library.read_bytes())
    path.chmod(0o666)
    with pytest.raises(ParameterError, match="others may write"):
        of_chain(library=str(path))


def test_a_library_in_the_cache_is_found(
    library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    settings = [f"--set=planner.optimal.{name}={value}" for name, value in QUICK.items()]
    words = ["library", str(FOLDER / "planar_chain.urdf"), "--count", "2", *settings]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    (kept,) = (tmp_path / "libraries").iterdir()
    assert str(kept) in result.output
    from_cache, named = of_chain(), of_chain(library=str(library))
    assert from_cache.positions.tobytes() == named.positions.tobytes()
