"""The page: the scene and its panels, drawn from the state of the stack again and again.

Everything is drawn in one thread, that of :meth:`Page.update`. What browsers send arrives in
threads of the server and waits in a queue until then.
"""

from __future__ import annotations

from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.control.thrusters import ThrusterTable
from spacerobot_ros.errors import GoalError
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.planning import Goal
from spacerobot_ros.simulation.faults import Targets
from spacerobot_ros.viewer import content, scene
from spacerobot_ros.viewer.config import ViewerConfig
from spacerobot_ros.viewer.content import Trail
from spacerobot_ros.viewer.goal_editor import GoalEditor
from spacerobot_ros.viewer.panels import Buttons, Faults, Joints, Log, Plots, TimeLine
from spacerobot_ros.viewer.port import Action, Fly, Measured, Notice, Part, Request, StackState
from spacerobot_ros.viewer.reachability import Check

if TYPE_CHECKING:
    import viser

_ROBOT = "/robot"

_TEXTS_S, _TABLES_S, _PLOTS_S, _PATHS_S = 0.2, 0.25, 0.5, 0.5
"""Wall s from one drawing of the slower parts to the next."""

CAMERA = np.array([1.1, 1.4, 0.8])
"""From the robot to where a page looks at it from when it is opened, in lengths of the robot.

What is ahead of the base, such as its arm, is then on the left: the panel is on the right.
"""


class Page:
    """What browsers see; several of them see the same.

    Parameters
    ----------
    server
        Serves the page.
    config
        How the page looks.
    """

    def __init__(self, server: viser.ViserServer, config: ViewerConfig) -> None:
        self._server, self._config = server, config
        self._inbox: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._actions: list[Action] = []
        self._robot: RobotDescription | None = None
        self._drawing: scene.RobotDrawing | None = None
        self._table: ThrusterTable | None = None
        self._state = StackState()
        self._due: dict[str, float] = {}
        self._now = 0.0
        self._last: Measured | None = None
        self._build()

    def _build(self) -> None:
        gui, defer = self._server.gui, self._inbox.put
        gui.configure_theme(**self._theme(dark=self._config.dark))
        # Buttons come first: a sentence that grows by a line must not move them under the mouse.
        self._time_line = TimeLine(gui, defer, self._want)
        self._buttons = Buttons(gui, defer, self._want, self._fly)
        self._head = gui.add_html(content.head(StackState()))
        self._bar: Any = gui.add_progress_bar(0.0, visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Goal"):
            self._editor = GoalEditor(self._server, defer, self._refuse)
        with tabs.add_tab("Plots"):
            self._plots = Plots(gui)
        with tabs.add_tab("Joints"):
            self._joints = Joints(gui)
        with tabs.add_tab("Faults"):
            self._faults = Faults(gui, defer, self._want, self._refuse)
        with tabs.add_tab("Log"):
            self._log = Log(gui)
        self._editor.on_to_robot(self._goal_to_robot)
        look = gui.add_button(
            "Look at the robot", color="gray", hint="Have this browser look at where it is now."
        )

        @look.on_click
        async def _(event: Any) -> None:
            if event.client is not None:
                defer(lambda: self._aim(event.client.camera))

        self._style = gui.add_button("Dark or light", color="gray")
        themes: dict[int, bool] = {}

        @self._style.on_click
        async def _(event: Any) -> None:
            if event.client is not None:
                dark = not themes.get(event.client.client_id, self._config.dark)
                themes[event.client.client_id] = dark
                event.client.gui.configure_theme(**self._theme(dark=dark))

    @staticmethod
    def _theme(*, dark: bool) -> dict[str, Any]:
        return {
            "dark_mode": dark,
            "control_width": "large",
            "show_logo": False,
            "show_share_button": False,
        }

    # -- what the stack is ----------------------------------------------------------------------

    def show_robot(
        self, robot: RobotDescription | None, table: ThrusterTable | None = None
    ) -> None:
        """Begin anew with another robot; None: there is none."""
        self._robot, self._table, self._drawing, self._last = robot, table, None, None
        self._around: scene.Surroundings | None = None
        self._server.scene.reset()
        reach = 1.0 if robot is None else scene.reach_of(robot)
        self._reach, self._trail = reach, Trail(0.003 * reach)
        self._editor.show_robot(robot, reach)
        self._plots.show_robot(robot)
        if robot is None:
            return
        self._drawing = scene.RobotDrawing(
            self._server.scene, _ROBOT, robot, on_note=lambda text: self.note(Notice(text, 1))
        )
        self._drawing.base.visible = False  # Until its first state comes.

    def show_thrusters(self, table: ThrusterTable | None) -> None:
        """Take the places of the thrusters, which are known later than the robot."""
        self._table = table

    def offer_faults(self, targets: Targets) -> None:
        """Offer the faults of such a plant."""
        self._faults.offer(targets)

    def note(self, notice: Notice) -> None:
        """Add a line to the log."""
        self._log.add(notice)

    def show_check(self, check: Check) -> None:
        """Show what is known of the goal; nothing while it moves."""
        if not self._editor.moving:
            self._editor.show_check(check)

    def goals_to_check(self, now: float) -> dict[Part, Goal] | None:
        """Return the goals once, when they have not been moved for a moment, else None."""
        return self._editor.goals_at_rest(now)

    @property
    def goal_moves(self) -> bool:
        """Whether the goal has changed since it was checked."""
        return self._editor.moving

    def touch_goal(self, now: float) -> None:
        """Have the goal checked again: something that it depends on has changed."""
        self._editor.touch(now)

    # -- drawing --------------------------------------------------------------------------------

    def update(self, state: StackState, now: float) -> list[Action]:
        """Draw a state, and return what users want since the last time; ``now`` is wall time, s."""
        before, self._state, self._now = self._state, state, now
        self._handle_inbox()
        with self._server.atomic():
            replays = state.replay is not None
            if replays != (before.replay is not None):
                self._buttons.show(visible=not replays)
                self._editor.show(visible=not replays)
                self._faults.show_menu(visible=not replays)
            if self._drawing is not None and state.measured is not None:
                self._draw_robot(state, state.measured)
            self._time_line.show(state, now)
            if self._is_due("texts", _TEXTS_S):
                self._draw_texts(state)
            if self._robot is not None and self._is_due("tables", _TABLES_S):
                self._joints.show(self._robot, state)
            if self._is_due("plots", _PLOTS_S):
                self._plots.draw()
        actions, self._actions = self._actions, []
        return actions

    def _draw_robot(self, state: StackState, measured: Measured) -> None:
        robot, drawing = self._robot, self._drawing
        assert robot is not None
        assert drawing is not None
        if measured is self._last:
            return
        self._last = measured
        if self._around is None:
            center = measured.pose[:3]
            self._around = scene.Surroundings(self._server.scene, self._reach, _ROBOT, center)
            self._aim(self._server.initial_camera)
            for client in self._server.get_clients().values():
                self._aim(client.camera)
        drawing.base.visible = True
        drawing.place(measured.pose)
        drawing.set_joint_positions(measured.q)
        if not self._editor.placed and state.replay is None:
            self._editor.place(measured.pose, None, measured.q, self._now)
        self._editor.robot_is_at(measured.pose, measured.q)
        self._plots.add(state)
        self._trail.add(measured.time_s, measured.pose[:3])
        if self._is_due("paths", _PATHS_S):
            self._around.flown.draw(self._trail.points)
            path = state.planned_path
            self._around.planned.draw(np.zeros((0, 3)) if path is None else path)
        if state.firing is not None and self._table is not None:
            names, duty = state.firing.names, state.firing.duty
            self._around.plumes.draw_segments(
                scene.plumes(self._table, names, duty, 0.25 * self._reach)
            )

    def _draw_texts(self, state: StackState) -> None:
        text = content.head(state, described=self._robot is not None)
        if text != self._head.content:
            self._head.content = text
        share = content.share_flown(state)
        self._bar.visible = content.time_to_go(state) is not None
        self._bar.value = round(100 * share, 1)
        self._faults.show(state)
        self._log.draw()
        has_tool = content.has_tool(state)
        if has_tool and state.measured is not None and not self._editor.has_tool:
            self._editor.add_tool(state.tool)
        self._editor.show_tool(there=has_tool and state.replay is None)
        self._editor.show_shape(there=state.planner is not None and state.replay is None)

    def _is_due(self, what: str, period: float) -> bool:
        if self._now < self._due.get(what, 0.0):
            return False
        self._due[what] = self._now + period
        return True

    def _aim(self, camera: Any) -> None:
        """Have a camera look at where the robot is, or will be."""
        at = np.zeros(3) if self._last is None else self._last.pose[:3]
        camera.position, camera.look_at = at + self._reach * CAMERA, at

    # -- what users want ------------------------------------------------------------------------

    def _handle_inbox(self) -> None:
        while True:
            try:
                act = self._inbox.get_nowait()
            except Empty:
                return
            act()

    def _want(self, action: Action) -> None:
        self._actions.append(action)
        if isinstance(action, Request):
            self.note(Notice(f"{action.value.capitalize()} is requested.", source="page",
                             time_s=self._time_s))  # fmt: skip

    def _fly(self) -> None:
        try:
            goals = self._editor.goals()
        except GoalError as error:
            self._refuse(str(error))
            return
        if not goals:
            self._refuse("There is no goal to fly to: the robot is not known yet.")
            return
        self._want(Fly(goals))

    def _goal_to_robot(self) -> None:
        measured = self._state.measured
        if measured is not None and self._robot is not None:
            tool = self._state.tool if content.has_tool(self._state) else None
            self._editor.place(measured.pose, tool, measured.q, self._now)

    def _refuse(self, sentence: str) -> None:
        self.note(Notice(sentence, 2, self._time_s, "page"))

    @property
    def _time_s(self) -> float | None:
        return None if self._state.measured is None else self._state.measured.time_s
