"""Where a link is after a motion of the joints, by Pinocchio's momentum alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle

Array = npt.NDArray[np.float64]


def attitude_after(
    oracle: PinocchioOracle, shapes: Array, attitude: Rotation | None = None, parts: int = 1
) -> Rotation:
    """Return R_WB after straight legs between shapes (V, n) at zero angular momentum.

    Every leg is integrated in equal parts, each by two Gauss stages: of order four.
    """
    R, reach = attitude or Rotation.identity(), np.sqrt(3) / 6
    for q, q_next in pairwise(shapes):
        move = (q_next - q) / parts
        for k in range(parts):
            one, two = (
                oracle.base_twist(q + (k + s) * move, move)[3:] for s in (0.5 - reach, 0.5 + reach)
            )
            turn = (one + two) / 2 + reach / 2 * np.cross(one, two)
            R = R * Rotation.from_rotvec(turn)
    return R


def end_of_motion(
    urdf: str,
    joint_names: tuple[str, ...],
    positions: Array,
    links: list[str],
    position: npt.ArrayLike = (0.0, 0.0, 0.0),
    attitude: Rotation | None = None,
) -> dict[str, tuple[Array, Rotation]]:
    """Return r_WL and R_WL of links after shapes (N + 1, n), from a pose of the base at rest.

    The attitude is that of :func:`attitude_after`; the centre of mass stays where it is.
    """
    oracle = PinocchioOracle(urdf, joint_names)
    R = Rotation.identity() if attitude is None else attitude
    oracle.set_configuration(positions[0], R.as_quat(), np.asarray(position, dtype=float))
    center = oracle.center_of_mass_W()
    R = attitude_after(oracle, positions, R, parts=2)
    oracle.set_configuration(positions[-1], R.as_quat(), np.zeros(3))
    moved = center - oracle.center_of_mass_W()
    oracle.set_configuration(positions[-1], R.as_quat(), moved)
    poses = {link: oracle.frame_W(link) for link in links}
    return {link: (r, Rotation.from_matrix(R_WL)) for link, (R_WL, r) in poses.items()}
