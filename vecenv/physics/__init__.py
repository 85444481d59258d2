"""Simulators that step a batch of scenes: ``native`` is MuJoCo in C threads."""
