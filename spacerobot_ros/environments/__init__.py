"""Gymnasium environments with one robot, or with thousands of robots in SIMD lanes.

If Gymnasium is installed, importing this package registers ``spacerobot/ReorientArm-v0``,
``spacerobot/Reach-v0`` and, for custom tasks, ``spacerobot/Task-v0``. Tasks and actions
(:mod:`.tasks`) do not require Gymnasium, so a trained policy can fly without Gymnasium.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from spacerobot_ros.resources import optional_module

__all__ = ["register"]


NAMESPACE = "spacerobot"

ENVIRONMENTS = {"ReorientArm-v0": "reorient", "Reach-v0": "reach", "Task-v0": ""}
"""Environment names in :data:`NAMESPACE`, and their tasks; if empty, the task is an argument."""


def import_gymnasium() -> Any:
    """Return the Gymnasium module; see :func:`.optional_module`."""
    return optional_module("gymnasium", "rl", "Environments need")


def register() -> None:
    """Register the environments with Gymnasium.

    Raises
    ------
    SpaceRobotError
        Gymnasium is not installed.
    """
    gymnasium = import_gymnasium()
    module = "spacerobot_ros.environments.gymnasium_interface"
    for name, task in ENVIRONMENTS.items():
        if f"{NAMESPACE}/{name}" not in gymnasium.registry:
            gymnasium.register(
                f"{NAMESPACE}/{name}",
                entry_point=f"{module}:SpaceRobotEnv",
                vector_entry_point=f"{module}:SpaceRobotVectorEnv",
                kwargs={"task": task},
            )


if find_spec("gymnasium") is not None:
    register()
