"""Wire types and ports of tools, and the values that go over them.

A :class:`Port` is a name, a :class:`WireType` and whether it may be left open; ports are pydantic models, so that a
server can publish them. :func:`check_inputs` refuses values that a wire of that type cannot carry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from vecenv.errors import InvalidInput

# Longest text that a port takes, characters.
LONGEST_TEXT = 1_000_000
# Largest whole number that every JSON reader keeps exact.
_LARGEST = 2**53


class NodeError(InvalidInput):
    """A tool cannot do what it was asked; the message names the port or option, and what would be right."""


class WireType(StrEnum):
    """What a wire carries.

    Images are uint8 [H, W, 3], depth float32 [H, W] in metres, poses xyz in metres and wxyz, [7]; metrics are a mapping
    from a name to a number or text. ``ANY`` is anything: numbers, arrays, mappings.
    """

    ANY = "ANY"
    TEXT = "TEXT"
    BOOL = "BOOL"
    IMAGE = "IMAGE"
    DEPTH = "DEPTH"
    POSE = "POSE"
    METRICS = "METRICS"
    IMAGES = "LIST[IMAGE]"
    TEXTS = "LIST[TEXT]"


class Port(BaseModel):
    """A named input or output of a tool."""

    model_config = ConfigDict(frozen=True)

    name: str
    type: WireType
    optional: bool = False
    description: str = ""


def port(name: str, kind: WireType = WireType.ANY, description: str = "", *, optional: bool = False) -> Port:
    """A port, with what is most often left at its default last."""
    return Port(name=name, type=kind, optional=optional, description=description)


def neutral(kind: WireType) -> Any:
    """What an output holds when there is nothing to report: False, an empty text, list or mapping, otherwise None."""
    empty: Mapping[WireType, Any] = {
        WireType.BOOL: False,
        WireType.TEXT: "",
        WireType.IMAGES: [],
        WireType.TEXTS: [],
        WireType.METRICS: {},
    }
    value = empty.get(kind)
    return value.copy() if isinstance(value, list | dict) else value


def check_inputs(ports: Sequence[Port], given: object) -> dict[str, Any]:
    """The values of all ports, None for an optional one that is left open.

    Raises:
        NodeError: a port that there is not, one that is missing, or a value that its wire cannot carry.
    """
    if not isinstance(given, Mapping):
        raise NodeError(f"inputs: got {_kind(given)}; expected a mapping from ports to values")
    known = [each.name for each in ports]
    if unknown := [name for name in given if name not in known]:
        raise NodeError(f"input {str(unknown[0])[:80]!r} does not exist; inputs: {', '.join(known) or 'none'}")
    return {each.name: _value(each, given.get(each.name)) for each in ports}


def _value(port: Port, value: Any) -> Any:
    if value is None:
        if port.optional:
            return None
        raise NodeError(f"input {port.name!r} is missing: it carries {port.type.value}")
    if port.type is WireType.TEXT:
        return _text(port.name, value)
    if port.type is WireType.BOOL:
        if not isinstance(value, bool | np.bool_):
            raise NodeError(f"input {port.name!r}: got {_kind(value)}; expected true or false")
        return bool(value)
    if port.type is WireType.TEXTS:
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise NodeError(f"input {port.name!r}: got {_kind(value)}; expected a list of texts")
        return [_text(f"{port.name}[{number}]", each) for number, each in enumerate(value)]
    return value


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise NodeError(f"input {name!r}: got {_kind(value)}; expected text")
    if not _is_unicode(value):
        raise NodeError(f"input {name!r}: the text holds half a surrogate pair, which is no character")
    if len(value) > LONGEST_TEXT:
        raise NodeError(f"input {name!r}: {len(value):,} characters; at most {LONGEST_TEXT:,} are read")
    return value


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def whole_number(what: str, value: Any, least: int = 0) -> int:
    """A whole number that came over a wire; ``what`` begins the sentence of the error.

    Raises:
        NodeError: something else, less than ``least``, or more than 2^53.
    """
    if isinstance(value, np.generic | np.ndarray) and np.ndim(value) == 0:
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise NodeError(f"{what}: got {_kind(value)}; expected a whole number from {least} on")
    if not least <= value <= _LARGEST or value != int(value):
        raise NodeError(f"{what}: got {_shown(value)}; expected a whole number from {least} on")
    return int(value)


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, int | float) and abs(value) < 1e15 else _kind(value)


def _kind(value: Any) -> str:
    return "nothing" if value is None else f"a {type(value).__name__}"
