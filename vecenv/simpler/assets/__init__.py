"""SIMPLER's asset files: what is needed, where it lies, how it is downloaded."""
