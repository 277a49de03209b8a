"""ROS messages as bytes and plain values, without ROS: layouts, definitions, statuses, plans."""
