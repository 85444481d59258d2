"""SIMPLER's asset files: which are needed, where they are, and their download."""
