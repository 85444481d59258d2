"""A rule-based provider of programs for litellm: needs no network and no model."""
