"""Named functions of a robot model, built on demand and compiled once.

The mass properties of a model are either constants or the last argument ``p`` of all its functions.
In the latter case, one compilation serves all robots that differ only in mass properties.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from spacerobot_ros.model.compilation import (
    compilation_settings,
    compiled,
    dense_function,
)
from spacerobot_ros.model.composite_rigid_body import (
    composite_dynamics,
    composites,
    joint_efforts,
    servo_rate,
    shape_equations,
    state_rate,
    state_slices,
)
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.dynamics import (
    base_twist,
    bias,
    connection,
    curvature,
    momentum_derivatives,
    momentum_of_bodies,
    point_jacobian,
)
from spacerobot_ros.model.external_loads import LoadLayout, external_loads
from spacerobot_ros.model.inertial_parameters import (
    InertialParameters,
    SymbolicMassProperties,
    possibly_nonzero_entries,
)
from spacerobot_ros.model.integration import (
    attitude_step,
    divided_step,
    runge_kutta_step,
)
from spacerobot_ros.model.kinematics import tree_kinematics
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion


class ModelFunctions:
    """All functions of one robot model.

    Parameters
    ----------
    robot
        The robot.
    mass_properties
        Mass properties of the bodies as symbols; by default, they are constants.
    """

    def __init__(
        self, robot: RobotDescription, mass_properties: SymbolicMassProperties | None = None
    ) -> None:
        self.n = len(robot.joint_names)
        self.link_names = tuple(link.name for link in robot.links)
        self._kin = tree_kinematics(robot, mass_properties)
        self._inertia = composites(self._kin)
        self._symbolic: dict[str, ca.Function] = {}
        self._compiled: dict[tuple[Hashable, ...], ca.Function] = {}
        self.derived: dict[Hashable, Any] = {}
        """Cache of objects derived from the model by other modules, by key."""

    @classmethod
    def of(cls, robot: RobotDescription) -> ModelFunctions:
        """Return the model with a robot's mass properties as constants; identical robots in a
        process share the model."""
        return _model_of_key(_RobotKey.of(robot, robot))

    def function(self, name: str, *, compile: bool = True) -> ca.Function:
        """Return a model function by name (one of the keys of ``_builders``).

        ``compile=False`` returns the symbolic function, for building larger functions.
        """
        kind, _, argument = name.partition(":")
        if name not in self._symbolic:
            build = self._builders[kind]
            self._symbolic[name] = build(argument) if argument else build()
        # Compiling the large curvature would take longer than its few calls in a plan.
        if not compile or kind == "curvature":
            return self._symbolic[name]
        return self.composed(name, lambda: self._symbolic[name])

    def composed(self, key: Hashable, build: Callable[[], ca.Function]) -> ca.Function:
        """Return a function composed of model functions, compiled once per key."""
        place = (key, *compilation_settings())
        if place not in self._compiled:
            self._compiled[place] = compiled(build())
        return self._compiled[place]

    @property
    def total_mass(self) -> float:
        """System mass, kg; only for models with constant mass properties."""
        return float(self._kin.total_mass)

    @property
    def mass_inputs(self) -> dict[str, ca.SX]:
        """The symbol ``p`` by name; empty if the mass properties are constants."""
        return self._kin.mass_properties.inputs

    @cached_property
    def equations_key(self) -> str:
        """Hash of the equations at zero momentum, identical for robots with the same motion."""
        digest = hashlib.sha256()
        for name in ("locked_inertia", "center_of_mass"):
            digest.update(self.function(name, compile=False).serialize().encode())
        return digest.hexdigest()

    def link_index(self, link: str) -> int:
        """Return the index of a link.

        Raises
        ------
        KeyError
            There is no such link.
        """
        try:
            return self.link_names.index(link)
        except ValueError:
            raise KeyError(
                f"robot '{self._kin.robot.name}' has no link '{link}'; "
                f"it has {', '.join(self.link_names)}"
            ) from None

    @cached_property
    def _builders(self) -> dict[str, Callable[..., ca.Function]]:
        return {
            "center_of_mass": lambda: self._shape_function("center_of_mass", self._kin.r_BC_B),
            "locked_inertia": self._locked_inertia,
            "momentum_derivatives": self._momentum_derivatives,
            "link_poses": self._link_poses,
            "inertia_matrix": lambda: self._shape_function("inertia_matrix", self._inertia.H_plus),
            "bias": self._bias,
            "forward_dynamics": self._forward_dynamics,
            "shape_equations": lambda: shape_equations(self._kin),
            "flight_step": self._flight_step,
            "holding_step": lambda: self._flight_step(holding=True),
            "loaded_shape_equations": lambda: shape_equations(self._kin, loaded=True),
            "loaded_flight_step": lambda: self._flight_step(loaded=True),
            "loaded_holding_step": lambda: self._flight_step(holding=True, loaded=True),
            "joint_efforts": self._joint_efforts,
            "servo_efforts": self._servo_efforts,
            "loaded_servo_efforts": lambda: self._servo_efforts(loaded=True),
            "jacobian": self._jacobian,
            "connection": lambda: self._shape_function("connection", self._connection),
            "curvature": self._curvature,
            "momentum": self._momentum,
            "base_twist": self._base_twist,
            "rotate": self._rotate,
            "velocity_step": self._velocity_step,
            "loaded_velocity_step": self._loaded_velocity_step,
            "total_mass": self._total_mass,
        }

    @cached_property
    def _connection(self) -> ca.SX:
        return connection(self._kin, self._inertia)

    def _dense_model_function(
        self, name: str, inputs: dict[str, ca.SX], outputs: dict[str, ca.SX]
    ) -> ca.Function:
        """Return a function of the model; symbolic mass properties become its last input."""
        return dense_function(name, inputs | self.mass_inputs, outputs)

    def _shape_function(self, name: str, *outputs: ca.SX) -> ca.Function:
        names = ["result"] if len(outputs) == 1 else [f"result_{i}" for i in range(len(outputs))]
        return self._dense_model_function(
            name, {"q": self._kin.q}, dict(zip(names, outputs, strict=True))
        )

    def _locked_inertia(self) -> ca.Function:
        return self._shape_function("locked_inertia", self._inertia.D, self._inertia.D_q)

    def _momentum_derivatives(self) -> ca.Function:
        symbols = [self._kin.q, *(ca.SX.sym(k, d) for k, d in (("omega", 3), ("qdot", self.n)))]
        symbols.append(ca.SX.sym("eta", 3))
        results = momentum_derivatives(self._inertia, *symbols[1:])
        return ca.Function("momentum_derivatives", symbols, ca.cse([*results]))

    def _link_poses(self) -> ca.Function:
        frames = [self._kin.frame(link) for link in self.link_names]
        R = ca.horzcat(*(frame[0] for frame in frames))
        r = ca.horzcat(*(frame[1] for frame in frames))
        return self._dense_model_function(
            "link_poses", {"q": self._kin.q}, {"R_BL": R, "r_BL_B": r}
        )

    def _state_symbols(self, v: str, *, quaternion: bool = False) -> dict[str, ca.SX]:
        """Return shape and velocity symbols by name; ``v`` is the name of the linear velocity."""
        attitude = {"quaternion_WB": ca.SX.sym("quaternion", 4)} if quaternion else {}
        return {
            **attitude,
            "q": self._kin.q,
            v: ca.SX.sym("v", 3),
            "omega_WB_B": ca.SX.sym("omega", 3),
            "qdot": ca.SX.sym("qdot", self.n),
        }

    def _bias(self) -> ca.Function:
        state = self._state_symbols("v_cm_B")
        _, *velocities = state.values()
        return self._dense_model_function("bias", state, {"C_plus": bias(self._kin, *velocities)})

    def _forward_dynamics(self) -> ca.Function:
        state = self._state_symbols("v_cm_B")
        _, *velocities = state.values()
        forces = {"wrench_B": ca.SX.sym("wrench_B", 6), "tau": ca.SX.sym("tau", self.n)}
        acceleration = composite_dynamics(self._kin, *velocities, *forces.values())
        inputs = {**state, **forces}
        return self._dense_model_function("forward_dynamics", inputs, {"z0ddot": acceleration})

    def _flight_step(self, *, holding: bool = False, loaded: bool = False) -> ca.Function:
        rate = state_rate(self._kin, holding=holding, loaded=loaded)
        return runge_kutta_step(rate, attitude=state_slices(self.n)[1])

    def _joint_efforts(self) -> ca.Function:
        rates = {"qdot": ca.SX.sym("qdot", self.n), "qddot": ca.SX.sym("qddot", self.n)}
        efforts = joint_efforts(self._kin, *rates.values())
        return self._dense_model_function(
            "joint_efforts", {"q": self._kin.q, **rates}, {"tau": efforts}
        )

    def _servo_efforts(self, *, loaded: bool = False) -> ca.Function:
        """Return the servo efforts that change the joint rates within ``h``."""
        n, quaternion = self.n, ca.SX.sym("quaternion", 4)
        before, after = ca.SX.sym("before", n), ca.SX.sym("after", n)
        L_W, h = ca.SX.sym("L_W", 3), ca.SX.sym("h")
        mean, change = (before + after) / 2, (after - before) / h
        L_B = matrix_from_quaternion(quaternion).T @ L_W
        inputs = {"quaternion_WB": quaternion, "q": self._kin.q, "before": before, "after": after}
        inputs |= {"L_W": L_W, "h": h}
        if not loaded:
            efforts = joint_efforts(self._kin, mean, change, L_B)
            return self._dense_model_function("servo_efforts", inputs, {"tau": efforts})
        layout = LoadLayout(len(self.link_names))
        r_WC_W, vector = ca.SX.sym("r_WC_W", 3), ca.SX.sym("loads", layout.size)
        J, time = self._inertia.J, vector[layout.time]
        loads = external_loads(self._kin, J, quaternion, r_WC_W, vector, time)
        efforts = joint_efforts(self._kin, mean, change, L_B, loads)
        inputs |= {"r_WC_W": r_WC_W, "loads": vector}
        return self._dense_model_function("loaded_servo_efforts", inputs, {"tau": efforts})

    def _jacobian(self, link: str) -> ca.Function:
        index = self.link_index(link)
        return self._shape_function(f"jacobian_{index}", point_jacobian(self._kin, link))

    def _curvature(self) -> ca.Function:
        K = curvature(self._connection, self._kin.q)
        # Index i varies fastest: reshaped in Fortran order, this is (6, i, j).
        stacked = ca.horzcat(*(K[i][j] for j in range(self.n) for i in range(self.n)))
        inputs = {"q": self._kin.q} | self.mass_inputs
        # It has few common subexpressions, and searching for them takes several times as long.
        names = [*inputs], ["result"]
        return ca.Function("curvature", [*inputs.values()], [ca.densify(stacked)], *names)

    def _momentum(self) -> ca.Function:
        state = self._state_symbols("v_WB_B", quaternion=True)
        quaternion, _, *velocities = state.values()
        R_WB = matrix_from_quaternion(quaternion)
        p_B, L_B, energy = momentum_of_bodies(self._kin, *velocities)
        outputs = {"p_W": R_WB @ p_B, "L_W": R_WB @ L_B, "energy": energy}
        return self._dense_model_function("momentum", state, outputs)

    def _base_twist(self) -> ca.Function:
        qdot = ca.SX.sym("qdot", self.n)
        quaternion, p_W, L_W = ca.SX.sym("quaternion", 4), ca.SX.sym("p", 3), ca.SX.sym("L", 3)
        R_BW = matrix_from_quaternion(quaternion).T
        v, omega = base_twist(self._kin, self._inertia, qdot, R_BW @ p_W, R_BW @ L_W)
        inputs = {"quaternion_WB": quaternion, "q": self._kin.q, "qdot": qdot}
        inputs |= {"p_W": p_W, "L_W": L_W}
        return self._dense_model_function("base_twist", inputs, {"v_WB_B": v, "omega_WB_B": omega})

    def _rotate(self) -> ca.Function:
        quaternion, vector = ca.SX.sym("quaternion", 4), ca.SX.sym("vector", 3)
        rotated = matrix_from_quaternion(quaternion) @ vector
        inputs = {"quaternion_WB": quaternion, "vector_B": vector}
        return self._dense_model_function("rotate", inputs, {"vector_W": rotated})

    def _velocity_step(self, substeps: str) -> ca.Function:
        step = attitude_step(self._locked_inertia())
        return divided_step(f"velocity_step_{substeps}", step, int(substeps))

    def _loaded_velocity_step(self, substeps: str) -> ca.Function:
        """Return ``(x, qdot, loads, h) -> x`` of :func:`.servo_rate` in some Runge-Kutta steps."""
        step = runge_kutta_step(servo_rate(self._kin), attitude=slice(self.n, self.n + 4))
        return divided_step(f"loaded_velocity_step_{substeps}", step, int(substeps))

    def _total_mass(self) -> ca.Function:
        return dense_function("total_mass", self.mass_inputs, {"M": self._kin.total_mass})


_MAX_SYMBOLIC_MODELS = 8
"""Number of models per cache; the least recently used model is dropped first."""


@dataclass(frozen=True)
class _RobotKey:
    """A robot identified by a hash of its relevant properties."""

    key: str
    robot: RobotDescription = field(compare=False)

    @classmethod
    def of(cls, robot: RobotDescription, facts: object) -> _RobotKey:
        return cls(hashlib.sha256(pickle.dumps(facts)).hexdigest(), robot)


@lru_cache(maxsize=_MAX_SYMBOLIC_MODELS)
def _model_of_key(equal: _RobotKey) -> ModelFunctions:
    return ModelFunctions(equal.robot)


class Composition:
    """Composes larger functions from model functions, in symbols of one kind (MX or SX).

    The composed functions use the model's mass properties: model functions are called without
    ``p``, and :meth:`function` adds it as the last input.
    """

    def __init__(self, model: ModelFunctions, kind: type[ca.MX] | type[ca.SX]) -> None:
        self.n, self.link_names = model.n, model.link_names
        self._model = model
        self.inputs = {name: kind.sym(name, p.numel()) for name, p in model.mass_inputs.items()}
        """The symbol ``p`` by name; empty if the mass properties are constants."""

    def __call__(self, name: str, *arguments: ca.MX | ca.SX | ca.DM) -> ca.MX | ca.SX:
        """Call a function of the model."""
        function = self._model.function(name, compile=False)
        return function(*arguments, *self.inputs.values())

    @property
    def total_mass(self) -> float | ca.MX | ca.SX:
        """System mass, kg."""
        return self("total_mass") if self.inputs else self._model.total_mass

    def function(
        self, name: str, inputs: Sequence[ca.MX | ca.SX], outputs: Sequence[ca.MX | ca.SX]
    ) -> ca.Function:
        """Return a function from input symbols and output expressions."""
        return ca.Function(name, [*inputs, *self.inputs.values()], list(outputs))


class SymbolicModels:
    """Models with mass properties as an argument, for all robots with the same structure."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._free = possibly_nonzero_entries(InertialParameters.of(robot))
        self._models: dict[bool, ModelFunctions] = {}

    @classmethod
    def of(cls, robot: RobotDescription) -> SymbolicModels:
        """Return the models for all robots that differ from this robot only in mass properties."""
        bodies = [(body.name, body.joint, body.parent, body.origin) for body in robot.bodies]
        free = possibly_nonzero_entries(InertialParameters.of(robot))
        facts = (robot.name, bodies, robot.frames, [link.name for link in robot.links], free)
        return _models_of_key(_RobotKey.of(robot, facts))

    def model(self, parameters: InertialParameters) -> tuple[ModelFunctions, Array]:
        """Return the model for inertial parameters (..., B), and its argument ``p`` (..., k).

        Entries that are zero in the nominal robot are usually zero in all robots, and are omitted
        from ``p``. If any of these entries is nonzero, all entries are in ``p``.
        """
        vector = parameters.vector
        usual = not vector[..., ~self._free].any()
        free = self._free if usual else np.ones_like(self._free)
        if usual not in self._models:
            self._models[usual] = ModelFunctions(self._robot, SymbolicMassProperties(free))
        return self._models[usual], np.ascontiguousarray(vector[..., free])


@lru_cache(maxsize=_MAX_SYMBOLIC_MODELS)
def _models_of_key(equal: _RobotKey) -> SymbolicModels:
    return SymbolicModels(equal.robot)
