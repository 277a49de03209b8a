"""Status of a controller: the state of its goal, and how well its last command was defined."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.planning.core.goal import Controlled

_ERROR_PREFIX = "error."
"""Prefix of the keys of output errors."""

_WHEEL_PREFIX, _MOMENTUM_PREFIX = "wheel.", "momentum."
"""Prefixes of the keys of the rates of reaction wheels, and of the momentum budget."""


class ControllerState(str, Enum):
    """The value of ``state`` in controller/status."""

    HOLDING = "holding"
    TRACKING = "tracking"
    REACHED = "reached"
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"
    ESTIMATING = "estimating"
    STOPPED = "stopped"

    @property
    def decided(self) -> bool:
        """Whether the state of the goal is final."""
        return self in (
            ControllerState.REACHED,
            ControllerState.FAILED,
            ControllerState.REFUSED,
            ControllerState.ABORTED,
        )

    @property
    def level(self) -> int:
        """Level of diagnostic_msgs/DiagnosticStatus: 0 OK, 1 WARN, 2 ERROR."""
        match self:
            case ControllerState.FAILED | ControllerState.REFUSED | ControllerState.STOPPED:
                return 2
            case ControllerState.ABORTED | ControllerState.ESTIMATING:
                return 1
            case _:
                return 0


@dataclass(frozen=True)
class CommandReport:
    """Report on one command of the controller.

    Attributes
    ----------
    law
        Name of the control law.
    singular, smallest_singular_value, damping
        See :class:`spacerobot_ros.control.LawStatus`.
    lost_force_N, lost_torque_Nm, lost_effort
        Part of the command beyond the limits: norms for the thrusters, the largest of the joints
        (N or N m).
    errors
        Error of each output by its label, m or rad.
    wheels
        Rate of each reaction wheel by name, as a share of its largest one.
    momentum
        Angular momentum about the centre of mass, N m s: of ``base``, ``arm``, ``wheels``, and
        their ``sum``; empty without reaction wheels.
    dumping
        Whether the momentum of the wheels is being dumped.
    """

    law: str
    singular: bool
    smallest_singular_value: float
    damping: float
    lost_force_N: float
    lost_torque_Nm: float
    lost_effort: float
    errors: Mapping[str, float] = field(default_factory=dict)
    wheels: Mapping[str, float] = field(default_factory=dict)
    momentum: Mapping[str, float] = field(default_factory=dict)
    dumping: bool = False

    def controls(self, part: str = "base") -> frozenset[Controlled]:
        """Return which of position, attitude and shape the outputs control.

        ``part`` is the part of the robot whose pose is meant: ``base`` or ``end_effector``.
        """
        kinds: dict[Controlled, tuple[str, ...]] = {
            "position": (f"{part}.x", f"{part}.y", f"{part}.z"),
            "attitude": (f"{part}.r",),
            "shape": ("joint.",),
        }
        return frozenset(
            part
            for part, beginnings in kinds.items()
            if any(label.startswith(beginnings) for label in self.errors)
        )


@dataclass(frozen=True)
class ControllerStatus:
    """A status of the controller, as controller/status carries it.

    Attributes
    ----------
    state
        State of the goal.
    message
        The text for the user.
    goal_id
        Id of the goal of this status; empty: no goal, or one without an id.
    command
        Report on the last command; None before the first.
    task
        The work before the goal is pursued: ``approach`` or ``detumble``; empty: nothing.
    ends_at_s
        Simulated time at which the goal is to be reached, when the reference has ended and the
        robot has settled, s; 0: not known.
    """

    state: ControllerState
    message: str = ""
    goal_id: str = ""
    command: CommandReport | None = None
    task: str = ""
    ends_at_s: float = 0.0

    def to_values(self) -> dict[str, str]:
        """Return the status as the key-value pairs of a DiagnosticStatus; numbers have 6 digits."""
        values = {"state": self.state.value}
        if self.goal_id:
            values["goal_id"] = self.goal_id
        if self.task:
            values["task"] = self.task
        if self.ends_at_s:
            # Long flights have large times.
            values["ends_at_s"] = f"{self.ends_at_s:.9g}"
        if self.command is not None:
            values["law"] = self.command.law
            values["singular"] = str(self.command.singular).lower()
            values.update((name, f"{getattr(self.command, name):.6g}") for name in _NUMBER_KEYS)
            values.update(
                (f"{_ERROR_PREFIX}{label}", f"{error:.6g}")
                for label, error in self.command.errors.items()
            )
            if self.command.wheels:
                values["dumping"] = str(self.command.dumping).lower()
            for prefix, numbers in (
                (_WHEEL_PREFIX, self.command.wheels),
                (_MOMENTUM_PREFIX, self.command.momentum),
            ):
                values.update((f"{prefix}{key}", f"{x:.6g}") for key, x in numbers.items())
        return values

    @classmethod
    def from_values(cls, values: Mapping[str, str], message: str = "") -> ControllerStatus:
        """Return the status of the pairs of :meth:`to_values`.

        Raises
        ------
        SpaceRobotError
            The pairs are not those of a controller.
        """
        try:
            command = None
            if "law" in values:
                command = CommandReport(
                    law=values["law"],
                    singular=values["singular"] == "true",
                    **{name: float(values[name]) for name in _NUMBER_KEYS},
                    errors=_numbers_below(_ERROR_PREFIX, values),
                    wheels=_numbers_below(_WHEEL_PREFIX, values),
                    momentum=_numbers_below(_MOMENTUM_PREFIX, values),
                    dumping=values.get("dumping") == "true",
                )
            state = ControllerState(values["state"])
            goal_id, task = values.get("goal_id", ""), values.get("task", "")
            ends_at = float(values.get("ends_at_s", 0.0))
            return cls(state, message, goal_id, command, task, ends_at)
        except (KeyError, ValueError) as error:
            raise SpaceRobotError(f"This is no status of a controller: {error}.") from error


def _numbers_below(prefix: str, values: Mapping[str, str]) -> dict[str, float]:
    """Return the numbers whose keys begin with a prefix, by the rest of their keys."""
    return {
        key.removeprefix(prefix): float(value)
        for key, value in values.items()
        if key.startswith(prefix)
    }


_NUMBER_KEYS = (
    "smallest_singular_value",
    "damping",
    "lost_force_N",
    "lost_torque_Nm",
    "lost_effort",
)
"""Values of a command report that are one number each."""


def tracking_time(states: Iterable[tuple[float, ControllerState]]) -> float | None:
    """Return the time from the first tracked state to the last decision about a goal, s.

    Parameters
    ----------
    states
        Time (s) and state of the controller's statuses; without either of them the result is None.
    """
    given = list(states)
    began = [time for time, state in given if state is ControllerState.TRACKING]
    ended = [
        time
        for time, state in given
        if state.decided and state is not ControllerState.REFUSED and began and time >= began[0]
    ]
    return ended[-1] - began[0] if ended else None
