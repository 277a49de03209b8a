"""A custom gait method: straight to a desired configuration, regardless of the base motion.

Run it with ``python examples/own_gait_method.py``; for flights, it is the method
``stow`` with ``spacerobot --plugin examples/own_gait_method.py``.
"""

from dataclasses import dataclass

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import parameter
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.resources import robot_file


@dataclass(frozen=True)
class StowOptions:
    """The options of ``stow``."""

    duration: float = parameter(20.0, "time of the motion", unit="s", minimum=0.1)


class StowGait(GaitMethod):
    """Moves all joints from rest to rest in a given time."""

    name = "stow"
    controls = frozenset({"shape"})
    Options = StowOptions

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Return the schedule; see :meth:`GaitMethod.plan`."""
        end = self.goal_shape(request.goal)
        if end is None:
            raise PlanningError("stow needs a goal with joint positions.")
        ticks = round(self.options.duration / self.control_period)
        s = np.linspace(0.0, 1.0, ticks + 1)[:, np.newaxis]
        way = s - np.sin(2 * np.pi * s) / (2 * np.pi)
        positions = request.state.q + way * (end - request.state.q)
        prediction = BasePrediction(self.robot, self.control_period, self.integration_step)
        path = prediction.path(request.state, positions)
        return self.schedule_of(request.goal, positions, path, {})


def main() -> None:
    """Stow a three-joint arm."""
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    here, upright = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    state = RobotState(here, upright, np.array([0.0, -0.8, 1.6]))
    goal = Goal(here, upright, joint_positions=np.array([0.0, 0.2, -2.7]))
    method = StowGait(robot, 0.05, options=StowOptions(duration=15.0))
    schedule = method.plan(PlanRequest(state, goal, Tolerance(1e-3, 1e-3)))
    print(f"{schedule.method}: {schedule.duration:g} s, {schedule.ticks} commands")
    turned = 2 * np.degrees(np.arccos(min(1.0, abs(schedule.path.quaternion[-1][3]))))
    print(f"predicted shape {np.round(schedule.positions[-1], 3).tolist()} rad")
    print(f"the base turns by {turned:.2f} deg on the way")


if __name__ == "__main__":
    main()
