"""Options of a command from the fields of a config, and values for the fields from the options that were given.

A field's type decides how its option is read: a mapping is a repeatable ``key=value``, another sequence a repeatable
value, a bool a pair of flags, anything else one value. Options that were not given are None, so that a command can
tell them from a config file's settings.
"""

from __future__ import annotations

import inspect
import json
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from types import NoneType, UnionType
from typing import Any

import typer

from vecenv.cli import fail
from vecenv_eval.config import EvalConfig, option_name, setting


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Decorator: the command's ``**settings`` become one option for each field of :class:`EvalConfig`."""
    own = list(inspect.signature(command, eval_str=True).parameters.values())
    hints = typing.get_type_hints(EvalConfig)
    generated = [_parameter(each, hints[each.name]) for each in fields(EvalConfig)]
    parameters = [
        *generated,
        *(each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in own if each.kind != each.VAR_KEYWORD),
    ]

    def run(**given: Any) -> None:
        command(**given)

    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    return run


def given_settings(options: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that were given as options, by field name."""
    hints = typing.get_type_hints(EvalConfig)
    return {
        each.name: _pairs(option_name(each), value) if _holds(hints[each.name], Mapping) else value
        for each in fields(EvalConfig)
        if (value := options[each.name]) not in (None, [])
    }


def _parameter(field: Field[Any], hint: Any) -> inspect.Parameter:
    about, name = setting(field), option_name(field)
    kind = _option_type(hint)
    flags = f"{name}/{name.replace('--', '--no-', 1)}" if kind is bool else name
    shown = False if kind is bool else about.default or _text(field)
    default = typer.Option(None, flags, help=about.help, min=about.minimum, show_default=shown)
    return inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind | None)


def _text(field: Field[Any]) -> str:
    value = None if field.default is MISSING else field.default
    return "none" if value is None else str(value)


def _option_type(hint: Any) -> Any:
    """What typer reads for a field: of a mapping or a sequence of texts a list of texts; of ``str | Sequence[int]`` one
    text, because numbers are written as a specification such as ``0,3,5-7``.
    """
    if _holds(hint, Mapping):
        return list[str]
    kinds = [kind for kind in _members(hint) if kind is not NoneType]
    if any(_holds(kind, Sequence) and typing.get_args(kind) == (str,) for kind in kinds):
        return list[str]
    plain = [kind for kind in kinds if not _holds(kind, Sequence)]
    return plain[0] if plain else list[str]


def _members(hint: Any) -> tuple[Any, ...]:
    """The types of a union, or the one type."""
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, UnionType) else (hint,)


def _holds(hint: Any, kind: type) -> bool:
    """Whether a type is a generic of this kind, such as ``Mapping[str, Any]``."""
    origin = typing.get_origin(hint)
    return isinstance(origin, type) and issubclass(origin, kind)


def _pairs(flag: str, texts: Sequence[str]) -> dict[str, Any]:
    """``["a=1", "b=x"]`` as ``{"a": 1, "b": "x"}``: values are read as JSON where they are JSON, else kept as text."""
    pairs = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            fail(f"{flag} {text!r}: write key=value")
        pairs[key] = _value(value)
    return pairs


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
