"""A lockstep flight without ROS: the plant and its commanders, called in the same order as the
nodes.

Nodes in lockstep exchange messages in publication order. The loop makes the same calls in the same
order:

1. The plant reports the state of tick k.
2. The planner responds as soon as the joint state arrives, the controller once the pose and the
   planner's reference, if any, have also arrived.
3. The first command of the tick is used; the plant steps when all expected commands have arrived.
4. The flight ends when the goal is completed. The planner reports completion before its command, so
the last state is from tick k; the controller reports it after its commands, so the last state is
from tick k + 1.

The planner and the controller are the same :class:`~spacerobot_ros.commanding.commander.Commander`
objects as in the nodes, but receive arrays instead of messages.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.commanding.commander import Commander
from spacerobot_ros.commanding.controller import JOINT_REFERENCE, ControllerCommander
from spacerobot_ros.commanding.goal_follower import GoalFollower, Status
from spacerobot_ros.commanding.host import ArrayDecoder, StateArrays
from spacerobot_ros.commanding.planner import PlannerCommander
from spacerobot_ros.commanding.plant_state import Stamped
from spacerobot_ros.control.goals import END_EFFECTOR
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.events import Event
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.series import FlightLog
from spacerobot_ros.measures import Outcome
from spacerobot_ros.messages.diagnostics import PlantDiagnostics, StatusRecord, state_diagnostics
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array
from spacerobot_ros.model.shared_parameters import RobotConfig, robot_from_text, robot_of
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import POSE
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, GoalIds
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.simulation.actuators import PlantWithFaults, build_plant
from spacerobot_ros.simulation.clearance import ClearanceMonitor
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.status import PlantMonitor, PlantState
from spacerobot_ros.times import SECOND

_FIRST_GOAL_STAMP = 0, 1
"""Stamp of the first goal that a mission client sends at time zero: seconds and nanoseconds."""

Progress = Callable[[float, float], bool]
"""Called regularly with simulated time and the end time of the current schedule, s; returns whether
to end the flight."""

_PROGRESS_PERIOD = 0.2  # wall s

_Build = Callable[[str, RobotConfig], SpaceRobot | None]
"""Returns the robot for a node and its configuration; None: none is configured."""


@dataclass(frozen=True)
class Robots:
    """The models in a flight: the plant's model, and the models assumed by its commanders."""

    plant: SpaceRobot
    planner: SpaceRobot
    controller: SpaceRobot
    method: GaitMethod | None = None
    """Gait method for the planner's robot and configuration; by default, the method is built for
    this flight."""

    @classmethod
    def of(
        cls, scenario: Scenario, built: _Build = lambda node, config: robot_of(config)
    ) -> Robots:
        """Build the models named in a scenario; a commander without a model uses the plant's URDF.

        Raises
        ------
        ParameterError
            The plant has no robot, or a robot is invalid.
        """
        plant = built("plant", scenario.plant)
        if plant is None:
            raise ParameterError(
                f"The scenario '{scenario.name}' has no robot for its plant: set plant.robot."
            )

        def assumed(node: str) -> SpaceRobot:
            if node not in scenario.commanders:
                return plant
            config = scenario.config(node)
            return built(node, config) or robot_from_text(plant.description.urdf, config)

        return cls(plant, assumed("planner"), assumed("coordinated_control"))


def require_flyable(scenario: Scenario) -> None:
    """Raise an error if a scenario requires ROS nodes, as it does for wall time, other processes or
    a resumed flight.

    Raises
    ------
    ParameterError
        The scenario requires nodes; the message names the command to use.
    """
    why = ""
    if not scenario.lockstep:
        why = "plant.time_mode is realtime"
    elif scenario.kills:
        why = "it kills nodes during the flight"
    elif scenario.plant.resume_bag:
        why = "plant.resume_bag is set"
    elif any(scenario.config(name).resume_file for name in scenario.commanders):
        why = "a resume_file is set"
    elif "planner" in scenario.commanders and scenario.planner.output == "trajectory":
        why = "planner.output is trajectory"
    elif len(scenario.commanders) > 1 and scenario.planner.output == "commands":
        why = "the planner and the controller both command the joints"
    if why:
        realtime = " --realtime" if scenario.kills and scenario.lockstep else ""
        raise ParameterError(
            f"The scenario '{scenario.name}' cannot be flown without nodes, because {why}: fly it "
            f"with `spacerobot run SCENARIO --nodes{realtime}`."
        )


def fly_scenario(
    scenario: Scenario,
    *,
    robots: Robots | None = None,
    progress: Progress = lambda now, end: False,
    longest: float = math.inf,
) -> Flight:
    """Fly a scenario from its initial state to its goal, without ROS, like ``spacerobot run``.

    Parameters
    ----------
    scenario
        The scenario to fly in lockstep.
    robots
        The models; by default, the models named in the scenario.
    progress
        Called with the flight's progress; it may end the flight.
    longest
        Simulated time after which the flight is interrupted, s.

    Raises
    ------
    ParameterError
        A parameter or the robot is invalid, or the scenario requires nodes.
    GoalError
        The goal's joint positions belong to another robot.
    """
    return LockstepFlight(scenario, robots).fly(progress, longest)


@dataclass(frozen=True)
class _Host:
    """The :class:`~spacerobot_ros.commanding.host.CommanderHost` of a commander here."""

    flight: LockstepFlight
    node: str
    send_command: Callable[[int], None]

    def publish_status(self, status: Status) -> None:
        self.flight.take_status(status)

    def report_event(self, event: Event) -> None:
        self.flight.take_event(self.node, event)

    def publish_plan(
        self, path: BasePath, stamp_ns: int, schedule: GaitSchedule | None = None
    ) -> None:
        self.flight.log.paths.append((stamp_ns, path))
        if schedule is not None:
            self.flight.log.schedules.append((stamp_ns, schedule))

    def log(self, level: str, message: str) -> None:
        pass

    def has_publisher(self, topic: str) -> bool:
        return topic == "odom" or (topic == JOINT_REFERENCE and self.flight.has_planner)

    def waiting_states(self) -> tuple[list[Stamped], list[Stamped]]:
        return [], []


class LockstepFlight:
    """One flight in lockstep, tick by tick.

    Parameters
    ----------
    scenario
        The scenario to fly; :func:`require_flyable` must accept it.
    robots
        The models.

    Raises
    ------
    ParameterError
        A parameter or the robot is invalid.
    GoalError
        The goal's joint positions belong to another robot.
    """

    def __init__(self, scenario: Scenario, robots: Robots | None = None) -> None:
        require_flyable(scenario)
        robots = robots or Robots.of(scenario)
        config = scenario.plant
        self._scenario, self._robots = scenario, robots
        self._period_ns = config.period_ns
        self._tick = 0
        self._plant: PlantWithFaults = build_plant(robots.plant, config)
        scenario.require_shape_of(robots.plant)
        self._reported = ReportedState(self._plant, config)
        self._commands = CommandValidator(self._plant, config)
        self._monitor = PlantMonitor(self._commands, self._plant, config)
        self._injected_seen = self._plant.injected
        self._diagnostics = PlantDiagnostics("/plant", self._plant, self._commands)
        self._report_ticks = config.ticks_of(config.diagnostics_period)
        self._contact_ticks = config.contact_ticks
        self._clearance: ClearanceMonitor | None = None
        if self._contact_ticks:
            self._clearance = ClearanceMonitor.of(
                robots.plant.description,
                tuple(robots.plant.link_names),
                capturing=self._plant.capturing,
                has_contact_forces=config.engine == "mujoco",
            )
        self._diagnosed_ns: dict[str, int] = {}
        """Time of the last diagnostics of each commander, ns."""
        self._statuses: dict[str, StatusRecord] = {}
        self.log = FlightLog(self._plant, self._reported, self._commands, self._period_ns)
        self._follower = GoalFollower(GoalIds().of(*_FIRST_GOAL_STAMP))
        self._commanded = False
        """Whether the command for the current state has been sent."""
        self._decided_before_command: bool | None = None
        """Whether a commander decided about the goal before its command; None: not decided."""
        self._status: Status | None = None
        self._interrupted = False
        self._planner: PlannerCommander | None = None
        self._controller: ControllerCommander | None = None
        self._commanders: dict[str, Commander] = {}
        for name in scenario.commanders:
            if name == "planner":
                tracked = "coordinated_control" in scenario.commanders
                send = self._send_reference if tracked else self._send_setpoint
                host, method = _Host(self, name, send), robots.method
                self._planner = PlannerCommander(scenario.planner, host, method=method)
                self._planner.use_robot(robots.planner, ArrayDecoder())
                self._commanders[name] = self._planner
            else:
                host = _Host(self, name, self._send_actuation)
                self._controller = ControllerCommander(scenario.controller, host)
                self._controller.use_robot(robots.controller, ArrayDecoder())
                if self._plant.capturing is not None:
                    self._controller.use_target(self._plant.capturing.target.description)
                self._commanders[name] = self._controller

    # -- the flight ---------------------------------------------------------------------------

    def fly(self, progress: Progress, longest: float) -> Flight:
        """Fly until the goal is completed; for parameters see :func:`fly_scenario`."""
        began = time.perf_counter()
        interrupted = self._fly(progress, longest)
        return self.until_now(time.perf_counter() - began, interrupted)

    def interrupt(self) -> None:
        """End the flight and the planning in progress; this may be called from another thread."""
        self._interrupted = True
        for commander in self._commanders.values():
            commander.interrupt()

    def _fly(self, progress: Progress, longest: float) -> str:
        """Fly; return why the flight was interrupted, empty if the goal was decided."""
        reported_at = time.perf_counter()
        self._commands.revoke_before(0)
        for source in self._commands.sources:
            wrench = source.quantity == "wrench"
            source.commanders = int(self._controller is not None) if wrench else 1
        self._commands.require_commanded()
        self.log.plant_statuses.append((0, self._monitor.status))
        for commander in self._commanders.values():
            commander.activate()
        self._report_plant_status(PlantState.RUNNING)
        self._commanded = False
        self._send_goals()
        self._report_state()
        while True:
            self._answer_state()
            if self._interrupted:
                return self._interruption
            if self._decided_before_command:
                return ""
            if not self._commands.complete and not self._reported.sensors.dropout:
                return f"There is no command for the state at {self.time:g} s."
            ends = self._decided_before_command is not None
            if not self._step():
                return ""
            self._report_state()
            if self._plant.injected is not self._injected_seen:
                self._report_plant_status(PlantState.RUNNING)
            if ends:
                return ""
            if self.time >= longest:
                return self._interruption
            if time.perf_counter() - reported_at >= _PROGRESS_PERIOD:
                reported_at = time.perf_counter()
                if progress(self.time, self._status.ends_at_s if self._status else 0.0):
                    return self._interruption

    @property
    def _interruption(self) -> str:
        return f"Interrupted after {self.time:.6g} s of simulated time."

    @property
    def has_planner(self) -> bool:
        """Whether there is a planner whose reference a controller tracks."""
        return self._planner is not None

    @property
    def _now_ns(self) -> int:
        return self._tick * self._period_ns

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._now_ns / SECOND

    def _report_state(self) -> None:
        self._reported.update()
        self.log.add_state(self._tick)
        if self._report_ticks and self._tick % self._report_ticks == 0:
            self.log.diagnostics.append((self._now_ns, tuple(self._diagnostics.records())))
        clearance, plant = self._clearance, self._plant
        if clearance is not None and self._tick % self._contact_ticks == 0:
            _, events = clearance.measure(plant.link_R, plant.link_r, plant.pose, self.time)
            if events:
                self.log.events += [replace(event, node="plant") for event in events]
                self._monitor.contacts = clearance.contacts
                self._report_plant_status(PlantState.RUNNING)

    def _step(self) -> bool:
        """Step with the commands of the tick; return whether the plant could step."""
        commands = self._commands.begin_step()
        try:
            self._plant.step(*commands)
        except SpaceRobotError as error:
            self._monitor.failure = "model", f"The plant stops at {self.time:g} s: {error}"
            self._commands.rest()
            self._report_plant_status(PlantState.FAILED)
            return False
        if self._plant.capturing is not None and self._plant.capturing.events:
            self._report_plant_status(PlantState.RUNNING)
        self._tick += 1
        return True

    def _answer_state(self) -> None:
        self._commanded = False
        quantities, now = self._reported.quantities, self._now_ns
        q, qdot = quantities["measured_q"], quantities["measured_qdot"]
        if self._controller is not None:
            # Joint states whose pose is lost are answered at the next tick.
            q, qdot = q.copy(), qdot.copy()
        pose, twist = quantities["measured_pose"], quantities["measured_twist"]
        state = StateArrays(now, q, qdot, pose, twist)
        measured = "target_pose" in quantities and not self._reported.misses_target
        if self._controller is not None and measured:
            pose, twist = quantities["target_pose"], quantities["target_twist"]
            self._controller.receive_target(now, StateArrays(now, q, qdot, pose, twist))
        for name, commander in self._commanders.items():
            if not self._reported.sensors.dropout:
                commander.take_odom(now, state)
            commander.take_joints(now, state)
            period_ns = commander.config.diagnostics_period * SECOND
            if period_ns and now - self._diagnosed_ns.get(name, 0) >= period_ns:
                assert commander.robot is not None
                robot, last = commander.robot.description.name, self._statuses.get(name)
                records = state_diagnostics(f"/{name}", robot, {"ignored": 0}, last)
                self.log.diagnostics.append((now, tuple(records)))
                self._diagnosed_ns[name] = now

    def _send_setpoint(self, stamp_ns: int) -> None:
        """Offer the setpoint of a planner that commands the joints itself."""
        assert self._planner is not None
        source, setpoint = self._commands.sources[0], self._planner.setpoint
        velocity = source.quantity == "velocity"
        values = setpoint.velocity if velocity else np.zeros(len(setpoint.velocity))
        self._offer_command(source, values, stamp_ns, (setpoint.position, setpoint.velocity))
        self._commanded = True

    def _send_reference(self, stamp_ns: int) -> None:
        """Pass the planner's setpoint to the controller."""
        assert self._planner is not None
        assert self._controller is not None
        position, velocity = self._planner.setpoint.position, self._planner.setpoint.velocity
        reference = StateArrays(stamp_ns, position.copy(), velocity.copy())
        self._controller.receive_reference(JOINT_REFERENCE, stamp_ns, reference)
        self.log.add_command(JOINT_REFERENCE, self._tick, velocity, (position, velocity))

    def _send_actuation(self, _: int) -> None:
        """Offer the controller's commands; its later decisions come after them."""
        assert self._controller is not None
        now, effort = self._now_ns, self._controller.effort
        for source in reversed(self._commands.sources):  # The wrench is sent first.
            values = self._controller.wrench if source.quantity == "wrench" else effort
            if source.quantity == "velocity":
                values = np.zeros(len(effort))
            self._offer_command(source, values, now)
        self._commanded = True

    def _offer_command(
        self,
        source: CommandSource,
        values: Array,
        now: int,
        setpoint: tuple[Array, Array] | None = None,
    ) -> None:
        self.log.add_command(source.topic, self._tick, values, setpoint)
        if self._decided_before_command:
            return
        refusal = self._commands.accept_or_refuse(source, now, values, now)
        if refusal is not None:
            self._diagnostics.note_refusal(source, refusal)
            self.log.refusals.append((self.time, source.topic, refusal))
            if refusal.latches:
                self._report_plant_status(PlantState.RUNNING)

    # -- plant status -------------------------------------------------------------------------

    def _report_plant_status(self, activity: PlantState) -> None:
        self._injected_seen, self._commanded = self._plant.injected, True
        before = self._monitor.status
        self.log.events += self._events_until(activity)
        status = self._monitor.status
        if status is not before:
            self.log.plant_statuses.append((self._now_ns, status))
            for commander in self._commanders.values():
                commander.receive_plant_status(status)

    def _events_until(self, activity: PlantState) -> list[Event]:
        events = self._monitor.update(activity, self.time)
        return [replace(event, node="plant") for event in events]

    # -- goals and statuses -------------------------------------------------------------------

    def _send_goals(self) -> None:
        """Send the goals as a mission client does: before the first state."""
        scenario, goal = self._scenario, self._scenario.goal
        # A pose is checked, and its quaternion normalised, on reception.
        checked = Goal.checked(goal.position, goal.quaternion, goal.joint_positions)
        given = replace(goal, quaternion=checked.quaternion)
        if self._planner is not None:
            self._planner.receive_goal(BASE_GOAL_KEY, *_FIRST_GOAL_STAMP, lambda: given)
        if self._controller is not None:
            receive, tool = self._controller.receive_goal, scenario.end_effector_goal
            pose = replace(given, joint_positions=None, end_effectors=(), base=POSE)
            unshaped = replace(pose, asked=goal.asked & goal.base)
            if given.base:
                receive(BASE_GOAL_KEY, *_FIRST_GOAL_STAMP, lambda: unshaped)
            own = ("", DEFAULT_END_EFFECTOR)
            heard = [x for x in goal.end_effectors if self._planner is None or x.link in own]
            if heard:
                receive(END_EFFECTOR, *_FIRST_GOAL_STAMP, lambda: Goal.of_end_effectors(heard))
            if tool is not None:
                r, q = tool.position, tool.quaternion
                receive(END_EFFECTOR, *_FIRST_GOAL_STAMP, lambda: Goal.checked(r, q))

    def take_status(self, status: Status) -> None:
        """Track the status like a mission client."""
        self.log.statuses.append((self._now_ns, status))
        name = "planner" if isinstance(status, PlannerStatus) else "coordinated_control"
        self._statuses[name] = StatusRecord.of(f"/{name}", status, status.state.level)
        if isinstance(status, PlannerStatus) is not self.has_planner:
            return
        if self._decided_before_command is not None:
            return
        self._status = status
        if self._follower.update(status):
            self._decided_before_command = not self._commanded

    def take_event(self, node: str, event: Event) -> None:
        """Store a commander event; its time defaults to the current time."""
        time = self.time if event.time_s is None else event.time_s
        self.log.events.append(replace(event, time_s=time, node=node))

    def until_now(self, wall_time: float, interrupted: str = "") -> Flight:
        """Return the flight up to the current time; ``interrupted`` gives the reason for an early
        end, if any."""
        decision = None if self._interrupted else self._follower.decision
        outcome = Outcome.INTERRUPTED if decision is None else Outcome(decision.state.value)
        message = interrupted
        if decision is not None:
            message = decision.message
        elif not interrupted and self._status is not None:
            message = self._monitor.status.message or self._status.message
        if self._monitor.status.state is not PlantState.FAILED:
            self.log.events += self._events_until(PlantState.INACTIVE)
            self.log.plant_statuses.append((self._now_ns, self._monitor.status))
        plan_time = 0.0
        if self._planner is not None:
            plan_time = self._planner.statistics.plan_time_s
        if self._controller is not None and self._controller.executive is not None:
            plan_time += self._controller.executive.plan_time
        scenario, data = self._scenario, self.log.data()
        robot = self._robots.plant.description
        return Flight(
            scenario=scenario,
            robot=robot,
            joint_names=tuple(robot.joint_names),
            outcome=outcome,
            message=message,
            goal=scenario.goal.kept_at(*np.split(data["series"]["pose"].values[0], [3])),
            end_effector_goal=scenario.end_effector_goal,
            status=self._status,
            gait=self._follower.gait,
            plan_time=plan_time,
            wall_time=wall_time,
            measures_clearance=scenario.plant.clearance_period > 0,
            **data,
        )
