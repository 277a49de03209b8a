"""The goal editor: gizmos, number fields, and a ghost of the robot at the goal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.errors import GoalError
from spacerobot_ros.model.description import Array, Joint, RobotDescription
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_inverse,
    quaternion_multiply,
)
from spacerobot_ros.planning import Goal
from spacerobot_ros.viewer.content import (
    COLORS,
    check_html,
    hint_html,
    shortened,
)
from spacerobot_ros.viewer.reachability import Check, Verdict
from spacerobot_ros.viewer.scene import RobotDrawing, wxyz, xyzw
from spacerobot_ros.viewer.state import Part

if TYPE_CHECKING:
    import viser

Defer = Callable[[Callable[[], None]], None]
"""Queues a function for the thread that draws the page."""

AT_REST_S = 0.3
"""Wall time without a change after which a goal is checked, s."""

_HIDDEN_GHOST_DISTANCE = 0.01
"""Distance from the robot below which the ghost is hidden, in robot lengths and rad."""

_BASE_GIZMO, _TOOL_GIZMO = "/goal", "/end_effector_goal"
_PART_OF: dict[str, Part] = {_BASE_GIZMO: "base", _TOOL_GIZMO: "end_effector"}


class GoalEditor:
    """Lets users choose a goal; it sends nothing itself.

    The gizmo of the end-effector moves along with that of the base, and can be moved alone.

    Parameters
    ----------
    server
        Server of the page; the number fields are added to the current GUI container.
    defer
        Queues the changes of users.
    on_note
        Called with the reason when an input is refused.
    """

    def __init__(
        self, server: viser.ViserServer, defer: Defer, on_note: Callable[[str], None]
    ) -> None:
        self._server, self._defer, self._on_note = server, defer, on_note
        self._gizmos: dict[str, Any] = {}
        self._poses: dict[str, Array] = {}
        self._ghost: RobotDrawing | None = None
        self._changed_at: float | None = None
        self._check = Check(Verdict.UNCHECKED)
        gui = server.gui
        self._none_taken = gui.add_html(hint_html("A recording takes no goals."), visible=False)
        self._verdict = gui.add_html(check_html(self._check))
        # Any: for mypy viser's values are read-only.
        self._position: Any = gui.add_vector3("Goal (m)", (0.0, 0.0, 0.0), step=0.01)
        self._angles: Any = gui.add_vector3("Roll, pitch, yaw (deg)", (0.0, 0.0, 0.0), step=1.0)
        self._tool_too = gui.add_checkbox(
            "Goal for the end-effector",
            initial_value=True,
            hint="Off: the end-effector keeps its current goal, if any.",
        )
        self._tool_too.visible = False
        self._final = _FinalShape(gui, defer, self._mark_changed)

        @self._tool_too.on_update
        async def _(event: Any) -> None:
            self._defer(lambda: self.touch(time.monotonic()))

        self._to_robot = gui.add_button("Goal to the robot", color="gray")
        for field in (self._position, self._angles):
            field.on_update(self._on_field)

    @property
    def placed(self) -> bool:
        """Whether the editor has a goal."""
        return _BASE_GIZMO in self._poses

    @property
    def has_tool(self) -> bool:
        """Whether the editor has a goal of the end-effector."""
        return _TOOL_GIZMO in self._poses

    def add_tool(self, pose: Array | None) -> None:
        """Add a goal of the end-effector at a pose (7,)."""
        if pose is not None and self.placed:
            self._add_gizmo(_TOOL_GIZMO, 0.2 * self._reach)
            self._move_gizmo(_TOOL_GIZMO, pose)
            self.touch(time.monotonic())

    def on_goal_to_robot(self, act: Callable[[], None]) -> None:
        """Call a function when the button that moves the goal to the robot is pressed."""

        @self._to_robot.on_click
        async def _(event: Any) -> None:
            self._defer(act)

    def show_robot(self, robot: RobotDescription | None, reach: float) -> None:
        """Start over with another robot, in an empty scene; None: there is none."""
        self._gizmos.clear()
        self._poses.clear()
        self._ghost, self._changed_at = None, None
        self._reach, self._robot = reach, robot
        # The check of another robot's goal does not apply: it has other joints.
        self.show_check(Check(Verdict.UNCHECKED))
        self._final.show_robot(robot)

    def place(self, base: Array, tool: Array | None, q: Array, now: float) -> None:
        """Set the goal to poses (7,) and the ghost to joint positions (n,)."""
        assert self._robot is not None
        if _BASE_GIZMO not in self._gizmos:
            self._add_gizmo(_BASE_GIZMO, 0.45 * self._reach)
            self._ghost = RobotDrawing(
                self._server.scene,
                f"{_BASE_GIZMO}/ghost",
                self._robot,
                color=COLORS[Verdict.UNCHECKED],
            )
        self._final.robot_is_at(q)
        self._final.fill()
        self._move_gizmo(_BASE_GIZMO, base)
        if tool is not None and self.has_tool:
            self._move_gizmo(_TOOL_GIZMO, tool)
        self.robot_is_at(base, q)
        self._show_fields()
        self._changed_at = now

    def robot_is_at(self, pose: Array, q: Array) -> None:
        """Update the pose (7,) of the robot's base and the positions (n,) of its joints.

        The ghost takes these joint positions unless a plan or a user sets others, and is hidden
        where it would only colour the robot.
        """
        self._final.robot_is_at(q)
        if self._ghost is None:
            return
        shape = self._check.shape
        if shape is None:
            final = self._final.positions
            shape = q if final is None else final
            self._ghost.set_joint_positions(shape)
        self._ghost.base.visible = not self._is_at_goal(pose, q, shape)

    def _is_at_goal(self, pose: Array, q: Array, shape: Array) -> bool:
        """Whether a robot at a pose and joint positions ``q`` coincides with the ghost."""
        goal = self._poses[_BASE_GIZMO]
        distance = float(np.linalg.norm(goal[:3] - pose[:3]))
        turned = 2.0 * math.acos(min(1.0, abs(float(goal[3:] @ pose[3:]))))
        bent = float(np.abs(shape - q).max(initial=0.0))
        return (
            distance < _HIDDEN_GHOST_DISTANCE * self._reach
            and max(turned, bent) < _HIDDEN_GHOST_DISTANCE
        )

    def show_tool(self, *, there: bool) -> None:
        """Show or hide the controls of the end-effector."""
        self._tool_too.visible = there
        if _TOOL_GIZMO in self._gizmos:
            self._gizmos[_TOOL_GIZMO].visible = there and self._tool_too.value

    def show_shape(self, *, there: bool) -> None:
        """Show or hide the final joint positions, which planners take."""
        self._final.show(visible=there)

    def show(self, *, visible: bool) -> None:
        """Show or hide all controls: a replay takes no goals."""
        fields = (self._verdict, self._position, self._angles, self._to_robot)
        for handle in (*fields, *self._gizmos.values()):
            handle.visible = visible
        self._none_taken.visible = not visible

    def goals(self) -> dict[Part, Goal]:
        """Return the goals to send.

        Raises
        ------
        GoalError
            A pose is not finite or its quaternion not of unit length.
        """
        names = [_BASE_GIZMO]
        if self._tool_too.visible and self._tool_too.value:
            names.append(_TOOL_GIZMO)
        shapes = {_BASE_GIZMO: self._final.positions}
        return {
            _PART_OF[name]: Goal.checked(
                self._poses[name][:3].tolist(), self._poses[name][3:].tolist(), shapes.get(name)
            )
            for name in names
            if name in self._poses
        }

    def goals_at_rest(self, now: float) -> dict[Part, Goal] | None:
        """Return the goals once after every change, when they have come to rest; else None."""
        if self._changed_at is None or now - self._changed_at < AT_REST_S or not self.placed:
            return None
        self._changed_at = None
        try:
            return self.goals()
        except GoalError as error:
            self.show_check(Check(Verdict.REFUSED, str(error)))
            return None

    @property
    def moving(self) -> bool:
        """Whether the goal has changed since it was last checked."""
        return self._changed_at is not None

    def touch(self, now: float) -> None:
        """Request another check of the goal, because its preconditions have changed."""
        if self.placed:
            self._changed_at = now

    def show_check(self, check: Check) -> None:
        """Show the result of a check of the goal."""
        self._check = check
        text = check_html(check)
        if text != self._verdict.content:
            self._verdict.content = text
        if self._ghost is not None:
            self._ghost.paint(COLORS[check.verdict])
            if check.shape is not None:
                self._ghost.set_joint_positions(check.shape)

    # -- changes by users --------------------------------------------------------------------------

    def _add_gizmo(self, name: str, scale: float) -> None:
        gizmo = self._server.scene.add_transform_controls(name, scale=scale, depth_test=False)
        self._gizmos[name] = gizmo
        if name == _TOOL_GIZMO:
            self._server.scene.add_icosphere(
                f"{name}/mark", 0.12 * scale, color=COLORS[Verdict.UNCHECKED], opacity=0.6,
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip

        @gizmo.on_update
        async def _(event: Any) -> None:
            pose = np.concatenate([event.target.position, xyzw(event.target.wxyz)])
            self._defer(lambda: self._on_gizmo_moved(name, pose))

    async def _on_field(self, event: Any) -> None:
        if event.client is not None:  # Else the page itself wrote the value.
            position, angles = self._position.value, self._angles.value
            self._defer(lambda: self._on_fields_typed(position, angles))

    def _on_gizmo_moved(self, name: str, pose: Array) -> None:
        if name not in self._gizmos or not np.all(np.isfinite(pose)):
            return  # The gizmo of an earlier robot, or a pose that is not finite.
        self._set_goal(name, pose)
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
        self._set_goal(_BASE_GIZMO, np.concatenate([goal.position, goal.quaternion]))
        self._move_gizmo(_BASE_GIZMO, self._poses[_BASE_GIZMO])

    def _set_goal(self, name: str, pose: Array) -> None:
        before = self._poses.get(name, pose)
        self._poses[name] = pose
        if name == _BASE_GIZMO and _TOOL_GIZMO in self._poses:
            self._move_gizmo(_TOOL_GIZMO, move_along(self._poses[_TOOL_GIZMO], before, pose))
        self._mark_changed()

    def _mark_changed(self) -> None:
        """Note that the goal has changed."""
        if not self.placed:
            return
        self._changed_at = time.monotonic()
        if self._check.verdict is not Verdict.UNCHECKED:
            self.show_check(Check(Verdict.PLANNING, "The goal is being moved."))

    def _move_gizmo(self, name: str, pose: Array) -> None:
        self._poses[name] = pose
        self._gizmos[name].position = pose[:3]
        self._gizmos[name].wxyz = wxyz(pose[3:])

    def _show_fields(self) -> None:
        pose = self._poses.get(_BASE_GIZMO)
        if pose is not None:
            x, y, z = (round(float(each), 4) for each in pose[:3])
            self._position.value = (x, y, z)
            turns = np.degrees(rpy_from_quaternion(pose[3:]))
            roll, pitch, yaw = (round(float(each), 2) for each in turns)
            self._angles.value = (roll, pitch, yaw)


class _FinalShape:
    """Controls of the joint positions at the end of the manoeuvre.

    Parameters
    ----------
    gui, defer
        As for :class:`GoalEditor`.
    on_change
        Called when users have changed them.
    """

    def __init__(self, gui: viser.GuiApi, defer: Defer, on_change: Callable[[], None]) -> None:
        self._gui, self._defer, self._on_change = gui, defer, on_change
        self._enabled: Any = gui.add_checkbox(
            "Final joint positions",
            initial_value=False,
            hint="The planner ends in these joint positions, not in any.",
        )
        self._enabled.visible = False
        self._folder = gui.add_folder("At the end", visible=False)
        self._fields: list[Any] = []
        self._q: Array = np.zeros(0)

        @self._enabled.on_update
        async def _(event: Any) -> None:
            defer(self._update_folder)

    @property
    def positions(self) -> Array | None:
        """Final positions (n,) of the joints, m or rad; None: any."""
        if not (self._enabled.visible and self._enabled.value):
            return None
        return np.array([field.value for field in self._fields], float)

    def show_robot(self, robot: RobotDescription | None) -> None:
        """Show a field for each joint of another robot."""
        for field in self._fields:
            field.remove()
        self._fields, self._q, self._enabled.value = [], np.zeros(0), False
        joints = () if robot is None else robot.movable_joints
        with self._folder:
            for joint in joints:
                field = self._add_joint_field(joint)
                field.on_update(self._on_field)
                self._fields.append(field)
        self._update_folder()

    def _add_joint_field(self, joint: Joint) -> Any:
        """Return a slider between the limits of a joint, or a number field if it has none."""
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

    def robot_is_at(self, q: Array) -> None:
        """Update the joint positions (n,) of the robot."""
        self._q = q

    def fill(self) -> None:
        """Set the fields to the joint positions of the robot."""
        for field, position in zip(self._fields, self._q, strict=False):
            low, high = getattr(field, "min", None), getattr(field, "max", None)
            value = round(float(position), 4)
            field.value = value if low is None or high is None else min(max(value, low), high)

    def show(self, *, visible: bool) -> None:
        """Show or hide the controls of the final joint positions."""
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

    async def _on_field(self, event: Any) -> None:
        if event.client is not None:  # Else the page itself wrote the value.
            self._defer(self._on_change)


def move_along(pose: Array, before: Array, after: Array) -> Array:
    """Return a pose (7,) rigidly moved along with another one, from ``before`` to ``after``."""
    turn = quaternion_multiply(after[3:], quaternion_inverse(before[3:]))
    position = after[:3] + matrix_from_quaternion(turn) @ (pose[:3] - before[:3])
    return np.concatenate([position, quaternion_multiply(turn, pose[3:])])


def rpy_from_quaternion(quaternion: Array) -> Array:
    """Return roll, pitch and yaw (3,), the angles about the fixed axes x, y, z, rad.

    Source: `R = Rz(yaw) Ry(pitch) Rx(roll)`, as URDF has it; at a pitch of 90 deg roll is zero.
    """
    x, y, z, w = quaternion
    sine = float(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    if abs(sine) > 1 - 1e-12:
        return np.array([0.0, math.copysign(math.pi / 2, sine), 2 * math.atan2(z, w)])
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, math.asin(sine), yaw])
