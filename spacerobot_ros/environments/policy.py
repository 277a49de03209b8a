"""Policies that were trained in the environments, evaluated by NumPy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array


@dataclass(frozen=True)
class Policy:
    """A network whose hidden layers end in tanh, and whose last layer is the action.

    Attributes
    ----------
    weights
        Of each layer (outputs, inputs).
    biases
        Of each layer (outputs,).

    Raises
    ------
    ParameterError
        The layers do not follow on each other, or a number is not finite.
    """

    weights: Sequence[Array]
    biases: Sequence[Array]

    def __post_init__(self) -> None:
        shapes = [np.shape(each) for each in self.weights]
        biases = [np.shape(each) for each in self.biases]
        if (
            not shapes
            or any(len(shape) != 2 for shape in shapes)
            or any(before[0] != after[1] for before, after in pairwise(shapes))
            or biases != [shape[:1] for shape in shapes]
        ):
            raise ParameterError(
                f"The layers of the policy have weights {shapes} and biases {biases}: each takes "
                "the outputs of the one before."
            )
        if not all(np.isfinite(each).all() for each in (*self.weights, *self.biases)):
            raise ParameterError("The policy has numbers that are not finite.")

    def __call__(self, observations: npt.ArrayLike) -> Array:
        """Return the actions (..., outputs) for observations (..., inputs), clipped to -1 and 1."""
        values = np.asarray(observations, dtype=float)
        *hidden, (weights, bias) = zip(self.weights, self.biases, strict=True)
        for each, offset in hidden:
            values = np.tanh(values @ each.T + offset)
        return np.clip(values @ weights.T + bias, -1.0, 1.0)

    @classmethod
    def load(cls, file: Path) -> Policy:
        """Return the policy of a file that :meth:`save` has written.

        Raises
        ------
        ParameterError
            It cannot be read as one.
        """
        try:
            arrays = np.load(BytesIO(file.read_bytes()), allow_pickle=False)
            layers = [arrays[f"layer_{k}"].astype(float) for k in range(len(arrays.files))]
        except (OSError, EOFError, ValueError, KeyError, AttributeError, BadZipFile) as error:
            raise ParameterError(f"{file} is no policy: {error}.") from error
        if any(layer.ndim != 2 for layer in layers):
            raise ParameterError(f"{file} is no policy: a layer is no matrix.")
        return cls([layer[:, :-1] for layer in layers], [layer[:, -1] for layer in layers])

    def save(self, file: Path) -> None:
        """Write the layers as matrices whose last column is the bias."""
        layers: dict[str, Any] = {
            f"layer_{k}": np.column_stack(layer)
            for k, layer in enumerate(zip(self.weights, self.biases, strict=True))
        }
        np.savez(file, **layers)
