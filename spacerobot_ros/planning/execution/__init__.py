"""Flying schedules: tracking, corrections, and the parts of them that need no ROS."""
