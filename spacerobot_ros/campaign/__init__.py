"""Campaigns: one scenario flown many times with different masses, sensors, starts and goals."""
