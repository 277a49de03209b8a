"""What the specification demands of all that a stack publishes, whatever operators do to it.

A :class:`Situation` is what they did, as far as services have confirmed it. Checks look at each
state and each status that is published then, in the order of publication. None of them knows how
the nodes work inside.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation
from support.oracles import Array, Motion, PinocchioOracle
from support.planner_flight import DECIDED
from support.random_actions.setups import Setup

from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.simulation.status import PlantState, PlantStatus

SECOND = 10**9


@dataclass(frozen=True)
class State:
    """A state as it was published, the truth where the sensors err: SI units, world W, base B."""

    time_ns: int
    q: Array
    qdot: Array
    effort: Array
    pose: Array
    twist: Array
    momentum: Array
    expected: Array | None

    def equals(self, other: State) -> bool:
        """Whether every true number is the same."""
        pairs = ((self.q, other.q), (self.qdot, other.qdot), (self.pose, other.pose))
        return all(np.array_equal(a, b) for a, b in pairs)


@dataclass
class Disturbance:
    """A fault that was sent: it may act from a time on, s, and until another."""

    kind: str
    target: str
    start: float
    end: float


@dataclass
class Situation:
    """What operators did to the stack.

    Attributes
    ----------
    lifecycle
        ``unconfigured``, ``inactive`` or ``active`` by node.
    paused, latched
        Whether the plant was told so, and has confirmed it.
    resumed, rearmed
        Likewise the opposite: neither is so between a request and its answer.
    stopped_once, goals_since_stop
        Whether the plant was latched, and the goals since then that were not refused.
    status
        What the plant has published last of itself.
    may_repeat, may_jump, may_restart
        Whether the next state may have the time of the last one; then at another place; or the
        time zero. In lockstep a state may be repeated at any time, for a new subscriber.
    stopping_until
        Until when joints may move though nothing is to be pursued, ns.
    disturbances
        Faults that act or may act.
    """

    lifecycle: dict[str, str]
    paused: bool = False
    resumed: bool = True
    latched: bool = False
    rearmed: bool = True
    latched_at: int = -1
    stopped_once: bool = False
    goals_since_stop: set[str] = field(default_factory=set)
    status: PlantStatus = field(default_factory=lambda: PlantStatus(PlantState.INACTIVE))
    may_repeat: bool = False
    may_jump: bool = False
    may_restart: bool = False
    stopping_until: int = -1
    disturbances: list[Disturbance] = field(default_factory=list)

    def acting(self, time_ns: int, period_ns: int, *kinds: str) -> set[str]:
        """Return the targets of faults of these kinds that may have acted up to a time."""
        now, slack = time_ns / SECOND, 2 * period_ns / SECOND
        return {
            d.target
            for d in self.disturbances
            if d.kind in kinds and d.start - slack <= now <= d.end + slack
        }

    @property
    def goal_since_stop(self) -> bool:
        """Whether something may be pursued, since the plant was latched last."""
        return bool(self.goals_since_stop) or not self.stopped_once

    @property
    def active(self) -> bool:
        """Whether every node is active."""
        return all(state == "active" for state in self.lifecycle.values())


class Check(Protocol):
    """Looks at each state; returns what is wrong with it."""

    def look(self, now: State, before: State | None) -> str | None: ...


class TimeCheck:
    """Stamps grow by one tick; they repeat, or begin again, where an operator has caused it."""

    def __init__(self, setup: Setup, situation: Situation) -> None:
        self._period, self._situation = setup.period_ns, situation

    def look(self, now: State, before: State | None) -> str | None:
        situation = self._situation
        if situation.lifecycle["plant"] != "active":
            return f"a state of {now.time_ns} ns by a plant that is {situation.lifecycle['plant']}"
        if before is None or now.time_ns == before.time_ns + self._period:
            return None
        if now.time_ns == 0 and situation.may_restart:
            return None
        if now.time_ns == before.time_ns and (situation.may_repeat or situation.may_jump):
            known = now.equals(before) or situation.may_jump
            return None if known else "the repeated state is another one"
        return f"the stamp goes from {before.time_ns} to {now.time_ns} ns"


class StatusCheck:
    """plant/status says what the plant does, and what operators have made it do.

    In lockstep a plant waits for commands, and never rests without one.
    """

    def __init__(
        self, setup: Setup, situation: Situation, *, lockstep: bool, report: Callable[[str], None]
    ) -> None:
        self._situation, self._lockstep, self._report = situation, lockstep, report
        self.changes: Counter[EventKind] = Counter()
        """What the statuses say has happened."""

    def on_status(self, now: PlantStatus) -> None:
        before, self._situation.status = self._situation.status, now
        if now == before:
            self._report(f"a status that changes nothing: {now}")
        if now.rearms < before.rearms or now.resets < before.resets:
            # Counted from the configuration on.
            if self._situation.lifecycle["plant"] == "active":
                self._report(f"counters run backwards: {now} after {before}")
            before = replace(before, rearms=0, resets=0, latched_fault="")
        if now.latched_fault and not before.latched_fault:
            self.changes[EventKind.LATCHED] += 1
        self.changes[EventKind.REARMED] += now.rearms - before.rearms
        self.changes[EventKind.RESET] += now.resets - before.resets
        if now.state is PlantState.PAUSED and before.state is not PlantState.PAUSED:
            self.changes[EventKind.PAUSED] += 1
        if now.state is PlantState.FAILED:
            self._report(f"the plant has failed: {now.message}")

    def look(self, now: State, before: State | None) -> str | None:
        """Compare the status with the state that is published under it."""
        status = self._situation.status
        if status.state in (PlantState.INACTIVE, PlantState.FAILED):
            return f"a state is published by a plant that says it is {status.state.value}"
        passes = before is not None and now.time_ns > before.time_ns
        if status.state is PlantState.PAUSED and passes:
            return "time goes on though the plant says that it is paused"
        if status.state is PlantState.RESTING and self._lockstep:
            return "a lockstep plant says that it rests"
        return self.agrees()

    def agrees(self) -> str | None:
        """Compare the status with what operators have made the plant do."""
        situation, status = self._situation, self._situation.status
        active = situation.lifecycle["plant"] == "active"
        if situation.latched and not status.latched_fault:
            return f"a latched plant says: {status}"
        if situation.rearmed and status.latched_fault:
            return f"a rearmed plant says: {status}"
        if not active:
            quiet = status.state is PlantState.INACTIVE
            return None if quiet else f"a plant that is not active says: {status}"
        if situation.paused and status.state is not PlantState.PAUSED:
            return f"a paused plant says: {status}"
        if situation.resumed and status.state is PlantState.PAUSED:
            return f"a plant that is not paused says: {status}"
        if situation.latched and situation.resumed and status.state is not PlantState.LATCHED:
            return f"a latched plant says: {status}"
        return None


class EventBook:
    """Every change of state is one event: none is missing, none comes twice."""

    _DECISIONS = (
        EventKind.GOAL_REACHED,
        EventKind.GOAL_REACHED_PARTLY,
        EventKind.GOAL_FAILED,
        EventKind.GOAL_ABORTED,
        EventKind.GOAL_REFUSED,
    )

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self.counts: Counter[EventKind] = Counter()
        """Events of the plant."""
        self.decided: dict[tuple[str, str], EventKind] = {}
        """What became of goals, by node and id."""
        self.accepted: set[tuple[str, str]] = set()

    def on_event(self, name: str, event: Event) -> None:
        node, goal = name.rsplit("/", 1)[-1], (name.rsplit("/", 1)[-1], event.goal_id)
        if node == "plant":
            self.counts[event.kind] += 1
        if event.kind in self._DECISIONS and event.goal_id:
            if goal in self.decided:
                was = self.decided[goal].value
                self._report(f"{node}: goal {event.goal_id} was {was}: {event.message}")
            self.decided[goal] = event.kind
        if event.kind is EventKind.GOAL_ACCEPTED:
            if goal in self.accepted:
                self._report(f"{node}: goal {event.goal_id} is accepted twice")
            if goal in self.decided:
                self._report(f"{node}: goal {event.goal_id} is accepted after its decision")
            self.accepted.add(goal)

    @property
    def undecided(self) -> set[tuple[str, str]]:
        """Goals that were accepted and have no result, by node and id."""
        return self.accepted - set(self.decided)

    def compare(self, changes: Counter[EventKind]) -> str | None:
        """Compare the plant's events with what its statuses say has happened."""
        for kind, count in changes.items():
            if self.counts[kind] != count:
                return f"{self.counts[kind]} events '{kind.value}' for {count} changes"
        return None


class LimitCheck:
    """Joint limits, rate limits of servos and effort limits of motors are kept.

    Motors that are sound keep joints about as slow as their URDF says, whatever is asked. On a busy
    machine commands come late, and what joints do then is what they do.
    """

    MOST = 5.0
    """How many times the rate of the URDF a joint may reach for a moment in lockstep."""

    def __init__(self, setup: Setup, situation: Situation, *, lockstep: bool) -> None:
        robot = setup.model
        self._lower, self._upper = robot.lower, robot.upper
        self._rate, self._effort = robot.velocity_limit, robot.effort_limit
        self._situation, self._recent = situation, 500 * setup.period_ns
        self._servos, self._lockstep = setup.servos, lockstep

    def look(self, now: State, before: State | None) -> str | None:
        numbers = np.concatenate([now.q, now.qdot, now.pose, now.twist, now.momentum, now.effort])
        if not np.all(np.isfinite(numbers)):
            return "a number of the state is not finite"
        if np.any(now.q < self._lower - 1e-9) or np.any(now.q > self._upper + 1e-9):
            return f"joints beyond their limits: {now.q}"
        if self._servos and np.any(np.abs(now.qdot) > self._rate * (1 + 1e-12)):
            return f"joint rates beyond their limits: {now.qdot}"
        if np.any(np.abs(now.effort) > self._effort * (1 + 1e-12)):
            return f"efforts beyond their limits: {now.effort}"
        faults = ("joint_slow", "joint_stuck", "actuator_bias")
        sound = self._lockstep and not self._situation.acting(now.time_ns, self._recent, *faults)
        if sound and np.any(np.abs(now.qdot) > self.MOST * self._rate):
            return f"joints move at {now.qdot}, their rates are {self._rate}"
        return None


class MomentumCheck:
    """Momenta change by what the thrusters give alone; now and then Pinocchio computes them."""

    EVERY = 25

    def __init__(self, setup: Setup, situation: Situation, *, lockstep: bool) -> None:
        self._situation, self._period = situation, setup.period_ns
        self._robot = setup.model
        self._oracle = PinocchioOracle(setup.urdf, self._robot.joint_names)
        start = [*setup.plant.get("linear_momentum", [0.0] * 3)]
        start += setup.plant.get("angular_momentum", [0.0] * 3)
        self._start = np.array(start)
        self._compared = lockstep and not setup.plant.get("thrusters")
        self._count = 0
        self.samples = 0
        self.wrenches: dict[int, Array] = {}
        """Wrenches (6,) that were commanded, by stamp."""

    def look(self, now: State, before: State | None) -> str | None:
        expected = self._start if now.expected is None else now.expected
        scale = 1e-9 * self._robot.total_mass
        if np.abs(now.momentum[:6] - expected).max() > scale:
            return f"momenta {now.momentum[:6]} instead of {expected}"
        self._count += 1
        if self._count % self.EVERY == 0:
            self.samples += 1
            p, L, energy = self._by_pinocchio(now)
            error = np.abs(np.concatenate([p, L, [energy]]) - now.momentum).max()
            if error > scale:
                return f"Pinocchio has momenta {p}, {L}, {energy}: published {now.momentum}"
        if before is not None and now.time_ns < before.time_ns:
            self.wrenches.clear()
        if before is None or now.expected is None or before.expected is None:
            return None
        return self._impulse(now, before)

    def _by_pinocchio(self, state: State) -> tuple[Array, Array, float]:
        motion = Motion(
            state.q, state.qdot, state.pose[3:], state.pose[:3], np.zeros(3), state.twist[3:]
        )
        return self._oracle.momentum(motion, v_WB_B=state.twist[:3])

    def _impulse(self, now: State, before: State) -> str | None:
        """Compare the change of the linear momentum with the wrench that was commanded."""
        assert now.expected is not None
        assert before.expected is not None
        wrench = self.wrenches.pop(before.time_ns, None)
        # One that comes late, after time has begun again, is for no state that there will be.
        self.wrenches = {
            t: w for t, w in self.wrenches.items() if before.time_ns < t <= now.time_ns
        }
        pushed = self._situation.acting(
            now.time_ns, self._period, "thruster_off", "thruster_weak", "thruster_stuck",
            "nozzle_open", "nozzle_closed", "nozzle_weak",
        )  # fmt: skip
        if now.time_ns != before.time_ns + self._period or pushed or not self._compared:
            return None
        if self._situation.latched and before.time_ns > self._situation.latched_at:
            changed = np.abs(now.expected - before.expected).max()
            return f"a wrench under a latch: momenta change by {changed}" if changed else None
        if wrench is None:
            return None
        attitudes = Rotation.from_quat([before.pose[3:], now.pose[3:]])
        push = attitudes.mean().apply(wrench[:3]) * self._period / SECOND
        given = now.expected[:3] - before.expected[:3]
        turns = (attitudes[0].inv() * attitudes[1]).magnitude()
        # The thrusters turn with the base: their mean direction in a tick in which the rates of the
        # base change is that of the middle attitude to a small part of the turn.
        error, bound = np.abs(given - push).max(), (1e-3 + 0.1 * turns) * np.abs(push).max() + 1e-9
        # A command may have been refused: then there is no push at all.
        if np.abs(given).max() > 0 and error > bound:
            return f"the linear momentum changes by {given}, the wrench has given {push}"
        return None


class Goals:
    """What becomes of goals, as one commander reports it: decided once, and never by others.

    Some commanders repeat their statuses.
    """

    def __init__(self, *, repeats: bool, report: Callable[[str], None]) -> None:
        self._repeats, self._report = repeats, report
        self.sent: set[str] = set()
        self.decided: dict[str, str] = {}
        self.pursued = ""
        """Id of the goal that is pursued."""
        self.last = ""
        self.sentence = ""
        self.latched_for = 0
        """States that were published under a latch with a goal still pursued."""

    def on_status(self, state: str, goal_id: str, sentence: str) -> None:
        self.last, self.sentence = state, sentence
        if goal_id and goal_id not in self.sent:
            self._report(f"a status about goal {goal_id}, which was never sent: {sentence}")
        before = self.decided.get(goal_id)
        if state in DECIDED and goal_id:
            if before is not None and not (self._repeats and before == state):
                self._report(f"goal {goal_id} was {before} and is {state}: {sentence}")
            self.decided[goal_id] = state
            if goal_id == self.pursued:
                self.pursued = ""
        elif state in ("planning", "executing", "tracking"):
            if before is not None:
                self._report(f"goal {goal_id} was {before} and is {state}: {sentence}")
            if state != "planning":
                # A controller pursues a goal of the base and one of the hand together.
                if self.pursued not in ("", goal_id) and not self._repeats:
                    self.decided[self.pursued] = "replaced"
                self.pursued = goal_id
        if state == "aborted" and not goal_id:
            self.pursued = ""

    def drop(self) -> None:
        """The commander was deactivated: it pursues nothing."""
        self.pursued = ""


class GoalCheck:
    """No goal is pursued under a latch, and none that was sent before it afterwards."""

    PATIENCE = 3
    """States that may be published before a commander has heard of a latch."""

    def __init__(self, goals: dict[str, Goals], situation: Situation) -> None:
        self._goals, self._situation = goals, situation

    def look(self, now: State, before: State | None) -> str | None:
        for name, goals in self._goals.items():
            bound = self._situation.latched and now.time_ns > self._situation.latched_at
            bound = bound and self._situation.lifecycle[name] == "active"
            goals.latched_for = goals.latched_for + 1 if bound and goals.pursued else 0
            if goals.latched_for == self.PATIENCE + 1:
                return f"{name} pursues goal {goals.pursued} under a latch: {goals.sentence}"
        return None
