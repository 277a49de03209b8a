"""Runs the viewer's node: ``python -m spacerobot_ros.nodes.viewer``."""

from spacerobot_ros.nodes.viewer.node import main

main()
