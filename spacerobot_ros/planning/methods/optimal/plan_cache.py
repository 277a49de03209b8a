"""Manoeuvres that were found before, on disk: named by all that they follow from."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import casadi as ca
import numpy as np

from spacerobot_ros import __version__
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import cache_directory
from spacerobot_ros.model.description import Array

_LOG = logging.getLogger(__name__)


class PlanCache:
    """Arrays by a key; a file that cannot be read or written is as good as none."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or cache_directory() / "plans"

    def load(self, key: str) -> dict[str, Array] | None:
        """Return what was stored under a key, or None."""
        try:
            # A file that is opened here is closed where it turns out to be broken, too.
            with self._file(key).open("rb") as file, np.load(file) as content:
                return {name: content[name] for name in content.files}
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            _LOG.warning("The plan %s cannot be read and is made anew: %s", self._file(key), error)
            return None

    def store(self, key: str, arrays: Mapping[str, Array]) -> None:
        """Keep arrays under a key."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.folder, delete=False) as file:
                np.savez(file, allow_pickle=False, **arrays)
            # Whole or not at all, whoever else writes it.
            os.replace(file.name, self._file(key))
        except OSError as error:
            _LOG.warning("The plan cannot be kept in %s: %s", self.folder, error)

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


def plan_key(robot: SpaceRobot, numbers: Mapping[str, Array], options: Mapping[str, object]) -> str:
    """Return the name of a plan: a hash of the robot's equations and of all that was asked."""
    digest = hashlib.sha256()
    for name in ("locked_inertia", "center_of_mass"):
        digest.update(robot.function(name, compile=False).serialize().encode())
    facts = {
        "versions": [__version__, ca.__version__, np.__version__],
        "joints": robot.joint_names,
        "options": options,
        "numbers": {
            name: [x.hex() for x in map(float, np.ravel(v))] for name, v in numbers.items()
        },
    }
    digest.update(json.dumps(facts, sort_keys=True, default=repr).encode())
    return digest.hexdigest()[:32]
