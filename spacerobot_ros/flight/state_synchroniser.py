"""Pairs the messages of one state, odom and joint_states, by the stamps in their bytes."""

from __future__ import annotations

from enum import Enum

from spacerobot_ros.times import HEADER_STAMP

CONTRADICTION = (
    "odom: two messages of one time differ; more than one node publishes it, and such poses are "
    "not used."
)
"""What a commander logs about :meth:`StateSynchroniser.put_odom`."""


class Pairing(str, Enum):
    """Which messages of a state a :class:`StateSynchroniser` hands over."""

    WHOLE = "whole"
    """``joint_states`` and ``odom`` have one stamp."""

    WITHOUT_POSE = "without pose"
    """``joint_states`` alone: its odom has not come."""

    LATE_POSE = "late pose"
    """``odom`` of a state that was handed over without it before."""


# Python looks up the member of an enum as slowly as it calls a function; these are for every state.
_WHOLE, _WITHOUT_POSE, _LATE_POSE = Pairing.WHOLE, Pairing.WITHOUT_POSE, Pairing.LATE_POSE


class StateSynchroniser:
    """Holds the latest odom and joint_states and hands every state over once.

    A commander either requires the pose (a controller) or does not (a planner, which needs it
    only to plan):

    * *Pose required:* a state is ready when its odom is there. Where odom fails, this is known
      when the next joint_states come: the state before is then :meth:`overdue`. From then on
      states are ready without their pose, until an odom comes again.
    * *Pose optional:* a state is ready with its joint_states; odom that comes after them is
      handed over as a :attr:`Pairing.LATE_POSE`.

    Topics beside these two can be required as well (:meth:`require`): a state then waits for a
    message of its stamp on each of them.

    Parameters
    ----------
    pose_required
        Whether a state waits for its odom.
    """

    def __init__(self, *, pose_required: bool) -> None:
        self._pose_required = pose_required
        self.odom = b""
        """The latest odom, serialised; empty before the first."""
        self.joint_states = b""
        """The latest joint_states, serialised; empty before the first."""
        self._odom_fresh = self._joints_fresh = self._without_pose = False
        self._required: dict[str, bytes] = {}
        """Latest messages of the topics that are required beside odom and joint_states."""

    def require(self, topic: str, *, required: bool = True) -> None:
        """Have states wait for a message on one more topic from now on, or no longer."""
        if not required:
            self._required.pop(topic, None)
        else:
            self._required.setdefault(topic, b"")

    def put_odom(self, raw: bytes) -> bool:
        """Accept an odom message; poses are measured (again).

        Return whether it contradicts the one before, of the same stamp: then another node
        publishes odom, too, and the state has no pose.
        """
        before, self.odom = self.odom, raw
        if raw[HEADER_STAMP] == before[HEADER_STAMP] and raw != before:
            self._odom_fresh, self._without_pose = False, True
            return True
        self._odom_fresh, self._without_pose = True, False
        return False

    def forget_pose(self) -> None:
        """Take no later odom for a contradiction: the plant shows another state of one time.

        Nor is it the pose of joints that were handed over before.
        """
        self.odom, self._odom_fresh = b"", False
        if not self._joints_fresh:
            self.joint_states = b""

    def put_joint_states(self, raw: bytes) -> None:
        """Accept a joint_states message; see :meth:`overdue` for the state before."""
        self.joint_states = raw
        self._joints_fresh = True

    def put_required(self, topic: str, raw: bytes) -> None:
        """Accept a message of another topic, which is required from now on."""
        self._required[topic] = raw

    def latest(self, topic: str) -> bytes:
        """Return the latest message of a required topic; empty if there is none."""
        return self._required.get(topic, b"")

    def ready(self) -> Pairing | None:
        """Hand over the state that is ready; None if there is none, or it was handed over."""
        stamp = self.joint_states[HEADER_STAMP]
        together = stamp == self.odom[HEADER_STAMP]
        if not self._pose_required:
            posed = self._odom_fresh and together
            self._odom_fresh = self._odom_fresh and not together
            if self._joints_fresh:
                self._joints_fresh = False
                return _WHOLE if posed else _WITHOUT_POSE
            return _LATE_POSE if posed else None
        if (
            self._joints_fresh
            and (self._without_pose or (self._odom_fresh and together))
            and all(raw[HEADER_STAMP] == stamp for raw in self._required.values())
        ):
            self._odom_fresh = self._joints_fresh = False
            return _WITHOUT_POSE if self._without_pose else _WHOLE
        return None

    def overdue(self) -> Pairing | None:
        """Hand over a state that was never ready; to be called when the next joint_states come.

        :attr:`Pairing.WITHOUT_POSE`: its odom is missing, and states are ready without from now
        on. :attr:`Pairing.WHOLE`: another required topic is silent.
        """
        if not self._joints_fresh:
            return None
        self._joints_fresh = False
        self._without_pose = self.joint_states[HEADER_STAMP] != self.odom[HEADER_STAMP]
        return _WITHOUT_POSE if self._without_pose else _WHOLE
