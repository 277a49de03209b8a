"""Types shared by all gait methods: goals, states, schedules, predictions."""
