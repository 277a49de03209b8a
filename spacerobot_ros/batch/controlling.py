"""A controller for flight batches, evaluated for one flight at a time, or as one function for SIMD
lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple

import casadi as ca
import numpy as np

from spacerobot_ros.batch.flights import ControlledGoals, Flights
from spacerobot_ros.control.controller import CoordinatedController, build_controller
from spacerobot_ros.control.goal_monitor import GoalMonitor
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
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import state_slices
from spacerobot_ros.model.symbolic_rotations import quaternion_from_rotvec, quaternion_multiply
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
        actuation, lowered = self.controller.limits_expression(omega, q, qdot, results["actuation"])
        exact = ca.logic_or(lowered, ca.logic_not(law.is_complete(results)))
        largest = dict.fromkeys(OutputDistance._fields, ca.SX(0))
        for kind, places in law.outputs.selection.distances:
            largest[kind] = ca.fmax(largest[kind], ca.norm_2(results["error"][list(places)]))
        error_share, rate_share = ca.SX(0), ca.SX(0)
        for error, bound in zip(ca.vertsplit(results["error"]), ca.vertsplit(bounds), strict=True):
            error_share = ca.fmax(error_share, ca.fabs(error) / bound)
        limits = self.controller.joint_rate_limits.rates
        for rate, limit in zip(ca.vertsplit(qdot), limits, strict=True):
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
