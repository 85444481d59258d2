"""Statements of a program, and its functions: what runs, in which scope, and how it ends.

In: nodes that ``voxposer.sandbox.syntax`` has checked. Out: what a program or one of its functions returns. Blocks are
Python generators, so that a function of a program can stop at a ``yield`` and go on later.

An error that a program may catch carries its class (``SandboxError.error``). One without, a limit for example, passes
every ``except`` and every ``finally``: nothing of the program runs after it. Nor does the ``finally`` of a generator
that is not run to its end, which in Python the garbage collector runs.
"""

from __future__ import annotations

import ast
import enum
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from voxposer.sandbox import formatting, indexing, modules, values
from voxposer.sandbox.expressions import Expressions
from voxposer.sandbox.guard import ITEM_BYTES, Guard, Refusal, kind_of
from voxposer.sandbox.iteration import stream
from voxposer.sandbox.objects import ERRORS, Error, ErrorType, Function
from voxposer.sandbox.scopes import Names, Scope, depth_of, is_generator, names_of
from voxposer.sandbox.syntax import SYMBOLS, SandboxError
from voxposer.sandbox.values import APPENDED_BYTES, ENTRY_BYTES


class Jump(enum.Enum):
    """How a block ends in a loop, other than by continuing with the next statement."""

    BREAK = enum.auto()
    CONTINUE = enum.auto()


@dataclass(frozen=True)
class Returned:
    """A block ended with a return, of this value."""

    value: Any


End = Jump | Returned | None
# What a block yields are the values of yield statements.
Block = Generator[Any, None, End]

# Levels of depth that a call counts for, besides those of its blocks, and bytes of a generator for each.
_CALL_LEVELS, _LEVEL_BYTES = 3, 1000


class Statements(Expressions):
    """Runs statements.

    Args:
        source: text of the program, for messages.
        functions: the given functions.
        guard: meters of this run.
        returns: an assignment to this name in the program's own scope returns what is assigned; None for no name.
    """

    def __init__(
        self, source: str, functions: Mapping[str, Callable[..., Any]], guard: Guard, returns: str | None = None
    ) -> None:
        super().__init__(source, functions, guard)
        self._returns = returns
        self._definitions: dict[int, tuple[Names, int, bool]] = {}
        self._simple: dict[type[ast.AST], Callable[[Any, Scope], End]] = {
            ast.Assign: self._assign,
            ast.AnnAssign: self._annotated,
            ast.AugAssign: self._augment,
            ast.Expr: self._expression,
            ast.Return: self._return,
            ast.Delete: self._delete,
            ast.FunctionDef: self._define,
            ast.Raise: self._raise,
            ast.Assert: self._assert,
            ast.Import: self._import,
            ast.ImportFrom: self._import,
            ast.Pass: lambda node, scope: None,
            ast.Global: lambda node, scope: None,
            ast.Nonlocal: lambda node, scope: None,
            ast.Break: lambda node, scope: Jump.BREAK,
            ast.Continue: lambda node, scope: Jump.CONTINUE,
        }
        self._compound: dict[type[ast.AST], Callable[[Any, Scope], Block]] = {
            ast.If: self._if,
            ast.For: self._for,
            ast.While: self._while,
            ast.Try: self._try,
        }
        self._evaluate[ast.Lambda] = self._lambda

    def close(self) -> None:
        """Let go of the tables; functions of this run can no longer be called."""
        super().close()
        self._simple, self._compound, self._definitions = {}, {}, {}

    def run(self, body: Sequence[ast.stmt], scope: Scope) -> End:
        """Run the statements of a block to its end."""
        block = self.block(body, scope)
        try:
            next(block)
        except StopIteration as ended:
            return ended.value
        raise AssertionError("a block without yield has yielded")

    def block(self, statements: Iterable[ast.stmt], scope: Scope) -> Block:
        """Run statements; yields what their yield statements do, and returns how the block ended."""
        for statement in statements:
            try:
                self._guard.budget.step()
                if yielded := _yielded(statement):
                    ended = yield from self._yield(yielded, statement, scope)
                elif type(statement) in self._compound:
                    ended = yield from self._compound[type(statement)](statement, scope)
                else:
                    ended = self._simple[type(statement)](statement, scope)
            except Exception as error:
                raise self._located(statement, error) from error.__cause__
            if ended is not None:
                return ended
        return None

    # Simple statements

    def _expression(self, node: ast.Expr, scope: Scope) -> None:
        self.eval(node.value, scope)

    def _assign(self, node: ast.Assign, scope: Scope) -> End:
        return self._put(node.targets, self.eval(node.value, scope), scope)

    def _annotated(self, node: ast.AnnAssign, scope: Scope) -> End:
        return None if node.value is None else self._put([node.target], self.eval(node.value, scope), scope)

    def _put(self, targets: Sequence[ast.expr], value: object, scope: Scope) -> End:
        """Assign to targets; an assignment to the name that is returned ends the program."""
        for target in targets:
            self.store(target, value, scope)
        name = self._returns
        if name is None or scope.home(name).parent is not None or not any(_assigns(target, name) for target in targets):
            return None
        return Returned(scope.program.variables[name])

    def _augment(self, node: ast.AugAssign, scope: Scope) -> None:
        symbol = SYMBOLS[type(node.op)]
        if isinstance(node.target, ast.Name):
            old = self._name(node.target, scope)
            right = self.eval(node.value, scope)
            self.bind(node.target.id, self._arithmetic(symbol, old, right, in_place=True), scope)
            return
        assert isinstance(node.target, ast.Subscript)
        container, index = self.eval(node.target.value, scope), self.eval(node.target.slice, scope)
        old = indexing.subscript(self._guard, container, index)
        right = self.eval(node.value, scope)
        indexing.assign(self._guard, container, index, self._arithmetic(symbol, old, right, in_place=True))

    def _return(self, node: ast.Return, scope: Scope) -> Returned:
        return Returned(None if node.value is None else self.eval(node.value, scope))

    def _delete(self, node: ast.Delete, scope: Scope) -> None:
        for target in node.targets:
            if isinstance(target, ast.Name):
                home = scope.home(target.id)
                if target.id not in home.variables:
                    raise Refusal("names", f"{target.id!r} is not a variable that can be deleted")
                del home.variables[target.id]
            elif isinstance(target, ast.Subscript):
                indexing.delete(self._guard, self.eval(target.value, scope), self.eval(target.slice, scope))
            else:
                raise Refusal("syntax", "del takes names and places, one by one")

    def _import(self, node: ast.Import | ast.ImportFrom, scope: Scope) -> None:
        for name, value in modules.imported(node, self._functions).items():
            member = self._of_vocabulary(name, value) if callable(value) else value
            scope.home(name).variables[name] = member

    # Compound statements

    def _if(self, node: ast.If, scope: Scope) -> Block:
        return (yield from self.block(node.body if self._true(node.test, scope) else node.orelse, scope))

    def _for(self, node: ast.For, scope: Scope) -> Block:
        for item in values.iterate(self._guard, self.eval(node.iter, scope)):
            self._guard.budget.step()
            self.store(node.target, item, scope)
            if self._returns is not None and _assigns(node.target, self._returns) and scope.parent is None:
                return Returned(item)
            ended = yield from self.block(node.body, scope)
            if ended is Jump.BREAK:
                return None
            if isinstance(ended, Returned):
                return ended
        return (yield from self.block(node.orelse, scope))

    def _while(self, node: ast.While, scope: Scope) -> Block:
        while self._true(node.test, scope):
            ended = yield from self.block(node.body, scope)
            if ended is Jump.BREAK:
                return None
            if isinstance(ended, Returned):
                return ended
        return (yield from self.block(node.orelse, scope))

    def _try(self, node: ast.Try, scope: Scope) -> Block:
        ended, failure = yield from self._attempt(self.block(node.body, scope))
        if failure is None and ended is None:
            ended, failure = yield from self._attempt(self.block(node.orelse, scope))
        elif failure is not None:
            ended, failure = yield from self._attempt(self._handle(node, failure, scope))
        last = yield from self.block(node.finalbody, scope)
        if last is not None:
            return last
        if failure is not None:
            try:
                raise failure
            finally:
                failure = None  # an error that its own frame holds would keep the maps of the program
        return ended

    def _attempt(self, block: Block) -> Generator[Any, None, tuple[End, SandboxError | None]]:
        """How a block ended, and the error it ended with, if the program may catch it; others pass."""
        try:
            return (yield from block), None
        except SandboxError as error:
            if error.error is None:
                raise
            return None, error

    def _handle(self, node: ast.Try, failure: SandboxError, scope: Scope) -> Block:
        error = failure.error
        assert error is not None
        handler = next((each for each in node.handlers if self._catches(each, error, scope)), None)
        if handler is None:
            try:
                raise failure
            finally:
                del failure
        self._guard.take(error)
        scope.handling.append(error)
        if handler.name:
            self.bind(handler.name, error, scope)
        try:
            return (yield from self.block(handler.body, scope))
        finally:
            scope.handling.pop()
            if handler.name:
                scope.home(handler.name).variables.pop(handler.name, None)

    def _catches(self, handler: ast.ExceptHandler, error: Error, scope: Scope) -> bool:
        if handler.type is None:
            return True
        kinds = self.eval(handler.type, scope)
        for kind in kinds if isinstance(kinds, tuple) else (kinds,):
            if not isinstance(kind, ErrorType):
                refusal = Refusal("types", f"except takes classes of errors: {', '.join(ERRORS)}")
                raise self._located(handler, refusal)
            if issubclass(error.python, kind.python) or kind.python is BaseException:
                return True
        return False

    def _raise(self, node: ast.Raise, scope: Scope) -> None:
        if node.cause is not None:
            self.eval(node.cause, scope)
        error = scope.latest_error if node.exc is None else self.eval(node.exc, scope)
        if error is None:
            raise Refusal("raised", "RuntimeError: raise without an error, outside an except", RuntimeError)
        if isinstance(error, ErrorType):
            error = Error(error.python, "")
        if not isinstance(error, Error):
            raise Refusal(
                "types", f"raise takes an error such as ValueError('...'), not a value of kind {kind_of(error)}"
            )
        raise Refusal("raised", f"{error.python.__name__}: {error.text}", error.python)

    def _assert(self, node: ast.Assert, scope: Scope) -> None:
        if self._true(node.test, scope):
            return
        text = "" if node.msg is None else formatting.text(self._guard, self.eval(node.msg, scope))
        raise Refusal("raised", f"AssertionError: {text or 'the condition does not hold'}", AssertionError)

    # Functions and generators

    def _yield(self, node: ast.Yield | ast.YieldFrom, statement: ast.stmt, scope: Scope) -> Block:
        if isinstance(node, ast.YieldFrom):
            for item in values.iterate(self._guard, self.eval(node.value, scope)):
                self._guard.budget.step()
                yield item
        else:
            yield None if node.value is None else self.eval(node.value, scope)
        if isinstance(statement, ast.Assign):
            self._put(statement.targets, None, scope)
        return None

    def _define(self, node: ast.FunctionDef, scope: Scope) -> None:
        self.bind(node.name, self._made(node.name, node.args, node.body, scope), scope)

    def _lambda(self, node: ast.Lambda, scope: Scope) -> Function:
        returned = ast.copy_location(ast.Return(value=node.body), node)
        return self._made("lambda", node.args, [returned], scope)

    def _made(self, name: str, arguments: ast.arguments, body: Sequence[ast.stmt], scope: Scope) -> Function:
        """A function, its default values evaluated."""
        defaults = [self.eval(default, scope) for default in arguments.defaults]
        named = [None if default is None else (self.eval(default, scope),) for default in arguments.kw_defaults]
        for default in (*defaults, *(given[0] for given in named if given)):
            kind_of(default)
        self._guard.hold((len(defaults) + len(named)) * APPENDED_BYTES)
        signature = _Signature(name, arguments, defaults, named)
        self._captured.append(scope)
        names, levels, yields = self._known(arguments, body)

        def call(*given: object, **options: object) -> Any:
            inner = self._inner(names, signature.bound(given, options), scope)
            if yields:
                self._captured.append(inner)
                self._guard.hold(levels * _LEVEL_BYTES)
                return self._guard.take(stream(self._guard, "generator", self._generated(body, inner), levels))
            budget, depth = self._guard.budget, self._guard.budget.depth
            try:
                budget.deeper(levels)
                ended = self.run(body, inner)
            finally:
                budget.depth = depth
            return ended.value if isinstance(ended, Returned) else None

        return self._guard.take(Function(name, call))

    def _known(self, arguments: ast.arguments, body: Sequence[ast.stmt]) -> tuple[Names, int, bool]:
        """The names that a function binds, the levels of a call, and whether it yields: once for each definition."""
        found = self._definitions.get(id(arguments))
        if found is None:
            found = names_of(arguments, body), _CALL_LEVELS + 2 * depth_of(body), is_generator(body)
            self._definitions[id(arguments)] = found
        return found

    def _inner(self, names: Names, bound: dict[str, Any], scope: Scope) -> Scope:
        """The scope of one call."""
        if not self._simple:
            raise Refusal("functions", "a function of a program that has ended")
        self._guard.hold(_SCOPE_BYTES + len(bound) * ITEM_BYTES)
        for value in bound.values():
            if isinstance(value, (tuple, dict)):  # of * and **, or given
                self._guard.hold(len(value) * (ENTRY_BYTES if isinstance(value, dict) else APPENDED_BYTES))
        return Scope(scope, names.local, names.from_program, names.from_outside, variables=bound)

    def _generated(self, body: Sequence[ast.stmt], scope: Scope) -> Iterator[Any]:
        yield from self.block(body, scope)


# Bytes counted for a call, besides its variables.
_SCOPE_BYTES = 700


@dataclass(frozen=True)
class _Signature:
    """The parameters of a function, and how arguments become them."""

    name: str
    arguments: ast.arguments
    defaults: Sequence[Any]
    named_defaults: Sequence[tuple[Any] | None]

    def bound(self, given: Sequence[object], options: Mapping[str, object]) -> dict[str, Any]:
        """The parameters by name.

        Raises:
            Refusal: arguments that do not fit.
        """
        spec = self.arguments
        places = [*spec.posonlyargs, *spec.args]
        bound: dict[str, Any] = {parameter.arg: value for parameter, value in zip(places, given, strict=False)}
        if len(given) > len(places) and spec.vararg is None:
            raise self._refused(f"takes {len(places)} arguments, and {len(given)} are given")
        if spec.vararg is not None:
            bound[spec.vararg.arg] = tuple(given[len(places) :])
        left = dict(options)
        for parameter in (*spec.args, *spec.kwonlyargs):
            if parameter.arg in left:
                if parameter.arg in bound:
                    raise self._refused(f"is given {parameter.arg!r} twice")
                bound[parameter.arg] = left.pop(parameter.arg)
        if spec.kwarg is not None:
            bound[spec.kwarg.arg] = left
        elif left:
            raise self._refused(f"has no parameter {next(iter(left))[:80]!r}")
        for parameter, default in zip(reversed(places), reversed(self.defaults), strict=False):
            bound.setdefault(parameter.arg, default)
        for parameter, default in zip(spec.kwonlyargs, self.named_defaults, strict=True):
            if default is not None:
                bound.setdefault(parameter.arg, default[0])
        missing = [p.arg for p in (*places, *spec.kwonlyargs) if p.arg not in bound]
        if missing:
            raise self._refused(f"is not given {', '.join(missing)}")
        return bound

    def _refused(self, reason: str) -> Refusal:
        return Refusal("types", f"{self.name}() {reason}")


def _yielded(statement: ast.stmt) -> ast.Yield | ast.YieldFrom | None:
    """The yield that a statement consists of, None for other statements."""
    value = statement.value if isinstance(statement, (ast.Expr, ast.Assign)) else None
    return value if isinstance(value, (ast.Yield, ast.YieldFrom)) else None


def _assigns(target: ast.expr, name: str) -> bool:
    """Whether a target is a name, or holds it."""
    if isinstance(target, ast.Starred):
        target = target.value
    if isinstance(target, (ast.Tuple, ast.List)):
        return any(_assigns(part, name) for part in target.elts)
    return isinstance(target, ast.Name) and target.id == name
