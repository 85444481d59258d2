"""A rule-based writer of programs: no network, no model."""
