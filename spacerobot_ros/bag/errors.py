"""What can go wrong with a bag."""

from spacerobot_ros.errors import SpaceRobotError


class RecordingError(SpaceRobotError):
    """A bag that cannot be written or read; the sentence says which, where and what to do."""
