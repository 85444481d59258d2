"""Names of a program: which scope a name belongs to, as Python decides it, and what it stands for there.

In: the syntax of functions and comprehensions. Out: :class:`Scope`, which reads and writes variables by name.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from voxposer.sandbox.guard import Refusal
from voxposer.sandbox.objects import Error

_OWN_SCOPE = (ast.FunctionDef, ast.Lambda, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
Comprehension = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp


@dataclass(eq=False)
class Scope:
    """The variables of a program, of one call of a function, or of one comprehension.

    Attributes:
        parent: the scope around it, None for the program's.
        local: names that belong to it; None for the program's, to which every name may belong.
        from_program: names declared ``global``.
        from_outside: names declared ``nonlocal``.
        inline: whether it is a comprehension's, where ``:=`` binds outside.
        variables: its variables.
        handling: errors whose handlers are running, the latest last.
    """

    parent: Scope | None = None
    local: frozenset[str] | None = None
    from_program: frozenset[str] = frozenset()
    from_outside: frozenset[str] = frozenset()
    inline: bool = False
    variables: dict[str, Any] = field(default_factory=dict)
    handling: list[Error] = field(default_factory=list)

    def find(self, name: str) -> Scope | None:
        """The scope in which a name has a value, None where it has none.

        Raises:
            Refusal: the name belongs to a scope that has not assigned it yet.
        """
        if name in self.variables:
            return self
        scope: Scope | None = self
        while scope is not None:
            if name in scope.from_program:
                scope = scope.program
            if name in scope.variables:
                return scope
            if scope.local is not None and name in scope.local:
                raise Refusal(
                    "names",
                    f"{name!r} is read before this function assigns it; pass it as an argument, or declare it global",
                    UnboundLocalError,
                )
            scope = scope.parent
        return None

    def home(self, name: str) -> Scope:
        """The scope in which an assignment puts a name."""
        scope: Scope = self
        while scope.inline and name not in (scope.local or ()):
            assert scope.parent is not None
            scope = scope.parent
        if name in scope.from_program:
            return scope.program
        if name not in scope.from_outside:
            return scope
        outside = scope.parent
        while outside is not None and name not in (outside.local or ()):
            outside = outside.parent
        if outside is None:
            raise Refusal("names", f"no function around this one has {name!r}, which is declared nonlocal")
        return outside

    @property
    def program(self) -> Scope:
        """The program's scope."""
        scope = self
        while scope.parent is not None:
            scope = scope.parent
        return scope

    @property
    def latest_error(self) -> Error | None:
        """The error that is being handled here or around here, None for none."""
        scope: Scope | None = self
        while scope is not None:
            if scope.handling:
                return scope.handling[-1]
            scope = scope.parent
        return None


@dataclass(frozen=True)
class Names:
    """The names that a function binds, by where they belong."""

    local: frozenset[str]
    from_program: frozenset[str]
    from_outside: frozenset[str]


def names_of(arguments: ast.arguments, body: Iterable[ast.AST]) -> Names:
    """The names that a function binds: its parameters and everything that its body assigns."""
    from_program: set[str] = set()
    from_outside: set[str] = set()
    bound = {argument.arg for argument in all_arguments(arguments)}
    for node in _inside(body):
        if isinstance(node, ast.Global):
            from_program.update(node.names)
        elif isinstance(node, ast.Nonlocal):
            from_outside.update(node.names)
        else:
            bound.update(_bound_by(node))
    return Names(frozenset(bound - from_program - from_outside), frozenset(from_program), frozenset(from_outside))


def targets_of(node: Comprehension) -> frozenset[str]:
    """The names that the loops of a comprehension assign."""
    found = [name for loop in node.generators for name in ast.walk(loop.target)]
    return frozenset(name.id for name in found if isinstance(name, ast.Name))


def all_arguments(arguments: ast.arguments) -> list[ast.arg]:
    """Every parameter of a function, starred ones included."""
    starred = [argument for argument in (arguments.vararg, arguments.kwarg) if argument is not None]
    return [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, *starred]


def is_generator(body: Iterable[ast.AST]) -> bool:
    """Whether a function's body yields."""
    return any(isinstance(node, (ast.Yield, ast.YieldFrom)) for node in _inside(body))


def depth_of(body: Iterable[ast.stmt]) -> int:
    """How many levels of blocks statements have inside them."""
    blocks = [
        block for node in body for name in ("body", "orelse", "finalbody") if (block := getattr(node, name, None))
    ]
    blocks += [handler.body for node in body if isinstance(node, ast.Try) for handler in node.handlers]
    return max((1 + depth_of(block) for block in blocks if isinstance(block, list)), default=0)


def _inside(body: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """The nodes of a function's own scope: what nested functions contain is left out, what ``:=`` binds is not."""
    pending = list(body)
    while pending:
        node = pending.pop()
        yield node
        if isinstance(node, _OWN_SCOPE):
            if not isinstance(node, (ast.FunctionDef, ast.Lambda)):
                pending.extend(inner for inner in ast.walk(node) if isinstance(inner, ast.NamedExpr))
        else:
            pending.extend(ast.iter_child_nodes(node))


def _bound_by(node: ast.AST) -> Iterable[str]:
    """The names that one node binds in its scope."""
    if isinstance(node, ast.Name) and isinstance(node.ctx, (ast.Store, ast.Del)):
        return (node.id,)
    if isinstance(node, ast.FunctionDef):
        return (node.name,)
    if isinstance(node, ast.ExceptHandler) and node.name:
        return (node.name,)
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        return [(alias.asname or alias.name).split(".")[0] for alias in node.names]
    return ()
