"""The small language: which syntax a program may contain, and the rules that a program can break.

In: source text. Out: a syntax tree in which every node is allowed, or a ``SandboxError`` that names the line and the
rule. Everything else is refused before anything runs.

The language: assignment (also to several names, and to places in arrays, lists and dictionaries), arithmetic,
comparisons, and/or/not, conditional expressions, if, for, while, break, continue, pass, return, lists, tuples,
dictionaries, list comprehensions, f-strings with plain formats, indexing and slicing, fields of observations, calls.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

from voxposer.sandbox.guard import Limits, Refusal

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


# The small language: nodes of the syntax tree that a program may contain.
_STATEMENTS = (ast.Assign, ast.AugAssign, ast.Expr, ast.If, ast.For, ast.While, ast.Return, ast.Pass)
_JUMPS = (ast.Break, ast.Continue)
_EXPRESSIONS = (
    *(ast.Constant, ast.Name, ast.Attribute, ast.Subscript, ast.Slice, ast.Call, ast.keyword),
    *(ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.IfExp),
    *(ast.List, ast.Tuple, ast.Dict, ast.ListComp, ast.comprehension, ast.JoinedStr, ast.FormattedValue),
)
_CONTEXTS = (ast.Load, ast.Store, ast.boolop, ast.cmpop, ast.unaryop)
SYMBOLS: dict[type[ast.AST], str] = {
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
_OPERATORS = tuple(SYMBOLS)
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


def checked_tree(source: str, limits: Limits) -> ast.Module:
    """The syntax tree of a source text, checked to be of the small language.

    Raises:
        SandboxError: it is not Python, or more of it than is allowed.
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
    return tree


def reads(body: Iterable[ast.stmt], name: str) -> bool:
    """Whether statements read a variable anywhere; changing it in place reads it."""
    nodes = [node for statement in body for node in ast.walk(statement)]
    names = [node.target if isinstance(node, ast.AugAssign) else node for node in nodes]
    return any(
        isinstance(found, ast.Name) and found.id == name and (isinstance(found.ctx, ast.Load) or found is not node)
        for node, found in zip(nodes, names, strict=True)
    )


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
        raise Refusal("values", f"{type(value).__name__} is not a kind of value that a program may hold")
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
