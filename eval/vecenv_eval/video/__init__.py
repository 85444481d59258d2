"""Videos of batches: images tiled into frames, frames written to an mp4, and the command ``vecenv video``."""

# Default options of LIBERO's videos; here so that the command's help needs no simulator.
SIZE, LOD, MAX_STEPS = 256, "exact", 400
