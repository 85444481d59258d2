"""Physics backends for LIBERO scenes: MuJoCo on threads, MJX on MuJoCo Warp or in pure JAX."""
