"""Videos of batches: images tiled into frames, frames written to an mp4, and the command ``vecenv video``."""

# Step budget of LIBERO's videos, control ticks, and most episodes of one; here so that the command's help needs no
# simulator.
MAX_STEPS, MOST_EPISODES = 400, 100
