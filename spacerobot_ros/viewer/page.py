"""The page: the scene and its panels, redrawn from the state of the stack.

One thread, which calls :meth:`Page.update`, draws everything. Browser input arrives in server
threads and is queued for the next update.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.control.wheels import BUDGET_PARTS
from spacerobot_ros.errors import GoalError, ParameterError, SpaceRobotError, shortened
from spacerobot_ros.measures import momentum_change
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.thrusters import IN_URDF, ThrusterTable, find_thrusters
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.simulation.faults import FAULT_KINDS, FaultTargets
from spacerobot_ros.topics import Request
from spacerobot_ros.viewer import content, scene
from spacerobot_ros.viewer.content import RecentItems
from spacerobot_ros.viewer.goal_editor import Defer, GoalEditor, react, react_to_client
from spacerobot_ros.viewer.server import ViewerConfig
from spacerobot_ros.viewer.state import (
    Action,
    FlyAction,
    InjectAction,
    Measured,
    Notice,
    Part,
    SeekAction,
    StackState,
    goals_from_text,
)

if TYPE_CHECKING:
    import viser


RequestAction = Callable[[Action], None]
"""Function that receives a user action."""

_MAX_SHOWN_NOTICES = 60

_CURVE_COLORS = (
    "#3c82f0",
    "#f0961a",
    "#2a9d5c",
    "#c04fb5",
    "#d23c3c",
    "#17a2b8",
    "#9a7d0a",
    "#8a8f98",
)
_AXIS_COLOR = "#8a8f98"
_PLOT_PIXELS = 170

_LOOK_BACK_STEP_S = 0.1  # simulated s
_MIN_LOOK_BACK_S = 1.0  # simulated s

_SLIDER_HOLD_S = 1.5
"""Wall time, s, during which the page does not move the time slider after a user has moved it."""


class ButtonPanel:
    """Buttons for requests that the stack carries out immediately."""

    def __init__(
        self,
        gui: viser.GuiApi,
        defer: Defer,
        act: RequestAction,
        fly: Callable[[], None],
        scenario_goals: Mapping[Part, Goal],
    ) -> None:
        self._fly = gui.add_button("Fly", color="green", hint="Send the shown goal.")
        self._has_scenario_goals = bool(scenario_goals)
        self._fly_scenario = gui.add_button(
            "Fly the scenario's goal", color="teal", visible=self._has_scenario_goals
        )
        hint = "Abandon the goal; the joints brake, and the stack continues."
        self._goal = gui.add_button_group("Goal", ("Abort goal",), hint=hint)
        self._plant = gui.add_button_group(
            "Plant",
            ("Stop all", "Rearm", "Reset"),
            hint="Stop all: joints brake, and thrusters are off until Rearm. "
            "Reset: return to the initial state.",
        )
        self._time = gui.add_button_group("Time", ("Pause", "Resume"))
        react(self._fly.on_click, defer, lambda _: fly())
        react(self._fly_scenario.on_click, defer, lambda _: act(FlyAction(scenario_goals)))
        for group in (self._goal, self._plant, self._time):
            react(group.on_click, defer, lambda label: act(Request(label.split()[0].lower())))

    def show(self, *, visible: bool) -> None:
        """Show or hide the buttons."""
        for handle in (self._fly, self._goal, self._plant, self._time):
            handle.visible = visible
        self._fly_scenario.visible = visible and self._has_scenario_goals


class TimeLine:
    """Replay controls: play, hold, and a time slider."""

    def __init__(self, gui: viser.GuiApi, defer: Defer, act: RequestAction) -> None:
        self._act = act
        self._folder = gui.add_folder("Replay", visible=False)
        with self._folder:
            buttons = gui.add_button_group("Replay", ("Play", "Hold"))
            self._slider: Any = gui.add_slider("Time (s)", 0.0, 1.0, 1e-3, 0.0)
        self._duration = 0.0
        self._left_alone_until = -math.inf
        react(buttons.on_click, defer, lambda label: act(Request(label.lower())))
        react(self._slider.on_update, defer, self._seek)

    def show(self, state: StackState, now: float) -> None:
        """Show the replay position, if there is a replay."""
        replay = state.replay
        self._folder.visible = replay is not None
        if replay is None:
            return
        if replay.duration_s != self._duration:
            self._duration = replay.duration_s
            step = max(10.0 ** math.floor(math.log10(max(self._duration, 1e-3) / 1000)), 1e-3)
            self._slider.step = step
            self._slider.max = max(math.ceil(self._duration / step) * step, step)
        if now >= self._left_alone_until:
            self._slider.value = min(max(replay.position_s, 0.0), self._slider.max)

    def _seek(self, seconds: float) -> None:
        self._left_alone_until = time.monotonic() + _SLIDER_HOLD_S
        self._act(SeekAction(float(seconds)))


class LookBack:
    """Slider for looking back over a flight, and a button to return to the current state."""

    def __init__(self, gui: viser.GuiApi, defer: Defer) -> None:
        self.time_s: float | None = None
        """Simulated time shown to the user, s; None: the present."""
        self._left_alone_until: float | None = None
        hint = "Show an earlier state from the last five minutes; the robot keeps flying."
        step = _LOOK_BACK_STEP_S
        self._slider: Any = gui.add_slider(
            "Look back to (s)", 0.0, step, step, 0.0, visible=False, hint=hint
        )
        self._live = gui.add_button("Back to the present", color="orange", visible=False)
        react(self._live.on_click, defer, lambda _: self._look(None, 0.0))

        @self._slider.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                at, end = float(event.target.value), float(event.target.max)
                # Set immediately, so that the value is not overwritten in the meantime.
                self._left_alone_until = until = time.monotonic() + _SLIDER_HOLD_S
                defer(lambda: self._look(None if at >= end else at, until))

    def _look(self, time_s: float | None, left_alone_until: float) -> None:
        self.time_s, self._left_alone_until = time_s, left_alone_until

    def show(self, span: tuple[float, float] | None) -> None:
        """Show the slider for a span of simulated time, s; None: no past states."""
        if span is None or span[1] - span[0] < _MIN_LOOK_BACK_S:
            self.time_s = None
            self._slider.visible = self._live.visible = False
            return
        # Whole steps within the span.
        low, high = (
            round(whole(end / _LOOK_BACK_STEP_S) * _LOOK_BACK_STEP_S, 6)
            for whole, end in ((math.ceil, span[0]), (math.floor, span[1]))
        )
        if self.time_s is not None:
            self.time_s = min(max(self.time_s, low), high)
        at = high if self.time_s is None else self.time_s
        self._slider.max, self._slider.min = high, low
        if self._left_alone_until is None:
            self._slider.value = at
        elif time.monotonic() >= self._left_alone_until:
            # The browser may have received an older value after sending its own, and viser does not
            # send a value that it already has.
            self._left_alone_until = None
            self._slider.value = low if at == high else high
            self._slider.value = at
        self._slider.visible, self._live.visible = True, self.time_s is not None


class FaultPanel:
    """Menu of faults that can be injected, and list of active faults."""

    def __init__(
        self, gui: viser.GuiApi, defer: Defer, act: RequestAction, on_note: Callable[[str], None]
    ) -> None:
        self._act, self._on_note = act, on_note
        self._targets, self._now_s = FaultTargets(), 0.0
        self._names: dict[str, list[str]] = {}
        self._kind: Any = gui.add_dropdown("Fault", ("-",))
        self._target: Any = gui.add_dropdown("Target", ("-",))
        self._value = gui.add_number("Value", 0.0, step=0.01)
        self._value.visible = False
        self._meaning = gui.add_html("")
        self._lasts = gui.add_number("For (s), 0: permanently", 0.0, min=0.0, step=1.0)
        self._inject = gui.add_button("Inject", color="orange")
        self._clear = gui.add_button("Clear faults", color="gray")
        self._active = gui.add_html("")
        react(self._kind.on_update, defer, lambda _: self._show_kind())
        react(self._inject.on_click, defer, lambda _: self._on_inject())
        react(self._clear.on_click, defer, lambda _: act(InjectAction("clear")))

    def offer(self, targets: FaultTargets) -> None:
        """Offer the faults that are possible for the targets in a plant."""
        if targets == self._targets:
            return
        self._targets = targets
        names = {kind: targets.of(about) for kind, about in FAULT_KINDS.items()}
        self._names = {kind: each for kind, each in names.items() if each}
        before = self._kind.value
        self._kind.options = tuple(self._names) or ("-",)
        if before in self._names:
            self._kind.value = before
        self._show_kind()

    def show_menu(self, *, visible: bool) -> None:
        """Show or hide the menu; a replay shows only active faults."""
        for handle in (self._kind, self._target, self._lasts, self._inject, self._clear):
            handle.visible = visible
        self._meaning.visible = visible
        self._value.visible = visible and self._has_value

    def show(self, state: StackState) -> None:
        """Show the active faults."""
        if state.measured is not None:
            self._now_s = state.measured.time_s
        faults = () if state.plant is None else state.plant.faults
        self._active.content = content.faults_html(faults)

    def _show_kind(self) -> None:
        names = self._names.get(self._kind.value, ["-"])
        before = self._target.value
        self._target.options = tuple(names)
        if before in names:
            self._target.value = before
        kind = FAULT_KINDS.get(self._kind.value)
        self._value.visible = self._has_value and self._kind.visible
        self._meaning.content = "" if kind is None else content.hint_html(kind.value)

    @property
    def _has_value(self) -> bool:
        kind = FAULT_KINDS.get(self._kind.value)
        return kind is not None and bool(kind.value)

    def _on_inject(self) -> None:
        try:
            numbers = float(self._value.value), float(self._lasts.value), self._now_s
            line = content.fault_line(self._kind.value, self._target.value, *numbers, self._targets)
        except ParameterError as error:
            self._on_note(str(error))
            return
        self._act(InjectAction(line))


class Plots:
    """Plots of goal errors, momentum drift and joint positions over simulated time."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        tabs = gui.add_tab_group()
        self._error_tab = tabs.add_tab("Errors")
        with self._error_tab:
            self._logarithmic: Any = gui.add_checkbox("Logarithmic", initial_value=False)
            self._no_errors: Any = gui.add_html(content.hint_html("No goal is pursued."))
        self._errors: dict[tuple[Part, int], _Plot] = {}
        with tabs.add_tab("Momentum"):
            # In millionths, because axis labels have three decimals.
            units = ("1e-6 kg m/s", "1e-6 kg m²/s")
            self._momentum = _Plot(gui, "Momentum drift", units, 1.0, units)
            self._budget_text = gui.add_html("")
            self._budget = _Plot(gui, "Momentum budget (N m s)", BUDGET_PARTS, 0.01)
            self._budget.handle.visible = False
        self._joint_tab = tabs.add_tab("Shape")
        self._shape: _Plot | None = None
        self._first: Array | None = None

    def show_robot(self, robot: RobotDescription | None) -> None:
        """Start again with another robot."""
        self._first = None
        for plot in (self._momentum, self._budget):
            plot.clear()
        self._budget.handle.visible = False
        self._show_parts({})
        if self._shape is not None:
            self._shape.handle.remove()
            self._shape = None
        if robot is not None and robot.joint_names:
            names, units = robot.joint_names, tuple(each.unit for each in robot.movable_joints)
            with self._joint_tab:
                self._shape = _Plot(self._gui, "Joints", names, 0.01, units, signed=True)

    def add(self, state: StackState, errors: Mapping[Part, content.GoalErrors]) -> None:
        """Append the last state and its goal errors to the curves."""
        measured = state.measured
        if measured is None:
            return
        time_s = measured.time_s
        self._show_parts(errors)
        for part, error in errors.items():
            self._errors[part, len(error)].add(time_s, 1e3 * np.array(error))
        if state.momenta is not None:
            if self._first is None:
                self._first = state.momenta.actual
            expected = state.momenta.expected
            reference = self._first if expected is None else expected
            self._momentum.add(time_s, 1e6 * momentum_change(state.momenta.actual, reference))
        budget = content.momentum_budget(state)
        if budget:
            self._budget.handle.visible = True
            self._budget.add(time_s, list(budget.values()))
        if self._shape is not None:
            self._shape.add(time_s, measured.q)

    def show_budget(self, state: StackState) -> None:
        """Show the current momentum budget of a robot with wheels."""
        self._budget_text.content = content.momentum_html(state)

    def _show_parts(self, errors: Mapping[Part, content.GoalErrors]) -> None:
        """Show one plot for each part with an error, and none for others.

        Hidden plots are reused, because browsers report errors about curves of removed plots.
        """
        shown = [(part, len(error)) for part, error in errors.items()]
        for part, count in shown:
            if (part, count) not in self._errors:
                title, units = f"Error of {shortened(part)}", ("mm", "mrad")[:count]
                with self._error_tab:
                    plot = _Plot(self._gui, title, units, 10.0, units, limited=True)
                self._errors[part, count] = plot
        for key, plot in self._errors.items():
            if plot.handle.visible and key not in shown:
                plot.clear()
            plot.handle.visible = key in shown
        self._no_errors.visible = not errors

    def draw(self, tolerance: Tolerance | None = None, time_s: float | None = None) -> None:
        """Redraw the curves, with error tolerances and a line at the displayed time."""
        limits = () if tolerance is None else (tolerance.position, tolerance.attitude)
        for plot in [each for each in self._errors.values() if each.handle.visible]:
            plot.set_logarithmic(enabled=bool(self._logarithmic.value))
            plot.draw(time_s, [1e3 * limit for limit in limits])
        for each in (self._momentum, self._budget, self._shape):
            if each is not None:
                each.draw(time_s)


_LEAST_ON_LOGARITHMIC_AXIS = 1e-3


class _Plot:
    """A plot and its history; its colours can be seen on white and on black.

    There is an axis for each of at most two ``units``, those of ``names``. ``least`` is the
    smallest upper limit of the axes, so that rounding errors do not look like peaks; ``signed``:
    the numbers may be negative; ``limited``: each has a limit.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        title: str,
        names: tuple[str, ...],
        least: float,
        units: tuple[str, ...] = (),
        *,
        signed: bool = False,
        limited: bool = False,
    ) -> None:
        self._limited = limited
        self.names = names
        self.clear()
        scales = units or ("y",) * len(names)
        series: list[Any] = [{"label": "t (s)"}]
        for i, name in enumerate(names):
            turn, color = divmod(i, len(_CURVE_COLORS))
            look = {"label": shortened(name), "stroke": _CURVE_COLORS[color], "width": 1.5}
            # Colours are reused with dashes that become shorter each time.
            dashes = {"dash": (max(12 // turn, 2), 4)} if turn else {}
            series.append(look | dashes | {"scale": scales[i]})
        limit = {"label": "tolerance", "dash": (2, 4), "width": 1}
        series += [each | limit for each in series[1:] if limited]
        line: Any = {"label": "shown", "stroke": _AXIS_COLOR, "width": 2, "scale": "line"}
        faint = {"stroke": f"{_AXIS_COLOR}33"}
        axis: dict[str, Any] = {"stroke": _AXIS_COLOR, "grid": faint, "ticks": faint}
        axes = [
            axis | {"scale": scale, "size": 50, "side": side, "label": scale * bool(units)}
            | {"labelSize": 16 * bool(units)}
            for scale, side in zip(dict.fromkeys(scales), (3, 1), strict=False)  # Left, right.
        ]  # fmt: skip
        # Mode 1 of uPlot's "soft limits": the axis ends there unless numbers exceed it.
        end = {"pad": 0.1, "mode": 1}
        ends = {"min": end | {"soft": -least if signed else 0.0}, "max": end | {"soft": least}}
        time: dict[str, Any] = {"x": {"time": False}, "line": {"auto": False, "range": (0, 1)}}
        self._linear = time | {scale: {"range": ends} for scale in scales}
        self._logarithmic = time | {scale: {"distr": 3} for scale in scales}
        self._least = -np.inf
        self.handle: Any = gui.add_uplot(
            self._data(None, ()),
            (*series, line),
            title=title,
            scales=self._linear,
            axes=(axis | {"size": 34}, *axes),  # type: ignore[arg-type]
            height=_PLOT_PIXELS,
            padding=(14, 0, 0, 0),
        )

    def set_logarithmic(self, *, enabled: bool) -> None:
        """Use logarithmic or linear axes."""
        self._least = _LEAST_ON_LOGARITHMIC_AXIS if enabled else -np.inf
        if (scales := self._logarithmic if enabled else self._linear) != self.handle.scales:
            self.handle.scales = scales

    def clear(self) -> None:
        self._rows: RecentItems[Array] = RecentItems(most=600)

    def add(self, time_s: float, values: Sequence[float] | Array) -> None:
        self._rows.add(time_s, np.append(time_s, values))

    def draw(self, time_s: float | None, limits: Sequence[float] = ()) -> None:
        self.handle.data = self._data(time_s, limits)

    def _data(self, time_s: float | None, limits: Sequence[float]) -> tuple[Array, ...]:
        """Return times, curves, their limits, and a vertical line at a time, s."""
        # A plot without numbers has no scale.
        rows = np.array(self._rows.items or [np.zeros(1 + len(self.names))])
        rows[:, 1:] = np.maximum(rows[:, 1:], self._least)
        line = np.full(len(rows), -1.0)  # Below the axis.
        if time_s is not None:
            at = int(np.searchsorted(rows[:, 0], time_s, "right"))
            row = np.append(time_s, rows[max(at - 1, 0), 1:])
            rows = np.insert(rows, [at] * 3, row, axis=0)
            line = np.insert(line, [at] * 3, (-1.0, 1.0, -1.0))
        curves = np.ascontiguousarray(rows.T)
        lines = [np.full(len(rows), limit) for limit in limits[: len(self.names)]]
        # An unknown limit is hidden behind its curve.
        known = (lines or [*curves[1:]]) if self._limited else []
        return *curves, *known, line


_REPEATED_NOTICES, _REPEATED_NOTICE_S = 6, 1.0
"""A line is a repetition if one of so many before it, at most this simulated time earlier, s, has
the same text and node."""


def _repeats(notice: Notice, earlier: Notice) -> bool:
    (name, now), (earlier_name, then) = (
        (each.source.replace(".", "/").strip("/"), each.time_s or 0.0) for each in (notice, earlier)
    )
    same = (notice.message, name) == (earlier.message, earlier_name)
    return same and abs(now - then) < _REPEATED_NOTICE_S


_ROBOT_PATH = "/robot"
_OBSTACLES_PATH, _TARGET_PATH = "/obstacles", "/target"

_TEXTS_S, _TABLES_S, _PLOTS_S, _PATHS_S = 0.2, 0.25, 0.5, 0.5
"""Drawing periods of the slower components, s of wall time."""

_ANSWER_TIME_S = 10.0
"""Wall time, s, for which the response to a user action is shown at the top."""

CAMERA = np.array([1.1, 1.4, 0.8])
"""Initial camera position relative to the robot, in robot lengths.

This position places an arm in front of the base on the left, because the panel is on the right.
"""


_PRESETS = {
    "Front": np.array([1.9, 0.0, 0.3]),
    "Side": np.array([0.0, 1.9, 0.3]),
    "Top": np.array([0.0, 0.01, 1.9]),
}
"""Camera positions relative to the robot by button name, in robot lengths."""

_THEME: Any = {"control_width": "large", "show_logo": False, "show_share_button": False}

_LAYERS = (
    ("Paths", True, "Planned base path, and flown paths of the base and end-effectors."),
    ("Frames", False, "Axes of the world and of all links."),
    ("Ghost", True, "The robot at the goal."),
    ("Plumes", True, "Thrusters that are on."),
    ("Collision shapes", False, "The geometry used to measure distances between links."),
    ("Names", False, "Names of the links."),
)
"""Scene layers: name, initial visibility, and explanation."""


_PORTRAIT, _PORTRAIT_DISTANCE, _PORTRAIT_SHIFT, _PANEL_SHIFT = 0.8, 1.75, 0.36, 0.32
"""Aspect ratio (width to height) below which a window is treated as a phone window; ratio of phone
to desktop camera distance; and view offsets below the robot (phone) and to its right (desktop), as
fractions of the distance.
"""


def view_beside_panel(at: Array, away: Array, aspect: float) -> tuple[Array, Array]:
    """Return a camera position and target (3,), m, for which the panel does not cover the robot:
    it is at the bottom on a phone, and on the right on a desktop.

    Parameters
    ----------
    at, away
        Robot position (3,), and camera position relative to it on a desktop, m.
    aspect
        Window aspect ratio (width to height).
    """
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    up = np.cross(away, right) / np.linalg.norm(away)
    aside = _PANEL_SHIFT * right
    if aspect < _PORTRAIT:
        away, aside = _PORTRAIT_DISTANCE * away, -_PORTRAIT_SHIFT * up
    look_at = at + float(np.linalg.norm(away)) * aside
    return look_at + away, look_at


class Page:
    """The page, which shows the same content in all browsers.

    Parameters
    ----------
    server
        Server of the page.
    config
        Its parameters.

    Attributes
    ----------
    editor, faults
        The goal editor and the fault menu.
    tolerance
        The planner's or controller's goal tolerance; None: unknown.
    """

    def __init__(self, server: viser.ViserServer, config: ViewerConfig) -> None:
        self._server, self._config = server, config
        self._inbox: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._actions: list[Action] = []
        self._target: RobotDescription | None = None
        self._obstacles: tuple[RobotDescription | None] | None = None
        """The obstacles shown last; None if the obstacles of the robot are shown."""
        self.tolerance: Tolerance | None = None
        self._state = StackState()
        self._due: dict[str, float] = {}
        self._now = 0.0
        self._looked_back = False
        self._notices: deque[Notice] = deque(maxlen=_MAX_SHOWN_NOTICES)
        """Events and warnings, newest first."""
        self._announced: tuple[Notice, float] | None = None
        """The line at the top, and the wall time, s, until which it is shown."""
        self._build()
        self.show_robot(None)

    def _build(self) -> None:
        gui, defer = self._server.gui, self._inbox.put
        gui.configure_theme(dark_mode=self._config.dark, **_THEME)
        # Buttons come first, so that a growing status text does not move them under the mouse.
        self._time_line = TimeLine(gui, defer, self._request)
        goals = goals_from_text(self._config.scenario_goals)
        self._buttons = ButtonPanel(gui, defer, self._request, self._fly, goals)
        self._look_back = LookBack(gui, defer)
        self._status = gui.add_html(content.status_html(StackState()))
        self._bar: Any = gui.add_progress_bar(0.0, visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Goal"):
            self.editor = GoalEditor(self._server, defer, self._refuse, self._goal_to_robot)
        with tabs.add_tab("Plots"):
            self._plots = Plots(gui)
        with tabs.add_tab("Joints"):
            self._joints = gui.add_html("")
        with tabs.add_tab("Faults"):
            self.faults = FaultPanel(gui, defer, self._request, self._refuse)
        with tabs.add_tab("Log"):
            self._log = gui.add_html(content.log_html(()))
        look = gui.add_button(
            "Look at the robot", color="gray", hint="Point the camera of this browser at the robot."
        )
        react_to_client(look.on_click, defer, lambda client, _: self._aim_camera(client.camera))
        presets = gui.add_button_group(
            "View from", tuple(_PRESETS), hint="Rotate this browser's camera."
        )
        aim = self._aim_camera
        react_to_client(presets.on_click, defer, lambda c, name: aim(c.camera, _PRESETS[name]))
        self._follow: Any = gui.add_checkbox(
            "Follow the robot", initial_value=False, hint="All cameras move with the base."
        )
        self._setting: Any = gui.add_dropdown("Setting", scene.BACKDROPS)
        with gui.add_folder("Layers", expand_by_default=False):
            self._layers: dict[str, Any] = {
                name: gui.add_checkbox(name, initial_value=shown, hint=hint)
                for name, shown, hint in _LAYERS
            }
        for handle in (self._setting, *self._layers.values()):
            react(handle.on_update, defer, lambda _: self._show_layers())

        @self._server.on_client_connect
        async def _(client: Any) -> None:
            defer(lambda: self._aim_camera(client.camera))

            # A browser may move to the initial camera after that.
            @client.camera.on_update
            async def _(camera: Any) -> None:
                if np.allclose(camera.position, self._server.initial_camera.position):
                    defer(lambda: self._aim_camera(camera))

        style = gui.add_button("Dark or light", color="gray")
        themes: dict[int, bool] = {}

        def switch_theme(client: Any, _: Any) -> None:
            dark = themes[client.client_id] = not themes.get(client.client_id, self._config.dark)
            client.gui.configure_theme(dark_mode=dark, **_THEME)

        react_to_client(style.on_click, defer, switch_theme)

    # -- the robot and its goal -----------------------------------------------------------------

    def show_robot(self, robot: RobotDescription | None) -> None:
        """Start again with another robot; None: there is none."""
        self._robot = robot
        self._table: ThrusterTable | None = None
        self._thrusters_in_urdf: ThrusterTable | None = None
        self._drawing: scene.RobotDrawing | None = None
        self._target_drawing: scene.RobotDrawing | None = None
        self._drawn_obstacles: list[viser.MeshHandle] = []
        self._drawn: Measured | None = None
        self._last: Measured | None = None
        """The last received state, from which users can look back."""
        self._past: RecentItems[StackState] = RecentItems()
        self._look_back.time_s = None
        self._kinematics = None if robot is None else ForwardKinematics(robot)
        self._around: scene.Surroundings | None = None
        self._server.scene.reset()
        reach = 1.0 if robot is None else scene.reach_of(robot)
        self._reach = reach
        self._flown: dict[Part, RecentItems[Array]] = {}
        """Positions over the whole flight."""
        self.editor.show_robot(robot, reach)
        self._plots.show_robot(robot)
        if robot is None:
            return
        with suppress(SpaceRobotError):
            self._thrusters_in_urdf = find_thrusters(IN_URDF, robot)
        self._drawing = self._draw_body(_ROBOT_PATH, robot)
        self._draw_obstacles(robot.world if self._obstacles is None else self._obstacles[0])
        self._show_layers()
        if self._target is not None:
            self.show_target(self._target)

    def show_obstacles(self, world: RobotDescription | None) -> None:
        """Draw other obstacles instead of those of the robot; None: there are none."""
        self._obstacles = (world,)
        for each in self._drawn_obstacles:
            each.remove()
        self._drawn_obstacles = []
        if self._robot is not None:
            self._draw_obstacles(world)

    def _draw_obstacles(self, world: RobotDescription | None) -> None:
        self._drawn_obstacles = scene.draw_obstacles(self._server.scene, _OBSTACLES_PATH, world)

    def _draw_body(self, path: str, body: RobotDescription) -> scene.RobotDrawing:
        """Draw a body, which is hidden until its first state arrives."""
        drawn = scene.RobotDrawing(
            self._server.scene, path, body, on_note=lambda text: self.note(Notice(text, 1))
        )
        drawn.base.visible = False
        return drawn

    def show_target(self, target: RobotDescription) -> None:
        """Draw the second floating body, starting with its first state."""
        if self._target_drawing is not None:
            self._target_drawing.base.remove()
        self._target = target
        self._target_drawing = self._draw_body(_TARGET_PATH, target)

    def _show_layers(self) -> None:
        shown = {name: bool(handle.value) for name, handle in self._layers.items()}
        if self._drawing is not None:
            self._drawing.show_collision_shapes(visible=shown["Collision shapes"])
            self._drawing.show_frames(visible=shown["Frames"])
            self._drawing.show_names(visible=shown["Names"])
        self.editor.show_ghost(visible=shown["Ghost"])
        if self._around is not None:
            self._around.show_paths(visible=shown["Paths"])
            self._around.world_axes.visible = shown["Frames"]
            self._around.plume_lines.show(visible=shown["Plumes"])
            self._around.show_backdrop(str(self._setting.value))

    def end(self) -> None:
        """Report that the viewer has stopped, in browsers that still show the page."""
        text = "The viewer has ended. This page shows its last state and cannot steer the robot."
        self._status.content = content.line_html(text, 2)
        self._bar.visible = False
        self._server.flush()

    def show_thrusters(self, table: ThrusterTable | None) -> None:
        """Set the thrusters, which become known later than the robot; cameras follow a robot with
        thrusters, because it may fly out of sight.
        """
        if table is not None and self._table is None:
            self._follow.value = True
        self._table = table

    def note(self, notice: Notice) -> None:
        """Add a line to the log, unless it repeats one; without a time, it has the time of the last
        state."""
        measured = self._state.measured
        if notice.time_s is None and measured is not None:
            notice = replace(notice, time_s=measured.time_s)
        # Nodes also log what they publish.
        if not any(_repeats(notice, each) for each in islice(self._notices, _REPEATED_NOTICES)):
            self._notices.appendleft(notice)

    def announce(self, notice: Notice, seconds: float = _ANSWER_TIME_S) -> None:
        """Add a line to the log, and show it at the top of the page for a wall time in s."""
        self.note(notice)
        self._announced = (notice, self._now + seconds)

    # -- drawing --------------------------------------------------------------------------------

    def update(self, state: StackState, now: float) -> list[Action]:
        """Draw a state; return the user actions since the last call. ``now``: wall time, s."""
        before, self._state, self._now = self._state, state, now
        while not self._inbox.empty():
            self._inbox.get()()
        with self._server.atomic():
            replays = state.replay is not None
            if replays != (before.replay is not None):
                self._buttons.show(visible=not replays)
                self.editor.show(visible=not replays)
                self.faults.show_menu(visible=not replays)
            if self._drawing is not None and state.measured is not None:
                self._take(state, state.measured)
            # The current state, or the earlier one that a user looks back at.
            at = self._look_back.time_s
            shown = state if at is None or self._past.span is None else self._past.at(at)
            if self._drawing is not None and shown.measured is not None:
                self._draw_robot(shown, shown.measured)
            if self._target_drawing is not None and shown.target is not None:
                self._target_drawing.base.visible = True
                self._target_drawing.place(shown.target)
            self._time_line.show(state, now)
            if self._is_due("texts", _TEXTS_S):
                self._look_back.show(None if replays else self._past.span)
                self._draw_texts(shown)
            last = shown.measured
            if self._robot is not None and last is not None and self._is_due("tables", _TABLES_S):
                table = content.joints_html(self._robot, last.q, last.qdot, last.effort)
                self._joints.content = table
            if self._is_due("plots", _PLOTS_S):
                self._plots.draw(self.tolerance, self._look_back.time_s)
        actions, self._actions = self._actions, []
        return actions

    def _take(self, state: StackState, measured: Measured) -> None:
        """Add a new state to plots, paths and history, and inform the editor about goals."""
        if measured is self._last:
            return
        self._last = measured
        if self._around is None:
            center = measured.pose[:3]
            self._around = scene.Surroundings(self._server.scene, self._reach, _ROBOT_PATH, center)
            self._show_layers()
            self._aim_camera(self._server.initial_camera)
            # Browsers receive the initial camera at the end of this update, and move to it.
            self._inbox.put(self._aim_cameras)
        if state.replay is not None:
            if state.firing is not None and self._table is None:
                self.show_thrusters(self._thrusters_in_urdf)  # There is no plant to ask.
            aims = [aim.link for goal in state.goals.values() for aim in goal.end_effectors]
            self.editor.offer_end_effectors(aims)
        if not self.editor.placed and (state.replay is None or state.goals):
            self.editor.place(measured.pose, None, measured.q, self._now)
        self.editor.follow(state.goals, self._now)
        self.editor.update_robot(measured.pose, measured.q)
        self._plots.add(state, self._goal_errors(state))
        assert self._kinematics is not None
        hands = content.end_effector_positions(state, self._kinematics)
        for part, point in {BASE_GOAL_KEY: measured.pose[:3], **hands}.items():
            path = self._flown.setdefault(part, RecentItems(span_s=math.inf))
            path.add(measured.time_s, point)
        if state.replay is None:
            self._past.add(measured.time_s, state)

    def _draw_robot(self, state: StackState, measured: Measured) -> None:
        drawing, around = self._drawing, self._around
        assert drawing is not None
        assert around is not None
        if measured is self._drawn:
            return
        self._drawn = measured
        drawing.base.visible = True
        drawing.place(measured.pose)
        drawing.set_joint_positions(measured.q)
        # Returning to the present also changes the displayed time.
        looked_back, self._looked_back = self._looked_back, self._look_back.time_s is not None
        if looked_back or self._looked_back or self._is_due("paths", _PATHS_S):
            self._draw_paths(state, around, measured.time_s)
        if state.firing is not None and self._table is not None:
            firing, length = state.firing, 0.25 * self._reach
            lines = scene.plume_lines(self._table, firing.names, firing.duty, length)
            around.plume_lines.draw_segments(lines)

    def _draw_paths(self, state: StackState, around: scene.Surroundings, until: float) -> None:
        flown = {part: np.array(path.until(until)) for part, path in self._flown.items()}
        around.draw_paths("flown", {part: x.reshape(-1, 3) for part, x in flown.items()})
        assert self._robot is not None
        assert self._kinematics is not None
        paths = content.planned_positions(state, self._robot, self._kinematics)
        if state.planned_path is not None:
            paths[BASE_GOAL_KEY] = state.planned_path
        around.draw_paths("planned", paths)

    def _goal_errors(self, state: StackState) -> dict[Part, content.GoalErrors]:
        return {} if self._kinematics is None else content.goal_errors(state, self._kinematics)

    def _draw_texts(self, shown: StackState) -> None:
        state, errors = self._state, self._goal_errors(shown)
        described = self._robot is not None
        text = content.status_html(shown, errors, self.tolerance, described=described)
        announces = self._announced is not None and self._now < self._announced[1]
        if self._announced is not None and announces and not content.has_stack_ended(state):
            text = content.line_html(self._announced[0].message, self._announced[0].level) + text
        if shown is not state:
            text = content.look_back_html(shown, state) + text
        self._status.content = text
        flown = content.progress(shown)
        self._bar.visible = flown is not None
        self._bar.value = 0.0 if flown is None else round(100 * flown, 1)
        self.faults.show(state)
        self._plots.show_budget(shown)
        self._log.content = content.log_html(self._notices)
        steered, flies = state.replay is None, content.time_to_go(state) is not None
        tool = content.steered_tool(state) if steered else None
        planned = state.planner is not None
        self.editor.show_parts(tool=tool, planned=planned, flies=flies)

    def _is_due(self, part: str, period: float) -> bool:
        if self._now < self._due.get(part, 0.0):
            return False
        self._due[part] = self._now + period
        return True

    def _aim_camera(self, camera: Any, offset: Array = CAMERA) -> None:
        """Turn a camera to the robot; before its first state, to the origin."""
        seen = self._last if self._drawn is None else self._drawn
        at = np.zeros(3) if seen is None else seen.pose[:3]
        aspect = getattr(camera, "aspect", 1.0)
        camera.position, camera.look_at = view_beside_panel(at, self._reach * offset, aspect)

    def _aim_cameras(self) -> None:
        for client in self._server.get_clients().values():
            self._aim_camera(client.camera)

    # -- actions of users -----------------------------------------------------------------------

    def _request(self, action: Action) -> None:
        self._actions.append(action)
        if isinstance(action, Request):
            self.announce(Notice(f"{action.value.capitalize()} requested.", source="page"))

    def _fly(self) -> None:
        try:
            goals = self.editor.goals()
        except GoalError as error:
            self._refuse(str(error))
            return
        if not goals:
            self._refuse("There is no goal to send: no robot state has been received yet.")
            return
        self._request(FlyAction(goals))

    def _goal_to_robot(self) -> None:
        measured = self._state.measured
        if measured is not None and self._robot is not None:
            tool = content.steered_tool(self._state)
            self.editor.place(measured.pose, tool, measured.q, self._now)

    def _refuse(self, message: str) -> None:
        self.announce(Notice(message, 2, source="page"))
