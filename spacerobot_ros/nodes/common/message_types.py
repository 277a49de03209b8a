"""Message classes by the names of their types."""

from __future__ import annotations

import importlib
from typing import Any

from spacerobot_ros.errors import SpaceRobotError


def message_class(type_name: str) -> Any:
    """Return the class of a type such as ``nav_msgs/msg/Odometry``.

    Raises
    ------
    SpaceRobotError
        Its package is not installed; the sentence goes after the name of a topic.
    """
    try:
        package, _, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError, ValueError):
        raise SpaceRobotError(f"its type {type_name} is not installed here.") from None
