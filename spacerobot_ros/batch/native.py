"""The tick of a plant and its commander, compiled for SIMD lanes, one flight per lane.

CasADi functions become C++ in which every number is replaced by a vector register;
``driver.hpp`` loops over ticks and groups of lanes. Everything shared by Python and C++ is declared
once, here, and generated as C++: the rows of a group's memory, the enumerations, and :class:`Job`.
:class:`BatchController` is a controller as such a function.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np

from spacerobot_ros.batch.flights import ControlledGoals, Flights
from spacerobot_ros.batch.targets import Target
from spacerobot_ros.control.controller import CoordinatedController, build_controller
from spacerobot_ros.control.goal_monitor import Decision, GoalMonitor
from spacerobot_ros.control.goals import require_controlled_axes
from spacerobot_ros.control.laws.law import Gains
from spacerobot_ros.control.outputs import OutputDistance
from spacerobot_ros.control.reference import (
    ReferenceProfile,
    profile_expression,
    profile_numbers,
    profile_size,
)
from spacerobot_ros.control.state import ControlState, PoseReference, Reference
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.compilation import compilation_settings
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import state_slices
from spacerobot_ros.model.model_functions import Composition, ModelFunctions
from spacerobot_ros.model.symbolic_rotations import quaternion_from_rotvec, quaternion_multiply
from spacerobot_ros.simulation import effort_plant
from spacerobot_ros.simulation.actuators import PLANTS
from spacerobot_ros.simulation.effort_plant import JointStops
from spacerobot_ros.times import SECOND


class BatchController:
    """One controller for all flights in a batch, with the goals and gains of each flight.

    Parameters
    ----------
    program
        Goals and gains of the flights.
    controller
        See :func:`.build_controller`; the gains and goals in the configuration are replaced.
    """

    def __init__(self, program: ControlledGoals, controller: CoordinatedController) -> None:
        self.program, self.controller, self.law = program, controller, controller.law
        self._config = program.config.for_robot(controller.law.robot.description)
        self._n = controller.law.robot.n
        self._period_ns = round(program.config.control_period * SECOND)
        for gains in program.gains:
            if self.law.has_automatic_gains(gains):
                # From then on, the law's function computes them for all flights.
                self.law.set_gains(gains)
                break
        selection = self.law.outputs.selection
        self._groups = (
            bool(selection.base),
            bool(selection.end_effector),
            self._n if selection.joints else 0,
        )

    @classmethod
    def of(cls, flights: Flights) -> BatchController:
        """Return the controller for the flights in a batch.

        Raises
        ------
        ParameterError
            The law cannot control the selected outputs.
        """
        program = flights.program
        assert isinstance(program, ControlledGoals)
        return cls(program, build_controller(program.robot or flights.robot, program.config))

    # -- one flight ---------------------------------------------------------------------------

    def begin_flight(self, row: int, state: ControlState) -> tuple[ReferenceProfile, Array]:
        """Start a flight from its first measured state.

        Returns
        -------
        profile
            Reference profile.
        bounds
            (m,) output errors beyond which control is lost.

        Raises
        ------
        PlanningError
            A goal is rejected.
        """
        program, controller = self.program, self.controller
        controller.reset()
        controller.set_gains(self._gains(row))
        joints = None if program.joints is None else _select_row(program.joints, row)
        base, hand = _pose_goal(program.base, row), _pose_goal(program.end_effector, row)
        require_controlled_axes(controller.law, state, self._config, Reference(base, hand))
        controller.set_goals(0.0, state, base=base, end_effector=hand, joints=joints)
        profile = controller.profile
        assert profile is not None
        controller.law.command(state, profile.at(0.0))
        return profile, controller.error_bounds(self._config.error_margin.as_distances())

    def time_of_tick(self, tick: int) -> float:
        """Return the time of a tick, s, as computed by controllers."""
        return tick * self._period_ns / SECOND

    # -- lanes --------------------------------------------------------------------------------

    def profile_argument(self, profile: ReferenceProfile) -> Array:
        """Return the ``profile`` argument of :meth:`function`."""
        return profile_numbers(profile, *self._groups)

    def gains_argument(self, rows: Sequence[int]) -> Array:
        """Return the ``gains`` argument for flights, Kp and Kd side by side: (flights, 2 m)."""
        each = (self.law.gain_arguments(self._gains(row)) for row in rows)
        return np.array([np.concatenate(pair) for pair in each])

    def _gains(self, row: int) -> Gains:
        each = self.program.gains
        return each[row] if each else self._config.gains

    def exact_command(
        self, row: int, profile: ReferenceProfile, tick: int, state: ControlState
    ) -> Array:
        """Return efforts and wrench (n + 6,) that :meth:`function` cannot compute."""
        self.law.set_gains(self._gains(row))
        commanded = self.law.command(state, profile.at(self.time_of_tick(tick)))
        realised = self.controller.apply_limits(state, commanded).realised
        return np.concatenate([realised.tau, realised.wrench_B])

    def function(self) -> ca.Function:
        """Return the function that computes a controller tick. Its arguments and results:

        ``state``, ``pose``, ``twist``
            Plant state, base pose and base twist.
        ``normals`` (12 + 2 n,), ``bias`` (6 + n,), ``sigma`` (6,)
            Random numbers in the order of :class:`.Sensors`, and measurement errors.
        ``time``, ``profile``, ``gains``, ``bounds``
            Time, s; :meth:`profile_argument`; :meth:`gains_argument`; as in :meth:`begin_flight`.
        ``monitor``, ``next_monitor`` (3,)
            State of :class:`.GoalMonitor` without ``started``, which is zero.
        ``command`` (n + 6,)
            Efforts and wrench; if ``exact``, :meth:`exact_command` computes them instead.
        ``measured`` (13 + 2 n,)
            The measured state.
        ``verdict``
            The goal :class:`.Decision`.

        Raises
        ------
        ParameterError
            The law cannot be expressed as a single function.
        """
        if any(
            gains.integral_diagonal(self.law.outputs.selection).any()
            or gains.kp_matrix
            or gains.kd_matrix
            for gains in (*self.program.gains, self._config.gains)
        ):
            raise ParameterError(
                "Lanes do not support controllers with integral gains (ki) or gain matrices: "
                "use engine 'flights'."
            )
        n, law, size = self._n, self.law, profile_size(*self._groups)
        fixed = law.fixed_inputs
        if fixed is None:
            raise ParameterError(f"Lanes do not support the law '{law.name}' with these options.")
        m = law.outputs.m
        sizes = {
            **{"state": 2 * n + 13, "pose": 7, "twist": 6},
            **{"normals": 12 + 2 * n, "bias": 6 + n, "sigma": 6},
            **{"time": 1, "profile": size, "gains": 2 * m, "bounds": m, "monitor": 3},
        }
        inputs = {name: ca.SX.sym(name, count) for name, count in sizes.items()}
        x, pose, twist, normals, bias, sigma, time, profile, gains, bounds, memory = inputs.values()
        shape, _, rates, *_ = state_slices(n)
        turn = bias[3:6] + sigma[1] * normals[3:6]
        measured = ca.vertcat(
            pose[:3] + bias[:3] + sigma[0] * normals[:3],
            quaternion_multiply(pose[3:], quaternion_from_rotvec(turn)),
            twist[:3] + sigma[2] * normals[6:9],
            twist[3:] + sigma[3] * normals[9:12],
            x[shape] + bias[6:] + sigma[4] * normals[12 : 12 + n],
            x[rates] + sigma[5] * normals[12 + n :],
        )
        reference = profile_expression(profile, time, *self._groups)
        names = law.function.name_out()
        values = law.function(
            measured, reference, gains[:m], gains[m:], *(ca.DM(value) for value in fixed.values())
        )
        results = dict(zip(names, values, strict=True))
        omega, q, qdot = measured[10:13], measured[13 : 13 + n], measured[13 + n :]
        joint_rates = self.controller.joint_rate_limits
        actuation = self.controller.limits.expression(results["actuation"])
        lowered = joint_rates.exceeds_limits_expression(omega, q, qdot, actuation)
        exact = ca.logic_or(lowered, ca.logic_not(law.is_complete(results)))
        largest = dict.fromkeys(OutputDistance._fields, ca.SX(0))
        for kind, places in law.outputs.selection.distances:
            largest[kind] = ca.fmax(largest[kind], ca.norm_2(results["error"][list(places)]))
        error_share, rate_share = ca.SX(0), ca.SX(0)
        for error, bound in zip(ca.vertsplit(results["error"]), ca.vertsplit(bounds), strict=True):
            error_share = ca.fmax(error_share, ca.fabs(error) / bound)
        for rate, limit in zip(ca.vertsplit(qdot), joint_rates.rates, strict=True):
            rate_share = ca.fmax(rate_share, ca.fabs(rate) * (1.0 / limit))
        monitor = GoalMonitor(0.0, *ca.vertsplit(memory))
        verdict = monitor.decide(
            time,
            time >= profile[0],
            profile[0],
            OutputDistance(**largest),
            rate_share,
            error_share,
            self._config,
        )
        command = ca.vertcat(actuation[6:], actuation[:6])
        outputs = {"command": command, "exact": exact, "measured": measured, "verdict": verdict}
        outputs["next_monitor"] = ca.vertcat(*astuple(monitor)[1:])
        dense = ca.cse([ca.densify(output) for output in outputs.values()])
        return ca.Function("control", [*inputs.values()], dense, [*inputs], [*outputs])


def _select_row(array: Array, row: int) -> Array:
    return np.asarray(array if array.ndim == 1 else array[row])


def _pose_goal(goal: Array | None, row: int) -> PoseReference | None:
    if goal is None:
        return None
    one = _select_row(goal, row)
    return PoseReference(one[:3], one[3:])


class Program(IntEnum):
    """Kind of command: constant, along a schedule, from a controller, or set before each step."""

    HELD = 0
    FOLLOWED = 1
    CONTROLLED = 2
    GIVEN = 3


_JOB_MEMBERS = (
    ("V *", "memory", "(groups, ROWS)"),
    ("long long", "groups", ""),
    ("long long *", "at", "(groups,) the next tick"),
    ("long long", "until", "fly_until: the first tick that is not flown"),
    ("unsigned char *", "pending", "(groups,) whether lanes wait for commands"),
    ("double", "period", "s"),
    ("long long", "period_ns", ""),
    ("long long", "program", "Program"),
    ("const double *", "table", "(ticks, COMMANDS); each_table: (groups, ticks, COMMANDS, LANES)"),
    ("long long", "table_ticks", "FOLLOWED: joint positions, one row more than ticks"),
    ("long long", "each_table", ""),
    ("long long", "noisy", "whether commands depend on measurement errors"),
    ("const unsigned long long *", "seeds", "(groups, LANES) of noise; null: no sensor errors"),
    ("double", "gain", "FOLLOWED: feedback gain for joint position errors, 1/s"),
    ("double", "deadband", "FOLLOWED: m or rad"),
    ("const long long *", "instants", "ticks at which states are reported, ascending"),
    ("long long", "instant_count", ""),
    ("V *", "reports", "(groups, instants, REPORT_ROWS)"),
    ("V *", "normals", "(groups, instants, NORMALS) random numbers at the instants"),
    ("long long", "ends", "CONTROLLED: whether flights end with their goal decision"),
)
"""Members of :class:`Job`: C++ type, name, meaning."""

_MEMBER_TYPES: dict[str, Any] = {"long long": ctypes.c_longlong, "double": ctypes.c_double}


class Job(ctypes.Structure):
    """Argument of the functions in ``driver.hpp``; ``_JOB_MEMBERS`` lists its members."""

    _fields_ = [(name, _MEMBER_TYPES.get(kind, ctypes.c_void_p)) for kind, name, _ in _JOB_MEMBERS]


@dataclass(frozen=True)
class CompiledTick:
    """The compiled tick for flights that differ only in numerical values, and its memory layout."""

    driver: Any
    """The functions of ``driver.hpp``; see :meth:`.Target.call`."""
    target: Target
    """Target on which they run."""
    rows: dict[str, slice]
    """The rows of a group's memory by name; a row contains one value for each flight in the
    group."""
    row_count: int
    """Number of rows of a group."""
    report_width: int
    """Number of values in a report."""
    controller: CoordinatedController | None = None
    """Source of the commands; None: tables."""

    @classmethod
    def of(
        cls, flights: Flights, model: ModelFunctions, target: Target, link: str = ""
    ) -> CompiledTick:
        """Compile the tick for flights, or reuse an earlier compilation.

        If ``link`` is given, reports end with the position (3) of that link in B, m.

        Raises
        ------
        NoLibraryError
            The tick cannot be compiled on this machine.
        ParameterError
            The law cannot control the selected outputs, or lanes do not support it.
        """
        key: tuple[Any, ...] = (cls, flights.actuation, flights.substeps)
        key = (*key, link, target, compilation_settings())
        controller = control = None
        if isinstance(flights.program, ControlledGoals):
            # A law is identified by its expressions: its class may have changed.
            in_lanes = BatchController.of(flights)
            controller, control = in_lanes.controller, in_lanes.function()
            key = (*key, control.serialize())
        if key not in model.derived:
            model.derived[key] = cls._compile(flights, model, target, link, control)
        compiled: CompiledTick = model.derived[key]
        return replace(compiled, controller=controller)

    @classmethod
    def _compile(
        cls,
        flights: Flights,
        model: ModelFunctions,
        target: Target,
        link: str,
        control: ca.Function | None,
    ) -> CompiledTick:
        effort, robot = flights.actuation == "effort", flights.robot
        inputs, n = _TICK_INPUTS[flights.actuation], robot.n
        results = _TICK_OUTPUTS[flights.actuation]
        # Reports need all results except the poses of links.
        reported = [name for name in results if not name.startswith("link")]
        ticks = {
            "FLIGHT": [name for name in results if name not in _ONLY_REPORTED],
            "REPORT": reported + ["place"] * bool(link),
        }
        functions: dict[str, ca.Function] = {}
        for kind, needed in ticks.items():
            tick = PLANTS[flights.actuation].tick_function(
                robot, Composition(model, ca.MX), flights.substeps
            )
            arguments = tick.mx_in()
            outputs = dict(zip(results, tick.call(arguments, True, False), strict=True))
            if link:
                of_links = ca.reshape(outputs["link_r"], 3, -1)
                outputs["place"] = ca.densify(of_links[:, robot.link_names.index(link)])
            chosen = [outputs[each] for each in needed]
            name = f"{flights.actuation}_{kind.lower()}"
            functions[kind] = ca.Function(name, arguments, chosen, [*inputs, "p"], needed)
        if control is not None:
            functions["CONTROL"] = control
        sizes = {
            **{"alive": 1, "measured": n, "joint_bias": n, "joint_noise": 1},
            **{"limits": 2 * n, "peak_rate": n, "peak_effort": n, "failure": 1, "failed_at": 1},
            **{"peak_wrench": 2, "lowest": n, "highest": n},
            **{"decision": 1, "decided": 1, "decided_state": 2 * n + 13},
            **{"ended": 1, "end_state": 2 * n + 20},
            **{"first_momenta": 6, "drift": 2},
        }
        for each in functions.values():
            sizes |= {name: each.nnz_in(i) for i, name in enumerate(each.name_in())}
            sizes |= {name: each.nnz_out(i) for i, name in enumerate(each.name_out())}
        *starts, row_count = np.cumsum([0, *sizes.values()]).tolist()
        first = dict(zip(sizes, starts, strict=True))
        arrays: dict[str, Iterable[int]] = {}
        for kind, each in functions.items():
            arrays[f"{kind}_ARGUMENTS"] = [first[name] for name in each.name_in()]
            arrays[f"{kind}_RESULTS"] = [first[name] for name in each.name_out()]
        has_stops = effort and np.isfinite([robot.lower, robot.upper]).any()
        if has_stops:
            for name in ("holding_step", "shape_equations"):
                functions[name.upper()] = model.function(name, compile=False)
        state, limited = first["next_state"], first["limited"] + 1
        rates = state + n + 4 if effort else first["qdot"]
        efforts = first["realised" if effort else "effort"]
        report, width = [(state, 0, n), (rates, n, n)], 2 * n
        for name in ("pose", "twist", "momentum", *["place"] * bool(link)):
            report.append((first[name], width, sizes[name]))
            width += sizes[name]
        spans = {
            "COPIES": [
                (first[source], first[target], sizes[source])
                for source, target in _FED_BACK.items()
                if source in sizes
            ],
            "SUMS": [(limited, first["limits"], n if effort else 2 * n)],
            "PEAKS": [(rates, first["peak_rate"], n), (efforts, first["peak_effort"], n)],
            "REPORTED": report,
        }
        constants = {"ROWS": row_count, "JOINTS": n, "COMMANDS": sizes["command"]}
        constants |= {"REPORT_ROWS": width, "NORMALS": 12 + 2 * n}
        if effort:
            constants |= {"STOP_ROW": limited + n, "REALISED_ROW": efforts}
            constants |= {"SUBSTEPS": flights.substeps, "BISECTIONS": effort_plant.BISECTIONS}
            constants["MAX_ARRIVALS_PER_STEP"] = effort_plant.MAX_ARRIVALS_PER_STEP
        if control is not None:
            constants["EXPECTED_ROW"] = state + 2 * n + 4
        limits = JointStops.limits(robot) if has_stops else {}
        declarations = _shared_declarations(first, constants, arrays, spans, limits)
        driver = target.compile(functions, declarations)
        rows = {name: slice(row, row + sizes[name]) for name, row in first.items()}
        return cls(driver, target, rows, row_count, width)


_TICK_INPUTS = {
    "velocity": ("state", "command", "before", "momenta", "r_cm", "h"),
    "effort": ("state", "command", "h"),
}
_TICK_OUTPUTS = {
    "velocity": (
        *("next_state", "pose", "twist", "qdot", "effort"),
        *("momentum", "link_R", "link_r", "limited", "next_r_cm"),
    ),
    "effort": (
        *("next_state", "pose", "twist", "realised"),
        *("momentum", "link_R", "link_r", "limited"),
    ),
}
"""Names of the arguments and results of a tick function, by actuation."""

_ONLY_REPORTED = ("pose", "twist", "momentum", "link_R", "link_r")
"""Results that only some ticks need."""

_FED_BACK = {
    **{"next_state": "state", "qdot": "before", "next_r_cm": "r_cm"},
    "next_monitor": "monitor",
}
"""Arguments of the next tick, by the results that become these arguments."""


def _shared_declarations(
    first: Mapping[str, int],
    constants: Mapping[str, int],
    arrays: Mapping[str, Iterable[int]],
    spans: Mapping[str, Iterable[tuple[int, int, int]]],
    numbers: Mapping[str, Array],
) -> str:
    lines = [f"#define {name} {value}" for name, value in constants.items()]
    lines.append("namespace row {")
    lines += [f"constexpr long long {name} = {row};" for name, row in first.items()]
    lines.append("}")
    for enum in (Program, Decision):
        members = ", ".join(f"{each.name} = {each.value}" for each in enum)
        lines.append(f"namespace {enum.__name__.lower()} {{ enum {{ {members} }}; }}")
    lines.append("struct Span { long long from, to, count; };  // rows")
    lines += [f"static const long long {name}[] = {_cpp_list(x)};" for name, x in arrays.items()]
    lines += [
        f"static const Span {name}[] = {{{', '.join(map(_cpp_list, each))}}};"
        for name, each in spans.items()
    ]
    lines += [
        f"static const double {name}[] = {_cpp_list(each.tolist()).replace('inf', 'INFINITY')};"
        for name, each in numbers.items()
    ]
    lines += [
        "struct Job {",
        *(f"  {kind} {name};  // {text}" for kind, name, text in _JOB_MEMBERS),
        "};",
    ]
    return "\n".join(lines)


def _cpp_list(numbers: Iterable[float]) -> str:
    return "{" + ", ".join(map(repr, numbers)) + "}"
