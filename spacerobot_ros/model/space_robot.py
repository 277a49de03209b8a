"""Model of one robot: its compiled equations as methods.

Frames: world W, base link B. Vectors with the suffix ``_B`` are in the base frame. The joint
positions ``q`` (n,) are in the order of ``joint_names``. The methods return new arrays; code that
runs every control period uses a :class:`BufferedFunction` from :meth:`SpaceRobot.buffered` and
works in place.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Hashable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import RobotDescriptionError, counted
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.model_functions import Composition, ModelFunctions, SymbolicModels
from spacerobot_ros.model.rotations import hat
from spacerobot_ros.model.urdf import load_robot, parse_robot

_MIN_RELATIVE_INERTIA = 1e-6
"""Largest joint component that is considered zero in a motion without inertia."""

_MIN_RELATIVE_COUPLING = 1e-9
"""Smallest singular value of the connection that is considered a base rotation, rad per rad."""


class SpaceRobot:
    """Model of a free-floating robot, built from its description.

    Parameters
    ----------
    description
        The robot, as returned by :func:`load_robot` or :func:`parse_robot`.
    build
        Set of models for all robots that differ only in mass properties: :meth:`buffered` and
        :meth:`composed` functions take the mass properties as an argument and are compiled once for
        all these robots. If None, the mass properties are compiled as constants.

    Raises
    ------
    RobotDescriptionError
        The robot's inertia matrix is not positive definite.

    Notes
    -----
    Methods for a link raise KeyError, with the names of the links, if there is no such link.
    """

    def __init__(self, description: RobotDescription, build: SymbolicModels | None = None) -> None:
        self.description = description
        self.n = len(description.joint_names)
        self.joint_names = description.joint_names
        self.link_names = tuple(link.name for link in description.links)
        self.base_link = description.base_link
        self.total_mass = description.total_mass
        self.lower = description.limits("lower")
        self.upper = description.limits("upper")
        self.velocity_limit = description.limits("velocity")
        self.effort_limit = description.limits("effort")
        self._model: ModelFunctions
        self._p: Array | None
        if build is None:
            self._model, self._p = self._numeric_model, None
        else:
            self._build = build
            self._model, self._p = build.model(self.inertial)
        self._buffers: dict[tuple[str, int], BufferedFunction] = {}
        self._compiles = True
        self._require_positive_inertia()

    def __reduce__(self) -> tuple[Any, ...]:
        return SpaceRobot, (self.description, None if self._p is None else self._build)

    def __repr__(self) -> str:
        name, joints = self.description.name, counted(self.n, "joint")
        return f"<SpaceRobot {name}: {joints}, {self.total_mass:.6g} kg>"

    @classmethod
    def from_file(cls, path: str | Path) -> SpaceRobot:
        """Read the robot from a URDF file; see :func:`load_robot`."""
        return cls(load_robot(path))

    @classmethod
    def from_urdf(cls, text: str) -> SpaceRobot:
        """Read the robot from a URDF string; see :func:`parse_robot`."""
        return cls(parse_robot(text))

    def with_inertial(self, parameters: InertialParameters) -> SpaceRobot:
        """Return the robot with new masses, centres of mass and inertias.

        All variants of the robot with different values share their compiled functions. If the
        values are unchanged, the robot itself is returned.

        Raises
        ------
        RobotDescriptionError
            A value is not finite, a mass is negative, all masses are zero, or an inertia is not
            physical.
        """
        parameters.require_physical([body.name for body in self.description.bodies])
        if np.array_equal(parameters.vector, self.inertial.vector):
            return self
        return self.with_masses_of(parameters.apply_to_description(self.description))

    def with_masses_of(self, description: RobotDescription) -> SpaceRobot:
        """Return the robot with the mass properties from a description with the same structure."""
        return SpaceRobot(description, self._build)

    def derived(self, description: RobotDescription) -> SpaceRobot:
        """Return a robot from a description that is derived from this robot's description, such as
        the description of its gyrostat.

        If this robot shares its compiled functions with robots that differ only in mass
        properties, so does the new robot.
        """
        shared = None if self._p is None else SymbolicModels.of(description)
        return SpaceRobot(description, shared)

    @cached_property
    def inertial(self) -> InertialParameters:
        """Mass properties of the bodies."""
        return InertialParameters.of(self.description)

    def symbolic_model(self, parameters: InertialParameters) -> tuple[ModelFunctions, Array]:
        """Return the model for inertial parameters (..., B), and its argument ``p``."""
        return self._build.model(parameters)

    # -- quantities ---------------------------------------------------------------------------

    def center_of_mass(self, q: npt.ArrayLike) -> Array:
        """Return ``r_BC_B`` (3,), m: the system's centre of mass relative to the base origin."""
        return self._call_function("center_of_mass", q)[0]

    def link_pose(self, link: str, q: npt.ArrayLike) -> tuple[Array, Array]:
        """Return ``(R_BL (3, 3), r_BL_B (3,))`` of a link frame relative to the base.

        Raises
        ------
        KeyError
            There is no such link.
        """
        index = self._model.link_index(link)
        R, r = self._call_function("link_poses", q)
        return R[:, 3 * index : 3 * index + 3], r.reshape((3, -1), order="F")[:, index]

    def inertia_matrix(self, q: npt.ArrayLike) -> Array:
        """Return ``H+`` (6 + n, 6 + n) of ``[v_cm; omega; qdot]``, in the base frame (eq. 15)."""
        return self._call_function("inertia_matrix", q)[0]

    def bias(
        self,
        q: npt.ArrayLike,
        v_cm_B: npt.ArrayLike,
        omega_WB_B: npt.ArrayLike,
        qdot: npt.ArrayLike,
    ) -> Array:
        """Return ``C+`` (6 + n,): the velocity terms of paper 4, eq. (19)."""
        return self._call_function("bias", q, v_cm_B, omega_WB_B, qdot)[0]

    def forward_dynamics(
        self,
        q: npt.ArrayLike,
        v_cm_B: npt.ArrayLike,
        omega_WB_B: npt.ArrayLike,
        qdot: npt.ArrayLike,
        wrench_B: npt.ArrayLike,
        tau: npt.ArrayLike,
    ) -> Array:
        """Return ``z0ddot`` (6 + n,): derivatives of ``[v_cm; omega; qdot]``, in the base frame
        (eq. 19).

        ``wrench_B`` (6,) is force (N) and torque (N m) at the base origin, ``tau`` (n,) efforts.
        """
        return self._call_function("forward_dynamics", q, v_cm_B, omega_WB_B, qdot, wrench_B, tau)[
            0
        ]

    def linearised(
        self,
        q: npt.ArrayLike,
        v_WB_B: npt.ArrayLike | None = None,
        omega_WB_B: npt.ArrayLike | None = None,
        qdot: npt.ArrayLike | None = None,
        wrench_B: npt.ArrayLike | None = None,
        tau: npt.ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Return ``A`` (12 + 2 n, 12 + 2 n) and ``B`` (12 + 2 n, 6 + n) of the equations of motion,
        linearised about a state and an actuation; omitted arguments are zero.

        ``d/dt dx = A dx + B du`` to first order, with ``dx = [dr; dtheta; dq; dv; domega; dqdot]``:
        position (m) and rotation vector (rad) of the base relative to its motion in that state,
        joint positions, base twist, and joint velocities. ``du = [f; n; tau]`` is the change in
        force, torque and efforts. All vectors are in the base frame.
        """
        n = self.n
        given = zip((3, 3, n, 6, n), (v_WB_B, omega_WB_B, qdot, wrench_B, tau), strict=True)
        values = [np.zeros(m) if x is None else np.asarray(x, dtype=float) for m, x in given]
        A_v, A_q, B_u = (np.array(each) for each in self._acceleration_jacobians(q, *values))
        v, omega = (hat(x) for x in values[:2])
        A = np.zeros((12 + 2 * n, 12 + 2 * n))
        A[:3, :3] = A[3:6, 3:6] = -omega
        A[:3, 3:6] = -v
        A[: 6 + n, 6 + n :] = np.eye(6 + n)
        A[6 + n :, 6 : 6 + n], A[6 + n :, 6 + n :] = A_q, A_v
        return A, np.vstack([np.zeros((6 + n, 6 + n)), B_u])

    @cached_property
    def _acceleration_jacobians(self) -> ca.Function:
        """Return the function for the derivatives of ``[vdot; omegadot; qddot]`` in B with respect
        to the velocities, ``q``, and the actuation.
        """
        n = self.n
        q, v, omega, qdot = (ca.SX.sym("x", m) for m in (n, 3, 3, n))
        wrench, tau = ca.SX.sym("wrench", 6), ca.SX.sym("tau", n)
        r = self.function("center_of_mass", compile=False)(q)
        v_BC = ca.jtimes(r, q, qdot)
        v_cm = v + ca.cross(omega, r) + v_BC
        forward = self.function("forward_dynamics", compile=False)
        rates = forward(q, v_cm, omega, qdot, wrench, tau)
        alpha, qddot = rates[3:6], rates[6:]
        dv_BC = ca.jtimes(v_BC, q, qdot) + ca.jtimes(r, q, qddot)
        vdot = rates[:3] - ca.cross(alpha, r) - ca.cross(omega, v_BC) - dv_BC
        acceleration = ca.vertcat(vdot, alpha, qddot)
        by = ca.vertcat(v, omega, qdot), q, ca.vertcat(wrench, tau)
        results = [ca.jacobian(acceleration, each) for each in by]
        return ca.Function("linearised", [q, v, omega, qdot, wrench, tau], results)

    def joint_efforts(self, q: npt.ArrayLike, qdot: npt.ArrayLike, qddot: npt.ArrayLike) -> Array:
        """Return the efforts (n,), N or N m, required for a joint motion at zero momentum.

        No wrench acts on the base; its motion follows from the momenta.
        """
        return self._call_function("joint_efforts", q, qdot, qddot)[0]

    def jacobian(self, link: str, q: npt.ArrayLike) -> Array:
        """Return ``0J+`` (6, 6 + n) for a link frame origin (paper 4, eq. 10), in the base frame.

        The matrix maps ``[v_cm; omega; qdot]`` to linear and angular velocity.

        Raises
        ------
        KeyError
            There is no such link.
        """
        self._model.link_index(link)
        return self._call_function(f"jacobian:{link}", q)[0]

    def generalised_jacobian(self, link: str, q: npt.ArrayLike) -> Array:
        """Return ``J*`` (6, n) for a link frame origin at zero momentum, in the base frame.

        The matrix maps ``qdot`` to linear and angular velocity in the world, while the base moves
        according to the momenta (Umetani and Yoshida's generalised Jacobian).

        Raises
        ------
        KeyError
            There is no such link.
        """
        J = self.jacobian(link, q)
        # The centre of mass is at rest, and the base rotates at -A qdot.
        return np.asarray(J[:, 6:] - J[:, 3:6] @ self.connection(q)[3:])

    def connection(self, q: npt.ArrayLike) -> Array:
        """Return ``A(q)`` (6, n): ``[v_WB_B; omega_WB_B] = -A qdot`` at zero momentum (paper 1)."""
        return self._call_function("connection", q)[0].reshape((6, self.n), order="F")

    def reaction_null_space(self, q: npt.ArrayLike) -> Array:
        """Return an orthonormal basis (n, k) of joint rates that do not rotate the base.

        These rates span the null space of the coupling inertia ``D_q`` (Nenchev, Umetani and
        Yoshida, 1992, cited from memory): at zero angular momentum, the base keeps its attitude
        while the joints move at these rates. The projection ``N N'`` maps any rates to the nearest
        such rates.
        """
        _, s, Vt = np.linalg.svd(self.connection(q)[3:])
        rank = int(np.count_nonzero(s > _MIN_RELATIVE_COUPLING * max(1.0, s.max(initial=0.0))))
        return np.asarray(Vt[rank:].T)

    def curvature(self, q: npt.ArrayLike) -> Array:
        """Return the curvature ``K`` (6, n, n) of ``F = -A``:
        ``dF_j/dq_i - dF_i/dq_j + [F_i, F_j]``.

        A small counter-clockwise loop in (q_i, q_j) displaces the base by ``K[:, i, j] * area``.
        """
        stacked = self._call_function("curvature", q)[0]
        return stacked.reshape((6, self.n, self.n), order="F")

    def momentum(
        self,
        quaternion_WB: npt.ArrayLike,
        q: npt.ArrayLike,
        v_WB_B: npt.ArrayLike,
        omega_WB_B: npt.ArrayLike,
        qdot: npt.ArrayLike,
    ) -> tuple[Array, Array, float]:
        """Return the linear momentum (3,) in kg m/s and the angular momentum about the system's
        centre of mass (3,) in kg m^2/s, both in W, and the kinetic energy in J, summed body by
        body.
        """
        p, L, energy = self._call_function("momentum", quaternion_WB, q, v_WB_B, omega_WB_B, qdot)
        return p, L, float(energy[0])

    def base_twist(
        self,
        quaternion_WB: npt.ArrayLike,
        q: npt.ArrayLike,
        qdot: npt.ArrayLike,
        p_W: npt.ArrayLike = (0, 0, 0),
        L_W: npt.ArrayLike = (0, 0, 0),
    ) -> tuple[Array, Array]:
        """Return ``(v_WB_B, omega_WB_B)`` for joint rates and momenta (L about the centre of
        mass)."""
        v, omega = self._call_function("base_twist", quaternion_WB, q, qdot, p_W, L_W)
        return v, omega

    # -- compiled functions -------------------------------------------------------------------

    def function(self, name: str, *, compile: bool = True) -> ca.Function:
        """Return a model function by name (see :class:`.ModelFunctions`), with this robot's
        mass properties as constants.

        ``compile=False`` returns the symbolic function, for composing larger functions.
        """
        return self._numeric_model.function(name, compile=compile)

    def buffered(self, name: str) -> BufferedFunction:
        """Return a function with its own input and output buffers, for use by one caller."""
        return BufferedFunction(self._model.function(name, compile=self._compiles), self._p)

    @cached_property
    def interpreted(self) -> SpaceRobot:
        """The same robot without compilation, for a few calls: model functions run in CasADi's
        virtual machine, with bit-identical results.
        """
        robot = copy.copy(self)
        robot._buffers, robot._compiles = {}, False
        return robot

    def composed(
        self,
        key: Hashable,
        build: Callable[[], ca.Function],
        inputs: Sequence[Array] = (),
        outputs: Sequence[Array] = (),
    ) -> BufferedFunction:
        """Return a buffered function that ``build`` composes from :meth:`expressions`, with the
        memory of the first ``inputs`` and ``outputs`` as for :class:`.BufferedFunction`.

        The function is compiled once per key for all robots that differ only in mass properties,
        for evaluation at every tick.
        """
        function = self._model.composed(key, build, compile=self._compiles)
        return BufferedFunction(function, self._p, inputs, outputs)

    def expressions(self, kind: type[ca.MX] | type[ca.SX] = ca.SX) -> Composition:
        """Return the model functions as expressions, to build larger functions."""
        return Composition(self._model, kind)

    def view(
        self, key: Hashable, make: Callable[[], ca.Function]
    ) -> tuple[ca.Function, BufferedFunction]:
        """Return a function made from :meth:`expressions`, and its compiled version with its own
        buffers, whose argument ``p``, if any, is set to this robot's mass properties.

        The function is made and compiled once per key for all robots that share the expressions:
        robots with equal mass properties, or with mass properties as an argument.
        """
        function = self._model.composed(("view", key), make, compile=False)
        return function, self.composed(("view", key), lambda: function)

    @property
    def mass_arguments(self) -> dict[str, Array]:
        """The last argument of functions from :meth:`expressions`, by name; empty if there is
        none."""
        return {} if self._p is None else {"p": self._p}

    @property
    def equations_key(self) -> str:
        """Hash of the equations at zero momentum, identical for robots with identical equations."""
        return self._numeric_model.equations_key

    @cached_property
    def _build(self) -> SymbolicModels:
        return SymbolicModels.of(self.description)

    @cached_property
    def _numeric_model(self) -> ModelFunctions:
        """The model with this robot's mass properties as constants."""
        return ModelFunctions.of(self.description)

    # -- helpers ------------------------------------------------------------------------------

    def _call_function(self, name: str, *arguments: npt.ArrayLike) -> tuple[Array, ...]:
        key = name, threading.get_ident()  # Buffers are overwritten by the next call.
        if key not in self._buffers:
            self._buffers[key] = self.buffered(name)
        return self._buffers[key](*(np.asarray(a, dtype=float) for a in arguments))

    def _require_positive_inertia(self) -> None:
        """Reject a robot whose inertia matrix is singular; the message names the joint or link."""
        H = self._model.function("inertia_matrix", compile=False)
        p = [] if self._p is None else [self._p]
        middle = np.clip(np.zeros(self.n), self.lower, self.upper)
        shapes = (np.zeros(self.n), middle, 0.1 * np.arange(1, self.n + 1))
        found = [np.linalg.eigh(np.array(H(shape, *p))) for shape in shapes]
        values, vectors = min(found, key=lambda each: float(each[0][0]))
        if values[0] > 1e-12 * self.total_mass:
            return
        moved = np.abs(vectors[6:, 0])
        box = "an <inertia> (for a box with sides a, b and c: ixx = m (b^2 + c^2) / 12, and so on)"
        if not moved.size or moved.max() < _MIN_RELATIVE_INERTIA:
            mend = (
                f"it can rotate without moving any mass. Give '{self.description.base_link}' {box}."
            )
        else:
            i = int(moved.argmax())
            joint = self.description.movable_joints[i]
            outer = np.array(H(shapes[1], *p))[6 + i, 6 + i]
            link = joint.child if outer <= 1e-12 * self.total_mass else joint.parent
            mend = (
                f"its joint '{joint.name}' can move without moving any mass, because the bodies on "
                f"the side of '{link}' have no inertia about its axis. Give '{link}' {box}, or "
                "make the joint fixed."
            )
        raise RobotDescriptionError(
            f"The inertia matrix of robot '{self.description.name}' is not positive definite: "
            f"{mend}"
        )
