"""Time-optimal manoeuvres by direct optimal control."""

from spacerobot_ros.planning.methods.optimal.method import OptimalGait

__all__ = ["OptimalGait"]
