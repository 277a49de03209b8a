"""Verification: the plant of a bag re-simulated under the commands in the bag."""
