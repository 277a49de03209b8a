"""Flights of scenarios without ROS, in which commanders respond to the states of the plant."""
