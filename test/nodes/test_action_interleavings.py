"""Random interleavings of goals by actions and topics, aborts, cancellations and transitions.

Every goal of an action ends in exactly one result, which is the status that decides it; `make
action-interleavings` does many. They run where the packages of interfaces are built.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.action_clients import Sender, SentGoal
from support.planner_flight import PLANNER, PLANT, values_of
from support.ros_harness import DEEP_LATCHED, Harness, Probe

from spacerobot_ros.nodes import CoordinatedControlNode, PlannerNode, PlantNode
from spacerobot_ros.nodes.common.fly_to import action_class

FLY_TO = action_class("spacerobot_msgs", "FlyTo")
NAVIGATE = action_class("nav2_msgs", "NavigateToPose")

COUNT = int(os.environ.get("SPACEROBOT_INTERLEAVINGS", "24"))
SEED = int(os.environ.get("SPACEROBOT_INTERLEAVINGS_SEED", "1"))
PART = 14
"""Number of interleavings with the nodes of one process.

Subscriptions that begin after 5000 states of a plant in their process get none of them.
"""

STEPS = 8
"""Number of actions of one interleaving."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(FLY_TO is None or NAVIGATE is None, reason="the packages are not built"),
]


@dataclass(frozen=True)
class Kind:
    """A kind of stack: the class of its commander, parameters, and goals near the start.

    Attributes
    ----------
    commander, settings, plant, status_topic
        Class, parameters of commander and plant, and the topic of statuses.
    shape
        Joint positions at the start, by name.
    end_effector
        Where the end-effector is then, with the base at the origin; empty: goals are for the base.
    attitude
        Whether goals of the end-effector have one.
    planar
        Whether the robot moves in a plane.
    """

    commander: type[Any]
    settings: dict[str, Any]
    plant: dict[str, Any]
    status_topic: str = "planner/status"
    shape: Mapping[str, float] = field(default_factory=dict)
    end_effector: tuple[float, ...] = ()
    attitude: bool = False
    planar: bool = False


STACKS = {
    "planner": Kind(PlannerNode, PLANNER, PLANT),
    "planner_in_background": Kind(PlannerNode, {**PLANNER, "plan_in_background": True}, PLANT),
    "planner_of_an_arm": Kind(
        PlannerNode,
        {
            "robot": "three_joint_arm",
            "tick_rate": 20.0,
            "method": "optimal",
            "end_effectors": ["end_effector"],
            "optimal.answers": 1,
            "optimal.intervals": 30,
            "optimal.cache": 0,
        },
        {**PLANT, "robot": "three_joint_arm", "initial_joint_positions": [0.4, -0.9, 1.1]},
        shape={"shoulder_yaw": 0.4, "shoulder_pitch": -0.9, "elbow_pitch": 1.1},
        end_effector=(1.48, 0.62, 1.38),
    ),
    "controller": Kind(
        CoordinatedControlNode,
        {
            "robot": "planar_manipulator",
            "tick_rate": 50.0,
            "settle_time": 0.1,
            "time_limit": 2.0,
            "status_period": 0.5,
        },
        {
            **PLANT,
            "robot": "planar_manipulator",
            "actuation": "effort",
            "tick_rate": 50.0,
            "initial_joint_positions": [0.7, -1.1],
        },
        "controller/status",
        shape={"shoulder": 0.7, "elbow": -1.1},
        end_effector=(2.19, 0.25, 0.0),
        attitude=True,
        planar=True,
    ),
}


class Interleaving:
    """A stack with clients of its actions, and random actions of operators."""

    def __init__(self, harness: Harness, name: str, seed: int) -> None:
        self.harness, self.random = harness, random.Random(seed)
        self.kind = STACKS[name]
        self.plant = harness.make(PlantNode, self.kind.plant)
        self.node = harness.make(self.kind.commander, self.kind.settings, name="commander")
        self.status_topic = self.kind.status_topic
        self.probe: Probe = harness.probe(
            {"odom": Odometry, "joint_states": JointState, self.status_topic: DiagnosticStatus}
        )
        self.goals = [self.probe.create_publisher(PoseStamped, "goal_pose", DEEP_LATCHED)]
        if self.kind.end_effector:
            topic = "end_effector/goal_pose"
            self.goals.append(self.probe.create_publisher(PoseStamped, topic, DEEP_LATCHED))
        self.abort = self.probe.create_client(Trigger, "commander/abort")
        self.senders = [
            Sender(harness, self.probe, FLY_TO, "commander/fly_to"),
            Sender(harness, self.probe, NAVIGATE, "commander/navigate_to_pose"),
        ]
        self.topic_goals = 0
        self.kinds: Counter[str] = Counter()
        """How many goals of each kind of FlyTo, and of NavigateToPose, were sent."""
        self.sent: list[tuple[SentGoal, bool]] = []
        """The goals of this interleaving, and whether they were cancelled."""
        harness.connect()
        for sender in self.senders:
            sender.connect()
        self.ticks(2)

    def ticks(self, count: int) -> None:
        wanted = self.probe.count("joint_states") + count
        if self.node.is_active:
            self.harness.spin_until(
                lambda: self.probe.count("joint_states") >= wanted, f"{count} ticks"
            )

    def pose(self, near: Sequence[float] = (0.0, 0.0, 0.0), *, turned: bool = True) -> PoseStamped:
        """Return a pose near a place; one that is not turned has a quaternion of zeros."""
        message = PoseStamped()
        message.header.frame_id = self.random.choice(["world", "world", "world", "moon"])
        p, o = message.pose.position, message.pose.orientation
        r = [self.random.uniform(-0.03, 0.03) for _ in range(3)]
        turn = [0.0, 0.0, 0.02 * r[0]]
        if self.kind.planar:
            r[2] = 0.0
        p.x, p.y, p.z = (x + dx for x, dx in zip(near, r, strict=True))
        o.x, o.y, o.z, o.w = Rotation.from_rotvec(turn).as_quat().tolist() if turned else [0.0] * 4
        return message

    def goal(self) -> dict[str, Any]:
        """Return the poses and joint positions of a goal of FlyTo, of any kind."""
        kinds = ["base"]
        if self.kind.end_effector:
            kinds += ["end_effector", "base_and_joints"]
        kind = self.random.choice(kinds)
        self.kinds[kind] += 1
        if kind == "end_effector":
            pose = self.pose(self.kind.end_effector, turned=self.kind.attitude)
            name = self.random.choice(["end_effector", ""])
            return {"end_effectors": [name], "end_effector_poses": [pose]}
        fields: dict[str, Any] = {"base_pose": [self.pose()]}
        if kind == "base_and_joints":
            shape = {
                name: q + self.random.uniform(-0.2, 0.2) for name, q in self.kind.shape.items()
            }
            names = self.random.sample(list(shape), len(shape))
            fields["joint_positions"] = JointState(name=names, position=[shape[n] for n in names])
        return fields

    def send_action(self) -> None:
        sender = self.random.choice(self.senders)
        if sender.kind is FLY_TO:
            fields = self.goal()
            if self.random.random() < 0.6:
                fields |= {"position_tolerance": 0.02, "attitude_tolerance": 0.02}
            if self.random.random() < 0.3:
                fields["time_limit"] = Duration(nanosec=self.random.randrange(10**8, 10**9))
        else:
            self.kinds["navigate_to_pose"] += 1
            fields = {"pose": self.pose()}
        sent = sender.post(**fields)
        if self.random.random() < 0.7:
            self.harness.spin_until(lambda: sent.handle is not None, "an answer")
        self.sent.append((sent, False))

    def send_topic(self) -> None:
        self.topic_goals += 1
        topic = self.random.choice(self.goals)
        if topic is self.goals[0]:
            message = self.pose()
        else:
            message = self.pose(self.kind.end_effector, turned=self.kind.attitude)
        message.header.stamp.sec = 1000 + self.topic_goals
        topic.publish(message)

    def request_abort(self) -> None:
        self.harness.call(self.abort, Trigger.Request()) if self.node.takes_goals else None

    def cancel(self) -> None:
        open_goals = [
            i for i, (sent, _) in enumerate(self.sent) if sent.handle is not None and not sent.ended
        ]
        if open_goals:
            i = self.random.choice(open_goals)
            sent, _ = self.sent[i]
            if sent.handle.accepted:
                sent.handle.cancel_goal_async()
                self.sent[i] = sent, True

    def toggle(self) -> None:
        """Deactivate and activate, at times with other states of life in between."""
        self.node.trigger_deactivate()
        deep = self.random.random() < 0.4
        if deep:
            self.node.trigger_cleanup()
            # An events executor that has not run since then may take a new subscription for one
            # that was destroyed.
            self.harness.settle(self.probe)
        for _ in range(self.random.randrange(3)):
            self.random.choice([self.send_action, self.send_topic])()
        if deep:
            self.node.trigger_configure()
            # A command that nobody hears yet would be lost, and time stand still in lockstep.
            self.harness.connect()
        self.node.trigger_activate()

    def run(self) -> Counter[str]:
        """Do random actions, end all goals, and return the counts of their outcomes."""
        self.sent, acts = [], [self.send_action, self.send_topic, self.request_abort]
        acts += [self.send_action, self.send_action, self.cancel, self.toggle]
        self.send_action()
        for _ in range(STEPS):
            self.random.choice(acts)()
            self.ticks(self.random.choice([0, 1, 3, 10, 60]))
        self.harness.spin_until(
            lambda: all(sent.handle is not None for sent, _ in self.sent), "answers"
        )
        # A goal that is on its way may come after an abort.
        self.ticks(3)
        if self.random.random() < 0.5:
            self.request_abort()
        accepted = [each for each in self.sent if each[0].handle.accepted]
        self.harness.spin_until(
            lambda: all(sent.ended for sent, _ in accepted), "every goal has a result", 40.0
        )
        self.ticks(3)
        outcomes = Counter(self.check(*each) for each in accepted)
        outcomes["rejected"] += len(self.sent) - len(accepted)
        return outcomes

    def check(self, sent: SentGoal, cancelled: bool) -> str:
        """Check that a goal has one result, which is its status; return its outcome."""
        assert len(sent.results) == 1
        decided = [
            status
            for status in self.probe.messages[self.status_topic]
            if values_of(status).get("goal_id") == sent.goal_id
            and values_of(status)["state"]
            in ("reached", "reached_partly", "failed", "refused", "aborted")
        ]
        # A controller repeats the state of its goal until there is another one.
        (outcome,) = {values_of(status)["state"] for status in decided}
        first, result = decided[0], sent.result
        if self.status_topic == "planner/status":
            assert len(decided) == 1
        if hasattr(result, "outcome"):
            assert (result.outcome, result.message) == (outcome, first.message)
            reported = values_of(first).get("position_error_m")
            if reported is not None:
                assert result.errors.position == pytest.approx(float(reported), rel=1e-6)
        else:
            told = (0, "") if outcome == "reached" else (9000, first.message)
            assert (result.error_code, result.error_msg) == told
        states = {"reached": {"succeeded"}}.get(outcome, {"aborted"})
        assert sent.state in (states | {"canceled"} if cancelled else states)
        return f"{outcome}{' after a cancellation' if sent.state == 'canceled' else ''}"


@pytest.mark.parametrize("part", range(-(-COUNT // (len(STACKS) * PART))))
@pytest.mark.parametrize("name", list(STACKS))
def test_each_goal_ends_in_one_result_which_is_the_status(
    harness: Harness, name: str, part: int
) -> None:
    interleaving = Interleaving(harness, name, SEED + part)
    outcomes: Counter[str] = Counter()
    for _ in range(PART):
        outcomes += interleaving.run()
    told = ", ".join(str(dict(sorted(each.items()))) for each in (outcomes, interleaving.kinds))
    print(f"\n{name}, {PART} interleavings from {SEED + part}: {told}")
    assert np.all([outcomes[each] for each in ("refused", "aborted")])
