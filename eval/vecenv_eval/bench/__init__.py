"""Benchmarks against upstream on the same cores in the same run: ``physics``, ``suite``, and the table both print.

``python -m vecenv_eval.bench SIDE JSON`` is one measurement in a process of its own; ``vecenv bench`` starts them.
"""
