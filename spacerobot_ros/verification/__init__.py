"""Re-simulation: the plant of a bag stepped again under the commands in the bag."""
