"""What all nodes share: life cycle, parameters, serialised messages."""
