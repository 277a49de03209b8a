"""The node that serves the page for watching and steering a robot."""
