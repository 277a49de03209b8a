"""What the page says: texts and numbers from the state of the stack, without a page."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from spacerobot_ros.control.status import ControllerState
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.rotations import quaternion_multiply
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.simulation.faults import KINDS, Targets, parse_fault
from spacerobot_ros.simulation.status import PlantState
from spacerobot_ros.viewer.port import Momenta, Notice, StackState
from spacerobot_ros.viewer.reachability import Check, Verdict

Color = tuple[int, int, int]

SILENT_AFTER = 1.0
"""Wall s without a state after which the page says so."""

_NEAR_LIMIT = 0.05
"""Share of its range that a joint is from its end when it counts as near."""

_LONGEST_NAME = 21
"""Characters of the name of a joint that are shown."""

COLORS: Mapping[Verdict, Color] = {
    Verdict.UNCHECKED: (150, 150, 160),
    Verdict.PLANNING: (235, 190, 40),
    Verdict.REACHABLE: (40, 180, 90),
    Verdict.REFUSED: (220, 60, 60),
}
"""Of the ghost, by what is known of its goal."""

_LEVELS = ("#2a9d5c", "#c98a00", "#d23c3c")
"""Of texts of level OK, WARN and ERROR: readable on white and on black."""

_QUIET = "#8a8f98"


def rpy_from_quaternion(quaternion: Array) -> Array:
    """Return the angles (3,) about the fixed axes x, y, z, in this order, rad.

    Source: `R = Rz(yaw) Ry(pitch) Rx(roll)`, as URDF has it; at a pitch of 90 deg roll is zero.
    """
    x, y, z, w = quaternion
    sine = float(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    if abs(sine) > 1 - 1e-12:
        return np.array([0.0, math.copysign(math.pi / 2, sine), 2 * math.atan2(z, w)])
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, math.asin(sine), yaw])


def quaternion_from_rpy(rpy: Sequence[float] | Array) -> Array:
    """Return the quaternion (x, y, z, w) of such angles, rad."""
    halves = 0.5 * np.asarray(rpy, float)
    (sr, sp, sy), (cr, cp, cy) = np.sin(halves), np.cos(halves)
    yaw_pitch = quaternion_multiply(np.array([0, 0, sy, cy]), np.array([0, sp, 0, cp]))
    product: Array = quaternion_multiply(yaw_pitch, np.array([sr, 0, 0, cr]))
    return product


def goal_of(
    position: Sequence[float] | Array,
    quaternion: Sequence[float] | Array,
    shape: Array | None = None,
) -> Goal:
    """Return the goal of the numbers on the page; ``shape`` (n,) to end in, m or rad, if any.

    Raises
    ------
    GoalError
        They are no pose.
    """
    return Goal.checked(list(position), list(quaternion), shape)


# -- the head of the page -----------------------------------------------------------------------


def silence(state: StackState) -> str:
    """Return a sentence where no state comes, else an empty text."""
    if state.replay is not None and (state.replay.paused or state.replay.ended):
        return ""
    if state.age_s == math.inf:
        return "No state has come yet: no plant is running in this ROS domain and namespace."
    if state.age_s < SILENT_AFTER:
        return ""
    if state.plant is not None and state.plant.state is PlantState.PAUSED:
        return ""
    return f"No state for {math.floor(state.age_s)} s."


def time_to_go(state: StackState) -> float | None:
    """Return how long the planned manoeuvre still takes, s; None where none is flown."""
    planner, measured = state.planner, state.measured
    if planner is None or measured is None or planner.state is not PlannerState.EXECUTING:
        return None
    if "planner" in state.absent:
        return None
    return max(0.0, planner.ends_at_s - measured.time_s) if planner.ends_at_s else None


def share_flown(state: StackState) -> float:
    """Return how much of the planned manoeuvre is flown, 0 to 1; 0 where none is."""
    left, planner = time_to_go(state), state.planner
    if left is None or planner is None or planner.manoeuvre_time_s <= 0.0:
        return 0.0
    return min(1.0, max(0.0, 1.0 - left / planner.manoeuvre_time_s))


def head(state: StackState, *, described: bool = True) -> str:
    """Return the state of the stack as HTML; ``described``: whether a robot is known."""
    lines = []
    quiet = silence(state)
    if quiet:
        lines.append(_line(quiet, 2))
    elif not described:
        lines.append(_line("No robot is shown: nothing valid has come on robot_description.", 2))
    for name, seconds in sorted(state.silent.items()):
        lines.append(_line(f"Node '{name}' is silent for {math.floor(seconds)} s.", 2))
    lines.extend(_line(f"Node '{name}' is not active.", 1) for name in sorted(state.inactive))
    if state.measured is not None:
        left = time_to_go(state)
        text = f"t = {state.measured.time_s:.2f} s"
        lines.append(_line(text if left is None else f"{text}, {left:.1f} s to go", None))
    if state.replay is not None:
        replay = state.replay
        word = "ended" if replay.ended else "paused" if replay.paused else "playing"
        text = f"Replay {word}: {replay.position_s:.2f} s of {replay.duration_s:.2f} s"
        lines.append(_line(text, 0))
    if state.plant is not None:
        plant = state.plant
        text = _status("Plant", plant.state.value, plant.message, plant.level)
        lines.append(_faint(text, faint="plant" in state.absent))
        lines.extend(_line(f"Fault: {each}", 1) for each in state.plant.faults)
    if state.planner is not None:
        status = state.planner
        text = _status("Planner", status.state.value, status.message, status.state.level)
        lines.append(_faint(text, faint="planner" in state.absent))
    if state.controller is not None:
        control = state.controller
        text = _status("Controller", control.state.value, control.message, control.state.level)
        lines.append(_faint(text, faint="controller" in state.absent))
    return padded("".join(lines))


def padded(html: str) -> str:
    """Return HTML with the margins and the size of the other elements of the page."""
    return f'<div style="padding:2px 12px;font-size:.85em;line-height:1.35">{html}</div>'


def _status(name: str, word: str, sentence: str, level: int) -> str:
    return (
        f'<div style="margin:2px 0"><b>{escape(name)}</b> '
        f'<span style="color:{_LEVELS[level]};font-weight:600">{escape(word)}</span> '
        f"{escape(sentence)}</div>"
    )


def _faint(html: str, *, faint: bool) -> str:
    """Return HTML so that what is no longer so is hardly seen."""
    return f'<div style="opacity:.45">{html}</div>' if faint else html


def _line(text: str, level: int | None) -> str:
    style = "" if level is None else f"color:{_LEVELS[level]};font-weight:600;"
    return f'<div style="{style}margin:2px 0">{escape(text)}</div>'


def verdict(check: Check) -> str:
    """Return what is known of the goal that is shown, as HTML."""
    words = {
        Verdict.UNCHECKED: "not checked",
        Verdict.PLANNING: "planning",
        Verdict.REACHABLE: "reachable",
        Verdict.REFUSED: "refused",
    }
    red, green, blue = COLORS[check.verdict]
    dot = (
        f'<span style="display:inline-block;width:.8em;height:.8em;border-radius:50%;'
        f'background:rgb({red},{green},{blue});margin-right:.4em"></span>'
    )
    text = f"{dot}<b>Goal {words[check.verdict]}</b>"
    return padded(f"{text} {escape(check.sentence)}")


# -- tables -------------------------------------------------------------------------------------


def joints(robot: RobotDescription, q: Array, qdot: Array, effort: Array) -> str:
    """Return the joints beside their limits as an HTML table with a bar each."""
    rows = []
    lower, upper = robot.limits("lower"), robot.limits("upper")
    fastest, strongest = robot.limits("velocity"), robot.limits("effort")
    for i, joint in enumerate(robot.movable_joints):
        share = _share(q[i], lower[i], upper[i])
        level = 0
        if share is not None and not _NEAR_LIMIT <= share <= 1 - _NEAR_LIMIT:
            level = 2 if not 0.0 <= share <= 1.0 else 1
        bar = "no limits" if share is None else _bar(share, level)
        name = f'<span title="{escape(joint.name)}">{escape(shortened(joint.name))}</span>'
        cells = [name, f"{_fixed(q[i], 3)} {joint.unit}", bar]
        cells += [_of(qdot[i], fastest[i]), _of(effort[i], strongest[i])]
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    titles = ("joint", "at", "in range", "rate", "effort")
    heads = "".join(f"<th>{title}</th>" for title in titles)
    if not rows:
        return padded("The robot has no joints.")
    style = "border-spacing:4px 2px;text-align:left;white-space:nowrap;font-size:.9em"
    table = f'<table style="{style}"><tr>{heads}</tr>{"".join(rows)}</table>'
    return padded(f'<div style="overflow-x:auto">{table}</div>')


def shortened(name: str) -> str:
    """Return a name as long as there is room for: a longer one loses its middle."""
    half = (_LONGEST_NAME - 1) // 2
    return name if len(name) <= _LONGEST_NAME else f"{name[:half]}…{name[-half:]}"


def _share(value: float, lower: float, upper: float) -> float | None:
    """Return where a value is between its limits, 0 to 1; None where one is infinite."""
    if not (math.isfinite(lower) and math.isfinite(upper)) or upper <= lower:
        return None
    return float((value - lower) / (upper - lower))


def _bar(share: float, level: int) -> str:
    place = 100 * min(1.0, max(0.0, share))
    color = _LEVELS[level]
    return (
        f'<div style="width:44px;height:8px;background:{_QUIET}55;border-radius:4px;'
        f'position:relative"><div style="position:absolute;left:{place:.0f}%;top:-2px;width:4px;'
        f'height:12px;margin-left:-2px;background:{color};border-radius:2px"></div></div>'
    )


def _of(value: float, limit: float) -> str:
    number = _fixed(value, 2)
    return number if not math.isfinite(limit) else f"{number} of {limit:.3g}"


def _fixed(value: float, digits: int) -> str:
    """Return a number with so many digits behind the point; what rounds to zero has no sign."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def log(notices: Iterable[Notice]) -> str:
    """Return the newest lines first as HTML."""
    rows = []
    for notice in notices:
        time = "" if notice.time_s is None else f"{notice.time_s:.2f} s"
        color = _LEVELS[notice.level] if notice.level else "inherit"
        rows.append(
            f'<div style="margin:2px 0"><span style="color:{_QUIET}">{time} '
            f'{escape(notice.source)}</span> <span style="color:{color}">'
            f"{escape(notice.sentence)}</span></div>"
        )
    return padded("".join(rows) or "Nothing has happened yet.")


# -- errors, momenta ----------------------------------------------------------------------------


def base_error(state: StackState) -> tuple[float, float] | None:
    """Return how far the base is from its goal, m and rad; None where there is no goal."""
    goal, measured = state.goals.get("base"), state.measured
    if goal is None or measured is None:
        return None
    error = PoseError.between(measured.pose[:3], measured.pose[3:], goal)
    return error.distance, error.angle


def tool_error(state: StackState) -> tuple[float, float] | None:
    """Return how far the end-effector is from its goal, m and rad; None where there is no goal."""
    goal, pose = state.goals.get("end_effector"), state.tool
    if goal is None or pose is None:
        return None
    error = PoseError.between(pose[:3], pose[3:], goal)
    return error.distance, error.angle


def momentum_drift(momenta: Momenta, first: Array) -> tuple[float, float]:
    """Return how far both momenta are from what they should be, kg m/s and kg m^2/s.

    ``first`` (6,) are those of the beginning, where none are expected of thrusters.
    """
    wanted = first if momenta.expected is None else momenta.expected
    difference = momenta.actual - wanted
    return float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))


def is_flying(state: StackState) -> bool:
    """Whether a commander pursues a goal."""
    planner, controller = state.planner, state.controller
    return (
        planner is not None and planner.state in (PlannerState.PLANNING, PlannerState.EXECUTING)
    ) or (controller is not None and controller.state is ControllerState.TRACKING)


def has_tool(state: StackState) -> bool:
    """Whether goals can be sent for the end-effector: a controller is there, and it is known."""
    return state.controller is not None and state.tool is not None


# -- faults -------------------------------------------------------------------------------------


def fault_kinds(targets: Targets) -> dict[str, list[str]]:
    """Return the kinds of faults that have something to hit, with what that is."""
    found = {name: targets.of(kind) for name, kind in KINDS.items()}
    return {name: names for name, names in found.items() if names}


def fault_line(
    kind: str, target: str, value: float, lasts_s: float, now_s: float, targets: Targets
) -> str:
    """Return the line of a fault that begins now and ends after ``lasts_s``; 0: never.

    Raises
    ------
    ParameterError
        There is no such fault, or a number is none; the sentence says why.
    """
    if not (math.isfinite(lasts_s) and lasts_s >= 0.0):
        raise ParameterError(f"The fault cannot last {lasts_s:g} s.")
    words = [kind, target]
    if kind in KINDS and KINDS[kind].value:
        words.append(f"{value:.9g}")
    if lasts_s:
        words += ["until", f"{now_s + lasts_s:.9g}"]
    line = " ".join(words)
    parse_fault(line, targets, now_s)
    return line


def faults(lines: Sequence[str]) -> str:
    """Return the active faults as HTML."""
    if not lines:
        return quiet("No fault is active.")
    return padded("".join(_line(line, 1) for line in lines))


def quiet(text: str) -> str:
    """Return a text that explains something, as HTML."""
    return padded(f'<span style="color:{_QUIET}">{escape(text)}</span>')


# -- over time ----------------------------------------------------------------------------------


class History:
    """Numbers over the last minutes of simulated time, a row for every look.

    Parameters
    ----------
    width
        Numbers in a row.
    span_s
        How far back, s of simulated time.
    most
        Rows that are kept: older ones are thinned out.
    """

    def __init__(self, width: int, span_s: float = 300.0, most: int = 600) -> None:
        self._span, self._most = span_s, most
        self._rows: deque[Array] = deque()
        self._width = width

    def add(self, time_s: float, values: Sequence[float] | Array) -> None:
        """Add a row; of a time that is not later than the last, everything since is forgotten."""
        while self._rows and self._rows[-1][0] >= time_s:
            self._rows.pop()
        self._rows.append(np.concatenate([[time_s], np.asarray(values, float)]))
        while self._rows[0][0] < time_s - self._span:
            self._rows.popleft()
        if len(self._rows) > self._most:
            # Every other one, but for the last.
            kept = list(self._rows)
            self._rows = deque([*kept[:-1:2], kept[-1]])

    def columns(self) -> tuple[Array, ...]:
        """Return time (k,) and each number (k,); at least one row, of zeros."""
        if not self._rows:
            # A figure has no scale for numbers that are none.
            return tuple(np.zeros(1) for _ in range(self._width + 1))
        table = np.array(self._rows)
        return tuple(np.ascontiguousarray(column) for column in table.T)


class Trail:
    """Where the base has been: points that are a step apart.

    Parameters
    ----------
    step
        m.
    most
        Points that are kept; beyond that every other one is dropped, and steps are twice as long.
    """

    def __init__(self, step: float, most: int = 1500) -> None:
        self._step, self._most = step, most
        self._points: list[Array] = []
        self._times: list[float] = []

    def add(self, time_s: float, point: Array) -> None:
        """Add a point; time that runs back erases what came later."""
        while self._times and self._times[-1] >= time_s:
            self._times.pop()
            self._points.pop()
        if self._points and float(np.linalg.norm(point - self._points[-1])) < self._step:
            return
        self._points.append(np.array(point, float))
        self._times.append(time_s)
        if len(self._points) > self._most:
            self._points, self._times = self._points[::2], self._times[::2]
            self._step *= 2

    @property
    def points(self) -> Array:
        """The points (k, 3), m."""
        return np.array(self._points).reshape(-1, 3)
