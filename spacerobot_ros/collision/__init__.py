"""Distances between the bodies of a robot: shapes, pairs, exact checks, rows for a solver."""

from spacerobot_ros.collision.geometry import CollisionGeometry, LinkPair, Solid
from spacerobot_ros.collision.nearest import NearestPair
from spacerobot_ros.collision.path_check import Approach, PathCheck

__all__ = ["Approach", "CollisionGeometry", "LinkPair", "NearestPair", "PathCheck", "Solid"]
