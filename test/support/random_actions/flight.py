"""A stack to which random actions are done, and everything it publishes being checked."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from support.planner_flight import Array, goal_at, pose_arrays
from support.random_actions.actions import PLANT, Action, Draw, Kind
from support.random_actions.expectations import SECOND, Disturbance
from support.random_actions.observer import Figures, Observer
from support.random_actions.setups import CONTROLLER, PLANNER, Setup
from support.ros_harness import Harness

from spacerobot_ros.nodes import CoordinatedControlNode, PlannerNode, PlantNode

_WALL_LIMIT = 60.0
"""Wall s without a state after which time is taken to stand: plans take less on a busy machine."""

_IDLE_SPINS = 25

_MOST_STATES = 4000
"""States after which a stack is replaced: see :func:`random_flights`."""

_CLASSES: dict[str, Any] = {
    PLANT: PlantNode,
    PLANNER: PlannerNode,
    CONTROLLER: CoordinatedControlNode,
}

_TRANSITIONS = {
    "configure": (Transition.TRANSITION_CONFIGURE, "unconfigured", "inactive"),
    "activate": (Transition.TRANSITION_ACTIVATE, "inactive", "active"),
    "deactivate": (Transition.TRANSITION_DEACTIVATE, "active", "inactive"),
    "cleanup": (Transition.TRANSITION_CLEANUP, "inactive", "unconfigured"),
}


def moved(
    position: Array, attitude: Rotation, offset: tuple[float, ...], turn: tuple[float, ...]
) -> PoseStamped:
    """Return a goal at an offset in the world, m, and turned about the own axes, rad."""
    turned = attitude * Rotation.from_rotvec(turn)
    return goal_at(((position + offset).tolist(), turned.as_rotvec().tolist()))


def spoilt(goal: PoseStamped, how: str) -> PoseStamped:
    o = goal.pose.orientation
    match how:
        case "frame":
            goal.header.frame_id = "moon"
        case "quaternion":
            o.x = o.y = o.z = o.w = 0.0
        case "nan":
            goal.pose.position.y = np.nan
        case _:
            goal.pose.position.z = np.inf
    return goal


def bad_shape(names: list[str], how: str) -> JointState:
    zeros = [0.0] * len(names)
    match how:
        case "unknown":
            return JointState(name=["nobody", *names[1:]], position=zeros)
        case "short":
            return JointState(name=names, position=zeros[1:])
        case "nan":
            return JointState(name=names, position=[np.nan, *zeros[1:]])
        case _:
            return JointState(name=[names[0]] * 2, position=[0.0, 0.0])


class RandomFlight:
    """Does random actions to a stack, and checks every state that is published."""

    def __init__(self, harness: Harness, setup: Setup, seed: int, *, real_time: bool) -> None:
        self._harness, self._setup, self._real_time = harness, setup, real_time
        rng = np.random.default_rng(seed)
        self._draw = Draw(setup, rng)
        self._names = list(setup.model.joint_names)
        self._nodes: dict[str, Node] = {}
        self._start_nodes()
        node = self._node = harness.add(Node("operator", context=harness.context))
        self._goals = node.create_publisher(PoseStamped, "goal_pose", 100)
        self._tip_goals = node.create_publisher(PoseStamped, "end_effector/goal_pose", 100)
        self._twists = node.create_publisher(TwistStamped, "end_effector/twist", 100)
        self._shapes = node.create_publisher(JointState, "goal_joint_states", 100)
        self._faults = node.create_publisher(String, "fault_injection", 100)
        self._clients: dict[str, Any] = {}
        self._goal_count = 0
        name = f"{setup.robot}, {'real time' if real_time else 'lockstep'}, seed {seed}"
        self._seen = Observer(node, setup, self._nodes, name, real_time=real_time)
        self.figures, self._situation = self._seen.figures, self._seen.situation
        self._books = self._seen.books
        for name in self._nodes:
            self._transit(name, "configure")
        harness.connect()
        for name in reversed(self._nodes):
            self._transit(name, "activate")
        self._pass_ticks(2)

    # -- the stack ----------------------------------------------------------------------------

    def _start_nodes(self) -> None:
        setup = self._setup
        plant = dict(setup.plant) | {"time_mode": "lockstep"}
        planner = dict(setup.planner)
        if self._real_time:
            plant |= setup.real_time
            planner |= {"plan_in_background": True}
        parameters = {PLANT: plant, PLANNER: planner, CONTROLLER: dict(setup.controller)}
        for name in (PLANT, *setup.commanders):
            self._nodes[name] = self._harness.make(
                _CLASSES[name], parameters[name], name=name, autostart=False
            )

    # -- services -----------------------------------------------------------------------------

    def _call(self, kind: Any, service: str, request: Any) -> Any:
        client = self._clients.get(service)
        if client is None:
            client = self._clients[service] = self._node.create_client(kind, service)
        return self._harness.call(client, request)

    def _transit(self, name: str, word: str) -> bool:
        """Ask for a transition, and note what has become of the node."""
        number, before, after = _TRANSITIONS[word]
        situation, lifecycle = self._situation, self._situation.lifecycle
        possible = lifecycle[name] == before
        if name == PLANT and possible and word == "activate":
            # Its state is published before the answer of the service.
            lifecycle[name] = after
            situation.may_repeat = True
        if name != PLANT and possible and word == "deactivate":
            self._books[name].drop()
            self._seen.allow_stop(self._timeout)
        request = ChangeState.Request(transition=Transition(id=number))
        answer = self._call(ChangeState, f"{name}/change_state", request)
        if answer.success is not possible:
            self._seen.violate(f"{name}, {lifecycle[name]}: {word} answers {answer.success}")
        if possible:
            lifecycle[name] = after
        if name == PLANT and possible and word == "activate":
            situation.may_jump = situation.may_restart = False
            situation.may_repeat = not self._real_time
        if name == PLANT and possible and word == "configure":
            situation.latched, situation.rearmed = False, True
            situation.may_jump = situation.may_restart = True
            situation.disturbances.clear()
        return bool(answer.success)

    @property
    def _timeout(self) -> float:
        return float(self._setup.real_time["command_timeout"]) if self._real_time else 0.0

    # -- time ---------------------------------------------------------------------------------

    @property
    def _time_runs(self) -> bool:
        situation = self._situation
        if situation.paused or situation.lifecycle[PLANT] != "active":
            return False
        return self._real_time or situation.active

    def _pass_ticks(self, count: int) -> None:
        """Let ticks pass; where time stands, look that it does."""
        if not self._time_runs:
            self._idle()
            return
        wanted = self.figures.states + count
        self._spin_until(lambda: self.figures.states >= wanted, f"{count} ticks pass")

    def _idle(self) -> None:
        quiet, before = 0, -1
        while quiet < _IDLE_SPINS:
            self._harness.executor.spin_once(timeout_sec=0.001)
            quiet = quiet + 1 if self.figures.states == before else 0
            before = self.figures.states

    def _spin_until(self, predicate: Callable[[], bool], what: str) -> bool:
        """Spin until something is so; a violation if it is not in time."""
        states, deadline = self.figures.states, monotonic() + _WALL_LIMIT
        violations = len(self.figures.violations)
        while not predicate():
            if self.figures.states > states:
                states, deadline = self.figures.states, monotonic() + _WALL_LIMIT
            if monotonic() > deadline:
                self._seen.violate(f"nothing for {_WALL_LIMIT:g} s of wall time: {what}")
                return False
            if len(self.figures.violations) > violations:
                return False
            self._harness.executor.spin_once(timeout_sec=0.05)
        return True

    # -- actions ------------------------------------------------------------------------------

    def run(self, count: int, *, between_recoveries: int = 40) -> None:
        """Do this many actions, or as many as there are before a violation or 4000 states.

        After every so many the stack is brought back into order and must reach a goal.
        """
        for _ in range(count):
            self.perform(self._possible_action())
            if self.figures.violations:
                return
            if self.figures.actions % between_recoveries == 0:
                self.recover()
            if self.figures.violations:
                return
            if self.figures.states > _MOST_STATES:
                break
        self.recover()

    def _possible_action(self) -> Action:
        """Draw until there is something to do: unconfigured nodes have no services."""
        lifecycle = self._situation.lifecycle
        while True:
            action = self._draw.action()
            of_plant = action.kind in (Kind.REARM, Kind.PAUSE, Kind.RESUME, Kind.RESET)
            node = PLANT if of_plant else action.node
            if node not in lifecycle or action.kind is Kind.ACTIVATE:
                return action
            if lifecycle[node] != "unconfigured":
                return action

    def perform(self, action: Action) -> None:
        """Do one action, and let time pass."""
        self.figures.actions += 1
        time = f"[{self._seen.now_ns / SECOND:.6g} s]"
        self._seen.actions.append(f"{self.figures.actions}: {action}  {time}")
        self._do(action)
        self._pass_ticks(action.ticks)
        self._compare()

    def _compare(self) -> None:
        """Compare statuses and events with what was done."""
        for wrong in (
            self._seen.plant_status.agrees(),
            self._seen.events.compare(self._seen.plant_status.changes),
        ):
            if wrong is not None:
                self._seen.violate(wrong)

    def _do(self, action: Action) -> None:
        situation = self._situation
        match action.kind:
            case Kind.GOAL | Kind.BURST | Kind.UNREACHABLE:
                for aim in action.aims:
                    self._send(self._pose(aim.offset, aim.turn))
            case Kind.TIP_GOAL:
                for aim in action.aims:
                    tip = self._seen.parts.get("end_effector_pose")
                    if tip is not None:
                        self._send(moved(*pose_arrays(tip.pose), aim.offset, aim.turn), tip=True)
            case Kind.TWIST:
                self._send_twist((*action.aims[0].offset, *action.aims[0].turn))
            case Kind.BAD_TWIST:
                self._send_twist((float(action.text), *(0.0,) * 5))
            case Kind.DETUMBLE:
                self._trigger(f"{CONTROLLER}/detumble", may_refuse=True)
            case Kind.SHAPE_GOAL:
                self._shapes.publish(JointState(name=self._names, position=list(action.shape)))
                self._send(self._pose(action.aims[0].offset, action.aims[0].turn))
            case Kind.BAD_GOAL:
                self._send(spoilt(self._pose(action.aims[0].offset, (0.0, 0.0, 0.0)), action.text))
            case Kind.BAD_SHAPE:
                self._shapes.publish(bad_shape(self._names, action.text))
            case Kind.ABORT if action.node == PLANT:
                situation.rearmed = False
                self._trigger("plant/abort")
                situation.latched, situation.latched_at = True, self._seen.now_ns
                situation.goals_since_stop.clear()
                situation.stopped_once = True
            case Kind.ABORT:
                self._trigger(f"{action.node}/abort", may_refuse=True)
            case Kind.REARM:
                self._rearm()
            case Kind.PAUSE:
                self._pause(True)
            case Kind.RESUME:
                self._pause(False)
            case Kind.RESET:
                self._reset()
            case Kind.DEACTIVATE | Kind.ACTIVATE:
                if situation.lifecycle[action.node] == "unconfigured":
                    self._transit(action.node, "configure")
                self._transit(action.node, action.kind.words)
                self._harness.connect()
            case Kind.RECONFIGURE:
                self._reconfigure(action.node)
            case Kind.FAULT:
                self._inject(action.text)
            case Kind.BAD_FAULT:
                self._faults.publish(String(data=action.text))
            case Kind.CLEAR:
                self._clear()
            case Kind.WAIT:
                pass

    def _reconfigure(self, name: str) -> None:
        was = self._situation.lifecycle[name]
        if was == "active":
            self._transit(name, "deactivate")
        self._transit(name, "cleanup")
        self._transit(name, "configure")
        self._harness.connect()
        if was == "active":
            self._transit(name, "activate")

    def _trigger(self, service: str, *, may_refuse: bool = False) -> None:
        answer = self._call(Trigger, service, Trigger.Request())
        if not answer.message or not (answer.success or may_refuse):
            self._seen.violate(f"{service} answers {answer.success}: '{answer.message}'")

    def _pause(self, on: bool) -> None:
        situation = self._situation
        situation.paused = situation.resumed = False
        self._call(SetBool, "plant/pause", SetBool.Request(data=on))
        situation.paused, situation.resumed = on, not on

    def _rearm(self) -> None:
        situation = self._situation
        situation.latched = False
        self._trigger("plant/rearm")
        situation.rearmed = True

    def _reset(self) -> None:
        situation = self._situation
        situation.may_jump = True
        self._trigger("plant/reset")
        if situation.lifecycle[PLANT] == "active":
            situation.may_jump = False
            self._compare_start()

    def _inject(self, text: str) -> None:
        now = self._seen.now_ns / SECOND
        words = text.split()
        times = {"at": now, "until": np.inf}
        line = []
        for before, word in zip(["", *words], words, strict=False):
            if word.startswith("NOW+"):
                times[before] = now + float(word.removeprefix("NOW+"))
                word = f"{times[before]:.9g}"
            line.append(word)
        found = Disturbance(words[0], words[1], times["at"], times["until"])
        self._situation.disturbances.append(found)
        self._faults.publish(String(data=" ".join(line)))

    def _clear(self) -> None:
        self._faults.publish(String(data="clear"))
        now = self._seen.now_ns / SECOND
        slack = 5 * self._setup.period_ns / SECOND
        for fault in self._situation.disturbances:
            fault.end = min(fault.end, now + slack)

    def _compare_start(self) -> None:
        """Look that a plant that was reset is where it began."""
        state, first = self._seen.state, self._seen.first
        assert state is not None
        assert first is not None
        if not (np.array_equal(state.q, first.q) and np.array_equal(state.pose, first.pose)):
            self._seen.violate(f"after a reset the robot is at {state.pose}, {state.q}")

    # -- goals --------------------------------------------------------------------------------

    def _pose(self, offset: tuple[float, ...], turn: tuple[float, ...]) -> PoseStamped:
        """Return a pose relative to where the base is."""
        state = self._seen.state
        pose = np.array([0, 0, 0, 0, 0, 0, 1.0]) if state is None else state.pose
        return moved(pose[:3], Rotation.from_quat(pose[3:]), offset, turn)

    def _send(self, goal: PoseStamped, *, tip: bool = False) -> str:
        self._goal_count += 1
        self.figures.goals += 1
        goal.header.stamp.sec, goal.header.stamp.nanosec = 1, self._goal_count
        goal_id = f"1.{self._goal_count:09d}"
        for book in self._books.values():
            book.sent.add(goal_id)
        self._situation.goals_since_stop.add(goal_id)
        (self._tip_goals if tip else self._goals).publish(goal)
        return goal_id

    def _send_twist(self, values: tuple[float, ...]) -> None:
        message, time = TwistStamped(), self._setup.planner["twist_timeout"]
        message.header.frame_id = "world"
        v, w = message.twist.linear, message.twist.angular
        v.x, v.y, v.z, w.x, w.y, w.z = values
        self._seen.allow_stop(time + 1.0)
        self._situation.goals_since_stop.add("twist")
        self._twists.publish(message)

    # -- liveness -----------------------------------------------------------------------------

    def recover(self) -> None:
        """Bring everything back into order; a fresh goal must be reached."""
        self.figures.recoveries += 1
        self._seen.actions.append(f"recovery  [{self._seen.now_ns / SECOND:.6g} s]")
        for name, state in self._situation.lifecycle.items():
            if state == "unconfigured":
                self._transit(name, "configure")
        self._harness.connect()
        for name, state in self._situation.lifecycle.items():
            if state != "active":
                self._transit(name, "activate")
        self._clear()
        self._pause(False)
        self._rearm()
        self._pass_ticks(10)
        if self.figures.violations or self._reaches():
            self._require_results()
            return
        first = self._books[self._setup.decider].sentence
        self.figures.second_attempts += 1
        self._seen.actions.append(f"second attempt after: {first}")
        self._reset()
        self._pass_ticks(10)
        if not self.figures.violations and not self._reaches():
            book = self._books[self._setup.decider]
            self._seen.violate(f"a fresh goal is {book.last}: {book.sentence}")
        self._require_results()

    def _require_results(self) -> None:
        """Look that every goal that was accepted has its result, now that the last one is met."""
        self._pass_ticks(10)
        for name, goal_id in sorted(self._seen.events.undecided):
            self._seen.violate(f"{name}: goal {goal_id} was accepted and has no result")

    def _reaches(self) -> bool:
        """Send a goal that can be reached, and return whether it is."""
        setup, book = self._setup, self._books[self._setup.decider]
        if setup.shapes:
            self._shapes.publish(JointState(name=self._names, position=setup.home.tolist()))
        step = self._homeward()
        tip = self._seen.parts.get("end_effector_pose") if setup.tip else None
        turn = (0.0,) * 3 if setup.tip else tuple(0.1 * x for x in setup.turn)
        goal_id = self._send(self._pose(step, turn))
        if tip is not None:
            # Otherwise the end-effector stays where it is held.
            goal_id = self._send(moved(*pose_arrays(tip.pose), step, turn), tip=True)
        end = self._seen.now_ns + round(setup.patience * SECOND)
        # A plan that is made in the background takes its time on the wall, however fast the flight.
        soonest = monotonic() + _WALL_LIMIT * self._real_time
        self._spin_until(
            lambda: goal_id in book.decided or (self._seen.now_ns > end and monotonic() > soonest),
            f"goal {goal_id} is decided",
        )
        if goal_id not in book.decided and not self.figures.violations:
            late = f"goal {goal_id} is not decided within {setup.patience:g} s"
            self._seen.violate(f"{late}: {book.sentence}")
        return book.decided.get(goal_id) in ("reached", "reached_partly")

    def _homeward(self) -> tuple[float, ...]:
        """Return a step (3,) of the base that brings sliders back: a part of the way home, m."""
        setup, state = self._setup, self._seen.state
        if not any(setup.reach) or state is None:
            return (0.0, 0.0, 0.0)
        if not setup.servos:
            return tuple(0.2 * x for x in setup.reach)
        robot = setup.model
        center = robot.function("center_of_mass")
        moved = np.asarray(center(state.q) - center(setup.home)).ravel()
        return tuple((0.2 * Rotation.from_quat(state.pose[3:]).apply(moved)).tolist())


def random_flights(domain: int, setup: Setup, seed: int, count: int, *, real_time: bool) -> Figures:
    """Do this many actions to one stack after the other, up to the first violation.

    Within one process, Fast DDS delivers nothing to a subscription that is created after 5000
    messages of a reliable publisher: nodes of an older stack cannot be configured again.
    """
    total = Figures()
    while total.actions < count and not total.violations:
        # Of its own: what is destroyed would still be called back in a shared one.
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        harness = Harness(context)
        flight = RandomFlight(harness, setup, seed + total.stacks, real_time=real_time)
        flight.run(count - total.actions)
        harness.close()
        rclpy.try_shutdown(context=context)
        total.add(flight.figures)
    return total
