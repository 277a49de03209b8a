"""Former location of :mod:`spacerobot_ros.scenario`; deprecated after version 0.2."""

from spacerobot_ros.scenario import *  # noqa: F403
