"""Deterministic damage to files: flipped bits, cuts, exchanged lines, values of other types."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from typing import Any

DEEP = "[" * 5000 + "]" * 5000
# Values that stand in for others: other types, numbers that fit nowhere, texts that are none.
STRANGERS = (
    *("null", "true", "-1", "3.5", "1e999", "-0.0", "1e308", "NaN", '""', '"x"', "[]", "{}", '{"a": 1}', "[[]]"),
    *("9" * 19, "9" * 400, "9" * 5000, '"\\ud800"', '"\\u0000"', '"os:system"', '"../../x"', DEEP),
)


def flip(content: bytes, chance: random.Random) -> bytes:
    """A few bits flipped."""
    made = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 8))):
        made[chance.randrange(len(made))] ^= 1 << chance.randrange(8)
    return bytes(made)


def flip_ahead(content: bytes, chance: random.Random) -> bytes:
    """Bytes replaced near the start, where formats have their headers and tables."""
    made = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 8))):
        made[chance.randrange(min(len(made), 4096))] = chance.choice((0, 0x7F, 0xFF, chance.randrange(256)))
    return bytes(made)


def flip_behind(content: bytes, chance: random.Random) -> bytes:
    """Bytes replaced near the end, where parquet has its tables."""
    return flip_ahead(content[::-1], chance)[::-1]


def cut(content: bytes, chance: random.Random) -> bytes:
    """The end, or a piece of the middle, is missing."""
    start = chance.randrange(len(content))
    return content[:start] + (b"" if chance.random() < 0.5 else content[start + chance.randrange(1, 64) :])


def grow(content: bytes, chance: random.Random) -> bytes:
    """Something is in the middle that does not belong there."""
    start = chance.randrange(len(content) + 1)
    piece = chance.choice((b"\0" * 64, b"\xff\xfe", b"\n", b"\r\n", b"{}\n", DEEP.encode(), content[:200]))
    return content[:start] + piece + content[start:]


def swap_lines(content: bytes, chance: random.Random) -> bytes:
    """Two lines exchanged, or one of them twice."""
    lines = content.split(b"\n")
    one, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    lines[one], lines[other] = lines[other], lines[chance.choice((one, other))]
    return b"\n".join(lines)


def swap_values(content: bytes, chance: random.Random) -> bytes:
    """One value of JSON replaced by a stranger, or its key left out or renamed; in JSON lines, of one line."""
    lines = [content] if content.startswith(b"{\n") else content.splitlines()
    number = chance.randrange(len(lines))
    value = json.loads(lines[number])
    holders = [(holder, key) for holder in _holders(value) for key in holder]
    holder, key = chance.choice(holders)
    text = chance.choice(STRANGERS)
    if chance.random() < 0.15:
        holder.pop(key)
    elif chance.random() < 0.1:
        holder[f"{key}x"] = holder.pop(key)
    else:
        holder[key] = "STRANGER"
    lines[number] = json.dumps(value).replace('"STRANGER"', text).encode()
    return b"\n".join(lines) + b"\n"


def _holders(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        yield value
        for each in value.values():
            yield from _holders(each)
    elif isinstance(value, list):
        for each in value:
            yield from _holders(each)


BYTES: tuple[Callable[[bytes, random.Random], bytes], ...] = (flip, flip_ahead, flip_behind, cut, grow)
LINES = (*BYTES, swap_lines)
JSON = (*LINES, swap_values, swap_values, swap_values, swap_values)


def mutations(
    content: bytes, kinds: tuple[Callable[[bytes, random.Random], bytes], ...], count: int
) -> Iterator[bytes]:
    """So many damaged versions of a file, the same ones every time."""
    for number in range(count):
        chance = random.Random(f"{number}")
        yield chance.choice(kinds)(content, chance)
