"""Videos: images tiled into frames, frames written to an mp4, and one mp4 for each episode of an evaluation."""
