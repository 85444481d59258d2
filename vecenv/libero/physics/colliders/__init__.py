"""The colliders that MuJoCo 2.3 to 3.3 had, in numba, Warp and JAX."""
