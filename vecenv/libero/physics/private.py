"""The private modules of MJX and MuJoCo Warp that vecenv uses, imported in this file alone.

Out: the names below, for the published contacts (``contacts.py`` and the Warp colliders) and for the ray tracer
(``vecenv.libero.render``). MJX gives no promise about them: they were read in the version ``TESTED``. The names of
MuJoCo Warp exist only where ``warp`` is installed. Asking for one that is missing raises an ``ImportError`` that names
the installed and the tested version. What the functions look like is checked by their users, which know what they
replace: ``contacts.py`` checks signatures, ``vecenv.libero.render.ray_kernel`` the kernel's arguments.
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
    from mujoco.mjx.third_party.mujoco_warp._src import render as warp_render
    from mujoco.mjx.third_party.mujoco_warp._src.collision_core import Geom
    from mujoco.mjx.third_party.mujoco_warp._src.collision_primitive_core import mat83f, vec8f
    from mujoco.mjx.third_party.mujoco_warp._src.ray import ray_capsule, ray_cylinder, ray_ellipsoid, ray_sphere
    from mujoco.mjx.third_party.mujoco_warp._src.render_util import pack_rgba_to_uint32
    from mujoco.mjx.third_party.mujoco_warp._src.types import mat43
    from mujoco.mjx.third_party.mujoco_warp._src.warp_util import event_scope
    from mujoco.mjx.warp import render_context
except ImportError as error:
    _missing = error

# The version of mujoco-mjx whose private modules vecenv was written for.
TESTED = "3.17"

__all__ = [
    "TESTED",
    "Geom",
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
    "vec8f",
    "warp_collision_driver",
    "warp_collision_primitive",
    "warp_render",
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
