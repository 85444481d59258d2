"""Simulators that step a batch of scenes: ``native`` is MuJoCo on CPU threads, ``mjx`` is MJX under jit."""
