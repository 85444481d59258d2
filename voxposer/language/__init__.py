"""Language-model programs: which model writes them, and how they are put together and run."""
