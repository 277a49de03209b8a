"""Campaigns: one scenario flown many times, with masses, sensors, starts and goals that differ."""
