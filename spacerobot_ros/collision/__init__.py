"""Distances between the bodies of a robot: solids, pairs, exact checks, functions for a solver."""

from spacerobot_ros.collision.distances import Solid
from spacerobot_ros.collision.geometry import BasePoses, CollisionGeometry, LinkPair, ObstaclePair
from spacerobot_ros.collision.nearest import Approach, NearestPair, PathCheck

__all__ = [
    "Approach",
    "BasePoses",
    "CollisionGeometry",
    "LinkPair",
    "NearestPair",
    "ObstaclePair",
    "PathCheck",
    "Solid",
]
