"""Sessions: a scenario flown by a stack of nodes, in one process or in many."""
