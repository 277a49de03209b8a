"""Campaigns: one scenario flown many times with different masses, sensors, start states and
goals."""
