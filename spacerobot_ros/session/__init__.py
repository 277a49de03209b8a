"""Sessions: scenarios flown without ROS, or by nodes in separate processes."""
