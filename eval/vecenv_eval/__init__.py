"""Evaluation harness: which episodes, which policy, how it went."""
