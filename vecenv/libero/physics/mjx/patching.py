"""Variants of MJX's functions: copies that see other globals, run for models with a mark; others run the originals.

MJX's private modules (``vecenv.libero.physics.private``) have no way to be extended, so vecenv's contacts
(``contacts``) and its order of contacts and sums (``deterministic``) put a function in the place of one of theirs that
looks at the model first. What is replaced is checked before it is replaced: ``expect`` refuses a function whose
arguments, or the names it refers to, are not those that vecenv was written for.
"""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable
from typing import Any


def expect(function: Any, arguments: str, *names: str, unsupported: Callable[[str], Exception]) -> types.FunctionType:
    """The undecorated function, checked to take these arguments first and to refer to these global names.

    Args:
        function: the function, a decorated one, or a Warp function.
        arguments: names of its first arguments, separated by spaces.
        names: global names that it refers to.
        unsupported: makes the error of a sentence that says what was found.
    """
    plain = inspect.unwrap(getattr(function, "func", function))
    name = f"{getattr(plain, '__module__', '?')}.{getattr(plain, '__qualname__', plain)}"
    if not isinstance(plain, types.FunctionType):
        raise unsupported(f"{name} is not a function")
    found = list(inspect.signature(plain).parameters)
    if found[: len(arguments.split())] != arguments.split():
        raise unsupported(f"{name} takes {', '.join(found)}")
    if missing := set(names) - set(plain.__code__.co_names):
        raise unsupported(f"{name} does not refer to {', '.join(sorted(missing))}")
    return plain


def copy_with(function: types.FunctionType, name: str, **replaced: object) -> types.FunctionType:
    """A copy of a function in which some of its global names have other values."""
    copied = types.FunctionType(function.__code__, {**function.__globals__, **replaced}, name, function.__defaults__)
    copied.__annotations__, copied.__doc__ = dict(function.__annotations__), function.__doc__
    copied.__module__, copied.__qualname__ = __name__, name
    return copied


def dispatch(marked: Callable[..., Any], current: Callable[..., Any], is_marked: Callable[[Any], bool]) -> Any:
    """A function of a model that calls ``marked`` if the model is marked, else ``current``."""

    @functools.wraps(current)
    def chosen(model: object, *args: object, **kwargs: object) -> Any:
        return (marked if is_marked(model) else current)(model, *args, **kwargs)

    return chosen
