"""The command `spacerobot`: one module a command, loaded when the command is used.

Command modules import nothing heavy at their top: `spacerobot --help` loads all of them.
"""
