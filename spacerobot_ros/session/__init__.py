"""Sessions: flights of scenarios without ROS, or by nodes in separate processes."""
