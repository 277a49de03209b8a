"""Manoeuvres to many goals of one robot: guesses for goals that are near to theirs."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import cache_directory
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits
from spacerobot_ros.private_files import Cache, UntrustedFileError, read_private

_NEAREST = 2
"""Manoeuvres of a library that a search begins with."""

_KNOTS = 41
"""Shapes that are kept of a manoeuvre."""


@dataclass(frozen=True)
class SolutionLibrary:
    """Manoeuvres of one robot.

    Attributes
    ----------
    key
        A hash of the robot and its limits (:func:`library_key`).
    turns
        (K, 4) quaternions of the last attitudes in the first ones.
    shapes
        (K, M, n) shapes at equal intervals from the beginning to the end.
    """

    key: str
    turns: Array
    shapes: Array

    @classmethod
    def of(cls, key: str, schedules: Sequence[GaitSchedule], turns: Array) -> SolutionLibrary:
        """Take schedules and the turns (K, 4) that they bring about."""
        shapes = []
        for schedule in schedules:
            ticks, instants = np.linspace(0, 1, schedule.ticks + 1), np.linspace(0, 1, _KNOTS)
            columns = schedule.positions.T
            shapes.append(np.column_stack([np.interp(instants, ticks, x) for x in columns]))
        return cls(key, turns, np.array(shapes))

    @property
    def digest(self) -> str:
        """A hash of all that it holds."""
        return hashlib.sha256(self.to_bytes()).hexdigest()

    def nearest(self, boundary: BoundaryConditions, limits: MotionLimits) -> Iterator[Array]:
        """Yield the shapes (M, n) of the manoeuvres whose ends are nearest, bent to these ends."""
        half = limits.span(boundary.start)[1]
        half = np.where(half > 0, half, 1.0)
        # The angle between two turns, and what the shapes at both ends differ by.
        apart = 2 * np.arccos(np.clip(np.abs(self.turns @ boundary.turn), 0.0, 1.0))
        begins = np.linalg.norm((self.shapes[:, 0] - boundary.start) / half, axis=1)
        distance = apart + begins
        if boundary.final is not None:
            ends = (self.shapes[:, -1] - boundary.final) / half
            distance = distance + np.linalg.norm(ends, axis=1)
        for index in np.argsort(distance, kind="stable")[:_NEAREST]:
            shapes = self.shapes[index]
            s = np.linspace(0.0, 1.0, len(shapes))[:, np.newaxis]
            late = s**3 * (10 - 15 * s + 6 * s**2)
            last = shapes[-1] if boundary.final is None else boundary.final
            bent = shapes + (1 - late) * (boundary.start - shapes[0]) + late * (last - shapes[-1])
            yield np.clip(bent, limits.lower, limits.upper)

    def to_bytes(self) -> bytes:
        """Return it as an archive of numpy."""
        file = io.BytesIO()
        key = np.array(self.key)
        np.savez(file, key=key, turns=self.turns, shapes=self.shapes)
        return file.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> SolutionLibrary:
        """Return it from an archive.

        Raises
        ------
        ValueError
            That holds something else.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                found = cls(str(arrays["key"]), arrays["turns"], arrays["shapes"])
        except (OSError, EOFError, KeyError, MemoryError, ValueError, zipfile.BadZipFile):
            # What numpy says of it recommends to trust it.
            raise ValueError("it holds no library") from None
        turns, shapes = found.turns, found.shapes
        fits = turns.shape[1:] == (4,) and shapes.ndim == 3 and len(shapes) == len(turns) > 0
        if not fits or shapes.shape[1] < 2 or not turns.dtype == shapes.dtype == np.float64:
            raise ValueError("it holds something else than a library")
        if not (np.all(np.isfinite(turns)) and np.all(np.isfinite(shapes))):
            raise ValueError("it is not finite")
        return found


def library_key(robot: SpaceRobot, limits: MotionLimits, axes: Array, *, position: bool) -> str:
    """Return a hash of what the manoeuvres of a library depend on."""
    digest = hashlib.sha256(robot.equations_key.encode())
    for numbers in (*vars(limits).values(), axes):
        digest.update(np.ascontiguousarray(numbers, dtype=float).tobytes())
    digest.update(repr((robot.joint_names, position)).encode())
    return digest.hexdigest()


def library_file(key: str) -> tuple[Cache, str]:
    """Return the cache of libraries, and the name of one in it."""
    return Cache(cache_directory() / "libraries"), f"{key[:32]}.npz"


def load_library(path: str, key: str) -> SolutionLibrary | None:
    """Return the library at a path; without one, that of the cache, or None.

    Raises
    ------
    ParameterError
        There is none at the path, it is of another robot, or others may have written it.
    """
    if not path:
        cache, name = library_file(key)
        kept = cache.load(name, key) if (cache.folder / name).exists() else None
        if kept is None:
            return None
        try:
            found = SolutionLibrary.from_bytes(kept[1])
        except ValueError as error:
            cache.discard(name, str(error))
            return None
        return found if found.key == key else None
    try:
        found = SolutionLibrary.from_bytes(read_private(Path(path).expanduser()))
    except (OSError, ValueError, UntrustedFileError) as error:
        raise ParameterError(f"The library '{path}' cannot be used: {error}") from None
    if found.key != key:
        raise ParameterError(
            f"The library '{path}' is of another robot, or of other limits; spacerobot library "
            "makes one of this."
        )
    return found
