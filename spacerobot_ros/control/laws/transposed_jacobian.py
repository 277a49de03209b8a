"""A PD law for the outputs with the transpose of J_z, without inertia or inverse."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy.typing as npt
from typing_extensions import override

from spacerobot_ros.control.laws.law import FORCE_GAINS, ControlLaw, LawOptions
from spacerobot_ros.parameters import nonnegative


@dataclass(frozen=True)
class TransposedJacobianOptions(LawOptions):
    """The options of ``transposed_jacobian``."""

    joint_damping: float = nonnegative(
        0.0,
        "viscous friction applied by joint efforts; damps motion that does not affect any output",
        "N m s/rad",
        maximum=1000000000.0,
    )


class TransposedJacobianLaw(ControlLaw):
    """Paper 4, eqs (29) and (30): ``[f; n; tau] = J_q^-T J_z' (Kp e + Kd edot)``.

    The product ``J_z J_q^-1`` maps the base twist and the joint rates to the output rates. The
    masses cancel, and the law requires only the robot's geometry. No potentially singular matrix is
    inverted: if the errors are bounded, so is the command, even near a singularity of ``J_z``. It
    has no acceleration feedforward. Automatic gains are matrices that depend on the masses, with
    feedforward (:meth:`.ControlLaw.automatic_effort`).

    If there are fewer outputs than degrees of freedom, eq. (29) does not act on the remaining
    motion: arms continue to swing.
    ``joint_damping`` subtracts ``joint_damping * qdot`` from the joint efforts.

    Parameters
    ----------
    robot, outputs, gains, options
        See :class:`ControlLaw`; Kp in N/m (N m/rad), Kd in N s/m (N m s/rad).
    """

    name: ClassVar[str] = "transposed_jacobian"
    gain_units: ClassVar[tuple[str, str]] = FORCE_GAINS
    Options: ClassVar[Any] = TransposedJacobianOptions

    @property
    @override
    def joint_damping(self) -> float:
        return float(self.options.joint_damping)

    @override
    def inputs(self) -> Mapping[str, npt.ArrayLike]:
        return {"joint_damping": self.joint_damping}

    @override
    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        z1 = self.outputs
        effort = symbols["kp"] * z1.error + symbols["kd"] * z1.error_rate + symbols["integral"]
        effort += self.automatic_effort(symbols)
        friction = ca.vertcat(ca.SX(6, 1), symbols["joint_damping"] * z1.qdot)
        return {"actuation": (z1.J_z @ z1.J_q_inverse).T @ effort - friction}
