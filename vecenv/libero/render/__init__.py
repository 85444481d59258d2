"""Camera images of LIBERO scenes: OpenGL, ray tracing on the GPU, and what both draw."""
