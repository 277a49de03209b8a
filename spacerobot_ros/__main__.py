"""``python -m spacerobot_ros``: the command ``spacerobot``."""

from spacerobot_ros.cli import start

start()
