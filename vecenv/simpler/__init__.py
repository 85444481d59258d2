"""SIMPLER: its 25 tasks on SAPIEN, behind the verbs of ``vecenv.contract``."""
