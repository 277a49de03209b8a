"""The goal editor: gizmos, number fields, and a ghost of the robot at the goal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.errors import GoalError, shortened
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array, Joint, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import (
    compose_poses,
    matrix_from_quaternion,
    relative_pose,
    rpy_from_matrix,
)
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.viewer.content import COLORS, check_html, hint_html
from spacerobot_ros.viewer.reachability import GoalCheck, Verdict
from spacerobot_ros.viewer.scene import RobotDrawing, wxyz, xyzw
from spacerobot_ros.viewer.state import Part

if TYPE_CHECKING:
    import viser

Defer = Callable[[Callable[[], None]], None]
"""Queues a function for the thread that draws the page."""


def react(register: Callable[[Any], Any], defer: Defer, act: Callable[[Any], None]) -> None:
    """Call a function with the value of a page element in the thread that draws the page.

    ``register`` is the method ``on_click`` or ``on_update`` of the element. The function is called
    only for user changes, not for values set by the page.
    """
    react_to_client(register, defer, lambda _, value: act(value))


def react_to_client(
    register: Callable[[Any], Any], defer: Defer, act: Callable[[Any, Any], None]
) -> None:
    """Call a function like :func:`react`, with the client (a browser) and the value."""

    @register
    async def _(event: Any) -> None:
        if event.client is not None:
            client, value = event.client, getattr(event.target, "value", None)
            defer(lambda: act(client, value))


GOAL_SETTLING_TIME_S = 0.3
"""Wall time, s, without changes after which a goal is checked."""

_HIDDEN_GHOST_DISTANCE = 0.01
"""Distance from the robot below which the ghost is hidden, in robot lengths and rad."""

_TOOL: Part = ""
"""Key of the goal for a controller's end-effector, which is no link's name."""

_DECIMALS = 4, 2
"""Decimal places for the position (m) and angles (deg) of a goal being edited."""

_MARK_SIZE = 0.15
"""Radius of the mark at an end-effector goal, as a fraction of its gizmo size."""


class RequestedPart(Enum):
    """Link pose components that a goal may require."""

    NOTHING = "free"
    POSITION = "position"
    POSE = "pose"


class Origin(Enum):
    """Origin of the displayed goal."""

    ROBOT = "the robot's own pose"
    USER = "a user of the page, not sent yet"
    SENT = "the last goal sent, from this page or from another client"


class GoalEditor:
    """Lets users choose a goal, without sending it.

    Users choose whether a planner goal is for the base, for end-effectors, or for both. A
    controller goal is for the base and for the controller's end-effector: the end-effector gizmo
    follows the base gizmo, and can be moved separately.

    Parameters
    ----------
    server
        Page server; the number fields are added to the current GUI container.
    defer
        Queues user changes.
    on_note
        Function called with the reason if an input is rejected.
    on_reset
        Function called when the button that moves the goal to the robot is pressed.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        defer: Defer,
        on_note: Callable[[str], None],
        on_reset: Callable[[], None],
    ) -> None:
        self._server, self._defer, self._on_note = server, defer, on_note
        self._ghost_shown = True
        self._origin = Origin.ROBOT
        self._in_flight = False
        """Whether the robot is flying to the displayed goal, which hides the gizmos."""
        self._in_replay = False
        gui = server.gui
        recorded = hint_html("A recording does not accept goals.")
        self._none_taken = gui.add_html(recorded, visible=False)
        self._hint = gui.add_html(hint_html("Drag the arrows or enter numbers, then press Fly."))
        self._verdict = gui.add_html("")
        edit = self._defer_edit
        self._parts = _PartMenu(gui, defer, edit, on_note, self._on_parts_chosen)
        # Any: for mypy viser's values are read-only.
        self._position: Any = gui.add_vector3("Goal (m)", (0.0, 0.0, 0.0), step=0.01)
        self._angles: Any = gui.add_vector3("Roll, pitch, yaw (deg)", (0.0, 0.0, 0.0), step=1.0)
        self._position.precision, self._angles.precision = _DECIMALS
        self._tool_too = gui.add_checkbox(
            "Goal for the end-effector",
            initial_value=True,
            hint="If disabled, the end-effector keeps its current goal, if any.",
            visible=False,
        )
        self._final = _FinalShape(gui, edit, self._mark_changed)
        react(self._tool_too.on_update, edit, lambda _: self.touch(time.monotonic()))
        self._to_robot = gui.add_button("Goal to the robot", color="gray")
        react(self._to_robot.on_click, defer, lambda _: on_reset())
        for field in (self._position, self._angles):
            field.on_update(self._on_field)
        self.show_robot(None, 1.0)

    @property
    def placed(self) -> bool:
        """Whether the editor has a goal."""
        return BASE_GOAL_KEY in self._poses

    def show_robot(self, robot: RobotDescription | None, reach: float) -> None:
        """Start again with another robot, in an empty scene; None: no robot."""
        self._gizmos: dict[Part, Any] = {}
        self._marks: dict[Part, Any] = {}
        self._poses: dict[Part, Array] = {}
        self._ghost: RobotDrawing | None = None
        self._present: tuple[Array, Array] | None = None
        self._changed_at: float | None = None
        self._followed: Mapping[Part, Goal] = {}
        """The last followed goals."""
        self._reach, self._robot = reach, robot
        self._kinematics = None if robot is None else ForwardKinematics(robot)
        self._parts.offer(())
        # The check of another robot's goal does not apply: it has other joints.
        self.show_check(GoalCheck(Verdict.UNCHECKED))
        self._final.show_robot(robot)

    def place(self, base: Array, tool: Array | None, q: Array, now: float) -> None:
        """Set the goal to poses (7,) and the ghost to joint positions (n,)."""
        assert self._robot is not None
        if BASE_GOAL_KEY not in self._gizmos:
            self._add_gizmo(BASE_GOAL_KEY)
            color, path = COLORS[Verdict.UNCHECKED], f"{_path_of(BASE_GOAL_KEY)}/ghost"
            self._ghost = RobotDrawing(self._server.scene, path, self._robot, color=color)
        self._present = base, q
        self._final.update_robot(q)
        self._final.fill()
        self._move_gizmo(BASE_GOAL_KEY, base)
        for link in self._parts.links:
            self._place_link_gizmo(link)
        if tool is not None and _TOOL in self._gizmos:
            self._move_gizmo(_TOOL, tool)
        self.update_robot(base, q)
        self._show_fields()
        self._changed_at = now
        self._origin = Origin.ROBOT

    def follow(self, goals: Mapping[Part, Goal], now: float) -> None:
        """Show the last goals sent by any client, once per goal. A goal that a user is editing is
        kept.

        Parameters
        ----------
        goals
            Goals by robot part.
        now
            Wall time, s.
        """
        before = self._followed
        links = {aim.link: aim for goal in goals.values() for aim in goal.end_effectors}
        same = goals.keys() == before.keys() and all(goals[x].equals(before[x]) for x in goals)
        if not goals or not self.placed or same:
            return
        if self._origin is Origin.USER or not set(links) <= set(self._parts.links):
            return
        self._followed = dict(goals)
        base, tool = goals.get(BASE_GOAL_KEY), goals.get(DEFAULT_END_EFFECTOR)
        asked = {link: RequestedPart.POSITION if aim.quaternion is None else RequestedPart.POSE
                 for link, aim in links.items()}  # fmt: skip
        if base is not None or not links:
            asked[BASE_GOAL_KEY] = RequestedPart.POSE
        self._parts.choose(asked)
        if base is not None:
            self._move_gizmo(BASE_GOAL_KEY, _pose_of(base))
        if tool is not None and not tool.end_effectors and _TOOL in self._gizmos:
            self._move_gizmo(_TOOL, _pose_of(tool))
        for link, aim in links.items():
            self._place_link_gizmo(link)
            turn = self._poses[link][3:] if aim.quaternion is None else aim.quaternion
            self._move_gizmo(link, np.concatenate([aim.position, turn]))
        self._show_parts()
        self._show_fields()
        self._changed_at = now
        self.note_sent()
        if self.check.verdict is not Verdict.UNCHECKED:
            self.show_check(GoalCheck(Verdict.PLANNING, "Another goal has been sent."))

    def note_sent(self) -> None:
        """Record that the displayed goal has been sent."""
        self._origin, self._hint.visible = Origin.SENT, False

    @property
    def shows_sent_goal(self) -> bool:
        """Whether the displayed goal is the goal that was sent last."""
        return self._origin is Origin.SENT

    def _defer_edit(self, act: Callable[[], None]) -> None:
        def edit() -> None:
            self._origin = Origin.USER
            self._hint.visible = False
            act()

        self._defer(edit)

    def update_robot(self, pose: Array, q: Array) -> None:
        """Update the robot's base pose (7,) and joint positions (n,).

        The ghost uses these joint positions unless a plan or a user sets other positions, and is
        hidden if it would coincide with the robot.
        """
        self._present = pose, q
        self._final.update_robot(q)
        if self._ghost is None:
            return
        shape = self.check.shape
        if shape is None:
            final = self._final.positions
            shape = q if final is None else final
            self._ghost.set_joint_positions(shape)
        goal = self._ghost_pose(pose)
        # The ghost is attached to the base gizmo, so that it follows the mouse immediately.
        self._ghost.place(relative_pose(self._poses[BASE_GOAL_KEY], goal))
        hidden = self._is_at_goal(goal, pose, q, shape)
        self._ghost.base.visible = self._ghost_shown and not hidden

    def show_ghost(self, *, visible: bool) -> None:
        """Show or hide the ghost; other conditions may hide it too."""
        self._ghost_shown = visible
        if self._present is not None:
            self.update_robot(*self._present)

    def _ghost_pose(self, pose: Array) -> Array:
        """Return the ghost's base pose (7,): the predicted final pose, or else the goal pose."""
        if self.check.base is not None:
            return self.check.base
        free = self._parts.asked(BASE_GOAL_KEY) is RequestedPart.NOTHING
        return pose if free else self._poses[BASE_GOAL_KEY]

    def _is_at_goal(self, goal: Array, pose: Array, q: Array, shape: Array) -> bool:
        """Whether a robot at a pose and joint positions ``q`` coincides with the ghost."""
        distance = float(np.linalg.norm(goal[:3] - pose[:3]))
        turned = 2.0 * math.acos(min(1.0, abs(float(goal[3:] @ pose[3:]))))
        bent = float(np.abs(shape - q).max(initial=0.0))
        return max(distance / self._reach, turned, bent) < _HIDDEN_GHOST_DISTANCE

    def show_parts(self, *, tool: Array | None, planned: bool, flies: bool) -> None:
        """Show the controls for the parts that accept goals.

        Parameters
        ----------
        tool
            Pose (7,) of the end-effector of a controller, where its goal begins; None: it does not
            accept goals.
        planned
            Whether a planner accepts goals: for end-effectors, and for final joint positions.
        flies
            Whether the robot flies to its goal; if this is the displayed goal, the gizmos are
            hidden.
        """
        if tool is not None and self.placed and _TOOL not in self._gizmos:
            self._add_gizmo(_TOOL)
            self._move_gizmo(_TOOL, tool)
            self.touch(time.monotonic())
        in_flight = flies and self.shows_sent_goal
        if in_flight != self._in_flight:
            self._in_flight = in_flight
            self._show_parts()
        self._tool_too.visible = tool is not None
        if _TOOL in self._gizmos:
            shown = self._tool_too.visible and self._tool_too.value and not in_flight
            self._gizmos[_TOOL].visible = shown
        self._parts.show(visible=planned)
        self._final.show(visible=planned and not self._in_replay)

    def offer_end_effectors(self, links: Iterable[str]) -> None:
        """Offer goals for the links whose goals the planner accepts."""
        offered = tuple(links)
        if offered == self._parts.links:
            return  # The user's choice is kept.
        for link in self._parts.links:
            if link in self._gizmos:
                self._gizmos[link].visible = False
        self._parts.offer(offered)
        self._on_parts_chosen(BASE_GOAL_KEY)

    def show(self, *, visible: bool) -> None:
        """Show or hide all controls: a replay does not accept goals, but shows the sent ones."""
        self._in_replay, self._origin = not visible, Origin.ROBOT
        self._parts.steered = visible
        for handle in (self._hint, self._verdict, self._position, self._to_robot):
            handle.visible = visible
        self._none_taken.visible = not visible
        self._show_parts()

    def goals(self) -> dict[Part, Goal]:
        """Return the goals to send, by robot part; a link goal names its link in ``end_effectors``.

        Raises
        ------
        GoalError
            A pose is not finite, or its quaternion does not have unit length.
        """
        if not self.placed:
            return {}
        shape = self._final.positions
        goals: dict[Part, Goal] = {}
        if self._parts.asked(BASE_GOAL_KEY) is not RequestedPart.NOTHING:
            goals[BASE_GOAL_KEY] = self._goal_at(BASE_GOAL_KEY, shape)
        if self._tool_too.visible and self._tool_too.value and _TOOL in self._gizmos:
            goals[DEFAULT_END_EFFECTOR] = self._goal_at(_TOOL)
        for link, asked in self._parts.requested_links().items():
            pose = self._poses[link]
            aim = EndEffectorGoal.checked(link, pose if asked is RequestedPart.POSE else pose[:3])
            goals[link] = Goal.of_end_effectors([aim], joint_positions=shape)
        return goals

    def _goal_at(self, part: Part, shape: Array | None = None) -> Goal:
        pose = self._poses[part]
        return Goal.checked(pose[:3].tolist(), pose[3:].tolist(), shape)

    def settled_goals(self, now: float) -> dict[Part, Goal] | None:
        """Return the goals once after each change, as soon as they have been unchanged for
        a while; otherwise None."""
        changed = self._changed_at
        if changed is None or now - changed < GOAL_SETTLING_TIME_S or not self.placed:
            return None
        self._changed_at = None
        try:
            return self.goals()
        except GoalError as error:
            self.show_check(GoalCheck(Verdict.REFUSED, str(error)))
            return None

    @property
    def moving(self) -> bool:
        """Whether the goal has changed since it was last checked."""
        return self._changed_at is not None

    def touch(self, now: float) -> None:
        """Request another goal check because its preconditions have changed."""
        if self.placed:
            self._changed_at = now

    def show_check(self, check: GoalCheck) -> None:
        """Show the goal check result."""
        self.check = check
        """The displayed check result."""
        self._verdict.content = check_html(check)
        if self._ghost is not None:
            self._ghost.paint(COLORS[check.verdict])
            for mark in self._marks.values():
                mark.color = COLORS[check.verdict]
            if check.shape is not None:
                self._ghost.set_joint_positions(check.shape)
            if self._present is not None:
                self.update_robot(*self._present)

    # -- changes by users --------------------------------------------------------------------------

    def _add_gizmo(self, part: Part) -> None:
        base, path = part == BASE_GOAL_KEY, _path_of(part)
        scale = (0.2 if base else 0.12) * self._reach
        gizmo = self._server.scene.add_transform_controls(path, scale=scale, depth_test=False)
        self._gizmos[part] = gizmo
        if not base:
            self._marks[part] = self._server.scene.add_icosphere(
                f"{path}/mark", _MARK_SIZE * scale, color=COLORS[self.check.verdict], opacity=0.6,
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip

        @gizmo.on_update
        async def _(event: Any) -> None:
            pose = np.concatenate([event.target.position, xyzw(event.target.wxyz)])
            self._defer_edit(lambda: self._on_gizmo_moved(part, pose))

    async def _on_field(self, event: Any) -> None:
        if event.client is not None:  # Otherwise, the page itself set the value.
            position, angles = self._position.value, self._angles.value
            self._defer_edit(lambda: self._on_fields_typed(position, angles))

    def _on_gizmo_moved(self, part: Part, pose: Array) -> None:
        if part not in self._gizmos or not np.all(np.isfinite(pose)):
            return  # The gizmo belongs to an earlier robot, or the pose is not finite.
        # The values shown in the fields are sent.
        goal = Goal.from_rpy(*_fields_of(pose))
        self._set_goal(part, _pose_of(goal))
        self._show_fields()

    def _on_fields_typed(self, position: tuple[float, ...], angles: tuple[float, ...]) -> None:
        if not self.placed:
            return
        try:
            goal = Goal.from_rpy(position, angles)
        except GoalError as error:
            self._on_note(str(error))
            self._show_fields()
            return
        part = self._parts.shown
        self._set_goal(part, _pose_of(goal))
        self._move_gizmo(part, self._poses[part])

    def _set_goal(self, part: Part, pose: Array) -> None:
        before = self._poses.get(part, pose)
        self._poses[part] = pose
        if part == BASE_GOAL_KEY and _TOOL in self._gizmos:
            self._move_gizmo(_TOOL, move_along(self._poses[_TOOL], before, pose))
        self._mark_changed()

    def _mark_changed(self) -> None:
        if not self.placed:
            return
        self._changed_at = time.monotonic()
        if self.check.verdict is not Verdict.UNCHECKED:
            self.show_check(GoalCheck(Verdict.PLANNING, "The goal is being moved."))

    def _move_gizmo(self, part: Part, pose: Array) -> None:
        self._poses[part] = pose
        self._gizmos[part].position = pose[:3]
        self._gizmos[part].wxyz = wxyz(pose[3:])

    def _on_parts_chosen(self, part: Part) -> None:
        """Apply a user's choice for a part, or the choice of the part whose numbers are shown."""
        if part != BASE_GOAL_KEY and self._parts.asked(part) is not RequestedPart.NOTHING:
            gizmo = self._gizmos.get(part)
            if gizmo is None or not gizmo.visible:
                self._place_link_gizmo(part)
        self._show_parts()
        self._show_fields()
        self._mark_changed()

    def _place_link_gizmo(self, link: str) -> None:
        if self._kinematics is None or self._present is None:
            return
        if link not in self._gizmos:
            self._add_gizmo(link)
            self._gizmos[link].visible = False
        self._move_gizmo(link, self._kinematics.link_in_world(link, *self._present))

    def _show_parts(self) -> None:
        """Show the gizmos of the parts that the goal specifies, and their handles."""
        hidden = self._in_flight or self._in_replay
        for link in self._parts.links:
            gizmo = self._gizmos.get(link)
            if gizmo is not None:
                asked = self._parts.asked(link)
                gizmo.visible = asked is not RequestedPart.NOTHING and not hidden
                gizmo.disable_rotations = asked is RequestedPart.POSITION
        base = self._gizmos.get(BASE_GOAL_KEY)
        if base is not None:
            # Its node stays visible, because the ghost is attached to it.
            free = self._parts.asked(BASE_GOAL_KEY) is RequestedPart.NOTHING
            base.disable_axes = base.disable_sliders = base.disable_rotations = free or hidden
        turned = self._parts.asked(self._parts.shown) is not RequestedPart.POSITION
        self._angles.visible = turned and not self._in_replay

    def _show_fields(self) -> None:
        pose = self._poses.get(self._parts.shown)
        if pose is not None:
            self._position.value, self._angles.value = _fields_of(pose)


class _PartMenu:
    """Controls for the robot parts that a planner goal specifies.

    Without end-effectors, or without a planner, that is the base pose. ``edit`` queues user
    changes that modify the goal; ``on_change`` is called with the part when a user has changed
    what its goal specifies, or the part whose numbers are shown.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        defer: Defer,
        edit: Defer,
        on_note: Callable[[str], None],
        on_change: Callable[[Part], None],
    ) -> None:
        self._gui, self._edit = gui, edit
        self._on_note, self._on_change = on_note, on_change
        self._folder = gui.add_folder("Goal for", visible=False)
        self._menus: dict[Part, Any] = {}
        hint = "The part to which the numbers below apply."
        parts = (BASE_GOAL_KEY,)
        self._numbers: Any = gui.add_dropdown("Numbers of", parts, hint=hint, visible=False)
        self._there, self.steered = False, True
        react(self._numbers.on_update, defer, lambda _: self._on_change(self.shown))

    @property
    def links(self) -> tuple[str, ...]:
        return tuple(part for part in self._menus if part != BASE_GOAL_KEY)

    @property
    def shown(self) -> Part:
        return str(self._numbers.value)

    def asked(self, part: Part) -> RequestedPart:
        """Return whether the goal specifies the position or the pose of a robot part, or leaves
        the part free."""
        if self._there and part in self._menus:
            return RequestedPart(self._menus[part].value)
        return RequestedPart.POSE if part == BASE_GOAL_KEY else RequestedPart.NOTHING

    def requested_links(self) -> dict[str, RequestedPart]:
        asked = {link: self.asked(link) for link in self.links}
        return {link: each for link, each in asked.items() if each is not RequestedPart.NOTHING}

    def offer(self, links: Iterable[str]) -> None:
        """Offer goals for other links; reset the goal to the base."""
        for menu in self._menus.values():
            menu.remove()
        self._menus = {}
        offered = tuple(links)
        with self._folder:
            for part in (BASE_GOAL_KEY, *offered) if offered else ():
                self._menus[part] = self._add_menu(part)
        self._update()

    def choose(self, asked: Mapping[Part, RequestedPart]) -> None:
        """Select the robot parts of a goal that another client sent."""
        for part, menu in self._menus.items():
            menu.value = asked.get(part, RequestedPart.NOTHING).value
        self._update()

    def show(self, *, visible: bool) -> None:
        if (visible and bool(self.links)) != self._there:
            self._there = not self._there
            self._update()
            self._on_change(self.shown)

    def _add_menu(self, part: Part) -> Any:
        base = part == BASE_GOAL_KEY
        choices = (RequestedPart.POSE, RequestedPart.NOTHING) if base else tuple(RequestedPart)
        menu = self._gui.add_dropdown(shortened(part), [each.value for each in choices], hint=part)
        react(menu.on_update, self._edit, lambda _: self._on_chosen(part))
        return menu

    def _on_chosen(self, part: Part) -> None:
        if part not in self._menus:
            return  # The menu belongs to an earlier robot.
        base, for_links = self._menus[BASE_GOAL_KEY], self.requested_links()
        chosen = self.asked(part)
        if not for_links:
            if part == BASE_GOAL_KEY and chosen is RequestedPart.NOTHING:
                self._on_note("A goal is for the base or for an end-effector: choose one of them.")
            base.value = RequestedPart.POSE.value
        elif list(for_links) == [part] and self._numbers.options == (BASE_GOAL_KEY,):
            # The first end-effector in a base goal: the base is free until users constrain it.
            base.value = RequestedPart.NOTHING.value
        self._update(part)
        self._on_change(part)

    def _update(self, part: Part | None = None) -> None:
        """Show the numbers of a part if the goal specifies it, otherwise of the previous part."""
        self._folder.visible = self._there and self.steered
        parts = [BASE_GOAL_KEY] if self.asked(BASE_GOAL_KEY) is not RequestedPart.NOTHING else []
        parts += self.requested_links()
        wanted = [each for each in (part, self.shown) if each in parts]
        self._numbers.options = tuple(parts)
        self._numbers.value = [*wanted, *parts][0]
        self._numbers.visible = len(parts) > 1 and self.steered


class _FinalShape:
    """Controls for the joint positions at the end of the manoeuvre.

    ``edit`` queues user changes; ``on_change`` is called when a user has changed the positions.
    """

    def __init__(self, gui: viser.GuiApi, edit: Defer, on_change: Callable[[], None]) -> None:
        self._gui, self._edit, self._on_change = gui, edit, on_change
        self._enabled: Any = gui.add_checkbox(
            "Final joint positions",
            initial_value=False,
            hint="If enabled, the planned motion ends at these joint positions; otherwise, final "
            "joint positions are free.",
            visible=False,
        )
        self._folder = gui.add_folder("At the end", visible=False)
        self._fields: list[Any] = []
        self._q: Array = np.zeros(0)
        react(self._enabled.on_update, edit, lambda _: self._update_folder())

    @property
    def positions(self) -> Array | None:
        """Final joint positions (n,), m or rad; None: any."""
        if not (self._enabled.visible and self._enabled.value):
            return None
        return np.array([field.value for field in self._fields], float)

    def show_robot(self, robot: RobotDescription | None) -> None:
        for field in self._fields:
            field.remove()
        self._fields, self._q, self._enabled.value = [], np.zeros(0), False
        joints = () if robot is None else robot.movable_joints
        with self._folder:
            for joint in joints:
                field = self._add_joint_field(joint)
                react(field.on_update, self._edit, lambda _: self._on_change())
                self._fields.append(field)
        self._update_folder()

    def _add_joint_field(self, joint: Joint) -> Any:
        """Return a slider between the limits of a joint, or a number field if it has no limits."""
        label, name = f"{shortened(joint.name)} ({joint.unit})", joint.name
        low, high = joint.limits.lower, joint.limits.upper
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            return self._gui.add_number(label, 0.0, step=0.01, hint=name)
        step = 10.0 ** math.floor(math.log10((high - low) / 100))
        low, high = (
            round(whole(end / step) * step, 9)
            for whole, end in ((math.ceil, low), (math.floor, high))
        )
        return self._gui.add_slider(label, low, high, step, min(max(0.0, low), high), hint=name)

    def update_robot(self, q: Array) -> None:
        """Update the robot's joint positions (n,)."""
        self._q = q

    def fill(self) -> None:
        for field, position in zip(self._fields, self._q, strict=False):
            low, high = getattr(field, "min", None), getattr(field, "max", None)
            value = round(float(position), 4)
            field.value = value if low is None or high is None else min(max(value, low), high)

    def show(self, *, visible: bool) -> None:
        shown = visible and bool(self._fields)
        if shown != self._enabled.visible:
            self._enabled.visible = shown
            self._update_folder()

    def _update_folder(self) -> None:
        shown = self._enabled.visible and self._enabled.value
        if shown and not self._folder.visible:
            self.fill()
        self._folder.visible = shown
        self._on_change()


def _fields_of(pose: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the position, m, and roll, pitch and yaw, deg, of a pose (7,), as they are shown."""
    angles = np.degrees(rpy_from_matrix(matrix_from_quaternion(pose[3:])))
    shown = np.round(pose[:3], _DECIMALS[0]), np.round(angles, _DECIMALS[1])
    return tuple(shown[0].tolist()), tuple(shown[1].tolist())


def _pose_of(goal: Goal) -> Array:
    return np.concatenate([goal.position, goal.quaternion])


def _path_of(part: Part) -> str:
    """Return the path of a part's gizmo in the scene; the name of a link may contain slashes."""
    paths = {BASE_GOAL_KEY: "/goal", _TOOL: "/end_effector_goal"}
    return paths.get(part, f"/end_effector_goals/{part.replace('/', '%')}")


def move_along(pose: Array, before: Array, after: Array) -> Array:
    """Return a pose (7,) moved rigidly with another pose, from ``before`` to ``after``."""
    return compose_poses(after, relative_pose(before, pose))
