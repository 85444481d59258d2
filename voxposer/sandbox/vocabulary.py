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

from voxposer.sandbox import numpy_functions as npf
from voxposer.sandbox import python_functions as pyf
from voxposer.sandbox.guard import Guard
from voxposer.sandbox.operators import dot
from voxposer.sandbox.values import array, hashable, length_of, listed, text, truth

Function = Callable[..., Any]

CONSTANTS: Mapping[str, Any] = MappingProxyType(
    {"pi": math.pi, "e": math.e, "inf": math.inf, "nan": math.nan, "newaxis": None}
)


_UNARY = """abs absolute fabs sqrt square exp log sin cos tan arcsin arccos arctan deg2rad rad2deg radians degrees floor
ceil rint sign isnan isfinite negative logical_not"""
_BINARY = """add subtract multiply divide floor_divide maximum minimum arctan2 power mod hypot logical_and logical_or
logical_xor equal not_equal less less_equal greater greater_equal"""
_REDUCTIONS = """sum mean min max amin amax std var prod any all median"""

NUMPY: Mapping[str, Function] = MappingProxyType(
    {name: npf.elementwise(name, 1) for name in _UNARY.split()}
    | {name: npf.elementwise(name, 2) for name in _BINARY.split()}
    | {name: npf.reduction(name) for name in _REDUCTIONS.split()}
    | {name: npf.rearranging(name, "axis", "keepdims") for name in ("argmin", "argmax", "count_nonzero")}
    | {name: npf.rearranging(name, "axis") for name in ("cumsum", "sort", "argsort", "flip", "squeeze", "expand_dims")}
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
        "interp": npf.interp,
    }
)


BUILTINS: Mapping[str, Function] = MappingProxyType(
    {
        "abs": pyf.absolute,
        "all": lambda guard, value: all(truth(guard, item) for item in listed(guard, value)),
        "any": lambda guard, value: any(truth(guard, item) for item in listed(guard, value)),
        "bool": truth,
        "enumerate": pyf.enumerated,
        "float": pyf.to_float,
        "int": pyf.to_int,
        "len": length_of,
        "list": lambda guard, value=(): listed(guard, value),
        "max": pyf.extreme(max),
        "min": pyf.extreme(min),
        "print": pyf.ignored_print,
        "range": pyf.make_range,
        "reversed": lambda guard, value: listed(guard, value)[::-1],
        "round": pyf.rounded,
        "sorted": pyf.in_order,
        "str": lambda guard, value="": text(guard, value),
        "sum": pyf.summed,
        "tuple": lambda guard, value=(): tuple(listed(guard, value)),
        "zip": pyf.zipped,
    }
)


def _transposed(guard: Guard, value: object, *axes: object) -> Any:
    """``array.transpose``, which takes its axes one by one."""
    return NUMPY["transpose"](guard, value, axes or None)


_SHARED = """min max mean sum std var prod any all argmin argmax argsort cumsum round clip dot squeeze reshape ravel
nonzero copy"""

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
            "remove": pyf.sequence_method("remove"),
            "index": pyf.sequence_method("index"),
            "count": pyf.sequence_method("count"),
            "reverse": lambda guard, value: value.reverse(),
            "sort": pyf.sort_list,
            "copy": lambda guard, value: listed(guard, value),
        },
        "tuple": {"index": pyf.sequence_method("index"), "count": pyf.sequence_method("count")},
        "dictionary": {
            "keys": pyf.dict_method("keys"),
            "values": pyf.dict_method("values"),
            "items": pyf.dict_method("items"),
            "get": lambda guard, value, key, default=None: value.get(hashable(guard, key), default),
        },
        "text": {name: pyf.text_method(name, 0, 0) for name in ("lower", "upper", "title", "capitalize")}
        | {name: pyf.text_method(name, 0, 1) for name in ("strip", "lstrip", "rstrip")}
        | {name: pyf.text_method(name, 1, 1) for name in ("startswith", "endswith", "count", "find")}
        | {"split": pyf.split_text, "replace": pyf.replace_text, "join": pyf.join_text},
        "number": {"item": pyf.array_item, "tolist": pyf.tolist, "astype": pyf.astype}
        | {name: NUMPY[name] for name in ("copy", "round", "clip", "any", "all", "sum", "min", "max", "mean")},
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
