"""Control laws, one module each, and their registry."""
