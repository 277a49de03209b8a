"""Motions of base and joints under thrust, around obstacles and for the least propellant."""
