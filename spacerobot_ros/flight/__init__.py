"""Flights: scenarios, and how a commander answers the states of its plant, without ROS."""
