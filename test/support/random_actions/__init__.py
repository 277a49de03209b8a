"""Random actions of operators on a stack, and what the specification demands of each state."""
