"""Runs programs that a language model wrote, which are not trusted.

In: source text, functions it may call and variables it starts with. Out: the value it returned and its variables, or a
``SandboxError`` naming the line and the rule it broke.

The source is parsed to a syntax tree, everything outside the language is refused before anything runs
(``voxposer.sandbox.syntax``), and the tree is interpreted (``statements``, ``expressions``): Python never executes the
program, so there is no frame, class or module it could reach. Every value passes through a
``voxposer.sandbox.guard.Guard``, every function and method is the program's own, the host's or listed in
``voxposer.sandbox.vocabulary``, and steps, calls, time, memory, sizes and nesting are bounded.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from voxposer.sandbox.guard import Budget, Guard, Limits
from voxposer.sandbox.objects import Function, Module, Stream
from voxposer.sandbox.scopes import Scope
from voxposer.sandbox.statements import Returned, Statements
from voxposer.sandbox.syntax import checked_tree, reads


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a program left behind.

    Attributes:
        value: what it returned; None without a return.
        variables: its variables at the end, without functions, iterators and modules.
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
        at_once = returns is not None and not reads(self.body, returns)
        run = Statements(self.source, functions, Guard(budget), returns if at_once else None)
        scope = Scope(variables=dict(variables or {}))
        try:
            with budget.nested(), np.errstate(all="ignore"):
                ended = run.run(self.body, scope)
            left = {name: value for name, value in scope.variables.items() if not isinstance(value, _OF_A_RUN)}
        finally:
            run.close()
        last = None if returns is None else left.get(returns)
        return Outcome(value=ended.value if isinstance(ended, Returned) else last, variables=MappingProxyType(left))


# Values that mean nothing outside the run that made them.
_OF_A_RUN = (Function, Stream, Module)


def parse(source: str, *, limits: Limits = Limits()) -> Program:  # noqa: B008  (frozen)
    """The program of a source text, checked to be of the small language.

    Raises:
        SandboxError: it is not Python, or more of it than is allowed.
    """
    return Program(source=source, body=tuple(checked_tree(source, limits).body), limits=limits)
