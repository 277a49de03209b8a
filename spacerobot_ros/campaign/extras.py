"""What campaigns need beside the package: imported where it is used, missed with one sentence."""

from __future__ import annotations

import importlib
from typing import Any

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
