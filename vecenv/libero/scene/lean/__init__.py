"""Lean geometry: at most 24 collision geoms a scene, fitted to upstream's."""
