"""Programs that a language model wrote, run as what they are: hostile until shown otherwise.

In: source text, functions it may call and variables it starts with. Out: the value it returned and its variables, or a
``SandboxError`` naming the line and the rule it broke.

The source is parsed to a syntax tree, everything outside a small language is refused before anything runs, and the
tree is interpreted here: Python never executes the program, so there is no frame, class or module it could reach. Every
value passes through a ``voxposer.sandbox.guard.Guard``, every function and method is one of
``voxposer.sandbox.vocabulary``'s or the host's, and steps, calls, time, memory, sizes and nesting are bounded.

The language: assignment (also to several names, and to places in arrays, lists and dictionaries), arithmetic,
comparisons, and/or/not, conditional expressions, if, for, while, break, continue, pass, return, lists, tuples,
dictionaries, list comprehensions, f-strings with plain formats, indexing and slicing, fields of observations, calls.
"""

from __future__ import annotations

import ast
import difflib
import enum
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from voxposer.sandbox import indexing, vocabulary
from voxposer.sandbox.guard import Budget, DType, Guard, HostFault, Limits, Opaque, Record, RecordList, Refusal, kind_of

__all__ = [
    "RULES",
    "Budget",
    "HostFault",
    "Limits",
    "Opaque",
    "Outcome",
    "Program",
    "Record",
    "RecordList",
    "SandboxError",
    "parse",
]

RULES: Mapping[str, str] = MappingProxyType(
    {
        "syntax": "the source is Python of the small language",
        "imports": "nothing is imported; what a program needs is there",
        "definitions": "no functions, lambdas or classes",
        "underscores": "no names that start with an underscore",
        "formats": "f-strings hold values and plain number formats",
        "names": "a name is a variable, a given function or one of the vocabulary's",
        "attributes": "attributes are an observation's fields, or an array's shape, ndim, size and T, and only read",
        "functions": "functions are called by their names and are no values",
        "values": "values are numbers, text, arrays of numbers, lists, tuples, dictionaries, observations and maps",
        "types": "operators and functions get values they are made for",
        "value": "operations have a result",
        "call": "a given function did what it was asked",
        "return": "a program that should return a value does",
        "nesting": "syntax, calls and lists nest a few levels",
        "size": "integers, text and lists are small",
        "memory": "arrays are of a map's size, a few at a time",
        "steps": "a program ends after a bounded number of steps",
        "calls": "a program calls the host a bounded number of times",
        "time": "a program ends after a bounded time",
    }
)


class SandboxError(ValueError):
    """A program that cannot be run, or not on.

    Attributes:
        line: line of the source, from 1.
        rule: the rule it breaks, a key of ``RULES``.
        reason: what was found and what would be right.
    """

    def __init__(self, line: int, rule: str, reason: str) -> None:
        super().__init__(f"line {line}: {reason} [rule: {rule}]")
        self.line, self.rule, self.reason = line, rule, reason


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a program left behind.

    Attributes:
        value: what it returned; None without a return.
        variables: its variables at the end.
    """

    value: Any
    variables: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program of the small language, ready to run any number of times.

    Attributes:
        source: its text.
        body: its statements.
        limits: what a run may use.
    """

    source: str
    body: Sequence[ast.stmt]
    limits: Limits

    def run(
        self,
        functions: Mapping[str, Callable[..., Any]],
        variables: Mapping[str, Any] | None = None,
        *,
        returns: str | None = None,
        budget: Budget | None = None,
    ) -> Outcome:
        """Run it.

        Args:
            functions: what it may call besides the vocabulary. What they return must be values a program may hold.
            variables: what it starts with.
            returns: an assignment to this name returns what is assigned, as upstream rewrites it to ``return``. A
                program that also reads the name gets it as a variable, whose last value is returned.
            budget: shared with the programs it runs on behalf of; a new one by default.

        Raises:
            SandboxError: it breaks a rule, or a given function raised; the function's error is the cause.
            HostFault: raised by a given function.
        """
        budget = budget or Budget(self.limits)
        with budget.clock(running=True), np.errstate(all="ignore"):
            return _Run(self, functions, dict(variables or {}), returns, Guard(budget)).outcome()


# The small language: nodes of the syntax tree that a program may contain.
_STATEMENTS = (ast.Assign, ast.AugAssign, ast.Expr, ast.If, ast.For, ast.While, ast.Return, ast.Pass)
_JUMPS = (ast.Break, ast.Continue)
_EXPRESSIONS = (
    *(ast.Constant, ast.Name, ast.Attribute, ast.Subscript, ast.Slice, ast.Call, ast.keyword),
    *(ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.IfExp),
    *(ast.List, ast.Tuple, ast.Dict, ast.ListComp, ast.comprehension, ast.JoinedStr, ast.FormattedValue),
)
_CONTEXTS = (ast.Load, ast.Store, ast.boolop, ast.cmpop, ast.unaryop)
_SYMBOLS: dict[type[ast.AST], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.FloorDiv: "//",
    ast.Mod: "%",
    ast.Pow: "**",
    ast.MatMult: "@",
    ast.BitAnd: "&",
    ast.BitOr: "|",
    ast.BitXor: "^",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Is: "is",
    ast.IsNot: "is not",
    ast.In: "in",
    ast.NotIn: "not in",
    ast.USub: "-",
    ast.UAdd: "+",
    ast.Invert: "~",
    ast.Not: "not",
}
_OPERATORS = tuple(_SYMBOLS)
_ALLOWED = _STATEMENTS + _JUMPS + _EXPRESSIONS + _CONTEXTS + _OPERATORS

_REFUSED: tuple[tuple[tuple[type[ast.AST], ...], str, str], ...] = (
    ((ast.Import, ast.ImportFrom), "imports", "an import statement; np and the given functions are there without"),
    (
        (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda, ast.arguments, ast.arg),
        "definitions",
        "a definition of a function or class; write the statements themselves",
    ),
    ((ast.GeneratorExp, ast.SetComp, ast.DictComp), "syntax", "only list comprehensions are allowed; put it in [ ]"),
    ((ast.Yield, ast.YieldFrom, ast.Await), "definitions", "a generator or coroutine"),
)

# A fill character is not allowed, and a width of two digits at most.
_FORMAT = re.compile(r"[<>^]?[+ ]?0?\d{0,2}(\.\d{1,2})?[dfegs%]?")
_STARRED = "a starred argument or item; write them out"


def parse(source: str, *, limits: Limits = Limits()) -> Program:  # noqa: B008  (frozen)
    """The program a source text says, checked to be of the small language.

    Raises:
        SandboxError: it is no Python, or more of it than is allowed.
    """
    if len(source) > limits.source_chars:
        raise SandboxError(1, "size", f"{len(source)} characters of source; {limits.source_chars} are allowed")
    tree = _tree(source)
    for node, line, depth in _walk(tree):
        if depth > limits.nesting:
            raise SandboxError(line, "nesting", f"syntax more than {limits.nesting} levels deep")
        try:
            _check(node)
        except Refusal as refusal:
            raise SandboxError(line, refusal.rule, refusal.reason) from None
    return Program(source=source, body=tuple(tree.body), limits=limits)


def _tree(source: str) -> ast.Module:
    try:
        return ast.parse(source)
    except SyntaxError as error:
        raise SandboxError(error.lineno or 1, "syntax", f"not Python: {error.msg}") from None
    except (RecursionError, MemoryError):  # Python's parser gives up on deep nesting with either
        raise SandboxError(1, "nesting", "syntax nested too deep to parse") from None
    except ValueError as error:  # NUL bytes and lone surrogates, by version of Python
        raise SandboxError(1, "syntax", f"not Python: {error}") from None


def _walk(tree: ast.Module) -> Iterator[tuple[ast.AST, int, int]]:
    """Nodes with their lines and depths, in the order of the source."""
    pending: list[tuple[ast.AST, int, int]] = [(node, 1, 1) for node in reversed(tree.body)]
    while pending:
        node, line, depth = pending.pop()
        line = getattr(node, "lineno", line)
        yield node, line, depth
        children = list(ast.iter_child_nodes(node))
        pending.extend((child, line, depth + 1) for child in reversed(children))


def _check(node: ast.AST) -> None:
    """Refuse a node that is not of the small language; its children are checked on their own."""
    for types, rule, reason in _REFUSED:
        if isinstance(node, types):
            raise Refusal(rule, reason)
    if isinstance(node, ast.Starred):
        raise Refusal("syntax", _STARRED)
    if not isinstance(node, _ALLOWED):
        raise Refusal("syntax", f"{_called(node)} is not part of the language")
    check = _CHECKS.get(type(node))
    if check is not None:
        check(node)


def _called(node: ast.AST) -> str:
    """What people call a kind of node: "an assert statement"."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(node).__name__).lower()
    return f"a '{words}'"


def _require_public(name: str) -> None:
    if name.startswith("_") and name != "_":
        raise Refusal("underscores", f"{name!r}: names that start with an underscore are out of reach")


def _check_constant(node: ast.Constant) -> None:
    value = node.value
    if value is not Ellipsis and not isinstance(value, (str, bool, int, float, type(None))):
        raise Refusal("values", f"{type(value).__name__} is no kind of value a program may hold")
    if isinstance(value, str) and any("\ud800" <= character <= "\udfff" or character == "\0" for character in value):
        raise Refusal("values", "text with characters that no encoding has")


def _check_call(node: ast.Call) -> None:
    if any(keyword.arg is None for keyword in node.keywords):
        raise Refusal("syntax", _STARRED)
    if not isinstance(node.func, (ast.Name, ast.Attribute)):
        raise Refusal("functions", "only functions and methods with a name can be called")


def _check_targets(targets: Iterable[ast.expr]) -> None:
    for target in targets:
        if isinstance(target, ast.Attribute):
            raise Refusal("attributes", f"attribute {target.attr!r} is assigned to; attributes are only read")
        if isinstance(target, ast.Starred):
            raise Refusal("syntax", _STARRED)


def _check_format(node: ast.FormattedValue) -> None:
    if node.conversion not in (-1, ord("s")):
        raise Refusal("formats", "a conversion in an f-string; write {value}")
    if node.format_spec is not None:
        values = node.format_spec.values if isinstance(node.format_spec, ast.JoinedStr) else [node.format_spec]
        parts = [value.value for value in values if isinstance(value, ast.Constant)]
        spec = "".join(str(part) for part in parts)
        if len(parts) < len(values) or not _FORMAT.fullmatch(spec):
            raise Refusal("formats", f"the format {spec!r} in an f-string; write one such as .2f or d")


def _check_comparison(node: ast.Compare) -> None:
    for operator, side in zip(node.ops, node.comparators, strict=True):
        if isinstance(operator, (ast.Is, ast.IsNot)) and not isinstance(side, ast.Constant):
            raise Refusal("syntax", "'is' compares with None, True and False only")


def _check_loop(node: ast.For | ast.While) -> None:
    if node.orelse:
        raise Refusal("syntax", "'else' after a loop is not part of the language")
    if isinstance(node, ast.For):
        _check_targets([node.target])


def _check_comprehension(node: ast.comprehension) -> None:
    if node.is_async:
        raise Refusal("definitions", "a generator or coroutine")
    _check_targets([node.target])


def _check_dict(node: ast.Dict) -> None:
    if any(key is None for key in node.keys):
        raise Refusal("syntax", _STARRED)


_CHECKS: dict[type[ast.AST], Callable[[Any], None]] = {
    ast.Name: lambda node: _require_public(node.id),
    ast.Attribute: lambda node: _require_public(node.attr),
    ast.keyword: lambda node: _require_public(node.arg or ""),
    ast.Constant: _check_constant,
    ast.Call: _check_call,
    ast.Assign: lambda node: _check_targets(node.targets),
    ast.AugAssign: lambda node: _check_targets([node.target]),
    ast.Tuple: lambda node: _check_targets(node.elts) if isinstance(node.ctx, ast.Store) else None,
    ast.List: lambda node: _check_targets(node.elts) if isinstance(node.ctx, ast.Store) else None,
    ast.FormattedValue: _check_format,
    ast.Compare: _check_comparison,
    ast.For: _check_loop,
    ast.While: _check_loop,
    ast.comprehension: _check_comprehension,
    ast.Dict: _check_dict,
}


class _Jump(enum.Enum):
    """How a statement ends other than by going on to the next."""

    BREAK = enum.auto()
    CONTINUE = enum.auto()
    RETURN = enum.auto()


# What NumPy and Python raise at values that do not fit, and the rule it is told as.
_FAILURES: tuple[tuple[tuple[type[Exception], ...], str], ...] = (
    ((MemoryError,), "memory"),
    ((RecursionError,), "nesting"),
    ((TypeError, AttributeError), "types"),
    ((ValueError, ArithmeticError, LookupError, BufferError), "value"),
)
_FAILURE_TYPES = tuple(kind for kinds, _ in _FAILURES for kind in kinds)


class _Run:
    """One run of a program: its variables and meters, and a method for each kind of node."""

    def __init__(
        self,
        program: Program,
        functions: Mapping[str, Callable[..., Any]],
        variables: dict[str, Any],
        returns: str | None,
        guard: Guard,
    ) -> None:
        self._program, self._functions, self._variables, self._guard = program, functions, variables, guard
        self._returns = returns
        self._returns_at_once = returns is not None and not _reads(program.body, returns)
        self._value: Any = None
        self._do: dict[type[ast.AST], Callable[[Any], _Jump | None]] = {
            ast.Assign: self._assign,
            ast.AugAssign: self._augment,
            ast.Expr: self._expression,
            ast.If: self._if,
            ast.For: self._for,
            ast.While: self._while,
            ast.Return: self._return,
            ast.Pass: lambda node: None,
            ast.Break: lambda node: _Jump.BREAK,
            ast.Continue: lambda node: _Jump.CONTINUE,
        }
        self._evaluate: dict[type[ast.AST], Callable[[Any], Any]] = {
            ast.Constant: lambda node: node.value,
            ast.Name: self._name,
            ast.Attribute: self._attribute,
            ast.Subscript: self._subscript,
            ast.Slice: self._slice,
            ast.Call: self._call,
            ast.BinOp: self._binary,
            ast.UnaryOp: self._unary,
            ast.BoolOp: self._boolean,
            ast.Compare: self._compare,
            ast.IfExp: self._conditional,
            ast.List: lambda node: guard.take([self._eval(item) for item in node.elts]),
            ast.Tuple: lambda node: guard.take(tuple(self._eval(item) for item in node.elts)),
            ast.Dict: self._dict,
            ast.ListComp: self._comprehension,
            ast.JoinedStr: self._joined,
        }

    def outcome(self) -> Outcome:
        """Run the program, once: the tables refer back to this run, which would keep its maps until the next cycle
        collection."""
        try:
            ended = self._block(self._program.body)
        finally:
            self._do, self._evaluate = {}, {}
        if ended is None and self._returns is not None:
            self._value = self._variables.get(self._returns)
        return Outcome(value=self._value, variables=MappingProxyType(self._variables))

    # Statements

    def _block(self, statements: Iterable[ast.stmt]) -> _Jump | None:
        for statement in statements:
            jump = self._located(self._do, statement)
            if jump is not None:
                return jump
        return None

    def _located(self, table: Mapping[type[ast.AST], Callable[[Any], Any]], node: ast.AST) -> Any:
        """A node's value or effect; what goes wrong is told with its line, the innermost node's first."""
        try:
            self._guard.budget.step()
            return table[type(node)](node)
        except Refusal as refusal:
            raise self._error(node, refusal.rule, refusal.reason) from refusal.__cause__
        except SandboxError:
            raise
        except _FAILURE_TYPES as error:
            rule = next(rule for kinds, rule in _FAILURES if isinstance(error, kinds))
            raise self._error(node, rule, _told(error)) from None

    def _error(self, node: ast.AST, rule: str, reason: str) -> SandboxError:
        line = getattr(node, "lineno", 1)
        return SandboxError(line, rule, f"{_excerpt(self._program.source, line)}: {reason}")

    def _expression(self, node: ast.Expr) -> None:
        self._eval(node.value)

    def _assign(self, node: ast.Assign) -> _Jump | None:
        value = self._eval(node.value)
        jumps = [self._store(target, value) for target in node.targets]
        return next((jump for jump in jumps if jump is not None), None)

    def _store(self, target: ast.expr, value: Any) -> _Jump | None:
        """Put a value in its place; tells if that is a return."""
        if isinstance(target, ast.Name):
            return self._bind(target.id, value)
        if isinstance(target, (ast.Tuple, ast.List)):
            return self._unpack(target.elts, value)
        assert isinstance(target, ast.Subscript)
        container = self._eval(target.value)
        indexing.assign(self._guard, container, self._eval(target.slice), value)
        return None

    def _bind(self, name: str, value: Any) -> _Jump | None:
        if name in _MODULE_NAMES:
            raise Refusal("names", f"{name!r} cannot be assigned to: it is part of the language")
        kind_of(value)
        self._variables[name] = value
        if name == self._returns and self._returns_at_once:
            self._value = value
            return _Jump.RETURN
        return None

    def _unpack(self, targets: Sequence[ast.expr], value: Any) -> _Jump | None:
        items = vocabulary.iterate(self._guard, value)
        if len(items) != len(targets):
            raise Refusal("value", f"{len(items)} values for {len(targets)} names")
        jumps = [self._store(target, item) for target, item in zip(targets, items, strict=True)]
        return next((jump for jump in jumps if jump is not None), None)

    def _augment(self, node: ast.AugAssign) -> _Jump | None:
        right, symbol = self._eval(node.value), _SYMBOLS[type(node.op)]
        if isinstance(node.target, ast.Name):
            changed = self._arithmetic(symbol, self._name(node.target), right, in_place=True)
            return self._bind(node.target.id, changed)
        assert isinstance(node.target, ast.Subscript)
        container, index = self._eval(node.target.value), self._eval(node.target.slice)
        old = indexing.subscript(self._guard, container, index)
        indexing.assign(self._guard, container, index, self._arithmetic(symbol, old, right, in_place=True))
        return None

    def _if(self, node: ast.If) -> _Jump | None:
        return self._block(node.body if self._true(node.test) else node.orelse)

    def _for(self, node: ast.For) -> _Jump | None:
        for item in vocabulary.iterate(self._guard, self._eval(node.iter)):
            self._guard.budget.step()
            jump = self._store(node.target, item) or self._block(node.body)
            if jump is _Jump.BREAK:
                return None
            if jump is _Jump.RETURN:
                return jump
        return None

    def _while(self, node: ast.While) -> _Jump | None:
        while self._true(node.test):
            jump = self._block(node.body)
            if jump is _Jump.BREAK:
                return None
            if jump is _Jump.RETURN:
                return jump
        return None

    def _return(self, node: ast.Return) -> _Jump:
        self._value = None if node.value is None else self._eval(node.value)
        return _Jump.RETURN

    # Expressions

    def _eval(self, node: ast.expr) -> Any:
        return self._located(self._evaluate, node)

    def _true(self, node: ast.expr) -> bool:
        return vocabulary.truth(self._guard, self._eval(node))

    def _name(self, node: ast.Name) -> Any:
        if node.id in self._variables:
            return self._variables[node.id]
        if node.id in vocabulary.DTYPES:
            return vocabulary.DTYPES[node.id]
        if node.id in self._functions or node.id in vocabulary.BUILTINS or node.id in _MODULE_NAMES:
            raise Refusal("functions", f"{node.id!r} is a function or module: it can be called, but is no value")
        raise self._unknown(node.id)

    def _unknown(self, name: str) -> Refusal:
        known = [*self._variables, *self._functions, *vocabulary.BUILTINS]
        near = difflib.get_close_matches(name, known, n=1)
        return Refusal("names", f"{name!r} is not known" + (f"; did you mean {near[0]!r}?" if near else ""))

    def _attribute(self, node: ast.Attribute) -> Any:
        dotted = self._of_numpy(node)
        if dotted is not None:
            return _numpy_value(dotted)
        value = self._eval(node.value)
        if isinstance(value, Record):
            return self._field(value, node.attr)
        if isinstance(value, np.ndarray) and node.attr in vocabulary.ATTRIBUTES:
            return vocabulary.ATTRIBUTES[node.attr](value)
        raise Refusal("attributes", f"{kind_of(value)} has no attribute {node.attr!r} to read")

    def _of_numpy(self, node: ast.Attribute) -> str | None:
        """``linalg.norm`` for ``np.linalg.norm``, None for what is not NumPy's."""
        names = [node.attr]
        base = node.value
        while isinstance(base, ast.Attribute):
            names.append(base.attr)
            base = base.value
        is_numpy = isinstance(base, ast.Name) and base.id in _MODULE_NAMES
        return ".".join(reversed(names)) if is_numpy else None

    def _field(self, record: Record, name: Any) -> Any:
        if not isinstance(name, str) or name.startswith("_"):
            raise Refusal("attributes", f"an observation's fields are named; {name!r} is none of them")
        try:
            return self._guard.host(f"the observation's {name}", record.__getitem__, name)
        except Refusal as refusal:
            if not isinstance(refusal.__cause__, KeyError):
                raise
        fields = self._guard.host("the observation", lambda: sorted(record.fields()))
        raise Refusal("attributes", f"the observation has no {name!r}; it has {', '.join(fields)}")

    def _subscript(self, node: ast.Subscript) -> Any:
        value, index = self._eval(node.value), self._eval(node.slice)
        return self._field(value, index) if isinstance(value, Record) else indexing.subscript(self._guard, value, index)

    def _slice(self, node: ast.Slice) -> slice:
        return slice(*(None if end is None else self._eval(end) for end in (node.lower, node.upper, node.step)))

    def _binary(self, node: ast.BinOp) -> Any:
        return self._arithmetic(_SYMBOLS[type(node.op)], self._eval(node.left), self._eval(node.right))

    def _arithmetic(self, symbol: str, left: Any, right: Any, in_place: bool = False) -> Any:
        made = vocabulary.arithmetic(self._guard, symbol, left, right, in_place)
        return made if made is left else self._guard.take(made)

    def _unary(self, node: ast.UnaryOp) -> Any:
        return self._guard.take(vocabulary.unary(self._guard, _SYMBOLS[type(node.op)], self._eval(node.operand)))

    def _boolean(self, node: ast.BoolOp) -> Any:
        ends_at = isinstance(node.op, ast.Or)
        for part in node.values[:-1]:
            value = self._eval(part)
            if vocabulary.truth(self._guard, value) == ends_at:
                return value
        return self._eval(node.values[-1])

    def _compare(self, node: ast.Compare) -> Any:
        left, result = self._eval(node.left), True
        for operator, side in zip(node.ops, node.comparators, strict=True):
            if result is not True and not vocabulary.truth(self._guard, result):
                return result
            right = self._eval(side)
            result = self._guard.take(vocabulary.compare(self._guard, _SYMBOLS[type(operator)], left, right))
            left = right
        return result

    def _conditional(self, node: ast.IfExp) -> Any:
        return self._eval(node.body if self._true(node.test) else node.orelse)

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        keys = [vocabulary.hashable(self._guard, self._eval(key)) for key in node.keys if key is not None]
        return self._guard.take(dict(zip(keys, [self._eval(value) for value in node.values], strict=True)))

    def _comprehension(self, node: ast.ListComp) -> list[Any]:
        outer = dict(self._variables)
        made: list[Any] = []
        self._collect(node, 0, made)
        self._variables.clear()
        self._variables.update(outer)
        return self._guard.take(made)

    def _collect(self, node: ast.ListComp, level: int, made: list[Any]) -> None:
        """Run the loops of a comprehension from one level on, adding to what it makes."""
        if level == len(node.generators):
            self._guard.length(len(made) + 1)
            made.append(self._eval(node.elt))
            return
        loop = node.generators[level]
        for item in vocabulary.iterate(self._guard, self._eval(loop.iter)):
            self._guard.budget.step()
            self._store(loop.target, item)
            if all(self._true(condition) for condition in loop.ifs):
                self._collect(node, level + 1, made)

    def _joined(self, node: ast.JoinedStr) -> str:
        return self._guard.take("".join(self._piece(part) for part in node.values))

    def _piece(self, part: ast.expr) -> str:
        if isinstance(part, ast.Constant):
            return str(part.value)
        assert isinstance(part, ast.FormattedValue)
        spec = part.format_spec.values[0] if isinstance(part.format_spec, ast.JoinedStr) else None
        plain = str(spec.value) if isinstance(spec, ast.Constant) else ""
        return vocabulary.text(self._guard, self._eval(part.value), plain)

    # Calls

    def _call(self, node: ast.Call) -> Any:
        function, before = self._function(node.func)
        arguments = [*before, *(self._eval(argument) for argument in node.args)]
        named = {keyword.arg or "": self._eval(keyword.value) for keyword in node.keywords}
        return function(*arguments, **named)

    def _function(self, node: ast.expr) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """The function to call, and what it gets before the arguments."""
        if isinstance(node, ast.Name):
            return self._named_function(node.id), ()
        assert isinstance(node, ast.Attribute)
        dotted = self._of_numpy(node)
        if dotted is not None:
            return self._numpy_function(dotted), ()
        value = self._eval(node.value)
        method = vocabulary.METHODS.get(kind_of(value), {}).get(node.attr)
        if method is None:
            raise Refusal("attributes", f"{kind_of(value)} has no method {node.attr!r} to call")
        return self._guarded(method), (value,)

    def _named_function(self, name: str) -> Callable[..., Any]:
        if name in self._variables:
            raise Refusal("functions", f"{name!r} is a {kind_of(self._variables[name])}, not a function")
        if name in self._functions:
            return self._of_host(name, self._functions[name])
        if name in vocabulary.BUILTINS:
            return self._guarded(vocabulary.BUILTINS[name])
        raise self._unknown(name)

    def _numpy_function(self, dotted: str) -> Callable[..., Any]:
        if dotted not in vocabulary.NUMPY:
            near = difflib.get_close_matches(dotted, vocabulary.NUMPY, n=1)
            hint = f"; did you mean np.{near[0]}?" if near else ""
            raise Refusal("names", f"np.{dotted} is not among the functions of NumPy that are allowed{hint}")
        return self._guarded(vocabulary.NUMPY[dotted])

    def _guarded(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *arguments, **named: self._guard.take_all(function(self._guard, *arguments, **named))

    def _of_host(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            self._guard.weigh([*arguments, *named.values()])
            return self._guard.host(name, function, *arguments, **named)

        return call


_MODULE_NAMES = frozenset({"np", "numpy"})


def _numpy_value(dotted: str) -> float | DType | None:
    if dotted in vocabulary.CONSTANTS:
        return vocabulary.CONSTANTS[dotted]
    if f"np.{dotted}" in vocabulary.DTYPES:
        return vocabulary.DTYPES[f"np.{dotted}"]
    if dotted in vocabulary.NUMPY:
        raise Refusal("functions", f"np.{dotted} is a function: it can be called, but is no value")
    raise Refusal("names", f"np.{dotted} is not among the parts of NumPy that are allowed")


def _reads(body: Iterable[ast.stmt], name: str) -> bool:
    """Whether statements read a variable anywhere; changing it in place reads it."""
    nodes = [node for statement in body for node in ast.walk(statement)]
    names = [node.target if isinstance(node, ast.AugAssign) else node for node in nodes]
    return any(
        isinstance(found, ast.Name) and found.id == name and (isinstance(found.ctx, ast.Load) or found is not node)
        for node, found in zip(nodes, names, strict=True)
    )


def _told(error: Exception) -> str:
    text = str(error) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]}..."


def _excerpt(source: str, line: int) -> str:
    """A line of the source, shortened."""
    lines = source.splitlines()
    text = lines[line - 1].strip() if 0 < line <= len(lines) else ""
    return f"`{text if len(text) <= 80 else text[:77] + '...'}`"
