"""What any package may use: rotations, numba compilation, cache folders, cores and devices. Imports nothing of ours."""
