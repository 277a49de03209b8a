"""Flight software for reaction wheels: torque allocation, saturation, dumping, failures.

A control law for the base and the arm commands a torque on the gyrostat's base
(:mod:`spacerobot_ros.model.wheels`). The wheels provide as much of this torque as their torque and
rate limits allow; the thrusters, if any, provide the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.state import Actuation, ControlState, Reference
from spacerobot_ros.errors import CommandError, ParameterError, counted
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import cross
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.parameters import nonnegative, parameter

_MIN_PERIODS_TO_LIMIT = 2
"""Shortest time for a wheel to reach its largest rate, in control periods."""

_SATURATED_SHARE = 0.99

_ANNOUNCEMENT_HYSTERESIS = 0.05
"""Decrease in a wheel's rate after which it may be reported again, as a fraction of the largest
rate."""

_DUMP_TIME = 5.0
"""Time constant of the rate decay while momentum is dumped, s."""

_DUMPED_SHARE = 0.02

_DUMP_TORQUE_SHARE = 0.5
"""Fraction of the thruster torque used for dumping; the rest is reserved for control."""

_MOTION_SHARE = 0.5
"""Fraction of wheel torque and momentum available to references."""

_FAILURE_TIME = 0.5
"""Time at full torque after which a wheel's response is checked, s."""

_MIN_RESPONSE_SHARE = 0.5
"""Smallest fraction of the commanded impulse that an intact wheel absorbs."""

_MIN_BOUND_WIDTH = 1e-12
"""Smallest width of the solver bounds, N m, and fraction of a torque that is considered zero."""

_SMOOTHING = 1e-6
"""Weight of the torques relative to their sum; selects the smallest torques among equivalent
allocations."""


@dataclass(frozen=True)
class WheelOptions:
    """Parameters of reaction wheels."""

    warning_rate: float = parameter(
        0.9,
        "fraction of a wheel's largest rate at which an event warns of saturation",
        minimum=0.01,
        maximum=1.0,
    )
    dump_rate: float = nonnegative(
        0.0,
        "fraction of a wheel's largest rate at which wheel momentum is dumped; 0: only on request",
        maximum=1.0,
    )
    excluded: str = parameter("", "joints of disabled wheels, separated by spaces")


class WheelAllocation:
    """Distributes a torque over wheels by bounded least squares.

    The torques solve ``min |A tau - torque|`` with ``lower <= tau <= upper``; among several
    solutions, the one with the smallest torques relative to their limits is chosen.

    Parameters
    ----------
    axes
        (3, k) wheel axes A.
    torque
        (k,) largest motor torques, N m.
    """

    def __init__(self, axes: Array, torque: Array) -> None:
        # Few robots have wheels, and it loads slowly, which would interrupt commands in flight.
        from scipy.optimize import lsq_linear

        self._solve = lsq_linear
        self._scaled, self._torque = axes * torque, torque
        self._inverse = np.linalg.pinv(self._scaled)
        largest = max(float(torque.max(initial=0.0)), _MIN_BOUND_WIDTH)
        self._extended = np.vstack([self._scaled / largest, _SMOOTHING * np.eye(len(torque))])
        self._size = largest
        self.rank = int(np.linalg.matrix_rank(self._scaled)) if len(torque) else 0
        """Number of independent axes."""

    def allocate(self, torque: Array, lower: Array, upper: Array) -> Array:
        """Return the torques (k,) whose sum along the axes is closest to ``torque`` (3,), N m."""
        tau = self._torque * (self._inverse @ torque)
        if np.all((lower <= tau) & (tau <= upper)):
            return np.asarray(tau)
        wanted = np.concatenate([torque / self._size, np.zeros(len(lower))])
        bounds = (
            (lower - _MIN_BOUND_WIDTH) / self._torque,
            (upper + _MIN_BOUND_WIDTH) / self._torque,
        )
        shares = self._solve(self._extended, wanted, bounds, method="bvls", tol=1e-14).x
        return np.clip(self._torque * shares, lower, upper)

    def within(self, limits: Array) -> float:
        """Return the largest sum achievable along every axis within ``limits`` (k,), which are
        wheel torques or momenta; zero if the wheel axes do not span the space.
        """
        if self.rank < 3:
            return 0.0
        rows = np.linalg.norm(self._torque[:, None] * self._inverse, axis=1)
        return float((limits / rows).min())


class WheelControl:
    """Wheels of a controlled robot: measured rates, commanded torques, and events.

    ``control_period`` is the time between two commands, s, and ``thruster_torque`` the largest
    torque of the thrusters, N m; infinite: no limit, zero: there are no thrusters.

    Raises
    ------
    ParameterError
        A named wheel does not exist, or momentum is to be dumped without thrusters.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        options: WheelOptions,
        control_period: float,
        thruster_torque: float,
    ) -> None:
        self.wheels = wheels = ReactionWheels.of(robot.description)
        self._options = options
        self._period, self._thruster_torque = control_period, thruster_torque
        self._used = np.ones(len(wheels), dtype=np.bool_)
        for name in options.excluded.split():
            if name not in wheels.names:
                raise ParameterError(
                    f"Parameter 'wheels.excluded' names '{name}'; the wheels of robot "
                    f"'{wheels.description.name}' are {', '.join(wheels.names)}."
                )
            self._used[wheels.names.index(name)] = False
        if options.dump_rate and not self.has_thrusters:
            raise ParameterError(
                f"Parameter 'wheels.dump_rate' is {options.dump_rate:g}, but 'use_thrusters' is "
                "false: only thrusters can dump momentum; set it to 0."
            )
        self.gyrostat = robot.derived(wheels.gyrostat)
        """The robot controlled by the laws."""
        self._allocate = self._make_allocation()
        self.reset()

    def reset(self) -> None:
        """Clear measurements; failed wheels remain unused."""
        count = len(self.wheels)
        self.torque = np.zeros(count)
        """Commanded motor torques (k,), N m."""
        self.thrust = np.zeros(6)
        """Wrench (6,) for the thrusters, N and N m."""
        self.rates, self._omega = np.zeros(count), np.zeros(3)
        self._spins = np.zeros(count)
        self._announced = np.zeros(count)
        """Rate of each wheel when last reported, as a fraction of the largest rate; zero: not
        reported."""
        self.dumping = False
        """Whether momentum is being dumped."""
        self._events: list[Event] = []
        self.reset_response_check()

    def reset_response_check(self) -> None:
        """Restart the wheel response check, because earlier commands were not executed."""
        self._asked, self._answered = np.zeros(len(self.wheels)), np.zeros(len(self.wheels))
        self._known = False

    @property
    def has_thrusters(self) -> bool:
        """Whether there are thrusters."""
        return self._thruster_torque > 0

    @property
    def rank(self) -> int:
        """Number of linearly independent axes of the wheels in use."""
        return self._allocate.rank

    @property
    def torque_about_every_axis(self) -> float:
        """Largest torque that the wheels in use can provide about every axis, N m; 0 if they cannot
        provide torque about all axes."""
        return self._allocate.within(self.wheels.torque[self._used])

    # -- measurements -------------------------------------------------------------------------

    def observe(
        self, measured: ControlState | None, q: Array, qdot: Array
    ) -> tuple[ControlState | None, Array, Array]:
        """Process a robot state and return the gyrostat state."""
        wheels = self.wheels
        self.rates = qdot[wheels.index]
        q, qdot = q[wheels.other], qdot[wheels.other]
        if measured is None:
            self._known = False
            return None, q, qdot
        self._omega = measured.omega_WB_B.copy()
        self._check_wheel_response()
        self._watch_rates()
        return replace(measured, q=q, qdot=qdot), q, qdot

    def reference(self, reference: Reference | None) -> Reference | None:
        """Return a robot reference as a gyrostat reference."""
        if reference is None or reference.joints is None:
            return reference
        parts = (getattr(reference.joints, name) for name in ("q", "qdot", "qddot"))
        joints = type(reference.joints)(*(part[self.wheels.other] for part in parts))
        return replace(reference, joints=joints)

    def shape_with_wheels(self, q: Array) -> Array:
        """Return the robot's joint positions (n,) from the gyrostat's (n - k,)."""
        whole = np.zeros(len(self.wheels) + len(self.wheels.other))
        whole[self.wheels.other] = q
        return whole

    def actuation(self, realised: Actuation) -> Actuation:
        """Return the thruster wrench and the efforts of all joints."""
        tau = self.shape_with_wheels(realised.tau)
        tau[self.wheels.index] = self.torque
        return Actuation(self.thrust.copy(), tau)

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    # -- torques ------------------------------------------------------------------------------

    def command_torque(self, torque: Array) -> Array:
        """Command wheel torques for a base torque (3,), N m; return the part that the wheels
        provide.

        The gyroscopic torque ``omega x A h`` of the spinning wheels is compensated for.
        """
        A = self.wheels.axes_B
        gyroscopic = cross(self._omega, A @ self.wheels.spins(self._omega, self.rates))
        if self.dumping:
            self.torque = self._dumping_torques()
        else:
            self.torque = np.zeros(len(self.wheels))
            used, wheels = self._used, self.wheels
            soon = wheels.inertia / (_MIN_PERIODS_TO_LIMIT * self._period)
            upper = np.clip(soon * (wheels.rate - self.rates), 0.0, wheels.torque)
            lower = -np.clip(soon * (wheels.rate + self.rates), 0.0, wheels.torque)
            wanted = -(torque + gyroscopic)
            self.torque[used] = self._allocate.allocate(wanted, lower[used], upper[used])
        given = -(A @ self.torque) - gyroscopic
        if np.abs(given - torque).max() <= 1e3 * _MIN_BOUND_WIDTH * np.abs(torque).max(
            initial=1e-6
        ):
            return torque.copy()
        return np.asarray(given)

    def coast(self) -> None:
        """Command no torque."""
        self.torque, self.thrust = np.zeros(len(self.wheels)), np.zeros(6)

    def limits_with_wheels(self, motion: MotionLimits, q: Array) -> MotionLimits:
        """Return reference limits for which wheels suffice, in a configuration (n - k,)."""
        if self.has_thrusters or self.rank < 3:
            return motion
        wheels, used = self.wheels, self._used
        inertia = float(np.linalg.eigvalsh(self.gyrostat.inertia_matrix(q)[3:6, 3:6])[-1])
        torque = self.torque_about_every_axis
        momentum = self._allocate.within((wheels.inertia * wheels.rate)[used])
        share = _MOTION_SHARE / inertia
        return replace(
            motion,
            angular_acceleration=min(motion.angular_acceleration, share * torque),
            angular_speed=min(motion.angular_speed, share * momentum),
        )

    # -- momentum -----------------------------------------------------------------------------

    def request_dump(self) -> str:
        """Start dumping the wheel momentum and return a message.

        Raises
        ------
        CommandError
            Without thrusters, momentum cannot be dumped.
        """
        if not self.has_thrusters:
            raise CommandError(
                "There are no thrusters (use_thrusters is false) to absorb the wheel momentum."
            )
        if self.dumping:
            return "Momentum is already being dumped."
        if self._is_dumped:
            return "The wheels have no momentum."
        self._begin_dump("on request")
        return "The wheel momentum is being dumped to the thrusters."

    def budget(self, q: Array, qdot: Array) -> dict[str, float]:
        """Return the norms of the :func:`momentum_budget` contributions by name, N m s, for the
        gyrostat's joints (n - k,).
        """
        parts = momentum_budget(self.wheels, self.gyrostat, self._omega, q, qdot, self.rates)
        return {name: float(np.linalg.norm(part)) for name, part in parts.items()}

    @property
    def shares(self) -> dict[str, float]:
        """Signed rate of each wheel as a fraction of its largest rate, by name."""
        return dict(zip(self.wheels.names, (self.rates / self.wheels.rate).tolist(), strict=True))

    @property
    def _is_dumped(self) -> bool:
        return bool(np.all(np.abs(self.rates) <= _DUMPED_SHARE * self.wheels.rate))

    def _begin_dump(self, why: str) -> None:
        self.dumping = True
        self._add(EventKind.DUMP_STARTED, f"The wheel momentum is being dumped {why}.", 0)

    def _dumping_torques(self) -> Array:
        wheels = self.wheels
        tau = np.where(self._used, -wheels.inertia * self.rates / _DUMP_TIME, 0.0)
        largest = _DUMP_TORQUE_SHARE * self._thruster_torque
        excess = max(
            float((np.abs(tau) / wheels.torque).max()),
            float(np.linalg.norm(wheels.axes_B @ tau)) / largest,
        )
        return tau / max(1.0, excess)

    # -- saturation and failures --------------------------------------------------------------

    def _watch_rates(self) -> None:
        wheels, options = self.wheels, self._options
        if self.dumping and self._is_dumped:
            self.dumping = False
            self._add(EventKind.DUMP_ENDED, "The wheel momentum has been dumped.", 0)
        shares = np.abs(self.rates) / wheels.rate
        for i in np.flatnonzero(self._used):
            share, name = float(shares[i]), wheels.names[i]
            turns = (
                f"Wheel '{name}' rotates at {self.rates[i]:.4g} of at most "
                f"{wheels.rate[i]:.4g} rad/s"
            )
            if share < options.warning_rate - _ANNOUNCEMENT_HYSTERESIS:
                self._announced[i] = 0.0
            elif share >= _SATURATED_SHARE > self._announced[i]:
                self._announced[i] = share
                message = f"{turns}: it is saturated and provides no more torque in this direction."
                self._add(EventKind.WHEEL_SATURATED, message, 1, name)
            elif share >= options.warning_rate and not self._announced[i]:
                self._announced[i], seconds = share, self.time_to_saturation(int(i))
                when = f", and will saturate in {seconds:.3g} s" if math.isfinite(seconds) else ""
                self._add(EventKind.WHEEL_NEAR_LIMIT, f"{turns}{when}.", 1, name)
        if options.dump_rate and not self.dumping:
            fastest = int(np.argmax(np.where(self._used, shares, 0.0)))
            if shares[fastest] >= options.dump_rate:
                self._begin_dump(f"because wheel '{wheels.names[fastest]}' is fast")

    def time_to_saturation(self, i: int) -> float:
        """Return the time until wheel i reaches its largest rate at its current torque, s."""
        tau, wheels = self.torque[i], self.wheels
        if tau == 0.0:
            return math.inf
        left = wheels.rate[i] - math.copysign(1.0, tau) * self.rates[i]
        return max(0.0, float(wheels.inertia[i] * left / abs(tau)))

    def _check_wheel_response(self) -> None:
        """Stop using wheels whose momentum does not follow their commanded torque."""
        wheels = self.wheels
        spins = wheels.spins(self._omega, self.rates)
        if self._known:
            self._asked += np.abs(self.torque) * self._period
            self._answered += np.sign(self.torque) * (spins - self._spins)
        self._spins, self._known = spins, True
        judged = self._asked >= wheels.torque * _FAILURE_TIME
        weak = self._answered < _MIN_RESPONSE_SHARE * self._asked
        for i in np.flatnonzero(judged & self._used & weak):
            self._fail(int(i))
        self._asked[judged] = self._answered[judged] = 0.0

    def _fail(self, i: int) -> None:
        name, asked, answered = self.wheels.names[i], self._asked[i], self._answered[i]
        self._used[i] = False
        self._allocate = self._make_allocation()
        left = " and the thrusters" if self.has_thrusters else ""
        message = (
            f"Wheel '{name}' absorbed {answered:.3g} of {asked:.3g} N m s and is no longer used: "
            f"{counted(int(self._used.sum()), 'wheel')}{left} can be used."
        )
        self._add(EventKind.WHEEL_FAILED, message, 1, name)

    def _make_allocation(self) -> WheelAllocation:
        used: npt.NDArray[np.bool_] = self._used
        return WheelAllocation(self.wheels.axes_B[:, used], self.wheels.torque[used])

    def _add(self, kind: EventKind, message: str, level: int, wheel: str = "") -> None:
        about = {"wheel": wheel} if wheel else {}
        self._events.append(Event(kind, message, level, about=about))


BUDGET_PARTS = ("base", "arm", "wheels", "sum")
"""The contributions in :func:`momentum_budget`."""


def momentum_budget(
    wheels: ReactionWheels,
    gyrostat: SpaceRobot,
    omega_WB_B: Array,
    q: Array,
    qdot: Array,
    rates: Array,
) -> dict[str, Array]:
    """Return the contributions (3,) to the angular momentum about the centre of mass by name, N m
    s, in the base frame.

    ``base`` is due to the rotation of the gyrostat with the base while its joints are at rest;
    ``arm`` is due to the gyrostat's joints (q, qdot: (n - k,)) with the base at rest; ``wheels`` is
    ``A h``; ``sum`` their sum.
    """
    H = gyrostat.inertia_matrix(q)
    parts = {
        "base": H[3:6, 3:6] @ omega_WB_B,
        "arm": H[3:6, 6:] @ qdot,
        "wheels": wheels.axes_B @ wheels.spins(omega_WB_B, rates),
    }
    return {**parts, "sum": parts["base"] + parts["arm"] + parts["wheels"]}
