"""An executive and the plant that it moves, in one loop and without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitSchedule, Goal
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Executive
from spacerobot_ros.planning.execution.goal_file import GoalFile, IdentifiedGoal, PursuedGoals
from spacerobot_ros.planning.execution.measured_states import BaseMeasurement, MeasuredState
from spacerobot_ros.planning.execution.status import (
    Notice,
    Output,
    PlannerState,
    PlannerStatus,
    PlanReason,
    ScheduleStart,
    Transition,
)
from spacerobot_ros.planning.execution.worker import Planned, PlanningTask, PlanningWorker, Refused
from spacerobot_ros.planning.methods.registry import build_method
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import InitialState, VelocityPlant

Array = npt.NDArray[np.float64]
Place = tuple[Sequence[float], Sequence[float]]
"""Position in m and rotation vector in rad."""

TICK = 0.05
TICK_NS = 50_000_000

HERE: Place = ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
NEAR: Place = ([0.05, -0.03, 0.02], [0.0, 0.0, 0.0])
TURNED: Place = ([0.02, -0.03, 0.01], [0.01, -0.005, 0.015])

# A slide of 2 s in one swing and turns in cycles of 1 s: hundreds of ticks instead of 98,000.
QUICK = {
    "method": "lie_bracket",
    "tick_rate": 1 / TICK,
    "plan_in_background": False,
    "lie_bracket.t1": 2.0,
    "lie_bracket.n1": 1,
    "lie_bracket.cycle_period": 1.0,
}


@cache
def robot_of(name: str = "sliding_masses") -> SpaceRobot:
    """Return the model of a robot of the package, or of a URDF file."""
    path = Path(name) if name.endswith(".urdf") else share_directory() / "urdf" / f"{name}.urdf"
    return SpaceRobot.from_file(path)


def goal_at(place: Place) -> Goal:
    position, rotvec = place
    return Goal.checked(position, Rotation.from_rotvec(rotvec).as_quat())


class StubMethod(GaitMethod):
    """Slides the base of the robot with three sliders in a straight line: one plan in 20 us.

    Its base is at ``-q/8`` off the centre of mass. Goals beyond 1 m are refused; so are all while
    ``refusing`` is set. Its gaits may be ``partial`` (half of the way), or too long by the share
    ``overshoot``; the path it predicts may be wrong by ``wrong_path``, m. Only the position is
    controlled.
    """

    name: ClassVar[str] = "stub"

    def __init__(self, ticks: int = 8) -> None:
        super().__init__(robot_of(), TICK)
        self.requests: list[PlanRequest] = []
        self.ticks, self.refusing, self.partial = ticks, False, False
        self.overshoot, self.wrong_path = 0.0, 0.0

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        self.requests.append(request)
        state, way = request.state, request.goal.position - request.state.position
        if self.refusing or np.linalg.norm(request.goal.position) > 1.0:
            raise PlanningError("It is too far.")
        s = np.linspace(0.0, 1.0, self.ticks + 1)[:, np.newaxis]
        share = (1.0 + self.overshoot) * (1 - np.cos(np.pi * s)) / 2
        if self.partial:
            share /= 2
        time: Array = TICK * np.arange(self.ticks + 1, dtype=float)
        moved = share * way
        if request.motion is not None:
            # Comes to rest and back meanwhile.
            moved = moved - TICK * self.ticks * s * (1 - s) ** 2 * request.motion.velocity / 8
        path = BasePath(
            time,
            state.position + moved + share * self.wrong_path,
            np.tile(state.quaternion, (self.ticks + 1, 1)),
        )
        schedule = GaitSchedule(
            method=self.name,
            joint_names=self.robot.joint_names,
            control_period=TICK,
            positions=state.q - 8 * moved,
            path=path,
            goal=request.goal,
            partial=self.partial,
        )
        return replace(schedule, controls=frozenset({"position"}))


class MovingStub(StubMethod):
    """The same; its gaits may begin in motion."""

    starts_in_motion: ClassVar[bool] = True


class HeldWorker(PlanningWorker):
    """A worker in the background whose plans are there when a test says so: no thread."""

    def __init__(
        self, robot: SpaceRobot, config: PlannerConfig, method: GaitMethod | None = None
    ) -> None:
        super().__init__(robot, config, method)
        self.plans_in_background = True
        self.task: PlanningTask | None = None
        self.cancelled = self.released = self.plans_with_stuck_joints = False
        self.tasks: list[PlanningTask] = []

    @property
    def is_busy(self) -> bool:
        return self.task is not None

    def start(self, task: PlanningTask) -> None:
        assert self.task is None
        self.task, self.cancelled, self.released = task, False, False
        self.tasks.append(task)

    def release(self) -> None:
        """Let the plan be there at the next look."""
        self.released = True

    def take_result(self) -> Planned | Refused | None:
        if self.task is None or not self.released:
            return None
        task, self.task = self.task, None
        if self.cancelled:
            return None
        if self.plans_with_stuck_joints:
            task = replace(task, stuck_joint_positions={})
        try:
            return Planned(self.plan(task, Cancellation()), 0.25)
        except PlanningError as refusal:
            return Refused(str(refusal), 0.25)

    def cancel(self) -> None:
        self.cancelled = True

    def close(self) -> None:
        self.cancelled = self.released = True


class PlantState:
    """The measured state of a plant."""

    def __init__(self, plant: VelocityPlant) -> None:
        self._plant = plant
        self.stamp_ns = 0
        self.seen = True
        """Whether the base is measured."""
        self.broken = False
        """Whether all that is measured is no number."""

    @property
    def q(self) -> Array:
        return self._plant.q * np.nan if self.broken else self._plant.q

    @property
    def base(self) -> BaseMeasurement | None:
        if not self.seen:
            return None
        pose = self._plant.pose * np.nan if self.broken else self._plant.pose
        return BaseMeasurement(pose, self._plant.twist, self._plant.qdot)

    @property
    def now(self) -> MeasuredState:
        return MeasuredState(self.stamp_ns, self.q, self.base)


class Loop:
    """An executive and a plant that does what it is told, tick by tick.

    Parameters
    ----------
    parameters
        Of the planner, by name; beside a quick gait.
    robot, initial
        The plant's; the planner has the robot ``believed``, by default the same.
    method
        Plans instead of the one that the parameters name.
    held
        Plan in the background, where every plan is there when a test says so.
    """

    def __init__(
        self,
        parameters: dict[str, Any] | None = None,
        *,
        robot: str = "sliding_masses",
        believed: str = "",
        initial: InitialState | None = None,
        method: GaitMethod | None = None,
        held: bool = False,
        goal_file: GoalFile | None = None,
    ) -> None:
        self.config = configured(PlannerConfig, {**QUICK, **(parameters or {})})
        self.plant = VelocityPlant(robot_of(robot), TICK, initial)
        model = robot_of(believed or robot)
        self.method = method or build_method(
            self.config.method,
            model,
            self.config.control_period,
            self.config.integration_step,
            self.config.method_options,
            Clearance.wanted(model.description, self.config.clearance),
        )
        self.held = HeldWorker(model, self.config, self.method)
        self.worker = self.held if held else PlanningWorker(model, self.config, self.method)
        self.executive = Executive(model, self.config, self.worker)
        self.goal_file = goal_file or GoalFile("")
        self.measured = PlantState(self.plant)
        self.outputs: list[Output] = []
        self.shapes: list[Array] = [self.plant.q.copy()]
        """The shape (n,) at every tick."""
        self.commands: list[Array] = []
        """The velocities (n,) that were commanded at every tick."""
        self.poses: list[Array] = [self.plant.pose.copy()]
        """The pose (7,) of the base at every tick."""
        self._goals = 0

    # -- acting -------------------------------------------------------------------------------

    def propose_goal(self, place: Place | Goal) -> str:
        """Propose a goal; return its id."""
        self._goals += 1
        goal = place if isinstance(place, Goal) else goal_at(place)
        if isinstance(self.method, StubMethod):
            goal = replace(goal, asked=frozenset({"position"}))  # All that it controls.
        self.executive.propose_goal(IdentifiedGoal(goal, f"goal-{self._goals}"))
        self.take()
        return f"goal-{self._goals}"

    def abort(self) -> str | None:
        sentence = self.executive.abort()
        self.take()
        return sentence

    def stop(self) -> None:
        self.executive.reset()
        self.take()

    def late(self) -> None:
        """Show the base of the state that was answered last."""
        self.measured.seen = True
        self.executive.add_base_measurement(self.measured.now)
        self.take()

    def set(self, **parameters: Any) -> None:
        """Change live parameters."""
        self.config = replace(self.config, **parameters)
        self.executive.config = self.config

    def tick(self, count: int = 1, *, base: bool = True) -> None:
        """Answer this many states and step the plant; ``base``: whether it is measured."""
        for _ in range(count):
            self.measured.seen = base
            setpoint = self.executive.update(self.measured.now)
            self.take()
            assert np.all(np.isfinite(setpoint.position))
            assert np.all(np.isfinite(setpoint.velocity))
            self.commands.append(setpoint.velocity.copy())
            self.plant.step(setpoint.velocity)
            self.measured.stamp_ns += TICK_NS
            self.shapes.append(self.plant.q.copy())
            self.poses.append(self.plant.pose.copy())

    def until(self, *states: PlannerState) -> PlannerStatus:
        """Tick until the latest status is one of these; return it."""
        for _ in range(4000):
            if self.statuses and self.statuses[-1].state in states:
                return self.statuses[-1]
            self.tick()
        raise AssertionError(f"not {states} but {self.statuses}")

    def decide(self, place: Place | Goal) -> PlannerStatus:
        """Propose a goal and tick until it is decided; return the status that decides it.

        Plans in the background are there a tick after they were begun.
        """
        before = len(self.statuses)
        self.propose_goal(place)
        for _ in range(4000):
            self.held.release()
            self.tick()
            decided = [s for s in self.statuses[before:] if s.state.decided]
            if decided:
                return decided[-1]
        raise AssertionError(f"not decided: {self.statuses[before:]}")

    def take(self) -> None:
        """Take what the executive has put out."""
        for output in self.executive.outputs:
            match output:
                case PursuedGoals() as pursued:
                    if problem := self.goal_file.pursue(pursued):
                        output = Notice("error", problem)
                case PlannerStatus() as status if status.state.decided:
                    refused = status.state is PlannerState.REFUSED
                    self.goal_file.end(status.goal_id, refused=refused)
            self.outputs.append(output)
        self.executive.outputs.clear()

    # -- looking ------------------------------------------------------------------------------

    @property
    def statuses(self) -> list[PlannerStatus]:
        return [output for output in self.outputs if isinstance(output, PlannerStatus)]

    @property
    def states(self) -> list[str]:
        """The states that were reported, but for those of plans that are being made."""
        return [s.state.value for s in self.statuses if s.state is not PlannerState.PLANNING]

    @property
    def starts(self) -> list[ScheduleStart]:
        return [output for output in self.outputs if isinstance(output, ScheduleStart)]

    @property
    def events(self) -> list[Event]:
        return [output for output in self.outputs if isinstance(output, Event)]

    @property
    def event_kinds(self) -> list[tuple[str, str]]:
        """Kind and goal of every event, in order."""
        return [(event.kind.value, event.goal_id) for event in self.events]

    @property
    def plan_reasons(self) -> list[PlanReason]:
        """Why plans were requested."""
        started = [each for each in self.events if each.kind is EventKind.PLAN_STARTED]
        return [PlanReason(each.about["reason"]) for each in started]

    @property
    def notices(self) -> list[str]:
        return [output.message for output in self.outputs if isinstance(output, Notice)]

    @property
    def transitions(self) -> list[Transition]:
        outputs = [*self.outputs, *self.executive.outputs]
        return [output for output in outputs if isinstance(output, Transition)]

    @property
    def speeds(self) -> list[float]:
        """The largest commanded velocity at every tick."""
        return [float(np.abs(velocity).max()) for velocity in self.commands]

    def error_to(self, place: Place) -> tuple[float, float]:
        """Return how far the base is from a goal: m, rad."""
        pose = self.plant.pose
        turn = Rotation.from_quat(pose[3:]).inv() * Rotation.from_rotvec(place[1])
        return float(np.linalg.norm(pose[:3] - place[0])), float(turn.magnitude())
