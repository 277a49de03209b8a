"""A custom robot: its URDF, its capabilities, and a base rotation by its arm alone.

Run it with ``python examples/own_urdf.py``.
"""

import numpy as np

from spacerobot_ros import plan
from spacerobot_ros.model import SpaceRobot

LINK = """
  <link name="link_{k}">
    <inertial><origin xyz="0.25 0 0"/><mass value="3"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.07" iyz="0" izz="0.07"/></inertial>
  </link>
  <joint name="joint_{k}" type="revolute">
    <parent link="{parent}"/><child link="link_{k}"/>
    <origin xyz="{x} 0 0"/><axis xyz="{axis}"/>
    <limit lower="-2.5" upper="2.5" velocity="0.5" effort="10"/>
  </joint>"""

URDF = f"""<robot name="inspector">
  <link name="base_link">
    <inertial><mass value="40"/>
      <inertia ixx="2.5" ixy="0" ixz="0" iyy="2.5" iyz="0" izz="2.5"/></inertial>
  </link>
  {LINK.format(k=1, parent="base_link", x=0.3, axis="0 0 1")}
  {LINK.format(k=2, parent="link_1", x=0.5, axis="0 1 0")}
  {LINK.format(k=3, parent="link_2", x=0.5, axis="0 1 0")}
</robot>"""


def main() -> None:
    """Load the robot, print model quantities, and plan a 10 deg rotation about z."""
    robot = SpaceRobot.from_urdf(URDF)
    q = np.array([0.0, -0.8, 1.6])
    print(f"{robot.description.name}: {robot.n} joints, {robot.total_mass:g} kg")
    print(f"centre of mass in the base frame: {np.round(robot.center_of_mass(q), 4).tolist()} m")
    # With no momentum, base twist = -A(q) qdot: the effect of a joint rate on the base.
    print(f"the base turns at {np.round(-robot.connection(q)[3:, 0], 3).tolist()} rad/s a rad/s")

    schedule = plan(robot, start=q, rotvec=(0.0, 0.0, np.radians(10.0)), answers=1)
    print(f"10 deg about z by the arm alone: {schedule.duration:.2f} s")
    for tick in range(0, len(schedule.positions), 10):
        shape = np.round(schedule.positions[tick], 2).tolist()
        print(f"  {tick * schedule.control_period:6.2f} s  joints at {shape} rad")


if __name__ == "__main__":
    main()
