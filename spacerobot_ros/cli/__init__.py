"""The command `spacerobot`: one module a command."""
