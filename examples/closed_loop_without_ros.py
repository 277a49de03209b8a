"""Close the loop without ROS: paper 4's spacecraft and arm, plant and controller in one program.

Run it with ``python examples/closed_loop_without_ros.py``.
"""

import numpy as np

from spacerobot_ros.control import ControlState, PoseReference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig

RATE = 100.0  # Hz


def main() -> None:
    """Fly to base and end-effector goals for 12 s; print the errors over time."""
    robot = SpaceRobot.from_file(robot_file("planar_manipulator"))
    start = PlantConfig(
        actuation="effort",
        tick_rate=RATE,
        initial_center_of_mass=(0.0, 0.0, 0.0),
        initial_orientation=tuple(quaternion_from_rotvec([0.0, 0.0, np.radians(21.0)])),
        initial_joint_positions=tuple(np.radians([-58.0, 60.3])),
    )
    plant = build_plant(robot, start)
    controller = build_controller(robot, ControllerConfig(tick_rate=RATE, law="model_based"))
    base = PoseReference(
        np.array([0.5, 0.5, 0.0]), quaternion_from_rotvec([0.0, 0.0, np.radians(15.0)])
    )
    hand = PoseReference(np.array([1.5, 1.5, 0.0]), quaternion_from_rotvec([0.0, 0.0, 0.0]))

    for tick in range(round(12 * RATE) + 1):
        time, pose, twist = tick / RATE, plant.pose.copy(), plant.twist.copy()
        q, qdot = plant.q.copy(), plant.qdot.copy()
        state = ControlState(pose[:3], pose[3:], twist[:3], twist[3:], q, qdot)
        if tick == 0:
            controller.set_goals(time, state, base=base, end_effector=hand)
        command = controller.command(time, state, q, qdot).realised
        if tick % 300 == 0:
            errors = controller.errors()
            force = np.linalg.norm(command.wrench_B[:3])
            print(f"{time:5.1f} s  {errors.position:.4f} m, {errors.attitude:.4f} rad off, "
                  f"force {force:.2f} N")  # fmt: skip
        plant.step(command.tau, command.wrench_B)


if __name__ == "__main__":
    main()
