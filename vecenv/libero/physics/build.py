"""Which backends there are, and the physics of a batch on one of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vecenv.libero.physics.base import Physics
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.scene.scene import Scene

BACKENDS = ("native", "warp", "jax", "mjx")


def make_physics(
    scenes: Sequence[Scene],
    scene_of_slot: np.ndarray,
    *,
    backend: str,
    geometry: str = "exact",
    num_threads: int | None,
    num_devices: int = 1,
    deterministic: bool = False,
    budgets: Sequence[Budget | None],
) -> Physics:
    """The physics of a batch.

    Args:
        scenes: distinct scenes.
        scene_of_slot: index into ``scenes`` of each slot, int [B].
        backend: one of ``BACKENDS``; ``"mjx"`` is warp on CUDA and jax elsewhere.
        geometry: profile of the scenes' collision geoms; MJX solves lean ones with fewer iterations.
        num_threads: threads of the native backend; None for one a core.
        num_devices: devices that MJX spreads the slots over.
        deterministic: with warp, results that do not depend on the order of threads; the native backend's never do.
        budgets: memory of each scene on MJX; not read by the native backend.

    Raises:
        ValueError: a backend that does not exist or is not installed, or ``deterministic`` in pure JAX.
    """
    # Each backend is imported when it is used: MJX takes two seconds, and the native one brings numba.
    if backend == "native":
        from vecenv.libero.physics.native import NativePhysics

        return NativePhysics(scenes, scene_of_slot, num_threads)
    from vecenv.libero.physics.mjx.backend import MjxPhysics
    from vecenv.libero.physics.mjx.model import build, usual_iterations

    if backend not in BACKENDS:
        raise ValueError(f"backend={backend!r}: expected one of {', '.join(BACKENDS)}")
    impl = None if backend == "mjx" else backend
    builds = []
    for scene, budget in zip(scenes, budgets, strict=True):
        if budget is None:
            raise ValueError(f"backend {backend!r} needs a budget for each scene")
        iterations = usual_iterations(impl, geometry)
        builds.append(build(scene, impl=impl, budget=budget, iterations=iterations, deterministic=deterministic))
    return MjxPhysics(builds, scene_of_slot, num_devices)
