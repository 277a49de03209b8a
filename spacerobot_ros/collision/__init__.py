"""Distances between the bodies of a robot: solids, pairs, exact checks, functions for a solver."""

from spacerobot_ros.collision.distances import Solid
from spacerobot_ros.collision.geometry import BasePoses, CollisionGeometry, LinkPair, ObstaclePair
from spacerobot_ros.collision.nearest import (
    Approach,
    NearestPair,
    nearest_approach,
    nearest_approaches,
)

__all__ = [
    "Approach",
    "BasePoses",
    "CollisionGeometry",
    "LinkPair",
    "NearestPair",
    "ObstaclePair",
    "Solid",
    "nearest_approach",
    "nearest_approaches",
]
