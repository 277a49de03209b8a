"""Policies that were trained in the environments, evaluated by NumPy alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Policy:
    """A network whose hidden layers end in tanh, and whose last layer is the action.

    Attributes
    ----------
    weights
        Of each layer (outputs, inputs).
    biases
        Of each layer (outputs,).
    """

    weights: Sequence[Array]
    biases: Sequence[Array]

    def __call__(self, observations: npt.ArrayLike) -> Array:
        """Return the actions (..., outputs) for observations (..., inputs), clipped to -1 and 1."""
        values = np.asarray(observations, dtype=float)
        *hidden, (weights, bias) = zip(self.weights, self.biases, strict=True)
        for each, offset in hidden:
            values = np.tanh(values @ each.T + offset)
        return np.clip(values @ weights.T + bias, -1.0, 1.0)

    @classmethod
    def load(cls, file: Path) -> "Policy":
        """Return the policy of a file that :meth:`save` has written."""
        with np.load(file, allow_pickle=False) as arrays:
            layers = [arrays[f"layer_{k}"].astype(float) for k in range(len(arrays.files))]
        return cls([layer[:, :-1] for layer in layers], [layer[:, -1] for layer in layers])

    def save(self, file: Path) -> None:
        """Write the layers as matrices whose last column is the bias."""
        layers: dict[str, Any] = {
            f"layer_{k}": np.column_stack(layer)
            for k, layer in enumerate(zip(self.weights, self.biases, strict=True))
        }
        np.savez(file, **layers)
