"""The environments by their names in Gymnasium."""

from __future__ import annotations

from typing import Any

from spacerobot_ros.lazy import optional_module

NAMESPACE = "spacerobot"

ENVIRONMENTS = {"ReorientArm-v0": "reorient", "Reach-v0": "reach"}
"""Names of the environments within :data:`NAMESPACE`, and their tasks."""


def import_gymnasium() -> Any:
    """Return the module of Gymnasium; see :func:`.optional_module`."""
    return optional_module("gymnasium", "rl", "Environments need")


def register() -> None:
    """Make the environments known to Gymnasium.

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
