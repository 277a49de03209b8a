"""What every gait method shares: goals, states, schedules, predictions."""
