"""From goals to setpoints: the executive, its planning worker and trajectory tracker; no ROS."""
