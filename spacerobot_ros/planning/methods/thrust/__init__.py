"""Motions of the base and the joints under thrust, around obstacles and with least propellant."""
