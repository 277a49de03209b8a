"""Runs the plant's node: ``python -m spacerobot_ros.nodes.plant``."""

from spacerobot_ros.nodes.plant.node import main

main()
