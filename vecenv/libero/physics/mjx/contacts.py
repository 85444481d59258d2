"""Published contacts inside MJX: our colliders among those of MJX and MuJoCo Warp, for models that ask for them.

MJX finds the collider of two geoms in a table, as MuJoCo does. This is the one place of vecenv that reaches into MJX's
private modules. It leaves the tables and functions it finds there as they are: for marked models it runs copies of the
functions that read a table of ours (``boxbox_warp``, ``planemesh_warp``, ``boxbox_jax``, ``planemesh_jax``), and
unmarked ones go where they always went. What is a mark is decided by ``vecenv.libero.scene.contacts``; a model of
MuJoCo Warp has no custom numbers, there it is a bit of the disable flags that MuJoCo does not use.

A MuJoCo that arranges these functions in another way is refused with ``MjxContactsError``, which says so.
"""

from __future__ import annotations

import copy
import functools
import importlib.metadata
import inspect
import threading
import types
from collections.abc import Callable
from typing import Any

import mujoco
from mujoco import mjx
from mujoco.mjx._src import collision_driver as jax_driver

from vecenv.errors import SimulationError
from vecenv.libero.physics.colliders import boxbox_jax, planemesh_jax
from vecenv.libero.scene.contacts import MARK, MESH_MARGIN

# The bit of a Warp model's disable flags that asks for published contacts.
PUBLISHED = 1 << 30
# MuJoCo Warp sends boxes to its table of primitive colliders only where this flag is set; it means nothing else there.
_BOXES_ARE_PRIMITIVE = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
_LOCK = threading.Lock()


class MjxContactsError(SimulationError):
    """Published contacts cannot be had from this MJX; the message says what was found and what to do."""


def put_model(model: mujoco.MjModel, *, impl: str) -> mjx.Model:
    """``mjx.put_model`` with the contacts that the model's custom number asks for, see
    ``vecenv.libero.scene.contacts``.

    Args:
        model: the model.
        impl: ``"jax"`` or ``"warp"``.

    Raises:
        MjxContactsError: it asks for published contacts, and this MJX is not the one that is understood.
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
    """A copy without what picks a path of native EPA: pure JAX has no margins of meshes, and neither needs them."""
    model = copy.copy(model)
    model.geom_margin[model.geom_margin == MESH_MARGIN] = 0.0
    return model


def _is_marked(model: Any) -> bool:
    """Whether the first custom number of a model, MuJoCo's or MJX's, is the mark."""
    return len(model.numeric_data) > 0 and float(model.numeric_data[0]) == MARK


def _unknown(found: str) -> MjxContactsError:
    version = importlib.metadata.version("mujoco-mjx")
    return MjxContactsError(
        f"contacts='published' cannot be had from mujoco-mjx {version}: {found}; use contacts='current', or a "
        "mujoco-mjx that this version of vecenv was tested with (3.17)"
    )


def _expect(function: Any, arguments: str, *names: str) -> types.FunctionType:
    """The function behind decorators, if it takes these arguments and refers to these global names.

    Raises:
        MjxContactsError: it does not.
    """
    plain = inspect.unwrap(getattr(function, "func", function))
    name = f"{getattr(plain, '__module__', '?')}.{getattr(plain, '__qualname__', plain)}"
    if not isinstance(plain, types.FunctionType):
        raise _unknown(f"{name} is no function")
    found = list(inspect.signature(plain).parameters)
    if found[: len(arguments.split())] != arguments.split():
        raise _unknown(f"{name} takes {', '.join(found)}")
    if missing := set(names) - set(plain.__code__.co_names):
        raise _unknown(f"{name} does not refer to {', '.join(sorted(missing))}")
    return plain


def _reading(function: types.FunctionType, name: str, **replaced: Any) -> types.FunctionType:
    """A copy of a function that finds other things under some of its global names."""
    copy = types.FunctionType(function.__code__, {**function.__globals__, **replaced}, name, function.__defaults__)
    copy.__annotations__, copy.__doc__ = dict(function.__annotations__), function.__doc__
    copy.__module__, copy.__qualname__ = __name__, name
    return copy


def _either(published: Callable[..., Any], current: Callable[..., Any], wanted: Callable[[Any], bool]) -> Any:
    """A function that looks at its first argument, a model, and calls one or the other."""

    @functools.wraps(current)
    def chosen(model: Any, *args: Any, **kwargs: Any) -> Any:
        return (published if wanted(model) else current)(model, *args, **kwargs)

    return chosen


# ---------------------------------------------------------------------------------------------------------------------
# MuJoCo Warp.


@functools.cache
def install_warp() -> None:
    """Let MuJoCo Warp's narrow phase look at the model first, once a process.

    Raises:
        MjxContactsError: see ``_expect``.
    """
    from mujoco.mjx.third_party.mujoco_warp._src import collision_driver as driver

    with _LOCK:
        published, current = _warp_narrowphase(), driver.primitive_narrowphase
        driver.primitive_narrowphase = _either(published, current, _has_bit)


def _has_bit(model: Any) -> bool:
    """Whether a model of MuJoCo Warp, or an MJX model for it, is to have published contacts."""
    return bool(int(model.opt.disableflags) & PUBLISHED)


def _warp_narrowphase() -> Callable[..., Any]:
    """MuJoCo Warp's narrow phase of primitive geoms with our colliders in it."""
    from mujoco.mjx.third_party.mujoco_warp._src import collision_driver as driver
    from mujoco.mjx.third_party.mujoco_warp._src.warp_util import event_scope

    _expect(getattr(driver, "_narrowphase", None), "m d ctx", "primitive_narrowphase", "NATIVECCD", "PRIMITIVE")
    current = getattr(driver, "primitive_narrowphase", None)
    plain = _expect(current, "m d ctx collision_table", "_PRIMITIVE_COLLISIONS", "_primitive_narrowphase")
    return event_scope(_reading(plain, "published_narrowphase", _PRIMITIVE_COLLISIONS=_warp_colliders()))


def _warp_colliders() -> dict[Any, Any]:
    """MuJoCo Warp's table of primitive colliders with ours in it."""
    import warp as wp
    from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive as primitive

    try:
        from vecenv.libero.physics.colliders import boxbox_warp, planemesh_warp
    except (ImportError, AttributeError) as error:
        raise _unknown(f"a type or function of MuJoCo Warp is missing ({error})") from error

    table, kind = dict(getattr(primitive, "_PRIMITIVE_COLLISIONS", {})), primitive.GeomType
    boxes = "box1_pos box1_rot box1_size box2_pos box2_rot box2_size margin"
    ours = {
        (kind.BOX, kind.BOX): ("box_box", boxes, boxbox_warp.box_box),
        (kind.PLANE, kind.MESH): ("plane_convex", "plane_normal plane_pos convex margin", planemesh_warp.plane_convex),
    }
    for kinds, (name, arguments, replacement) in ours.items():
        _expect(getattr(primitive, name, None), arguments)
        wrapper = _expect(table.get(kinds), "naconmax_in", name)
        table[kinds] = wp.func(_reading(wrapper, f"published_{name}", **{name: replacement}))
    return table


# ---------------------------------------------------------------------------------------------------------------------
# Pure JAX.


@functools.cache
def install_jax() -> None:
    """Let MJX's collision driver look at the model first, once a process.

    Raises:
        MjxContactsError: see ``_expect``.
    """
    with _LOCK:
        for name, published in _jax_functions().items():
            setattr(jax_driver, name, _either(published, getattr(jax_driver, name), _is_marked))
        mjx.collision = jax_driver.collision


def _jax_functions() -> dict[str, Callable[..., Any]]:
    """MJX's functions that read its table of colliders, reading one with ours in it."""
    table, kind = dict(getattr(jax_driver, "_COLLISION_FUNC", {})), mjx.GeomType
    boxes, meshes = (kind.BOX, kind.BOX), (kind.PLANE, kind.MESH)
    for kinds in (boxes, meshes):
        _expect(table.get(kinds), "m d key geom")
        if not hasattr(table[kinds], "ncon"):
            raise _unknown("its collision functions have no number of contacts")
    table |= {boxes: boxbox_jax.collider, meshes: planemesh_jax.collider(table[meshes])}
    found = {}
    for name, arguments in (("collision", "m d"), ("make_condim", "m impl")):
        plain = _expect(getattr(jax_driver, name, None), arguments, "_COLLISION_FUNC")
        found[name] = _reading(plain, f"published_{name}", _COLLISION_FUNC=table)
    return found
