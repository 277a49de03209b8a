"""Coordinated control in batches: the law, references and limits of a flight as one function."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy

import casadi as ca
import numpy as np

from spacerobot_ros.batch.flights import Controlled, Flights
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import CoordinatedController, build_controller, error_kind
from spacerobot_ros.control.executive import LOST_RATE
from spacerobot_ros.control.laws.law import Gains
from spacerobot_ros.control.limits import Saturated
from spacerobot_ros.control.reference import (
    ReferenceProfile,
    profile_expression,
    profile_numbers,
    profile_size,
)
from spacerobot_ros.control.state import ControlState, PoseReference
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.composite_rigid_body import state_slices
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.symbolic_rotations import quaternion_from_rotvec, quaternion_multiply
from spacerobot_ros.times import SECOND

ROUNDING = 1e-9
"""By how much sums of control periods may be off a time, s."""

NOT_YET = -1.0
"""Of times: what they are of has not happened."""

CONTROL_INPUTS = (
    *("state", "pose", "twist", "normals", "bias", "sigma"),
    *("time", "profile", "gains", "bounds", "since"),
)
"""Arguments of :meth:`BatchController.function`."""

CONTROL_OUTPUTS = ("command", "exact", "measured", "begun", "settled", "wild", "errors")
"""Its results."""

_KINDS = ("position", "attitude", "joints")
"""The fields of :class:`.Errors`, in the order of ``errors``."""


class BatchController:
    """One controller for all flights of a batch, one after the other or by its expressions.

    It knows no goals: :meth:`serving` returns one that does.

    Raises
    ------
    ParameterError
        The law cannot drive what is to be controlled.
    """

    def __init__(self, robot: SpaceRobot, config: ControllerConfig) -> None:
        self._config = config
        self._program = Controlled(config)
        self._controller: CoordinatedController = build_controller(robot, config)
        self.law = self._controller.law
        self._n, self.period_ns = robot.n, round(config.control_period * SECOND)
        selection = self.law.outputs.selection
        self._groups = (
            *(bool(selection.base), bool(selection.end_effector)),
            robot.n if selection.joints else 0,
        )
        limit = config.time_limit
        self.last_tick = math.ceil((limit - ROUNDING) / config.control_period) if limit else -1
        """The tick at whose state a goal that is not reached has failed; -1: never."""

    @classmethod
    def of(cls, flights: Flights) -> BatchController:
        """Return the controller of the flights of a batch."""
        program = flights.program
        assert isinstance(program, Controlled)
        return cls(program.robot or flights.robot, program.config).serving(program)

    def serving(self, program: Controlled) -> BatchController:
        """Return this controller, to be used for these goals and gains; all else is as it was."""
        served = copy(self)
        served._program, served._config = program, program.config
        return served

    @property
    def until_decided(self) -> bool:
        """Whether flights end with the decision about their goals."""
        return self._program.until_decided

    # -- one flight ---------------------------------------------------------------------------

    def begin(self, row: int, state: ControlState) -> tuple[ReferenceProfile, Array]:
        """Begin a flight at its first measured state.

        Returns
        -------
        profile
            The way of its references.
        bounds
            (m,) errors of the outputs beyond which control is lost.
        """
        program, controller = self._program, self._controller
        controller.reset()
        controller.set_gains(self._gains(row))
        shape = None if program.joints is None else _of(program.joints, row)
        controller.set_goals(
            0.0,
            state,
            base=_pose(program.base, row),
            end_effector=_pose(program.end_effector, row),
            joints=shape,
        )
        profile = controller.profile
        assert profile is not None
        controller.law.command(state, profile.at(0.0))
        return profile, controller.error_bounds(self._config.error_margin.as_errors())

    def time(self, tick: int) -> float:
        """Return the time of a tick as controllers know it, s."""
        return tick * self.period_ns / SECOND

    def command(self, tick: int, state: ControlState) -> list[Array]:
        """Return efforts and wrench for a state of the flight that was begun last."""
        time = self.time(tick)
        realised = self._controller.command(time, state, state.q, state.qdot).realised
        return [realised.tau, realised.wrench_B]

    def errors(self) -> Array:
        """Return the largest errors (3,) of positions, attitudes and joints at the last command."""
        errors = self._controller.errors()
        return np.array([getattr(errors, kind) for kind in _KINDS])

    def reached(self, tick: int) -> bool:
        """Whether all errors of the last command are within tolerances, the reference at rest."""
        errors, config = self._controller.errors(), self._config
        return self._controller.reference_at_rest(self.time(tick)) and (
            errors.position <= config.position_tolerance
            and errors.attitude <= config.attitude_tolerance
            and errors.joints <= config.joint_tolerance
        )

    def settled(self, since: int, tick: int) -> bool:
        """Whether what has been so since a tick has been so for the settling time."""
        return self.time(tick) - self.time(since) >= self._config.settle_time - ROUNDING

    def wild(self, qdot: Array, bounds: Array) -> tuple[bool, bool]:
        """Whether a measured joint rate, and an error of the last command, are beyond bounds."""
        return (
            self._controller.largest_rate_share(qdot) > LOST_RATE,
            self.law.largest_error_share(bounds) > 1.0,
        )

    # -- many ---------------------------------------------------------------------------------

    def numbers(self, profile: ReferenceProfile) -> Array:
        """Return the numbers of a profile that the function takes."""
        return profile_numbers(profile, *self._groups)

    def gains(self, rows: Sequence[int]) -> Array:
        """Return Kp over Kd (flights, 2 m)."""
        selection = self.law.outputs.selection
        return np.array([np.concatenate(self._gains(row).diagonals(selection)) for row in rows])

    def _gains(self, row: int) -> Gains:
        each = self._program.gains
        return each[row] if each else self._config.gains

    def exact(
        self, row: int, profile: ReferenceProfile, tick: int, state: ControlState
    ) -> Saturated:
        """Return the command where the function cannot give it."""
        self.law.set_gains(self._gains(row))
        commanded = self.law.command(state, profile.at(self.time(tick)))
        return self._controller.limited(state, commanded)

    def function(self) -> ca.Function:
        """Return the function from :data:`CONTROL_INPUTS` to :data:`CONTROL_OUTPUTS`.

        ``state`` is the plant's, ``normals`` (12 + 2 n,) as sensors draw them, ``bias`` (6 + n,),
        ``sigma`` (6,), ``profile`` of :meth:`numbers`, ``bounds`` (m,) of :meth:`begin`. ``exact``:
        it is for :meth:`exact` to give the command. ``since``, and ``begun`` after it, is when
        errors came within their tolerances, -1 if they are not; ``settled``: they have been for the
        settling time. ``wild`` (2,): a rate, and an error, are beyond their bounds. ``errors`` (3,)
        of :meth:`errors`.

        Raises
        ------
        ParameterError
            The law needs more than its function.
        """
        n, law, size = self._n, self.law, profile_size(*self._groups)
        fixed = law.fixed_inputs
        if fixed is None:
            raise ParameterError(f"The law '{law.name}' with these options is not flown in lanes.")
        m = law.outputs.m
        sizes = (2 * n + 13, 7, 6, 12 + 2 * n, 6 + n, 6, 1, size, 2 * m, m, 1)
        inputs = [ca.SX.sym(name, count) for name, count in zip(CONTROL_INPUTS, sizes, strict=True)]
        x, pose, twist, normals, bias, sigma, time, profile, gains, bounds, since = inputs
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
        actuation, lowered = self._controller.limited_expression(
            omega, q, qdot, results["actuation"]
        )
        exact = ca.logic_or(lowered, ca.logic_not(law.defined(results)))
        within = time >= profile[0]
        largest = {kind: ca.SX(0) for kind in _KINDS}
        beyond = []
        errors = ca.vertsplit(results["error"])
        labels = law.outputs.labels
        for error, bound, label in zip(errors, ca.vertsplit(bounds), labels, strict=True):
            kind, size_of = error_kind(label), ca.fabs(error)
            within = ca.logic_and(within, size_of <= self._tolerance(kind))
            largest[kind] = ca.fmax(largest[kind], size_of)
            beyond.append(size_of / bound > 1.0)
        begun = ca.if_else(within, ca.if_else(since < 0, time, since), NOT_YET)
        settled = time - begun >= self._config.settle_time - ROUNDING
        shares = ca.fabs(qdot * ca.DM(1.0 / self._controller.joint_rates))
        wild = ca.vertcat(ca.sum1(shares > LOST_RATE) > 0, ca.sum1(ca.vertcat(*beyond)) > 0)
        command = ca.vertcat(actuation[6:], actuation[:6])
        settled = ca.logic_and(within, settled)
        outputs = command, exact, measured, begun, settled, wild, ca.vertcat(*largest.values())
        dense = ca.cse([ca.densify(output) for output in outputs])
        return ca.Function("control", inputs, dense, CONTROL_INPUTS, CONTROL_OUTPUTS)

    def _tolerance(self, kind: str) -> float:
        config = self._config
        return {
            "position": config.position_tolerance,
            "attitude": config.attitude_tolerance,
            "joints": config.joint_tolerance,
        }[kind]


def control_state(measured: Array) -> ControlState:
    """Return the measured state (13 + 2 n,) as controllers take it."""
    return ControlState.unstack(measured)


def _of(array: Array, row: int) -> Array:
    return np.asarray(array if array.ndim == 1 else array[row])


def _pose(goal: Array | None, row: int) -> PoseReference | None:
    if goal is None:
        return None
    one = _of(goal, row)
    return PoseReference(one[:3], one[3:])
