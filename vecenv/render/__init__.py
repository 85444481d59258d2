"""Camera images of a batch: GL on CPU threads, cameras and visual options as data, level of detail, video."""
