"""``python -m spacerobot_ros``: the command ``spacerobot``."""

from spacerobot_ros.cli.main import main

main(prog_name="spacerobot")
