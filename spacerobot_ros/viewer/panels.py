"""The panels of the page: each shows one part of the state, and passes on what users do there."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.simulation.faults import KINDS, Targets
from spacerobot_ros.viewer import content
from spacerobot_ros.viewer.content import History
from spacerobot_ros.viewer.goal_editor import Defer
from spacerobot_ros.viewer.port import Action, Inject, Notice, Request, Seek, StackState

if TYPE_CHECKING:
    import viser

Want = Callable[[Action], None]
"""Has an action carried out."""

_MOST_NOTICES = 200
_SHOWN_NOTICES = 60

_COLORS = ("#3c82f0", "#f0961a", "#2a9d5c", "#c04fb5", "#d23c3c", "#17a2b8", "#9a7d0a", "#8a8f98")
_AXIS = "#8a8f98"
_PLOT_HEIGHT = 170

_HANDS_OFF_S = 1.5
"""Wall s after a user has moved the time line in which the page leaves it alone."""


class Buttons:
    """Buttons that act on the stack at once."""

    def __init__(
        self, gui: viser.GuiApi, defer: Defer, want: Want, fly: Callable[[], None]
    ) -> None:
        self._fly = gui.add_button("Fly", color="green", hint="Send the goal that is shown.")
        self._goal = gui.add_button_group(
            "Goal", ("Abort",), hint="Give the goal up; the joints brake."
        )
        self._plant = gui.add_button_group(
            "Plant",
            ("Stop", "Rearm", "Reset"),
            hint="Stop: everything comes to rest until Rearm. Reset: back to the initial state.",
        )
        self._time = gui.add_button_group("Time", ("Pause", "Resume"))

        @self._fly.on_click
        async def _(event: Any) -> None:
            defer(fly)

        for group in (self._goal, self._plant, self._time):

            @group.on_click
            async def _(event: Any) -> None:
                request = Request(str(event.target.value).lower())
                defer(lambda: want(request))

    def show(self, *, visible: bool) -> None:
        """Show or hide them."""
        for handle in (self._fly, self._goal, self._plant, self._time):
            handle.visible = visible


class TimeLine:
    """Where a replay is: play, pause, and a slider."""

    def __init__(self, gui: viser.GuiApi, defer: Defer, want: Want) -> None:
        self._gui, self._defer, self._want = gui, defer, want
        self._folder = gui.add_folder("Replay", visible=False)
        with self._folder:
            self._buttons = gui.add_button_group("Replay", ("Play", "Hold"))
        self._slider: Any = None
        self._duration = 0.0
        self._left_alone_until = -math.inf

        @self._buttons.on_click
        async def _(event: Any) -> None:
            request = Request(str(event.target.value).lower())
            defer(lambda: want(request))

    def show(self, state: StackState, now: float) -> None:
        """Show where the replay is, if there is one."""
        replay = state.replay
        self._folder.visible = replay is not None
        if replay is None:
            return
        if self._slider is None or replay.duration_s != self._duration:
            self._make(replay.duration_s)
        if now >= self._left_alone_until:
            self._slider.value = min(max(replay.position_s, 0.0), self._slider.max)

    def _make(self, duration: float) -> None:
        if self._slider is not None:
            self._slider.remove()
        self._duration = duration
        step = max(10.0 ** math.floor(math.log10(max(duration, 1e-3) / 1000)), 1e-3)
        with self._folder:
            self._slider = self._gui.add_slider(
                "Time (s)", 0.0, max(math.ceil(duration / step) * step, step), step, 0.0
            )

        @self._slider.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                seconds = float(event.target.value)
                self._defer(lambda: self._seek(seconds))

    def _seek(self, seconds: float) -> None:
        self._left_alone_until = time.monotonic() + _HANDS_OFF_S
        self._want(Seek(seconds))


class Faults:
    """A menu of what can break, and what is broken."""

    def __init__(
        self, gui: viser.GuiApi, defer: Defer, want: Want, on_note: Callable[[str], None]
    ) -> None:
        self._want, self._on_note = want, on_note
        self._targets, self._now_s = Targets(), 0.0
        self._names: dict[str, list[str]] = {}
        self._kind: Any = gui.add_dropdown("Fault", ("-",))
        self._target: Any = gui.add_dropdown("Target", ("-",))
        self._value = gui.add_number("Value", 0.0, step=0.01)
        self._value.visible = False
        self._meaning = gui.add_html("")
        self._lasts = gui.add_number("For (s), 0: for good", 0.0, min=0.0, step=1.0)
        self._inject = gui.add_button("Inject", color="orange")
        self._clear = gui.add_button("Clear faults", color="gray")
        self._active = gui.add_html("")

        @self._kind.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                defer(self._show_kind)

        @self._inject.on_click
        async def _(event: Any) -> None:
            defer(self._on_inject)

        @self._clear.on_click
        async def _(event: Any) -> None:
            defer(lambda: want(Inject("clear")))

    def offer(self, targets: Targets) -> None:
        """Offer what such a plant can be hit by."""
        if targets == self._targets:
            return
        self._targets, self._names = targets, content.fault_kinds(targets)
        before = self._kind.value
        self._kind.options = tuple(self._names) or ("-",)
        if before in self._names:
            self._kind.value = before
        self._show_kind()

    def show_menu(self, *, visible: bool) -> None:
        """Show or hide what breaks something: a replay only shows what was broken."""
        for handle in (self._kind, self._target, self._lasts, self._inject, self._clear):
            handle.visible = visible
        self._meaning.visible = visible
        self._value.visible = visible and self._has_value

    def show(self, state: StackState) -> None:
        """Show which faults are active."""
        if state.measured is not None:
            self._now_s = state.measured.time_s
        faults = () if state.plant is None else state.plant.faults
        text = content.faults(faults)
        if text != self._active.content:
            self._active.content = text

    def _show_kind(self) -> None:
        names = self._names.get(self._kind.value, ["-"])
        before = self._target.value
        self._target.options = tuple(names)
        if before in names:
            self._target.value = before
        kind = KINDS.get(self._kind.value)
        self._value.visible = self._has_value and self._kind.visible
        self._meaning.content = "" if kind is None else content.quiet(kind.value)

    @property
    def _has_value(self) -> bool:
        """Whether the fault that is chosen has a number."""
        kind = KINDS.get(self._kind.value)
        return kind is not None and bool(kind.value)

    def _on_inject(self) -> None:
        try:
            line = content.fault_line(
                self._kind.value,
                self._target.value,
                float(self._value.value),
                float(self._lasts.value),
                self._now_s,
                self._targets,
            )
        except ParameterError as error:
            self._on_note(str(error))
            return
        self._want(Inject(line))


class Joints:
    """The joints beside their limits."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._table = gui.add_html("")

    def show(self, robot: RobotDescription, state: StackState) -> None:
        """Show the last state."""
        measured = state.measured
        if measured is not None:
            self._table.content = content.joints(robot, measured.q, measured.qdot, measured.effort)


class Plots:
    """Errors, momenta and joints over simulated time."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._tab_group = gui.add_tab_group()
        with self._tab_group.add_tab("Errors"):
            self._error = _Plot(gui, "Base from its goal", ("m", "rad"), 0.01)
            self._tool = _Plot(gui, "End-effector from its goal", ("m", "rad"), 0.01)
            self._tool.handle.visible = False
        with self._tab_group.add_tab("Momentum"):
            # In millionths: the figures of an axis have three digits behind the point.
            units = ("1e-6 kg m/s", "1e-6 kg m²/s")
            self._momentum = _Plot(gui, "Momenta from what they should be", units, 1.0)
        self._joint_tab = self._tab_group.add_tab("Shape")
        self._shape: _Plot | None = None
        self._first: Array | None = None

    def show_robot(self, robot: RobotDescription | None) -> None:
        """Begin anew with another robot."""
        self._first = None
        for plot in (self._error, self._tool, self._momentum):
            plot.clear()
        if self._shape is not None:
            self._shape.handle.remove()
            self._shape = None
        if robot is not None and robot.joint_names:
            with self._joint_tab:
                self._shape = _Plot(
                    self._gui, "Joints (m, rad)", robot.joint_names, 0.01, signed=True
                )

    def add(self, state: StackState) -> None:
        """Take the last state into the curves."""
        measured = state.measured
        if measured is None:
            return
        time_s = measured.time_s
        error, tool = content.base_error(state), content.tool_error(state)
        if error is not None:
            self._error.history.add(time_s, error)
        if tool is not None:
            self._tool.handle.visible = True
            self._tool.history.add(time_s, tool)
        if state.momenta is not None:
            if self._first is None:
                self._first = state.momenta.actual
            drift = content.momentum_drift(state.momenta, self._first)
            self._momentum.history.add(time_s, 1e6 * np.array(drift))
        if self._shape is not None:
            self._shape.history.add(time_s, measured.q)

    def draw(self) -> None:
        """Show the curves."""
        for plot in (self._error, self._tool, self._momentum, self._shape):
            if plot is not None:
                plot.draw()


class _Plot:
    """One figure with its numbers; colors that are seen on white and on black.

    Parameters
    ----------
    gui, title
        Where it is added, and what is above it.
    names
        Of the curves.
    least
        Numbers up to which the axis goes at least: rounding is not to look like a peak.
    signed
        Whether the numbers may be negative.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        title: str,
        names: tuple[str, ...],
        least: float,
        *,
        signed: bool = False,
    ) -> None:
        self.history = History(len(names))
        series: list[Any] = [{"label": "t (s)"}]
        for i, name in enumerate(names):
            turn, color = divmod(i, len(_COLORS))
            look = {"label": content.shortened(name), "stroke": _COLORS[color], "width": 1.5}
            # Colors come again with dashes, which are shorter every time.
            series.append(look | ({"dash": (max(12 // turn, 2), 4)} if turn else {}))
        faint = {"stroke": f"{_AXIS}33"}
        axis: dict[str, Any] = {"stroke": _AXIS, "grid": faint, "ticks": faint}
        # Of uPlot's "soft limits", mode 1: those of the axis where all numbers are within.
        end = {"pad": 0.1, "mode": 1}
        ends = {"min": end | {"soft": -least if signed else 0.0}, "max": end | {"soft": least}}
        self.handle: Any = gui.add_uplot(
            self.history.columns(),
            tuple(series),
            title=title,
            scales={"x": {"time": False}, "y": {"range": ends}},
            axes=(axis | {"size": 34}, axis | {"size": 66}),  # type: ignore[arg-type]
            height=_PLOT_HEIGHT,
        )
        self._width = len(names)

    def clear(self) -> None:
        """Forget everything."""
        self.history = History(self._width)

    def draw(self) -> None:
        """Send the curves."""
        self.handle.data = self.history.columns()


class Log:
    """What has happened, the newest first."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html(content.log(()))
        self._notices: deque[Notice] = deque(maxlen=_MOST_NOTICES)
        self._changed = False

    def add(self, notice: Notice) -> None:
        """Add a line."""
        if self._notices and self._notices[0] == notice:
            return  # Repeated at once: it is shown once.
        self._notices.appendleft(notice)
        self._changed = True

    def draw(self) -> None:
        """Show the lines."""
        if self._changed:
            self._changed = False
            self._html.content = content.log(list(self._notices)[:_SHOWN_NOTICES])
