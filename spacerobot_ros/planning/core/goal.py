"""Goals, the initial states of plans, and errors relative to goals."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import GoalError, counted
from spacerobot_ros.files import warn_once
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array, RobotDescription
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_matrix,
    quaternion_from_rotvec,
    unit_quaternion,
)
from spacerobot_ros.parameters import as_numbers

Controlled = Literal["position", "attitude", "shape", "end_effectors"]
"""A goal component: base position, base attitude, joint positions, or end-effector poses."""

POSE: frozenset[Controlled] = frozenset({"position", "attitude"})
"""The goal components that form the base pose."""

POSITION_SLACK = 0.5
"""Fraction of the position tolerance by which a plan may miss an unreachable position."""

_MAX_COORDINATE = 1e12
"""Largest coordinate, m or rad; up to this value, a float64 resolves a millimetre."""

MAX_PATH_POSES = 10_000
"""Largest number of poses in a given path, which limits planning time."""

_USUAL_NORM = 0.5
"""Length of a quaternion above which it is a rotation without further checks."""

_MAX_ANGLE = 2e6 * np.pi
"""A million revolutions, rad: larger angles do not determine the attitude accurately."""


@dataclass(frozen=True)
class EndEffectorGoal:
    """A world position or pose for a robot link E.

    Attributes
    ----------
    link
        Link name; empty: the robot's default end-effector.
    position
        (3,) r_WE of the link frame origin, m.
    quaternion
        (4,) of R_WE, (x, y, z, w); None: any attitude.
    waypoints
        Waypoints before the goal, connected by straight lines: positions (K, 3), m, or poses (K, 7)
        if the goal has an attitude, which rotates along the lines. The link moves in a straight
        line to the first waypoint. None: the method chooses the path.
    """

    link: str
    position: Array
    quaternion: Array | None = None
    waypoints: Array | None = None

    @classmethod
    def checked(cls, link: str, pose: npt.ArrayLike) -> EndEffectorGoal:
        """Return the goal at a position (3,), m, or a pose (7,) with a quaternion (x, y, z, w).

        Raises
        ------
        GoalError
            The values are not 3 or 7 finite numbers, or the quaternion is zero.
        """
        name = f"'{link}'" if link else "the end-effector"
        values = as_numbers(pose, f"The goal of {name}", GoalError)
        if values.shape not in ((3,), (7,)):
            raise GoalError(
                f"The goal of {name} has {counted(values.size, 'number')}; give 3 (a position) or "
                "7 (a position and a quaternion)."
            )
        has_attitude = len(values) == 7
        given = Goal.checked(values[:3], values[3:] if has_attitude else None)
        return cls(link, given.position, given.quaternion if has_attitude else None)

    @classmethod
    def along(cls, link: str, poses: npt.ArrayLike) -> EndEffectorGoal:
        """Return the goal at the end of a path: positions (K, 3), m, or poses (K, 7).

        A path with a single pose is a goal without waypoints. Quaternions are scaled to length one.

        Raises
        ------
        GoalError
            There are no poses or too many, or a pose is invalid.
        """
        values = as_numbers(poses, f"The goal path of '{link}'", GoalError)
        name = f"The path of '{link}'"
        if not values.size:
            raise GoalError(f"{name} has no poses.")
        if values.ndim != 2 or values.shape[1] not in (3, 7):
            raise GoalError(
                f"{name} has shape {values.shape}; each of its poses must have 3 numbers (a "
                "position) or 7 (a position and a quaternion)."
            )
        if len(values) > MAX_PATH_POSES:
            raise GoalError(
                f"{name} has {len(values)} poses; at most {MAX_PATH_POSES} are allowed."
            )
        r, q = values[:, :3], values[:, 3:]
        # A pose alone takes long to check; of a long path, more than a tick for all.
        most = [_MAX_COORDINATE] * 3 + [1.0] * q.shape[1]
        usual = np.asarray((np.abs(values) <= most).all(axis=1))
        norms = np.sqrt([each.dot(each) for each in np.where(usual[:, np.newaxis], q, 0.0)])
        usual &= (norms > _USUAL_NORM) | (q.shape[1] == 0)
        found = np.hstack([r, q / np.where(usual & (norms > 0.0), norms, 1.0)[:, np.newaxis]])
        for k in np.flatnonzero(~usual).tolist():
            try:
                found[k] = cls.checked(link, values[k]).values
            except GoalError as error:
                raise GoalError(
                    f"Pose {k + 1} of the path of '{link}' is invalid: {error}"
                ) from None
        end = found[-1]
        return cls(
            link,
            end[:3],
            end[3:] if q.shape[1] else None,
            waypoints=found[:-1] if len(found) > 1 else None,
        )

    @classmethod
    def of_numbers(cls, link: str, numbers: npt.ArrayLike) -> EndEffectorGoal:
        """Return the goal in a file: a position or a pose, or a list of these for a path.

        Raises
        ------
        GoalError
            See :meth:`checked` and :meth:`along`.
        """
        nested = isinstance(numbers, Sequence) and any(isinstance(x, Sequence) for x in numbers)
        return cls.along(link, numbers) if nested else cls.checked(link, numbers)

    @property
    def numbers(self) -> list[float] | list[list[float]]:
        """The goal in the form accepted by :meth:`of_numbers`."""
        return list(self.values) if self.waypoints is None else self.path_values.tolist()

    @property
    def path_values(self) -> Array:
        """The waypoints and the goal (K + 1, 3) or (K + 1, 7), as accepted by :meth:`along`."""
        end = np.array(self.values)[np.newaxis]
        return end if self.waypoints is None else np.vstack([self.waypoints, end])

    def displaced(self, by: Array) -> EndEffectorGoal:
        """Return the goal and its waypoints displaced by a vector (3,) in W, m."""
        moved = _displaced(self.waypoints, by)
        return replace(self, position=self.position + by, waypoints=moved)

    def as_goal(self) -> Goal:
        """Return the goal as a pose for a message; a zero quaternion leaves the attitude free."""
        return Goal(self.position, np.zeros(4) if self.quaternion is None else self.quaternion)

    @property
    def values(self) -> tuple[float, ...]:
        """Position (3,), or position and quaternion (7,), as accepted by :meth:`checked`."""
        attitude = [] if self.quaternion is None else self.quaternion.tolist()
        return (*self.position.tolist(), *attitude)


@dataclass(frozen=True)
class Goal:
    """A goal: base link pose in the world, final joint shape, and end-effector goals.

    Attributes
    ----------
    position
        (3,) r_WB, m.
    quaternion
        (4,) of R_WB, (x, y, z, w).
    joint_positions
        (n,) in robot joint order, m or rad; None: the method chooses.
    end_effectors
        End-effector goals, at most one per link.
    base
        Requested components of the base pose. If there are end-effector goals, any of these
        components may be requested, or none; the motion determines the other components.
    asked
        Base pose components that the sender has specified explicitly. Other components keep their
        values at the start (:meth:`kept_at`), and the goal can be reached without them.
    waypoints
        Base poses (K, 7) before the goal, at each of which the robot comes to rest; None: none.
    """

    position: Array
    quaternion: Array
    joint_positions: Array | None = None
    end_effectors: tuple[EndEffectorGoal, ...] = ()
    base: frozenset[Controlled] = POSE
    asked: frozenset[Controlled] = POSE
    waypoints: Array | None = None

    @classmethod
    def through(cls, poses: npt.ArrayLike) -> Goal:
        """Return the goal at the end of a base path: poses (K, 7).

        Raises
        ------
        GoalError
            See :meth:`EndEffectorGoal.along`; or the poses have no orientations.
        """
        end = EndEffectorGoal.along("base", poses)
        if end.quaternion is None:
            raise GoalError("The path of the base needs an orientation in each pose.")
        return cls(end.position, end.quaternion, waypoints=end.waypoints)

    @classmethod
    def of_end_effectors(
        cls,
        end_effectors: Iterable[EndEffectorGoal],
        *,
        position: npt.ArrayLike | None = None,
        quaternion: npt.ArrayLike | None = None,
        joint_positions: npt.ArrayLike | None = None,
    ) -> Goal:
        """Return an end-effector goal; the base is free except for the given pose components.

        Raises
        ------
        GoalError
            A link has two goals or there is no goal, or a list is rejected by :meth:`checked`.
        """
        goals = tuple(end_effectors)
        if not goals:
            raise GoalError("The goal names no end-effector.")
        _require_one_goal_each(goals)
        given: dict[Controlled, object] = {"position": position, "attitude": quaternion}
        base = frozenset(part for part, value in given.items() if value is not None)
        made = cls.checked(position, quaternion, joint_positions)
        return replace(made, end_effectors=goals, base=base)

    @classmethod
    def checked(
        cls,
        position: npt.ArrayLike | None = None,
        quaternion: npt.ArrayLike | None = None,
        joint_positions: npt.ArrayLike | None = None,
    ) -> Goal:
        """Return a goal with a unit quaternion; the default pose is the origin of W.

        Raises
        ------
        GoalError
            A list has the wrong length, or contains numbers that are not finite or are too large,
            or the quaternion is zero.
        """
        r, q = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        if position is not None:
            r = as_numbers(position, "The goal position", GoalError)
        if quaternion is not None:
            q = as_numbers(quaternion, "The goal orientation", GoalError)
        if r.shape != (3,) or q.shape != (4,):
            raise GoalError("A goal needs three position values and four orientation values.")
        if not np.all(np.isfinite(r)):
            raise GoalError(f"The goal position {r.tolist()} is not finite.")
        if np.abs(r).max() > _MAX_COORDINATE:
            raise GoalError(
                f"The goal position {r.tolist()} is more than {_MAX_COORDINATE:g} m from the "
                "origin."
            )
        if not np.all(np.isfinite(q)):
            raise GoalError(f"The goal orientation {q.tolist()} is not finite.")
        shape = None
        if joint_positions is not None:
            shape = as_numbers(joint_positions, "The goal shape", GoalError)
            # A comparison with NaN is false.
            if shape.ndim != 1 or not np.all(np.abs(shape) <= _MAX_COORDINATE):
                raise GoalError(
                    f"The goal shape {shape.tolist()} is not a list of finite joint positions "
                    f"of at most {_MAX_COORDINATE:g} m or rad."
                )
        try:
            return cls(r, unit_quaternion(q), shape)
        except ValueError:
            raise GoalError(
                f"The goal orientation {q.tolist()} is a zero quaternion, not a rotation; the "
                "identity is (0, 0, 0, 1)."
            ) from None

    @classmethod
    def received(
        cls,
        position: Sequence[float],
        quaternion: Sequence[float],
        joint_positions: npt.ArrayLike | None = None,
    ) -> Goal:
        """Return the goal in a message; NaN components are not requested.

        Raises
        ------
        GoalError
            See :meth:`checked`; or the entire pose is NaN.
        """
        parts: dict[Controlled, Sequence[float]] = {"position": position, "attitude": quaternion}
        asked = frozenset(part for part, numbers in parts.items() if not np.isnan(numbers).all())
        if not asked:
            raise GoalError("The goal pose is all NaN, which requests nothing.")
        made = cls.checked(
            position if "position" in asked else None,
            quaternion if "attitude" in asked else None,
            joint_positions,
        )
        return replace(made, asked=asked)

    @classmethod
    def from_rotvec(cls, position: npt.ArrayLike, rotvec: npt.ArrayLike) -> Goal:
        """Return the goal at a position (m) with the attitude ``exp(hat(rotvec))`` (rad).

        Raises
        ------
        GoalError
            The goal is invalid, or the vector does not have three numbers of at most 1e6 turns.
        """
        vector = as_numbers(rotvec, "The goal rotation vector", GoalError)
        if vector.shape != (3,) or not np.all(np.abs(vector) <= _MAX_ANGLE):
            raise GoalError(
                f"The rotation vector {rotvec!r} does not consist of three finite numbers of at "
                f"most {_MAX_ANGLE:.2g} rad."
            )
        return cls.checked(position, quaternion_from_rotvec(vector))

    @classmethod
    def from_rpy(cls, position: npt.ArrayLike, rpy_deg: npt.ArrayLike) -> Goal:
        """Return the goal at a position (m) with fixed-axis roll, pitch and yaw (deg).

        Raises
        ------
        GoalError
            The goal is invalid, or the angles are not three finite numbers.
        """
        angles = as_numbers(rpy_deg, "The goal roll, pitch and yaw", GoalError)
        if angles.shape != (3,) or not np.all(np.abs(angles) <= np.degrees(_MAX_ANGLE)):
            raise GoalError(f"The angles {rpy_deg!r} are not three finite numbers in degrees.")
        return cls.checked(position, quaternion_from_matrix(matrix_from_rpy(np.radians(angles))))

    def for_robot(self, robot: RobotDescription) -> Goal:
        """Return the goal with link names resolved; an empty name means the default end-effector.

        Raises
        ------
        GoalError
            The robot has no such link, the link is the base, or a link has two goals.
        """
        names = ", ".join(each.name for each in robot.links[1:])
        remedy = f": name one of its links {names}" if names else ", nor any other than its base"
        goals = []
        for each in self.end_effectors:
            link = robot.end_effector(each.link)
            if not link:
                raise GoalError(
                    f"The goal is for the end-effector, but robot '{robot.name}' has no link "
                    f"'{DEFAULT_END_EFFECTOR}'{remedy}."
                )
            if link == robot.base_link:
                raise GoalError(
                    f"The goal is for '{link}', which is the base: give its pose as the base goal."
                )
            if link not in robot.frames:
                raise GoalError(
                    f"The goal is for '{link}', which robot '{robot.name}' does not have; its "
                    f"links are {names}."
                )
            goals.append(replace(each, link=link))
        _require_one_goal_each(goals)
        return replace(self, end_effectors=tuple(sorted(goals, key=lambda each: each.link)))

    def joined_with(self, other: Goal) -> Goal:
        """Return this goal merged with another goal; the other goal takes precedence.

        If both goals are for the base only, the other goal is returned.
        """
        if not self.end_effectors and not other.end_effectors:
            return other
        links = {each.link: each for each in (*self.end_effectors, *other.end_effectors)}
        of_base = other if other.base else self
        shape = self.joint_positions if other.joint_positions is None else other.joint_positions
        return replace(of_base, joint_positions=shape, end_effectors=tuple(links.values()))

    def kept_at(self, position: Array, quaternion: Array) -> Goal:
        """Return the goal, with the components that it does not request taken from a base pose."""
        if self.asked == POSE or not self.base:
            return self
        return replace(
            self,
            position=self.position if "position" in self.asked else position.copy(),
            quaternion=self.quaternion if "attitude" in self.asked else quaternion.copy(),
        )

    @property
    def has_path(self) -> bool:
        """Whether an end-effector follows a given path to the goal."""
        return bool(self.links_with_paths)

    @property
    def links_with_paths(self) -> frozenset[str]:
        """Links that follow a given path."""
        return frozenset(each.link for each in self.end_effectors if each.waypoints is not None)

    def displaced(self, by: Array) -> Goal:
        """Return the goal with all its positions displaced by a vector (3,) in W, m."""
        hands = tuple(each.displaced(by) for each in self.end_effectors)
        moved = _displaced(self.waypoints, by)
        return replace(self, position=self.position + by, end_effectors=hands, waypoints=moved)

    @property
    def path_values(self) -> Array:
        """The waypoints and the goal (K + 1, 7), as accepted by :meth:`through`."""
        end = np.concatenate([self.position, self.quaternion])[np.newaxis]
        return end if self.waypoints is None else np.vstack([self.waypoints, end])

    def after_waypoints(self, passed: int) -> Goal:
        """Return the goal without its first waypoints."""
        if self.waypoints is None or not passed:
            return self
        left = self.waypoints[passed:]
        return replace(self, waypoints=left if len(left) else None)

    def equals(self, other: Goal) -> bool:
        """Whether another goal has exactly the same poses and shape."""
        mine, others = (
            (
                each.base,
                None if each.joint_positions is None else each.joint_positions.tolist(),
                each.path_values.tolist(),
                {hand.link: hand.path_values.tolist() for hand in each.end_effectors},
            )
            for each in (self, other)
        )
        return mine == others


def warn_of_large_angles(rotvec: npt.ArrayLike) -> None:
    """Warn about a rotation of more than one revolution, which may be in degrees."""
    angle = float(np.linalg.norm(rotvec))
    if 2 * np.pi < angle < np.inf:
        warn_once(
            f"The goal rotates by {angle:.5g} rad, which is {angle / (2 * np.pi):.3g} "
            "revolutions: only the final attitude matters. Rotation vectors are in rad; "
            "--goal-rpy-deg takes degrees."
        )


def _displaced(waypoints: Array | None, by: Array) -> Array | None:
    return None if waypoints is None else waypoints + np.pad(by, (0, waypoints.shape[1] - 3))


def _require_one_goal_each(goals: Iterable[EndEffectorGoal]) -> None:
    for link, count in Counter(each.link for each in goals).items():
        if count > 1:
            name = f" '{link}'" if link else ""
            raise GoalError(f"The end-effector{name} has {count} goals; only one is allowed.")


@dataclass(frozen=True)
class RobotState:
    """State of a robot.

    Attributes
    ----------
    position, quaternion
        (3,) r_WB in m, and (4,) of R_WB, (x, y, z, w).
    q
        (n,) joint positions, m or rad.
    linear_momentum, angular_momentum
        (3,) each in W, kg m/s and kg m^2/s; angular momentum is about the system's centre of mass.
    qdot
        (n,) joint velocities, m/s or rad/s; None: zero. Plans from rest use only the velocities of
        reaction wheels, which may spin while the other joints are at rest.
    """

    position: Array
    quaternion: Array
    q: Array
    linear_momentum: Array = field(default_factory=lambda: np.zeros(3))
    angular_momentum: Array = field(default_factory=lambda: np.zeros(3))
    qdot: Array | None = None


@dataclass(frozen=True)
class PoseError:
    """Remaining error of a pose and a shape relative to a goal.

    Attributes
    ----------
    position
        (3,) vector from the base to its goal, in W, m.
    rotvec
        (3,) rotation vector from the attitude to the goal attitude, in B, rad.
    shape
        (n,) differences from joint positions to goal positions, m or rad; empty if there are none.
    end_effectors
        The same errors for each end-effector in the goal: position in W, rotation in the
        end-effector frame (zero for a position-only goal).
    """

    position: Array
    rotvec: Array
    shape: Array = field(default_factory=lambda: np.zeros(0))
    end_effectors: tuple[PoseError, ...] = ()

    @classmethod
    def between(
        cls,
        position: Array,
        quaternion: Array,
        goal: Goal,
        q: Array | None = None,
        robot: SpaceRobot | None = None,
    ) -> PoseError:
        """Return the error of a pose, and of the shape ``q`` (n,) if given, relative to the goal.

        End-effector errors require the shape and the robot.
        """
        shape = np.zeros(0)
        hands: tuple[PoseError, ...] = ()
        if q is not None and goal.joint_positions is not None:
            shape = goal.joint_positions - q
        if q is not None and robot is not None and goal.end_effectors:
            poses = [
                end_effector_pose(robot, each.link, position, quaternion, q)
                for each in goal.end_effectors
            ]
            hands = tuple(map(cls.of_link, map(np.concatenate, poses), goal.end_effectors))
        turn = attitude_error(quaternion, goal.quaternion)
        return cls(goal.position - position, turn, shape, hands)

    @classmethod
    def of_link(cls, pose: Array, goal: Goal | EndEffectorGoal) -> PoseError:
        """Return the error of a link pose (7,) in the world relative to its goal."""
        turn = np.zeros(3)
        if goal.quaternion is not None:
            turn = attitude_error(pose[3:], goal.quaternion)
        return cls(goal.position - pose[:3], turn)

    @cached_property
    def distance(self) -> float:
        """Length of the position error, m."""
        return math.sqrt(self.position.dot(self.position))

    @cached_property
    def angle(self) -> float:
        """Angle of the attitude error, rad."""
        return math.sqrt(self.rotvec.dot(self.rotvec))

    @property
    def max_joint_error(self) -> float:
        """Largest joint error, m or rad; zero for a goal without a shape."""
        return float(np.abs(self.shape).max(initial=0.0))

    @property
    def largest_end_effector_distance(self) -> float:
        """Largest distance of an end-effector from its goal, m; zero if the goal has none."""
        return max((each.distance for each in self.end_effectors), default=0.0)

    @property
    def largest_end_effector_angle(self) -> float:
        """Largest angle between an end-effector and its goal, rad; zero if the goal has none."""
        return max((each.angle for each in self.end_effectors), default=0.0)


def end_effector_pose(
    robot: SpaceRobot, link: str, position: Array, quaternion: Array, q: Array
) -> tuple[Array, Array]:
    """Return the pose of a link: r_WE (3,), m, and the quaternion (4,) of R_WE.

    ``position`` (3,), ``quaternion`` (4,) and ``q`` (n,) are the base pose and the shape.

    Raises
    ------
    KeyError
        There is no such link.
    """
    R_BE, r_BE_B = robot.link_pose(link, q)
    R_WB = matrix_from_quaternion(quaternion)
    return position + R_WB @ r_BE_B, quaternion_from_matrix(R_WB @ R_BE)


def uncontrolled_parts(goal: Goal, controls: frozenset[Controlled]) -> tuple[Controlled, ...]:
    """Return the base and shape components requested by a goal but not in ``controls``."""
    asked: list[Controlled] = [part for part in ("position", "attitude") if part in goal.base]
    if goal.joint_positions is not None:
        asked.append("shape")
    return tuple(part for part in asked if part not in controls)


def missed_parts(
    goal: Goal, error: PoseError, controls: frozenset[Controlled], tolerance: Tolerance
) -> dict[str, str]:
    """Return requested base components out of tolerance and not controlled, with their errors."""
    errors: dict[Controlled, tuple[float, float, str]] = {
        "position": (error.distance, tolerance.position, "m"),
        "attitude": (error.angle, tolerance.attitude, "rad"),
    }
    return {
        part: f"{size:.3g} {unit}"
        for part, (size, most, unit) in errors.items()
        if part in goal.base & goal.asked - controls and size > most
    }


def missed_turn(angle: float, tolerance: Tolerance) -> dict[str, str]:
    """Return a missed end-effector attitude (rad) in the format of :func:`missed_parts`."""
    return {"end-effector's attitude": f"{angle:.3g} rad"} if angle > tolerance.attitude else {}


def reached_message(remaining: str, missed: Mapping[str, str]) -> str:
    """Return the message for a reached goal; ``missed`` are its :func:`missed_parts`."""
    parts = " and ".join(f"its {part}, which is {error} off" for part, error in missed.items())
    but = f" but for {parts} (not controlled here)" if parts else ""
    return f"The goal is reached{but}: {remaining}."


@dataclass(frozen=True)
class Tolerance:
    """Largest errors at a reached goal: ``position`` m, ``attitude`` rad, joints m or rad.

    Pose tolerances apply to the base and to end-effectors.
    """

    position: float
    attitude: float
    shape: float = 1e-3

    def require_control(self, goal: Goal, controls: frozenset[Controlled], who: str) -> None:
        """Reject a goal with a tolerance here (0: none) for a component not controlled by ``who``.

        ``controls`` are the goal components controlled by ``who``, a method or a law.

        Raises
        ------
        GoalError
            A tolerance is given for a goal component that is not controlled.
        """
        given = {"position": self.position, "attitude": self.attitude, "shape": self.shape}
        missing = [part for part in uncontrolled_parts(goal, controls) if given[part]]
        if missing:
            named = " and ".join("joints" if part == "shape" else part for part in missing)
            raise GoalError(
                f"The goal gives a tolerance for its {named}, which {who} does not control here: "
                "set that tolerance to 0 to accept any error."
            )

    def admits(self, error: PoseError, controls: frozenset[Controlled] = POSE) -> bool:
        """Whether an error is within tolerance in all controlled goal components."""
        hands = error.end_effectors
        return (
            ("position" not in controls or error.distance <= self.position)
            and ("attitude" not in controls or error.angle <= self.attitude)
            and ("shape" not in controls or error.max_joint_error <= self.shape)
            # Unknown errors do not count as small.
            and ("end_effectors" not in controls or (bool(hands) and all(map(self.admits, hands))))
        )


NO_TOLERANCE = Tolerance(0.0, 0.0, 0.0)
"""Default tolerances if the sender specifies none."""
