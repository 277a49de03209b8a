"""Planar chains, square paths in shape space: the reorientation of paper 3, section III.

Step 1 brings the shape to the wanted one, ``psi_e``. Step 2 goes to the corner of a square that is
nearest to it, step 3 goes round the square, step 4 comes back by the path of step 2. The square is
such that its geometric phase is the turn of the base that is missing after step 1; steps 2 and 4
cancel.

Every leg is a straight line of the shape from rest to rest. The plant holds each velocity for a
tick: the shape then moves along the same straight lines with other speeds within a tick, and the
geometric phase, which depends on the path alone, is that of the smooth motion exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.model.rotations import quaternion_inverse, quaternion_multiply
from spacerobot_ros.parameters import parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.goal import Controlled, PoseError
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.planar import planar_axis
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import GaitSchedule, Notes
from spacerobot_ros.planning.methods.geometric_phase import PlanarPhase
from spacerobot_ros.planning.methods.square_loop import SquareLoop, SquareSearch
from spacerobot_ros.planning.methods.straight_legs import straight_motion

_WORTHWHILE = 0.1
"""A missing turn below this share of the tolerance is left as it is."""

_NO_ROTATION = 1e-9


@dataclass(frozen=True)
class SquarePathOptions:
    """The options of ``square_path``."""

    t1: float = parameter(
        8.0,
        "end of step 1, the motion to the final shape",
        unit="s",
        minimum=0.001,
        maximum=1000000000.0,
    )
    t2: float = parameter(
        12.0,
        "end of step 2, the motion to the square",
        unit="s",
        minimum=0.001,
        maximum=1000000000.0,
    )
    t3: float = parameter(
        20.0,
        "end of step 3, one loop; more loops take as long each",
        unit="s",
        minimum=0.001,
        maximum=1000000000.0,
    )
    t4: float = parameter(
        24.0, "end of step 4, the motion back", unit="s", minimum=0.001, maximum=1000000000.0
    )
    most_loops: int = parameter(20, "loops that a turn may take", minimum=1, maximum=1000000)
    given_centre: int = parameter(
        0, "1: squares round (centre_1, centre_2); 0: the best", minimum=0, maximum=1
    )
    centre_1: float = parameter(
        0.0, "first coordinate of a given centre", unit="rad", minimum=-1000.0, maximum=1000.0
    )
    centre_2: float = parameter(
        0.0, "second coordinate of a given centre", unit="rad", minimum=-1000.0, maximum=1000.0
    )
    check_position: int = parameter(
        0, "1: refuse goals that are not where the base ends", minimum=0, maximum=1
    )
    longest: float = parameter(
        3600.0,
        "longest manoeuvre that is still planned",
        unit="s",
        minimum=1.0,
        maximum=1000000000.0,
    )


class SquarePathGait(GaitMethod):
    """Attitude and shape of planar trees of three or more links with joints that turn.

    The base's position follows from both (the centre of mass rests) and cannot be chosen.
    """

    name: ClassVar[str] = "square_path"
    controls: frozenset[Controlled] = frozenset({"attitude", "shape"})
    Options: ClassVar[type[SquarePathOptions]] = SquarePathOptions
    options: SquarePathOptions

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        options: SquarePathOptions | None = None,
    ) -> None:
        super().__init__(robot, control_period, integration_step, options)
        chosen = self.options
        t1, t2, t3, t4 = chosen.t1, chosen.t2, chosen.t3, chosen.t4
        instants = (0.0, t1, t2, t3, t4)
        if not np.all(np.diff(instants) > 0):
            raise ParameterError(
                f"The times t1 to t4 of square_path are {t1:g}, {t2:g}, {t3:g} and {t4:g} s; "
                "each must be later than the one before."
            )
        self._durations = tuple(float(x) for x in np.diff(instants))
        self._refusal: PlanningError | None = None
        try:
            self._phase = PlanarPhase(robot)
        except PlanningError as refusal:
            # Planners exist before goals: the robot is refused with the first one.
            self._refusal = refusal
            return
        centre = np.array([chosen.centre_1, chosen.centre_2])
        self._search = SquareSearch(
            robot, self._phase, chosen.most_loops, centre if chosen.given_centre else None
        )
        self._prediction = BasePrediction(robot, control_period, integration_step)

    @classmethod
    def objection(cls, robot: SpaceRobot) -> str:
        """Return why the robot is not planar, or has too few links."""
        try:
            planar_axis(robot)
        except PlanningError as refusal:
            return str(refusal)
        return ""

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan steps 1 to 4; see :meth:`GaitMethod.plan`."""
        state, goal, tolerance = request.state, request.goal, request.tolerance
        if self._refusal is not None:
            raise PlanningError(str(self._refusal))
        self._require_rest(state)
        turn = self._turn(request)
        psi_e = self._goal_shape(goal)
        if psi_e is None:
            psi_e = np.clip(state.q, self.robot.lower, self.robot.upper)
        step_1 = float(self._phase.legs(state.q[np.newaxis], psi_e[np.newaxis])[0])
        # Whole turns are no matter: the smaller of the two ways round.
        wanted = math.remainder(turn - step_1, 2 * math.pi)
        loop = None
        if abs(wanted) > max(_NO_ROTATION, _WORTHWHILE * tolerance.attitude):
            loop = self._search.loop(psi_e, wanted)
        positions = straight_motion(
            self.robot,
            state.q,
            self._legs(psi_e, loop),
            self.control_period,
            self.options.longest,
        )
        path = self._prediction.path(state, positions)
        left = PoseError.between(path.position[-1], path.quaternion[-1], goal)
        if self.options.check_position and left.distance > tolerance.position:
            raise PlanningError(
                f"The base will be at {np.round(path.position[-1], 4).tolist()} m, "
                f"{left.distance:.3g} m from the goal position: without thrust, attitude and shape "
                "decide where the base is; with check_position 0 the goal position is ignored."
            )
        notes: Notes = {
            "psi_e": psi_e.tolist(),
            "turn_of_step_1": step_1,
            "wanted_phase": wanted,
            **self._loop_notes(loop),
            "final_position": path.position[-1].tolist(),
            "predicted_attitude_error": left.angle,
        }
        return self._schedule_of(goal, positions, path, notes)

    def _turn(self, request: PlanRequest) -> float:
        """Return the angle in [-pi, pi] about the robot's axis from the present attitude."""
        start, wanted = request.state.quaternion, request.goal.quaternion
        axis = self._phase.axis
        x, y, z, w = quaternion_multiply(quaternion_inverse(start), wanted)
        vector = np.array([x, y, z])
        # Swing after twist: what the twist about the axis leaves is a tilt out of the plane.
        about = float(axis @ vector)
        across = float(np.linalg.norm(vector - about * axis))
        tilt = 2 * math.atan2(across, math.hypot(about, float(w)))
        if tilt > max(request.tolerance.attitude, _NO_ROTATION):
            raise PlanningError(
                f"The goal attitude is {tilt:.4g} rad off any rotation about the axis "
                f"{np.round(axis, 6).tolist()} of {self.robot.base_link}: planar robot "
                f"'{self.robot.description.name}' turns about no other."
            )
        return math.remainder(2 * math.atan2(about, float(w)), 2 * math.pi)

    def _legs(self, psi_e: Array, loop: SquareLoop | None) -> list[tuple[Array, float]]:
        """Return the ends (n,) of the straight legs, and how long each is to take, s."""
        step_1, step_2, step_3, step_4 = self._durations
        legs = [(psi_e, step_1)]
        if loop is not None:
            legs.append((loop.corners[0], step_2))
            around = [(corner, step_3 / 4) for corner in np.roll(loop.corners, -1, axis=0)]
            legs += loop.loops * around
            legs.append((psi_e, step_4))
        return legs

    def _loop_notes(self, loop: SquareLoop | None) -> Notes:
        if loop is None:
            return {"loops": 0.0}
        return {
            "joints": ", ".join(self.robot.joint_names[i] for i in loop.pair),
            "psi_star": loop.centre.tolist(),
            "z_star": loop.side,
            "loops": float(loop.loops),
            "direction": "clockwise" if loop.clockwise else "counter-clockwise",
            "corner": loop.corners[0].tolist(),
        }
