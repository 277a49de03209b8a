"""Joints that do not follow: found, and planned around with those that remain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError, PlanningError, RobotDescriptionError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.parameters import declared
from spacerobot_ros.planning.core.goal import POSE, Controlled, Goal, RobotState, Tolerance
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.methods.registry import METHODS, build_method

_STUCK_SHARE = 0.05
"""A joint that goes less than this part of what it is commanded to go is stuck."""

_FOLLOWS_SHARE = 0.5
"""... and one that goes more than this follows. In between it is slow, or noise hides it."""

_PATIENCE = 8
"""Windows that are waited for commands to arrive when no joint moves."""

_LOOK_EVERY = 16
"""Ticks between two looks at joints that have all followed so far: a look takes time."""

_LEAST_BAND = 1e-6
"""Errors below this are rounding, m or rad."""

_OF_JOINTS = frozenset(
    option.name
    for name, method in METHODS.items()
    for option in declared(method.Options, f"{name}.")
    if option.of_joints
)
"""Keys of the options that say something of every joint."""


class StuckJointWatch:
    """Watches the joints of a flight, tick by tick.

    Since it was last seen to follow, every joint has gone over some range and was commanded to go
    over another; a joint is stuck when it was commanded to move in N ticks or more and the first
    range is a small part of the second. So joints that are not commanded to move, slow ones, and
    ones whose measurements are noisy are not taken for stuck. Where no joint moves at all they are
    watched for longer: a plant that starts again takes a while to hear its commander.

    Parameters
    ----------
    joints
        Their number.
    ticks
        N; 0: nothing is ever stuck.
    tick_period
        s.
    band
        Measured shapes that are as near as this to the wanted ones are there, m or rad.
    """

    def __init__(self, joints: int, ticks: int, tick_period: float, band: float = 0.0) -> None:
        self._ticks, self._tick_period = ticks, tick_period
        self._band = max(band, _LEAST_BAND)
        self._joints, self._longest = joints, _PATIENCE * ticks
        self.restart()

    def restart(self) -> None:
        """Begin with a new flight."""
        n = self._joints
        self._suspicious, self._looks = False, 0
        self._moving = np.zeros(n, dtype=np.int64)
        self._window = np.full(n, self._ticks, dtype=np.int64)
        self._commanded = np.zeros(n)
        self._asked, self._gone = np.zeros((2, n)), np.zeros((2, n))

    def look(self, q: Array, wanted: Array, velocity: Array) -> list[int]:
        """Return which joints are stuck, mostly none.

        ``q`` and ``wanted`` (n,) are the measured and the wanted shape now, ``velocity`` (n,) what
        is commanded until the next tick.
        """
        if not self._suspicious:
            self._looks += 1
            if self._looks % _LOOK_EVERY or not self._ticks:
                return []
            if np.abs(wanted - q).max(initial=0.0) <= self._band:
                return []
            self._suspicious = True
            self._begin(np.ones(self._joints, dtype=np.bool_), q)
        _widen(self._gone, q)
        self._commanded += velocity * self._tick_period
        _widen(self._asked, self._commanded)
        self._moving += np.abs(velocity) * self._tick_period > _LEAST_BAND * _STUCK_SHARE
        due = self._moving >= self._window
        if not due.any():
            return []
        asked, gone = np.diff(self._asked, axis=0)[0], np.diff(self._gone, axis=0)[0]
        stuck = due & (gone <= _STUCK_SHARE * asked) & (asked > self._band)
        moved = asked > self._band
        still = gone[moved] <= _STUCK_SHARE * asked[moved]
        if np.count_nonzero(moved) > 1 and still.all() and self._window[due].max() < self._longest:
            # Joints do not all jam at once: commands do not arrive, perhaps not for long.
            stuck[:] = False
        follows = due & (gone >= _FOLLOWS_SHARE * asked)
        # Those in between are looked at for longer.
        self._window[due] *= 2
        self._begin(follows | stuck, q)
        return [int(i) for i in np.flatnonzero(stuck)]

    def _begin(self, joints: npt.NDArray[np.bool_], q: Array) -> None:
        self._moving[joints], self._window[joints] = 0, self._ticks
        self._commanded[joints] = 0.0
        self._asked[:, joints], self._gone[:, joints] = 0.0, q[joints]


def _widen(ranges: Array, values: Array) -> None:
    np.minimum(ranges[0], values, out=ranges[0])
    np.maximum(ranges[1], values, out=ranges[1])


class RemainingJointsGait(GaitMethod):
    """Plans with the joints that are not stuck; the others are part of the bodies they join.

    The model is that of the robot with the stuck joints fixed where the first plan finds them. Its
    schedules name every joint and leave the stuck ones there.

    Parameters
    ----------
    stuck
        Names of the joints.
    method, options
        What plans for the robot that is left, as for :func:`build_method`; where it refuses, the
        method ``auto`` is asked.
    controls
        Parts of the goal that must not be left as they come.
    """

    name: ClassVar[str] = "remaining_joints"

    def __init__(
        self,
        robot: SpaceRobot,
        tick_period: float,
        tolerance: Tolerance,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        *,
        stuck: Sequence[str],
        method: str,
        options: Mapping[str, Any],
        controls: frozenset[Controlled] = frozenset(),
    ) -> None:
        super().__init__(robot, tick_period, tolerance, integration_step)
        self._stuck = np.array([name in stuck for name in robot.joint_names], dtype=np.bool_)
        self._names = list(dict.fromkeys((method, "auto")))
        self._required = controls
        self._options = _options_without(options, self._stuck, robot.joint_names)
        self._remaining: SpaceRobot | None = None
        self._methods: dict[str, GaitMethod] = {}

    @classmethod
    def instead_of(
        cls, method: GaitMethod, stuck: Sequence[str], name: str, options: Mapping[str, Any]
    ) -> RemainingJointsGait:
        """Return what goes on for a method, of a name and with options, without some joints."""
        return cls(
            method.robot,
            method.tick_period,
            method.tolerance,
            method.integration_step,
            stuck=stuck,
            method=name,
            options=options,
            controls=method.controls & POSE,
        )

    def plan(self, state: RobotState, goal: Goal, *, correction: bool = False) -> GaitSchedule:
        """Plan with the remaining joints; see :meth:`GaitMethod.plan`."""
        try:
            return self._plan(state, goal, correction)
        except PlanningError as refusal:
            raise PlanningError(f"{self._where(state)}; {refusal}") from None

    def _plan(self, state: RobotState, goal: Goal, correction: bool) -> GaitSchedule:
        moving = ~self._stuck
        if not moving.any():
            raise PlanningError(
                "no joint follows; /diagnostics says whether the plant refuses the commands."
            )
        shape = goal.joint_positions
        left = replace(state, q=state.q[moving])
        wanted = replace(goal, joint_positions=None if shape is None else shape[moving])
        reasons = []
        for name in self._names:
            try:
                method = self._method(name, state)
                schedule = method.plan(left, wanted, correction=correction)
            except (PlanningError, ParameterError, RobotDescriptionError) as refusal:
                reasons.append(str(refusal))
                continue
            lost = self._required - method.controls
            if lost:
                parts = " and ".join(sorted(lost))
                reasons.append(f"{schedule.method} would leave the {parts} as it comes.")
                continue
            if "shape" in method.controls and shape is not None:
                self._require_shape(state, shape)
            self.controls = method.controls
            self._names = [name]
            positions = np.tile(state.q, (len(schedule.positions), 1))
            positions[:, moving] = schedule.positions
            return replace(
                schedule, joint_names=self.robot.joint_names, positions=positions, goal=goal
            )
        raise PlanningError(f"with the remaining joints: {' '.join(dict.fromkeys(reasons))}")

    def _method(self, name: str, state: RobotState) -> GaitMethod:
        if self._remaining is None:
            fixed = {
                joint: float(position)
                for joint, position, stuck in zip(
                    self.robot.joint_names, state.q, self._stuck, strict=True
                )
                if stuck
            }
            self._remaining = SpaceRobot(self.robot.description.with_locked(fixed))
        if name not in self._methods:
            self._methods[name] = build_method(
                name,
                self._remaining,
                self.tick_period,
                self.tolerance,
                self.integration_step,
                self._options,
            )
        method = self._methods[name]
        method.tolerance = self.tolerance
        return method

    def _require_shape(self, state: RobotState, shape: Array) -> None:
        far = np.abs(shape - state.q) * self._stuck
        worst = int(np.argmax(far))
        if far[worst] > self.tolerance.shape:
            raise PlanningError(
                f"the goal wants joint '{self.robot.joint_names[worst]}' at {shape[worst]:.4g}."
            )

    def _where(self, state: RobotState) -> str:
        places = []
        for joint, position, stuck in zip(
            self.robot.description.movable_joints, state.q, self._stuck, strict=True
        ):
            if stuck:
                unit = "m" if joint.kind is JointKind.PRISMATIC else "rad"
                places.append(f"joint '{joint.name}' is stuck at {position:.4g} {unit}")
        return " and ".join(places)


def _options_without(
    options: Mapping[str, Any], stuck: npt.NDArray[np.bool_], names: Sequence[str]
) -> dict[str, Any]:
    """Return options for the remaining joints: lists with a number a joint lose those of the stuck
    ones, and names of joints are left to the method if one of them is stuck.
    """
    gone = {name for name, is_stuck in zip(names, stuck, strict=True) if is_stuck}
    kept = dict(options)
    for key in _OF_JOINTS & kept.keys():
        value = kept[key]
        if isinstance(value, str):
            kept[key] = "" if gone & set(value.split()) else value
        elif len(value) == len(names):
            kept[key] = [x for x, is_stuck in zip(value, stuck, strict=True) if not is_stuck]
    return kept
