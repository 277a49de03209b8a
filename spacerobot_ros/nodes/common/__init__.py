"""Code shared by all nodes: life cycle, parameters, serialised messages."""
