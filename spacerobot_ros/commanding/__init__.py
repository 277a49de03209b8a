"""Commanders without ROS: how a planner or a controller answers the states of a plant."""
