"""Parts of ``examples/ppo.py``: settings, networks, the environment that is trained on, and the files of a run."""
