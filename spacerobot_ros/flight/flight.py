"""One flight: its data, summary, views and files.

A flight is produced by the loop without ROS (:mod:`~spacerobot_ros.flight.lockstep`) or read from a
bag (:mod:`~spacerobot_ros.flight.reading`).
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from spacerobot_ros.errors import counted, quantity
from spacerobot_ros.flight.data import FlightData
from spacerobot_ros.model.rotations import rotvec_from_quaternion

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@dataclass(frozen=True, eq=False, repr=False)
class Flight(FlightData):
    """A flight, from :func:`spacerobot_ros.fly` or from a bag; see the base class for its data."""

    def __repr__(self) -> str:
        error, left = self.error, ""
        if error is not None:
            distance, angle = (
                quantity(value, unit) + " (not controlled)" * (part in self.not_controlled)
                for part, value, unit in (
                    ("position", error.distance, "m"),
                    ("attitude", error.angle, "rad"),
                )
            )
            left = f", {distance} and {angle} from "
        return (
            f"<Flight of {self.scenario.name} by {self.method}: {self.outcome.value} after "
            f"{self.duration:.6g} s ({len(self.time) - 1} ticks, "
            f"{counted(self.corrections, 'correction')}){left and f'{left}the goal'}. "
            f"{self.verdict.sentence}>"
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
            "gait": {}
            if self.gait is None
            else {"duration_s": self.gait.duration_s, **self.gait.notes},
            "state": self.outcome.value,
            "message": self.message,
            "verdict": self.verdict.sentence,
            "succeeded": self.succeeded,
            "succeeded_by_measurement": self.succeeded_by_measurement,
        }
        if errors := self.end_effector_errors:
            summary["end_effectors"] = {
                link: {
                    "position_error_m": each.distance,
                    "attitude_error_rad": each.angle if link in self._turned_links else None,
                }
                for link, each in errors.items()
            }
        elif math.isfinite(measures.end_effector_distance):
            end = self.signal("end_effector_pose").values[-1, :3]
            summary["end_effector_final_position_m"] = end.tolist()
            summary["end_effector_position_error_m"] = measures.end_effector_distance
            if self.turns_end_effector:
                summary["end_effector_attitude_error_rad"] = measures.end_effector_angle
        if self.capture:
            summary["capture"] = self.capture
        if self.detumbling:
            summary["detumbling"] = self.detumbling
        if self.propellant is not None:
            summary["propellant_kg"] = self.propellant
        if self.planned_propellant is not None:
            summary["planned_propellant_kg"] = self.planned_propellant
        if self.clearance is not None:
            summary["clearance_m"] = measures.clearance
            summary["clearance_links"] = list(self.clearance.nearest.links)
            summary["clearance_time_s"] = self.clearance.nearest_time
        return summary

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
        return {
            "scenario": self.scenario.name,
            "method": self.method,
            "message": self.message,
        }

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
            The file exists and may not be replaced, or cannot be written, or the flight has no
            robot description.
        """
        from spacerobot_ros.flight.saved import save_flight

        save_flight(self, path, overwrite=overwrite)
