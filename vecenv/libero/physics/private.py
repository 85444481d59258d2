"""The private modules of MJX, MuJoCo Warp and Warp that vecenv uses, imported in this file alone.

Out: the names below, for the published contacts (``contacts.py`` and the Warp colliders), for the order of contacts and
sums (``deterministic.py``), for the compilation of kernels (``kernels.py``) and for the ray tracer
(``vecenv.libero.render``). Their packages give no promise about them: they were read in the versions ``TESTED`` of
mujoco-mjx and 1.18 of Warp. The names of MuJoCo Warp exist only where ``warp`` is installed. Asking for one that is
missing raises an ``ImportError`` that names the installed and the tested version. What the functions look like is
checked by their users, which know what they replace: ``contacts.py`` and ``deterministic.py`` check signatures,
``vecenv.libero.render.ray_kernel`` the kernel's arguments; ``kernels.py`` does without where it fails.
"""

from __future__ import annotations

import importlib.metadata
from typing import NoReturn

from mujoco.mjx._src import collision_driver as jax_collision_driver
from mujoco.mjx._src import scan as jax_scan

_missing: ImportError | None = None
try:
    from mujoco.mjx.third_party.mujoco_warp._src import collision_driver as warp_collision_driver
    from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive as warp_collision_primitive
    from mujoco.mjx.third_party.mujoco_warp._src import constraint as warp_constraint
    from mujoco.mjx.third_party.mujoco_warp._src import render as warp_render
    from mujoco.mjx.third_party.mujoco_warp._src import smooth as warp_smooth
    from mujoco.mjx.third_party.mujoco_warp._src import solver as warp_solver
    from mujoco.mjx.third_party.mujoco_warp._src.collision_core import Geom
    from mujoco.mjx.third_party.mujoco_warp._src.collision_primitive_core import mat83f, vec8f
    from mujoco.mjx.third_party.mujoco_warp._src.ray import ray_capsule, ray_cylinder, ray_ellipsoid, ray_sphere
    from mujoco.mjx.third_party.mujoco_warp._src.render_util import _build_rays as build_rays
    from mujoco.mjx.third_party.mujoco_warp._src.render_util import pack_rgba_to_uint32
    from mujoco.mjx.third_party.mujoco_warp._src.types import ConstraintState, ContactType, mat43, vec5, vec10
    from mujoco.mjx.third_party.mujoco_warp._src.warp_util import event_scope
    from mujoco.mjx.warp import render_context
    from warp._src.jax.ffi import FfiCallable
except ImportError as error:
    _missing = error

# The version of mujoco-mjx whose private modules vecenv was written for.
TESTED = "3.17"

__all__ = [
    "TESTED",
    "ConstraintState",
    "ContactType",
    "FfiCallable",
    "Geom",
    "build_rays",
    "event_scope",
    "installed_version",
    "jax_collision_driver",
    "jax_scan",
    "mat43",
    "mat83f",
    "pack_rgba_to_uint32",
    "ray_capsule",
    "ray_cylinder",
    "ray_ellipsoid",
    "ray_sphere",
    "render_context",
    "vec5",
    "vec8f",
    "vec10",
    "warp_collision_driver",
    "warp_collision_primitive",
    "warp_constraint",
    "warp_render",
    "warp_smooth",
    "warp_solver",
]


def installed_version() -> str:
    """The version of mujoco-mjx that is installed."""
    return importlib.metadata.version("mujoco-mjx")


def __getattr__(name: str) -> NoReturn:
    """Called for a name that could not be imported."""
    if name in __all__:
        raise ImportError(
            f"mujoco-mjx {installed_version()} has no {name} ({_missing}); vecenv was tested with mujoco-mjx {TESTED}, "
            "and MuJoCo Warp needs pip install 'vecenv[warp]'"
        ) from _missing
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
