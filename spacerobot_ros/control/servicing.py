"""Tasks that precede a goal: approaching a target until its capture, and detumbling after the
capture.

A task sets the controller's references, state by state, until it succeeds or fails. An approach
sets the end-effector reference; detumbling replaces the law until the robot is at rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from spacerobot_ros.control.approach import ApproachPlan, ArmReach, TargetClearance, plan_approach
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import CoordinatedController
from spacerobot_ros.control.detumbling import Detumbling, shortest_detumbling
from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.control.planned_reference import (
    PLANNING_TIME,
    GrappleReference,
    ReferencePlanner,
)
from spacerobot_ros.control.state import ControlState, PoseReference, Reference
from spacerobot_ros.errors import ParameterError, PlanningError, RobotDescriptionError, quantity
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import (
    BodyMotion,
    Payload,
    RelativeMotion,
    RobotMotion,
    TargetBody,
    frame_motion,
)
from spacerobot_ros.model.target_motion import FrameMotion, TorqueFreeMotion
from spacerobot_ros.planning.core.cancellation import PlanningJob
from spacerobot_ros.planning.methods.thrust.problem import Grapple

_PREDICTION_TOLERANCE = 0.02
"""Deviation (m and rad) of a target from its predicted motion beyond which the approach is
replanned."""

_AVERAGED = 100
"""Measurements over which the momenta of a target are averaged."""


class Task(str, Enum):
    """Controller tasks with a target, performed before a goal is pursued."""

    APPROACH = "approach"
    """Bring the end-effector to the grapple frame, and keep it there until the target is
    captured."""
    DETUMBLE = "detumble"
    """Bring the robot to rest, with or without a held body."""

    @classmethod
    def parsed(cls, text: str) -> tuple[Task, ...]:
        """Return the tasks in a space-separated string.

        Raises
        ------
        ParameterError
            A task does not exist.
        """
        known = [task.value for task in cls]
        for name in text.split():
            if name not in known:
                raise ParameterError(
                    f"Parameter 'tasks' names '{name}'; the tasks are {' and '.join(known)}."
                )
        return tuple(cls(name) for name in text.split())


class TaskState(Enum):
    """State of the current task after processing a robot state."""

    ACTIVE = "active"
    DONE = "done"
    REFUSED = "refused"
    """It cannot begin."""
    FAILED = "failed"
    """The task was aborted after it had begun."""


@dataclass(frozen=True)
class TaskProgress:
    """State of a task, with a sentence if it was refused or has failed."""

    state: TaskState
    message: str = ""


_ACTIVE, _DONE = TaskProgress(TaskState.ACTIVE), TaskProgress(TaskState.DONE)


class MeasuredTarget:
    """Description and last measurement of the target; None: not received.

    The momenta of a free target are constant, so their average predicts its motion better than one
    measurement: noise in a rate grows with the prediction time.
    """

    def __init__(self) -> None:
        self.description: RobotDescription | None = None
        self.body: TargetBody | None = None
        self.why_unknown = ""
        """Why the body is unknown; empty: nothing was received."""
        self.motion: BodyMotion | None = None
        """Motion of the target's root link."""
        self.time = -math.inf
        """Time of the measurement, s."""
        self.forget_momenta()

    def forget_momenta(self) -> None:
        """Average the momenta from the next measurement on, because they have changed."""
        self._count, self._momenta, self._scatter = 0, np.zeros(6), np.zeros(6)

    def describe(self, target: RobotDescription, grapple_frame: str) -> None:
        """Set the target description."""
        self.description = target
        self.forget_momenta()
        try:
            self.body, self.why_unknown = TargetBody.of(target, grapple_frame), ""
        except RobotDescriptionError as error:
            self.body, self.why_unknown = None, str(error)

    def measure(self, time: float, pose: Array, twist: Array) -> None:
        """Set the root link's pose (7,) and twist (6,) at a given time (s); the twist is in the
        link frame."""
        self.motion, self.time = BodyMotion.of(pose, twist), time
        if self.body is not None:
            self._count += 1
            change = np.concatenate(self.motion.momenta(self.body.inertia)) - self._momenta
            self._momenta += change / min(self._count, _AVERAGED)
            if self._count > 1:
                self._scatter = np.maximum(self._scatter, np.abs(change))

    @property
    def has_new_average(self) -> bool:
        """Whether the last measurement completes an average."""
        return self._count > 0 and self._count % _AVERAGED == 0

    def is_averaged(self, horizon: float) -> bool:
        """Whether the momenta are averages, or measured without noise that would matter in
        predictions for a given time, s."""
        assert self.body is not None
        scale = np.repeat([self.body.inertia.mass, self.body.least_inertia], 3)
        off = horizon * float(np.max(self._scatter / scale))
        return self._count >= (_AVERAGED if off > _PREDICTION_TOLERANCE else 2)

    def free_motion(self, time: float) -> TorqueFreeMotion:
        """Return the predicted motion of a described target from a given time (s) on."""
        assert self.body is not None
        assert self.motion is not None
        motion = self.motion
        if self._count > 1:
            motion = motion.with_momenta(self.body.inertia, self._momenta)
        free = TorqueFreeMotion(self.body, motion)
        return free.later(time - self.time) if time > self.time else free


_LONGEST_AVERAGING = 2.0
"""Longest time, s, for which a planned approach waits for the averages of noisy momenta."""

_LATEST_BEGIN = 0.1
"""Longest start delay of a motion, s."""


class ApproachTask:
    """An approach, planned at its first state and replanned if the target deviates from its
    predicted motion.
    """

    def __init__(
        self, target: MeasuredTarget, config: ControllerConfig, report: Callable[[Event], None]
    ) -> None:
        self.target, self.config, self._report_event = target, config, report
        self._plan: ApproachPlan | GrappleReference | None = None
        self._start = self._contact = 0.0
        """Times, in s after planning, at which the end-effector sets out and meets the target."""
        self._predicted: TorqueFreeMotion | None = None
        self._planned_at = 0.0
        self._began: float | None = None
        self._seen: tuple[float, ControlLaw, ControlState, FrameMotion] | None = None
        """Time until contact, s, law, and the last states of the robot and the grapple frame."""
        self._job: PlanningJob[GrappleReference] | None = None
        """The job that plans an approach."""
        self._lead = PLANNING_TIME
        self._is_forecast = False
        """Whether the latest plan is for a deviation at contact, predicted from average momenta."""
        self._looks_ahead = True
        """Whether deviations at contact count: not after planning for one has failed."""

    def step(
        self, time: float, state: ControlState, controller: CoordinatedController
    ) -> TaskProgress:
        """Set the controller's reference for a state."""
        options, target, planner = self.config.target, self.target, controller.planner
        if not controller.law.outputs.selection.end_effector:
            return self._ended(f"the law '{controller.law.name}' does not control an end-effector")
        self._began = time if self._began is None else self._began
        if target.motion is None or target.body is None:
            if not target.why_unknown and time - self._began < options.timeout:
                return _ACTIVE
            why = target.why_unknown.rstrip(".") or (
                "nothing is received on 'target/odom' and 'target/robot_description'"
            )
            return self._ended(f"the target is unknown: {why}")
        age = time - target.time
        if age > options.timeout:
            return self._ended(f"the target is lost: its odometry is {age:.3g} s old")
        if self._predicted is None and planner is not None:
            waits = time - self._began < _LONGEST_AVERAGING
            if waits and not target.is_averaged(options.horizon):
                return _ACTIVE
        grapple = TorqueFreeMotion(target.body, target.motion).grapple([max(age, 0.0)])
        try:
            if self._job is None and self._deviates(time, grapple):
                if planner is None:
                    self._make_plan(time, state, controller, target.body)
                else:
                    self._start_job(time, state, controller, planner)
            if planner is not None:
                self._take_plan(time, controller, planner)
        except PlanningError as error:
            if not self._is_forecast:
                why = str(error).rstrip(".")
                return self._ended(f"{why[0].lower()}{why[1:]}")
            # The target is where it was predicted to be: the robot continues with the current plan.
            self._looks_ahead = False
        if self._plan is None:
            return _ACTIVE
        plan, now = self._plan, time - self._planned_at
        self._seen = self._contact - now, controller.law, state.copied(), grapple
        if now > self._contact + options.patience:
            return self._ended(
                f"the target is missed: at contact, the end-effector is {self._distance_text}, and "
                f"it was not captured within {options.patience:g} s"
            )
        if now >= self._start:
            moving = plan.hand(grapple, np.array([now]))
            controller.follow(Reference(end_effector=PoseReference.of_motion(moving)))
        return _ACTIVE

    def close(self) -> None:
        """Cancel the planning job and wait for it to end."""
        if self._job is not None:
            self._job.close()
            self._job = None

    @property
    def message(self) -> str:
        """Sentence on the approach."""
        if self._seen is None:
            return "Approaching the target."
        left, *_ = self._seen
        when = f"contact in {left:.3g} s" if left > 0 else "in contact"
        return f"Approaching the target: the end-effector is {self._distance_text}; {when}."

    @property
    def _distance_text(self) -> str:
        assert self._seen is not None
        _, law, state, grapple = self._seen
        motion = RobotMotion(
            np.concatenate([state.r_WB, state.quaternion_WB]),
            np.concatenate([state.v_WB_B, state.omega_WB_B]),
            state.q,
            state.qdot,
        )
        hand = frame_motion(law.robot, law.outputs.selection.end_effector_link, motion)
        far = RelativeMotion.between(hand, grapple.body_motion())
        return (
            f"{quantity(far.distance, 'm')}, {quantity(far.angle, 'rad')}, "
            f"{quantity(far.speed, 'm/s')} and {quantity(far.rate, 'rad/s')} from the grapple frame"
        )

    def _ended(self, why: str) -> TaskProgress:
        if self._predicted is None:
            return TaskProgress(TaskState.REFUSED, f"The approach is refused: {why}.")
        return TaskProgress(TaskState.FAILED, f"The approach is aborted: {why}.")

    def _deviates(self, time: float, grapple: FrameMotion) -> bool:
        """Whether there is no plan, or the target deviates from the motion predicted for it, now or
        at contact; ``grapple`` is the measured motion of its grapple frame at this time, s."""
        self._is_forecast = False
        if self._predicted is None:
            return True
        now = time - self._planned_at
        if _is_off(self._predicted.grapple([now]), grapple):
            self.target.forget_momenta()
            return True
        if not (self._looks_ahead and self.target.has_new_average and now < self._contact):
            return False
        self._is_forecast = True
        later = self.target.free_motion(time).grapple([self._contact - now])
        return _is_off(self._predicted.grapple([self._contact]), later)

    def _start_job(
        self,
        time: float,
        state: ControlState,
        controller: CoordinatedController,
        planner: ReferencePlanner,
    ) -> None:
        """Start planning the base and the arm together."""
        options, target = self.config.target, self.target
        grapple = Grapple(
            target.free_motion(time),
            target.description,
            options.clearance,
            options.horizon,
            options.detumble == "before",
            options.standoff,
            options.corridor_angle,
            options.corridor_length,
        )
        lead = self._lead * planner.in_background
        self._job = controller.plan_grapple(time, state.copied(), grapple, lead)
        self._job.start(in_background=planner.in_background)

    def _take_plan(
        self, time: float, controller: CoordinatedController, planner: ReferencePlanner
    ) -> None:
        """Begin with a completed plan for base and arm; until then, the robot continues with an
        earlier one.
        """
        options, job = self.config.target, self._job
        if job is None or not job.done or time < job.begins:
            return
        self._job = None
        planned = job.result()
        self._looks_ahead = True
        if time - job.begins > _LATEST_BEGIN and planner.in_background:
            # The robot and the target have moved on.
            self._lead *= 2
            return
        self._predicted, self._planned_at = planned.grapple.motion, job.begins
        self._plan, self._start, self._contact = planned, 0.0, planned.duration
        controller.begin(job.begins, planned)
        contact = job.begins + planned.duration
        left = float(np.linalg.norm(planned.motion.joined_momentum(planned.grapple.motion)))
        message = (
            f"The base and the end-effector start at {job.begins:.4g} s and meet the target at "
            f"{contact:.4g} s; the plan leaves {left:.4g} N m s of angular momentum after the "
            f"grasp."
        )
        about = {
            "detumble": options.detumble,
            "planned_momentum_Nms": f"{left:.9g}",
            "planned_cost": f"{planned.motion.spent:.9g}",
        }
        self._report(message, (job.begins, contact, contact), about)

    def _make_plan(
        self, time: float, state: ControlState, controller: CoordinatedController, body: TargetBody
    ) -> None:
        law, options, described = controller.law, self.config.target, self.target.description
        outputs, clearance = law.outputs.selection, None
        held = controller.followed.end_effector
        held = held or controller.reference_at(time, state).end_effector
        assert held is not None
        if described is not None and options.clearance:
            clearance = TargetClearance(
                law.robot.description,
                outputs.end_effector_link,
                described,
                body.grapple,
                options.clearance,
            )
        target, rates = self.target.free_motion(time), controller.joint_rate_limits.rates
        link, axes = outputs.end_effector_link, outputs.end_effector
        reach = ArmReach(law.robot, link, axes, state, rates)
        plan = plan_approach(target, held, options, self.config.motion, reach, clearance)
        self._plan, self._start, self._contact = plan, plan.start, plan.contact
        self._predicted, self._planned_at, self._looks_ahead = target, time, True
        starts, closes, contact = (
            time + each for each in (plan.start, plan.closing_time, plan.contact)
        )
        message = (
            f"The end-effector sets out at {starts:.4g} s, closes in at {closes:.4g} s, and meets "
            f"the target at {contact:.4g} s."
        )
        self._report(message, (starts, closes, contact))

    def _report(
        self, message: str, times: tuple[float, float, float], more: dict[str, str] | None = None
    ) -> None:
        names = ("starts_s", "closes_s", "contact_s")
        about = {name: f"{time:.9g}" for name, time in zip(names, times, strict=True)}
        self._report_event(Event(EventKind.APPROACH_STARTED, message, about=about | (more or {})))


def _is_off(expected: FrameMotion, found: FrameMotion) -> bool:
    distance = np.linalg.norm(found.r - expected.r)
    # Matrices differ by the square root of 2 times a small angle.
    angle = np.linalg.norm(found.R - expected.R) / math.sqrt(2)
    return bool(max(distance, angle) > _PREDICTION_TOLERANCE)


class DetumblingTask:
    """Detumbling until the robot, with the body that it holds, has been at rest for a while."""

    def __init__(
        self, payload: Payload | None, config: ControllerConfig, report: Callable[[Event], None]
    ) -> None:
        self.payload, self.config, self._report_event = payload, config, report
        self._law: Detumbling | None = None
        self._began = self._momentum = self._fastest = 0.0
        self._at_rest_since: float | None = None

    def step(
        self, time: float, state: ControlState, controller: CoordinatedController
    ) -> TaskProgress:
        """Make the controller bring the robot to rest."""
        options = self.config.detumble
        if self._law is None:
            self._begin(time, state, controller)
        assert self._law is not None
        rates = [
            float(np.linalg.norm(state.omega_WB_B)),
            float(np.abs(state.qdot).max(initial=0.0)),
        ]
        self._fastest = max(rates)
        speed = float(np.linalg.norm(self._law.velocity(state)))
        pushed = controller.limits.force > 0.0
        if self._fastest > options.rate or (pushed and speed > options.speed):
            self._at_rest_since = None
        elif self._at_rest_since is None:
            self._at_rest_since = time
        if self._at_rest_since is not None and time - self._at_rest_since >= options.settle_time:
            self._end(self._at_rest_since)
            return _DONE
        limit = self.config.time_limit
        if limit and time - self._began > limit:
            return TaskProgress(
                TaskState.FAILED,
                f"The robot is not at rest after {limit:g} s: it still rotates at "
                f"{quantity(self._fastest, 'rad/s')} (detumble.rate: "
                f"{quantity(options.rate, 'rad/s')}), and its centre of mass moves at "
                f"{quantity(speed, 'm/s')} (detumble.speed: {quantity(options.speed, 'm/s')}).",
            )
        return _ACTIVE

    @property
    def message(self) -> str:
        """One-sentence description of the remaining motion."""
        fastest = quantity(self._fastest, "rad/s")
        return f"Detumbling: the base and the joints rotate at up to {fastest}."

    def _begin(self, time: float, state: ControlState, controller: CoordinatedController) -> None:
        limit = self.config.detumble.grapple_torque_limit
        self._law = controller.detumbling(self.payload, limit)
        self._began = time
        self._momentum = float(np.linalg.norm(self._law.angular_momentum(state)))
        controller.come_to_rest(self._law.command)
        bound = shortest_detumbling(self._momentum, self._law.torque)
        message = (
            f"The robot is brought to rest: removing an angular momentum of {self._momentum:.4g} "
            f"N m s takes at least {bound:.4g} s."
        )
        self._report_event(Event(EventKind.DETUMBLE_STARTED, message))

    def _end(self, at_rest: float) -> None:
        law = self._law
        assert law is not None
        took, bound = at_rest - self._began, shortest_detumbling(self._momentum, law.torque)
        message = (
            f"The robot came to rest in {took:.4g} s; the shortest time for an angular momentum "
            f"of {self._momentum:.4g} N m s is {bound:.4g} s, and the grasp torque was at most "
            f"{law.largest_grasp_torque:.4g} N m."
        )
        about = {
            "took_s": f"{took:.9g}",
            "shortest_s": f"{bound:.9g}",
            "angular_momentum_Nms": f"{self._momentum:.9g}",
            "largest_torque_Nm": f"{law.torque:.9g}",
            "grasp_torque_Nm": f"{law.largest_grasp_torque:.9g}",
        }
        self._report_event(Event(EventKind.DETUMBLED, message, about=about))


class Servicing:
    """The tasks of a controller: tasks that precede its goals, and tasks on request; ``report`` is
    called with their events."""

    def __init__(self, config: ControllerConfig, report: Callable[[Event], None]) -> None:
        tasks = Task.parsed(config.tasks)
        without = config.target.detumble == "none"
        self.before_goals = tuple(t for t in tasks if not (without and t is Task.DETUMBLE))
        self._config, self._report_event = config, report
        self.target = MeasuredTarget()
        self.payload: Payload | None = None
        """The held body."""
        self._remaining_tasks: list[Task] = []
        self._present: ApproachTask | DetumblingTask | None = None

    def configure(self, config: ControllerConfig) -> None:
        """Use another configuration from the next task on."""
        self._config = config

    @property
    def task(self) -> Task | None:
        """The current task."""
        return self._remaining_tasks[0] if self._remaining_tasks else None

    @property
    def needs_target(self) -> bool:
        """Whether target measurements are used now, or will be used by a later task."""
        return (
            Task.APPROACH in (self._remaining_tasks or self.before_goals) and self.payload is None
        )

    @property
    def message(self) -> str:
        """One-sentence description of the current task."""
        return "" if self._present is None else self._present.message

    def begin(self, tasks: Sequence[Task]) -> None:
        """Begin the first task at the next state."""
        self.restart()
        self._remaining_tasks = list(tasks)

    def restart(self) -> None:
        """Restart the current task."""
        if isinstance(self._present, ApproachTask):
            self._present.close()
        self._present = None

    def end(self) -> None:
        """Drop the remaining tasks."""
        self.restart()
        self._remaining_tasks = []

    def hold(self, payload: Payload | None) -> None:
        """Set the body that the robot holds from now on."""
        self.payload = payload
        if self.task is Task.DETUMBLE:
            self.restart()

    def step(
        self, time: float, state: ControlState, controller: CoordinatedController
    ) -> TaskProgress:
        """Advance the current task; DONE after the last task."""
        config, report = self._config, self._report_event
        while self._remaining_tasks:
            if self.task is not Task.APPROACH or self.payload is None:
                if self._present is None and self.task is Task.APPROACH:
                    self._present = ApproachTask(self.target, config, report)
                elif self._present is None:
                    self._present = DetumblingTask(self.payload, config, report)
                progress = self._present.step(time, state, controller)
                if progress.state is not TaskState.DONE:
                    return progress
            self.restart()
            self._remaining_tasks = self._remaining_tasks[1:]
            controller.follow(Reference())
            controller.hold_here(time, state)
        return _DONE
