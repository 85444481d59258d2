"""Datasets for imitation learning, written while policies run."""
