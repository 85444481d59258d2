"""What programs give to the functions of the host, checked before anything is computed with it.

In: a value of any kind, and what to call it. Out: the value as NumPy or Python has it, of one shape and finite in
single precision, in which maps are kept; or an ``InterfaceError`` that names the value and says in one sentence what is
expected.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from voxposer.requests import InterfaceError

# Distances, indices and angles of programs stay below this.
FAR = 1e6
# Characters of a value that are shown.
_SHOWN = 80


def shown(value: object) -> str:
    """A value in an error: text and numbers as they are, shortened, anything else by its type and shape."""
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of shape {value.shape}"
    if isinstance(value, str):
        return repr(value[:_SHOWN]) + ("..." if len(value) > _SHOWN else "")
    if isinstance(value, (list, tuple)):
        return f"a {type(value).__name__} of {len(value)}"
    plain = value is None or isinstance(value, (bool, int, float, np.generic, np.ndarray))
    return f"{value}"[:_SHOWN] if plain else f"a value of type {type(value).__name__}"


def text(value: object, what: str) -> str:
    """Text.

    Raises:
        InterfaceError: it is something else.
    """
    if not isinstance(value, str):
        raise InterfaceError(f"{what}: expected text, got {shown(value)}")
    return value


def number(value: object, what: str) -> float:
    """A number between -1e6 and 1e6, as it is.

    Raises:
        InterfaceError: it is something else.
    """
    if isinstance(value, np.ndarray) and value.shape == ():
        value = value[()]
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise InterfaceError(f"{what}: expected a number, got {shown(value)}")
    if not abs(value) < FAR:  # also what is not a number
        raise InterfaceError(f"{what}: expected a number between -{FAR:.0f} and {FAR:.0f}, got {value:g}")
    return value  # pyright: ignore[reportReturnType]


def numbers(value: object, what: str, *shapes: tuple[int | None, ...]) -> np.ndarray:
    """An array of numbers, float64, of one of the shapes; a length that is None may be any, and no shape is any shape.

    Raises:
        InterfaceError: it holds something else than numbers, has another shape, or is not finite in single precision.
    """
    given = plain_array(value, what)
    if shapes and not any(_fits(given.shape, shape) for shape in shapes):
        raise InterfaceError(f"{what}: expected {_described(shapes)}, got {shown(value)}")
    made = given.astype(float)
    if not finite_in_single(made):
        raise InterfaceError(f"{what}: expected {_described(shapes)}, finite in single precision, got {shown(value)}")
    return made


def plain_array(value: object, what: str) -> np.ndarray:
    """A number, an array of them or lists of them as an array of truth values, integers or floats.

    Raises:
        InterfaceError: it is something else.
    """
    if not isinstance(value, (bool, int, float, np.generic, np.ndarray, list, tuple)):
        raise InterfaceError(f"{what}: expected numbers, got {shown(value)}")
    try:
        made = np.asarray(value)
    except (ValueError, TypeError, OverflowError):
        raise InterfaceError(f"{what}: expected numbers in rows of one length, got {shown(value)}") from None
    if made.dtype.kind not in "biuf":
        raise InterfaceError(f"{what}: expected numbers, got {shown(value)}")
    return made


def finite_in_single(value: npt.ArrayLike) -> bool:
    """Whether every number is finite after conversion to float32."""
    with np.errstate(over="ignore"):
        return bool(np.isfinite(np.asarray(value).astype(np.float32)).all())


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(shape) == len(wanted) and all(b is None or a == b for a, b in zip(shape, wanted, strict=True))


def _described(shapes: tuple[tuple[int | None, ...], ...]) -> str:
    if not shapes:
        return "numbers"
    return " or ".join(
        "a number" if not shape else f"{shape[0]} numbers" if len(shape) == 1 else f"rows of {shape[-1]} numbers"
        for shape in shapes
    )
