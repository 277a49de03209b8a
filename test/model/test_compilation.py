"""Compiled functions: what is loaded was checked, and nothing that happens to a cache harms."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import cached_function, compiled, find_compiler, load_library
from spacerobot_ros.resources import robot_file

Compiler = Callable[[str], Path]


@pytest.fixture(autouse=True)
def cache(compiled_code: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return the folder of this test's objects; nothing was said before."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(folder))
    return folder


@pytest.fixture
def compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Compiler:
    """Return what makes the machine's C compiler a shell script; ``$CC`` in it is the real one."""
    real = find_compiler()

    def install(script: str) -> Path:
        path = tmp_path / "cc"
        path.write_text(f"#!/bin/sh\nCC={real}\n{script}\n", encoding="utf-8")
        path.chmod(0o700)
        monkeypatch.setenv("CC", str(path))
        return path

    return install


def probe() -> ca.Function:
    x = ca.SX.sym("x", 3)
    return ca.Function("probe", [x], [2 * ca.sin(x)], ["x"], ["y"])


def is_compiled() -> bool:
    """Build the probe; it is right in any case."""
    function = compiled(probe())
    wanted = probe()([1, 2, 3])
    assert float(ca.norm_inf(function([1, 2, 3]) - wanted)) < 1e-12
    return str(function.class_name()) == "External"


def only_file(cache: Path) -> Path:
    (path,) = cache.iterdir()
    return path


def test_a_damaged_object_is_made_anew(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert is_compiled()
    kept = only_file(cache)
    whole = kept.read_bytes()
    kept.write_bytes(whole[:3000] + bytes([whole[3000] ^ 1]) + whole[3001:])
    assert is_compiled()
    assert "is deleted and recomputed: it is damaged" in caplog.text
    assert only_file(cache).read_bytes() == whole
    caplog.clear()
    assert is_compiled()
    assert not caplog.text


def test_a_whole_object_is_not_made_again(cache: Path, compiler: Compiler) -> None:
    compiler('exec $CC "$@"')
    assert is_compiled()
    compiler("exit 1")
    assert is_compiled()
    assert only_file(cache).stat().st_mode & 0o077 == 0


def test_an_object_under_the_name_of_another_is_not_loaded(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    x = ca.SX.sym("x", 3)
    compiled(ca.Function("probe", [x], [3 * ca.cos(x)], ["x"], ["y"]))
    other = only_file(cache)
    content = other.read_bytes()
    assert is_compiled()
    (own,) = set(cache.iterdir()) - {other}
    own.unlink()  # It may still be mapped.
    own.write_bytes(content)
    assert is_compiled()
    assert "is deleted" in caplog.text


def test_flags_are_part_of_the_name() -> None:
    """An object for other registers is another one."""
    source = "double number(void) { return NUMBER; }"

    def number(flag: str) -> float:
        library = load_library("number", source, ctypes.CDLL, flags=(flag,))
        library.number.restype = ctypes.c_double
        return float(library.number())

    assert [number(f"-DNUMBER={k}.0") for k in (1, 2, 1)] == [1.0, 2.0, 1.0]


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ('while [ "$1" != -o ]; do shift; done; echo hello > "$2"', "cannot be loaded"),
        ("echo no room >&2; exit 3", r"failed \(3\): no room"),
        ("exit 4", r"failed \(4\): no reason given; is the disk of .* full"),
        ("kill -9 $$", "was ended by SIGKILL"),
    ],
)
def test_a_compiler_that_fails_costs_speed_only(
    script: str, reason: str, compiler: Compiler, caplog: pytest.LogCaptureFixture
) -> None:
    compiler(script)
    assert not is_compiled()
    assert len(caplog.records) == 1
    assert caplog.records[0].levelname == "WARNING"
    assert re.search(reason, caplog.text)


def test_no_compiler_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert not is_compiled()
    assert not is_compiled()
    assert len(caplog.records) == 1
    assert "no C compiler" in caplog.text


# -- who may write it -------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777, 0o1777])
def test_a_folder_that_others_may_write_is_not_used(
    mode: int, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert is_compiled()
    kept = only_file(cache)
    kept.write_bytes(b"planted")
    cache.chmod(mode)
    assert is_compiled()
    assert is_compiled()
    assert kept.read_bytes() == b"planted"
    (record,) = caplog.records
    assert f"chmod go-w '{cache}'" in record.getMessage()
    assert f"(mode {mode:o})" in record.getMessage()


def test_a_folder_of_somebody_else_is_not_used(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cache.mkdir(mode=0o755)
    if os.geteuid() == 0:
        os.chown(cache, 12345, 12345)
    else:
        monkeypatch.setattr("os.geteuid", lambda: os.getuid() + 1)
    assert is_compiled()
    assert is_compiled()
    assert not list(cache.iterdir())
    assert len(caplog.records) == 1
    assert "belongs to user" in caplog.text
    assert "SPACEROBOT_CACHE_DIR" in caplog.text


@pytest.mark.parametrize("mode", [0o755, 0o777])
def test_a_link_is_followed_to_a_folder_that_nobody_else_may_write(
    mode: int, cache: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    real = tmp_path / "disk"
    real.mkdir()
    real.chmod(mode)
    cache.symlink_to(real)
    assert is_compiled()
    assert len(list(real.iterdir())) == (mode == 0o755)
    assert (f"chmod go-w '{cache}'" in caplog.text) == (mode == 0o777)


def test_whatever_the_umask_the_cache_is_for_its_user_alone(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = cache / "a" / "b"
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(deep))
    before = os.umask(0)
    try:
        assert is_compiled()
    finally:
        os.umask(before)
    for path in (deep, only_file(deep)):
        assert path.stat().st_mode & 0o077 == 0, path


# -- places that take nothing -----------------------------------------------------------------


@pytest.mark.parametrize("folder", ["/proc/none", "/dev/null/cache"])
def test_without_a_place_to_keep_it_an_object_is_used_all_the_same(
    folder: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", folder)
    assert is_compiled()
    assert is_compiled()
    assert len(caplog.records) == 1
    assert folder in caplog.text


def test_a_folder_that_forbids_execution_costs_speed_only(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def external(name: str, path: str) -> ca.Function:
        raise RuntimeError("failed to map segment from shared object")

    monkeypatch.setattr(ca, "external", external)
    assert not is_compiled()
    assert not is_compiled()
    (record,) = caplog.records
    assert "forbids execution; SPACEROBOT_CACHE_DIR selects" in record.getMessage()


def test_a_full_disk_keeps_nothing_and_harms_nothing(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.replace", full)
    assert is_compiled()
    assert "No space left" in caplog.text
    assert not list(cache.iterdir())


def test_equal_robots_share_functions_and_others_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    text = robot_file("planar_chain").read_text("utf-8")
    first, again = SpaceRobot.from_urdf(text), SpaceRobot.from_urdf(text)
    heavier = SpaceRobot.from_urdf(text.replace('mass value="', 'mass value="1'))
    step = first.function("velocity_step:2")
    assert again.function("velocity_step:2") is step
    assert heavier.function("velocity_step:2") is not step
    # Memory is a caller's own.
    one, other = first.buffered("velocity_step:2"), again.buffered("velocity_step:2")
    one.inputs[0][:] = 1.0
    assert not other.inputs[0].any()
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    assert again.function("velocity_step:2") is not step


def test_a_model_answers_several_threads() -> None:
    """Each thread has its own memory for arguments and results."""
    robot = SpaceRobot.from_file(robot_file("surveyor"))
    shapes = np.random.default_rng(1).uniform(-1.0, 1.0, (500, robot.n))
    alone = [robot.inertia_matrix(q) for q in shapes]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as threads:
            together = [*threads.map(robot.inertia_matrix, [*shapes] * 10)]
    finally:
        sys.setswitchinterval(before)
    np.testing.assert_array_equal(together, alone * 10)


def test_a_long_wait_is_announced_once_in_a_process(tmp_path: Path) -> None:
    code = (
        "import casadi as ca\n"
        "from spacerobot_ros.model.compilation import compiled\n"
        "from spacerobot_ros.planning.core.progress import report_progress\n"
        "x = ca.SX.sym('x')\n"
        "with report_progress(lambda progress: None, print):\n"
        "    for name in ('first', 'second'):\n"
        "        compiled(ca.Function(name, [x], [2 * x]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.count("Compiling the equations of this robot") == 1


POINT = np.array([0.3, -1.2, 0.7])


class Derivation:
    """A function, and how often it was derived."""

    def __init__(self, factor: float = 1.1) -> None:
        self.factor, self.count = factor, 0

    def __call__(self) -> ca.Function:
        self.count += 1
        x = ca.SX.sym("x", 3)
        rows = ca.vertcat(ca.sin(x) * self.factor, x[0] / x[1] + ca.exp(x[2]) * x[0])
        return ca.Function("bent", [x], [rows, ca.jacobian(rows, x)])

    def kept(self, key: str = "a" * 64) -> list[list[float]]:
        function = cached_function("bent", key, self)
        return [each.nonzeros() for each in function.call([ca.DM(POINT)])]


def test_what_is_kept_is_not_derived_again_and_gives_the_same_bits(cache: Path) -> None:
    derivation = Derivation()
    expected = [each.nonzeros() for each in derivation()(ca.DM(POINT))]
    results = [derivation.kept() for _ in range(3)]
    assert derivation.count == 2
    assert results == [expected] * 3
    assert only_file(cache).suffix == ".casadi"


def test_another_key_is_another_function() -> None:
    first, second = Derivation(1.1), Derivation(1.2)
    assert first.kept("a" * 64) != second.kept("b" * 64)
    assert (first.count, second.count) == (1, 1)
