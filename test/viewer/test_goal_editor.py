"""The goal on the page: what is sent of what users have set, and when it is checked anew."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import robot_file
from spacerobot_ros.viewer.goal_editor import GoalEditor
from spacerobot_ros.viewer.reachability import Check, Verdict
from spacerobot_ros.viewer.scene import reach_of
from spacerobot_ros.viewer.server import start_server, stop_server

POSE = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
LATER = 1e9
"""A wall time at which every goal has been at rest."""


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    server = start_server("127.0.0.1", 0)
    yield server
    stop_server(server)


class Editor:
    """The editor of a page, and its user."""

    def __init__(self, server: Any, robot: str) -> None:
        server.gui.reset()
        server.scene.reset()
        self.inbox: SimpleQueue[Any] = SimpleQueue()
        self.refusals: list[str] = []
        self.server = server
        self.editor = GoalEditor(server, self.inbox.put, self.refusals.append)
        self.robot = load_robot(robot_file(robot))
        self.editor.show_robot(self.robot, reach_of(self.robot))

    def set(self, handle: Any, value: Any) -> None:
        """Set a value as a browser does, and let the page take note of it."""
        handle._impl.value = value
        event = type("Event", (), {"target": handle, "client": object()})()
        for callback in handle._impl.update_cb:
            found = callback(event)
            if found is not None:
                asyncio.run_coroutine_threadsafe(found, self.server.get_event_loop()).result(10)
        while not self.inbox.empty():
            self.inbox.get()()

    @property
    def final(self) -> Any:
        return self.editor._final

    def ghost(self) -> list[Array]:
        """Return where the moving links of the ghost are to their parents."""
        assert self.editor._ghost is not None
        return [np.array(frame.position) for frame in self.editor._ghost._moving]


def test_a_goal_ends_in_the_joint_positions_that_are_asked_for(server: Any) -> None:
    page = Editor(server, "sliding_masses")
    q = np.array([0.05, -0.1, 0.15])
    page.editor.place(POSE, None, q, 0.0)
    assert not page.final._enabled.visible, "no planner is there"
    page.editor.show_shape(there=True)
    assert page.final._enabled.visible
    assert not page.final._folder.visible
    goal = page.editor.goals()["base"]
    np.testing.assert_array_equal(goal.position, POSE[:3])
    assert goal.joint_positions is None, "any"
    page.editor.goals_at_rest(LATER)
    # The fields begin where the robot is now.
    page.editor.robot_is_at(POSE, q + 0.02)
    page.set(page.final._enabled, True)
    assert page.final._folder.visible
    shape = page.editor.goals()["base"].joint_positions
    assert shape is not None
    np.testing.assert_allclose(shape, q + 0.02)
    assert page.editor.moving, "another goal is to be checked"
    page.editor.show_check(Check(Verdict.REACHABLE, shape=q))
    page.editor.goals_at_rest(LATER)
    at_rest = page.ghost()
    page.set(page.final._fields[2], -0.2)
    shape = page.editor.goals()["base"].joint_positions
    assert shape is not None
    np.testing.assert_allclose(shape, [0.07, -0.08, -0.2])
    checked = page.editor.goals_at_rest(LATER)
    assert checked is not None
    assert checked["base"].joint_positions is not None
    # The ghost has that shape before it is planned for, whatever the robot does.
    page.editor.robot_is_at(POSE, np.zeros(3))
    moved = [float(np.linalg.norm(a - b)) for a, b in zip(page.ghost(), at_rest, strict=True)]
    np.testing.assert_allclose(moved, [0.02, 0.02, 0.35], atol=1e-9)
    # Without a planner nobody takes it.
    page.editor.show_shape(there=False)
    assert not page.final._folder.visible
    assert page.editor.goals()["base"].joint_positions is None


def test_the_ghost_is_not_drawn_where_the_robot_is(server: Any) -> None:
    page = Editor(server, "sliding_masses")
    q = np.zeros(3)
    page.editor.place(POSE, None, q, 0.0)
    ghost = page.editor._ghost
    assert ghost is not None

    def is_drawn(pose: Array = POSE, q: Array = q) -> bool:
        page.editor.robot_is_at(pose, q)
        return bool(ghost.base.visible)

    assert not is_drawn()
    assert not is_drawn(POSE * [1, 1, 1, -1, -1, -1, -1]), "the same attitude"
    assert is_drawn(POSE + np.eye(7)[0] * 0.1)
    half = np.array([0.0, 0.0, 0.05])
    assert is_drawn(np.concatenate([POSE[:3], np.sin(half), [np.cos(0.05)]])), "0.1 rad"
    page.editor.show_check(Check(Verdict.REACHABLE, shape=np.array([0.0, 0.0, 0.1])))
    assert is_drawn()
    assert not is_drawn(q=np.array([0.0, 0.0, 0.1]))


def test_fields_of_joints_stay_within_their_limits(server: Any) -> None:
    page = Editor(server, "servicer")
    page.editor.show_shape(there=True)
    page.editor.place(POSE, None, np.full(6, 100.0), 0.0)
    page.set(page.final._enabled, True)
    shape = page.editor.goals()["base"].joint_positions
    assert shape is not None
    upper = page.robot.limits("upper")
    assert np.all(shape[np.isfinite(upper)] <= upper[np.isfinite(upper)])
    assert np.all(shape > 0.9 * np.minimum(upper, 100.0)), "nearly at them"
    labels = [field.label for field in page.final._fields]
    assert labels[0] == "shoulder_yaw (rad)"
    # Another robot has fields of its own, and asks for nothing.
    other = load_robot(robot_file("sliding_masses"))
    page.editor.show_robot(other, reach_of(other))
    assert len(page.final._fields) == 3
    assert page.final.positions is None


def test_a_goal_of_the_end_effector_that_appears_is_checked(server: Any) -> None:
    page = Editor(server, "servicer")
    page.editor.place(POSE, None, np.zeros(6), 0.0)
    goals = page.editor.goals_at_rest(LATER)
    assert goals is not None
    assert set(goals) == {"base"}
    assert page.editor.goals_at_rest(LATER) is None, "it is checked once"
    page.editor.add_tool(np.array([1.0, 0, 0, 0, 0, 0, 1]))
    page.editor.show_tool(there=True)
    goals = page.editor.goals_at_rest(LATER)
    assert goals is not None
    assert set(goals) == {"base", "end_effector"}


def test_a_robot_with_other_joints_comes_after_a_goal_was_checked(server: Any) -> None:
    page = Editor(server, "sliding_masses")
    page.editor.place(POSE, None, np.zeros(3), 0.0)
    reachable = Check(Verdict.REACHABLE, "Reachable in 1 s.", 1.0, shape=np.full(3, 0.1))
    page.editor.show_check(reachable)
    bent = page.ghost()
    # The next plan may end in the same sentence, with another shape.
    page.editor.show_check(replace(reachable, shape=np.full(3, 0.2)))
    moved = [float(np.linalg.norm(a - b)) for a, b in zip(page.ghost(), bent, strict=True)]
    np.testing.assert_allclose(moved, 0.1, atol=1e-9)
    server.scene.reset()
    other = load_robot(robot_file("servicer"))
    page.editor.show_robot(other, reach_of(other))
    assert "not checked" in page.editor._verdict.content
    page.editor.place(POSE, None, np.zeros(6), 0.0)
    page.editor.robot_is_at(POSE, np.full(6, 0.1))
    assert len(page.ghost()) == 6
