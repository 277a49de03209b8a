"""Commanders without ROS: a planner or a controller that commands a plant state by state."""
