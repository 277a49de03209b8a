"""Tasks before goals: approach, capture, detumbling and carrying, with a test as the plant."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from control.flights import refusals
from scipy.spatial.transform import Rotation
from support.executive_loop import (
    AIM,
    PERIOD,
    SHAPE,
    TIP,
    UPRIGHT,
    ExecutiveLoop,
    goal_at,
    planar_manipulator,
)
from support.oracles.integrated import tumbled_body
from support.sentences import assert_one_sentence

from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.servicing import MeasuredTarget, Task
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import BodyMotion, Payload
from spacerobot_ros.model.urdf import parse_robot

URDF = """
<robot name="block">
  <link name="block"><inertial><mass value="10"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="handle"/>
  <joint name="mount" type="fixed"><parent link="block"/><child link="handle"/>
    <origin xyz="-0.3 0 0"/></joint>
</robot>"""
BLOCK = parse_robot(URDF)
NEAR = np.array([1.95, -0.6, 0.0])
"""The root of the block; its handle is 0.3 m nearer."""
HELD = Payload("end_effector", Inertia(10.0, np.array([0.3, 0.0, 0.0]), np.eye(3)))
SETTINGS: dict[str, Any] = {
    "tasks": "approach detumble",
    "target.grapple_frame": "handle",
    "target.standoff": (-0.2, 0.0, 0.0),
    "target.standoff_time": 0.5,
    "target.closing_speed": 0.1,
    "target.horizon": 2.0,
    "target.patience": 0.2,
    "target.timeout": 0.05,
    "detumble.settle_time": 0.03,
    "motion.speed": 0.3,
    "motion.acceleration": 0.2,
    "max_torque": 0.5,
}
PLANNED = {"profile": "planned", "max_force": 4.0, "plan.clearance": 0.0}


class Meeting(ExecutiveLoop):
    """A robot and a block that are where they are put."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{**SETTINGS, **settings})
        self.block, self.drift, self.seen = NEAR.copy(), np.zeros(3), True
        self.executive.servicing.target.describe(BLOCK, "handle")

    def answer(self, ticks: int = 1, **options: Any) -> tuple[Any, Any]:
        for _ in range(ticks):
            self.block = self.block + PERIOD * self.drift
            if self.seen:
                pose = np.concatenate([self.block, UPRIGHT])
                twist = np.concatenate([self.drift, np.zeros(3)])
                time = (self.tick + 1) * PERIOD
                self.executive.servicing.target.measure(time, pose, twist)
            result = super().answer(**options)
        return result

    def capture(self) -> None:
        robot = HELD.attached_to(planar_manipulator())
        self.executive.use_controller(build_controller(robot, self.config), HELD)

    def kinds(self) -> list[str]:
        return [each.kind.value for each in self.events]

    @property
    def contact(self) -> float:
        """Time of contact according to the event of the last approach."""
        found = [each for each in self.events if each.kind is EventKind.APPROACH_STARTED]
        return float(found[-1].about["contact_s"])

    def skip_to(self, time: float) -> None:
        """Show states up to a time, of which most are left out."""
        while (left := round(time / PERIOD) - self.tick) > 0:
            self.tick += min(left, 80) - 1
            self.block = self.block + (min(left, 80) - 1) * PERIOD * self.drift
            self.answer()


def test_tasks_are_named_in_their_order() -> None:
    assert Task.parsed(" detumble  approach ") == (Task.DETUMBLE, Task.APPROACH)
    assert Task.parsed("") == ()
    with pytest.raises(ParameterError) as refused:
        Task.parsed("approach catch")
    assert_one_sentence(str(refused.value), "'catch'", "approach and detumble")


def test_a_target_is_approached_captured_brought_to_rest_and_carried() -> None:
    loop = Meeting()
    loop.answer(2)
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer()
    assert (loop.state, loop.status.task, loop.status.goal_id) == ("tracking", "approach", "5")
    assert_one_sentence(loop.status.message, "Approaching the target", "0.459 m", "contact in")
    assert loop.kinds() == ["goal_accepted", "approach_started"]
    assert {each.goal_id for each in loop.events} == {"5"}
    began = {key: float(text) for key, text in loop.events[1].about.items()}
    assert began["starts_s"] == pytest.approx(0.03)
    assert began["starts_s"] < began["closes_s"] < began["contact_s"] == loop.contact
    # The reference of the end-effector has left the place where it was held.
    loop.answer(40)
    followed = loop.executive.controller.followed.end_effector
    assert followed is not None
    assert 0.001 < np.linalg.norm(followed.position - TIP) < 0.3
    loop.capture()
    loop.rates = np.array([0.03, -0.05])
    loop.answer()
    assert (loop.state, loop.status.task) == ("tracking", "detumble")
    assert_one_sentence(loop.status.message, "Detumbling", "50 mrad/s")
    assert loop.kinds()[2:] == ["detumble_started"]
    assert_one_sentence(loop.events[-1].message, "N m s takes at least")
    assert loop.executive.controller.coming_to_rest
    loop.answer(5)
    loop.rates = np.array([0.001, -0.002])
    loop.answer(3)
    assert loop.status.task == "detumble", "it settles"
    loop.answer()
    assert (loop.state, loop.status.task, loop.status.goal_id) == ("tracking", "", "5")
    assert loop.kinds()[3:] == ["detumbled"]
    about = {key: float(text) for key, text in loop.events[-1].about.items()}
    assert about["took_s"] == pytest.approx(0.06)
    assert about["largest_torque_Nm"] == 0.5
    assert about["shortest_s"] == pytest.approx(about["angular_momentum_Nms"] / 0.5)
    joined = HELD.attached_to(planar_manipulator())
    _, L, _ = joined.momentum(UPRIGHT, SHAPE, np.zeros(3), np.zeros(3), [0.03, -0.05])
    assert about["angular_momentum_Nms"] == pytest.approx(np.linalg.norm(L))
    assert_one_sentence(
        loop.events[-1].message, "came to rest in 0.06 s", f"{about['shortest_s']:.4g} s"
    )
    goal = loop.executive.controller.goal
    assert goal.base is not None
    assert goal.end_effector is not None
    np.testing.assert_allclose(goal.base.position, AIM)
    np.testing.assert_allclose(goal.end_effector.position, TIP + AIM, atol=1e-12)
    assert loop.executive.controller.followed.end_effector is None


def test_a_goal_of_the_end_effector_is_carried_to_where_it_is_given() -> None:
    loop = Meeting(tasks="detumble")
    loop.aim(base=goal_at(AIM, "1"), end_effector=goal_at(TIP - AIM, "1"))
    loop.answer(5)
    assert loop.status.task == ""
    goal = loop.executive.controller.goal.end_effector
    assert goal is not None
    np.testing.assert_allclose(goal.position, TIP - AIM)


def test_a_goal_that_cannot_be_met_after_the_tasks_is_refused_and_not_reached() -> None:
    loop = Meeting(tasks="detumble")
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer()
    loop.place = np.array([0.0, 0.0, 0.5])
    loop.answer(8)
    assert loop.kinds()[-2:] == ["detumbled", "goal_refused"]
    assert "along z" in loop.events[-1].message
    assert (loop.state, loop.status.goal_id) == ("holding", "")


def test_the_reference_meets_the_grapple_frame_with_its_velocity_and_a_miss_has_its_figures() -> (
    None
):
    loop = Meeting()
    loop.drift = np.array([0.01, 0.02, 0.0])
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer()
    loop.skip_to(loop.contact + 0.02)
    followed = loop.executive.controller.followed.end_effector
    assert followed is not None
    np.testing.assert_allclose(followed.position, loop.block - [0.3, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(followed.velocity, loop.drift, atol=1e-9)
    assert loop.status.task == "approach"
    assert "in contact" in loop.executive.servicing.message
    loop.answer(30)
    assert loop.state == "aborted"
    distance = np.linalg.norm(loop.block - [0.3, 0.0, 0.0] - TIP)
    assert_one_sentence(
        loop.status.message,
        "The approach is aborted: the target is missed",
        "22.4 mm/s",
        "within 0.2 s",
    )
    (told,) = re.findall(r"is ([\d.]+) m, 0 rad", loop.status.message)
    assert float(told) == pytest.approx(distance, abs=0.005)
    assert loop.status.goal_id == "5"
    assert loop.kinds()[-1] == "goal_aborted"
    assert loop.executive.controller.followed.end_effector is None
    assert loop.status.task == ""


def test_without_a_target_an_approach_is_refused_and_the_robot_holds() -> None:
    loop = ExecutiveLoop(**SETTINGS)
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(5)
    assert loop.state == "tracking"
    assert loop.status.message == "Approaching the target."
    loop.answer(2)
    (refused,) = refusals(loop.statuses)
    assert_one_sentence(
        refused.message, "The approach is refused: the target is unknown", "'target/odom'"
    )
    assert refused.goal_id == "5"
    loop.answer(3)
    assert loop.state == "holding"
    np.testing.assert_allclose(loop.answer()[0], 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "frame", "x", "mentions"),
    [
        ({}, "ring", NEAR[0], ("no link 'ring'", "'target.grapple_frame'")),
        ({}, "handle", 5.0, ("The approach is refused: the target is out of reach",)),
        (
            {"base_outputs": "x y rz"},
            "handle",
            NEAR[0],
            ("'transposed_jacobian' does not control an end-effector",),
        ),
        # The start is beside the corridor of the target.
        (
            {**PLANNED, "target.corridor_length": 3.0, "target.corridor_angle": 0.2},
            "handle",
            NEAR[0],
            ("refused: at the start", "corridor_angle = 0.2 rad", "corridor_length = 3 m"),
        ),
    ],
)
def test_a_target_that_cannot_be_met_is_refused(
    settings: dict[str, Any], frame: str, x: float, mentions: tuple[str, ...]
) -> None:
    loop = Meeting(**settings)
    loop.executive.plan_at_once()
    loop.executive.servicing.target.describe(BLOCK, frame)
    loop.block[0] = x
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(2)
    (refused,) = refusals(loop.statuses)
    assert_one_sentence(refused.message, *mentions)


def test_base_and_arm_are_planned_once_the_rates_of_a_noisy_target_are_averaged() -> None:
    loop = Meeting(**PLANNED, **{"target.detumble": "none", "target.horizon": 9.0})
    loop.executive.plan_at_once()
    loop.aim(base=goal_at(AIM, "5"))
    loop.seen, rng, pose = False, np.random.default_rng(2), np.concatenate([NEAR, UPRIGHT])
    for _ in range(110):
        time, noise = (loop.tick + 1) * PERIOD, 0.02 * rng.normal(size=6)
        loop.executive.servicing.target.measure(time, pose, noise)
        loop.answer()
    assert loop.kinds() == ["goal_accepted", "approach_started"]
    assert float(loop.events[-1].about["starts_s"]) == pytest.approx(100 * PERIOD)


def test_a_target_that_is_not_seen_any_more_is_lost() -> None:
    loop = Meeting()
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(3)
    loop.seen = False
    loop.answer(5)
    assert loop.state == "tracking"
    loop.answer()
    assert loop.state == "aborted"
    assert_one_sentence(loop.status.message, "aborted: the target is lost", "0.06 s old")


def test_a_target_that_strays_is_approached_anew_and_one_that_leaves_is_given_up() -> None:
    loop = Meeting()
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(3)
    loop.block[0] += 0.019
    loop.answer()
    assert loop.kinds().count("approach_started") == 1
    loop.block[0] += 0.002
    loop.answer()
    assert loop.kinds().count("approach_started") == 2
    loop.block[0] += 3.0
    loop.answer()
    assert loop.state == "aborted"
    assert_one_sentence(loop.status.message, "aborted: the target is out of reach")


def test_an_approach_goes_on_if_no_plan_for_a_deviation_at_contact_is_found() -> None:
    """According to its rates the target leaves, but it is where it was predicted to be."""
    loop = Meeting()
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(3)
    loop.seen = False
    pose, rates = np.concatenate([loop.block, UPRIGHT]), np.array([9.0, 0, 0, 0, 0, 0])
    while (loop.tick + 1) * PERIOD < loop.contact - 0.1:
        loop.executive.servicing.target.measure((loop.tick + 1) * PERIOD, pose, rates)
        loop.answer()
        assert loop.state == "tracking"
    assert loop.tick > 110, "the rates are averaged over 100 measurements"
    assert loop.kinds().count("approach_started") == 1


def test_base_and_arm_are_planned_to_a_target_and_anew_if_it_strays() -> None:
    # The robot of the test stays where it is.
    any_error = {"error_margin.position": 0.0, "error_margin.attitude": 0.0}
    loop = Meeting(**PLANNED, **any_error, **{"target.detumble": "none", "target.horizon": 9.0})
    loop.executive.plan_at_once()
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(3)
    assert loop.kinds() == ["goal_accepted", "approach_started"]
    assert_one_sentence(
        loop.events[-1].message, "The base and the end-effector start at", "the plan leaves"
    )
    about = loop.events[-1].about
    assert about["detumble"] == "none"
    # The block of 10 kg does not turn: what is left is that of the robot beside it.
    assert float(about["planned_momentum_Nms"]) > 0.1
    controller, loop.drift = loop.executive.controller, np.array([0.0, 0.01, 0.0])
    loop.answer()
    loop.block[0] += 0.019
    loop.answer()
    assert loop.kinds().count("approach_started") == 1
    loop.block[0] += 0.002
    loop.answer()
    assert loop.kinds().count("approach_started") == 2
    loop.skip_to(loop.contact + 0.05)
    hand = controller.followed.end_effector
    assert hand is not None
    assert hand.position == pytest.approx(loop.block - np.array([0.3, 0.0, 0.0]), abs=1e-4)
    assert hand.velocity == pytest.approx(loop.drift, abs=1e-4)
    # Base and shape go on with the target.
    base = controller.reference_at(loop.tick * PERIOD, controller.law.state).base
    assert base is not None
    assert base.velocity == pytest.approx(loop.drift, abs=1e-4)
    loop.capture()
    loop.answer()
    assert loop.status.task == "", "nothing is detumbled"


def test_detumbling_that_lasts_too_long_is_given_up() -> None:
    loop = Meeting(tasks="detumble", time_limit=0.05)
    loop.rates = np.array([0.3, 0.2])
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(6)
    assert loop.state == "tracking"
    loop.answer()
    assert loop.state == "aborted"
    words = "not at rest after 0.05 s", "0.3 rad/s (detumble.rate: 2 mrad/s)", "speed: 2 mm/s"
    assert_one_sentence(loop.status.message, *words)


def test_a_task_alone_is_reached_and_an_abort_ends_it() -> None:
    loop = Meeting(tasks="")
    loop.answer()
    loop.executive.request(Task.DETUMBLE)
    loop.answer()
    assert (loop.state, loop.status.task, loop.status.goal_id) == ("tracking", "detumble", "")
    loop.answer(5)
    assert (loop.state, loop.status.task) == ("reached", "")
    assert loop.kinds()[-1] == "goal_reached"
    loop.executive.request(Task.APPROACH)
    loop.answer(3)
    assert loop.status.task == "approach"
    loop.executive.abort()
    loop.answer()
    assert (loop.state, loop.executive.servicing.task) == ("aborted", None)
    assert loop.executive.controller.followed.end_effector is None


def test_a_later_goal_replaces_the_one_that_waits_for_the_tasks() -> None:
    loop = Meeting(tasks="detumble")
    loop.rates = np.array([0.1, 0.0])
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(2)
    loop.aim(base=goal_at(-AIM, "6"))
    loop.answer(1)
    assert (loop.status.task, loop.status.goal_id) == ("detumble", "6")
    loop.executive.request(Task.DETUMBLE)
    loop.answer(1)
    accepted = [each.goal_id for each in loop.events if each.kind is EventKind.GOAL_ACCEPTED]
    assert accepted == ["5", "6"]
    loop.rates = np.zeros(2)
    loop.answer(6)
    assert loop.status.goal_id == "6"
    assert [each.goal_id for each in loop.events if each.kind.value == "goal_accepted"] == accepted
    goal = loop.executive.controller.goal.base
    assert goal is not None
    np.testing.assert_allclose(goal.position, -AIM)


@pytest.mark.parametrize("part", ["base", "end_effector"])
def test_a_reset_of_the_plant_begins_with_the_tasks_again(part: str) -> None:
    loop = Meeting(tasks="detumble")
    loop.aim(**{part: goal_at(AIM if part == "base" else TIP - AIM, "5")})
    loop.answer(6)
    assert loop.status.task == ""
    loop.rates = np.array([0.1, 0.0])
    loop.executive.plant_reset()
    loop.answer(2)
    assert (loop.status.task, loop.status.goal_id) == ("detumble", "5")


def test_goals_wait_in_the_file_while_tasks_are_done(file: Any) -> None:
    loop = ExecutiveLoop(goal_file=file, **SETTINGS)
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer()
    assert loop.status.task == "approach"
    assert json.loads(file.read_text())["base"]["id"] == "5"


def test_the_target_is_needed_for_an_approach_alone() -> None:
    loop = Meeting()
    servicing = loop.executive.servicing
    assert servicing.needs_target
    servicing.hold(HELD)
    assert not servicing.needs_target
    assert not Meeting(tasks="detumble").executive.servicing.needs_target


def test_a_measured_target_has_its_twist_in_the_world() -> None:
    target = MeasuredTarget()
    turned = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    target.measure(2.5, np.concatenate([[1, 2, 3], turned]), np.array([1, 0, 0, 0, 2.0, 0]))
    assert target.time == 2.5
    assert target.motion is not None
    np.testing.assert_allclose(target.motion.v, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(target.motion.omega, [-2, 0, 0], atol=1e-15)


def test_a_noisy_target_is_predicted_from_the_average_of_its_momenta() -> None:
    root = parse_robot(URDF.replace('ixx="1"', 'ixx="1.7"').replace('iyy="1"', 'iyy="1.3"'))
    omega = np.array([0.03, -0.01, 0.04])
    free = BodyMotion(np.eye(3), NEAR, np.array([0.002, -0.001, 0.003]), omega)
    times = np.linspace(0.0, 32.0, 3201)
    R, r, _ = tumbled_body(root.bodies[0].inertia, free, times)
    X, rates = R.as_quat(), (R[:-1].inv() * R[1:]).as_rotvec() / 0.01
    rng, target, late = np.random.default_rng(3), MeasuredTarget(), []
    target.describe(root, "handle")
    for k in range(200):
        twist = np.concatenate([Rotation.from_quat(X[k]).inv().apply(free.v), rates[k]])
        target.measure(times[k], np.concatenate([r[k], X[k]]), twist + 1e-3 * rng.normal(size=6))
        (there,), (place,) = target.free_motion(target.time).body_poses([30.0])
        turn = Rotation.from_quat(X[k + 3000]).inv() * Rotation.from_quat(there)
        late.append([np.linalg.norm(place - r[k + 3000]), turn.magnitude()])
    assert np.min(late[0]) > 0.015, "the test is sharp"
    assert np.max(late[100:]) < 0.01
    target.forget_momenta()
    (_,), (place,) = target.free_motion(target.time).body_poses([30.0])
    assert np.linalg.norm(place - r[3199]) > 0.02


@pytest.mark.parametrize("limit", [0.002, 0.0])
def test_the_grasp_takes_no_more_than_its_torque_limit(limit: float) -> None:
    loop = Meeting(**{"tasks": "detumble", "detumble.grapple_torque_limit": limit})
    loop.capture()
    loop.rates = np.array([0.03, -0.05])
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer()
    loop.rates = np.zeros(2)
    loop.answer(5)
    took = float(loop.events[-1].about["grasp_torque_Nm"])
    # With the whole demand the grasp takes more; joints at rest need less.
    assert took > 0.05 if limit == 0.0 else took < 0.05


def test_drift_is_no_rest_where_thrusters_could_end_it() -> None:
    loop = Meeting(tasks="detumble")
    loop.velocity = np.array([0.003, 0.0, 0.0])
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(10)
    assert loop.status.task == "detumble"
    loop.velocity = np.array([0.0015, 0.0, 0.0])
    loop.answer(5)
    assert loop.status.task == ""


def test_rest_is_what_the_parameters_say() -> None:
    settings = {"detumble.rate": 0.021, "detumble.speed": 0.01, "detumble.settle_time": 0.05}
    loop = Meeting(tasks="detumble", **settings)
    loop.rates, loop.velocity = np.array([0.02, 0.0]), np.array([0.003, 0.0, 0.0])
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(5)
    assert loop.status.task == "detumble"
    loop.answer(2)
    assert loop.status.task == ""


@pytest.mark.parametrize(("clearance", "state"), [(0.0, "tracking"), (0.02, "holding")])
def test_an_approach_keeps_its_clearance_from_the_target_or_is_refused(
    clearance: float, state: str
) -> None:
    ball = '<collision><geometry><sphere radius="0.5"/></geometry></collision></link>'
    loop = Meeting(**{"target.clearance": clearance})
    round_block = parse_robot(URDF.replace("</inertial></link>", f"</inertial>{ball}"))
    loop.executive.servicing.target.describe(round_block, "handle")
    loop.answer(2)
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer(3)
    assert loop.state == state
    refused = "link 'end_effector' would touch 'block' of the target"
    assert any(refused in said.message for said in loop.statuses) == bool(clearance)
