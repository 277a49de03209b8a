"""Options of gait methods and control laws: declared once, and checked where they arrive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.errors import ParameterError


@dataclass(frozen=True)
class Option:
    """A parameter of a method or a law; the default sets its type, unit and meaning are for people.

    ``minimum`` and ``maximum`` are those of numbers and of the entries of a list. ``of_joints``: a
    list has a number for every joint of the robot, a text names some of its joints.
    """

    name: str
    default: float | int | str | list[float]
    unit: str
    meaning: str
    minimum: float = 0.0
    maximum: float = 1e9
    of_joints: bool = False

    def checked(self, value: Any) -> Any:
        """Return the value.

        Raises
        ------
        ParameterError
            It is out of range or not a number; the sentence names the option.
        """
        if isinstance(self.default, str):
            return value
        numbers = np.asarray(value, dtype=float)
        if not np.all((numbers >= self.minimum) & (numbers <= self.maximum)):
            unit = f" {self.unit}" if self.unit else ""
            raise ParameterError(
                f"The option '{self.name}' is {value}{unit}; it must be from "
                f"{self.minimum:g} to {self.maximum:g}."
            )
        return value


def chosen_options(
    owner: str, options: Sequence[Option], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a value for every option of a method or a law: the given one, or the default.

    Raises
    ------
    ParameterError
        The owner has no option of a given name, or a value is out of range.
    """
    unknown = sorted(set(given) - {option.name for option in options})
    if unknown:
        raise ParameterError(f"{owner} has no option '{unknown[0]}'.")
    return {
        option.name: option.checked(given.get(option.name, option.default)) for option in options
    }
