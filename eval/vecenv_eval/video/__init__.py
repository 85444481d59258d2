"""Videos of batches: images tiled into frames, frames written to an mp4, and the command ``vecenv video``."""
