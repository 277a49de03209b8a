"""The ROS-independent live page that shows and steers a robot.

The page shows a :class:`~spacerobot_ros.viewer.state.StackState` and returns user actions as
:data:`~spacerobot_ros.viewer.state.Action`; the viewer node provides the state and
performs the actions.
"""
