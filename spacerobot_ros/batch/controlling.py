"""Coordinated control in batches: the law, references and limits of a flight as one function."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from spacerobot_ros.batch.flights import Controlled, Flights
from spacerobot_ros.control.controller import CoordinatedController, build_controller
from spacerobot_ros.control.limits import Saturated
from spacerobot_ros.control.reference import ReferenceProfile, profile_expression, profile_numbers
from spacerobot_ros.control.state import ControlState, PoseReference
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.composite_rigid_body import state_slices
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.symbolic_rotations import quaternion_from_rotvec, quaternion_multiply

_ROUNDING = 1e-9
"""By how much sums of control periods may be off a time, s."""

NOT_YET = -1.0
"""Of times: what they are of has not happened."""


CONTROL_INPUTS = (
    *("state", "pose", "twist", "normals", "bias", "sigma"),
    *("time", "profile", "gains", "since"),
)
"""Arguments of :meth:`BatchController.function`."""

CONTROL_OUTPUTS = ("command", "exact", "measured", "begun", "settled")
"""Its results."""


class BatchController:
    """One controller for all flights of a batch, one after the other or by its expressions.

    Raises
    ------
    ParameterError
        The law cannot drive what is to be controlled.
    """

    def __init__(self, flights: Flights) -> None:
        program = flights.program
        assert isinstance(program, Controlled)
        self._program, self._config = program, program.config
        robot = program.robot or flights.robot
        self._controller: CoordinatedController = build_controller(robot, program.config)
        self.law = self._controller.law
        self._n, self.period = robot.n, flights.control_period
        selection = self.law.outputs.selection
        self._groups = (
            *(bool(selection.base), bool(selection.end_effector)),
            robot.n if selection.joints else 0,
        )

    # -- one flight ---------------------------------------------------------------------------

    def begin(self, row: int, state: ControlState) -> ReferenceProfile:
        """Begin a flight at its first measured state; return its profile."""
        program, controller = self._program, self._controller
        controller.reset()
        if program.gains:
            controller.set_gains(program.gains[row])
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
        return profile

    def command(self, tick: int, state: ControlState) -> list[Array]:
        """Return efforts and wrench for a state of the flight that was begun last."""
        time = tick * self.period
        realised = self._controller.command(time, state, state.q, state.qdot).realised
        return [realised.tau, realised.wrench_B]

    def reached(self, tick: int) -> bool:
        """Whether all errors of the last command are within tolerances, the reference at rest."""
        errors, config = self._controller.errors(), self._config
        return self._controller.reference_at_rest(tick * self.period) and (
            errors.position <= config.position_tolerance
            and errors.attitude <= config.attitude_tolerance
            and errors.joints <= config.joint_tolerance
        )

    def settled(self, since: int, tick: int) -> bool:
        """Whether what has been so since a tick has been so for the settling time."""
        return (tick - since) * self.period >= self._config.settle_time - _ROUNDING

    # -- many ---------------------------------------------------------------------------------

    def numbers(self, profile: ReferenceProfile) -> Array:
        """Return the numbers of a profile that the function takes."""
        return profile_numbers(profile, *self._groups)

    def gains(self, rows: Sequence[int]) -> Array:
        """Return Kp over Kd (flights, 2 m)."""
        each = self._program.gains
        chosen = [each[row] if each else self._config.gains for row in rows]
        selection = self.law.outputs.selection
        return np.array([np.concatenate(gains.diagonals(selection)) for gains in chosen])

    def exact(
        self, row: int, profile: ReferenceProfile, tick: int, state: ControlState
    ) -> Saturated:
        """Return the command where the function cannot give it."""
        gains = self._program.gains
        self.law.set_gains(gains[row] if gains else self._config.gains)
        commanded = self.law.command(state, profile.at(tick * self.period))
        return self._controller.limited(state, commanded)

    def function(self, size: int) -> ca.Function:
        """Return the function from :data:`CONTROL_INPUTS` to :data:`CONTROL_OUTPUTS`.

        ``state`` is the plant's, ``normals`` (12 + 2 n,) as sensors draw them, ``bias`` (6 + n,),
        ``sigma`` (6,), ``profile`` (size,) of :meth:`numbers`. ``exact``: it is for :meth:`exact`
        to give the command. ``since``, and ``begun`` after it, is when errors came within their
        tolerances, -1 if they are not; ``settled``: they have been for the settling time.

        Raises
        ------
        ParameterError
            The law needs more than its function.
        """
        n, law = self._n, self.law
        fixed = law.fixed_inputs
        if fixed is None:
            raise ParameterError(f"The law '{law.name}' with these options is not flown in lanes.")
        m = law.outputs.m
        sizes = (2 * n + 13, 7, 6, 12 + 2 * n, 6 + n, 6, 1, size, 2 * m, 1)
        inputs = [ca.SX.sym(name, count) for name, count in zip(CONTROL_INPUTS, sizes, strict=True)]
        x, pose, twist, normals, bias, sigma, time, profile, gains, since = inputs
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
        for error, label in zip(ca.vertsplit(results["error"]), law.outputs.labels, strict=True):
            within = ca.logic_and(within, ca.fabs(error) <= self._tolerance(label))
        begun = ca.if_else(within, ca.if_else(since < 0, time, since), NOT_YET)
        settled = time - begun >= self._config.settle_time - _ROUNDING
        command = ca.vertcat(actuation[6:], actuation[:6])
        outputs = command, exact, measured, begun, ca.logic_and(within, settled)
        dense = ca.cse([ca.densify(output) for output in outputs])
        return ca.Function("control", inputs, dense, CONTROL_INPUTS, CONTROL_OUTPUTS)

    def _tolerance(self, label: str) -> float:
        config, (group, _, axis) = self._config, label.partition(".")
        if group == "joint":
            return config.joint_tolerance
        return config.attitude_tolerance if axis[0] == "r" else config.position_tolerance


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
