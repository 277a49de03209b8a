"""Messages, tables and curves on the page, created from the state of the stack."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Generic, TypeVar

from spacerobot_ros.control.wheels import BUDGET_PARTS
from spacerobot_ros.errors import ParameterError, enumeration, numbers, quantity, shortened
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.core.goal import (
    Controlled,
    EndEffectorGoal,
    Tolerance,
    uncontrolled_parts,
)
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.simulation.faults import FAULT_KINDS, FaultTargets, parse_fault, with_seconds
from spacerobot_ros.simulation.status import PlantState
from spacerobot_ros.viewer.reachability import GoalCheck, Verdict
from spacerobot_ros.viewer.scene import Color
from spacerobot_ros.viewer.state import Measured, Notice, Part, StackState

SILENT_AFTER = 1.0
"""Wall time, s, after which the page reports that no state was received."""

_NEAR_LIMIT_SHARE = 0.05
"""Distance to a limit below which a joint is highlighted, as a fraction of the joint range."""

_WARNING_WHEEL_SHARE, _SATURATED_WHEEL_SHARE = 0.8, 0.98
"""Fractions of the maximum rate of a wheel above which the wheel is shown in amber and in red."""

_NEAR_CONTACT = 0.02
"""Link distance, m, below which the distance is shown at the top of the page."""

COLORS: Mapping[Verdict, Color] = {
    Verdict.UNCHECKED: (150, 150, 160),
    Verdict.PLANNING: (120, 170, 235),
    Verdict.REACHABLE: (40, 180, 90),
    Verdict.PARTLY: (240, 160, 30),
    Verdict.REFUSED: (220, 60, 60),
}
"""Ghost colours by goal verdict."""

_LEVEL_COLORS = "var(--ok-color,#2a9d5c)", "var(--warn-color,#c98a00)", "var(--bad-color,#d23c3c)"
"""Colours of the levels OK, WARN and ERROR; the colours in ``page.js`` are readable in both
themes.
"""

_FAINT_COLOR, _BAR_COLOR = "var(--faint-color,#8a8f98)", "#8a8f9855"

_ENDED = "The stack has ended: none of its nodes responds."


# -- the head of the page -----------------------------------------------------------------------


def silence_message(state: StackState) -> str:
    """Return a message if states no longer arrive or never arrived, otherwise an empty string."""
    if state.replay is not None and state.replay.state != "playing":
        return ""
    if state.age_s == math.inf:
        return "No state received yet: no plant is running in this ROS domain and namespace."
    if state.age_s < SILENT_AFTER:
        return ""
    if state.plant is not None and state.plant.state is PlantState.PAUSED:
        return ""
    return f"No state for {math.floor(state.age_s)} s."


def time_to_go(state: StackState) -> float | None:
    """Return the expected time, s, until the goal is reached; None if no goal is being pursued.

    The time is reported by a planner or, if there is none, by a controller.
    """
    planner, controller, measured = state.planner, state.controller, state.measured
    if measured is None:
        return None
    if planner is not None and "planner" not in state.absent:
        flies = planner.state is PlannerState.EXECUTING and planner.ends_at_s
        ends = planner.ends_at_s + planner.remaining_s if flies else 0.0
    elif controller is not None and "controller" not in state.absent:
        ends = controller.ends_at_s
    else:
        return None
    return max(0.0, ends - measured.time_s) if ends else None


def _to_go_text(left: float | None) -> str:
    """Return the end of a line about the time to go, s; None: no goal is being pursued.

    After the end of its reference, the robot settles at the goal.
    """
    if left is None:
        return ""
    return f", {left:.1f} s to go" if left > 0.0 else ", settling"


def progress(state: StackState) -> float | None:
    """Return the completed fraction of the planned manoeuvre, 0 to 1; None without a manoeuvre."""
    left, planner = time_to_go(state), state.planner
    if left is None or planner is None or planner.manoeuvre_time_s <= 0.0:
        return None
    return min(1.0, max(0.0, 1.0 - left / (planner.manoeuvre_time_s + planner.remaining_s)))


def status_html(
    state: StackState,
    errors: Mapping[Part, GoalErrors] | None = None,
    tolerance: Tolerance | None = None,
    *,
    described: bool = True,
) -> str:
    """Return the state of the stack; ``described`` states whether a robot is known.

    ``errors``: see :func:`goal_errors`. ``tolerance`` is the tolerance of the planner or,
    without a planner, of the controller; None if unknown.
    """
    lines = []
    hidden = "No robot is shown: no valid robot_description has been received."
    if problem := silence_message(state) or (not described and hidden):
        lines.append(_line_html(problem, 2))
    if has_stack_ended(state):
        lines.append(_line_html(_ENDED, 2))
    for name, seconds in sorted(state.silent.items()):
        lines.append(_line_html(f"Node '{name}' has been silent for {math.floor(seconds)} s.", 2))
    lines.extend(_line_html(f"Node '{name}' is not active.", 1) for name in sorted(state.inactive))
    if state.measured is not None:
        text = f"t = {state.measured.time_s:.2f} s{_to_go_text(time_to_go(state))}"
        lines.append(_line_html(text, None))
    if state.replay is not None:
        replay = state.replay
        text = f"Replay {replay.state}: {replay.position_s:.2f} s of {replay.duration_s:.2f} s"
        lines.append(_line_html(text, 0))
    if state.plant is not None:
        plant = state.plant
        lines.append(_node_html(state, "plant", plant.state.value, plant.message, plant.level))
        if plant.latched_fault and state.measured is not None:
            twist, rearm = state.measured.twist, " Press Rearm." * (state.replay is None)
            speed = quantity(math.hypot(*twist[:3]), "m/s")
            rate = quantity(math.hypot(*twist[3:]), "rad/s")
            lines.append(_line_html(f"The base drifts at {speed} and {rate}.{rearm}", 2))
        for kind, found in (("Fault", plant.faults), ("Disturbance", plant.disturbances)):
            lines.extend(_line_html(f"{kind}: {with_seconds(each)}", 1) for each in found)
    if state.clearance is not None and state.clearance.distance < _NEAR_CONTACT:
        line = _line_html(state.clearance.message, state.clearance.level or None)
        lines.append(_grey_out(line, offline="plant" in state.absent))
    if (planner := state.planner) is not None:
        partly = planner.state is PlannerState.REACHED and planner.not_controlled
        level = 1 if partly else planner.state.level
        lines.append(_node_html(state, "planner", planner.state.value, planner.message, level))
    if (control := state.controller) is not None:
        word, level = control.state.value, control.state.level
        lines.append(_node_html(state, "controller", word, control.message, level))
    if task := _task_before_goals(state):
        lines.append(_line_html(f"The goal is pursued once the task '{task}' has ended.", None))
    lines.extend(_distance_lines(state, errors or {}, tolerance))
    return padded("".join(lines))


def _distance_lines(
    state: StackState, errors: Mapping[Part, GoalErrors], tolerance: Tolerance | None
) -> list[str]:
    """Return a line about each part with a goal: its distance from the goal, and the time to go."""
    left = time_to_go(state) if state.planner is None else None
    to_go, planner = _to_go_text(left), state.planner
    flies = planner is not None and planner.state is PlannerState.EXECUTING
    lines = []
    for part, error in errors.items():
        of_link = bool(state.goals[part].end_effectors)
        # Once a planner has decided about a base goal, its message contains the numbers.
        by_planner = flies if not of_link else planner is not None
        if by_planner or (not of_link and state.controller is not None):
            text = _errors_text(error, tolerance, not_controlled(state, part))
            line = _line_html(f"{part} is {text}{'' if of_link else to_go}.", None)
            whose = "planner" if state.controller is None or of_link else "controller"
            lines.append(_grey_out(line, offline=whose in state.absent))
    return lines


def not_controlled(state: StackState, part: Part) -> tuple[Controlled, ...]:
    """Return the goal components that the planner or controller is known not to control."""
    goal = state.goals.get(part)
    if goal is None or goal.end_effectors:
        return ()
    if state.planner is not None and part == BASE_GOAL_KEY:
        return state.planner.not_controlled
    command = None if state.controller is None else state.controller.command
    if command is None or not command.errors:
        return ()
    return uncontrolled_parts(goal, command.controls(part))


def look_back_html(shown: StackState, live: StackState) -> str:
    """Return the lines shown above an earlier state: its age, and whether the stack has ended."""
    assert shown.measured is not None
    assert live.measured is not None
    ago = live.measured.time_s - shown.measured.time_s
    text = f"Looking back {ago:.1f} s. The robot is now at t = {live.measured.time_s:.2f} s."
    lines = [_line_html(text, 1)]
    if has_stack_ended(live):
        lines.append(_line_html(_ENDED, 2))
    return padded("".join(lines))


def line_html(text: str, level: int) -> str:
    """Return a line in the page header."""
    return padded(_line_html(text, level))


def has_stack_ended(state: StackState) -> bool:
    """Whether all nodes that have reported a status are offline, and at least one has become
    silent."""
    statuses = {"plant": state.plant, "planner": state.planner, "controller": state.controller}
    known = {key for key, status in statuses.items() if status is not None}
    return bool(known and state.silent) and known <= state.absent


def padded(html: str) -> str:
    """Return HTML with the margins and font size of the other page elements."""
    return f'<div style="padding:2px 12px 6px;font-size:.85em;line-height:1.35">{html}</div>'


def _node_html(state: StackState, key: str, word: str, message: str, level: int) -> str:
    """Return the status of a node; the status of an offline node is labelled as its last one."""
    offline, color = key in state.absent, _LEVEL_COLORS[level]
    if offline:
        word, color = f"offline, last {word}:", "inherit"
    text = (
        f'<div style="margin:2px 0"><b>{key.capitalize()}</b> '
        f'<span style="color:{color};font-weight:600">{escape(word)}</span> '
        f"{escape(message)}</div>"
    )
    return _grey_out(text, offline=offline)


def _grey_out(html: str, *, offline: bool) -> str:
    return f'<div style="opacity:.75">{html}</div>' if offline else html


def _line_html(text: str, level: int | None) -> str:
    style = "" if level is None else f"color:{_LEVEL_COLORS[level]};font-weight:600;"
    return f'<div style="{style}margin:2px 0">{escape(text)}</div>'


def check_html(check: GoalCheck) -> str:
    """Return the goal check result."""
    red, green, blue = COLORS[check.verdict]
    dot = (
        f'<span style="display:inline-block;width:.8em;height:.8em;border-radius:50%;'
        f'background:rgb({red},{green},{blue});margin-right:.4em"></span>'
    )
    return padded(f"{dot}<b>Goal {check.verdict.value}</b> {escape(check.message)}")


# -- tables -------------------------------------------------------------------------------------


def joints_html(robot: RobotDescription, q: Array, qdot: Array, effort: Array) -> str:
    """Return a table of joints (n,) and their limits, with a bar for each range."""
    rows = []
    lower, upper = robot.limits("lower"), robot.limits("upper")
    fastest, strongest = robot.limits("velocity"), robot.limits("effort")
    for i, joint in enumerate(robot.movable_joints):
        span = upper[i] - lower[i]
        share = (q[i] - lower[i]) / span if 0.0 < span < math.inf else None
        level = 0
        if share is not None and not _NEAR_LIMIT_SHARE <= share <= 1 - _NEAR_LIMIT_SHARE:
            level = 2 if not 0.0 <= share <= 1.0 else 1
        bar = "no limits" if share is None else _bar_html(share, level)
        # Long names take several lines.
        style = "white-space:normal;overflow-wrap:anywhere"
        cells = [f'<div style="{style}">{_name_html(joint.name)}</div>']
        cells += [f"{numbers([q[i]], 3)} {joint.unit}", bar]
        effort_unit = "N" if joint.unit == "m" else "N m"
        cells.append(_value_and_limit(qdot[i], fastest[i], f"{joint.unit}/s"))
        cells.append(_value_and_limit(effort[i], strongest[i], effort_unit))
        rows.append(cells)
    if not rows:
        return padded("The robot has no joints.")
    table = _table_html(rows, ("joint", "at", "in range", "rate", "effort"))
    return padded(f'<div tabindex="0" style="overflow-x:auto">{table}</div>')


def _table_html(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    cells = [[f"<th>{title}</th>" for title in head]] if head else []
    cells += [[f"<td>{cell}</td>" for cell in row] for row in rows]
    lines = "".join(f"<tr>{''.join(each)}</tr>" for each in cells)
    style = "border-spacing:3px 2px;text-align:left;white-space:nowrap;font-size:.85em"
    return f'<table style="{style}">{lines}</table>'


def _name_html(name: str) -> str:
    return f'<span title="{escape(name)}">{escape(shortened(name))}</span>'


def _bar_html(share: float, level: int) -> str:
    place = 100 * min(1.0, max(0.0, share))
    color = _LEVEL_COLORS[level]
    return (
        f'<div style="width:32px;height:8px;background:{_BAR_COLOR};border-radius:4px;'
        f'position:relative"><div style="position:absolute;left:{place:.0f}%;top:-2px;width:4px;'
        f'height:12px;margin-left:-2px;background:{color};border-radius:2px"></div></div>'
    )


def _value_and_limit(value: float, limit: float, unit: str) -> str:
    number = numbers([value], 2)
    return f"{number}/{limit:.3g} {unit}" if math.isfinite(limit) else f"{number} {unit}"


def log_html(notices: Iterable[Notice]) -> str:
    """Return the log lines, in the given order."""
    rows = []
    for notice in notices:
        time = "" if notice.time_s is None else f"{notice.time_s:.2f} s"
        color = _LEVEL_COLORS[notice.level] if notice.level else "inherit"
        rows.append(
            f'<div style="margin:2px 0"><span style="color:{_FAINT_COLOR}">{time} '
            f'{escape(notice.source.strip("/"))}</span> <span style="color:{color}">'
            f"{escape(notice.message)}</span></div>"
        )
    return padded("".join(rows) or "No events yet.")


# -- errors, momenta ----------------------------------------------------------------------------


GoalErrors = tuple[float, ...]
"""Distance of a robot part from its goal, m, and angle, rad, unless any attitude is accepted."""


def _errors_text(
    errors: GoalErrors, tolerance: Tolerance | None, left_out: Sequence[Controlled]
) -> str:
    """Return a clause with errors, their tolerances, and the components not controlled."""
    limits = (0.0, 0.0) if tolerance is None else (tolerance.position, tolerance.attitude)
    texts, bounds = [], []
    parts = zip(("position", "attitude"), errors, ("m", "rad"), limits, strict=False)
    for part, error, unit, limit in parts:
        free = part in left_out
        texts.append(quantity(error, unit) + " (not controlled)" * free)
        bounds += [] if free or tolerance is None else [quantity(limit, unit)]
    within = f" (tolerance {', '.join(bounds)})" if bounds else ""
    return f"{enumeration(texts)} from its goal{within}"


def _task_before_goals(state: StackState) -> str:
    """Return the task after which a controller pursues its goals; empty: there is none."""
    task = "" if state.controller is None else state.controller.task
    return task if state.goals and "controller" not in state.absent else ""


def goal_errors(state: StackState, kinematics: ForwardKinematics) -> dict[Part, GoalErrors]:
    """Return the error of each robot part that has a goal and a known pose. Goals that a controller
    pursues after a task, such as an approach, are omitted.
    """
    measured, errors = state.measured, dict[Part, GoalErrors]()
    if _task_before_goals(state):
        return {}
    for part, goal in state.goals.items():
        aim: Goal | EndEffectorGoal = goal
        pose: Array | None
        if goal.end_effectors:
            (aim,) = goal.end_effectors
            pose = _measured_pose(kinematics, aim.link, measured)
        elif part == BASE_GOAL_KEY:
            pose = None if measured is None else measured.pose
        else:
            pose = state.tool
        if pose is not None:
            error = PoseError.of_link(pose, aim)
            turned = () if aim.quaternion is None else (error.angle,)
            errors[part] = (error.distance, *turned)
    return errors


def _measured_pose(
    kinematics: ForwardKinematics, link: str, measured: Measured | None
) -> Array | None:
    """Return the pose (7,) of a link; None: it is not known, or the robot has no such link."""
    if measured is None or link not in kinematics.links:
        return None
    return kinematics.link_in_world(link, measured.pose, measured.q)


def end_effector_positions(state: StackState, kinematics: ForwardKinematics) -> dict[Part, Array]:
    """Return the world positions (3,), m, of the end-effectors whose paths are drawn.

    These end-effectors are the plant's end-effector, if it publishes one, and the links with goals.
    """
    found = {} if state.tool is None else {DEFAULT_END_EFFECTOR: state.tool[:3]}
    for goal in state.goals.values():
        for aim in goal.end_effectors:
            pose = _measured_pose(kinematics, aim.link, state.measured)
            if pose is not None:
                found[aim.link] = pose[:3]
    return found


def planned_positions(
    state: StackState, robot: RobotDescription, kinematics: ForwardKinematics
) -> dict[Part, Array]:
    """Return the planned world positions (k, 3) of end-effectors, m.

    The end-effectors are those in :func:`end_effector_positions` that are links of the robot.
    """
    motion = state.planned_motion
    n = len(robot.joint_names)
    if motion is None or motion.shape[1] != 7 + n:
        return {}
    links = {aim.link: aim.link for goal in state.goals.values() for aim in goal.end_effectors}
    if state.tool is not None:
        links[DEFAULT_END_EFFECTOR] = robot.end_effector()
    _, places = kinematics.poses_in_world(motion[:, :7], motion[:, 7:])
    names = kinematics.links
    return {part: places[:, names.index(x)] for part, x in links.items() if x in names}


def flown_check(state: StackState) -> GoalCheck | None:
    """Return the end of the plan that is being executed, as a goal check result; None: there is
    none.

    Controlled goal components are assumed to be reached: later plans correct remaining errors.
    """
    planner, motion = state.planner, state.planned_motion
    if planner is None or motion is None or "planner" in state.absent:
        return None
    if planner.state is not PlannerState.EXECUTING:
        return None
    left_out, base = not_controlled(state, BASE_GOAL_KEY), motion[-1, :7].copy()
    goal = state.goals.get(BASE_GOAL_KEY)
    if goal is not None and "position" in goal.base - {*left_out}:
        base[:3] = goal.position
    if goal is not None and "attitude" in goal.base - {*left_out}:
        base[3:] = goal.quaternion
    verdict = Verdict.PARTLY if left_out else Verdict.REACHABLE
    message = "The robot flies to the ghost."
    if left_out:
        message += f" Not controlled: {' and '.join(left_out)}."
    return GoalCheck(verdict, message, shape=motion[-1, 7:], base=base, source=motion)


def momentum_budget(state: StackState) -> dict[str, float]:
    """Return the angular momentum components in controller/status, N m s; empty if there are none,
    or if the controller is offline.
    """
    control = state.controller
    if control is None or control.command is None or "controller" in state.absent:
        return {}
    found = control.command.momentum
    complete = set(BUDGET_PARTS) <= set(found)
    return {part: found[part] for part in BUDGET_PARTS} if complete else {}


def momentum_html(state: StackState) -> str:
    """Return the momentum budget, and the rate of each wheel as a fraction of its maximum."""
    budget = momentum_budget(state)
    control = state.controller
    if not budget or control is None or control.command is None:
        return ""
    command = control.command
    rows = [(escape(part), f"{numbers([value], 3)} N m s", "") for part, value in budget.items()]
    for name, share in command.wheels.items():
        # 0, 1 or 2: the number of thresholds that it reaches.
        level = sum(abs(share) >= each for each in (_WARNING_WHEEL_SHARE, _SATURATED_WHEEL_SHARE))
        bar = _bar_html((1.0 + share) / 2, level)
        rows.append((_name_html(name), f"{numbers([100 * share], 0)} %", bar))
    dumping = _line_html("The wheel momentum is being dumped.", 1)
    return padded(f"<b>Angular momentum</b>{_table_html(rows)}{dumping * command.dumping}")


def steered_tool(state: StackState) -> Array | None:
    """Return the end-effector pose (7,) if a controller accepts goals for it, otherwise None."""
    return None if state.controller is None else state.tool


# -- faults -------------------------------------------------------------------------------------


def fault_line(
    kind: str, target: str, value: float, lasts_s: float, now_s: float, targets: FaultTargets
) -> str:
    """Return the description of a fault that starts now and lasts for ``lasts_s``; 0 means forever.

    Raises
    ------
    ParameterError
        There is no such fault, or a value is not finite.
    """
    if not (math.isfinite(lasts_s) and lasts_s >= 0.0):
        raise ParameterError(f"The fault duration is {lasts_s:g} s; it must not be negative.")
    words = [kind, target]
    if kind in FAULT_KINDS and FAULT_KINDS[kind].value:
        words.append(f"{value:.9g}")
    if lasts_s:
        words += ["until", f"{now_s + lasts_s:.9g}"]
    line = " ".join(words)
    parse_fault(line, targets, now_s)
    return line


def faults_html(lines: Sequence[str]) -> str:
    """Return the active faults."""
    if not lines:
        return hint_html("No fault is active.")
    return padded("".join(_line_html(with_seconds(line), 1) for line in lines))


def hint_html(text: str) -> str:
    """Return an explanation in grey."""
    return padded(f'<span style="color:{_FAINT_COLOR}">{escape(text)}</span>')


# -- over time ----------------------------------------------------------------------------------


T = TypeVar("T")


class RecentItems(Generic[T]):
    """Items from the last minutes of simulated time, in time order, at least one step apart.

    Parameters
    ----------
    span_s
        Simulated time, s, from the oldest to the latest item.
    most
        Largest number of items; if it is exceeded, every second item is dropped and the step is
        doubled.
    """

    def __init__(self, span_s: float = 300.0, most: int = 1500) -> None:
        self._span, self._most, self._step = span_s, most, 0.0
        self._times: list[float] = []
        self._items: list[T] = []

    def add(self, time_s: float, item: T) -> None:
        """Add an item; existing items at this time or later are dropped first (time may jump
        back)."""
        times = self._times
        begin, end = (bisect_left(times, each) for each in (time_s - self._span, time_s))
        if end - begin > 1 and times[end - 1] - times[end - 2] < self._step:
            end -= 1  # Only the latest item may be closer than a step to the previous one.
        self._times, self._items = [*times[begin:end], time_s], [*self._items[begin:end], item]
        if len(self._times) > self._most:
            self._step = 2.0 * (time_s - self._times[0]) / self._most
            self._times = [*self._times[:-1:2], time_s]
            self._items = [*self._items[:-1:2], item]

    @property
    def items(self) -> Sequence[T]:
        """The items."""
        return self._items

    def until(self, time_s: float) -> Sequence[T]:
        """Return the items at or before a time."""
        return self._items[: bisect_right(self._times, time_s)]

    @property
    def span(self) -> tuple[float, float] | None:
        """Times of the first and last items, s; None: there is none."""
        return (self._times[0], self._times[-1]) if self._times else None

    def at(self, time_s: float) -> T:
        """Return the last item at or before a time or, if there is none, the first item."""
        return self._items[max(bisect_right(self._times, time_s) - 1, 0)]
