"""Runs programs that a language model wrote, which are not trusted.

In: source text, functions it may call and variables it starts with. Out: the value it returned and its variables, or a
``SandboxError`` naming the line and the rule it broke.

The source is parsed to a syntax tree, everything outside a small language is refused before anything runs
(``voxposer.sandbox.syntax``), and the tree is interpreted here: Python never executes the program, so there is no
frame, class or module it could reach. Every value passes through a ``voxposer.sandbox.guard.Guard``, every function and
method is the host's or listed in ``voxposer.sandbox.vocabulary``, and steps, calls, time, memory, sizes and nesting are
bounded.
"""

from __future__ import annotations

import ast
import difflib
import enum
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from voxposer.sandbox import indexing, operators, values, vocabulary
from voxposer.sandbox.guard import Budget, DType, Guard, Limits, Record, Refusal, kind_of
from voxposer.sandbox.syntax import SYMBOLS, SandboxError, checked_tree, reads


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


def parse(source: str, *, limits: Limits = Limits()) -> Program:  # noqa: B008  (frozen)
    """The program of a source text, checked to be of the small language.

    Raises:
        SandboxError: it is not Python, or more of it than is allowed.
    """
    return Program(source=source, body=tuple(checked_tree(source, limits).body), limits=limits)


class _Jump(enum.Enum):
    """How a statement ends, other than by continuing with the next."""

    BREAK = enum.auto()
    CONTINUE = enum.auto()
    RETURN = enum.auto()


# What NumPy and Python raise at values that do not fit, and the rule that is reported.
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
        self._returns_at_once = returns is not None and not reads(program.body, returns)
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
        """A node's value or effect; an error is reported with the line of the innermost node that failed."""
        try:
            self._guard.budget.step()
            return table[type(node)](node)
        except Refusal as refusal:
            raise self._error(node, refusal.rule, refusal.reason) from refusal.__cause__
        except SandboxError:
            raise
        except _FAILURE_TYPES as error:
            rule = next(rule for kinds, rule in _FAILURES if isinstance(error, kinds))
            raise self._error(node, rule, _message(error)) from None

    def _error(self, node: ast.AST, rule: str, reason: str) -> SandboxError:
        line = getattr(node, "lineno", 1)
        return SandboxError(line, rule, f"{_excerpt(self._program.source, line)}: {reason}")

    def _expression(self, node: ast.Expr) -> None:
        self._eval(node.value)

    def _assign(self, node: ast.Assign) -> _Jump | None:
        value = self._eval(node.value)
        jumps = [self._store(target, value) for target in node.targets]
        return next((jump for jump in jumps if jump is not None), None)

    def _store(self, target: ast.expr, value: object) -> _Jump | None:
        """Assign a value to a target; the jump that this causes, if any."""
        if isinstance(target, ast.Name):
            return self._bind(target.id, value)
        if isinstance(target, (ast.Tuple, ast.List)):
            return self._unpack(target.elts, value)
        assert isinstance(target, ast.Subscript)
        container = self._eval(target.value)
        indexing.assign(self._guard, container, self._eval(target.slice), value)
        return None

    def _bind(self, name: str, value: object) -> _Jump | None:
        if name in _MODULE_NAMES:
            raise Refusal("names", f"{name!r} cannot be assigned to: it is part of the language")
        kind_of(value)
        self._variables[name] = value
        if name == self._returns and self._returns_at_once:
            self._value = value
            return _Jump.RETURN
        return None

    def _unpack(self, targets: Sequence[ast.expr], value: object) -> _Jump | None:
        items = values.iterate(self._guard, value)
        if len(items) != len(targets):
            raise Refusal("value", f"{len(items)} values for {len(targets)} names")
        jumps = [self._store(target, item) for target, item in zip(targets, items, strict=True)]
        return next((jump for jump in jumps if jump is not None), None)

    def _augment(self, node: ast.AugAssign) -> _Jump | None:
        right, symbol = self._eval(node.value), SYMBOLS[type(node.op)]
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
        for item in values.iterate(self._guard, self._eval(node.iter)):
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
        return values.truth(self._guard, self._eval(node))

    def _name(self, node: ast.Name) -> Any:
        if node.id in self._variables:
            return self._variables[node.id]
        if node.id in values.DTYPES:
            return values.DTYPES[node.id]
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

    def _field(self, record: Record, name: object) -> Any:
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
        return self._arithmetic(SYMBOLS[type(node.op)], self._eval(node.left), self._eval(node.right))

    def _arithmetic(self, symbol: str, left: object, right: object, in_place: bool = False) -> Any:
        made = operators.arithmetic(self._guard, symbol, left, right, in_place)
        return made if made is left else self._guard.take(made)

    def _unary(self, node: ast.UnaryOp) -> Any:
        return self._guard.take(operators.unary(self._guard, SYMBOLS[type(node.op)], self._eval(node.operand)))

    def _boolean(self, node: ast.BoolOp) -> Any:
        ends_at = isinstance(node.op, ast.Or)
        for part in node.values[:-1]:
            value = self._eval(part)
            if values.truth(self._guard, value) == ends_at:
                return value
        return self._eval(node.values[-1])

    def _compare(self, node: ast.Compare) -> Any:
        left, result = self._eval(node.left), True
        for operator, side in zip(node.ops, node.comparators, strict=True):
            if result is not True and not values.truth(self._guard, result):
                return result
            right = self._eval(side)
            result = self._guard.take(operators.compare(self._guard, SYMBOLS[type(operator)], left, right))
            left = right
        return result

    def _conditional(self, node: ast.IfExp) -> Any:
        return self._eval(node.body if self._true(node.test) else node.orelse)

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        keys = [values.hashable(self._guard, self._eval(key)) for key in node.keys if key is not None]
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
        for item in values.iterate(self._guard, self._eval(loop.iter)):
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
        return values.text(self._guard, self._eval(part.value), plain)

    # Calls

    def _call(self, node: ast.Call) -> Any:
        function, before = self._function(node.func)
        arguments = [*before, *(self._eval(argument) for argument in node.args)]
        named = {keyword.arg or "": self._eval(keyword.value) for keyword in node.keywords}
        return function(*arguments, **named)

    def _function(self, node: ast.expr) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """The function to call, and arguments to insert before the given ones."""
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
        def call(*arguments: object, **named: object) -> Any:
            self._guard.weigh([*arguments, *named.values()])
            return self._guard.host(name, function, *arguments, **named)

        return call


_MODULE_NAMES = frozenset({"np", "numpy"})


def _numpy_value(dotted: str) -> float | DType | None:
    if dotted in vocabulary.CONSTANTS:
        return vocabulary.CONSTANTS[dotted]
    if f"np.{dotted}" in values.DTYPES:
        return values.DTYPES[f"np.{dotted}"]
    if dotted in vocabulary.NUMPY:
        raise Refusal("functions", f"np.{dotted} is a function: it can be called, but is no value")
    raise Refusal("names", f"np.{dotted} is not among the parts of NumPy that are allowed")


def _message(error: Exception) -> str:
    text = str(error) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]}..."


def _excerpt(source: str, line: int) -> str:
    """A line of the source, shortened."""
    lines = source.splitlines()
    text = lines[line - 1].strip() if 0 < line <= len(lines) else ""
    return f"`{text if len(text) <= 80 else text[:77] + '...'}`"
