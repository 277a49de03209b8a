"""Random free-floating robots as URDF text, the same for the same generator state."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

BASE = "base_link"


def random_robot_urdf(rng: np.random.Generator, joints: int) -> str:
    """Return a branched tree with ``joints`` movable joints of all kinds and some fixed ones.

    Every robot of three joints or more has a prismatic, a revolute and a continuous joint; a
    massive link fixed to the base; a mass-less frame fixed to a random link; and a moving link
    without mass that a massive link is fixed to. The base's centre of mass is not at its origin.
    Names and elements are in no particular order, so that neither can stand for the topology.
    """
    links = [_link(rng, BASE, massive=True)]
    elements: list[str] = []
    open_links = [BASE]

    def attach(name: str, kind: str, parent: str, *, massive: bool) -> None:
        links.append(_link(rng, name, massive=massive))
        elements.append(_joint(rng, f"joint_of_{name}", kind, parent, name))
        open_links.append(name)

    kinds = [str(kind) for kind in rng.permutation(["prismatic", "revolute", "continuous"])]
    kinds += [str(kind) for kind in rng.choice(kinds, size=max(0, joints - len(kinds)))]
    labels = rng.permutation(joints)
    carrier = int(rng.integers(joints))
    attach("bracket", "fixed", BASE, massive=True)
    for index, kind in enumerate(kinds[:joints]):
        # The first two joints leave the base on two branches; the others go anywhere.
        parent = BASE if index < 2 else str(rng.choice(open_links))
        name = f"link_{labels[index]}"
        attach(name, kind, parent, massive=index != carrier)
        if index == carrier:
            attach("payload", "fixed", name, massive=True)
    attach("sensor_frame", "fixed", str(rng.choice(open_links)), massive=False)
    attach("tool_frame", "fixed", f"link_{labels[-1]}", massive=False)
    return _robot(rng.permutation([*links, *elements]))


def random_chain_urdf(rng: np.random.Generator, joints: int) -> str:
    """Return an unbranched chain of revolute joints: the manipulator of paper 4, eq. (3b)."""
    links = [_link(rng, BASE, massive=True)]
    elements = []
    for k in range(1, joints + 1):
        parent = BASE if k == 1 else f"link_{k - 1}"
        links.append(_link(rng, f"link_{k}", massive=True))
        elements.append(_joint(rng, f"joint_{k}", "revolute", parent, f"link_{k}"))
    return _robot([*links, *elements])


def random_inertia(rng: np.random.Generator, mass: float) -> Array:
    """Return a rotated inertia (3, 3) that a body of this mass can have: three positive second
    moments of mass along random axes, hence moments that satisfy the triangle inequality.
    """
    second = mass * rng.uniform(0.02, 0.15, 3)
    R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    return R @ np.diag(second.sum() - second) @ R.T


def _robot(elements: npt.ArrayLike) -> str:
    body = "\n".join(str(element) for element in np.asarray(elements))
    return f'<?xml version="1.0"?>\n<robot name="random">\n{body}\n</robot>\n'


def _link(rng: np.random.Generator, name: str, *, massive: bool) -> str:
    if not massive:
        return f'<link name="{name}"/>'
    mass = float(rng.uniform(8.0, 20.0) if name == BASE else rng.uniform(0.5, 5.0))
    about = random_inertia(rng, mass)
    moments = " ".join(
        f'i{"xyz"[i]}{"xyz"[j]}="{about[i, j]:.17g}"' for i in range(3) for j in range(i, 3)
    )
    return (
        f'<link name="{name}"><inertial>{_origin(rng, 0.3)}<mass value="{mass:.17g}"/>'
        f"<inertia {moments}/></inertial></link>"
    )


def _joint(rng: np.random.Generator, name: str, kind: str, parent: str, child: str) -> str:
    axis = rng.normal(size=3)
    limit = {"fixed": "", "continuous": '<limit velocity="2" effort="20"/>'}.get(
        kind, '<limit lower="-3" upper="3" velocity="2" effort="20"/>'
    )
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'{_origin(rng, 0.6)}<axis xyz="{_numbers(axis / np.linalg.norm(axis))}"/>{limit}</joint>'
    )


def _origin(rng: np.random.Generator, reach: float) -> str:
    xyz = rng.uniform(-reach, reach, 3)
    rpy = rng.uniform((-np.pi, -1.5, -np.pi), (np.pi, 1.5, np.pi))
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'


def _numbers(values: npt.ArrayLike) -> str:
    return " ".join(f"{value:.17g}" for value in np.asarray(values))
