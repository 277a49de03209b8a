"""Gait methods, one module each, and their registry."""
