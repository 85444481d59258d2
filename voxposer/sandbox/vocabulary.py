"""The allow-list: every function, method, attribute and constant that programs may use.

Tables only; what they point to is in ``numpy_functions``, ``python_functions`` and ``values``. Every function takes a
``Guard`` first. NumPy is a closed list: nothing that reads or writes files, takes a function, a dtype by name or an
``out`` array.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from voxposer.sandbox import formatting, iteration
from voxposer.sandbox import numpy_functions as npf
from voxposer.sandbox import python_functions as pyf
from voxposer.sandbox.guard import Guard
from voxposer.sandbox.operators import dot, power_of
from voxposer.sandbox.values import array, counted, hashable, length_of, listed, number_of, truth

Function = Callable[..., Any]

CONSTANTS: Mapping[str, Any] = MappingProxyType(
    {"pi": math.pi, "e": math.e, "inf": math.inf, "nan": math.nan, "newaxis": None}
)


_UNARY = """abs absolute fabs sqrt cbrt square exp exp2 log log2 log10 sin cos tan sinh cosh tanh arcsin arccos arctan
deg2rad rad2deg radians degrees floor ceil trunc rint sign isnan isinf isfinite negative logical_not"""
_BINARY = """add subtract multiply divide true_divide floor_divide maximum minimum fmax fmin arctan2 power mod remainder
hypot logical_and logical_or logical_xor equal not_equal less less_equal greater greater_equal"""
_REDUCTIONS = """sum mean min max amin amax std var prod any all median ptp"""

NUMPY: Mapping[str, Function] = MappingProxyType(
    {name: npf.elementwise(name, 1) for name in _UNARY.split()}
    | {name: npf.elementwise(name, 2) for name in _BINARY.split()}
    | {name: npf.reduction(name) for name in _REDUCTIONS.split()}
    | {name: npf.rearranging(name, "axis", "keepdims") for name in ("argmin", "argmax", "count_nonzero")}
    | {name: npf.rearranging(name, "axis") for name in ("cumsum", "cumprod", "flip")}
    | {name: npf.ordering(name) for name in ("sort", "argsort")}
    | {name: npf.rearranging(name, "axis") for name in ("squeeze", "expand_dims")}
    | {name: npf.rearranging(name) for name in ("atleast_1d", "flipud", "fliplr", "flatnonzero")}
    | {name: npf.joining(name, with_axis=False) for name in ("column_stack", "dstack")}
    | {name: npf.closeness(name) for name in ("allclose", "isclose")}
    | {name: npf.positions(name) for name in ("nonzero", "argwhere")}
    | {name: npf.joining(name, with_axis=True) for name in ("concatenate", "stack")}
    | {name: npf.joining(name, with_axis=False) for name in ("vstack", "hstack")}
    | dict.fromkeys(("array", "asarray"), array)
    | {name: npf.filled(0.0) for name in ("zeros", "empty")}
    | {
        "ones": npf.filled(1.0),
        "full": npf.full,
        "zeros_like": npf.filled_like(0.0),
        "ones_like": npf.filled_like(1.0),
        "full_like": npf.full_like,
        "eye": npf.eye,
        "arange": npf.arange,
        "linspace": npf.linspace,
        "indices": npf.indices,
        "meshgrid": npf.meshgrid,
        "copy": npf.copy_array,
        "linalg.norm": npf.norm,
        "dot": dot,
        "matmul": dot,
        "cross": npf.cross,
        "outer": npf.outer,
        "where": npf.where,
        "clip": npf.clip,
        "round": npf.round_array,
        "around": npf.round_array,
        "unravel_index": npf.unravel_index,
        "array_equal": npf.array_equal,
        "reshape": npf.reshape,
        "ravel": npf.rearranging("ravel"),
        "transpose": npf.rearranging("transpose", "axes"),
        "roll": npf.rearranging("roll", "shift", "axis"),
        "diff": npf.diff,
        "tile": npf.tile,
        "repeat": npf.repeat,
        "append": npf.append,
        "unique": npf.unique,
        "isin": npf.isin,
        "swapaxes": npf.swapaxes,
        "average": npf.average,
        "percentile": npf.percentile,
        "shape": npf.shape,
        "ndim": lambda guard, a: len(npf.shape(guard, a)),
        "size": lambda guard, a: math.prod(npf.shape(guard, a)),
        "linalg.inv": npf.inverse,
        "interp": npf.interp,
    }
)


def _of_numbers(function: Function) -> Function:
    """A function of ``math``, of numbers alone."""
    return lambda guard, *values: function(*(number_of(value) for value in values))


_MATH = """sqrt sin cos tan asin acos atan atan2 sinh cosh tanh floor ceil trunc fabs degrees radians hypot isclose
isnan isinf isfinite exp log log2 log10 copysign fmod"""

MATH: Mapping[str, Function] = MappingProxyType(
    {name: _of_numbers(getattr(math, name)) for name in _MATH.split()}
    | {
        "pow": lambda guard, x, y: math.pow(number_of(x), number_of(y)),
        "dist": lambda guard, p, q: math.dist(listed(guard, p), listed(guard, q)),
        "fsum": lambda guard, seq: math.fsum(listed(guard, seq)),
    }
)

COPY: Mapping[str, Function] = MappingProxyType({"copy": pyf.shallow_copy, "deepcopy": pyf.deep_copy})


def _any(guard: Guard, iterable: object) -> bool:
    return any(truth(guard, item) for item in counted(guard, iterable))


def _all(guard: Guard, iterable: object) -> bool:
    return all(truth(guard, item) for item in counted(guard, iterable))


BUILTINS: Mapping[str, Function] = MappingProxyType(
    {
        "abs": pyf.absolute,
        "all": _all,
        "any": _any,
        "callable": pyf.is_callable,
        "dict": pyf.make_dict,
        "divmod": lambda guard, a, b: divmod(number_of(a), number_of(b)),
        "enumerate": iteration.enumerated,
        "filter": iteration.filtered,
        "format": lambda guard, value, spec="": formatting.formatted(guard, value, pyf.require_text(spec)),
        "isinstance": pyf.is_instance,
        "iter": iteration.make_iterator,
        "len": length_of,
        "list": lambda guard, iterable=(): listed(guard, iterable),
        "map": iteration.mapped,
        "max": pyf.extreme(max),
        "min": pyf.extreme(min),
        "next": iteration.next_item,
        "pow": lambda guard, base, exp: power_of(guard, base, exp),
        "print": pyf.ignored_print,
        "range": pyf.make_range,
        "repr": formatting.representation,
        "reversed": iteration.backwards,
        "round": pyf.rounded,
        "set": pyf.make_set,
        "sorted": pyf.in_order,
        "str": lambda guard, value="": formatting.text(guard, value),
        "sum": pyf.summed,
        "tuple": lambda guard, iterable=(): tuple(listed(guard, iterable)),
        "zip": iteration.zipped,
    }
)


def _transposed(guard: Guard, value: object, *axes: object) -> Any:
    """``array.transpose``, which takes its axes one by one."""
    return NUMPY["transpose"](guard, value, axes or None)


_SHARED = """min max mean sum std var prod any all argmin argmax argsort cumsum round clip dot squeeze reshape ravel
nonzero copy swapaxes repeat ptp"""

_SET_METHODS = """union intersection difference symmetric_difference issubset issuperset isdisjoint update"""
_TEXT_METHODS = """lower upper title capitalize casefold swapcase splitlines isdigit isdecimal isnumeric isalpha isalnum
isspace islower isupper"""
_TEXT_SEARCHES = """startswith endswith count find rfind index rindex partition rpartition removeprefix removesuffix"""

METHODS: Mapping[str, Mapping[str, Function]] = MappingProxyType(
    {
        "array": {name: NUMPY[name] for name in _SHARED.split()}
        | {
            "astype": pyf.astype,
            "flatten": lambda guard, value: npf.copy_array(guard, value).ravel(),
            "tolist": pyf.tolist,
            "item": pyf.array_item,
            "transpose": _transposed,
            "fill": pyf.fill_in_place,
            "sort": pyf.sort_in_place,
        },
        "list": {
            "append": pyf.append_item,
            "extend": pyf.extend_list,
            "insert": pyf.insert_item,
            "pop": pyf.pop_item,
            "remove": pyf.remove_item,
            "index": pyf.index_of,
            "count": pyf.count_in,
            "reverse": lambda guard, value: value.reverse(),
            "sort": pyf.sort_list,
            "copy": lambda guard, value: listed(guard, value),
            "clear": pyf.clear,
        },
        "tuple": {"index": pyf.index_of, "count": pyf.count_in},
        "dictionary": {
            "keys": pyf.dict_method("keys"),
            "values": pyf.dict_method("values"),
            "items": pyf.dict_method("items"),
            "get": lambda guard, value, key, default=None: value.get(hashable(guard, key), default),
            "pop": pyf.pop_key,
            "setdefault": pyf.set_default,
            "update": pyf.update_dict,
            "copy": lambda guard, value: dict(value),
            "clear": pyf.clear,
        },
        "set": {name: pyf.set_item_method(name) for name in ("add", "discard", "remove")}
        | {name: pyf.set_method(name) for name in _SET_METHODS.split()}
        | {"pop": pyf.pop_from_set, "copy": lambda guard, value: set(value), "clear": pyf.clear},
        "text": {name: pyf.text_method(name, 0, 0) for name in _TEXT_METHODS.split()}
        | {name: pyf.text_method(name, 0, 1) for name in ("strip", "lstrip", "rstrip")}
        | {name: pyf.text_method(name, 1, 1) for name in _TEXT_SEARCHES.split()}
        | {name: pyf.padding(name) for name in ("ljust", "rjust", "center", "zfill")}
        | {
            "split": pyf.split_text,
            "replace": pyf.replace_text,
            "join": pyf.join_text,
            "format": formatting.format_text,
        },
        "number": {"item": pyf.array_item, "tolist": pyf.tolist, "astype": pyf.astype}
        | {name: NUMPY[name] for name in ("copy", "round", "clip", "any", "all", "sum", "min", "max", "mean")}
        | {"is_integer": lambda guard, value: float(number_of(value)).is_integer()},
    }
)
ATTRIBUTES: Mapping[str, Function] = MappingProxyType(
    {
        "shape": lambda value: value.shape,
        "ndim": lambda value: value.ndim,
        "size": lambda value: value.size,
        "T": lambda value: value.T,
    }
)

# What to write in place of names of Python that programs do not have.
HINTS: Mapping[str, str] = MappingProxyType(
    {
        "type": "; compare with isinstance",
        "object": "; keep values in dictionaries",
        "id": "; compare with ==",
        "hash": "; compare with ==",
        "getattr": "; read an observation's field as x['name']",
        "hasattr": "; read an observation's field as x['name'] in try and except",
        "open": "; programs have no files",
        "input": "; programs ask nobody",
        "exit": "; end the program with return",
        "quit": "; end the program with return",
        "get_clock_time": "; programs do not see the time, so leave it out",
        "vars": "; name the variables",
        "locals": "; name the variables",
        "globals": "; name the variables",
        "frozenset": "; write a tuple or a set",
        "slice": "; write the slice in brackets",
        "chr": "; write the character",
        "ord": "; compare the characters",
        "bytes": "; write text",
        "complex": "; write two numbers",
    }
)
