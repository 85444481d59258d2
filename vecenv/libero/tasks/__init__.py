"""LIBERO's suites: their tasks, initial states and fixture poses, installed or exported."""
