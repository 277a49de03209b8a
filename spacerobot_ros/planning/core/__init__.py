"""Types that all gait methods share: goals, states, schedules, predictions."""
