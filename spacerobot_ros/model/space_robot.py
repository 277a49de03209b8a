"""The model of one robot: every equation the stack uses, compiled, behind plain methods.

Frames: world W, base link B. Vectors with suffix ``_B`` are in base components. The shape ``q``
(n,) is ordered as ``joint_names``. Convenience methods return new arrays; what runs every period
takes a :class:`BufferedFunction` from :meth:`SpaceRobot.buffered` and works in place.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.compilation import (
    BufferedFunction,
    compiled,
    dense_function,
    kept_function,
    source_of,
)
from spacerobot_ros.model.composite_rigid_body import (
    composite_dynamics,
    composites,
    joint_efforts,
    shape_equations,
    state_rate,
    state_slices,
)
from spacerobot_ros.model.connection import base_twist, connection, curvature, momentum_of_bodies
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.dynamics import (
    barycentric_inertia,
    bias,
    forward_dynamics,
    generalised_forces,
    point_jacobian,
)
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.integration import attitude_step, repeated, runge_kutta_step
from spacerobot_ros.model.kinematics import tree_kinematics
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion
from spacerobot_ros.model.urdf import load_robot, parse_robot


class SpaceRobot:
    """Equations of a free-floating robot, built once from its description.

    Parameters
    ----------
    description
        The robot, as :func:`load_robot` or :func:`parse_robot` return it.

    Raises
    ------
    RobotDescriptionError
        The inertia matrix of the described robot is not positive definite.
    """

    def __init__(self, description: RobotDescription) -> None:
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
        self._kin = tree_kinematics(description)
        self._inertia = composites(self._kin)
        self._symbolic: dict[str, ca.Function] = {}
        self._compiled: dict[str, ca.Function] = {}
        self._buffers: dict[str, BufferedFunction] = {}
        self._require_positive_inertia()

    @classmethod
    def from_file(cls, path: str | Path) -> SpaceRobot:
        """Read the robot of a URDF file; see :func:`load_robot`."""
        return cls(load_robot(path))

    @classmethod
    def from_urdf(cls, text: str) -> SpaceRobot:
        """Read the robot of a URDF text; see :func:`parse_robot`."""
        return cls(parse_robot(text))

    def with_inertial(self, parameters: InertialParameters) -> SpaceRobot:
        """Return the robot with other masses, centres of mass and inertias.

        Raises
        ------
        RobotDescriptionError
            No robot weighs that.
        """
        parameters.require_physical([body.name for body in self.description.bodies])
        return SpaceRobot(parameters.described(self.description))

    # -- quantities ---------------------------------------------------------------------------

    def center_of_mass(self, q: npt.ArrayLike) -> Array:
        """Return ``r_BC_B`` (3,), m: the system's centre of mass from the base origin."""
        return self._call("center_of_mass", q)[0]

    def link_pose(self, link: str, q: npt.ArrayLike) -> tuple[Array, Array]:
        """Return ``(R_BL (3, 3), r_BL_B (3,))`` of a link's frame in the base.

        Raises
        ------
        KeyError
            There is no such link.
        """
        index = self._link_index(link)
        R, r = self._call("link_poses", q)
        return R[:, 3 * index : 3 * index + 3], r.reshape((3, -1), order="F")[:, index]

    def inertia_matrix(self, q: npt.ArrayLike) -> Array:
        """Return ``H+`` (6 + n, 6 + n) of ``[v_cm; omega; qdot]``, base components (eq. 15)."""
        return self._call("inertia_matrix", q)[0]

    def bias(
        self,
        q: npt.ArrayLike,
        v_cm_B: npt.ArrayLike,
        omega_WB_B: npt.ArrayLike,
        qdot: npt.ArrayLike,
    ) -> Array:
        """Return ``C+`` (6 + n,): the velocity terms of paper 4, eq. (19)."""
        return self._call("bias", q, v_cm_B, omega_WB_B, qdot)[0]

    def forward_dynamics(
        self,
        q: npt.ArrayLike,
        v_cm_B: npt.ArrayLike,
        omega_WB_B: npt.ArrayLike,
        qdot: npt.ArrayLike,
        wrench_B: npt.ArrayLike,
        tau: npt.ArrayLike,
    ) -> Array:
        """Return ``z0ddot`` (6 + n,): rates of ``[v_cm; omega; qdot]``, base components (eq. 19).

        ``wrench_B`` (6,) is force (N) over torque (N m) at the base origin, ``tau`` (n,) efforts.
        """
        return self._call("forward_dynamics", q, v_cm_B, omega_WB_B, qdot, wrench_B, tau)[0]

    def joint_efforts(self, q: npt.ArrayLike, qdot: npt.ArrayLike, qddot: npt.ArrayLike) -> Array:
        """Return the efforts (n,), N or N m, that move the shape so at zero momentum.

        Nothing pushes the base, which moves as the momenta demand.
        """
        return self._call("joint_efforts", q, qdot, qddot)[0]

    def jacobian(self, link: str, q: npt.ArrayLike) -> Array:
        """Return ``0J+`` (6, 6 + n) of a link's frame origin (paper 4, eq. 10), base components.

        It maps ``[v_cm; omega; qdot]`` to linear over angular velocity.

        Raises
        ------
        KeyError
            There is no such link.
        """
        self._link_index(link)
        return self._call(f"jacobian:{link}", q)[0]

    def connection(self, q: npt.ArrayLike) -> Array:
        """Return ``A(q)`` (6, n): ``[v_WB_B; omega_WB_B] = -A qdot`` at zero momentum (paper 1)."""
        return self._call("connection", q)[0].reshape((6, self.n), order="F")

    def curvature(self, q: npt.ArrayLike) -> Array:
        """Return ``K`` (6, n, n) of ``F = -A``: ``dF_j/dq_i - dF_i/dq_j + [F_i, F_j]``.

        A small loop counter-clockwise in (q_i, q_j) displaces the base by ``K[:, i, j] * area``.
        """
        stacked = self._call("curvature", q)[0]
        return stacked.reshape((6, self.n, self.n), order="F")

    def lie_brackets(self, q: npt.ArrayLike) -> Array:
        """Return ``w`` (3, n, n), ``w[:, i, j] = omega_[Fi,Fj]``: paper 1's brackets, eq. (7).

        They are minus the angular part of :meth:`curvature`.
        """
        return -self.curvature(q)[3:]

    def momentum(
        self,
        quaternion_WB: npt.ArrayLike,
        q: npt.ArrayLike,
        v_WB_B: npt.ArrayLike,
        omega_WB_B: npt.ArrayLike,
        qdot: npt.ArrayLike,
    ) -> tuple[Array, Array, float]:
        """Return linear momentum (3,) in kg m/s and angular momentum about the system's centre of
        mass (3,) in kg m^2/s, both in W, and kinetic energy in J; summed body by body.
        """
        p, L, energy = self._call("momentum", quaternion_WB, q, v_WB_B, omega_WB_B, qdot)
        return p, L, float(energy[0])

    def base_twist(
        self,
        quaternion_WB: npt.ArrayLike,
        q: npt.ArrayLike,
        qdot: npt.ArrayLike,
        p_W: npt.ArrayLike = (0, 0, 0),
        L_W: npt.ArrayLike = (0, 0, 0),
    ) -> tuple[Array, Array]:
        """Return ``(v_WB_B, omega_WB_B)`` at given joint rates and momenta (L about the CM)."""
        v, omega = self._call("base_twist", quaternion_WB, q, qdot, p_W, L_W)
        return v, omega

    # -- compiled functions -------------------------------------------------------------------

    def function(self, name: str, *, compile: bool = True) -> ca.Function:
        """Return a function of the model by name (the keys of ``_builders``).

        ``compile=False`` gives the symbolic function, to build larger ones from.
        """
        kind, _, argument = name.partition(":")
        if name not in self._symbolic:
            build = self._builders[kind]
            self._symbolic[name] = build(argument) if argument else build()
        # Curvature is wide and asked for once in a plan: compiling it would take longer than all
        # its calls.
        if not compile or kind == "curvature":
            return self._symbolic[name]
        if name not in self._compiled:
            self._compiled[name] = compiled(self._symbolic[name])
        return self._compiled[name]

    def buffered(self, name: str) -> BufferedFunction:
        """Return a new buffered view of a function, for one caller's own use."""
        return BufferedFunction(self.function(name))

    def velocity_step(self, substeps: int) -> BufferedFunction:
        """Return the step under held joint velocities ``(x, qdot, L_W, h) -> x``.

        ``x = [q; quaternion_WB]``; the step of ``h`` seconds is taken in ``substeps``
        Runge-Kutta steps of the attitude (see :mod:`spacerobot_ros.model.integration`).
        """
        return self.buffered(f"velocity_step:{substeps}")

    @cached_property
    def equations_key(self) -> str:
        """A hash of the equations at zero momentum: equal for robots that move alike."""
        digest = hashlib.sha256()
        for name in ("locked_inertia", "center_of_mass"):
            digest.update(self.function(name, compile=False).serialize().encode())
        return digest.hexdigest()

    @cached_property
    def _builders(self) -> dict[str, Callable[..., ca.Function]]:
        return {
            "center_of_mass": lambda: self._shape_function("center_of_mass", self._kin.r_BC_B),
            "locked_inertia": self._locked_inertia,
            "link_poses": self._link_poses,
            "inertia_matrix": lambda: self._shape_function("inertia_matrix", self._inertia.H_plus),
            "bias": self._bias,
            "forward_dynamics": self._forward_dynamics,
            "dynamics": self._dynamics,
            "shape_equations": lambda: shape_equations(self._kin),
            "flight_step": self._flight_step,
            "holding_step": lambda: self._flight_step(holding=True),
            "joint_efforts": self._joint_efforts,
            "jacobian": self._jacobian,
            "connection": lambda: self._shape_function("connection", self._A),
            "curvature": self._curvature,
            "momentum": self._momentum,
            "base_twist": self._base_twist,
            "rotate": self._rotate,
            "velocity_step": self._velocity_step,
        }

    @cached_property
    def _A(self) -> ca.SX:
        return connection(self._kin, self._inertia)

    def _shape_function(self, name: str, *outputs: ca.SX) -> ca.Function:
        names = ["result"] if len(outputs) == 1 else [f"result_{i}" for i in range(len(outputs))]
        return dense_function(name, {"q": self._kin.q}, dict(zip(names, outputs, strict=True)))

    def _locked_inertia(self) -> ca.Function:
        return self._shape_function("locked_inertia", self._inertia.D, self._inertia.D_q)

    def _link_poses(self) -> ca.Function:
        frames = [self._kin.frame(link) for link in self.link_names]
        R = ca.horzcat(*(frame[0] for frame in frames))
        r = ca.horzcat(*(frame[1] for frame in frames))
        return dense_function("link_poses", {"q": self._kin.q}, {"R_BL": R, "r_BL_B": r})

    def _state(self, v: str, *, quaternion: bool = False) -> dict[str, ca.SX]:
        """Return symbols of the shape and the velocities, by name; ``v`` names the first."""
        attitude = {"quaternion_WB": ca.SX.sym("quaternion", 4)} if quaternion else {}
        return {
            **attitude,
            "q": self._kin.q,
            v: ca.SX.sym("v", 3),
            "omega_WB_B": ca.SX.sym("omega", 3),
            "qdot": ca.SX.sym("qdot", self.n),
        }

    def _bias(self) -> ca.Function:
        state = self._state("v_cm_B")
        _, *velocities = state.values()
        return dense_function("bias", state, {"C_plus": bias(self._kin, *velocities)})

    def _forward_dynamics(self) -> ca.Function:
        state = self._state("v_cm_B")
        _, *velocities = state.values()
        wrench, tau = ca.SX.sym("wrench_B", 6), ca.SX.sym("tau", self.n)
        forces = generalised_forces(self._kin, wrench, tau)
        inertia = barycentric_inertia(self._kin)
        acceleration = forward_dynamics(inertia, bias(self._kin, *velocities), forces)
        inputs = {**state, "wrench_B": wrench, "tau": tau}
        return dense_function("forward_dynamics", inputs, {"z0ddot": acceleration})

    def _dynamics(self) -> ca.Function:
        """The same function as ``forward_dynamics``, by fewer operations."""
        state = self._state("v_cm_B")
        _, *velocities = state.values()
        forces = {"wrench_B": ca.SX.sym("wrench_B", 6), "tau": ca.SX.sym("tau", self.n)}
        acceleration = composite_dynamics(self._kin, *velocities, *forces.values())
        return dense_function("dynamics", {**state, **forces}, {"z0ddot": acceleration})

    def _flight_step(self, *, holding: bool = False) -> ca.Function:
        rate = state_rate(self._kin, holding=holding)
        return runge_kutta_step(rate, attitude=state_slices(self.n)[1])

    def _joint_efforts(self) -> ca.Function:
        rates = {"qdot": ca.SX.sym("qdot", self.n), "qddot": ca.SX.sym("qddot", self.n)}
        efforts = joint_efforts(self._kin, *rates.values())
        return dense_function("joint_efforts", {"q": self._kin.q, **rates}, {"tau": efforts})

    def _jacobian(self, link: str) -> ca.Function:
        index = self._link_index(link)
        return self._shape_function(f"jacobian_{index}", point_jacobian(self._kin, link))

    def _curvature(self) -> ca.Function:
        def derived() -> ca.Function:
            K = curvature(self._A, self._kin.q)
            # Columns run over i fastest: reshaped in Fortran order this is (6, i, j).
            stacked = ca.horzcat(*(K[i][j] for j in range(self.n) for i in range(self.n)))
            return self._shape_function("curvature", stacked)

        facts = f"{source_of(curvature.__module__)} {self.equations_key}"
        key = hashlib.sha256(facts.encode()).hexdigest()
        return kept_function("curvature", key, derived, compiling=False)

    def _momentum(self) -> ca.Function:
        state = self._state("v_WB_B", quaternion=True)
        quaternion, _, *velocities = state.values()
        R_WB = matrix_from_quaternion(quaternion)
        p_B, L_B, energy = momentum_of_bodies(self._kin, *velocities)
        outputs = {"p_W": R_WB @ p_B, "L_W": R_WB @ L_B, "energy": energy}
        return dense_function("momentum", state, outputs)

    def _base_twist(self) -> ca.Function:
        qdot = ca.SX.sym("qdot", self.n)
        quaternion, p_W, L_W = ca.SX.sym("quaternion", 4), ca.SX.sym("p", 3), ca.SX.sym("L", 3)
        R_BW = matrix_from_quaternion(quaternion).T
        v, omega = base_twist(self._kin, self._inertia, qdot, R_BW @ p_W, R_BW @ L_W)
        inputs = {"quaternion_WB": quaternion, "q": self._kin.q, "qdot": qdot}
        inputs |= {"p_W": p_W, "L_W": L_W}
        return dense_function("base_twist", inputs, {"v_WB_B": v, "omega_WB_B": omega})

    def _rotate(self) -> ca.Function:
        quaternion, vector = ca.SX.sym("quaternion", 4), ca.SX.sym("vector", 3)
        rotated = matrix_from_quaternion(quaternion) @ vector
        inputs = {"quaternion_WB": quaternion, "vector_B": vector}
        return dense_function("rotate", inputs, {"vector_W": rotated})

    def _velocity_step(self, substeps: str) -> ca.Function:
        count = int(substeps)
        step = attitude_step(self._locked_inertia())
        x0, qdot = ca.MX.sym("x", self.n + 4), ca.MX.sym("qdot", self.n)
        L_W, h = ca.MX.sym("L_W", 3), ca.MX.sym("h")
        x = repeated(step, count)(x0, qdot, L_W, h / count)
        names = ["x", "qdot", "L_W", "h"]
        return ca.Function(f"velocity_step_{count}", [x0, qdot, L_W, h], [x], names, ["x_next"])

    # -- helpers ------------------------------------------------------------------------------

    def _call(self, name: str, *arguments: npt.ArrayLike) -> tuple[Array, ...]:
        if name not in self._buffers:
            self._buffers[name] = self.buffered(name)
        return self._buffers[name](*(np.asarray(a, dtype=float) for a in arguments))

    def _link_index(self, link: str) -> int:
        try:
            return self.link_names.index(link)
        except ValueError:
            raise KeyError(
                f"robot '{self.description.name}' has no link '{link}'; "
                f"it has {', '.join(self.link_names)}"
            ) from None

    def _require_positive_inertia(self) -> None:
        H = ca.Function("H", [self._kin.q], [self._inertia.H_plus])
        middle = np.clip(np.zeros(self.n), self.lower, self.upper)
        shapes = (np.zeros(self.n), middle, 0.1 * np.arange(1, self.n + 1))
        smallest = min(float(np.linalg.eigvalsh(np.array(H(shape)))[0]) for shape in shapes)
        if smallest <= 1e-12 * self.total_mass:
            raise RobotDescriptionError(
                f"The inertia matrix of robot '{self.description.name}' is not positive definite: "
                "some part turns or moves without mass or without inertia about its axis."
            )
