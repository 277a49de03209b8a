"""One flight: its data, measures, verdict, summary, views and files.

A commander evaluates its goal with the measured state, at the time of its decision. The verdict
uses the true state at the end of the flight; its errors are in :attr:`Flight.error`.

A flight is produced by the loop without ROS (:mod:`~spacerobot_ros.flight.lockstep`) or read from a
bag (:mod:`~spacerobot_ros.flight.reading`).
"""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.errors import counted, quantity, sentence_case
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.data import FlightData
from spacerobot_ros.measures import Measures, Outcome, peak, peak_wrench
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.planning import PoseError
from spacerobot_ros.planning.core.goal import (
    Controlled,
    Tolerance,
    missed_parts,
    missed_turn,
    reached_message,
)
from spacerobot_ros.planning.execution.status import describe_remaining_error
from spacerobot_ros.scenario import COMMANDERS
from spacerobot_ros.simulation.faults import active_fault

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


_PARTS: frozenset[Controlled] = frozenset(("position", "attitude", "shape", "end_effectors"))


@dataclass(frozen=True)
class Verdict:
    """The outcome of a flight in words, according to its last true state.

    Attributes
    ----------
    word
        The outcome in a few words, such as ``Reached, except for the position``.
    sentence
        The commander's message; if the goal is reached or the time limit has expired, a sentence
        with the true errors and the tolerances.
    succeeded
        Whether the true state reaches all controlled components of the goal, and whether any
        automatic capture has taken place.
    complete
        Whether every component of the goal was also controlled.
    """

    word: str
    sentence: str
    succeeded: bool = False
    complete: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class Flight(FlightData):
    """A flight, from :func:`spacerobot_ros.fly` or from a bag; see the base class for its data."""

    def __repr__(self) -> str:
        error, left = self.error, ""
        if error is not None:
            parts = (("position", error.distance, "m"), ("attitude", error.angle, "rad"))
            distance, angle = (
                quantity(value, unit) + " (not controlled)" * (part in self.not_controlled)
                for part, value, unit in parts
            )
            left = f", {distance} and {angle} from the goal"
        return (
            f"<Flight of {self.scenario.name} by {self.method}: {self.outcome.value} after "
            f"{self.duration:.6g} s ({len(self.time) - 1} ticks, "
            f"{counted(self.corrections, 'correction')}){left}. {self.verdict.sentence}>"
        )

    def summary(self) -> dict[str, Any]:
        """Return the measures with the keys of ``spacerobot run --json``.

        The flight must have states and a goal.
        """
        goal, measures = self.goal, self.measures
        assert goal is not None
        assert measures.error is not None or not goal.base
        error = measures.error
        linear, angular = measures.momentum_drift.tolist()
        ticks, wall_time = len(self.time) - 1, self.wall_time
        summary: dict[str, Any] = {
            "scenario": self.scenario.name,
            "method": self.method,
            "goal": [*goal.position.tolist(), *goal.quaternion.tolist()] if goal.base else None,
            "final_position_m": self.pose[-1, :3].tolist(),
            "final_attitude_rotvec_rad": rotvec_from_quaternion(self.pose[-1, 3:]).tolist(),
            "final_joint_positions": self.q[-1].tolist(),
            "joint_names": list(self.joint_names),
            "wheel_names": [] if self.robot is None else list(self.robot.wheel_names),
            "position_error_m": None if error is None else error.distance,
            "attitude_error_rad": None if error is None else error.angle,
            "position_tolerance_m": self.tolerance("position"),
            "attitude_tolerance_rad": self.tolerance("attitude"),
            "not_controlled": list(self.not_controlled),
            "has_thrust": self.has_thrust,
            "sim_time_s": measures.duration,
            "manoeuvre_time_s": measures.manoeuvre_time,
            "plan_time_s": measures.plan_time,
            "wall_time_s": wall_time,
            "ticks": ticks,
            "ticks_per_s": ticks / wall_time if wall_time else math.inf,
            "real_time_factor": self.duration / wall_time if wall_time else math.inf,
            "momentum_drift": max(linear, angular),
            "linear_momentum_drift": linear,
            "angular_momentum_drift": angular,
            "peak_joint_velocities": measures.peak_rate.tolist(),
            "corrections": measures.corrections,
            "gait": {},
            "state": self.outcome.value,
            "message": self.message,
            "verdict": self.verdict.sentence,
            "succeeded": self.succeeded,
            "succeeded_by_measurement": self.succeeded_by_measurement,
        }
        if self.gait is not None:
            summary["gait"] = {"duration_s": self.gait.duration_s, **self.gait.notes}
        if errors := self.end_effector_errors:
            angles = {link: errors[link].angle for link in self._turned_links}
            summary["end_effectors"] = {
                link: {"position_error_m": x.distance, "attitude_error_rad": angles.get(link)}
                for link, x in errors.items()
            }
        elif math.isfinite(measures.end_effector_distance):
            end = self.signal("end_effector_pose").values[-1, :3]
            summary["end_effector_final_position_m"] = end.tolist()
            summary["end_effector_position_error_m"] = measures.end_effector_distance
            if self.turns_end_effector:
                summary["end_effector_attitude_error_rad"] = measures.end_effector_angle
        optional = {
            "capture": self.capture or None,
            "detumbling": self.detumbling or None,
            "propellant_kg": self.propellant,
            "planned_propellant_kg": self.planned_propellant,
        }
        summary |= {name: value for name, value in optional.items() if value is not None}
        if (found := self.detection) is not None:
            about = {"node": found.node, "time_s": found.time_s, "message": found.message}
            summary["detection"] = about
        if self.clearance is not None:
            summary["clearance_m"] = measures.clearance
            summary["clearance_links"] = list(self.clearance.nearest.links)
            summary["clearance_time_s"] = self.clearance.nearest_time
        return summary

    # -- measures -----------------------------------------------------------------------------

    @property
    def succeeded(self) -> bool:
        """Whether the goal was reached, according to the true state and the capture, if any."""
        return self.verdict.succeeded

    @property
    def succeeded_by_measurement(self) -> bool:
        """Whether the goal was reached within tolerance, according to the measured state."""
        return self.outcome is Outcome.REACHED

    @cached_property
    def measures(self) -> Measures:
        """The measures of the flight, which must have states."""
        return self.measured()

    def measured(self, *, clearance: bool = True) -> Measures:
        """Return the measures of the flight, which must have states.

        ``clearance``: whether to measure the smallest distance between links (slow).
        """
        distance, angle = self._largest_end_effector_errors
        return Measures(
            outcome=self.outcome,
            message=self.message,
            duration=self.duration,
            manoeuvre_time=self.manoeuvre_time,
            error=self.error,
            peak_rate=peak(self.qdot),
            peak_effort=peak(self.effort),
            peak_wrench=peak_wrench(self.wrench.values),
            lowest=self.q.min(axis=0),
            highest=self.q.max(axis=0),
            momentum_drift=self.momentum_drift,
            end_effector_distance=distance,
            end_effector_angle=angle,
            corrections=self.corrections,
            propellant=math.nan if self.propellant is None else self.propellant,
            plan_time=self.plan_time,
            wall_time=self.wall_time,
            clearance=self.smallest_distance if clearance else math.nan,
            capture=self.capture_metrics,
        )

    @property
    def _largest_end_effector_errors(self) -> tuple[float, float]:
        """Distance (m) and angle (rad) as defined in :class:`Measures`."""
        if errors := self.end_effector_errors:
            angles = [errors[link].angle for link in self._turned_links]
            return max(each.distance for each in errors.values()), max(angles, default=math.nan)
        error = self.end_effector_error
        if error is None:
            return math.nan, math.nan
        return error.distance, error.angle if self.turns_end_effector else math.nan

    @property
    def _turned_links(self) -> list[str]:
        assert self.goal is not None
        assert self.robot is not None
        aims = self.goal.for_robot(self.robot).end_effectors
        return [aim.link for aim in aims if aim.quaternion is not None]

    @property
    def smallest_distance(self) -> float:
        """Smallest distance between links, m; infinite if none can touch, NaN if not measured."""
        if self.clearance is not None:
            return self.clearance.nearest.distance
        return math.inf if self.measures_clearance else math.nan

    @property
    def thrust_impulse(self) -> float:
        """Impulse of the thrusters since the start or the last reset, N s: the sum over all, or of
        the commanded force; 0: none."""
        forces = self.signal("thruster_force")
        thrust = forces or self.wrench.norms([0, 1, 2])
        # The first forces acted before the first state; the first command acts after it.
        first = max([int(bool(forces)), *thrust.rows_after(self.resets)])
        return float(thrust.values[first:].sum() * self.control_period)

    @cached_property
    def capture_metrics(self) -> dict[str, float]:
        """The metrics of the capture that have a value; none without a target."""
        capture, detumbling = self.capture, self.detumbling
        if not capture:
            return {}
        changes = (EventKind.CAPTURED, EventKind.RELEASED)
        last = [event.kind for event in self.events if event.kind in changes][-1:]
        time, distance = capture.get("time_s", math.nan), capture.get("nearest_m", math.nan)
        times, distances = self._grapple_distances
        if capture["captured"] and len(times):
            distance = distances[int(np.searchsorted(times, time - 1e-9))]
        impulse = np.array(capture.get("impulse_Ns", [math.nan] * 6))
        joints = np.abs(capture.get("joint_impulses_Nms", ()))
        metrics = {
            "captured": capture["captured"],
            "placed": self.succeeded and last == [EventKind.CAPTURED],
            "capture_time_s": time,
            "capture_distance_m": distance,
            "capture_impulse_Ns": np.linalg.norm(impulse[:3]),
            "capture_angular_impulse_Nms": np.linalg.norm(impulse[3:]),
            "capture_joint_impulse": joints.max() if joints.size else math.nan,
            "detumbling_time_s": detumbling.get("took_s", math.nan),
            "detumbling_bound_s": detumbling.get("shortest_s", math.nan),
        }
        return {name: float(x) for name, x in metrics.items() if not math.isnan(x)}

    # -- verdict ------------------------------------------------------------------------------

    @cached_property
    def verdict(self) -> Verdict:
        """The outcome of the flight in a few words and a sentence, according to its last true
        state; faults that were active when the flight failed follow in another sentence."""
        verdict, outcome = self._verdict_without_faults, self.outcome
        failed = outcome in (Outcome.FAILED, Outcome.ABORTED)
        faults = self._faults_at_decision
        if not faults or not (failed or (outcome is Outcome.REACHED and not verdict.succeeded)):
            return verdict
        clauses = sentence_case("; ".join(map(active_fault, faults)))
        return replace(verdict, sentence=f"{verdict.sentence} {clauses}.")

    @property
    def detection(self) -> Event | None:
        """The first warning of a commander after a fault had begun, other than the outcome of a
        goal; None: there is none."""
        events = itertools.dropwhile(lambda e: e.kind is not EventKind.FAULT_INJECTED, self.events)
        return next(
            (e for e in events if e.level and e.node in COMMANDERS and "goal" not in e.kind.value),
            None,
        )

    @property
    def _faults_at_decision(self) -> list[str]:
        """The lines of the faults that were active when the goal was decided."""
        active: dict[str, None] = {}
        decided: list[str] = []
        for event in self.events:
            if event.kind is EventKind.FAULT_INJECTED and "fault" in event.about:
                active[event.about["fault"]] = None
            elif event.kind is EventKind.FAULT_ENDED:
                active.pop(event.about.get("fault", ""), None)
            elif event.kind.value == f"goal_{self.outcome.value}":
                decided = list(active)
        return decided

    @property
    def _verdict_without_faults(self) -> Verdict:
        late = self.outcome is Outcome.FAILED and isinstance(self.status, ControllerStatus)
        reached = self.outcome in (Outcome.REACHED, Outcome.REACHED_PARTLY)
        if not (reached or late):
            return Verdict(self.outcome.value.capitalize(), self.message)
        automatic = self.scenario.plant.capture.mode == "automatic"
        missed = reached and automatic and not self.capture.get("captured", True)
        left_out = self.not_controlled
        word = "Reached" if reached else "Failed"
        if reached and left_out:
            word += f", except for the {' and '.join(left_out)}"
        if missed:
            word += ", but the target is not captured"
        succeeded = self.outcome is Outcome.REACHED and not missed
        error, tolerance, goal = self._last_error, self._tolerances, self.goal
        if error is None or tolerance is None:
            sentence = self.message
            if left_out and "not controlled" not in sentence:
                sentence += f" Not controlled: {' and '.join(left_out)}."
            if missed:
                sentence += " The target is not captured."
            return Verdict(word, sentence, succeeded, succeeded and not left_out)
        controls = _PARTS - set(left_out)
        if self.error is None:
            controls -= {"position", "attitude"}
        if not error.end_effectors:
            controls -= {"end_effectors"}
        errors = describe_remaining_error(error, controls, tolerance, goal)
        within = tolerance.admits(error, controls)
        touched = self.message.startswith("The goal is not reached without contact")
        if late and within and not touched:
            settling = f"{self.scenario.controller.settle_time:g} s"
            errors += f", within tolerance for less than the settling time of {settling}"
        if reached and not within and "measured_pose" in self.series:
            sentence = (
                f"The measured pose is within tolerance of the goal; the true pose is {errors}."
            )
            return Verdict("Reached according to the measured pose", sentence)
        # Part of a component may be controlled: a base in a plane.
        controlled = frozenset(controls) if within else frozenset[Controlled]()
        parts = {} if goal is None else missed_parts(goal, error, controlled, tolerance)
        if not self.turns_end_effector:
            parts |= missed_turn(error.largest_end_effector_angle, tolerance)
        if self.outcome is Outcome.REACHED_PARTLY and parts and not missed:
            return Verdict(word, reached_message(errors, parts))
        fact = "The goal is reached" if reached else "The goal is not reached in time"
        if late and (touched or self.message.startswith(fact)):
            # A controller's message states what kept it from the goal, if known.
            fact = self.message.partition(": ")[0]
        fact += ", but the target is not captured" * missed
        if reached and not (missed or within):
            # The robot was moved later, for instance by a reset.
            fact = f"{self.message} At the end of the flight, the robot is elsewhere"
        return Verdict(word, f"{fact}: {errors}.", succeeded, succeeded and not left_out)

    @property
    def _last_error(self) -> PoseError | None:
        """The final true error of base, joints and end-effectors; None if there is none."""
        base, links = self.error, tuple(self.end_effector_errors.values())
        hand = self.end_effector_error
        if not links and hand is not None:
            # If the controller does not control the end-effector attitude, it is free.
            turn = hand.rotvec if self.turns_end_effector else np.zeros(3)
            links = (PoseError(hand.position, turn),)
        if base is None and not links:
            return None
        position, rotvec = (np.zeros(3),) * 2 if base is None else (base.position, base.rotvec)
        return PoseError(position, rotvec, self._joint_errors, links)

    @property
    def _joint_errors(self) -> Array:
        """Errors (k,) of joints with goals, m or rad; for a controller, those of its outputs."""
        wanted = None if self.goal is None else self.goal.joint_positions
        if wanted is not None and len(self.q) and wanted.shape == self.q[-1].shape:
            return wanted - self.q[-1]
        command = self.status.command if isinstance(self.status, ControllerStatus) else None
        errors = {} if command is None else command.errors
        return np.array([x for name, x in errors.items() if name.startswith("joint.")])

    @property
    def _tolerances(self) -> Tolerance | None:
        position, attitude = self.tolerance("position"), self.tolerance("attitude")
        if position is None or attitude is None:
            return None
        return Tolerance(position, attitude, self.tolerance("joint") or Tolerance(0.0, 0.0).shape)

    # -- views and files ----------------------------------------------------------------------

    def to_pandas(self, *, euler: bool = False) -> pd.DataFrame:
        """Return a table with one row per state, indexed by time (s).

        Columns and their units (``attrs["units"]``) are the same as in bag tables. Columns of
        ``odom`` and ``joint_states`` contain the true state; other columns have their topic as a
        prefix, such as ``momentum.data[linear_x]``. Measured states that differ from the true
        states have the prefix ``measured``. If ``euler`` is set, the columns ``roll``, ``pitch``
        and ``yaw`` contain each attitude's rotations about the fixed axes x, y, z (rad).

        Raises
        ------
        SpaceRobotError
            pandas is not installed.
        """
        from spacerobot_ros.bag.tables import to_pandas
        from spacerobot_ros.flight.saved import table_of_flight

        made = to_pandas(table_of_flight(self, euler=euler))
        made.attrs = self._attributes | {"units": made.attrs["units"]}
        return made

    def to_xarray(self, *, euler: bool = False) -> xr.Dataset:
        """Return the columns of :meth:`to_pandas` as variables over ``time``, with their units.

        Arrays are kept as arrays, with dimensions ``time`` and ``joint`` for joint states, as for
        bags.

        Raises
        ------
        SpaceRobotError
            xarray is not installed.
        """
        from spacerobot_ros.bag.tables import to_xarray
        from spacerobot_ros.flight.saved import table_of_flight

        made = to_xarray(table_of_flight(self, euler=euler))
        made.attrs = dict(self._attributes)
        return made

    @property
    def _attributes(self) -> dict[str, str]:
        return {"scenario": self.scenario.name, "method": self.method, "message": self.message}

    def plot(self) -> Any:
        """Return a matplotlib figure with base pose and goal, joints, and efforts or rates."""
        from spacerobot_ros.flight.views import figure

        return figure(self)

    def animate(self, *, seconds: float = 8.0, frames: int = 80) -> Any:
        """Return the robot in motion as an HTML animation for a notebook.

        Parameters
        ----------
        seconds
            Duration of the animation.
        frames
            Number of pictures, at most 1000.

        Raises
        ------
        ParameterError
            A value is out of range.
        SpaceRobotError
            The flight has no robot description.
        """
        from spacerobot_ros.flight.views import animation

        return animation(self, seconds, frames)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write a bag for ``spacerobot verify`` and ``spacerobot report``.

        Raises
        ------
        RecordingError
            The file exists and may not be replaced, or cannot be written, a message type is not
            installed, or the flight has no robot description.
        """
        from spacerobot_ros.bag import BagWriter
        from spacerobot_ros.flight.saved import write_flight

        self.required_robot()
        config = self.scenario.config("recorder")
        with BagWriter(path, config, overwrite=overwrite) as writer:
            write_flight(self, writer)
