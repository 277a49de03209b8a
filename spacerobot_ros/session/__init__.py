"""Sessions: scenarios flown without ROS, or by nodes that have a process each."""
