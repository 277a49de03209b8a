"""What flights of tests run on: registers, the program of a device on this machine, a device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from spacerobot_ros.batch.targets import THREADS_OF_HOST, CudaDevice, Target, vector_unit
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.compilation import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler("cpp") is None, reason="there is no C++ compiler")

TARGETS: dict[str, Callable[[], Target]] = {
    "registers": vector_unit,
    "threads": lambda: THREADS_OF_HOST,
    "device": CudaDevice.of,
}


def on_targets(*fast: str) -> Any:
    """Parametrise a test by the name of a target; those that are not ``fast`` are slow.

    Tests on a device are marked ``gpu`` too.
    """
    marks = {name: [needs_compiler] for name in ("registers", "threads")}
    marks["device"] = [pytest.mark.gpu]
    for name, each in marks.items():
        if name not in fast:
            each.append(pytest.mark.slow)
    return pytest.mark.parametrize(
        "target_name", [pytest.param(name, id=name, marks=marks[name]) for name in TARGETS]
    )


def target_named(name: str) -> Target:
    """Return a target; the test is skipped if there is none."""
    try:
        return TARGETS[name]()
    except SpaceRobotError as error:
        pytest.skip(str(error))
