"""What the planner says of itself: one latched status, for people and for programs."""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from spacerobot_ros.nodes.common.diagnostics import diagnostic_status
from spacerobot_ros.nodes.common.node import LATCHED
from spacerobot_ros.planning import GaitSchedule, Goal, PoseError


class PlannerState(str, Enum):
    """The value of ``state`` in planner/status."""

    IDLE = "idle"
    PLANNING = "planning"
    EXECUTING = "executing"
    REACHED = "reached"
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"


_LEVELS = {
    PlannerState.FAILED: DiagnosticStatus.ERROR,
    PlannerState.REFUSED: DiagnosticStatus.ERROR,
    PlannerState.ABORTED: DiagnosticStatus.WARN,
}


class PlannerStatus:
    """Publishes planner/status and logs the same sentence."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticStatus, "planner/status", LATCHED)

    def publish(
        self,
        state: PlannerState,
        sentence: str,
        *,
        goal: Goal | None = None,
        error: PoseError | None = None,
        corrections: int = 0,
        schedule: GaitSchedule | None = None,
        flown_time: float = 0.0,
        ends_at: float = 0.0,
    ) -> None:
        """Publish the state with a sentence and what belongs to it.

        ``flown_time`` is the duration of the schedules for the goal so far, ``ends_at`` the
        simulated time at which the last one ends, s.
        """
        values = {"state": state.value, "corrections": str(corrections)}
        if goal is not None:
            values["goal"] = " ".join(f"{x:.9g}" for x in (*goal.position, *goal.quaternion))
        if error is not None:
            values["position_error_m"] = f"{error.distance:.9g}"
            values["attitude_error_rad"] = f"{error.angle:.9g}"
        if ends_at:
            values["manoeuvre_time_s"] = f"{flown_time:.9g}"
            values["ends_at_s"] = f"{ends_at:.9g}"
        if schedule is not None:
            values["method"] = schedule.method
            values["duration_s"] = f"{schedule.duration:.9g}"
            for name, note in schedule.notes.items():
                numbers = note if isinstance(note, list) else [note]
                values[name] = " ".join(
                    f"{x:.9g}" if isinstance(x, float) else str(x) for x in numbers
                )
        level = _LEVELS.get(state, DiagnosticStatus.OK)
        name = self._node.get_fully_qualified_name()
        self._publisher.publish(diagnostic_status(name, level, sentence, values))
        logger = self._node.get_logger()
        # Two calls: rclpy refuses one that changes its severity.
        if level == DiagnosticStatus.OK:
            logger.info(sentence)
        else:
            logger.warning(sentence)


def what_is_left(error: PoseError, controls: Collection[str]) -> str:
    """Say how far from the goal the robot is, in the parts of it that are controlled."""
    parts = {
        "position": f"{error.distance:.3g} m",
        "attitude": f"{error.angle:.3g} rad",
    }
    if len(error.shape):
        parts["shape"] = f"{error.farthest_joint:.3g} at the joints"
    left = " and ".join(text for part, text in parts.items() if part in controls)
    return f"{left} from the goal"
