"""SIMPLER's scenes on SAPIEN, in worker processes."""
