"""Plans that were kept are flown only if they still do what they were made for."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
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
    cache.store(made[1].name, key_of(made[1]), content_of(made[1]))
    return cache


def key_of(path: Path) -> str:
    return path.read_bytes().splitlines()[-1].split()[3].decode()


def content_of(path: Path) -> bytes:
    whole = path.read_bytes()
    return whole[: whole.rfind(b"\nspacerobot_ros cache")]


def with_arrays(content: bytes, change: Callable[[dict[str, Any]], None]) -> bytes:
    """Return a plan with other arrays."""
    with np.load(io.BytesIO(content)) as file:
        arrays: dict[str, Any] = {name: file[name] for name in file.files}
    change(arrays)
    changed = io.BytesIO()
    np.savez(changed, **arrays)
    return changed.getvalue()


def of_positions(change: Callable[[Array], Array]) -> Callable[[bytes], bytes]:
    """Return what alters the shapes at the ticks of a plan, the digest included."""

    def alter(arrays: dict[str, Any]) -> None:
        arrays["positions"] = change(arrays["positions"])

    return lambda content: with_arrays(content, alter)


def of_notes(text: object) -> Callable[[bytes], bytes]:
    return lambda content: with_arrays(content, lambda arrays: arrays.update(notes=text))


def bumped(positions: Array) -> Array:
    """A smooth detour within all limits, to another attitude."""
    s = np.linspace(0.0, 1.0, len(positions))[:, np.newaxis]
    return np.asarray(positions + 1e-4 * np.sin(np.pi * s) ** 2 * [1.0, 0.5])


def without(name: str) -> Callable[[bytes], bytes]:
    return lambda content: with_arrays(content, lambda arrays: arrays.pop(name))


class Trap:
    """Makes a file where it is unpickled."""

    path = ""

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (self.path, "w")


@pytest.mark.slow
def test_a_plan_is_flown_again_as_it_was(
    robot: SpaceRobot, made: tuple[GaitSchedule, Path], cache: Cache
) -> None:
    first, again = made[0], plan(robot, **ASKED)
    np.testing.assert_array_equal(again.positions, first.positions)
    for part in ("time", "position", "quaternion"):
        np.testing.assert_array_equal(getattr(again.path, part), getattr(first.path, part))
    assert again.notes == {**first.notes, "from_cache": 1.0}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (of_positions(bumped), "it ends in another attitude"),
        (of_positions(lambda q: q + 1e-5), "it begins in another shape"),
        (of_positions(lambda q: np.vstack([q[:-1], q[-1:] + 1e-5])), "it ends in another shape"),
        (of_positions(lambda q: q[::-1].copy()), "it begins in another shape"),
        (of_positions(lambda q: q[::2].copy()), "it exceeds a limit"),
        (of_positions(lambda q: np.where(q == q[len(q) // 2], 100.0, q)), "it exceeds a limit"),
        (of_positions(lambda q: np.where(q == q[len(q) // 2], np.nan, q)), "it is not finite"),
        (of_positions(lambda q: np.where(q == q[len(q) // 2], np.inf, q)), "it is not finite"),
        (of_positions(lambda q: np.hstack([q, q])), "it is of shape"),
        (of_positions(lambda q: q[:, 0].copy()), "it is of shape"),
        (of_positions(lambda q: q[:1]), "it is of shape"),
        (of_positions(lambda q: q[:0]), "it is of shape"),
        (of_positions(lambda q: q.astype(np.float32)), "something else"),
        (of_positions(lambda q: q.astype(complex)), "something else"),
        (of_positions(lambda q: np.repeat(q, 40000, axis=0)[: 36000 * 2]), "it takes 7199.9 s"),
        (of_notes('{"starts": NaN}'), "its notes are not numbers"),
        (of_notes('{"starts": "<script>"}'), "its notes are not numbers"),
        (of_notes("[]"), "something else"),
        (of_notes("{"), "Expecting"),
        (without("notes"), "holds no plan"),
        (without("positions"), "holds no plan"),
        (lambda content: content[: len(content) // 2], "holds no plan"),
        (lambda _: b"", "holds no plan"),
        (lambda _: b"\x80\x04K\x01.", "pickled|allow_pickle|holds no plan"),
    ],
)
def test_a_plan_that_is_not_one_is_thrown_away(
    change: Callable[[bytes], bytes],
    reason: str,
    robot: SpaceRobot,
    made: tuple[GaitSchedule, Path],
    cache: Cache,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """With the digest of what it has become, as who owns the folder could write it."""
    name, key, content = made[1].name, key_of(made[1]), content_of(made[1])
    cache.store(name, key, change(content))
    with pytest.raises(PlanningError, match="searched"):
        plan(robot, **ASKED)
    (record,) = caplog.records
    assert "is deleted and computed again: " in record.getMessage()
    assert any(each in record.getMessage() for each in reason.split("|")), record.getMessage()
    assert not list(cache.folder.iterdir())


def test_nothing_in_a_plan_is_executed(
    robot: SpaceRobot, made: tuple[GaitSchedule, Path], cache: Cache, tmp_path: Path
) -> None:
    trap = Trap()
    trap.path = str(tmp_path / "sprung")
    change = of_positions(lambda _: np.array([trap], dtype=object))
    cache.store(made[1].name, key_of(made[1]), change(content_of(made[1])))
    (tmp_path / "sprung").unlink(missing_ok=True)
    with pytest.raises(PlanningError, match="searched"):
        plan(robot, **ASKED)
    assert not (tmp_path / "sprung").exists()


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
    ("options", "reason"),
    [
        ({"keep_out": [0.05, -10.0, 10.0, 10.0]}, "enters a box"),
        ({"max_base_rate": 1e-4}, "the base turns at"),
        ({"max_velocity": [0.01, 0.01]}, "exceeds a limit"),
        ({"rotvec": [0, 0, 0.31]}, "another attitude"),
        ({"joint_positions": [0.4, 0.2]}, "another shape"),
        ({"start": [0.01, 0.0]}, "another shape"),
        ({"duration": 100.0}, "not 100 s"),
    ],
)
def test_the_plan_of_another_request_is_not_flown(
    options: dict[str, Any],
    reason: str,
    robot: SpaceRobot,
    made: tuple[GaitSchedule, Path],
    cache: Cache,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It is put under the other's key."""
    asked: list[tuple[str, str]] = []
    load = Cache.load

    def loading(self: Cache, name: str, key: str) -> tuple[Path, bytes] | None:
        asked.append((name, key))
        return load(self, name, key)

    monkeypatch.setattr(Cache, "load", loading)
    request = {**ASKED, **options}
    with pytest.raises(PlanningError, match="searched"):
        plan(robot, **request)
    cache.store(*asked[0], content_of(made[1]))
    with pytest.raises(PlanningError, match="searched"):
        plan(robot, **request)
    assert reason in caplog.text


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
