"""MJX as a backend: model, control step, rollout."""
