"""Sessions: scenarios flown without ROS, or by nodes in one process each."""
