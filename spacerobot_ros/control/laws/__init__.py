"""The control laws: one module each, and their registry."""
