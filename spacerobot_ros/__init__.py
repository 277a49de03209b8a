"""A ROS 2 flight stack for free-floating space robots."""

__version__ = "0.1.0"
