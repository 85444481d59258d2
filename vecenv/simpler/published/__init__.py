"""The episode lists that SIMPLER's published numbers were taken on."""
