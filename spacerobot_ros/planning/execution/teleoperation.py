"""Teleoperation: joint rates for an end-effector twist while the base floats.

At zero momentum, the generalised Jacobian ``J*(q)`` maps joint rates to the twist of an
end-effector (Umetani and Yoshida), so ``qdot = J*^+ [v; omega]`` are the smallest rates that
produce the twist, each relative to the joint's velocity limit. With ``keep_attitude``, the base
must not rotate either (``-A qdot = 0``), so the rates lie in the reaction null space.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.errors import PlanningError, sentence_case
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.measured_states import MeasuredState
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorRows
from spacerobot_ros.planning.methods.optimal.goal_specification import BaseRotations
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits
from spacerobot_ros.planning.methods.resolved_rate import (
    MIN_PROGRESS_RATE,
    ResolvedRateGait,
    ResolvedRateOptions,
    unit_of_motion,
)
from spacerobot_ros.times import SECOND

_SLOW_PROGRESS_RATE = 2 * MIN_PROGRESS_RATE
"""Progress per joint motion below which the end-effector slows down before a singularity."""

_LOOK_AHEAD = 1e-3
"""Motion of the fastest joint after which progress is checked again, rad."""

_TRIED_SPEED_SHARES = (1.0, 0.5, 0.25, 0.0)
"""Fractions of the rates tried if links come too close; at the last fraction, the joints brake."""

_MAX_TWIST = 1e6
"""Largest value in a twist, m/s or rad/s: squares of much larger values overflow."""

_MIDPOINT_STEPS = 2
_ROUNDING = 1e-12

TwistFrame = Literal["world", "base", "link"]
"""Frame in which the components of a twist are given."""


@dataclass(frozen=True)
class TwistCommand:
    """Desired twist of a link origin, relative to the world.

    Attributes
    ----------
    link
        Name of the link.
    linear, angular
        (3,) velocity, m/s, and angular velocity, rad/s, in the frame.
    frame
        The frame of both.
    """

    link: str
    linear: Array
    angular: Array
    frame: TwistFrame

    @classmethod
    def checked(
        cls, robot: SpaceRobot, link: str, linear: Array, angular: Array, frame: str, world: str
    ) -> TwistCommand:
        """Return a twist in the named frame; ``world`` is the world frame.

        Raises
        ------
        PlanningError
            The link, the frame or a value is invalid.
        """
        description = robot.description
        if link not in description.frames or link == description.base_link:
            raise PlanningError(f"Robot '{description.name}' has no end-effector '{link}'.")
        base = description.base_link
        frames: dict[str, TwistFrame] = {world: "world", base: "base", link: "link"}
        # Frames of a robot may have a prefix.
        found = frames.get(frame) or frames.get(frame.rpartition("/")[2])
        if found is None:
            names = "', '".join(frames)
            raise PlanningError(f"The frame '{frame}' of the twist is not one of '{names}'.")
        if not (np.all(np.isfinite(linear)) and np.all(np.isfinite(angular))):
            raise PlanningError("The twist has a non-finite value.")
        if max(np.abs(linear).max(), np.abs(angular).max()) > _MAX_TWIST:
            raise PlanningError(f"The twist has a value beyond {_MAX_TWIST:g} m/s or rad/s.")
        return cls(link, np.asarray(linear, float), np.asarray(angular, float), found)


class TwistStep(NamedTuple):
    """Result for one state while an end-effector follows twists.

    ``rates`` (n,) are the joint rates; None if the joints hold their shape. ``message`` is reported
    in the status, if new. ``ended``: whether the joints are at rest and no more twists arrive.
    """

    rates: Array | None
    message: str
    ended: bool = False


@dataclass
class _Following:
    """The twists that one end-effector follows."""

    follower: TwistFollower
    twist: TwistCommand | None
    """The last twist; None: the joints brake."""
    received_ns: int
    """Stamp, in ns, of the state that preceded the twist."""
    reported: str | None = None
    """First words of the last reported reason; empty: the twist is followed."""
    limited_ns: int = 0
    """Stamp of the last state at which the twist was not followed, ns."""
    pose: Array | None = None
    """(7,) last measured base pose."""
    pose_ns: int = 0
    """Stamp, in ns, of the state with this pose."""


class Teleoperation:
    """End-effectors that follow twists, one at a time, until none arrives for ``twist_timeout``.

    After a refusal or an abort, twists are rejected until none has arrived for this long, so that
    an operator who keeps sending twists does not cause unexpected motion.

    Parameters
    ----------
    robot, config
        The model, and the planner parameters.
    clearance
        Distances that are kept; None: any.
    """

    def __init__(
        self, robot: SpaceRobot, config: PlannerConfig, clearance: Clearance | None
    ) -> None:
        self._robot, self._config, self._clearance = robot, config, clearance
        self._timeout_ns = config.twist_timeout * SECOND
        self._followers: dict[str, TwistFollower] = {}
        """Followers by link name."""
        self._following: _Following | None = None
        self._refused_ns: int | None = None
        """Stamp, in ns, of the state that preceded the last rejected twist."""

    def use_clearance(self, clearance: Clearance | None) -> None:
        """Use new clearances from now on."""
        self._clearance = clearance
        self._followers.clear()
        if self._following is not None:
            self._following.follower = self._follower_of(self._following.follower.link)

    def receive(self, twist: TwistCommand, stamp_ns: int) -> None:
        """Follow a twist from the next state on; ``stamp_ns`` is the stamp of the previous state.

        Raises
        ------
        PlanningError
            The twist is rejected; the message says why.
        """
        refused, following = self._refused_ns, self._following
        try:
            if refused is not None and stamp_ns - refused <= self._timeout_ns:
                timeout = self._config.twist_timeout
                raise PlanningError(
                    f"Twists are ignored until no twist has arrived for {timeout:g} s."
                )
            if following is not None and following.follower.link != twist.link:
                raise PlanningError(
                    f"'{following.follower.link}' follows twists: '{twist.link}' waits until they "
                    "stop."
                )
            follower = self._follower_of(twist.link)
        except PlanningError:
            self.refuse(stamp_ns)
            raise
        if following is None:
            self._following = _Following(follower, twist, stamp_ns)
        else:
            following.twist, following.received_ns = twist, stamp_ns

    def refuse(self, stamp_ns: int) -> None:
        """Record that a twist was rejected after the state with this stamp."""
        self._refused_ns = stamp_ns

    def abort(self, stamp_ns: int) -> None:
        """Brake the joints, and reject any twists that still arrive."""
        self.refuse(stamp_ns)
        if self._following is not None:
            self._following.twist = None

    def end(self) -> None:
        """Stop following twists."""
        self._following = None

    def _follower_of(self, link: str) -> TwistFollower:
        if link not in self._followers:
            config = self._config
            options = config.options.get(ResolvedRateGait.name, ResolvedRateOptions())
            self._followers[link] = TwistFollower(
                self._robot, link, options, config.control_period, self._clearance
            )
        return self._followers[link]

    def keep_base_pose(self, measured: MeasuredState) -> None:
        """Store the measured base pose."""
        following, base = self._following, measured.base
        if following is not None and base is not None and np.all(np.isfinite(base.pose)):
            following.pose, following.pose_ns = base.pose, measured.stamp_ns

    def step(self, measured: MeasuredState, before: Array, *, goal_waits: bool) -> TwistStep:
        """Return the result for a state: braking if the twist is stale or a goal is waiting.

        ``before`` (n,) are the last commanded rates.
        """
        following, stamp, q = self._following, measured.stamp_ns, measured.q
        assert following is not None
        self.keep_base_pose(measured)
        if goal_waits or stamp - following.received_ns > self._timeout_ns:
            following.twist = None
        twist, reason = following.twist, ""
        if following.pose is None or stamp - following.pose_ns > self._timeout_ns:
            twist, reason = None, "The base motion is not measured."
        if not np.all(np.isfinite(q)):
            return TwistStep(None, "The joint motion is not measured.", ended=True)
        pose = np.eye(7)[6] if following.pose is None else following.pose
        rates, limited = following.follower.rates(twist, pose, q, before)
        if following.twist is None and not np.any(rates):
            return TwistStep(rates, "No more twists arrive: the joints are at rest.", ended=True)
        return TwistStep(rates, self._news(following, reason or limited, stamp))

    def _news(self, following: _Following, reason: str, stamp: int) -> str:
        """Return the message about a new reason, or one that has been over for a while."""
        beginning = reason.split(":")[0].split(" come within ")[0].split(" touch,")[0]
        if reason:
            following.limited_ns = stamp
        lasts = bool(following.reported) and stamp - following.limited_ns <= self._timeout_ns
        if beginning == following.reported or (lasts and not reason):
            return ""
        following.reported = beginning
        if reason:
            return f"{reason} The twist is followed as far as possible."
        return f"'{following.follower.link}' follows twists."


class TwistFollower:
    """Joint rates for twists of one link, within all limits.

    The rotation follows the twist if the joints have enough degrees of freedom; otherwise only the
    link origin follows it. The robot slows down and stops before a dynamic singularity, before
    joint limits, and before links come too close; a twist that leads away from them is followed.

    Parameters
    ----------
    robot
        The model.
    link
        The link.
    options
        Options of ``resolved_rate``: motion limits, and whether the base keeps its attitude.
    control_period
        Command duration, s.
    clearance
        Distances that are kept; None: any.

    Raises
    ------
    PlanningError
        The joints cannot make the link follow twists.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        link: str,
        options: ResolvedRateOptions,
        control_period: float,
        clearance: Clearance | None = None,
    ) -> None:
        self.link, self._robot, self._period = link, robot, control_period
        self._limits = limits = MotionLimits.of(robot, options, "resolved_rate")
        finite = np.where(np.isfinite(limits.velocity), limits.velocity, 1.0)
        self._weights = finite / finite.max(initial=1e-300)
        self._keeps_attitude = options.keep_attitude == 1
        self._clearance = clearance
        self._required: Array | None = None
        """Distances (P,), m, that pairs of bodies must keep, determined at the first shape."""
        axes = BaseRotations.of(robot).loop_axes
        (directions,) = EndEffectorRows(robot, [(link, True)], axes).directions
        displacements, rotations = directions.displacements, directions.rotations
        kept = len(axes) if self._keeps_attitude else 0
        if len(displacements) + kept > robot.n or not len(displacements):
            still = " and keep the base attitude" if kept else ""
            raise PlanningError(
                f"Robot '{robot.description.name}' has too few joints to move '{link}' by "
                f"twists{still}."
            )
        self.turns = len(displacements) + len(rotations) + kept <= robot.n
        """Whether the rotation follows the twist."""
        reach = unit_of_motion(robot, limits, link)
        self._displacements = displacements
        self._rotations = rotations if self.turns else rotations[:0]
        self._scales = np.repeat([1 / reach, 1.0], [len(displacements), len(self._rotations)])

    def rates(
        self, twist: TwistCommand | None, pose: Array, q: Array, before: Array
    ) -> tuple[Array, str]:
        """Return the rates (n,) for the next tick, and the reason if the twist is not followed.

        Parameters
        ----------
        twist
            The desired twist; None: no twist, so the joints come to rest.
        pose
            (7,) of the base: position, m, and quaternion.
        q
            (n,) shape, m or rad.
        before
            (n,) last commanded rates.
        """
        wanted, reason = np.zeros(len(q)), ""
        if twist is not None:
            wanted, reason = self._wanted(twist, pose, q)
            # Rates are held for a tick, so they are computed for its midpoint.
            for _ in range(_MIDPOINT_STEPS):
                half = self._limited(wanted, q, before) * self._period / 2
                turn = quaternion_from_rotvec(-self._robot.connection(q + half / 2)[3:] @ half)
                middle = np.append(pose[:3], quaternion_multiply(pose[3:], turn))
                wanted, reason = self._wanted(twist, middle, q + half)
        for share in _TRIED_SPEED_SHARES:
            rates = self._limited(share * wanted, q, before)
            if self._clearance is None or not np.any(rates):
                break
            clause = self._too_near(self._clearance, rates, pose, q)
            if not clause:
                break
            reason = f"{sentence_case(clause)}."
        return rates, reason

    def _wanted(self, twist: TwistCommand, pose: Array, q: Array) -> tuple[Array, str]:
        """Return rates proportional to those of the twist, and why they are smaller."""
        limits = self._limits
        R_BE, _ = self._robot.link_pose(self.link, q)
        R_BW = matrix_from_quaternion(pose[3:]).T
        R = {"world": R_BW, "base": np.eye(3), "link": R_BE}[twist.frame]
        v, omega = R @ twist.linear, R @ twist.angular
        motion = self._scales * np.append(self._displacements @ v, self._rotations @ omega)
        if np.linalg.norm(motion) <= _ROUNDING:
            return np.zeros(len(q)), ""
        rates, progress = self._solution(q, motion)
        factor, reason, ahead = 1.0, "", 0.0
        if progress < _SLOW_PROGRESS_RATE and rates.any():
            step = _LOOK_AHEAD * rates / np.abs(rates / self._weights).max()
            ahead = self._solution(q + step, motion)[1]
        # Rates that lead away from a singularity are not reduced.
        if ahead <= progress < _SLOW_PROGRESS_RATE:
            factor = max(
                0.0, (progress - MIN_PROGRESS_RATE) / (_SLOW_PROGRESS_RATE - MIN_PROGRESS_RATE)
            )
            reason = (
                f"'{self.link}' is near a dynamic singularity: it moves by {progress:.3g} of its "
                "reach per radian of the fastest joint."
            )
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = min(factor, float(np.nanmin(limits.velocity / np.abs(rates))))
            room = np.where(rates > 0, limits.upper - q, q - limits.lower)
            by_stops = np.where(rates != 0, self._rates_that_can_stop(room) / np.abs(rates), np.inf)
        nearest = int(np.argmin(by_stops))
        if by_stops[nearest] < factor:
            factor = float(by_stops[nearest])
            joint = self._robot.joint_names[nearest]
            limit = (limits.upper if rates[nearest] > 0 else limits.lower)[nearest]
            reason = f"Joint '{joint}' reaches its limit of {limit:.4g}."
        return factor * rates, reason

    def _solution(self, q: Array, motion: Array) -> tuple[Array, float]:
        """Return the rates (n,) of a scaled motion, and the motion for a radian of the joints."""
        J = self._robot.generalised_jacobian(self.link, q)
        rows = np.vstack([self._displacements @ J[:3], self._rotations @ J[3:]])
        M = self._scales[:, np.newaxis] * rows * self._weights
        goal = motion
        if self._keeps_attitude:
            M = np.vstack([M, self._robot.connection(q)[3:] * self._weights])
            goal = np.concatenate([motion, np.zeros(3)])
        # An attitude that does not depend on the joints never changes: its rows are zero.
        scaled = np.linalg.lstsq(M, goal, rcond=1e-9)[0]
        if np.linalg.norm(M @ scaled - goal) > 1e-6 * np.linalg.norm(goal):
            return np.zeros(len(q)), 0.0
        return self._weights * scaled, float(np.linalg.norm(motion) / np.linalg.norm(scaled))

    def _rates_that_can_stop(self, room: Array) -> Array:
        """Return the largest rates (n,) from which joints stop within a distance (n,)."""
        a, h = self._limits.acceleration, self._period
        free = np.maximum(room - a * h**2 / 8, 0.0)
        return np.asarray(a * (np.sqrt(h**2 / 4 + 2 * free / a) - h / 2))

    def _limited(self, wanted: Array, q: Array, before: Array) -> Array:
        """Return rates (n,) towards the desired ones, within acceleration and position limits."""
        limits, most = self._limits, self._limits.acceleration * self._period
        change = wanted - before
        with np.errstate(divide="ignore", invalid="ignore"):
            share = float(np.nanmin(np.append(most / np.abs(change), 1.0)))
        # All joints change together to keep the direction of motion, except at joint stops.
        rates = before + share * change
        up, down = map(self._rates_that_can_stop, (limits.upper - q, q - limits.lower))
        return np.asarray(np.clip(rates, -down, up))

    def _too_near(self, clearance: Clearance, rates: Array, pose: Array, q: Array) -> str:
        """Return a clause if links come too close before the joints can stop; else empty."""
        if self._required is None:
            at = BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])
            try:
                self._required = clearance.required(q, at if clearance.has_obstacles else None)
            except PlanningError as refusal:
                return str(refusal).removesuffix(".")
        next_ = q + rates * self._period
        rest = next_ + rates * np.abs(rates) / (2 * self._limits.acceleration)
        shapes = np.clip(np.vstack([next_, rest]), self._limits.lower, self._limits.upper)
        base = None
        if clearance.has_obstacles:
            base = BasePoses(np.tile(pose[:3], (2, 1)), np.tile(pose[3:], (2, 1)))
        found = clearance.approaches(shapes, self._required, base)
        return clearance.clause(found[0], None) if found else ""
