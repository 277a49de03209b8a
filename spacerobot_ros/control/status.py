"""Controller status: goal state, and conditioning of the last command."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from spacerobot_ros.control.outputs import controlled_parts
from spacerobot_ros.events import (
    BOOLEAN,
    KeyValueField,
    KeyValueFormat,
    choice_format,
    number_format,
)
from spacerobot_ros.planning.core.goal import Controlled
from spacerobot_ros.planning.execution.status import NUMBERS, GoalState

if TYPE_CHECKING:
    from spacerobot_ros.control.controller import CoordinatedController
    from spacerobot_ros.control.limits import Saturated


class ControllerState(GoalState):
    """Value of ``state`` in controller/status."""

    WAITING = "waiting"
    """No state has been measured yet."""
    HOLDING = "holding"
    TRACKING = "tracking"
    STALLED = "stalled"
    """A goal is tracked, but the robot makes no progress."""
    REACHED = "reached"
    REACHED_PARTLY = "reached_partly"
    """A requested component of the base pose is out of tolerance and not controlled."""
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"
    ESTIMATING = "estimating"
    STOPPED = "stopped"


@dataclass(frozen=True)
class CommandReport:
    """Report on one controller command.

    Attributes
    ----------
    law
        Name of the control law.
    singular, smallest_singular_value, damping
        See :class:`spacerobot_ros.control.LawStatus`.
    lost_force_N, lost_torque_Nm, lost_effort
        Excess of the command over the limits: norms for the thrusters, maximum over the joints (N
        or N m).
    errors
        Error of each output by its label, m or rad.
    wheels
        Rate of each reaction wheel by name, as a fraction of its largest rate.
    momentum
        Angular momentum about the centre of mass, N m s, of ``base``, ``arm``, ``wheels``, and
        their ``sum``; empty without reaction wheels.
    dumping
        Whether wheel momentum is being dumped.
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

    @classmethod
    def of(cls, controller: CoordinatedController, result: Saturated) -> CommandReport:
        """Return the report on a controller's last command; ``result`` is this command within the
        limits."""
        law, excess, wheels = controller.law, result.excess, controller.wheels
        status, state = law.status, law.state
        return cls(
            law=law.name,
            singular=status.singular,
            smallest_singular_value=status.smallest_singular_value,
            damping=status.damping,
            lost_force_N=float(np.linalg.norm(excess.wrench_B[:3])),
            lost_torque_Nm=float(np.linalg.norm(excess.wrench_B[3:])),
            lost_effort=float(np.abs(excess.tau).max(initial=0.0)),
            errors=dict(zip(law.outputs.labels, law.error.tolist(), strict=True)),
            wheels={} if wheels is None else wheels.shares,
            momentum={} if wheels is None else wheels.budget(state.q, state.qdot),
            dumping=wheels is not None and wheels.dumping,
        )

    def controls(self, part: str = "base") -> frozenset[Controlled]:
        """Return which of position, attitude and shape are controlled by the outputs.

        ``part`` is ``base`` or ``end_effector``.
        """
        labels = [label.split(".", 1) for label in self.errors]
        axes = [axis for group, axis in labels if group == part]
        return controlled_parts(axes, [name for group, name in labels if group == "joint"])


@dataclass(frozen=True)
class ControllerStatus:
    """A controller status, as published on controller/status.

    Attributes
    ----------
    state
        State of the goal.
    message
        Text for the user.
    goal_id
        Goal id; empty: no goal, or a goal without an id.
    command
        Report on the last command; None before the first.
    task
        Task before the goal: ``approach`` or ``detumble``; empty: none.
    ends_at_s
        Expected simulated time at which the goal will be reached, including settling, s; 0:
        unknown.
    goal
        (7,) pursued base goal, as in :class:`.PlannerStatus`.
    """

    state: ControllerState
    message: str = ""
    goal_id: str = ""
    command: CommandReport | None = None
    task: str = ""
    ends_at_s: float = 0.0
    goal: tuple[float, ...] = ()

    def to_values(self) -> dict[str, str]:
        """Return the status as the key-value pairs of a DiagnosticStatus; numbers have six
        digits."""
        command = {} if self.command is None else _COMMAND_FORMAT.to_values(self.command)
        return _FORMAT.to_values(self) | command

    @classmethod
    def from_values(cls, values: Mapping[str, str], message: str = "") -> ControllerStatus:
        """Return the status from pairs written by :meth:`to_values`.

        Raises
        ------
        SpaceRobotError
            The pairs do not form a controller status.
        """
        command = None
        if "law" in values:
            command = _COMMAND_FORMAT.from_values(CommandReport, values)
        return _FORMAT.from_values(cls, values, message=message, command=command)


_NUMBER = number_format(".6g")
_FORMAT = KeyValueFormat(
    "status of a controller",
    KeyValueField("state", choice_format(ControllerState)),
    KeyValueField("goal_id"),
    KeyValueField("goal", NUMBERS),
    KeyValueField("task"),
    KeyValueField("ends_at_s", number_format(".9g")),  # Long flights have large times.
)
_COMMAND_FORMAT = KeyValueFormat(
    "status of a controller",
    KeyValueField("law"),
    KeyValueField("singular", BOOLEAN),
    KeyValueField("smallest_singular_value", _NUMBER),
    KeyValueField("damping", _NUMBER),
    KeyValueField("lost_force_N", _NUMBER),
    KeyValueField("lost_torque_Nm", _NUMBER),
    KeyValueField("lost_effort", _NUMBER),
    KeyValueField("errors", _NUMBER, prefix="error."),
    KeyValueField("dumping", BOOLEAN, present_with="wheels"),
    KeyValueField("wheels", _NUMBER, prefix="wheel."),
    KeyValueField("momentum", _NUMBER, prefix="momentum."),
)


def tracking_time(states: Iterable[tuple[float, ControllerState]]) -> float | None:
    """Return the time from the first tracked state to the last goal decision, s, which later
    statuses repeat.

    Parameters
    ----------
    states
        Times (s) and states of the controller statuses; without a tracked state or a decision, the
        result is None.
    """
    began = ended = None
    decided = False
    for time, state in states:
        if began is None and state is ControllerState.TRACKING:
            began = time
        if began is None or state is ControllerState.REFUSED:
            continue
        if state.decided and not decided:
            ended = time
        decided = state.decided
    return None if began is None or ended is None else ended - began
