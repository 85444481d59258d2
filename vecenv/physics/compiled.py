"""How this package compiles functions with numba for simulators' inner loops.

Everything is float64 without fast-math, so bits depend neither on the batch nor on the machine's vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}
# What only compiled code calls needs no entry from Python or C; called from Python nevertheless, it crashes.
part = numba.njit(**OPTIONS, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def compile_for_c(signature: Any, function: Callable[..., Any]) -> Any:
    """Compile to a C function, or read it from numba's cache: beside the file, else the user's, else none."""
    try:
        return numba.cfunc(signature, cache=True, **OPTIONS)(function)
    except RuntimeError:  # numba finds no folder that it may write
        return numba.cfunc(signature, **OPTIONS)(function)


@intrinsic(prefer_literal=True)
def stack_array(typingctx: Any, size: Any) -> Any:
    """Pointer to ``size`` (a literal) floats on the stack of the calling function: no memory is allocated."""
    if not isinstance(size, types.IntegerLiteral):
        raise TypeError("stack_array: the size must be a literal")
    count = size.literal_value

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.ArrayType(ir.DoubleType(), count)
        return builder.bitcast(cgutils.alloca_once(builder, kind), ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(size), codegen


# ---------------------------------------------------------------------------------------------------------------------
# Memory of C libraries, by address.


@intrinsic
def int32_at(typingctx: Any, address: Any) -> Any:
    """The int32 at an address."""
    return types.int32(types.uintp), _loader(ir.IntType(32))


@intrinsic
def address_at(typingctx: Any, address: Any) -> Any:
    """The pointer at an address, as a number."""
    return types.uintp(types.uintp), _loader(ir.IntType(64))


@intrinsic
def floats_at(typingctx: Any, address: Any) -> Any:
    """An address as a pointer to float64."""
    return types.CPointer(types.float64)(types.uintp), _pointer(ir.DoubleType())


@intrinsic
def singles_at(typingctx: Any, address: Any) -> Any:
    """An address as a pointer to float32."""
    return types.CPointer(types.float32)(types.uintp), _pointer(ir.FloatType())


@intrinsic
def int32s_at(typingctx: Any, address: Any) -> Any:
    """An address as a pointer to int32."""
    return types.CPointer(types.int32)(types.uintp), _pointer(ir.IntType(32))


def _pointer(kind: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], kind.as_pointer())

    return codegen


def _loader(kind: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(builder.inttoptr(args[0], kind.as_pointer()))

    return codegen
