"""Goals of a controller: their parts, which of these a law controls, their outcome, and the
planning of their references, in parallel with the control loop.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from spacerobot_ros.control.config import ControllerConfig, waypoints_refusal
from spacerobot_ros.control.controller import CoordinatedController
from spacerobot_ros.control.goal_monitor import Decision, GoalMonitor, StallMonitor
from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.control.outputs import OutputDistance, controlled_parts
from spacerobot_ros.control.planned_reference import PLANNING_TIME, Aims, PlannedReference
from spacerobot_ros.control.state import ControlState, PoseReference, Reference
from spacerobot_ros.control.status import ControllerState
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inverse_kinematics import AXES
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningJob
from spacerobot_ros.planning.core.goal import (
    POSE,
    Controlled,
    Goal,
    PoseError,
    Tolerance,
    missed_parts,
    missed_turn,
    reached_message,
)
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, IdentifiedGoal

END_EFFECTOR = "end_effector"
"""Key of the end-effector goal in goal files."""

GOAL_KEYS = (BASE_GOAL_KEY, END_EFFECTOR)
"""Goal keys: robot frames that have goal poses."""

_FREE_AXIS_MARGIN = 5.0
"""Number of tolerances by which a goal may differ from the pose along an uncontrolled axis: noise
moves a measured pose out of the plane of a planar robot."""

_NO_ROTATION = np.array([0.0, 0.0, 0.0, 1.0])

_PLACE: frozenset[Controlled] = frozenset({"position"})
"""Components requested by an end-effector goal with free attitude."""


def goal_parts(
    controller: CoordinatedController, key: str, identified: IdentifiedGoal
) -> dict[str, IdentifiedGoal]:
    """Return the base and end-effector goals contained in a goal that was received for either of
    them.

    A goal that names an end-effector applies to that end-effector, and also to the base if the goal
    has a base pose.

    Raises
    ------
    PlanningError
        The law does not control the frame, or the goal's shape has the wrong number of joints.
    """
    hands = identified.goal.end_effectors
    if key == END_EFFECTOR:
        _require_output(controller, key)
    parts = _parts_of(controller, identified) if hands else {key: identified}
    if key == END_EFFECTOR and all(each.link == "" for each in hands):
        # A pose on the end-effector topic is pursued along the controlled axes only.
        parts[key] = replace(parts[key], goal=replace(parts[key].goal, asked=_PLACE))
    for part, each in parts.items():
        _require_controlled(controller, part, each)
    return parts


def with_later_goals(
    goals: Mapping[str, IdentifiedGoal], later: Mapping[str, IdentifiedGoal]
) -> dict[str, IdentifiedGoal]:
    """Return the goals pursued together after later goals were accepted, by frame.

    A goal for both frames ends if a later goal replaces one of them; its other frame keeps its pose
    as a part of the later goal.
    """
    *_, latest = later.values()
    replaced = {goal.goal_id for part, goal in goals.items() if part in later}
    replaced -= {goal.goal_id for goal in later.values()}
    kept = {
        part: replace(goal, goal_id=latest.goal_id) if goal.goal_id in replaced else goal
        for part, goal in goals.items()
        if part not in later
    }
    return {**kept, **later}


def _parts_of(
    controller: CoordinatedController, identified: IdentifiedGoal
) -> dict[str, IdentifiedGoal]:
    law, goal = controller.law, identified.goal
    link, axes = law.outputs.selection.end_effector_link, law.outputs.selection.end_effector
    # The law's end-effector is the default one here, whatever its name.
    hands = tuple(replace(each, link=each.link or link) for each in goal.end_effectors)
    goal = replace(goal, end_effectors=hands).for_robot(law.robot.description)
    parts = {}
    if goal.base:
        pose = replace(goal, end_effectors=(), base=POSE, asked=goal.asked & goal.base)
        parts[BASE_GOAL_KEY] = replace(identified, goal=pose)
    for each in goal.end_effectors:
        if each.link != link:
            raise PlanningError(
                f"The goal is for '{each.link}', which the law '{law.name}' does not control"
                f"{f'; it controls {link!r}' if link else ''}."
            )
        if each.waypoints is not None:
            raise PlanningError(
                f"The goal of '{each.link}' is a path, which a controller does not follow: "
                "plan it with the method 'resolved_rate'."
            )
        asked, quaternion = POSE, each.quaternion
        if quaternion is None:
            if any(axis.startswith("r") for axis in axes):
                raise PlanningError(
                    f"The goal of '{each.link}' is a position only, but the law '{law.name}' "
                    "controls its attitude: add an orientation."
                )
            asked, quaternion = _PLACE, _NO_ROTATION
        pose = Goal(each.position, quaternion, goal.joint_positions, asked=asked)
        parts[END_EFFECTOR] = replace(identified, goal=pose)
    return parts


def _require_output(controller: CoordinatedController, key: str) -> None:
    law = controller.law
    if not getattr(law.outputs.selection, key):
        raise PlanningError(
            f"The law '{law.name}' does not control the {key.replace('_', '-')} of this robot; "
            f"its outputs are {', '.join(law.outputs.labels)}."
        )


def _require_controlled(
    controller: CoordinatedController, key: str, identified: IdentifiedGoal
) -> None:
    _require_output(controller, key)
    law, goal, wheels = controller.law, identified.goal, controller.wheels
    selection = law.outputs.selection
    controls = controlled_parts(getattr(selection, key), selection.joints)
    identified.required.require_control(goal, controls, f"the law '{law.name}'")
    n = law.robot.n if wheels is None else law.robot.n + len(wheels.wheels)
    if goal.joint_positions is not None and len(goal.joint_positions) != n:
        raise PlanningError(
            f"The goal has {len(goal.joint_positions)} joint positions; robot "
            f"'{law.robot.description.name}' has {n}."
        )
    if goal.waypoints is not None and controller.planner is None:
        raise PlanningError(waypoints_refusal(len(goal.waypoints)))


def require_controlled_axes(
    law: ControlLaw, state: ControlState, config: ControllerConfig, goals: Reference
) -> None:
    """Reject goals that differ from the current pose along an axis not controlled by the law.

    For a planar robot, the law controls only the axes in its plane. A position or attitude
    without any controlled axis is not checked.

    Raises
    ------
    PlanningError
        A goal differs from the pose by several tolerances along such an axis; the message names the
        axis.
    """
    selection, labels = law.outputs.selection, ", ".join(law.outputs.labels)
    here = Reference.present(law.robot, state, selection.end_effector_link)
    for name in GOAL_KEYS:
        goal, start, controlled = (getattr(each, name) for each in (goals, here, selection))
        if goal is None or start is None:
            continue
        way = goal.position - start.position
        turn_B = attitude_error(start.quaternion, goal.quaternion)
        turn = matrix_from_quaternion(start.quaternion) @ turn_B
        for part, unit, axes, error, tolerance in (
            ("position", "m", AXES[:3], way, config.position_tolerance),
            ("attitude", "rad", AXES[3:], turn, config.attitude_tolerance),
        ):
            left = [i for i in range(3) if axes[i] not in controlled]
            off = float(np.linalg.norm(error[left]))
            if 0 < len(left) < 3 and off > _FREE_AXIS_MARGIN * tolerance:
                raise PlanningError(
                    f"The goal {part} of the {name.replace('_', '-')} is {off:.4g} {unit} "
                    f"from the current value along {' and '.join(axes[i] for i in left)} of the "
                    "world, "
                    f"which the law '{law.name}' does not control; its outputs are {labels}."
                )


def aims_of(
    controller: CoordinatedController, goals: Mapping[str, IdentifiedGoal], state: ControlState
) -> Aims:
    """Return the goal poses and joint positions, given a state."""
    poses, shapes, waypoints = {}, [], ()
    for key, identified in goals.items():
        goal = identified.goal
        if key == BASE_GOAL_KEY:
            goal = goal.kept_at(state.r_WB, state.quaternion_WB)
            waypoints = tuple(goal.path_values[:-1])
        poses[key] = PoseReference(goal.position, goal.quaternion)
        if goal.joint_positions is not None:
            shapes.append(goal.joint_positions)
    if controller.wheels is not None:
        shapes = [shape[controller.wheels.wheels.other] for shape in shapes]
    return Aims(
        base=poses.get(BASE_GOAL_KEY),
        waypoints=waypoints,
        end_effector=poses.get(END_EFFECTOR),
        joints=shapes[0] if shapes else None,
    )


def goals_to_save(
    controller: CoordinatedController,
    asked: Mapping[str, frozenset[Controlled]],
    goal_id: str,
    *,
    waypoints: Array | None,
    resumes: bool,
) -> dict[str, IdentifiedGoal]:
    """Return the goals of the current reference by robot part.

    ``asked`` are the base and end-effector pose components that goals request, ``waypoints`` the
    base waypoints.
    """
    goal, selection = controller.goal, controller.law.outputs.selection
    shape = goal.joints.q if goal.joints is not None and selection.joints else None
    if shape is not None and controller.wheels is not None:
        shape = controller.wheels.shape_with_wheels(shape)
    poses = {BASE_GOAL_KEY: goal.base}
    profile = controller.profile
    if profile is not None and not profile.carries:
        poses[END_EFFECTOR] = goal.end_effector
    found = {}
    for key, pose in poses.items():
        if pose is not None and getattr(selection, key):
            parts = asked[key] if key == BASE_GOAL_KEY else POSE
            kept = Goal(pose.position, pose.quaternion, shape, asked=parts)
            if key == BASE_GOAL_KEY:
                kept = replace(kept, waypoints=waypoints)
            found[key] = IdentifiedGoal(kept, goal_id, resumes=resumes)
    return found


def config_with(config: ControllerConfig, tolerance: Tolerance | None) -> ControllerConfig:
    """Return a configuration with the tolerances of a goal; None: the parameters' tolerances."""
    if tolerance is None:
        return config
    return replace(
        config,
        position_tolerance=tolerance.position,
        attitude_tolerance=tolerance.attitude,
        joint_tolerance=tolerance.shape,
    )


class GoalWatch:
    """Evaluates the states since a goal began: whether the goal ends or stalls, or control is
    lost."""

    def __init__(self) -> None:
        self.monitor, self.stall = GoalMonitor(), StallMonitor()
        self._error_bounds: Array | None = None
        """Output errors (m,) beyond which control is lost."""
        self._contacts: tuple[str, ...] = ()
        """Links in contact."""
        self.asked: dict[str, frozenset[Controlled]] = dict.fromkeys(GOAL_KEYS, frozenset())
        """Base and end-effector pose components requested by the current goals."""
        self.touched = ""
        """First contact during the motion to the current goal, and its time; empty: none."""

    def begin(self, time: float) -> None:
        """Begin a goal or a task at a given time (s)."""
        self.monitor.begin(time)
        self._begin_motion()

    def begin_anew(self) -> None:
        """Restart the motion to the goal from another pose."""
        self.monitor.restart_settling()
        self._begin_motion()

    def _begin_motion(self) -> None:
        self.stall.restart()
        self._error_bounds = None

    def shift_time(self, jump: float) -> None:
        """Continue after a time jump (s)."""
        self.monitor.shift_time(jump)
        self.stall.restart()

    def forget_touch(self, time: float) -> None:
        """Begin a motion at a given time (s); current contacts also count as contacts during the
        motion."""
        self.touched = _touch(self._contacts, time)

    def take_contacts(self, contacts: tuple[str, ...], time: float, *, pursues: bool) -> None:
        """Set the links in contact from a given time (s) on; a new contact during the motion is
        recorded."""
        met = [each for each in contacts if each not in self._contacts]
        self._contacts = contacts
        if not self.touched and pursues:
            self.touched = _touch(met, time)

    def loss_by_rates(self, controller: CoordinatedController, qdot: Array) -> str:
        """Return a clause about a joint that stays far beyond its rate limit; empty: no joint."""
        limits = controller.joint_rate_limits
        if not self.monitor.check_rates(limits.largest_rate_share(qdot)):
            return ""
        joint = int(np.argmax(np.abs(qdot) / limits.rates))
        moving = controller.law.robot.description.movable_joints[joint]
        return (
            f"joint '{moving.name}' moves at {qdot[joint]:.3g} {moving.unit}/s instead of "
            f"{limits.rates[joint]:.3g} {moving.unit}/s"
        )

    def loss_by_errors(self, controller: CoordinatedController, config: ControllerConfig) -> str:
        """Return a clause about errors far beyond the goal distance; empty: no such errors."""
        if self._error_bounds is None:
            self._error_bounds = controller.error_bounds(config.error_margin.as_distances())
        share = controller.law.largest_error_share(self._error_bounds)
        if not self.monitor.check_errors(share):
            return ""
        away = controller.distance_from_reference()
        return f"the errors grow and the robot is {away} from the reference"

    def decision(
        self, controller: CoordinatedController, time: float, config: ControllerConfig
    ) -> ControllerState | None:
        """Return the state of a goal decided at a given time (s); None: not decided yet."""
        at_rest, ends = controller.reference_at_rest(time), controller.reference_ends
        assert ends is not None
        if not at_rest and not self.monitor.is_late(time, ends, config):
            # Errors do not decide the goal while the reference moves.
            self.monitor.restart_settling()
            return None
        decision = self.monitor.decide_by_errors(time, at_rest, ends, controller.errors(), config)
        if decision == Decision.NONE:
            return None
        if decision == Decision.FAILED or self.touched:
            return ControllerState.FAILED
        if self._missed_parts(controller, config):
            return ControllerState.REACHED_PARTLY
        return ControllerState.REACHED

    def _missed_parts(
        self, controller: CoordinatedController, config: ControllerConfig
    ) -> dict[str, str]:
        """Return the :func:`missed_parts` in the state of the last command."""
        law, goal = controller.law, controller.goal
        state, outputs = law.state, law.outputs.selection
        tolerance = Tolerance(config.position_tolerance, config.attitude_tolerance)
        missed: dict[str, str] = {}
        if goal.base is not None and self.asked[BASE_GOAL_KEY]:
            aimed = Goal(goal.base.position, goal.base.quaternion, asked=self.asked[BASE_GOAL_KEY])
            error = PoseError.between(state.r_WB, state.quaternion_WB, aimed)
            turn = matrix_from_quaternion(state.quaternion_WB) @ error.rotvec
            left = np.array([axis not in outputs.base for axis in AXES])
            error = PoseError(error.position * left[:3], turn * left[3:])
            missed |= missed_parts(aimed, error, frozenset(), tolerance)
        turned = "attitude" in self.asked[END_EFFECTOR] - controlled_parts(outputs.end_effector)
        if goal.end_effector is not None and turned:
            R_BE, _ = law.robot.link_pose(outputs.end_effector_link, state.q)
            R_WE = matrix_from_quaternion(state.quaternion_WB) @ R_BE
            turn = attitude_error(quaternion_from_matrix(R_WE), goal.end_effector.quaternion)
            missed |= missed_turn(float(np.linalg.norm(turn)), tolerance)
        return missed

    def message(
        self, state: ControllerState, controller: CoordinatedController, config: ControllerConfig
    ) -> str:
        """Return the message about a reached or failed goal; see :meth:`decision`."""
        away, missed = controller.distance_between(controller.law.state, controller.goal), {}
        if state is ControllerState.REACHED_PARTLY:
            missed = self._missed_parts(controller, config)
        return decided_message(state, away, config, self.stall.cause, missed, self.touched)


def _touch(contacts: Sequence[str], time: float) -> str:
    """Return a clause on the first of some contacts at a time, s; empty: there is none."""
    return f"{contacts[0]} touched at {time:.4g} s" if contacts else ""


def decided_message(
    state: ControllerState,
    distance: OutputDistance,
    config: ControllerConfig,
    cause: str = "",
    missed: Mapping[str, str] | None = None,
    touched: str = "",
) -> str:
    """Return the message for a reached or failed goal, including the distance from the goal.

    ``cause`` is the reason, if known, why the robot came no closer; ``missed`` lists the missed
    components of a partly reached goal; ``touched`` is the contact that made the goal fail.
    """
    away = f"{distance} from it ({tolerance_of(distance, config)})"
    if state is not ControllerState.FAILED:
        return reached_message(away, missed or {})
    if touched:
        return f"The goal is not reached without contact, as {touched}: {away}."
    late = f"not reached in time, as {cause}" if cause else "not reached in time"
    if not any(off > most for off, most in zip(distance, config.tolerances, strict=True)):
        away += f", within tolerance for less than the settling time of {config.settle_time:g} s"
    return f"The goal is {late}: {away}."


def tolerance_of(distance: OutputDistance, config: ControllerConfig) -> str:
    """Return the tolerances of the kinds of outputs in a distance."""
    limits = zip(distance, config.tolerances, strict=True)
    tolerance = OutputDistance(*(math.nan if math.isnan(off) else most for off, most in limits))
    return f"tolerance {tolerance}"


# -- planned references ----------------------------------------------------------------------------


class GoalPlanning:
    """Plans references for pending goals, one at a time."""

    def __init__(self) -> None:
        self.time = 0.0
        """Total wall time spent planning references, s."""
        self._pending: Mapping[str, IdentifiedGoal] | None = None
        """Goals whose reference is being planned; None: there are none."""
        self._aims = Aims()
        """Poses and joints of these goals."""
        self._job: PlanningJob[PlannedReference] | None = None
        """The last job, which may still be running although cancelled."""
        self._lead = PLANNING_TIME

    @property
    def active(self) -> bool:
        """Whether a reference is being planned."""
        return self._pending is not None

    def is_for(self, pending: Mapping[str, IdentifiedGoal]) -> bool:
        """Whether a reference for these goals is being planned."""
        present = self._pending
        if present is None or present.keys() != pending.keys():
            return False
        return all(goal is pending[part] for part, goal in present.items())

    def planned(
        self,
        time: float,
        state: ControlState,
        controller: CoordinatedController,
        pending: Mapping[str, IdentifiedGoal],
    ) -> PlanningJob[PlannedReference] | None:
        """Return the completed job for pending goals; None while their reference is being planned,
        and before its motion begins.

        Raises
        ------
        PlanningError
            No motion is found.
        """
        planner = controller.planner
        assert planner is not None
        if not self.is_for(pending):
            self.cancel()
            if self._pending is None:
                self._lead = PLANNING_TIME
            self._begin(time, state, controller, pending, aims_of(controller, pending, state))
        job = self._job
        assert job is not None
        waits = planner.in_background and job.begins > time
        if not job.done:
            return None
        try:
            job.result()
        except PlanningError:
            waits = False
            raise
        finally:
            if not waits:
                self.time += job.wall_time
                self._pending = None
        if waits:
            return None
        if planner.in_background and -math.inf < job.begins < time:
            # The reference has moved on: plan from its state after twice the time.
            self._lead *= 2
            self._begin(time, state, controller, pending, self._aims)
            return None
        return job

    def _begin(
        self,
        time: float,
        state: ControlState,
        controller: CoordinatedController,
        pending: Mapping[str, IdentifiedGoal],
        aims: Aims,
    ) -> None:
        planner = controller.planner
        assert planner is not None
        seen, begins = state.copied(), -math.inf
        if controller.profile is not None and not controller.reference_at_rest(time):
            begins = time + self._lead * planner.in_background
        motion = controller.motion_to(max(begins, time), seen, **aims)

        def work(cancellation: Cancellation) -> PlannedReference:
            return planner.plan_motion(motion, seen, cancellation)

        last, self._job = self._job, PlanningJob(work, begins)
        # Set before the work begins, so that it can be cancelled.
        self._pending, self._aims = dict(pending), aims
        self._job.start(in_background=planner.in_background, after=last)

    def cancel(self) -> None:
        """Cancel the job; any thread may call this."""
        job = self._job
        if self._pending is not None and job is not None:
            job.cancel()

    def drop(self) -> None:
        """Cancel the job and discard its result."""
        self.cancel()
        self._pending = None

    def close(self) -> None:
        """Cancel the job and wait for its thread to end."""
        self._pending = None
        if self._job is not None:
            self._job.close()
