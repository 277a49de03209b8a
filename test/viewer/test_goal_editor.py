"""The goal on the page: what is sent of what users have set, and when it is checked anew."""

from __future__ import annotations

from dataclasses import replace
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.page_elements import Element, Server

from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.resources import robot_file
from spacerobot_ros.viewer.content import COLORS
from spacerobot_ros.viewer.goal_editor import GoalEditor
from spacerobot_ros.viewer.reachability import GoalCheck, Verdict, planned_goal
from spacerobot_ros.viewer.scene import reach_of, wxyz, xyzw

POSE = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
LATER = 1e9
"""A wall time at which every goal has been at rest."""


POSITION, ANGLES, FINAL = "Goal (m)", "Roll, pitch, yaw (deg)", "Final joint positions"
"""Labels of fields."""


class Editor:
    """The editor of a page, and its user."""

    def __init__(self, robot: str) -> None:
        self.server = Server()
        self.inbox: SimpleQueue[Any] = SimpleQueue()
        self.refusals: list[str] = []
        server: Any = self.server
        self.editor = GoalEditor(server, self.inbox.put, self.refusals.append, lambda: None)
        self.robot = load_robot(robot_file(robot))
        self.editor.show_robot(self.robot, reach_of(self.robot))

    def field(self, label: str) -> Element:
        return self.server.gui.named(label)

    def node(self, path: str) -> Element:
        return self.server.scene.named(path)

    def set(self, label: str, value: Any) -> None:
        """Set a value as a browser does, and let the page take note of it."""
        self.field(label).use(self.server, value)
        self.settle()

    def drag(self, path: str, pose: Array) -> None:
        """Move a gizmo as a browser does."""
        gizmo = self.node(path)
        gizmo.position, gizmo.wxyz = pose[:3], wxyz(pose[3:])
        gizmo.use(self.server)
        self.settle()

    def settle(self) -> None:
        while not self.inbox.empty():
            self.inbox.get()()

    @property
    def ends(self) -> list[Element]:
        """The fields of the joint positions at the end."""
        joints = [joint.name for joint in self.robot.movable_joints]
        shown = {each.shown.get("hint"): each for each in self.server.gui.elements}
        return [shown[name] for name in joints if name in shown]

    @property
    def shape(self) -> Array:
        """The joint positions that the goal of the base asks for."""
        shape = self.editor.goals()["base"].joint_positions
        assert shape is not None
        return shape

    def says(self, words: str) -> bool:
        found = self.server.gui.elements
        return any(words in each.content for each in found if each.kind == "add_html")

    def ghost(self) -> list[Array]:
        """Return where the links of the ghost are to their parents."""
        nodes = self.server.scene.elements
        frames = [each for each in nodes if each.kind == "add_frame"]
        return [np.array(each.position) for each in frames if "/ghost/" in each.name]


def test_a_goal_ends_in_the_joint_positions_that_are_asked_for() -> None:
    page = Editor("sliding_masses")
    q = np.array([0.05, -0.1, 0.15])
    page.editor.place(POSE, None, q, 0.0)
    assert not page.field(FINAL).visible, "no planner is there"
    page.editor.show_parts(tool=None, planned=True, flies=False)
    assert page.field(FINAL).visible
    assert not page.field("At the end").visible
    goal = page.editor.goals()["base"]
    np.testing.assert_array_equal(goal.position, POSE[:3])
    assert goal.joint_positions is None, "any"
    page.editor.settled_goals(LATER)
    # The fields begin where the robot is now.
    page.editor.update_robot(POSE, q + 0.02)
    page.set(FINAL, True)
    assert page.field("At the end").visible
    np.testing.assert_allclose(page.shape, q + 0.02)
    assert page.editor.moving, "another goal is to be checked"
    page.editor.show_check(GoalCheck(Verdict.REACHABLE, shape=q))
    page.editor.settled_goals(LATER)
    at_rest = page.ghost()
    page.set(page.ends[2].label, -0.2)
    np.testing.assert_allclose(page.shape, [0.07, -0.08, -0.2])
    checked = page.editor.settled_goals(LATER)
    assert checked is not None
    assert checked["base"].joint_positions is not None
    # The ghost has that shape before it is planned for, whatever the robot does.
    page.editor.update_robot(POSE, np.zeros(3))
    moved = [float(np.linalg.norm(a - b)) for a, b in zip(page.ghost(), at_rest, strict=True)]
    np.testing.assert_allclose(moved, [0.02, 0.02, 0.35], atol=1e-9)
    # Without a planner nobody takes it.
    page.editor.show_parts(tool=None, planned=False, flies=False)
    assert not page.field("At the end").visible
    assert page.editor.goals()["base"].joint_positions is None


def test_a_goal_that_is_moved_is_sent_as_it_is_shown() -> None:
    page = Editor("sliding_masses")
    page.editor.place(POSE, None, np.zeros(3), 0.0)
    turn = Rotation.from_euler("xyz", [12.3456, -7.891, 33.3333], degrees=True)
    page.drag("/goal", np.array([0.818265, -1.23456, 0.1, *turn.as_quat()]))
    goal, fields = page.editor.goals()["base"], (page.field(POSITION), page.field(ANGLES))
    assert [each.precision for each in fields] == [4, 2], "so many decimals are seen"
    assert tuple(goal.position) == fields[0].value == (0.8183, -1.2346, 0.1)
    assert fields[1].value == (12.35, -7.89, 33.33)
    angles = Rotation.from_quat(goal.quaternion).as_euler("xyz", degrees=True)
    np.testing.assert_allclose(angles, fields[1].value, atol=1e-9)


def test_the_ghost_is_not_drawn_where_the_robot_is() -> None:
    page = Editor("sliding_masses")
    q = np.zeros(3)
    page.editor.place(POSE, None, q, 0.0)
    ghost = page.node("/goal/ghost")

    def is_drawn(pose: Array = POSE, q: Array = q) -> bool:
        page.editor.update_robot(pose, q)
        return bool(ghost.visible)

    assert not is_drawn()
    assert not is_drawn(POSE * [1, 1, 1, -1, -1, -1, -1]), "the same attitude"
    assert is_drawn(POSE + np.eye(7)[0] * 0.1)
    # Rounding makes a quaternion longer than one, and no cosine of an angle.
    assert not is_drawn(POSE * [1, 1, 1, *[1 + 1e-12] * 4])
    half = np.array([0.0, 0.0, 0.05])
    assert is_drawn(np.concatenate([POSE[:3], np.sin(half), [np.cos(0.05)]])), "0.1 rad"
    page.editor.show_check(GoalCheck(Verdict.REACHABLE, shape=np.array([0.0, 0.0, 0.1])))
    assert is_drawn()
    assert not is_drawn(q=np.array([0.0, 0.0, 0.1]))


def test_fields_of_joints_stay_within_their_limits() -> None:
    page = Editor("servicer")
    page.editor.show_parts(tool=None, planned=True, flies=False)
    page.editor.place(POSE, None, np.full(6, 100.0), 0.0)
    page.set(FINAL, True)
    shape, upper = page.shape, page.robot.limits("upper")
    assert np.all(shape[np.isfinite(upper)] <= upper[np.isfinite(upper)])
    assert np.all(shape > 0.9 * np.minimum(upper, 100.0)), "nearly at them"
    labels = [field.label for field in page.ends]
    assert labels[0] == "shoulder_yaw (rad)"
    # Another robot has fields of its own, and asks for nothing.
    other = load_robot(robot_file("sliding_masses"))
    page.editor.show_robot(other, reach_of(other))
    page.robot = other
    assert len(page.ends) == 3
    assert page.field(FINAL).value is False


def test_a_goal_of_the_end_effector_that_appears_is_checked() -> None:
    page = Editor("servicer")
    page.editor.place(POSE, None, np.zeros(6), 0.0)
    goals = page.editor.settled_goals(LATER)
    assert goals is not None
    assert set(goals) == {"base"}
    assert page.editor.settled_goals(LATER) is None, "it is checked once"
    page.editor.show_parts(tool=np.array([1.0, 0, 0, 0, 0, 0, 1]), planned=False, flies=False)
    goals = page.editor.settled_goals(LATER)
    assert goals is not None
    assert set(goals) == {"base", "end_effector"}


def test_a_robot_with_other_joints_comes_after_a_goal_was_checked() -> None:
    page = Editor("sliding_masses")
    page.editor.place(POSE, None, np.zeros(3), 0.0)
    reachable = GoalCheck(Verdict.REACHABLE, "Reachable in 1 s.", shape=np.full(3, 0.1))
    page.editor.show_check(reachable)
    bent = page.ghost()
    # The next plan may end in the same sentence, with another shape.
    page.editor.show_check(replace(reachable, shape=np.full(3, 0.2)))
    moved = [float(np.linalg.norm(a - b)) for a, b in zip(page.ghost(), bent, strict=True)]
    np.testing.assert_allclose(moved, 0.1, atol=1e-9)
    page.server.scene.reset()
    other = load_robot(robot_file("servicer"))
    page.editor.show_robot(other, reach_of(other))
    assert page.says("not checked")
    page.editor.place(POSE, None, np.zeros(6), 0.0)
    page.editor.update_robot(POSE, np.full(6, 0.1))
    assert len(page.ghost()) == len(other.links) - 1


HANDS = ("left_link_7", "right_link_7")
TURNED = np.array([0.5, -0.1, 0.7, 0.5])
STANDING = np.array([1.0, -2.0, 0.5, *TURNED])


@pytest.fixture
def two_hands() -> Editor:
    """The editor of a robot with two arms, whose planner takes goals of both hands."""
    page = Editor("dual_arm")
    page.editor.offer_end_effectors(HANDS)
    page.editor.place(STANDING, None, np.linspace(0.1, 0.7, 14), 0.0)
    page.editor.show_parts(tool=None, planned=True, flies=False)
    return page


def where(page: Editor, link: str) -> Array:
    """Return the pose (7,) of a link by Pinocchio."""
    oracle = PinocchioOracle(page.robot.urdf, page.robot.joint_names)
    R, r = oracle.link_pose(link, np.linspace(0.1, 0.7, 14), STANDING)
    return np.concatenate([r, Rotation.from_matrix(R).as_quat()])


def gizmo(page: Editor, link: str) -> Any:
    return page.node(f"/end_effector_goals/{link}")


def test_a_goal_of_a_hand_begins_where_the_hand_is_and_leaves_the_base_free(
    two_hands: Editor,
) -> None:
    page = two_hands
    assert page.field("Goal for").visible
    assert all(page.field(part).visible for part in ("base", *HANDS))
    assert set(page.editor.goals()) == {"base"}
    page.set(HANDS[1], "position")
    goals = page.editor.goals()
    assert set(goals) == {HANDS[1]}
    assert goals[HANDS[1]].base == frozenset()
    (aim,) = goals[HANDS[1]].end_effectors
    at = where(page, HANDS[1])
    assert (aim.link, aim.quaternion) == (HANDS[1], None)
    np.testing.assert_allclose(aim.position, at[:3], atol=1e-12)
    base, hand = page.node("/goal"), gizmo(page, HANDS[1])
    assert base.disable_axes and base.disable_sliders and base.disable_rotations  # noqa: PT018
    assert hand.visible
    assert hand.disable_rotations
    # Its numbers are those on the page, and typed ones move it.
    np.testing.assert_allclose(page.field(POSITION).value, at[:3], atol=1e-4)
    assert not page.field(ANGLES).visible
    page.set(POSITION, (0.5, 0.25, -0.75))
    np.testing.assert_allclose(hand.position, (0.5, 0.25, -0.75))
    (aim,) = page.editor.goals()[HANDS[1]].end_effectors
    np.testing.assert_allclose(aim.position, (0.5, 0.25, -0.75))
    # With an attitude, and where the gizmo is.
    page.set(HANDS[1], "pose")
    assert page.field(ANGLES).visible
    assert not hand.disable_rotations
    page.set(ANGLES, (10.0, -20.0, 30.0))
    (aim,) = page.editor.goals()[HANDS[1]].end_effectors
    np.testing.assert_allclose(aim.position, (0.5, 0.25, -0.75))
    assert aim.quaternion is not None
    wanted = Rotation.from_euler("xyz", (10.0, -20.0, 30.0), degrees=True).as_quat()
    np.testing.assert_allclose(aim.quaternion, wanted, atol=1e-12)
    # No goal of the hand: that of the base again.
    page.set(HANDS[1], "free")
    assert set(page.editor.goals()) == {"base"}
    assert not hand.visible
    assert not base.disable_axes
    assert page.field(ANGLES).visible
    np.testing.assert_allclose(page.field(POSITION).value, STANDING[:3])
    # Asked for again it begins at the hand.
    page.set(HANDS[1], "position")
    np.testing.assert_allclose(hand.position, at[:3], atol=1e-12)


def test_a_goal_may_be_of_both_hands_and_of_the_base(two_hands: Editor) -> None:
    page = two_hands
    page.set(HANDS[0], "pose")
    assert not page.field("Numbers of").visible, "one part has numbers"
    page.set(HANDS[1], "position")
    goals = page.editor.goals()
    assert set(goals) == set(HANDS)
    left, right = (goals[link].end_effectors[0] for link in HANDS)
    np.testing.assert_allclose(left.values, where(page, HANDS[0]), atol=1e-12)
    np.testing.assert_allclose(right.values, where(page, HANDS[1])[:3], atol=1e-12)
    assert page.field("Numbers of").visible
    numbers = page.field("Numbers of")
    assert (numbers.options, numbers.value) == (HANDS, HANDS[1])
    page.set("Numbers of", HANDS[0])
    np.testing.assert_allclose(page.field(POSITION).value, left.position, atol=1e-4)
    page.set("base", "pose")
    assert set(page.editor.goals()) == {"base", *HANDS}
    assert numbers.value == "base"
    goal = planned_goal(page.editor.goals())
    assert goal.base == {"position", "attitude"}
    assert [each.link for each in goal.end_effectors] == list(HANDS)
    np.testing.assert_array_equal(goal.position, STANDING[:3])
    # A change of a hand leaves the base as users chose.
    page.set(HANDS[0], "position")
    assert set(page.editor.goals()) == {"base", *HANDS}
    # The base moves alone: hands are in the world.
    page.drag("/goal", STANDING + np.eye(7)[1])
    np.testing.assert_allclose(gizmo(page, HANDS[0]).position, left.position)
    page.set("base", "free")
    assert set(page.editor.goals()) == set(HANDS)
    for link in HANDS:
        page.set(link, "free")
    assert page.refusals == []
    page.set("base", "free")
    assert page.refusals == ["A goal is for the base or for an end-effector: choose one of them."]
    assert set(page.editor.goals()) == {"base"}


def test_the_ghost_of_a_free_base_is_where_the_plan_ends(two_hands: Editor) -> None:
    page, q = two_hands, np.linspace(0.1, 0.7, 14)
    ghost = page.node("/goal/ghost")
    page.set(HANDS[0], "position")
    # Off the robot, so that the ghost's place in the gizmo is not the place in the world.
    turn = Rotation.from_euler("xyz", [40.0, -20.0, 70.0], degrees=True)
    page.drag("/goal", np.array([5.0, 5.0, 5.0, *turn.as_quat()]))
    page.editor.show_check(GoalCheck(Verdict.PLANNING, "Planning for 2 s."))
    assert not ghost.visible, "nothing is predicted"
    end = np.array([1.5, -2.25, 0.5, *TURNED[[1, 0, 3, 2]]])
    page.editor.show_check(GoalCheck(Verdict.REACHABLE, shape=q + 0.1, base=end))
    assert ghost.visible
    R = matrix_from_quaternion(xyzw(page.node("/goal").wxyz))
    seen = page.node("/goal").position + R @ ghost.position
    np.testing.assert_allclose(seen, end[:3], atol=1e-12)
    turned = R @ matrix_from_quaternion(xyzw(ghost.wxyz))
    np.testing.assert_allclose(turned, matrix_from_quaternion(end[3:]), atol=1e-12)
    mark = page.node(f"/end_effector_goals/{HANDS[0]}/mark")
    assert mark.color == COLORS[Verdict.REACHABLE]
    # Where the robot is then, it is not drawn; and a base with a goal is drawn there.
    page.editor.update_robot(end, q + 0.1)
    assert not ghost.visible
    page.set("base", "pose")
    page.editor.update_robot(end, q + 0.1)
    assert ghost.visible
    np.testing.assert_allclose(ghost.position, 0.0, atol=1e-12)


def test_hands_are_offered_while_a_planner_is_there(two_hands: Editor) -> None:
    page = two_hands
    page.set(HANDS[0], "position")
    shape = np.full(14, 0.5)
    page.editor.show_parts(tool=None, planned=True, flies=False)
    page.set(FINAL, True)
    for field, position in zip(page.ends, shape, strict=True):
        field.value = position
    asked = page.editor.goals()[HANDS[0]].joint_positions
    assert asked is not None
    np.testing.assert_array_equal(asked, shape)
    page.editor.show_parts(tool=None, planned=False, flies=False)
    assert not page.field("Goal for").visible
    assert not gizmo(page, HANDS[0]).visible
    assert set(page.editor.goals()) == {"base"}
    page.editor.show_parts(tool=None, planned=True, flies=False)
    assert set(page.editor.goals()) == {HANDS[0]}, "as it was chosen"
    assert gizmo(page, HANDS[0]).visible
    # A recording takes no goals; after it everything is as before.
    page.editor.show(visible=False)
    assert not gizmo(page, HANDS[0]).visible
    page.editor.show(visible=True)
    assert gizmo(page, HANDS[0]).visible
    assert not page.field(ANGLES).visible
    # Goals go to the robot, all of them.
    page.drag(f"/end_effector_goals/{HANDS[0]}", STANDING)
    page.editor.place(STANDING, None, np.linspace(0.1, 0.7, 14), 0.0)
    np.testing.assert_allclose(
        gizmo(page, HANDS[0]).position, where(page, HANDS[0])[:3], atol=1e-12
    )
    # The same planner again, and one that takes no goals of hands.
    page.editor.offer_end_effectors(HANDS)
    assert set(page.editor.goals()) == {HANDS[0]}
    page.editor.settled_goals(LATER)
    page.editor.offer_end_effectors(())
    assert page.editor.moving, "the goal is another one"
    page.editor.show_parts(tool=None, planned=True, flies=False)
    assert not page.field("Goal for").visible
    assert not gizmo(page, HANDS[0]).visible
    assert set(page.editor.goals()) == {"base"}


# -- goals of others ------------------------------------------------------------------------------


def base_goal(*numbers: float) -> Goal:
    return Goal.checked(list(numbers), [0.0, 0.0, 0.0, 1.0])


def test_a_goal_that_others_send_is_shown_and_one_that_a_user_changes_stays() -> None:
    page = Editor("sliding_masses")
    editor = page.editor
    editor.follow({"base": base_goal(1.0, 2.0, 3.0)}, 0.0)
    assert not editor.placed, "there is no robot yet"
    editor.place(POSE, None, np.zeros(3), 0.0)
    assert not editor.shows_sent_goal
    editor.follow({}, 1.0)
    np.testing.assert_array_equal(editor.goals()["base"].position, POSE[:3])
    sent = {"base": base_goal(1.0, 2.0, 3.0)}
    editor.follow(sent, 2.0)
    assert editor.shows_sent_goal
    np.testing.assert_array_equal(editor.goals()["base"].position, [1.0, 2.0, 3.0])
    assert page.field(POSITION).value == (1.0, 2.0, 3.0)
    assert editor.settled_goals(LATER) is not None, "it is checked"
    # A user's change is not lost, until it is sent.
    page.set(POSITION, (0.5, 0.0, 0.0))
    assert not editor.shows_sent_goal
    editor.follow({"base": base_goal(7.0, 8.0, 9.0)}, 3.0)
    np.testing.assert_array_equal(editor.goals()["base"].position, [0.5, 0.0, 0.0])
    editor.note_sent()
    assert editor.shows_sent_goal
    editor.follow({"base": base_goal(7.0, 8.0, 9.0)}, 4.0)
    np.testing.assert_array_equal(editor.goals()["base"].position, [7.0, 8.0, 9.0])
    # The same goal is followed once: the goal can be put back to the robot.
    editor.place(POSE, None, np.zeros(3), 5.0)
    editor.follow({"base": base_goal(7.0, 8.0, 9.0)}, 6.0)
    np.testing.assert_array_equal(editor.goals()["base"].position, POSE[:3])


def test_goals_of_links_that_others_send_are_shown_with_their_parts() -> None:
    page = Editor("three_joint_arm")
    editor, link = page.editor, page.robot.links[-1].name
    editor.place(POSE, None, np.zeros(3), 0.0)
    aim = EndEffectorGoal.checked(link, [1.0, 2.0, 3.0])
    sent = {link: Goal.of_end_effectors([aim])}
    editor.follow(sent, 1.0)
    assert set(editor.goals()) == {"base"}, "the page offers no goals of links yet"
    editor.offer_end_effectors([link])
    editor.show_parts(tool=None, planned=True, flies=False)
    editor.follow(sent, 2.0)
    found = editor.goals()
    assert set(found) == {link}
    (shown,) = found[link].end_effectors
    np.testing.assert_array_equal(shown.position, aim.position)
    assert shown.quaternion is None
    assert page.field("Numbers of").value == link
    assert page.field(POSITION).value == (1.0, 2.0, 3.0)
    assert gizmo(page, link).visible
    both = {
        link: Goal.of_end_effectors([EndEffectorGoal.checked(link, [0, 1, 2, 0, 0, 0.6, 0.8])]),
        "base": base_goal(0.5, 0.0, 0.0),
    }
    editor.follow(both, 3.0)
    found = editor.goals()
    turned = found[link].end_effectors[0].quaternion
    assert turned is not None
    np.testing.assert_allclose(turned, np.array([0.0, 0.0, 0.6, 0.8]))
    np.testing.assert_array_equal(found["base"].position, [0.5, 0.0, 0.0])


def test_the_ghost_stands_where_the_robot_will_end() -> None:
    page = Editor("three_joint_arm")
    editor = page.editor
    editor.place(POSE, None, np.zeros(3), 0.0)
    page.set(POSITION, (1.0, 0.0, 0.0))
    end = np.array([0.2, 0.1, 0.3, 0.0, 0.0, 0.6, 0.8])
    editor.show_check(GoalCheck(Verdict.PARTLY, shape=np.full(3, 0.1), base=end))
    gizmo, ghost = page.node("/goal"), page.node("/goal/ghost")
    # The ghost hangs on the gizmo, which stays at the goal.
    np.testing.assert_array_equal(gizmo.position, [1.0, 0.0, 0.0])
    R = matrix_from_quaternion(xyzw(gizmo.wxyz))
    np.testing.assert_allclose(gizmo.position + R @ ghost.position, end[:3], atol=1e-12)
    turned = Rotation.from_matrix(R) * Rotation.from_quat(xyzw(ghost.wxyz))
    np.testing.assert_allclose(turned.as_quat(), end[3:], atol=1e-12)
    solids = [each for each in page.server.scene.elements if each.kind == "add_mesh_simple"]
    assert {each.color for each in solids} == {COLORS[Verdict.PARTLY]}
    assert len({*COLORS.values()}) == len(COLORS)
    page.set(POSITION, (0.9, 0.0, 0.0))
    np.testing.assert_allclose(ghost.position, 0.0, atol=1e-12)
