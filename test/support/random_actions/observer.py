"""All that a stack publishes, checked message by message."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.planner_flight import DECIDED
from support.random_actions.expectations import (
    SECOND,
    Check,
    EventBook,
    GoalCheck,
    Goals,
    LimitCheck,
    MomentumCheck,
    Situation,
    State,
    StatusCheck,
    TimeCheck,
)
from support.random_actions.rest import EnergyCheck, RestCheck
from support.random_actions.setups import CONTROLLER, PLANNER, Setup
from support.ros_harness import DEEP, DEEP_LATCHED, nanoseconds

from spacerobot_ros.events import Event
from spacerobot_ros.simulation.status import PlantStatus

_LAST = 15
"""Actions that are named with a violation."""

_HEARD = 40
"""Messages that are named with it."""


@dataclass
class Figures:
    """What was done and seen."""

    actions: int = 0
    states: int = 0
    samples: int = 0
    stopped: int = 0
    rearmed: int = 0
    goals: int = 0
    recoveries: int = 0
    second_attempts: int = 0
    decisions: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    stacks: int = 0

    def add(self, other: Figures) -> None:
        """Add the figures of one more stack."""
        for each in fields(self):
            setattr(self, each.name, getattr(self, each.name) + getattr(other, each.name))
        self.stacks += 1

    def __str__(self) -> str:
        decided = ", ".join(f"{count} {word}" for word, count in sorted(self.decisions.items()))
        return (
            f"{self.actions} actions, {self.goals} goals ({decided}), {self.states} states, "
            f"{self.samples} compared with Pinocchio, {self.stopped} whose energy may not grow "
            f"({self.rearmed} of them rearmed), {self.recoveries} recoveries "
            f"({self.second_attempts} at the second attempt), {len(self.violations)} violations"
        )


class Observer:
    """Listens to the nodes ``names`` of a stack, and checks every state and every status.

    Violations are told with the ``name`` of the flight.
    """

    def __init__(
        self, node: Node, setup: Setup, names: Iterable[str], name: str, *, real_time: bool
    ) -> None:
        self._node, self._setup, self._real_time = node, setup, real_time
        self.name = name
        self.figures = Figures()
        self.actions: deque[str] = deque(maxlen=_LAST)
        """The last actions, as lines."""
        self._heard: deque[str] = deque(maxlen=_HEARD)
        self.situation = situation = Situation(dict.fromkeys(names, "unconfigured"))
        situation.may_repeat = not real_time
        self.books = {
            each: Goals(repeats=each == CONTROLLER, report=self.violate)
            for each in setup.commanders
        }
        lockstep = not real_time
        self._momentum = MomentumCheck(setup, situation, lockstep=lockstep)
        self.plant_status = StatusCheck(setup, situation, lockstep=lockstep, report=self.violate)
        self._energy = EnergyCheck(setup, situation, lockstep=lockstep)
        self.events = EventBook(self.violate)
        self._checks: list[Check] = [
            TimeCheck(setup, situation),
            self.plant_status,
            LimitCheck(setup, situation, lockstep=lockstep),
            self._momentum,
            GoalCheck(self.books, situation),
            RestCheck(setup, situation, self.books[setup.decider]),
            self._energy,
        ]
        self.state: State | None = None
        """The last one."""
        self.first: State | None = None
        self.parts: dict[str, Any] = {}
        """Messages of the last state by topic."""
        self._subscribe()

    def _subscribe(self) -> None:
        def hear(kind: Any, topic: str, act: Callable[[Any], None], latched: bool = False) -> None:
            qos = DEEP_LATCHED if latched else DEEP
            self._node.create_subscription(kind, topic, act, qos)

        def part(topic: str) -> Callable[[Any], None]:
            def keep(message: Any) -> None:
                self.parts[topic] = message

            return keep

        hear(Clock, "/clock", lambda message: self.parts.clear())
        for topic in ("odom", "odom_true"):
            hear(Odometry, topic, part(topic))
        hear(JointState, "joint_states_true", part("joint_states_true"))
        hear(PoseStamped, "base_pose", part("base_pose"))
        hear(PoseStamped, "end_effector_pose", part("end_effector_pose"))
        for topic in ("momentum", "momentum_expected"):
            hear(Float64MultiArray, topic, part(topic))
        hear(JointState, "joint_states", self._on_joints)
        hear(JointState, "joint_commands", self._on_command)
        if not self._setup.servos:
            hear(WrenchStamped, "base_wrench", self._on_wrench)
        hear(DiagnosticStatus, "plant/status", self._on_plant_status, True)
        hear(DiagnosticStatus, "events", self._on_event)
        for name, topic in ((PLANNER, "planner/status"), (CONTROLLER, "controller/status")):
            if name in self.situation.lifecycle:
                hear(DiagnosticStatus, topic, partial(self._on_status, name), True)

    # -- what is published --------------------------------------------------------------------

    def _on_joints(self, message: JointState) -> None:
        parts = self.parts
        joints = parts.get("joint_states_true", message)
        odom = parts.get("odom_true", parts.get("odom"))
        pose = parts.get("base_pose")
        if odom is None or pose is None or "momentum" not in parts:
            self.violate(f"a state lacks topics: only {', '.join(parts)} are there")
            return
        expected = parts.get("momentum_expected")
        p, o = pose.pose.position, pose.pose.orientation
        v, w = odom.twist.twist.linear, odom.twist.twist.angular
        state = State(
            nanoseconds(message.header.stamp),
            np.array(joints.position),
            np.array(joints.velocity),
            np.array(message.effort),
            np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w]),
            np.array([v.x, v.y, v.z, w.x, w.y, w.z]),
            np.array(parts["momentum"].data),
            None if expected is None else np.array(expected.data),
        )
        self.figures.states += 1
        self.figures.samples = self._momentum.samples
        self.figures.stopped, self.figures.rearmed = self._energy.states, self._energy.rearmed
        rates = " ".join(f"{rate:.3g}" for rate in state.qdot)
        self._heard.append(f"{state.time_ns / SECOND:.9g} s: joints at {rates}")
        before, self.state = self.state, state
        self.first = self.first or state
        for check in self._checks:
            wrong = check.look(state, before)
            if wrong is not None:
                self.violate(wrong)

    def _on_command(self, message: JointState) -> None:
        values = message.velocity if self._setup.servos else message.effort
        words = " ".join(f"{value:.3g}" for value in values)
        stamp = nanoseconds(message.header.stamp) / SECOND
        self._heard.append(f"command for {stamp:.9g} s: {words}")

    def _on_wrench(self, message: WrenchStamped) -> None:
        f, t = message.wrench.force, message.wrench.torque
        stamp = nanoseconds(message.header.stamp)
        self._heard.append(f"wrench for {stamp / SECOND:.9g} s")
        self._momentum.wrenches.setdefault(stamp, np.array([f.x, f.y, f.z, t.x, t.y, t.z]))

    def _on_status(self, name: str, message: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in message.values}
        state, goal_id = values["state"], values.get("goal_id", "")
        book = self.books[name]
        self._heard.append(f"{name}: {state} {goal_id}: {message.message}")
        if state in DECIDED and goal_id not in book.decided:
            self.figures.decisions[state] += 1
        if state == "refused" and name == self._setup.decider:
            self.situation.goals_since_stop.discard(goal_id)
        pursued = book.pursued
        book.on_status(state, goal_id, message.message)
        if pursued and not book.pursued and (state == "aborted" or self._real_time):
            # The joints brake; in real time commands are some ticks on their way.
            self.allow_stop(1.0 if state == "aborted" else 0.0)

    def _on_plant_status(self, message: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in message.values}
        self._heard.append(f"plant: {values['state']}: {message.message}")
        self.plant_status.on_status(PlantStatus.from_values(values, message.message))

    def _on_event(self, message: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in message.values}
        self._heard.append(f"event of {message.name}: {values['event']}: {message.message}")
        self.events.on_event(message.name, Event.from_values(values, message.message))

    def allow_stop(self, seconds: float) -> None:
        """Let joints move for s more, though nothing is to be pursued."""
        ticks = 3 * self._setup.period_ns
        end = self.now_ns + round(seconds * SECOND) + ticks
        self.situation.stopping_until = max(end, self.situation.stopping_until)

    @property
    def now_ns(self) -> int:
        """Time of the last state, ns."""
        return 0 if self.state is None else self.state.time_ns

    def violate(self, sentence: str) -> None:
        """Note a violation, with what was done and heard before."""
        done = "\n".join(f"  {line}" for line in self.actions)
        self.figures.violations.append(
            f"{self.name}, action {self.figures.actions}, {self.now_ns / SECOND:.6g} s: {sentence}"
            f"\nthe last actions:\n{done}\nthe last messages:\n  " + "\n  ".join(self._heard)
        )
