"""Scenario flights without ROS, in which commanders respond to plant states."""
