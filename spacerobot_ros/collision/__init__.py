"""Distances between a robot's bodies: solids, pairs, exact checks, and solver functions."""

from spacerobot_ros.collision.distances import Solid, unread_mesh_notes
from spacerobot_ros.collision.geometry import (
    Approach,
    BasePoses,
    CollisionGeometry,
    LinkPair,
    ObstaclePair,
    nearest_approach,
    nearest_approaches,
)

__all__ = [
    "Approach",
    "BasePoses",
    "CollisionGeometry",
    "LinkPair",
    "ObstaclePair",
    "Solid",
    "nearest_approach",
    "nearest_approaches",
    "unread_mesh_notes",
]
