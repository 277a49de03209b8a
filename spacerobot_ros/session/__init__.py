"""Sessions: scenarios flown by a stack of ROS nodes, in one process or in several."""
