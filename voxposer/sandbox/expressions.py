"""Expressions of a program: a method for each kind of node, which gives its value in a scope.

In: nodes that ``voxposer.sandbox.syntax`` has checked, and the :class:`~voxposer.sandbox.scopes.Scope` they stand in.
Out: values that the guard has accepted, or a ``SandboxError`` with the line of the innermost node that failed.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from voxposer.sandbox import formatting, indexing, modules, operators, values, vocabulary
from voxposer.sandbox.guard import (
    Guard,
    HostFault,
    Opaque,
    Record,
    RecordList,
    Refusal,
    about_arguments,
    kind_of,
    shortened,
)
from voxposer.sandbox.iteration import stream
from voxposer.sandbox.modules import similar
from voxposer.sandbox.numpy_functions import grid
from voxposer.sandbox.objects import ERRORS, DType, Error, ErrorType, Function, Module, TypeName, error_class
from voxposer.sandbox.scopes import Comprehension, Scope, targets_of
from voxposer.sandbox.syntax import SYMBOLS, SandboxError

# What NumPy and Python raise at values that do not fit, and the rule that is reported.
_FAILURES: tuple[tuple[tuple[type[Exception], ...], str], ...] = (
    ((MemoryError,), "memory"),
    ((RecursionError,), "nesting"),
    ((TypeError, AttributeError), "types"),
    ((ValueError, ArithmeticError, LookupError, BufferError), "value"),
)
# Where Python's own lines end; other separators of text are not ends of lines to it.
_LINE_ENDS = re.compile(r"\r\n|\r|\n")


class Expressions:
    """Evaluates expressions; ``voxposer.sandbox.statements`` adds statements and functions.

    Args:
        source: text of the program, for messages.
        functions: the given functions.
        guard: meters of this run.
    """

    def __init__(self, source: str, functions: Mapping[str, Callable[..., Any]], guard: Guard) -> None:
        self._source, self._guard = source, guard
        self._captured: list[Scope] = []
        self._functions = {name: Function(name, self._of_host(name, call)) for name, call in functions.items()}
        self._evaluate: dict[type[ast.AST], Callable[[Any, Scope], Any]] = {
            ast.Constant: lambda node, scope: node.value,
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
            ast.NamedExpr: self._named,
            ast.List: self._list,
            ast.Tuple: self._tuple,
            ast.Set: self._set,
            ast.Dict: self._dict,
            ast.ListComp: self._list_comprehension,
            ast.SetComp: self._set_comprehension,
            ast.DictComp: self._dict_comprehension,
            ast.GeneratorExp: self._generator,
            ast.JoinedStr: self._joined,
            ast.Starred: self._starred,
        }

    def close(self) -> None:
        """Let go of the tables and of the variables that functions refer to: with them, a run's maps are released at
        once and not with the next collection of cycles."""
        self._evaluate, self._functions = {}, {}
        for scope in self._captured:
            scope.variables.clear()
        self._captured.clear()

    def eval(self, node: ast.expr, scope: Scope) -> Any:
        """The value of an expression."""
        budget = self._guard.budget
        try:
            budget.step()
            budget.deeper()
            return self._evaluate[type(node)](node, scope)
        except Exception as error:
            raise self._located(node, error) from error.__cause__
        finally:
            budget.depth -= 1

    def _located(self, node: ast.AST, error: Exception) -> Exception:
        """An error with the line and the rule; those that have them already, and faults of the host, as they are."""
        line = getattr(node, "lineno", 1)
        if isinstance(error, Refusal):
            caught = None if error.python is None else Error(error.python, _own_text(error.reason, error.python))
            return SandboxError(line, error.rule, f"{self._excerpt(line)}: {shortened(error.reason)}", caught)
        if isinstance(error, (SandboxError, HostFault)):
            return error
        rule = next((rule for kinds, rule in _FAILURES if isinstance(error, kinds)), "value")
        text, python = shortened(str(error) or type(error).__name__, 200), error_class(error)
        caught = None if python is None else Error(python, text)
        return SandboxError(line, rule, f"{self._excerpt(line)}: {text}", caught)

    def _excerpt(self, line: int) -> str:
        """A line of the source, shortened."""
        lines = _LINE_ENDS.split(self._source)
        return f"`{shortened(lines[line - 1], 80) if 0 < line <= len(lines) else ''}`"

    def _true(self, node: ast.expr, scope: Scope) -> bool:
        return values.truth(self._guard, self.eval(node, scope))

    # Names, attributes, places

    def _name(self, node: ast.Name, scope: Scope) -> Any:
        found = scope.find(node.id)
        return self._outside(node.id, scope) if found is None else found.variables[node.id]

    def _outside(self, name: str, scope: Scope) -> Any:
        """What a name stands for that is no variable: the given functions and the vocabulary."""
        if name in self._functions:
            return self._functions[name]
        if name in values.DTYPES:
            return values.DTYPES[name]
        if name in vocabulary.BUILTINS:
            return self._of_vocabulary(name, vocabulary.BUILTINS[name])
        if name in modules.BUILT_IN:
            return modules.BUILT_IN[name]
        if name in ERRORS:
            return ErrorType(ERRORS[name])
        near = similar(name, [*self._functions, *vocabulary.BUILTINS, *scope.program.variables, *scope.variables])
        hint = vocabulary.HINTS.get(name) or (f"; did you mean {near!r}?" if near else "")
        raise Refusal("names", f"{name[:80]!r} is not known{hint}")

    def _attribute(self, node: ast.Attribute, scope: Scope) -> Any:
        value = self.eval(node.value, scope)
        if isinstance(value, Module):
            return self._member(value, node.attr)
        if isinstance(value, Record):
            return self._field(value, node.attr)
        if isinstance(value, (np.ndarray, np.generic)) and node.attr in vocabulary.ATTRIBUTES:
            return vocabulary.ATTRIBUTES[node.attr](value)
        if isinstance(value, Error) and node.attr == "args":
            return (value.text,)
        if node.attr in vocabulary.METHODS.get(kind_of(value), {}):
            raise Refusal("functions", f"{node.attr!r} is a method: call it, as .{node.attr}()")
        raise Refusal("attributes", f"{kind_of(value)} has no attribute {node.attr!r} to read")

    def _member(self, module: Module, name: str) -> Any:
        found = modules.member(module, name, self._functions)
        return self._of_vocabulary(name, found) if callable(found) else found

    def _field(self, record: Record, name: object) -> Any:
        if not isinstance(name, str) or name.startswith("_"):
            shown = repr(name[:60]) if isinstance(name, str) else f"a value of kind {kind_of(name)}"
            raise Refusal("attributes", f"an observation's fields are named; {shown} is none of them")
        try:
            return self._guard.host(f"the observation's {name[:80]}", record.__getitem__, name)
        except Refusal as refusal:
            if not isinstance(refusal.__cause__, KeyError):
                raise
        fields = self._guard.host("the observation", lambda: sorted(record.fields()))
        raise Refusal("attributes", f"the observation has no {name[:80]!r}; it has {', '.join(fields)}")

    def _subscript(self, node: ast.Subscript, scope: Scope) -> Any:
        value, index = self.eval(node.value, scope), self.eval(node.slice, scope)
        if isinstance(value, Record):
            return self._field(value, index)
        if isinstance(value, Module) and value.name in ("numpy.mgrid", "numpy.ogrid"):
            return self._guard.take_all(grid(self._guard, index, sparse=value.name == "numpy.ogrid"))
        return indexing.subscript(self._guard, value, index)

    def _slice(self, node: ast.Slice, scope: Scope) -> slice:
        return slice(*(None if end is None else self.eval(end, scope) for end in (node.lower, node.upper, node.step)))

    # Operators

    def _binary(self, node: ast.BinOp, scope: Scope) -> Any:
        return self._arithmetic(SYMBOLS[type(node.op)], self.eval(node.left, scope), self.eval(node.right, scope))

    def _arithmetic(self, symbol: str, left: object, right: object, in_place: bool = False) -> Any:
        made = operators.arithmetic(self._guard, symbol, left, right, in_place)
        return made if made is left else self._guard.take(made)

    def _unary(self, node: ast.UnaryOp, scope: Scope) -> Any:
        made = operators.unary(self._guard, SYMBOLS[type(node.op)], self.eval(node.operand, scope))
        return self._guard.take(made)

    def _boolean(self, node: ast.BoolOp, scope: Scope) -> Any:
        ends_at = isinstance(node.op, ast.Or)
        for part in node.values[:-1]:
            value = self.eval(part, scope)
            if values.truth(self._guard, value) == ends_at:
                return value
        return self.eval(node.values[-1], scope)

    def _compare(self, node: ast.Compare, scope: Scope) -> Any:
        left, result = self.eval(node.left, scope), True
        for operator, side in zip(node.ops, node.comparators, strict=True):
            if result is not True and not values.truth(self._guard, result):
                return result
            right = self.eval(side, scope)
            result = self._guard.take(operators.compare(self._guard, SYMBOLS[type(operator)], left, right))
            left = right
        return result

    def _conditional(self, node: ast.IfExp, scope: Scope) -> Any:
        return self.eval(node.body if self._true(node.test, scope) else node.orelse, scope)

    def _named(self, node: ast.NamedExpr, scope: Scope) -> Any:
        value = self.eval(node.value, scope)
        self.bind(node.target.id, value, scope)
        return value

    def bind(self, name: str, value: object, scope: Scope) -> None:
        """Assign a value to a name."""
        if name in modules.BUILT_IN:
            raise Refusal("names", f"{name!r} cannot be assigned to: it is part of the language")
        kind_of(value)
        scope.home(name).variables[name] = value

    # Containers

    def _items(self, nodes: Sequence[ast.expr], scope: Scope) -> list[Any]:
        """The values of expressions in a row, starred ones taken apart."""
        made: list[Any] = []
        for node in nodes:
            if isinstance(node, ast.Starred):
                made.extend(values.listed(self._guard, self.eval(node.value, scope)))
                self._guard.length(len(made))
            else:
                made.append(self.eval(node, scope))
        return made

    def _starred(self, node: ast.Starred, scope: Scope) -> Any:
        raise Refusal("syntax", "a starred value outside a list, a tuple and the arguments of a call")

    def _list(self, node: ast.List, scope: Scope) -> list[Any]:
        return self._guard.take(self._items(node.elts, scope))

    def _tuple(self, node: ast.Tuple, scope: Scope) -> tuple[Any, ...]:
        return self._guard.take(tuple(self._items(node.elts, scope)))

    def _set(self, node: ast.Set, scope: Scope) -> set[Any]:
        return self._guard.take({values.hashable(self._guard, item) for item in self._items(node.elts, scope)})

    def _dict(self, node: ast.Dict, scope: Scope) -> dict[Any, Any]:
        made: dict[Any, Any] = {}
        for key, value in zip(node.keys, node.values, strict=True):
            if key is not None:
                made[values.hashable(self._guard, self.eval(key, scope))] = self.eval(value, scope)
                continue
            more = self.eval(value, scope)
            if not isinstance(more, dict):
                raise Refusal("types", f"** of a value of kind {kind_of(more)}; it takes a dictionary")
            self._guard.length(len(made) + len(more))
            made.update(more)
        return self._guard.take(made)

    def _list_comprehension(self, node: ast.ListComp, scope: Scope) -> list[Any]:
        made: list[Any] = []
        for inner in self._loops(node, scope):
            self._guard.length(len(made) + 1)
            made.append(self.eval(node.elt, inner))
        return self._guard.take(made)

    def _set_comprehension(self, node: ast.SetComp, scope: Scope) -> set[Any]:
        made: set[Any] = set()
        for inner in self._loops(node, scope):
            self._guard.length(len(made) + 1)
            made.add(values.hashable(self._guard, self.eval(node.elt, inner)))
        return self._guard.take(made)

    def _dict_comprehension(self, node: ast.DictComp, scope: Scope) -> dict[Any, Any]:
        made: dict[Any, Any] = {}
        for inner in self._loops(node, scope):
            self._guard.length(len(made) + 1)
            key = values.hashable(self._guard, self.eval(node.key, inner))
            made[key] = self.eval(node.value, inner)
        return self._guard.take(made)

    def _generator(self, node: ast.GeneratorExp, scope: Scope) -> Any:
        items = (self.eval(node.elt, inner) for inner in self._loops(node, scope))
        self._captured.append(scope)
        return self._guard.take(stream(self._guard, "generator", items))

    def _loops(self, node: Comprehension, scope: Scope) -> Iterator[Scope]:
        """The scope of a comprehension, once for each round of its loops; its first value is evaluated at once."""
        inner = Scope(parent=scope, local=targets_of(node), inline=True)
        first = values.iterate(self._guard, self.eval(node.generators[0].iter, scope))
        return self._rounds(node, 0, first, inner)

    def _rounds(self, node: Comprehension, level: int, items: Any, scope: Scope) -> Iterator[Scope]:
        loop = node.generators[level]
        for item in items:
            self._guard.budget.step()
            self.store(loop.target, item, scope)
            if not all(self._true(condition, scope) for condition in loop.ifs):
                continue
            if level + 1 == len(node.generators):
                yield scope
            else:
                more = values.iterate(self._guard, self.eval(node.generators[level + 1].iter, scope))
                yield from self._rounds(node, level + 1, more, scope)

    # Assignment to targets

    def store(self, target: ast.expr, value: object, scope: Scope) -> None:
        """Assign a value to a target: a name, a place, or several of them."""
        if isinstance(target, ast.Name):
            self.bind(target.id, value, scope)
        elif isinstance(target, (ast.Tuple, ast.List)):
            self._unpack(target.elts, value, scope)
        else:
            assert isinstance(target, ast.Subscript)
            container = self.eval(target.value, scope)
            kind_of(value)
            indexing.assign(self._guard, container, self.eval(target.slice, scope), value)

    def _unpack(self, targets: Sequence[ast.expr], value: object, scope: Scope) -> None:
        items = values.listed(self._guard, value)
        star = next((place for place, target in enumerate(targets) if isinstance(target, ast.Starred)), None)
        if star is None:
            if len(items) != len(targets):
                raise Refusal("value", f"{len(items)} values for {len(targets)} names")
            pairs = list(zip(targets, items, strict=True))
        else:
            after = len(targets) - star - 1
            if len(items) < star + after:
                raise Refusal("value", f"{len(items)} values for at least {star + after} names")
            starred = targets[star]
            assert isinstance(starred, ast.Starred)
            rest = self._guard.take(items[star : len(items) - after])
            pairs = [*zip(targets[:star], items[:star], strict=True), (starred.value, rest)]
            pairs += zip(targets[star + 1 :], items[len(items) - after :], strict=True)
        for target, item in pairs:
            self.store(target, item, scope)

    # Text

    def _joined(self, node: ast.JoinedStr, scope: Scope) -> str:
        pieces = [self._piece(part, scope) for part in node.values]
        self._guard.characters(sum(len(piece) for piece in pieces))
        return self._guard.take("".join(pieces))

    def _piece(self, part: ast.expr, scope: Scope) -> str:
        if isinstance(part, ast.Constant):
            return str(part.value)
        assert isinstance(part, ast.FormattedValue)
        value = self.eval(part.value, scope)
        spec = "" if part.format_spec is None else self.eval(part.format_spec, scope)
        return formatting.formatted(self._guard, value, spec, "" if part.conversion < 0 else chr(part.conversion))

    # Calls

    def _call(self, node: ast.Call, scope: Scope) -> Any:
        function = self._function(node.func, scope)
        arguments = self._items(node.args, scope)
        named: dict[str, Any] = {}
        for keyword in node.keywords:
            more = self.eval(keyword.value, scope)
            if keyword.arg is not None:
                more = {keyword.arg: more}
            elif not isinstance(more, dict) or not all(isinstance(name, str) for name in more):
                raise Refusal(
                    "types", f"** of a value of kind {kind_of(more)}; it takes a dictionary with text as keys"
                )
            if not more.keys().isdisjoint(named):
                raise Refusal("types", "the same argument is given twice")
            named.update(more)
        return function(*arguments, **named)

    def _function(self, node: ast.expr, scope: Scope) -> Callable[..., Any]:
        """What a call calls: a function, a method with its value put first, or a type."""
        if isinstance(node, ast.Attribute):
            value = self.eval(node.value, scope)
            if isinstance(value, Module):
                return self._callable(self._member(value, node.attr))
            method = vocabulary.METHODS.get(kind_of(value), {}).get(node.attr)
            if method is None:
                raise Refusal("attributes", f"{kind_of(value)} has no method {node.attr!r} to call")
            return self._vocabulary(node.attr, method, value)
        return self._callable(self.eval(node, scope), node.id if isinstance(node, ast.Name) else "")

    def _callable(self, value: object, name: str = "") -> Callable[..., Any]:
        if isinstance(value, Function):
            return value.call
        if isinstance(value, DType):
            return self._vocabulary(value.name, values.converted, value)
        if isinstance(value, ErrorType):
            return self._of_errors(value)
        if isinstance(value, (Record, RecordList)):  # upstream's are functions that give the present state
            return self._vocabulary("an observation", lambda guard: value)
        what = f"{name!r} is" if name else "this is"
        if isinstance(value, TypeName):
            raise Refusal("functions", f"{what} a type, which isinstance takes and which is not called", TypeError)
        hint = "; give the map itself to execute" if isinstance(value, Opaque) else ""
        raise Refusal("functions", f"{what} a value of kind {kind_of(value)}, not a function{hint}", TypeError)

    def _of_errors(self, kind: ErrorType) -> Callable[..., Error]:
        def make(*arguments: object, **named: object) -> Error:
            if named:
                raise Refusal("types", f"{kind.name}() takes no named arguments")
            text = ", ".join(formatting.text(self._guard, argument) for argument in arguments)
            return self._guard.take(Error(kind.python, shortened(text)))

        return make

    def _of_vocabulary(self, name: str, function: Callable[..., Any]) -> Function:
        return Function(name, self._vocabulary(name, function))

    def _vocabulary(self, name: str, function: Callable[..., Any], *first: object) -> Callable[..., Any]:
        """A function of the vocabulary as programs call it, with its first arguments given."""
        guard = self._guard

        def call(*arguments: object, **named: object) -> Any:
            try:
                made = function(guard, *first, *arguments, **named)
            except TypeError as error:
                told = about_arguments(name, str(error))
                if not told:
                    raise
                if "keyword argument" not in told:  # the numbers in it count what programs do not see
                    told = f"{name}() is given fewer or more arguments than it takes"
                raise Refusal("types", told, TypeError) from None
            return guard.take_all(made)

        return call

    def _of_host(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: object, **named: object) -> Any:
            given = [self._for_host(name, argument) for argument in arguments]
            options = {key: self._for_host(name, argument) for key, argument in named.items()}
            return self._guard.host(name, function, *given, **options)

        return call

    def _for_host(self, name: str, value: object) -> Any:
        """An argument of a given function: data alone, no more of it than a program may print or keep."""
        weight = self._guard.weigh(value)
        self._guard.characters(weight.characters)
        wrong = weight.kinds & {"function", "iterator", "error", "class of errors", "type"}
        if wrong:
            raise Refusal("types", f"{name}() takes values, not a {sorted(wrong)[0]}; give what it returns")
        if isinstance(value, (range, set)):
            return values.listed(self._guard, value)
        if "range" in weight.kinds:
            raise Refusal("types", f"{name}() takes numbers and lists of them; write list(range(...))")
        if not isinstance(value, np.ndarray):
            self._guard.room((weight.numbers,))
        return value


def _own_text(reason: str, python: type[BaseException]) -> str:
    """The message of an error as the program sees it: without the class that an uncaught error is reported with."""
    return reason.removeprefix(f"{python.__name__}: ")
