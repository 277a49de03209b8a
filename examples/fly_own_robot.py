"""A driver instead of the plant: motion capture and encoder inputs, drive outputs, twist estimates.

Run it with ``python examples/fly_own_robot.py``: its hardware is a plant in the namespace lab.
"""

from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from spacerobot_ros.nodes import PlannerNode, PlantNode

LONGEST_GAP, SMOOTHING, LOSSY = 0.25, 0.5, qos_profile_sensor_data  # s, share of the newest


class Driver(rclpy.node.Node):
    """Publishes odom and joint_states with a common stamp, like the plant; drives get commands."""

    def __init__(self, **options: Any) -> None:
        super().__init__("driver", **options)
        self.captured, self.twist = -np.inf, np.zeros((2, 3))  # s; v_WB_W over omega_WB_B
        self.r_WB, self.R_WB = np.zeros(3), Rotation.identity()
        self.odoms = self.create_publisher(Odometry, "odom", 10)
        self.joints = self.create_publisher(JointState, "joint_states", 10)
        self.drives = self.create_publisher(JointState, "lab/joint_commands", 10)
        self.create_subscription(PoseStamped, "lab/mocap", self.on_capture, LOSSY)
        self.create_subscription(JointState, "lab/joint_states", self.on_encoders, LOSSY)
        self.create_subscription(JointState, "joint_commands", self.drives.publish, 10)

    def on_capture(self, message: PoseStamped) -> None:
        """Receive a pose, stamped with the image time, and estimate the twist."""
        p, o, stamp = message.pose.position, message.pose.orientation, message.header.stamp
        r_WB, R_WB = np.array([p.x, p.y, p.z]), Rotation.from_quat([o.x, o.y, o.z, o.w])
        step = stamp.sec + stamp.nanosec * 1e-9 - self.captured
        if step <= 0.0:
            return  # A later one has overtaken it.
        rates = np.array([r_WB - self.r_WB, (self.R_WB.inv() * R_WB).as_rotvec()]) / step
        self.twist += (SMOOTHING if step <= LONGEST_GAP else 1.0) * (rates - self.twist)
        self.r_WB, self.R_WB, self.captured = r_WB, R_WB, stamp.sec + stamp.nanosec * 1e-9

    def on_encoders(self, joints: JointState) -> None:
        """Publish a state: the pose predicted by its age, or none if it is too old."""
        age = joints.header.stamp.sec + joints.header.stamp.nanosec * 1e-9 - self.captured
        if age <= LONGEST_GAP:
            r_WB = self.r_WB + age * self.twist[0]
            R_WB = self.R_WB * Rotation.from_rotvec(age * self.twist[1])
            odom = Odometry(header=joints.header, child_frame_id="base_link")
            odom.header.frame_id, pose, twist = "world", odom.pose.pose, odom.twist.twist
            pose.position, pose.orientation = xyz(Point, r_WB), xyz(Quaternion, R_WB.as_quat())
            twist.linear = xyz(Vector3, R_WB.inv().apply(self.twist[0]))
            twist.angular = xyz(Vector3, self.twist[1])
            self.odoms.publish(odom)
        self.joints.publish(joints)


def xyz(kind: Any, values: Any) -> Any:
    """Return a message with the fields x, y, z and, for a quaternion, w."""
    return kind(**dict(zip("xyzw", values, strict=False)))


if __name__ == "__main__":
    rclpy.init(args=["--ros-args", "-p", "robot:=sliding_masses"])
    lab, driver, late = PlantNode(namespace="lab"), Driver(), list[PoseStamped]()
    driver.create_subscription(PoseStamped, "lab/base_pose", late.append, 10)
    goals = driver.create_publisher(PoseStamped, "goal_pose", 10)
    executor = rclpy.executors.SingleThreadedExecutor()
    for node in (lab, PlannerNode(), driver):
        executor.add_node(node)
    for tick in (10, 120):
        while lab.tick < tick:
            executor.spin_once()
            if len(late) > 2:  # The cameras are two ticks late.
                driver.on_capture(late.pop(0))
        goals.publish(PoseStamped(pose=Pose(position=Point(x=0.05, y=-0.03))))
        print(f"{lab.simulated_time_s:g} s\nbase at {lab.plant.pose[:3].round(4)} m")
