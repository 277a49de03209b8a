"""The node of the page on which a robot is watched and steered."""
