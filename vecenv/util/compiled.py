"""Compiling functions with numba: one cache policy and one set of options for all compiled code.

Everything is float64 without fast-math, so bits depend neither on the batch nor on the machine's vectors. A function is
compiled once per machine and then read from numba's cache, which is next to the function's file, or in the user's cache
folder if that cannot be written; if neither can, nothing is cached. Numba looks for changes in the file of the compiled
function alone, so keep the functions it calls (``part``) in the same file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.types import IntegerLiteral, Type
from numba.core.typing.context import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

# What an intrinsic returns: its signature, and the function that generates its code.
Intrinsic: TypeAlias = tuple[Signature, Callable[..., Any]]

OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True}
# What only compiled code calls needs no entry from Python or C, which is a quarter less to compile. Called from Python
# nevertheless, it crashes.
_INNER: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
part = numba.njit(**_INNER)
carray: Any = numba.carray  # pyright: ignore[reportPrivateImportUsage]


def intrinsic_with_literals(function: Callable[..., Intrinsic]) -> Any:
    """A numba intrinsic that receives literal arguments as literal types, so that it can read their values."""
    return intrinsic(prefer_literal=True)(function)


def compile_function(signature: Signature, function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile to a function that Python calls and that releases the interpreter's lock, or read it from the cache."""
    return _cached(numba.njit, [signature], function)


def compile_for_c(signature: Signature, function: Callable[..., Any]) -> Any:
    """Compile to a C function with an ``address``, or read it from the cache."""
    return _cached(numba.cfunc, signature, function)


def _cached(compiler: Callable[..., Any], signature: Signature | list[Signature], function: Callable[..., Any]) -> Any:
    try:
        return compiler(signature, cache=True, **OPTIONS)(function)
    except RuntimeError:  # numba finds no folder that it may write
        return compiler(signature, **OPTIONS)(function)


@intrinsic_with_literals
def stack_array(typingctx: TypingContext, size: Type) -> Intrinsic:
    """Pointer to ``size`` (a literal) floats on the stack of the calling function: no memory is allocated."""
    if not isinstance(size, IntegerLiteral):
        raise TypeError("stack_array: the size must be a literal")
    count = size.literal_value

    def codegen(context: BaseContext, builder: ir.IRBuilder, signature: Signature, args: Sequence[ir.Value]) -> Any:
        kind = ir.ArrayType(ir.DoubleType(), count)
        return builder.bitcast(cgutils.alloca_once(builder, kind), ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(size), codegen


# ---------------------------------------------------------------------------------------------------------------------
# Reading the memory of C libraries by address.


@intrinsic_with_literals
def int32_at(typingctx: TypingContext, address: Type) -> Intrinsic:
    """The int32 at an address."""
    return types.int32(types.uintp), _loader(ir.IntType(32))


@intrinsic_with_literals
def address_at(typingctx: TypingContext, address: Type) -> Intrinsic:
    """The pointer at an address, as a number."""
    return types.uintp(types.uintp), _loader(ir.IntType(64))


@intrinsic_with_literals
def floats_at(typingctx: TypingContext, address: Type) -> Intrinsic:
    """An address as a pointer to float64."""
    return types.CPointer(types.float64)(types.uintp), _pointer(ir.DoubleType())


@intrinsic_with_literals
def singles_at(typingctx: TypingContext, address: Type) -> Intrinsic:
    """An address as a pointer to float32."""
    return types.CPointer(types.float32)(types.uintp), _pointer(ir.FloatType())


@intrinsic_with_literals
def int32s_at(typingctx: TypingContext, address: Type) -> Intrinsic:
    """An address as a pointer to int32."""
    return types.CPointer(types.int32)(types.uintp), _pointer(ir.IntType(32))


def _pointer(kind: ir.Type) -> Callable[..., Any]:
    def codegen(context: BaseContext, builder: ir.IRBuilder, signature: Signature, args: Sequence[ir.Value]) -> Any:
        return builder.inttoptr(args[0], kind.as_pointer())

    return codegen


def _loader(kind: ir.Type) -> Callable[..., Any]:
    def codegen(context: BaseContext, builder: ir.IRBuilder, signature: Signature, args: Sequence[ir.Value]) -> Any:
        return builder.load(builder.inttoptr(args[0], kind.as_pointer()))

    return codegen
