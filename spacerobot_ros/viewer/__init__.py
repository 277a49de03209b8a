"""The page on which a robot is watched and steered; it knows no ROS.

The page shows a :class:`~spacerobot_ros.viewer.port.StackState` and hands out what its users want
as :data:`~spacerobot_ros.viewer.port.Action`; the viewer node gives it the one and carries out the
other.
"""
