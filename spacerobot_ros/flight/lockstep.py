"""A flight in lockstep without ROS: the plant and its commanders, in the order of their nodes.

The nodes of a stack in one process hand messages to each other in the order of publication. What
they do between two ticks follows from that, and is done here by calls:

1. The plant reports the state of tick k.
2. The planner answers it as soon as its joints are there, the controller when its pose is, too, and
   the planner's reference, if there is one.
3. The first command of the tick counts; when all that the plant waits for are there, it steps.
4. The flight ends with the decision about the goal. The planner reports it before its command, so
   that the state of tick k is the last one; the controller after its commands, so that the state of
   tick k + 1 is.

Which messages make a state is decided by the same
:class:`~spacerobot_ros.flight.state_synchroniser.StateSynchroniser` as in the nodes, on stamps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from spacerobot_ros.commanding.goal_follower import GoalFollower, Status, decision_event
from spacerobot_ros.control import ControlState, NotFiniteError
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import END_EFFECTOR, GOAL_KEYS, ControlExecutive
from spacerobot_ros.control.reference import HeldVelocityReference
from spacerobot_ros.control.state import Reference
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.errors import CommandError, ParameterError, PlanningError, SpaceRobotError
from spacerobot_ros.events import Event
from spacerobot_ros.flight.flight import Flight, FlightLog
from spacerobot_ros.flight.plant_listener import Change, PlantListener, Stopped
from spacerobot_ros.flight.scenario import Scenario
from spacerobot_ros.flight.state_synchroniser import Pairing, StateSynchroniser
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.shared_parameters import RobotConfig, robot_from_text, robot_of
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Executive
from spacerobot_ros.planning.execution.goal_file import BASE, GoalFile, GoalIds, IdentifiedGoal
from spacerobot_ros.planning.execution.state_average import BaseMeasurement
from spacerobot_ros.planning.execution.status import PlannerStatus, ScheduleStart
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.simulation.actuators import FaultyPlant, build_plant
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.status import PlantMonitor, PlantState, PlantStatus
from spacerobot_ros.times import HEADER_STAMP, SECOND, stamp_bytes

_REFERENCE = "joint_reference"

Progress = Callable[[float, float], bool]
"""Called now and then with simulated time and the time the present schedule ends, s; returns
whether the flight is to end."""

_LOOK_PERIOD = 0.2
"""Wall s between two looks at whether the flight is to end."""

_LOOKED_AT = 64
"""Ticks between two looks at the wall clock."""


@dataclass(frozen=True)
class Robots:
    """The models of a flight: that of the plant, and those that its commanders believe in."""

    plant: SpaceRobot
    planner: SpaceRobot
    controller: SpaceRobot
    description: RobotDescription | None = None
    """Of the plant, with the URDF that is recorded; None: as its model has it."""
    method: GaitMethod | None = None
    """What plans, for the planner's robot and configuration; None: it is built for this flight."""

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        built: Callable[[str, RobotConfig], SpaceRobot | None] = lambda node, config: robot_of(
            config
        ),
    ) -> Robots:
        """Build the models that a scenario names; a commander that names none has the plant's URDF.

        ``built`` returns the robot of a node's configuration, None where that names none.

        Raises
        ------
        ParameterError
            The plant has no robot, or one is refused.
        """
        plant = built("plant", scenario.plant)
        if plant is None:
            raise ParameterError(
                f"The scenario '{scenario.name}' names no robot for its plant: set plant.robot."
            )
        robots = {"plant": plant, "planner": plant, "controller": plant}
        for name, node in (("planner", "planner"), ("controller", "coordinated_control")):
            if node in scenario.commanders:
                config = scenario.config(node)
                own = built(node, config)
                robots[name] = own or robot_from_text(plant.description.urdf, config)
        return cls(robots["plant"], robots["planner"], robots["controller"])


def require_flyable(scenario: Scenario) -> None:
    """Refuse what only the nodes can do: wall time, other processes, files to go on from.

    Raises
    ------
    ParameterError
        The scenario asks for it; the sentence says how it is flown.
    """
    why = ""
    if not scenario.lockstep:
        why = "plant.time_mode is realtime"
    elif scenario.kills:
        why = "it kills nodes on the way"
    elif scenario.plant.resume_bag:
        why = "plant.resume_bag is set"
    elif "planner" in scenario.commanders and scenario.planner.plan_in_background:
        why = "planner.plan_in_background is true"
    elif any(scenario.config(name).resume_file for name in scenario.commanders):
        why = "a resume_file is set"
    elif len(scenario.commanders) > 1 and scenario.planner.output == "commands":
        why = "planner and controller both command the joints"
    if why:
        raise ParameterError(
            f"The scenario '{scenario.name}' cannot be flown without ROS, because {why}; "
            "`spacerobot run` flies it."
        )


def fly_scenario(
    scenario: Scenario,
    *,
    robots: Robots | None = None,
    progress: Progress = lambda now, end: False,
    longest: float = math.inf,
) -> Flight:
    """Fly a scenario from its initial state to its goal, without ROS: as `spacerobot run` does.

    Parameters
    ----------
    scenario
        What to fly, in lockstep.
    robots
        The models; None: those that the scenario names.
    progress
        Called with the progress of the flight; it may end it.
    longest
        Simulated time after which the flight is interrupted, s.

    Raises
    ------
    ParameterError
        A parameter or the robot is refused, or only the nodes can fly this.
    GoalError
        The shape of the goal is of another robot.
    """
    require_flyable(scenario)
    return _LockstepFlight(scenario, robots or Robots.of(scenario)).fly(progress, longest)


class _Moment(Enum):
    """When a commander has decided about the goal, as the plant sees it."""

    BEFORE_COMMAND = "before its command"
    AFTER_COMMAND = "after its command"


class _Measured:
    """The :class:`~spacerobot_ros.planning.execution.state_average.MeasuredState` of a plant."""

    def __init__(self) -> None:
        self.stamp_ns = 0
        self.q: Array = np.zeros(0)
        self.measurement: BaseMeasurement | None = None

    def base(self) -> BaseMeasurement | None:
        return self.measurement


class _LockstepFlight:
    """One flight in the making."""

    def __init__(self, scenario: Scenario, robots: Robots) -> None:
        config = scenario.plant
        self._scenario, self._robots = scenario, robots
        self._period_ns = config.period_ns
        self._tick = 0
        self._plant: FaultyPlant = build_plant(robots.plant, config)
        scenario.require_shape_of(robots.plant)
        self._reported = ReportedState(self._plant, config)
        self._commands = CommandValidator(self._plant, config)
        self._monitor = PlantMonitor(self._commands, self._plant, lockstep=True)
        self._faults_seen = self._plant.active
        self._log = FlightLog(self._plant, self._reported, self._commands, self._period_ns)
        self._goal_id = GoalIds().of(0, 1)
        """Of the first goal that a mission client sends at time zero."""
        self._follower = GoalFollower(self._goal_id)
        self._decided: _Moment | None = None
        self._moment = _Moment.BEFORE_COMMAND
        self._status: Status | None = None
        self._events = self._log.events
        self._planner = self._controller = None
        commanders = scenario.commanders
        self._decider = commanders[0]
        if "planner" in commanders:
            self._planner = _Planner(robots.planner, scenario.planner, robots.method)
        if "coordinated_control" in commanders:
            self._controller = _Controller(
                robots.controller, scenario.controller, self._on_status, self._report_event
            )
            if self._planner is not None:
                self._controller.states.require(_REFERENCE)
        self._listeners = {name: PlantListener() for name in commanders}

    # -- the flight ---------------------------------------------------------------------------

    def fly(self, progress: Progress, longest: float) -> Flight:
        """Fly to the decision about the goal."""
        began, interrupted = time.perf_counter(), ""
        looked = began
        self._commands.begin(0)
        for source in self._commands.sources:
            wrench = source.quantity == "wrench"
            source.commanders = int(self._controller is not None) if wrench else 1
        self._commands.require_commanded()
        self._look_at_plant(PlantState.RUNNING)
        self._moment = _Moment.BEFORE_COMMAND
        self._send_goals()
        self._report_state()
        while True:
            self._answer()
            if self._decided is _Moment.BEFORE_COMMAND:
                break
            if not self._commands.complete and not self._reported.sensors.dropout:
                interrupted = f"No command answers the state of {self._time:g} s."
                break
            ends = self._decided is not None
            if not self._step():
                break
            self._report_state()
            if self._plant.active is not self._faults_seen:
                self._look_at_plant(PlantState.RUNNING)
            if ends:
                break
            if self._time >= longest:
                interrupted = f"Interrupted after {self._time:.6g} s of simulated time."
                break
            if self._tick % _LOOKED_AT == 0 and time.perf_counter() - looked >= _LOOK_PERIOD:
                looked = time.perf_counter()
                if progress(self._time, self._ends_at):
                    interrupted = f"Interrupted after {self._time:.6g} s of simulated time."
                    break
        return self._result(time.perf_counter() - began, interrupted)

    @property
    def _time(self) -> float:
        return self._tick * self._period_ns / SECOND

    @property
    def _ends_at(self) -> float:
        return self._status.ends_at_s if isinstance(self._status, PlannerStatus) else 0.0

    def _report_state(self) -> None:
        """Report the state of a tick, as the node publishes it."""
        self._reported.update()
        self._log.add_state(self._tick)

    def _step(self) -> bool:
        """Step under the commands of the tick; return whether the plant could."""
        commands = self._commands.begin_step()
        try:
            self._plant.step(*commands)
        except SpaceRobotError as error:
            sentence = f"The plant stops at {self._time:g} s: {error}"
            self._monitor.failure = "model", sentence
            self._commands.rest()
            self._look_at_plant(PlantState.FAILED)
            return False
        self._tick += 1
        return True

    def _answer(self) -> None:
        """Have the commanders answer the present state."""
        self._moment = _Moment.BEFORE_COMMAND
        quantities, now = self._reported.quantities, self._tick * self._period_ns
        lost = self._reported.sensors.dropout
        q, qdot = quantities["measured_q"], quantities["measured_qdot"]
        base = None
        if not lost:
            base = BaseMeasurement(quantities["measured_pose"], quantities["measured_twist"], qdot)
        planner, controller = self._planner, self._controller
        if planner is not None:
            planner.answer(now, q, base)
            self._take_outputs(planner)
            setpoint = planner.executive.setpoint
            if controller is None:
                velocity = self._commands.sources[0].quantity == "velocity"
                values = setpoint.velocity if velocity else np.zeros(len(q))
                self._offer(self._commands.sources[0], values, now)
                self._moment = _Moment.AFTER_COMMAND
            else:
                controller.take_reference(now, setpoint.position, setpoint.velocity)
                self._log.add_command(_REFERENCE, self._tick, setpoint.velocity)
        if controller is not None:
            if base is not None:
                controller.take_base(now, base)
            try:
                controller.take_joints(now, q, qdot, self._send)
            except (CommandError, NotFiniteError) as error:
                self._log.refused_states.append((self._time, str(error)))

    def _send(self, effort: Array, wrench: Array) -> None:
        """Offer the commands of the controller; its later decisions follow them."""
        now = self._tick * self._period_ns
        for source in reversed(self._commands.sources):  # The wrench is sent first.
            values = wrench if source.quantity == "wrench" else effort
            if source.quantity == "velocity":
                values = np.zeros(len(effort))
            self._offer(source, values, now)
        self._moment = _Moment.AFTER_COMMAND

    def _offer(self, source: CommandSource, values: Array, now: int) -> None:
        self._log.add_command(source.topic, self._tick, values)
        if self._decided is _Moment.BEFORE_COMMAND:
            return
        refusal = self._commands.offer(source, now, values, now)
        if refusal is not None:
            self._log.refusals.append((self._time, source.topic, refusal))
            if refusal.latches:
                self._look_at_plant(PlantState.RUNNING)

    # -- what the plant reports to its commanders ---------------------------------------------

    def _look_at_plant(self, activity: PlantState) -> None:
        """Pass a change of the plant's status to the commanders."""
        self._faults_seen, self._moment = self._plant.active, _Moment.AFTER_COMMAND
        before = self._monitor.status
        self._events += self._monitor.update(activity, self._time)
        status = self._monitor.status
        if status is not before:
            for name, listener in self._listeners.items():
                self._take_news(name, listener, status)

    def _take_news(self, name: str, listener: PlantListener, status: PlantStatus) -> None:
        owner = self._planner if name == "planner" else self._controller
        assert owner is not None
        for news in listener.take(status, "plant"):
            match news:
                case Stopped():
                    owner.executive.plant_stopped(
                        news.why, news.commanded_until_ns, news.rests_since_ns
                    )
                case Change():
                    raise AssertionError("this plant is neither reset nor rearmed")
        if isinstance(owner, _Planner):
            owner.executive.plant_rests = listener.rests
            self._take_outputs(owner)
        else:
            owner.executive.plant_blocked = bool(listener.blocked)

    # -- goals and statuses -------------------------------------------------------------------

    def _send_goals(self) -> None:
        """Send the goals as the client of a mission does: before the first state."""
        scenario, goal = self._scenario, self._scenario.goal
        # A pose is checked, and its quaternion scaled, where it is received.
        given = Goal.checked(goal.position, goal.quaternion, goal.joint_positions)
        unshaped = replace(given, joint_positions=None)
        if self._planner is not None:
            self._planner.executive.propose(IdentifiedGoal(given, self._goal_id))
        if self._controller is not None:
            self._submit(BASE, unshaped)
            tool = scenario.end_effector_goal
            if tool is not None:
                self._submit(END_EFFECTOR, Goal.checked(tool.position, tool.quaternion))

    def _submit(self, key: str, goal: Goal) -> None:
        assert self._controller is not None
        executive = self._controller.executive
        try:
            executive.submit(key, IdentifiedGoal(goal, self._goal_id))
        except PlanningError as error:
            executive.refuse(str(error), self._goal_id)

    def _take_outputs(self, planner: _Planner) -> None:
        """Take what the planner publishes beside its commands."""
        outputs = planner.executive.outputs
        while outputs:
            output = outputs.popleft()
            match output:
                case PlannerStatus():
                    self._on_status(output)
                    event = decision_event(output)
                    if event is not None:
                        self._report_event(event)
                case ScheduleStart(schedule, stamp_ns):
                    self._log.schedules.append((stamp_ns, schedule))
                case Event():
                    self._report_event(output)
                case _:
                    pass  # For the log of a node.

    def _on_status(self, status: Status) -> None:
        """Follow the status as the client of a mission does."""
        self._log.statuses.append((self._tick * self._period_ns, status))
        if isinstance(status, PlannerStatus) is not (self._decider == "planner"):
            return
        if self._decided is not None:
            return
        self._status = status
        if self._follower.take(status):
            self._decided = self._moment

    def _report_event(self, event: Event) -> None:
        stamped = event if event.time_s is not None else replace(event, time_s=self._time)
        self._events.append(stamped)

    def _result(self, wall_time: float, interrupted: str) -> Flight:
        decision = self._follower.decision
        outcome = Outcome.INTERRUPTED if decision is None else Outcome(decision.state.value)
        message = interrupted
        if decision is not None:
            message = decision.message
        elif not interrupted and self._status is not None:
            message = self._monitor.status.message or self._status.message
        plan_time = 0.0
        if self._planner is not None:
            plan_time = self._planner.executive.statistics.plan_time_s
        return self._log.flight(
            self._scenario,
            self._robots.description or self._robots.plant.description,
            outcome=outcome,
            message=message,
            status=self._status,
            gait=self._follower.gait,
            plan_time=plan_time,
            wall_time=wall_time,
        )


class _Planner:
    """What a planner node does with states."""

    def __init__(self, robot: SpaceRobot, config: PlannerConfig, method: GaitMethod | None) -> None:
        worker = PlanningWorker(robot, config, method)
        self.executive = Executive(robot, config, worker, GoalFile(""))
        self._measured = _Measured()

    def answer(self, stamp_ns: int, q: Array, base: BaseMeasurement | None) -> None:
        """Answer a state; without its base where that is lost."""
        measured = self._measured
        measured.stamp_ns, measured.q, measured.measurement = stamp_ns, q, base
        self.executive.update(measured)


class _Controller:
    """What a node of coordinated control does with states."""

    def __init__(
        self,
        robot: SpaceRobot,
        config: ControllerConfig,
        on_status: Callable[[ControllerStatus], None],
        on_event: Callable[[Event], None],
    ) -> None:
        self.executive = ControlExecutive(
            build_controller(robot, config),
            config,
            on_status,
            GoalFile("", GOAL_KEYS),
            report_event=on_event,
        )
        self.states = StateSynchroniser(pose_required=True)
        self._held = HeldVelocityReference(config.control_period)
        self._q, self._qdot = np.zeros(robot.n), np.zeros(robot.n)
        self._base: BaseMeasurement | None = None
        self._reference: tuple[Array, Array] | None = None
        self._stamp_ns = 0

    def take_base(self, stamp_ns: int, base: BaseMeasurement) -> None:
        """Take the pose and the twist of the base."""
        self._base = base
        self.states.put_odom(_stamp(stamp_ns))

    def take_reference(self, stamp_ns: int, position: Array, velocity: Array) -> None:
        """Take the setpoint of a planner."""
        self._reference = position.copy(), velocity.copy()
        self.states.put_required(_REFERENCE, _stamp(stamp_ns))

    def take_joints(
        self, stamp_ns: int, q: Array, qdot: Array, send: Callable[[Array, Array], None]
    ) -> None:
        """Take the joints of a state, and answer it; first one whose pose has not come.

        Raises
        ------
        CommandError, NotFiniteError
            The state is refused.
        """
        overdue = self.states.overdue()
        if overdue is not None:
            # An answer to a lost pose would come a tick late; what it estimates goes on from there.
            self._answer(overdue, send if overdue is Pairing.WHOLE else None)
        self._stamp_ns, self._q[:], self._qdot[:] = stamp_ns, q, qdot
        self.states.put_joint_states(_stamp(stamp_ns))
        pairing = self.states.ready()
        if pairing is not None:
            self._answer(pairing, send)

    def _answer(self, pairing: Pairing, send: Callable[[Array, Array], None] | None) -> None:
        measured, base = None, self._base
        if pairing is Pairing.WHOLE and base is not None:
            pose, twist = base.pose, base.twist
            measured = ControlState(pose[:3], pose[3:], twist[:3], twist[3:], self._q, self._qdot)
        reference = None
        if self._reference is not None:
            reference = Reference(joints=self._held.at_command(*self._reference))
        now = self._stamp_ns / SECOND
        result = self.executive.command(now, measured, self._q, self._qdot, reference)
        if send is not None:
            send(result.realised.tau, result.realised.wrench_B)
        self.executive.evaluate(now, result)


def _stamp(stamp_ns: int) -> bytes:
    return bytes(HEADER_STAMP.start) + stamp_bytes(stamp_ns)
