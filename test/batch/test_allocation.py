"""The allocation in C++ and that of the package give the same levels for the same cases."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.oracles import Array

import spacerobot_ros.batch
from spacerobot_ros.control.thrusters import ThrusterAllocation, thrusters_of_urdf
from spacerobot_ros.model.compilation import cxx_compiler
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import share_directory

SOURCE = Path(spacerobot_ros.batch.__file__).with_name("thrusters.hpp")
SERVICER = thrusters_of_urdf(load_robot(share_directory() / "urdf" / "servicer.urdf"))


class CompiledAllocation:
    """``allocate_levels`` of ``thrusters.hpp``, for the problem of an allocation."""

    def __init__(self, allocation: ThrusterAllocation, count: int, folder: Path) -> None:
        compiler = cxx_compiler()
        assert compiler is not None
        main = folder / "allocation.cpp"
        main.write_text(
            f"#include <math.h>\n#include <algorithm>\n#define THRUSTERS {count}\n"
            f'#include "{SOURCE}"\n'
        )
        library = folder / "allocation.so"
        command = [compiler, "-O2", "-std=c++17", "-ffp-contract=off", "-shared", "-fPIC"]
        subprocess.run([*command, str(main), "-o", str(library)], check=True, timeout=120)
        self._allocate = ctypes.CDLL(str(library)).allocate_levels
        self._count = count
        matrix, weights = allocation.problem
        self._matrix, self._weights = np.ascontiguousarray(matrix.T), weights

    def __call__(self, impulse: Array, most: Array) -> Array | None:
        """Return the levels; None where the driver would ask Python."""
        levels = np.zeros(self._count)
        arrays = self._matrix, self._weights, impulse, most, levels
        found = self._allocate(*(ctypes.c_void_p(array.ctypes.data) for array in arrays))
        return levels if found else None


@pytest.mark.skipif(cxx_compiler() is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("count", [24, 9])
def test_both_allocations_agree_on_random_cases(count: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(count)
    wrenches, cost = SERVICER.wrenches, SERVICER.mass_flow * rng.uniform(0.99, 1.01, 24)
    if count < 24:  # Random ones: most corrections are too large for the compiled one.
        force, place = rng.normal(size=(2, count, 3))
        wrenches, cost = np.vstack([force.T, np.cross(place, force).T]), rng.uniform(1, 2, count)
    allocation = ThrusterAllocation(wrenches, cost)
    compiled = CompiledAllocation(allocation, count, tmp_path)
    given, passed_on = 0, 0
    for _ in range(400):
        levels = 0.02 * rng.uniform(size=count) * rng.integers(0, 2, count)
        outside = rng.normal(size=6) * rng.choice([0.0, 0.01])
        impulse, most = wrenches @ levels + outside, rng.uniform(0.012, 0.05, count)
        found = compiled(impulse, most)
        if found is None:
            passed_on += 1
            continue
        given += 1
        expected = allocation.allocate(impulse, most).levels
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert given > (100 if count == 24 else 8)
    assert passed_on > 10
    assert not compiled(np.zeros(6), np.ones(count)).any()  # type: ignore[union-attr]
