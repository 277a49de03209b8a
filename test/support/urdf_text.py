"""Pieces of URDF with every digit of their numbers."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def link(name: str, mass: float, inertia: Array, com: Array) -> str:
    """Return a link with an inertia (3, 3) about its center of mass (3,)."""
    moments = " ".join(
        f'i{"xyz"[i]}{"xyz"[j]}="{inertia[i, j]:.17g}"' for i in range(3) for j in range(i, 3)
    )
    return (
        f'<link name="{name}"><inertial><origin xyz="{numbers(com)}"/><mass value="{mass!r}"/>'
        f"<inertia {moments}/></inertial></link>"
    )


def numbers(values: npt.ArrayLike) -> str:
    return " ".join(f"{value:.17g}" for value in np.asarray(values))


def without_collisions(urdf: str) -> str:
    """Return a URDF whose links have no shapes but those that are drawn."""
    return re.sub(r"<collision>.*?</collision>", "", urdf, flags=re.DOTALL)
