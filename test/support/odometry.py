"""What a nav_msgs/Odometry says, as arrays."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from nav_msgs.msg import Odometry

Array = npt.NDArray[np.float64]


def pose_of(odom: Odometry) -> tuple[Array, Array]:
    p, o = odom.pose.pose.position, odom.pose.pose.orientation
    return np.array([p.x, p.y, p.z]), np.array([o.x, o.y, o.z, o.w])


def twist_of(odom: Odometry) -> tuple[Array, Array]:
    v, w = odom.twist.twist.linear, odom.twist.twist.angular
    return np.array([v.x, v.y, v.z]), np.array([w.x, w.y, w.z])
