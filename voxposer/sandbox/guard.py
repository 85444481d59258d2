"""The kinds of values that a program may hold, and the limits on what it may use.

In: values as they are created while ``voxposer.sandbox`` interprets a program. Out: the same values, or a
``Refusal`` with the rule it breaks. Sizes are checked before anything is allocated. Nothing here knows about syntax;
the interpreter adds the line number.
"""

from __future__ import annotations

import contextlib
import math
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np

from voxposer.sandbox.objects import DType, Error, ErrorType, Function, Module, Stream, TypeName, error_class

# Array elements that count as one interpreter step: working on them takes about as long as one node.
ELEMENTS_A_STEP = 1000
# Steps between two readings of the clock; whatever may take long reads it as well.
_STEPS_A_LOOK = 100
# Seconds that pass before the time of this thread is read again: that is a call of the system, and slow on some.
_CLOCK_S = 0.005
# Bytes counted for an item of a list (enough for a tuple of two numbers), for a character, for a list, tuple,
# dictionary or set besides its items, and for an array or a view of one besides its elements.
ITEM_BYTES, _CHARACTER_BYTES, _CONTAINER_BYTES, ARRAY_BYTES = 100, 4, 220, 250
# Elements that one call may put in order, and the steps that a thousand of them count for.
_SORTED, _STEPS_OF_SORTING = 2**22, 10
# Largest number of dimensions of an array: the cost of printing or rolling one grows exponentially with it.
_DIMENSIONS = 8
# Bytes counted for a function with its scope, for a suspended generator, and for an error besides its text.
FUNCTION_BYTES, STREAM_BYTES, _ERROR_BYTES = 2000, 4000, 500
# Tuples of one hash that may be keys, and bytes for remembering one.
_ALIKE, _KEY_BYTES = 32, 300
# Characters of a message that comes from elsewhere.
_MESSAGE = 600

# Rules whose violation is an error that a program may catch, and the class by which it does.
_CATCHABLE: Mapping[str, type[BaseException]] = MappingProxyType(
    {
        "types": TypeError,
        "value": ValueError,
        "attributes": AttributeError,
        "names": NameError,
        "call": RuntimeError,
        "raised": Exception,
    }
)


class Refusal(Exception):
    """A program violates a rule.

    Attributes:
        rule: short name of the rule, one of ``voxposer.sandbox.syntax.RULES``.
        reason: what the program did, and what is allowed.
        python: Python's class of the error, by which a program may catch it; None if it may not.
    """

    def __init__(self, rule: str, reason: str, python: type[BaseException] | None = None) -> None:
        super().__init__(f"{reason} [{rule}]")
        self.rule, self.reason = rule, reason
        self.python = python if python is not None else _CATCHABLE.get(rule)


class Kept(int):
    """What a function of the host returns that keeps bytes for the program and otherwise returns None."""


class HostFault(Exception):
    """An error of the host, not of the program: it passes through the interpreter unchanged."""


class Record(ABC):
    """A value of the host whose named fields programs may read, as ``x.name`` or ``x["name"]``, but not write."""

    @abstractmethod
    def fields(self) -> Collection[str]:
        """The names a program may read."""

    @abstractmethod
    def __getitem__(self, name: str, /) -> Any:
        """The field's value; arrays are copies."""


class RecordList(Sequence[Record]):
    """Several records. Programs may take its length, index it and loop over it."""


class Opaque:
    """A value of the host that programs can only store and pass to the host's functions."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How much a program may use.

    Attributes:
        source_chars: characters of source.
        nesting: levels of syntax, and of lists in lists.
        steps: nodes interpreted, with a thousand array elements worked on counted as one more; shared by the programs
            that one program calls.
        calls: calls of the host's functions and reads of its records; shared likewise.
        programs: further programs requested from the model; shared likewise.
        seconds: computing time of this thread in programs and in the host's functions, without what is spent on
            asking the model; shared likewise.
        memory_bytes: all that a program allocates, freed or not, what the host keeps for it included. The programs
            that it calls share it; what they leave is given back when they end.
        array_elements: elements of one array.
        items: items of a list, tuple or dictionary, nested ones included.
        text_chars: characters of a string.
        integer_bits: bits of an integer.
        depth: expressions inside one another while they are evaluated, through calls of a program's own functions and
            through generators; shared by the programs that one program calls. A simple recursive function may call
            itself about 35 times.
    """

    source_chars: int = 20_000
    nesting: int = 60
    steps: int = 1_000_000
    calls: int = 2_000
    programs: int = 200
    seconds: float = 10.0
    memory_bytes: int = 512 * 2**20
    array_elements: int = 2**23
    items: int = 10_000
    text_chars: int = 10_000
    integer_bits: int = 63
    depth: int = 250


class Budget:
    """Steps, calls, time and memory left to a program and to all programs that it calls.

    Attributes:
        depth: expressions, calls and generators that are entered.
        memory: bytes left.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._steps, self._calls, self._seconds = limits.steps, limits.calls, limits.seconds
        self._programs = limits.programs
        self._unseen = 0
        self._since: float | None = None
        self._looked = 0.0
        self.depth = 0
        self.memory = limits.memory_bytes

    def deeper(self, levels: int = 1) -> None:
        """Enter an expression, a call or a generator; whoever entered subtracts the levels again."""
        self.depth += levels
        if self.depth > self.limits.depth:
            raise Refusal("nesting", f"calls and generators more than {self.limits.depth} levels deep")

    def step(self, count: int = 1) -> None:
        """Count steps, and check the time now and then."""
        self._steps -= count
        self._unseen += count
        if self._steps < 0:
            raise Refusal("steps", f"more than {self.limits.steps} steps: a loop that is too long or never ends")
        if self._unseen >= _STEPS_A_LOOK:
            self.look()

    def call(self) -> None:
        """Count one call of the host."""
        self.look()
        self._calls -= 1
        if self._calls < 0:
            raise Refusal("calls", f"more than {self.limits.calls} calls of given functions and reads of observations")

    def program(self) -> None:
        """Count one further program requested from the model."""
        self._programs -= 1
        if self._programs < 0:
            raise Refusal("calls", f"more than {self.limits.programs} further programs were asked for")

    @contextlib.contextmanager
    def clock(self, running: bool) -> Iterator[None]:
        """Run the clock (in a program) or stop it (asking the model); its previous state is restored afterwards."""
        was_running = self._since is not None
        self._set(running)
        try:
            yield
        finally:
            self._set(was_running)

    @contextlib.contextmanager
    def nested(self) -> Iterator[None]:
        """Run a program; the memory it took is given back afterwards."""
        before = self.memory
        try:
            with self.clock(running=True):
                yield
        finally:
            self.memory = before

    def _set(self, running: bool) -> None:
        now = time.thread_time()
        if self._since is not None:
            self._seconds -= now - self._since
        self._since = now if running else None

    def look(self) -> None:
        """Check the time, if some has passed since the last look."""
        self._unseen = 0
        now = time.monotonic()
        if now - self._looked < _CLOCK_S:
            return
        self._looked = now
        self._set(self._since is not None)
        if self._seconds < 0:
            raise Refusal("time", f"more than {self.limits.seconds} s of computing")


class Guard:
    """Checks and counts what one run of one program uses; every function a program may call gets it first."""

    def __init__(self, budget: Budget) -> None:
        self.budget, self.limits = budget, budget.limits
        self._keys: dict[int, list[tuple[Any, ...]]] = {}

    def hold(self, size: int) -> None:
        """Count bytes that the program has made or is about to make."""
        self.require_memory(size)
        self.budget.memory -= size

    def require_memory(self, size: int) -> None:
        """Refuse an allocation that would exceed the memory limit."""
        if size > self.budget.memory:
            raise Refusal("memory", f"values of more than {self.limits.memory_bytes} bytes in all")

    def room(self, shape: Sequence[int], itemsize: int = 8) -> None:
        """Refuse an array that would be too large, before it is allocated; its elements count as steps."""
        if len(shape) > _DIMENSIONS:
            raise Refusal("size", f"an array of {len(shape)} dimensions; {_DIMENSIONS} are allowed")
        elements = math.prod(max(int(length), 1) for length in shape)  # (10**9, 0) is empty, its sums are not
        if elements > self.limits.array_elements:
            raise Refusal("memory", f"an array of {elements} elements; {self.limits.array_elements} are allowed")
        self.require_memory(elements * itemsize)
        self.budget.step(elements // ELEMENTS_A_STEP)

    def order(self, elements: int) -> None:
        """Refuse to put in order, or to look up in order, more elements than that takes a moment for."""
        if elements > _SORTED:
            raise Refusal("memory", f"{elements} elements put in order; {_SORTED} are allowed")
        self.budget.step(_STEPS_OF_SORTING * elements // ELEMENTS_A_STEP)

    def length(self, count: int) -> None:
        """Refuse a container with too many items, before it is made."""
        if count > self.limits.items:
            raise Refusal("size", f"{count} items in a list; {self.limits.items} are allowed")

    def characters(self, count: int) -> None:
        """Refuse a string that would be too long, before it is made."""
        if count > self.limits.text_chars:
            raise Refusal("size", f"a string of {count} characters; {self.limits.text_chars} are allowed")

    def bits(self, count: int) -> None:
        """Refuse an integer that would be too large, before it is computed."""
        if count > self.limits.integer_bits:
            raise Refusal("size", f"an integer of more than {self.limits.integer_bits} bits")

    def remember_key(self, key: tuple[Any, ...]) -> None:
        """Refuse a key if too many others have its hash: Python compares it with each of them, every time."""
        alike = self._keys.setdefault(hash(key), [])
        if any(key is known or key == known for known in alike):
            return
        if len(alike) >= _ALIKE:
            raise Refusal("size", f"more than {_ALIKE} tuples of one hash as keys, such as (-1,) and (-2,)")
        self.hold(_KEY_BYTES)
        alike.append(key)

    def take(self, value: object) -> Any:
        """A new value, checked, with its memory counted; a view counts as an array of its size."""
        self.budget.look()
        if isinstance(value, np.ndarray):
            require_numbers(value)
            self.room(value.shape, value.itemsize)
            self.hold(value.nbytes + ARRAY_BYTES)
        elif isinstance(value, str):
            self.characters(len(value))
            self.hold(len(value) * _CHARACTER_BYTES)
        elif isinstance(value, (list, tuple, dict, set)):
            self.length(len(value))
            self.hold(len(value) * ITEM_BYTES + _CONTAINER_BYTES)
            self.budget.step(len(value) // 100)
        elif type(value) is int:
            self.bits(value.bit_length())
        elif isinstance(value, (Function, Stream)):
            self.hold(FUNCTION_BYTES if isinstance(value, Function) else STREAM_BYTES)
        elif isinstance(value, Error):
            self.hold(_ERROR_BYTES + len(value.text) * _CHARACTER_BYTES)
        else:
            kind_of(value)
        return value

    def take_all(self, value: object) -> Any:
        """A function's result, checked together with the items of a list or tuple."""
        if isinstance(value, (list, tuple)):
            self.weigh(value)
            for item in value:
                self.take(item)
        return self.take(value)

    def host(self, name: str, function: Callable[..., Any], /, *arguments: object, **named: object) -> Any:
        """Call a function of the host; its time counts, and the bytes that it says it has :class:`Kept`.

        Raises:
            Refusal: it raised something other than a ``HostFault`` (the refusal's cause), or returned a value that
                programs may not hold.
        """
        self.budget.call()
        try:
            value = function(*arguments, **named)
        except (HostFault, Refusal):  # a nested program exceeded this budget
            raise
        except Exception as error:
            raise _host_refusal(name, error) from error
        self.budget.look()
        if type(value) is Kept:
            self.hold(value)
            return None
        given = any(value is argument for argument in (*arguments, *named.values()))
        return value if given else self.take_all(value)

    def weigh(self, value: object) -> Weight:
        """Count what a value contains, nested lists included; shared items count each time they appear.

        Shared lists can represent exponentially many items, and a list may contain itself, so every value that is
        passed to a function that walks lists is checked here first.

        Raises:
            Refusal: there are too many, they nest too deep, or one is not a value that programs may hold.
        """
        pending: list[tuple[Any, int]] = [(value, 0)]
        seen, leaves = 0, []
        while pending:
            item, depth = pending.pop()
            seen += 1
            if isinstance(item, (list, tuple, dict, set)):
                if depth >= self.limits.nesting or seen + len(pending) + len(item) > self.limits.items + 1:
                    raise Refusal("size", f"lists nested too deep or with more than {self.limits.items} items in all")
                pending.extend((child, depth + 1) for child in _children(item))
            else:
                leaves.append(item)
        self.budget.step(seen // 10)
        return Weight(
            numbers=sum(_numbers_in(leaf) for leaf in leaves),
            characters=sum(len(leaf) for leaf in leaves if isinstance(leaf, str)),
            kinds=frozenset(kind_of(leaf) for leaf in leaves),
        )


@dataclass(frozen=True, kw_only=True)
class Weight:
    """The counts of ``Guard.weigh``.

    Attributes:
        numbers: numbers and elements of arrays and ranges, each counted as often as it appears.
        characters: characters of all strings.
        kinds: kinds of value that appear, other than lists, tuples and dictionaries.
    """

    numbers: int
    characters: int
    kinds: frozenset[str]


def _host_refusal(name: str, error: Exception) -> Refusal:
    """What a program is told when a given function raised: catchable, unless it is the limit of a nested program."""
    text = shortened(f"{name}: {type(error).__name__}: {about_arguments(name, str(error)) or error}")
    refusal = Refusal("call", text, error_class(error))
    if hasattr(error, "rule") or error_class(error) is None:
        refusal.python = None
    return refusal


def about_arguments(name: str, text: str) -> str:
    """What Python says about arguments that a function does not take, by the function's name in programs; "" for other
    texts."""
    found = _ARGUMENTS.match(text)
    if not found:
        return ""
    if found[1].startswith("takes"):  # so many, and counts one that programs do not see
        return f"{name}() is given more arguments than it takes"
    return f"{name}() {found[1]}"


_ARGUMENTS = re.compile(r"[\w.<>]+\(\) ((?:takes|got|missing) .*)", re.S)


def shortened(text: str, most: int = _MESSAGE) -> str:
    """A message of at most so many characters, in one line; what a terminal would obey is escaped."""
    line = " ".join(text[: 4 * most].split())
    if not line.isprintable():
        line = "".join(each if each.isprintable() else repr(each)[1:-1] for each in line)
    return line if len(line) <= most else f"{line[: most - 3]}..."


def _children(container: list[Any] | tuple[Any, ...] | dict[Any, Any] | set[Any]) -> Iterable[Any]:
    return [*container.keys(), *container.values()] if isinstance(container, dict) else container


def _numbers_in(leaf: object) -> int:
    if isinstance(leaf, np.ndarray):
        return leaf.size
    return len(leaf) if isinstance(leaf, range) else 1


_KINDS: dict[type, str] = {
    type(None): "None",
    bool: "number",
    int: "number",
    float: "number",
    str: "text",
    list: "list",
    tuple: "tuple",
    dict: "dictionary",
    set: "set",
    range: "range",
    Function: "function",
    Stream: "iterator",
    Error: "error",
    ErrorType: "class of errors",
    DType: "type",
    TypeName: "type",
}


def kind_of(value: object) -> str:
    """The kind of a value: number, array, text, list, tuple, dictionary, set, range, observation, map, function,
    iterator, error, class of errors, type, None.

    Raises:
        Refusal: programs may not hold it.
    """
    kind = _KINDS.get(type(value))
    if kind is not None:
        return kind
    if isinstance(value, (np.ndarray, np.generic)):
        require_numbers(value)
        return "array" if isinstance(value, np.ndarray) else "number"
    for of_host, name in ((Record, "observation"), (RecordList, "observations"), (Opaque, "map")):
        if isinstance(value, of_host):
            return name
    if isinstance(value, Module):
        raise Refusal("functions", f"{value.name} is a module: its functions can be called, but it is no value")
    raise Refusal("values", f"{type(value).__name__} is not a kind of value that a program may hold")


def require_numbers(value: np.ndarray | np.generic) -> None:
    """Refuse arrays of anything but truth values, integers and floats."""
    if value.dtype.kind not in "biuf":
        raise Refusal("values", f"an array of {value.dtype}; only truth values, integers and floats are allowed")


def refuse_kind(value: object, wanted: str) -> NoReturn:
    """Refuse a value where another kind is wanted."""
    raise Refusal("types", f"expected {wanted}, got {_article(kind_of(value))}")


def _article(kind: str) -> str:
    if kind in ("None", "text", "observations"):
        return kind
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"
