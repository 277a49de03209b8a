"""The gait methods: one module each, and their registry."""
