"""Plans on request: synchronously, with time stopped, or in a thread while states are processed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningCancelled, PlanningJob
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import Controlled, PoseError, RobotState
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.planning.execution.measured_states import PathSensitivity
from spacerobot_ros.planning.execution.status import PlanReason
from spacerobot_ros.planning.execution.tracker import TakeOver
from spacerobot_ros.planning.methods.registry import METHODS, RemainingJointsGait, build_method
from spacerobot_ros.times import SECOND

_COASTING_TIME, _COASTING_FACTOR = 2.0, 2.0
"""Rest period, s, at the start of a background plan for a drifting robot, and, if this period was
too short, the factor by which the time from then to the end of planning is multiplied."""

_MAX_COASTING_TIME = 600.0
"""Longest such time, s."""


@dataclass(frozen=True)
class PlanJob:
    """A requested plan.

    Attributes
    ----------
    identified
        The goal.
    reason
        Reason for the request.
    error
        Remaining error of an active goal at rest, or deviation of the base from its path.
    take_over
        Tick at which the plan takes over in motion; None: the plan begins at rest, or with braking.
    """

    identified: IdentifiedGoal
    reason: PlanReason
    error: PoseError | None = None
    take_over: TakeOver | None = None


@dataclass(frozen=True)
class PlanningTask:
    """A plan to make.

    Attributes
    ----------
    request
        The request, starting from the measured state.
    stuck_joint_positions
        Positions of joints excluded from planning, m or rad, by name.
    required
        Goal components that a plan without these joints must control.
    braking
        (K + 1, n) shapes at the ticks before the gait, m or rad: the joints brake, or they rest
        while the base drifts; None: the gait begins immediately.
    rates_after_braking
        (n,) velocities held after braking, m/s or rad/s, for reaction wheels; None: zero.
    take_over
        Tick at which the plan takes over in motion; None: the plan begins at rest, or with braking.
    """

    request: PlanRequest
    stuck_joint_positions: Mapping[str, float] = field(default_factory=dict)
    required: frozenset[Controlled] = frozenset()
    braking: Array | None = None
    rates_after_braking: Array | None = None
    take_over: TakeOver | None = None


@dataclass(frozen=True)
class Planned:
    """A plan, the wall time spent planning, s, and the stamp of its first tick, ns."""

    schedule: GaitSchedule
    wall_time: float
    begins_ns: int = 0


@dataclass(frozen=True)
class Refused:
    """The reason for a failed plan, as a message, and the wall time spent planning, s."""

    reason: str
    wall_time: float = 0.0


class PlanningWorker:
    """Plans with a planner's method, one plan at a time.

    With ``plan_in_background``, a thread plans: CasADi and numpy release Python's global
    interpreter lock for most of the time. A drifting robot keeps moving during planning, so its
    plans begin with a rest period; if planning takes longer, the rest period of the next plan is
    extended. The thread uses the robot's functions, whose buffers are shared: while the worker is
    :attr:`is_busy`, nothing else may use them.

    Parameters
    ----------
    robot
        The model.
    config
        The planner configuration.
    method
        Planning method that uses all joints; None: the method named in the configuration.
    long_work
        Returns the context for synchronous planning.
    described
        The robot with its current obstacles; None: as described by the model.

    Raises
    ------
    ParameterError
        An option is incompatible with the robot or with another option.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        config: PlannerConfig,
        method: GaitMethod | None = None,
        long_work: Callable[[], AbstractContextManager[None]] = nullcontext,
        described: RobotDescription | None = None,
    ) -> None:
        self._robot, self._config, self._long_work = robot, config, long_work
        self.plans_in_background = config.plan_in_background
        """Whether planning runs in a thread."""
        self.clearance = Clearance.wanted(described or robot.description, config.clearance)
        """Distances that plans keep; None: any."""
        self._method = method or build_method(
            config.method,
            robot,
            config.control_period,
            config.integration_step,
            config.method_options,
            self.clearance,
        )
        self._sensitivity = PathSensitivity(robot)
        self._remaining_joints: tuple[object, GaitMethod] | None = None
        """The stuck joints and required goal components of a task, and the method used for it."""
        self._job: PlanningJob[GaitSchedule] | None = None
        self._time = 0.0
        """Wall time of the work on the requested plan so far, s."""
        self._coasting: tuple[PlanningTask, int, float] | None = None
        """A task that begins with a rest while the base drifts, its stamp, ns, and the rest, s."""

    @property
    def is_busy(self) -> bool:
        """Whether a plan is in progress, its result is waiting, or its thread is still running."""
        return self._job is not None

    def is_free(self) -> bool:
        """Whether a plan can be requested, after discarding the result of a cancelled plan."""
        if self.is_busy:
            self.take_result()
            return False
        return True

    def starts_in_motion(self, schedule: GaitSchedule) -> bool:
        """Whether a plan may take over from a schedule: the methods of both must allow it."""
        maker = METHODS.get(schedule.method, type(self._method))
        return self._method.starts_in_motion and maker.starts_in_motion

    def submit(self, task: PlanningTask, stamp_ns: int) -> None:
        """Make a plan from the state with this stamp, synchronously or in a thread."""
        self._coasting, self._time = None, 0.0
        state, at_rest = task.request.state, task.braking is None and task.take_over is None
        momenta = state.linear_momentum, state.angular_momentum
        drifts = any(self._method.significant(each).any() for each in momenta)
        if at_rest and drifts and self.plans_in_background:
            self._start_coasting(task, stamp_ns, _COASTING_TIME)
        else:
            self.start(task)

    def _start_coasting(self, task: PlanningTask, begins_ns: int, duration: float) -> None:
        """Plan a gait that begins where the base has drifted to after a rest."""
        self._coasting, period = (task, begins_ns, duration), self._config.control_period
        ticks = math.ceil(duration / period - 1e-9)
        shapes = np.tile(task.request.state.q, (ticks + 1, 1))
        if task.rates_after_braking is not None:
            shapes += period * np.arange(ticks + 1)[:, np.newaxis] * task.rates_after_braking
        self.start(replace(task, braking=shapes))

    def start(self, task: PlanningTask) -> None:
        """Start planning a task."""
        assert self._job is None, "one plan at a time"
        self._job = PlanningJob(partial(self.plan, task))
        with nullcontext() if self.plans_in_background else self._long_work():
            self._job.start(in_background=self.plans_in_background)

    def poll(self, stamp_ns: int) -> Planned | Refused | None:
        """Return the result for the state with this stamp; None before the end, or if cancelled.

        Unexpected method errors are raised here.
        """
        result, coasting = self.take_result(), self._coasting
        if result is not None:
            self._time += result.wall_time
            result = replace(result, wall_time=self._time)
        if not isinstance(result, Planned):
            return result
        if coasting is None:
            return replace(result, begins_ns=stamp_ns)
        task, begins_ns, duration = coasting
        elapsed = (stamp_ns - begins_ns) / SECOND
        if elapsed <= duration:
            return replace(result, begins_ns=begins_ns)
        if elapsed > _MAX_COASTING_TIME:
            return Refused(
                f"The robot drifts, and {elapsed:.3g} s of planning were too short to find a plan "
                f"that begins in time; a smaller optimal.starts shortens planning",
                result.wall_time,
            )
        # The base has drifted past the start of the plan.
        self._start_coasting(task, begins_ns, _COASTING_FACTOR * elapsed)
        return None

    def take_result(self) -> Planned | Refused | None:
        """Return the result, once; None until planning has ended, or if it was cancelled."""
        job = self._job
        if job is None or not job.done:
            return None
        self._job = None
        try:
            return Planned(job.result(), job.wall_time)
        except PlanningCancelled:
            return None
        except PlanningError as refusal:
            return Refused(str(refusal), job.wall_time)

    def cancel(self) -> None:
        """Cancel the current plan; no result is returned for it."""
        job = self._job  # Another thread may clear the attribute meanwhile.
        if job is not None:
            job.cancel()

    def close(self) -> None:
        """Cancel the current plan, and wait until its thread has ended."""
        if self._job is not None:
            self._job.close()

    def approach_ahead(self, schedule: GaitSchedule, begins: float, now: float) -> str:
        """Return a clause that states where the rest of a schedule comes too close to obstacles.

        ``begins`` and ``now`` are times, s. Empty if the schedule stays clear of obstacles.
        """
        if self.clearance is None or not self.clearance.has_obstacles:
            return ""
        period = self._config.control_period
        first = min(max(int((now - begins) / period), 0), schedule.ticks)
        ticks = np.arange(first, schedule.ticks + 1, dtype=float)
        base = BasePoses(*schedule.path.at(period * ticks))
        try:
            found = self.clearance.approaches(schedule.positions[first:], base=base)
        except PlanningError as refusal:
            return str(refusal).removesuffix(".")
        return self.clearance.clause(found[0], period) if found else ""

    def plan(self, task: PlanningTask, cancellation: Cancellation) -> GaitSchedule:
        """Plan in the calling thread.

        Raises
        ------
        PlanningError
            No plan was found; the message says why.
        """
        method, request, braking = self._choose_method(task), task.request, task.braking
        if task.take_over is not None:
            state = self._predict_motion(request.state, task.take_over.shapes)[0]
            request, braking = replace(request, state=state, motion=task.take_over.motion), None
        if braking is None:
            schedule = method.plan(request, cancellation)
        else:
            schedule = self._plan_with_braking(braking, task, method, cancellation)
        if not isinstance(schedule, GaitSchedule):
            raise PlanningError(f"The method '{method.name}' returned no GaitSchedule.")
        replans = self._config.replanning > 0 and self._config.takeover_time > 0
        if replans and self.starts_in_motion(schedule):
            # These derivatives take longer than a tick: in flight, the first command would be late.
            derivatives = self._sensitivity.path_derivatives(schedule)
            path = replace(schedule.path, mass_derivatives=derivatives)
            schedule = replace(schedule, path=path)
        return schedule

    def _choose_method(self, task: PlanningTask) -> GaitMethod:
        stuck, required, config = task.stuck_joint_positions, task.required, self._config
        if not stuck:
            return self._method
        if self._remaining_joints is None or self._remaining_joints[0] != (stuck, required):
            method = RemainingJointsGait(
                self._robot,
                config.control_period,
                config.integration_step,
                stuck=stuck,
                method=config.method,
                options=config.method_options,
                required=required,
                clearance=self.clearance,
            )
            self._remaining_joints = (stuck, required), method
        return self._remaining_joints[1]

    def _plan_with_braking(
        self, shapes: Array, task: PlanningTask, method: GaitMethod, cancellation: Cancellation
    ) -> GaitSchedule:
        """Return one schedule: braking in ``shapes`` (K + 1, n), then a gait from rest."""
        request = task.request
        shapes[0] = request.state.q
        at_rest, braking = self._predict_motion(request.state, shapes)
        at_rest = replace(at_rest, qdot=task.rates_after_braking)
        gait = method.plan(replace(request, state=at_rest), cancellation)
        path = BasePath(
            np.append(braking.time[:-1], braking.time[-1] + gait.path.time),
            np.vstack([braking.position[:-1], gait.path.position]),
            np.vstack([braking.quaternion[:-1], gait.path.quaternion]),
        )
        return replace(gait, positions=np.vstack([shapes[:-1], gait.positions]), path=path)

    def _predict_motion(self, state: RobotState, shapes: Array) -> tuple[RobotState, BasePath]:
        """Return the state after shapes (K + 1, n), one per tick, and the base path on the way."""
        config = self._config
        # Most manoeuvres have few ticks: compiling the step would take longer.
        robot = self._robot.interpreted
        prediction = BasePrediction(robot, config.control_period, config.integration_step)
        times: Array = config.control_period * np.arange(len(shapes), dtype=float)
        attitudes = prediction.attitudes(shapes, state.quaternion, state.angular_momentum)
        positions = prediction.positions(state, times, shapes, attitudes)
        q = shapes[-1].copy()
        after = replace(state, position=positions[-1], quaternion=attitudes[-1], q=q)
        return after, BasePath(times, positions, attitudes)
