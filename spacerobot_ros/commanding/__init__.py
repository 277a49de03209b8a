"""Commanders without ROS: planners and controllers that command a plant state by state."""
