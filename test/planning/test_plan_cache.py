"""Plans that were kept are flown for the same request, and only if they are whole."""

from __future__ import annotations

import io
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.test_optimal import FOLDER, QUICK

from spacerobot_ros import files
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.files import Cache
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import GaitSchedule, plan
from spacerobot_ros.planning.methods.optimal.search import ManoeuvreSearch

Array = npt.NDArray[Any]

ASKED: dict[str, Any] = {**QUICK, "cache": 1, "rotvec": [0, 0, 0.3], "joint_positions": [0.4, 0.1]}


@pytest.fixture(scope="module")
def robot() -> SpaceRobot:
    return SpaceRobot.from_file(FOLDER / "planar_chain.urdf")


@pytest.fixture(scope="module")
def made(robot: SpaceRobot, tmp_path_factory: pytest.TempPathFactory) -> tuple[GaitSchedule, Path]:
    """Return a plan and the file that it was kept in."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(folder))
        schedule = plan(robot, **ASKED)
    (kept,) = (folder / "plans").iterdir()
    return schedule, kept


@pytest.fixture
def cache(
    made: tuple[GaitSchedule, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Cache:
    """Return a cache of this test's own with that plan; a search for another one fails."""
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(files, "_logged_warnings", set())

    def searching(*arguments: Any, **options: Any) -> None:
        raise PlanningError("searched")

    monkeypatch.setattr(ManoeuvreSearch, "search", searching)
    cache = Cache(tmp_path / "plans")
    cache.folder.mkdir()
    shutil.copy(made[1], cache.folder)
    return cache


def content_of(path: Path) -> bytes:
    whole = path.read_bytes()
    return whole[: whole.rfind(b"\nspacerobot_ros cache")]


@pytest.mark.slow
def test_a_plan_is_flown_again_as_it_was(
    robot: SpaceRobot, made: tuple[GaitSchedule, Path], cache: Cache
) -> None:
    first, again = made[0], plan(robot, **ASKED)
    np.testing.assert_array_equal(again.positions, first.positions)
    for part in ("time", "position", "quaternion"):
        np.testing.assert_array_equal(getattr(again.path, part), getattr(first.path, part))
    assert again.notes == {**first.notes, "from_cache": 1.0}


@pytest.mark.parametrize("bit", [100, 1200, -40])
def test_one_bit_makes_a_plan_another(
    bit: int, robot: SpaceRobot, cache: Cache, caplog: pytest.LogCaptureFixture
) -> None:
    (kept,) = cache.folder.iterdir()
    whole = bytearray(kept.read_bytes())
    whole[bit] ^= 1
    kept.write_bytes(whole)
    with pytest.raises(PlanningError, match="searched"):
        plan(robot, **ASKED)
    assert "it is damaged" in caplog.text


@pytest.mark.parametrize(
    "options",
    [
        {"keep_out": [0.05, -10.0, 10.0, 10.0]},
        {"max_base_rate": 1e-4},
        {"max_velocity": [0.01, 0.01]},
        {"rotvec": [0, 0, 0.31]},
        {"joint_positions": [0.4, 0.2]},
        {"start": [0.01, 0.0]},
        {"duration": 100.0},
    ],
)
def test_the_plan_of_another_request_is_not_flown(
    options: dict[str, Any], robot: SpaceRobot, cache: Cache
) -> None:
    assert "from_cache" in plan(robot, **ASKED).notes
    with pytest.raises(PlanningError, match="searched"):
        plan(robot, **{**ASKED, **options})


def test_a_folder_of_plans_that_others_may_write_is_not_read(
    robot: SpaceRobot, cache: Cache, caplog: pytest.LogCaptureFixture
) -> None:
    cache.folder.chmod(0o777)
    for _ in range(2):
        with pytest.raises(PlanningError, match="searched"):
            plan(robot, **ASKED)
    (record,) = caplog.records
    assert f"chmod go-w '{cache.folder}'" in record.getMessage()
    assert len(list(cache.folder.iterdir())) == 1


def test_a_plan_of_an_earlier_version_is_not_asked_for(
    robot: SpaceRobot, made: tuple[GaitSchedule, Path], cache: Cache
) -> None:
    """It has no digest and lies under other names."""
    (kept,) = cache.folder.iterdir()
    kept.write_bytes(content_of(made[1]))
    with pytest.raises(PlanningError, match="searched"):
        plan(robot, **ASKED)


def test_what_is_kept_is_this_users_alone(cache: Cache) -> None:
    (kept,) = cache.folder.iterdir()
    facts = kept.stat()
    assert (facts.st_mode & 0o777, facts.st_uid) == (0o600, os.geteuid())
    assert json.loads(str(np.load(io.BytesIO(content_of(kept)))["notes"]))["starts"] == 1.0
