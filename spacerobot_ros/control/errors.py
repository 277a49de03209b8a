"""What control refuses, with a sentence that a user can act on."""

from spacerobot_ros.errors import SpaceRobotError


class TargetNotSetError(SpaceRobotError):
    """A controlled output has no reference; the sentence says which."""


class NotFiniteError(SpaceRobotError):
    """A state or reference holds a number that is not finite; no command follows from it."""
