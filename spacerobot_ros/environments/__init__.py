"""Learning environments with the interface of Gymnasium, one robot each or thousands in SIMD lanes.

Importing this package registers ``spacerobot/ReorientArm-v0``, ``spacerobot/Reach-v0`` and, for
tasks of one's own, ``spacerobot/Task-v0`` where Gymnasium is installed. Tasks and actions
(:mod:`.tasks`) need no Gymnasium: a trained policy flies without it.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from spacerobot_ros.lazy import optional_module

__all__ = ["register"]


NAMESPACE = "spacerobot"

ENVIRONMENTS = {"ReorientArm-v0": "reorient", "Reach-v0": "reach", "Task-v0": ""}
"""Names of the environments within :data:`NAMESPACE`, and their tasks; empty: to be given."""


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


if find_spec("gymnasium") is not None:
    register()
