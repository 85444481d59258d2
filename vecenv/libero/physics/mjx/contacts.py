"""Published contacts inside MJX: our colliders among those of MJX and MuJoCo Warp, used for models with the mark.

MJX finds the collider of two geoms in a table, as MuJoCo does. The tables and functions of MJX's private modules
(``private``) stay as they are. Marked models run copies of the functions, which read a table with our colliders
(``boxbox_warp``, ``planemesh_warp``, ``boxbox_jax``, ``planemesh_jax``); unmarked models run the originals. The mark is
defined in ``vecenv.libero.scene.contacts``. A model of MuJoCo Warp has no custom numbers, so its mark is a bit of the
disable flags that MuJoCo does not use.

The functions' arguments and the names they refer to are checked first: an MJX whose functions differ is refused with
``MjxContactsError``.
"""

from __future__ import annotations

import copy
import functools
import threading
from collections.abc import Callable
from typing import Any

import mujoco
from mujoco import mjx

from vecenv.errors import SimulationError
from vecenv.libero.physics import private
from vecenv.libero.physics.colliders import boxbox_jax, planemesh_jax
from vecenv.libero.physics.mjx.patching import copy_with, dispatch, expect
from vecenv.libero.physics.private import jax_collision_driver
from vecenv.libero.scene.contacts import MARK, MESH_MARGIN

# The bit of a Warp model's disable flags that selects published contacts.
PUBLISHED = 1 << 30
# MuJoCo Warp sends boxes to its table of primitive colliders only where this flag is set; it means nothing else there.
_BOXES_ARE_PRIMITIVE = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
_LOCK = threading.Lock()


class MjxContactsError(SimulationError):
    """The installed MJX does not support published contacts; the message says what was found and what to do."""


def put_model(model: mujoco.MjModel, *, impl: str) -> mjx.Model:
    """``mjx.put_model`` with the contacts that the model's custom number selects, see
    ``vecenv.libero.scene.contacts``.

    Args:
        model: the model.
        impl: ``"jax"`` or ``"warp"``.

    Raises:
        MjxContactsError: the model needs published contacts, and the installed MJX is not a supported one.
    """
    if not _is_marked(model):
        return mjx.put_model(model, impl=impl)
    model = _without_mesh_margins(model)
    if impl != "warp":
        install_jax()
        return mjx.put_model(model, impl=impl)
    install_warp()
    put = mjx.put_model(model, impl=impl)
    return put.replace(opt=put.opt.replace(disableflags=put.opt.disableflags | _BOXES_ARE_PRIMITIVE | PUBLISHED))


def _without_mesh_margins(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy without the mesh margins, which only native MuJoCo needs; pure JAX does not support them."""
    model = copy.copy(model)
    model.geom_margin[model.geom_margin == MESH_MARGIN] = 0.0
    return model


def _is_marked(model: mujoco.MjModel | mjx.Model) -> bool:
    """Whether the first custom number of a model, MuJoCo's or MJX's, is the mark."""
    return len(model.numeric_data) > 0 and float(model.numeric_data[0]) == MARK


def _unsupported(found: str) -> MjxContactsError:
    return MjxContactsError(
        f"mujoco-mjx {private.installed_version()} does not support contacts='published': {found}; use "
        f"contacts='current', or the mujoco-mjx that this version of vecenv was tested with ({private.TESTED})"
    )


_expect = functools.partial(expect, unsupported=_unsupported)


# ---------------------------------------------------------------------------------------------------------------------
# MuJoCo Warp.


@functools.cache
def install_warp() -> None:
    """Make MuJoCo Warp's narrow phase use published contacts for marked models; done once a process.

    Raises:
        MjxContactsError: see ``_expect``.
    """
    driver = _warp_driver()
    with _LOCK:
        published, current = _warp_narrowphase(), driver.primitive_narrowphase
        driver.primitive_narrowphase = dispatch(published, current, _has_bit)


def _warp_driver() -> Any:
    """MuJoCo Warp's collision driver.

    Raises:
        MjxContactsError: a private module or name of MuJoCo Warp is missing.
    """
    try:
        return private.warp_collision_driver
    except ImportError as error:
        raise _unsupported(str(error)) from error


def _has_bit(model: mjx.Model) -> bool:
    """Whether a model of MuJoCo Warp, or an MJX model for it, has the mark of published contacts."""
    return bool(int(model.opt.disableflags) & PUBLISHED)


def _warp_narrowphase() -> Callable[..., Any]:
    """MuJoCo Warp's narrow phase of primitive geoms, with our colliders."""
    driver = _warp_driver()
    _expect(getattr(driver, "_narrowphase", None), "m d ctx", "primitive_narrowphase", "NATIVECCD", "PRIMITIVE")
    current = getattr(driver, "primitive_narrowphase", None)
    plain = _expect(current, "m d ctx collision_table", "_PRIMITIVE_COLLISIONS", "_primitive_narrowphase")
    return private.event_scope(copy_with(plain, "published_narrowphase", _PRIMITIVE_COLLISIONS=_warp_colliders()))


def _warp_colliders() -> dict[Any, Any]:
    """MuJoCo Warp's table of primitive colliders, with ours."""
    import warp as wp

    try:
        from vecenv.libero.physics.colliders import boxbox_warp, planemesh_warp
    except (ImportError, AttributeError) as error:
        raise _unsupported(f"a type or function of MuJoCo Warp is missing ({error})") from error

    primitive = private.warp_collision_primitive
    table, kind = dict(getattr(primitive, "_PRIMITIVE_COLLISIONS", {})), primitive.GeomType
    boxes = "box1_pos box1_rot box1_size box2_pos box2_rot box2_size margin"
    ours = {
        (kind.BOX, kind.BOX): ("box_box", boxes, boxbox_warp.box_box),
        (kind.PLANE, kind.MESH): ("plane_convex", "plane_normal plane_pos convex margin", planemesh_warp.plane_convex),
    }
    for kinds, (name, arguments, replacement) in ours.items():
        _expect(getattr(primitive, name, None), arguments)
        wrapper = _expect(table.get(kinds), "naconmax_in", name)
        table[kinds] = wp.func(copy_with(wrapper, f"published_{name}", **{name: replacement}))
    return table


# ---------------------------------------------------------------------------------------------------------------------
# Pure JAX.


@functools.cache
def install_jax() -> None:
    """Make MJX's collision driver use published contacts for marked models; done once a process.

    Raises:
        MjxContactsError: see ``_expect``.
    """
    with _LOCK:
        for name, published in _jax_functions().items():
            setattr(jax_collision_driver, name, dispatch(published, getattr(jax_collision_driver, name), _is_marked))
        mjx.collision = jax_collision_driver.collision


def _jax_functions() -> dict[str, Callable[..., Any]]:
    """MJX's functions that read its table of colliders, as copies that read a table with ours."""
    table, kind = dict(getattr(jax_collision_driver, "_COLLISION_FUNC", {})), mjx.GeomType
    boxes, meshes = (kind.BOX, kind.BOX), (kind.PLANE, kind.MESH)
    for kinds in (boxes, meshes):
        _expect(table.get(kinds), "m d key geom")
        if not hasattr(table[kinds], "ncon"):
            raise _unsupported("its collision functions do not say how many contacts they return")
    table |= {boxes: boxbox_jax.collider, meshes: planemesh_jax.collider(table[meshes])}
    found = {}
    for name, arguments in (("collision", "m d"), ("make_condim", "m impl")):
        plain = _expect(getattr(jax_collision_driver, name, None), arguments, "_COLLISION_FUNC")
        found[name] = copy_with(plain, f"published_{name}", _COLLISION_FUNC=table)
    return found
