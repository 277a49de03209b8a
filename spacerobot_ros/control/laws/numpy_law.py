"""Base class for control laws in plain numpy, which may be stateful."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import casadi as ca
import numpy as np
from typing_extensions import override

from spacerobot_ros.control.laws.law import ACCELERATION_GAINS, ControlLaw
from spacerobot_ros.control.state import Actuation, ControlState, Reference
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.description import Array


class NumpyLaw(ControlLaw):
    """A law that computes its command from the state and the reference in Python.

    A subclass defines ``name`` and :meth:`compute`. Before each call, the base class evaluates
    :attr:`error`, :attr:`error_rate` and :attr:`J_z` of the outputs; :attr:`gain_diagonals` are the
    parameters ``gains``; :attr:`gain_matrices` include their couplings. A stateful law keeps its
    state in attributes and resets it in :meth:`start`. All engines except campaign lanes support
    such a law.

    See :class:`ControlLaw` for the parameters and errors of the constructor.
    """

    gain_units: ClassVar[tuple[str, str]] = ACCELERATION_GAINS

    @abstractmethod
    def compute(self, state: ControlState, reference: Reference) -> Actuation:
        """Return the unlimited base wrench and joint efforts.

        Parameters
        ----------
        state
            The measured state, or the estimate while the base is not measured.
        reference
            The current reference for base, end-effector and joints; a group that is not an output
            is None.

        Returns
        -------
        Actuation
            ``wrench_B`` (6,), force (N), then torque (N m) at the base link origin in base
            components, and ``tau`` (n,), joint efforts (N or N m).
        """

    @property
    @override
    def takes_matrices(self) -> bool:
        """Whether gains may be matrices; :meth:`compute` must then use :attr:`gain_matrices`."""
        return True

    @property
    def J_z(self) -> Array:
        """Jacobian (m, 6 + n) of the outputs with respect to ``[v_cm; omega; qdot]`` (paper 4, eq.
        23)."""
        return self._out["J_z"].copy()

    @override
    def command(self, state: ControlState, reference: Reference) -> Actuation:
        """Evaluate the output errors, then return :meth:`compute`; see :class:`ControlLaw`."""
        super().command(state, reference)
        given = self.compute(state, reference)
        try:
            wrench, tau = (np.array(each, dtype=float) for each in given)
        except (TypeError, ValueError):
            wrench = tau = np.empty(0)
        sizes = wrench.shape, tau.shape
        if sizes != ((6,), (self.robot.n,)) or not np.isfinite(np.concatenate([wrench, tau])).all():
            raise SpaceRobotError(
                f"The law '{self.name}' returned {given!r} at {self.time:g} s; it must return "
                f"Actuation(wrench_B, tau) with 6 and {self.robot.n} finite numbers."
            )
        return Actuation(wrench, tau)

    @override
    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """Return no expressions: :meth:`compute` returns the command."""
        return {"actuation": ca.SX(6 + self.robot.n, 1)}
