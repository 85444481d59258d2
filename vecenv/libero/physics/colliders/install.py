"""Published contacts inside MuJoCo: our colliders in its collision table, used for models with the mark.

MuJoCo calls the collider of two geoms through a table of function pointers, ``mjCOLLISIONFUNC``. The table belongs to
the whole process, so its entries for two boxes and for a mesh on a plane become functions that look at the model first:
a model with the mark of ``vecenv.libero.scene.contacts`` gets the contacts of ``boxbox.py`` and ``planemesh.py``, any
other gets MuJoCo's own collider, unchanged. The functions are compiled, take no lock and allocate nothing.

The offsets of the fields they read in ``mjModel`` and ``mjData`` are measured on a small model, and the result is
tested before it is kept: a MuJoCo that calls its colliders in another way is refused with ``ColliderError``.
"""

from __future__ import annotations

import ctypes
import functools
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import llvmlite.binding as llvm
import mujoco
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.types import Type
from numba.core.typing.context import Context as TypingContext
from numba.core.typing.templates import Signature

from vecenv.errors import SimulationError
from vecenv.libero.physics.colliders import boxbox, boxbox_numba, planemesh
from vecenv.libero.scene.contacts import MARK, mark
from vecenv.util.compiled import (
    Intrinsic,
    address_at,
    compile_for_c,
    floats_at,
    int32_at,
    intrinsic_with_literals,
    part,
)

_PLANE, _BOX, _MESH = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("PLANE", "BOX", "MESH"))
_GEOM_TYPES = int(mujoco.mjtGeom.mjGEOM_SDF) + 1
# Bytes of mjModel and mjData that are searched for a field; statistics of solvers fill most of mjData.
_REACH = 1_000_000
# Numeric values of the probe: a number that none of its other sizes has.
_PROBE_NUMERICS = 431
_Unsigned: TypeAlias = ctypes.c_uint32 | ctypes.c_uint64
_SYMBOL = "vecenv_collider_layout"
_LOCK = threading.Lock()


class ColliderError(SimulationError):
    """The collision table of the installed MuJoCo cannot be used; the message says what was found and what to do."""


# What the compiled functions read: addresses of colliders, bytes from the start of mjData or mjModel to a field.
_LAYOUT = np.zeros(17, np.int64)
_BOXES, _MESHES, _OUR_BOXES, _OUR_MESHES, _WANTED, _NUM_NUMERIC, *_FIELDS = range(17)
_GEOM_XPOS, _GEOM_XMAT, _NUMERIC_DATA, _GEOM_SIZE, _GEOM_RBOUND, _GEOM_DATAID, *_MESH_FIELDS = _FIELDS
_VERTADR, _VERT, _GRAPHADR, _GRAPH = _MESH_FIELDS[:4]
# Fields in the order of the entries above, and the types they are read with.
_DATA_FIELDS = {"geom_xpos": np.float64, "geom_xmat": np.float64}
_MODEL_FIELDS = {
    "numeric_data": np.float64,
    "geom_size": np.float64,
    "geom_rbound": np.float64,
    "geom_dataid": np.int32,
    "mesh_vertadr": np.int32,
    "mesh_vert": np.float32,
    "mesh_graphadr": np.int32,
    "mesh_graph": np.int32,
}


@functools.cache
def install() -> None:
    """Put the colliders into MuJoCo's table, once a process.

    Raises:
        ColliderError: the layout is unknown, or a collider returns wrong contacts.
    """
    with _LOCK:
        table = _table()
        boxes, meshes = table[_BOX][_BOX], table[_PLANE][_MESH]
        if not boxes or not meshes:
            raise _unsupported("its collision table has no collider for two boxes, or none for a mesh on a plane")
        ours = boxbox_numba.compiled().address, planemesh.compiled().address
        entries = [boxes, meshes, *ours, int(np.float64(MARK).view(np.int64)), *_offsets()]
        _LAYOUT[: len(entries)] = entries
        llvm.add_symbol(_SYMBOL, _LAYOUT.ctypes.data)
        table[_BOX][_BOX], table[_PLANE][_MESH] = (compiled.address for compiled in _compiled())
        try:
            _verify()
        except BaseException:
            table[_BOX][_BOX], table[_PLANE][_MESH] = boxes, meshes
            raise


def _unsupported(found: str) -> ColliderError:
    return ColliderError(
        f"MuJoCo {mujoco.__version__} does not support contacts='published': {found}; use contacts='current', "
        "or a MuJoCo that this version of vecenv was tested with (3.17)"
    )


def _table() -> ctypes.Array[ctypes.Array[ctypes.c_void_p]]:
    """MuJoCo's table of collision functions, [type, type]."""
    folder = Path(mujoco.__file__).parent
    names = [*folder.glob("libmujoco*.so*"), *folder.glob("libmujoco*.dylib"), *folder.glob("mujoco.dll")]
    if not names:
        raise _unsupported(f"no MuJoCo library in {folder}")
    try:
        return ((ctypes.c_void_p * _GEOM_TYPES) * _GEOM_TYPES).in_dll(ctypes.CDLL(str(names[0])), "mjCOLLISIONFUNC")
    except ValueError as error:
        raise _unsupported("its library does not export mjCOLLISIONFUNC") from error


# ---------------------------------------------------------------------------------------------------------------------
# Offsets of fields.

_PROBE = """
<mujoco>
  <custom><numeric name="probe" size="{numerics}"/></custom>
  <asset><mesh name="wedge" vertex="-.2 -.1 0  .2 -.1 0  .2 .1 0  -.2 .1 0  0 0 .1"/></asset>
  <worldbody>
    <geom type="box" size=".1 .2 .3"/>
    <geom type="plane" size="9 9 1" pos="0 0 -5"/>
    <body pos=".02 .03 .34" quat="1 .03 .02 .01"><freejoint/><geom type="box" size=".05 .06 .07"/></body>
    <body pos="3 0 -5" quat="1 .001 0 0"><freejoint/><geom type="mesh" mesh="wedge"/></body>
  </worldbody>
</mujoco>
"""


def _probe(numerics: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A box that leans into another, and a mesh that lies nearly flat on a plane."""
    model = mujoco.MjModel.from_xml_string(_PROBE.format(numerics=numerics))
    return model, mujoco.MjData(model)


def _offsets() -> list[int]:
    """Bytes from the start of mjData or mjModel to the fields, in the order of ``_LAYOUT``."""
    model, data = _probe(_PROBE_NUMERICS)
    found = [_find(model._address, _PROBE_NUMERICS, "nnumericdata", ctypes.c_uint32)]
    for owner, fields in ((data, _DATA_FIELDS), (model, _MODEL_FIELDS)):
        for name, kind in fields.items():
            array = getattr(owner, name)
            if array.dtype != kind:
                raise _unsupported(f"the field {name} is of type {array.dtype}")
            found.append(_find(owner._address, array.ctypes.data, name, ctypes.c_uint64))
    return found


def _find(start: int, value: int, name: str, kind: type[_Unsigned]) -> int:
    """Bytes from ``start`` to the field that holds a value; nothing after it is read."""
    width = ctypes.sizeof(kind)
    for offset in range(0, _REACH, width):
        if kind.from_address(start + offset).value == value:
            break
    else:
        raise _unsupported(f"the field {name} was not found")
    # Arrays without entries share the address of what follows them: the last of them is the one.
    while kind.from_address(start + offset + width).value == value:
        offset += width
    return offset


def _verify() -> None:
    """Compare MuJoCo's contacts of a marked and an unmarked model with the expected ones."""
    model, data = _probe(1)
    mujoco.mj_forward(model, data)
    boxes, meshes = _rows(model, data, _BOX), _rows(model, data, _MESH)
    mark(model, "published")
    mujoco.mj_forward(model, data)
    poses = [(data.geom_xpos[i], data.geom_xmat[i], model.geom_size[i]) for i in (0, 2)]
    wanted = boxbox.box_box(*poses[0], *poses[1])
    if not len(wanted) or not np.array_equal(_rows(model, data, _BOX), wanted):
        raise _unsupported("it does not return our contacts of two boxes")
    # Both have the four corners of the upper box's face; those of MuJoCo 3.4 and later are twice as deep.
    if len(boxes) != len(wanted) or not np.allclose(np.sort(boxes[:, 0]), 2 * np.sort(wanted[:, 0]), rtol=1e-6):
        raise _unsupported("its own contacts of two boxes have changed")
    lowest, published = meshes[:, 0].min(initial=0), _rows(model, data, _MESH)
    if not len(published) or not np.isclose(published[0, 0], lowest, rtol=1e-9):
        raise _unsupported("it does not return our contacts of a mesh on a plane")


def _rows(model: mujoco.MjModel, data: mujoco.MjData, kind: int) -> np.ndarray:
    """Distance, position and normal of the contacts of a kind of geom, [n, 7]."""
    contact = data.contact
    chosen = model.geom_type[contact.geom[:, 1]] == kind
    return np.concatenate([contact.dist[:, None], contact.pos, contact.frame[:, :3]], axis=1)[chosen]


# ---------------------------------------------------------------------------------------------------------------------
# The functions in the table. They are read from numba's cache in later processes, so nothing that belongs to this
# process or this MuJoCo is a constant in them: all of that is in ``_LAYOUT``, which they find by its symbol.

_ARGUMENTS = (types.uintp, types.uintp, types.uintp, types.int32, types.int32, types.float64)


@functools.cache
def _compiled() -> tuple[Any, Any]:
    signature = types.int32(*_ARGUMENTS)
    return compile_for_c(signature, _box_box), compile_for_c(signature, _plane_mesh)


@intrinsic_with_literals
def _layout(typingctx: TypingContext, index: Type) -> Intrinsic:
    """An entry of ``_LAYOUT``."""

    def codegen(context: BaseContext, builder: ir.IRBuilder, signature: Signature, args: Sequence[ir.Value]) -> Any:
        kind = ir.IntType(64)
        variable = builder.module.globals.get(_SYMBOL) or ir.GlobalVariable(builder.module, kind, _SYMBOL)
        variable.linkage = "external"
        return builder.load(builder.gep(variable, [args[0]]))

    return types.uintp(types.int64), codegen


@intrinsic_with_literals
def _call(typingctx: TypingContext, function: Type, arguments: Type) -> Intrinsic:
    """Call a C function that returns an int32 by its address, with a tuple of arguments."""

    def codegen(context: BaseContext, builder: ir.IRBuilder, signature: Signature, args: Sequence[ir.Value]) -> Any:
        values = cgutils.unpack_tuple(builder, args[1])
        kind = ir.FunctionType(ir.IntType(32), [value.type for value in values])
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)

    return types.int32(types.uintp, arguments), codegen


@part
def _is_marked(model: int) -> bool:
    """Whether the first custom number of a model is the mark."""
    if int32_at(model + _layout(_NUM_NUMERIC)) < 1:
        return False
    return address_at(address_at(model + _layout(_NUMERIC_DATA))) == _layout(_WANTED)


@part
def _row(owner: int, field: int, row: int, width: int) -> int:
    """Address of a row of a field; ``width`` is its size in bytes."""
    return address_at(owner + _layout(field)) + types.uintp(width * row)


def _box_box(model: int, data: int, rows: int, geom1: int, geom2: int, margin: float) -> int:
    """MuJoCo's collider of two boxes: writes contacts to ``rows`` and returns how many."""
    if not _is_marked(model):
        return _call(_layout(_BOXES), (model, data, rows, geom1, geom2, margin))
    first = _row(data, _GEOM_XPOS, geom1, 24), _row(data, _GEOM_XMAT, geom1, 72), _row(model, _GEOM_SIZE, geom1, 24)
    second = _row(data, _GEOM_XPOS, geom2, 24), _row(data, _GEOM_XMAT, geom2, 72), _row(model, _GEOM_SIZE, geom2, 24)
    return _call(_layout(_OUR_BOXES), (*first, *second, margin, rows))


def _plane_mesh(model: int, data: int, rows: int, geom1: int, geom2: int, margin: float) -> int:
    """MuJoCo's collider of a mesh on a plane: writes contacts to ``rows`` and returns how many."""
    mesh = int32_at(_row(model, _GEOM_DATAID, geom2, 4))
    graph = int32_at(_row(model, _GRAPHADR, mesh, 4)) if mesh >= 0 else -1
    if graph < 0 or not _is_marked(model):
        return _call(_layout(_MESHES), (model, data, rows, geom1, geom2, margin))
    vertex = int32_at(_row(model, _VERTADR, mesh, 4))
    poses = (
        _row(data, _GEOM_XPOS, geom1, 24),
        _row(data, _GEOM_XMAT, geom1, 72),
        _row(data, _GEOM_XPOS, geom2, 24),
        _row(data, _GEOM_XMAT, geom2, 72),
    )
    radius = floats_at(_row(model, _GEOM_RBOUND, geom2, 8))[0]
    shape = _row(model, _VERT, vertex, 12), _row(model, _GRAPH, graph, 4), radius
    return _call(_layout(_OUR_MESHES), (*poses, *shape, margin, rows))
