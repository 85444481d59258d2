"""MJX as a backend: options, model, control step, rollouts, batch."""
