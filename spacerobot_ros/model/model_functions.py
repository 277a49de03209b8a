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
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from spacerobot_ros.model.compilation import compilation_settings, compiled, dense_function
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.dynamics import (
    ExternalLoads,
    base_twist,
    bias,
    composite_dynamics,
    composites,
    connection,
    curvature,
    joint_efforts,
    momentum_derivatives,
    momentum_of_bodies,
    point_jacobian,
)
from spacerobot_ros.model.inertial_parameters import (
    InertialParameters,
    SymbolicMassProperties,
    possibly_nonzero_entries,
)
from spacerobot_ros.model.integration import (
    LoadLayout,
    attitude_step,
    divided_step,
    external_loads,
    runge_kutta_step,
    servo_rate,
    shape_equations,
    state_rate,
    state_slices,
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
        self._functions: dict[tuple[Hashable, ...], ca.Function] = {}
        self.derived: dict[Hashable, Any] = {}
        """Cache of objects derived from the model by other modules, by key."""

    @classmethod
    def of(cls, robot: RobotDescription) -> ModelFunctions:
        """Return the model with a robot's mass properties as constants; identical robots in a
        process share the model."""
        return _model_of_key(_RobotKey.of(robot, robot))

    def function(self, name: str, *, compile: bool = True) -> ca.Function:
        """Return a model function by name; some names take an argument after a colon.

        ``compile=False`` returns the symbolic function, for building larger functions.
        """
        kind, _, argument = name.partition(":")
        symbolic = self.composed(name, lambda: self._build(kind, argument), compile=False)
        # Compiling the large curvature would take longer than its few calls in a plan.
        if not compile or kind == "curvature":
            return symbolic
        return self.composed(name, lambda: symbolic)

    def composed(
        self, key: Hashable, build: Callable[[], ca.Function], *, compile: bool = True
    ) -> ca.Function:
        """Return a function composed of model functions, built and compiled once per key."""
        place = (key, *compilation_settings()) if compile else (key,)
        if place not in self._functions:
            self._functions[place] = compiled(build()) if compile else build()
        return self._functions[place]

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
        """Hash of the equations at zero momentum, identical for robots with identical equations."""
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

    def _build(self, kind: str, argument: str) -> ca.Function:
        match kind:
            case "momentum_derivatives":
                q, *motion = (self._symbols[x] for x in ("q", "omega_WB_B", "qdot", "eta"))
                results = momentum_derivatives(self._inertia, *motion)
                return ca.Function(kind, [q, *motion], ca.cse([*results]))
            case "jacobian":
                index = self.link_index(argument)
                J = point_jacobian(self._kin, argument)
                return self._function_of(f"jacobian_{index}", "q", result=J)
            case "link_pose":
                R, r, _ = self._kin.frame(argument)
                name = f"link_pose_{self.link_index(argument)}"
                return self._function_of(name, "q", R_BL=R, r_BL_B=r)
            case "curvature":
                K = curvature(self._connection, self._kin.q)
                # Index i varies fastest: reshaped in Fortran order, this is (6, i, j).
                stacked = ca.horzcat(*(K[i][j] for j in range(self.n) for i in range(self.n)))
                symbols = {"q": self._kin.q} | self.mass_inputs
                names, result = ([*symbols], ["result"]), ca.densify(stacked)
                # Searching its few common subexpressions takes several times as long.
                return ca.Function(kind, [*symbols.values()], [result], *names)
            case "shape_equations" | "loaded_shape_equations":
                return shape_equations(self._kin, loaded=kind.startswith("loaded"))
            case "velocity_step":
                step = attitude_step(self.function("locked_inertia", compile=False))
                return divided_step(f"{kind}_{argument}", step, int(argument))
            case "loaded_velocity_step":
                step = runge_kutta_step(servo_rate(self._kin), slice(self.n, self.n + 4))
                return divided_step(f"{kind}_{argument}", step, int(argument))
            case "flight_step" | "holding_step" | "loaded_flight_step" | "loaded_holding_step":
                holding, loaded = "holding" in kind, kind.startswith("loaded")
                rate = state_rate(self._kin, holding=holding, loaded=loaded)
                return runge_kutta_step(rate, state_slices(self.n)[1])
        inputs, outputs = self._closed_form(kind)
        return self._function_of(kind, inputs, **outputs)

    def _closed_form(self, kind: str) -> tuple[str, dict[str, ca.SX]]:
        """Return the names of the inputs of a function, and the expressions of its results."""
        kin, parts, x = self._kin, self._inertia, SimpleNamespace(**self._symbols)
        R_WB = matrix_from_quaternion(x.quaternion_WB)
        match kind:
            case "center_of_mass":
                return "q", {"result": kin.r_BC_B}
            case "locked_inertia":
                return "q", {"result_0": parts.D, "result_1": parts.D_q}
            case "link_poses":
                R, r, _ = zip(*map(kin.frame, self.link_names), strict=True)
                return "q", {"R_BL": ca.horzcat(*R), "r_BL_B": ca.horzcat(*r)}
            case "inertia_matrix":
                return "q", {"result": parts.H_plus}
            case "connection":
                return "q", {"result": self._connection}
            case "bias":
                C_plus = bias(parts, x.v_cm_B, x.omega_WB_B, x.qdot)
                return "q v_cm_B omega_WB_B qdot", {"C_plus": C_plus}
            case "forward_dynamics":
                motion = x.v_cm_B, x.omega_WB_B, x.qdot
                z0ddot = composite_dynamics(kin, *motion, x.wrench_B, x.tau)
                return "q v_cm_B omega_WB_B qdot wrench_B tau", {"z0ddot": z0ddot}
            case "joint_efforts":
                tau = joint_efforts(kin, x.qdot, x.qddot, ca.SX(3, 1), ExternalLoads.none(kin))
                return "q qdot qddot", {"tau": tau}
            case "servo_efforts" | "loaded_servo_efforts":
                # The efforts of servos that change the joint rates within ``h``.
                inputs, loads = "quaternion_WB q before after L_W h", ExternalLoads.none(kin)
                if kind.startswith("loaded"):
                    inputs = f"{inputs} r_WC_W loads"
                    time = x.loads[LoadLayout(len(self.link_names)).time]
                    loads = external_loads(parts, x.quaternion_WB, x.r_WC_W, x.loads, time)
                mean, change = (x.before + x.after) / 2, (x.after - x.before) / x.h
                return inputs, {"tau": joint_efforts(kin, mean, change, R_WB.T @ x.L_W, loads)}
            case "momentum":
                p_B, L_B, energy = momentum_of_bodies(kin, x.v_WB_B, x.omega_WB_B, x.qdot)
                outputs = {"p_W": R_WB @ p_B, "L_W": R_WB @ L_B, "energy": energy}
                return "quaternion_WB q v_WB_B omega_WB_B qdot", outputs
            case "base_twist":
                v, omega = base_twist(kin, parts, x.qdot, R_WB.T @ x.p_W, R_WB.T @ x.L_W)
                return "quaternion_WB q qdot p_W L_W", {"v_WB_B": v, "omega_WB_B": omega}
            case "rotate":
                return "quaternion_WB vector_B", {"vector_W": R_WB @ x.vector_B}
            case "total_mass":
                return "", {"M": kin.total_mass}
        raise KeyError(kind)

    @cached_property
    def _symbols(self) -> dict[str, ca.SX]:
        """Symbols of all inputs by name."""
        n, loads = self.n, LoadLayout(len(self.link_names)).size
        sizes = {
            **dict.fromkeys(("qdot", "qddot", "before", "after", "tau"), n),
            **dict.fromkeys(("v_cm_B", "v_WB_B", "omega_WB_B", "vector_B", "eta"), 3),
            **dict.fromkeys(("p_W", "L_W", "r_WC_W"), 3),
            **{"quaternion_WB": 4, "wrench_B": 6, "h": 1, "loads": loads},
        }
        return {"q": self._kin.q} | {name: ca.SX.sym(name, size) for name, size in sizes.items()}

    @cached_property
    def _connection(self) -> ca.SX:
        return connection(self._kin, self._inertia)

    def _function_of(self, name: str, inputs: str, **outputs: ca.SX) -> ca.Function:
        """Return a function of named inputs; symbolic mass properties become its last input."""
        symbols = {each: self._symbols[each] for each in inputs.split()}
        return dense_function(name, symbols | self.mass_inputs, outputs)


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

    def __reduce__(self) -> tuple[Any, ...]:
        return SymbolicModels.of, (self._robot,)

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
