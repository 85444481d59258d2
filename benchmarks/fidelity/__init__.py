"""Parts of the command ``benchmarks/mjx_fidelity.py``: recordings, scenes, comparisons, workers and tables."""
