"""What campaigns need beside the package: imported where it is used, missed with one sentence."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from spacerobot_ros.errors import SpaceRobotError


def needed(module: str) -> Any:
    """Return a module of the extra ``campaign``.

    Raises
    ------
    SpaceRobotError
        It is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        name = module.partition(".")[0]
        raise SpaceRobotError(
            f"Campaigns need {name}, which is not installed: "
            "pip install 'spacerobot_ros[campaign]'."
        ) from None


def salib(module: str) -> Any:
    """Return a module of SALib; see :func:`needed`."""
    return needed(f"SALib.{module}")


def sobol_problem(names: Sequence[str]) -> dict[str, Any]:
    """Return what SALib calls the problem: quantities of these names, from 0 to 1."""
    # An array, because SALib 1.5 has pandas sort out the names, and pandas 3 takes no list.
    listed = np.array(list(names), dtype=object)
    return {"num_vars": len(listed), "names": listed, "bounds": [[0, 1]] * len(listed)}
