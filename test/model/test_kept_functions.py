"""Functions that take long to derive are derived once, and give the same numbers ever after."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.model import compilation
from spacerobot_ros.model.compilation import c_compiler, cached_function

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

    def kept(self, key: str = "a" * 64, *, compiling: bool) -> list[list[float]]:
        compilation._functions_in_memory.clear()  # As another process.
        function = cached_function("bent", key, self, compiling=compiling)
        return [each.nonzeros() for each in function.call([ca.DM(POINT)])]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compilation, "_MIN_OPERATIONS_TO_KEEP", 1)
    return tmp_path


@pytest.mark.parametrize("compiling", [False, True])
def test_what_is_kept_is_not_derived_again_and_gives_the_same_bits(
    folder: Path, compiling: bool
) -> None:
    derivation = Derivation()
    expected = [each.nonzeros() for each in derivation()(ca.DM(POINT))]
    results = [derivation.kept(compiling=compiling) for _ in range(3)]
    assert derivation.count == 2
    assert results == [expected] * 3
    (kept,) = folder.iterdir()
    assert kept.suffix == (".so" if compiling and c_compiler() else ".casadi")
    # Without a compiler it is derived or read, and a compiled one is not missed.
    assert Derivation().kept("b" * 64, compiling=False) == expected


def test_another_key_is_another_function(folder: Path) -> None:
    first, second = Derivation(1.1), Derivation(1.2)
    assert first.kept("a" * 64, compiling=False) != second.kept("b" * 64, compiling=False)
    assert (first.count, second.count) == (1, 1)


@pytest.mark.parametrize(
    "damage", [lambda whole: whole[:50], lambda whole: bytes([*whole[:-80], 0, *whole[-79:]])]
)
def test_what_is_damaged_is_derived_again(
    folder: Path, damage: object, caplog: pytest.LogCaptureFixture
) -> None:
    derivation = Derivation()
    expected = derivation.kept(compiling=False)
    (kept,) = folder.iterdir()
    assert callable(damage)
    kept.write_bytes(damage(kept.read_bytes()))
    assert derivation.kept(compiling=False) == expected
    assert derivation.count == 2


def test_what_others_may_have_written_is_not_read(folder: Path) -> None:
    derivation = Derivation()
    derivation.kept(compiling=False)
    (kept,) = folder.iterdir()
    kept.chmod(0o666)
    derivation.kept(compiling=False)
    assert derivation.count == 2


def test_a_process_reads_and_derives_a_function_once(folder: Path) -> None:
    derivation = Derivation()
    first = cached_function("bent", "c" * 64, derivation, compiling=False)
    for file in folder.iterdir():
        file.unlink()
    assert cached_function("bent", "c" * 64, derivation, compiling=False) is first
    assert derivation.count == 1
    # Another function, another way of compiling, and what was used long ago.
    assert cached_function("bent", "d" * 64, Derivation(2.0), compiling=False) is not first
    assert cached_function("bent", "c" * 64, derivation, compiling=True) is not first
    for number in range(compilation._MAX_FUNCTIONS_IN_MEMORY):
        cached_function("bent", f"{number:064}", derivation, compiling=False)
    assert cached_function("bent", "c" * 64, derivation, compiling=False) is not first
    assert len(compilation._functions_in_memory) == compilation._MAX_FUNCTIONS_IN_MEMORY
