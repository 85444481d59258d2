"""Runs untrusted programs within limits of time, memory and access."""
