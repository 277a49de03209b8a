"""From goals to setpoints, without ROS: the executive, its planning worker and its tracker."""
