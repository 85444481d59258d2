"""Compiling functions with numba: one cache policy and one set of options for all compiled code.

Everything is float64 without fast-math, so bits depend neither on the batch nor on the machine's vectors. A function is
compiled once per machine and then read from numba's cache, which is next to the function's file, or in the user's cache
folder if that cannot be written; if neither can, nothing is cached. Numba looks for changes in the file of the compiled
function alone, so keep the functions it calls (``part``) in the same file.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.caching import FunctionCache
from numba.core.types import IntegerLiteral, Type
from numba.core.typing.context import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from vecenv.util import caching

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
        cache = FunctionCache(function)
    except RuntimeError:  # numba finds no folder that it may write
        return compiler(signature, **OPTIONS)(function)
    files = CachedFiles(Path(cache.cache_path), cache._impl.filename_base)
    compile_it = compiler(signature, cache=True, **OPTIONS)
    files.remove_unsound()
    try:
        compiled = compile_it(function)
    except Exception as error:  # whatever reading a damaged pickle raises; what is wrong with the function comes again
        files.remove(f"{type(error).__name__}: {error}")
        compiled = compiler(signature, cache=True, **OPTIONS)(function)
    files.seal()
    return compiled


class CachedFiles:
    """What numba cached of a function, with a file beside it that has the checksums.

    Numba runs whatever machine code its files hold, and does not notice when they were changed.

    Args:
        folder: numba's folder.
        base: how the files of the function begin.
    """

    def __init__(self, folder: Path, base: str) -> None:
        self._folder, self._base = folder, base
        self._seal = folder / f"{base}.sha256"

    def remove_unsound(self) -> None:
        """Remove the files unless they are those that were sealed, with a warning if they were changed since."""
        try:
            sealed = json.loads(self._seal.read_bytes())
        except FileNotFoundError:
            sealed = None  # nothing was cached yet, or not by this version
        except (OSError, ValueError, RecursionError):
            sealed = {}
        try:
            present = self._digests()
        except OSError as error:
            self.remove(str(error))
            return
        if sealed is None:
            self._unlink()
        elif present != sealed:
            self.remove("its checksum is another")

    def remove(self, why: str) -> None:
        """Remove the files and say why."""
        caching.damaged(self._folder / f"{self._base}.nbi", why)
        self._unlink()

    def seal(self) -> None:
        """Write the checksums; a folder that cannot be written is no error."""
        with contextlib.suppress(OSError):
            caching.write_file(self._seal, json.dumps(self._digests()).encode())

    def _paths(self) -> list[Path]:
        start = glob.escape(self._base)
        return sorted([*self._folder.glob(f"{start}.nbi"), *self._folder.glob(f"{start}.*.nbc")])

    def _digests(self) -> dict[str, str]:
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in self._paths()}

    def _unlink(self) -> None:
        for path in (*self._paths(), self._seal):
            with contextlib.suppress(OSError):
                path.unlink()


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
