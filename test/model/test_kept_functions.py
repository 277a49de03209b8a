"""Functions that take long to derive are derived once, and give the same numbers ever after."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.model import compilation
from spacerobot_ros.model.compilation import cached_function

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


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compilation, "_MIN_OPERATIONS_TO_KEEP", 1)
    return tmp_path


def test_what_is_kept_is_not_derived_again_and_gives_the_same_bits(folder: Path) -> None:
    derivation = Derivation()
    expected = [each.nonzeros() for each in derivation()(ca.DM(POINT))]
    results = [derivation.kept() for _ in range(3)]
    assert derivation.count == 2
    assert results == [expected] * 3
    (kept,) = folder.iterdir()
    assert kept.suffix == ".casadi"


def test_another_key_is_another_function(folder: Path) -> None:
    first, second = Derivation(1.1), Derivation(1.2)
    assert first.kept("a" * 64) != second.kept("b" * 64)
    assert (first.count, second.count) == (1, 1)


@pytest.mark.parametrize(
    "damage", [lambda whole: whole[:50], lambda whole: bytes([*whole[:-80], 0, *whole[-79:]])]
)
def test_what_is_damaged_is_derived_again(
    folder: Path, damage: object, caplog: pytest.LogCaptureFixture
) -> None:
    derivation = Derivation()
    expected = derivation.kept()
    (kept,) = folder.iterdir()
    assert callable(damage)
    kept.write_bytes(damage(kept.read_bytes()))
    assert derivation.kept() == expected
    assert derivation.count == 2


def test_a_folder_that_others_may_write_is_not_read(folder: Path) -> None:
    derivation = Derivation()
    derivation.kept()
    folder.chmod(0o777)
    derivation.kept()
    assert derivation.count == 2
