"""Where a link is after a motion of the joints, by Pinocchio's momentum alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle

Array = npt.NDArray[np.float64]


def end_of_motion(
    urdf: str,
    joint_names: tuple[str, ...],
    positions: Array,
    links: list[str],
    position: npt.ArrayLike = (0.0, 0.0, 0.0),
    attitude: Rotation | None = None,
) -> dict[str, tuple[Array, Rotation]]:
    """Return r_WL and R_WL of links after shapes (N + 1, n), from a pose of the base at rest.

    The attitude is integrated at zero angular momentum by two Gauss stages of each tick; the centre
    of mass stays where it is.
    """
    oracle = PinocchioOracle(urdf, joint_names)
    R = Rotation.identity() if attitude is None else attitude
    oracle.set_configuration(positions[0], R.as_quat(), np.asarray(position, dtype=float))
    center = oracle.center_of_mass_W()
    reach = np.sqrt(3) / 6
    for q, q_next in pairwise(positions):
        move = (q_next - q) / 2
        for half in (q, q + move):
            one, two = (
                -oracle.connection(half + s * move)[3:] @ move for s in (0.5 - reach, 0.5 + reach)
            )
            turn = (one + two) / 2 + reach / 2 * np.cross(one, two)
            R = R * Rotation.from_rotvec(turn)
    oracle.set_configuration(positions[-1], R.as_quat(), np.zeros(3))
    moved = center - oracle.center_of_mass_W()
    oracle.set_configuration(positions[-1], R.as_quat(), moved)
    poses = {link: oracle.frame_W(link) for link in links}
    return {link: (r, Rotation.from_matrix(R_WL)) for link, (R_WL, r) in poses.items()}
