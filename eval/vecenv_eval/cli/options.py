"""Options of a command from the fields of a config, and values for the fields from the options that were given.

A field's type decides how its option is read: a mapping is a repeatable ``key=value``, another sequence a repeatable
value, a bool a pair of flags, anything else one value. Options that were not given are None, so that a command can
tell them from a config file's settings. A command that has only some of the settings names them; from a file it
refuses the others (:func:`some_settings`), as typer does on the command line.
"""

from __future__ import annotations

import inspect
import json
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Any

import typer

from vecenv.cli import fail
from vecenv.errors import InvalidInput, NotFound, VecenvError
from vecenv.util.names import unknown
from vecenv_eval.config import ConfigError, EvalConfig, option_name, read_settings, setting


def with_settings(
    command: Callable[..., None],
    names: Collection[str] | None = None,
    also: Mapping[str, str] = MappingProxyType({}),
    shown: Mapping[str, str] = MappingProxyType({}),
    helps: Mapping[str, str] = MappingProxyType({}),
) -> Callable[..., None]:
    """Decorator: the command's ``**settings`` become one option for each field of :class:`EvalConfig`.

    Args:
        command: the command.
        names: the fields that it has; None for all.
        also: field -> another name of its option.
        shown: field -> what the command does without it, where that is not what an evaluation does.
        helps: field -> its sentence, where what it means for the command is not what it means for an evaluation.
    """
    own = list(inspect.signature(command, eval_str=True).parameters.values())
    hints = typing.get_type_hints(EvalConfig)
    generated = [
        _parameter(each, hints[each.name], also.get(each.name), shown.get(each.name), helps.get(each.name))
        for each in fields(EvalConfig)
        if names is None or each.name in names
    ]
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
        each.name: pairs(option_name(each), value) if _holds(hints[each.name], Mapping) else value
        for each in fields(EvalConfig)
        if (value := options.get(each.name)) not in (None, [])
    }


def some_settings(
    options: Mapping[str, Any], file: Path | None, names: Collection[str], command: str
) -> dict[str, Any]:
    """The settings of a command that has only some: those of the file, replaced by those given as options.

    Args:
        options: what the command was called with.
        file: a YAML file of settings, or None.
        names: the settings that the command has; from the file, others are taken only where they change nothing.
        command: its name, for messages.

    Raises:
        ConfigError: the file cannot be read, or has a setting that the command does not have.
    """
    settings = {} if file is None else read_settings(file)
    usual = {each.name: _default(each) for each in fields(EvalConfig)}
    for name, value in settings.items():
        if name not in usual:
            raise ConfigError(f"{file}: {unknown('setting', str(name), tuple(names))}")
        if name not in names and value != usual[name]:
            raise ConfigError(f"{file}: {name} is no setting of `vecenv {command}`; its own: {', '.join(names)}")
    return {**{name: settings[name] for name in settings if name in names}, **given_settings(options)}


@contextmanager
def user_errors() -> Iterator[None]:
    """A mistake of the user becomes one line and exit status 2; what is missing on the machine, status 1."""
    from vecenv.assets import AssetsMissing

    try:
        yield
    except AssetsMissing:
        raise
    except (InvalidInput, NotFound) as error:
        fail(" ".join(str(error).split()))
    except VecenvError as error:
        fail(" ".join(str(error).split()), code=1)


def _parameter(
    field: Field[Any], hint: Any, also: str | None, shown: str | None, help: str | None
) -> inspect.Parameter:
    about, name = setting(field), option_name(field)
    kind = _option_type(hint)
    flags = [f"{name}/{name.replace('--', '--no-', 1)}" if kind is bool else name, *([also] if also else [])]
    without = False if kind is bool else shown or about.default or _text(field)
    default = typer.Option(None, *flags, help=help or about.help, min=about.minimum, show_default=without)
    return inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind | None)


def _default(field: Field[Any]) -> Any:
    """The value of a field that is not given, None for one that must be."""
    if field.default_factory is not MISSING:
        return field.default_factory()
    return None if field.default is MISSING else field.default


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


def pairs(flag: str, texts: Sequence[str]) -> dict[str, Any]:
    """``["a=1", "b.c=x"]`` as ``{"a": 1, "b": {"c": "x"}}``: values are JSON where they can be read so, else text."""
    pairs: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        *above, last = key.split(".")
        if not (equals and all(part.isidentifier() for part in (*above, last))):
            fail(f"{flag} {text!r}: write key=value")
        here = pairs
        for part in above:
            here = here.setdefault(part, {})
            if not isinstance(here, dict):
                fail(f"{flag} {text!r}: {part} was given a value of its own")
        if (above and last in here) or isinstance(here.get(last), dict):
            fail(f"{flag} {text!r}: {key} is given twice")
        here[last] = _value(value)
    return pairs


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
