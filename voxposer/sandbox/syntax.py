"""The small language: which syntax a program may contain, and the rules that a program can break.

In: source text. Out: a syntax tree in which every node is allowed, or a ``SandboxError`` that names the line and the
rule. Everything else is refused before anything runs.

The language is Python without classes, decorators, ``with``, ``match``, ``async``, shifts, complex numbers and bytes,
and with names instead of walks: attributes are read from observations, arrays, modules and errors alone, and imports
bring nothing but what programs may use anyway (``voxposer.sandbox.vocabulary``).
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

from voxposer.sandbox.guard import Limits, Refusal, shortened
from voxposer.sandbox.objects import Error

RULES: Mapping[str, str] = MappingProxyType(
    {
        "syntax": "the source is Python of the small language",
        "imports": "imports name modules whose functions programs have anyway: numpy, math and those of the prompts",
        "definitions": "no classes, decorators, coroutines or context managers",
        "underscores": "no attributes that start with an underscore, and no names that start with two",
        "formats": "formats are plain: a width and a precision of two digits at most, and no fields or indices",
        "names": "a name is a variable, a given function or one of the vocabulary's",
        "attributes": "attributes are an observation's fields, or an array's shape, ndim, size and T, and only read",
        "functions": "modules are no values, and only functions are called",
        "values": "values are numbers, text, arrays of numbers, lists, tuples, dictionaries, sets, functions, "
        "iterators, errors, types, observations and maps",
        "types": "operators and functions get values they are made for",
        "value": "operations have a result",
        "call": "a given function did what it was asked",
        "raised": "an error that the program raises is caught by it",
        "return": "a program that should return a value does",
        "nesting": "syntax, calls, generators and lists nest a few levels",
        "size": "integers, text and lists are small",
        "memory": "arrays are of a map's size, a few at a time",
        "steps": "a program ends after a bounded number of steps",
        "calls": "a program calls the host a bounded number of times",
        "time": "a program ends after a bounded time",
    }
)


# Characters of a reason, the excerpt of the source in it included.
_REASON = 900


class SandboxError(ValueError):
    """A program that cannot be run, or not on.

    Attributes:
        line: line of the source, from 1.
        rule: the rule it breaks, a key of ``RULES``.
        reason: what was found and what would be right.
        error: what the program itself may catch; None if it may not, as for limits.
    """

    def __init__(self, line: int, rule: str, reason: str, error: Error | None = None) -> None:
        reason = shortened(reason, _REASON)
        super().__init__(f"line {line}: {reason} [rule: {rule}]")
        self.line, self.rule, self.reason, self.error = line, rule, reason, error


# The small language: nodes of the syntax tree that a program may contain.
_STATEMENTS = (
    *(ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Expr, ast.If, ast.For, ast.While, ast.Return, ast.Pass, ast.Delete),
    *(ast.FunctionDef, ast.Try, ast.ExceptHandler, ast.Raise, ast.Assert, ast.Global, ast.Nonlocal),
    *(ast.Import, ast.ImportFrom, ast.alias, ast.Break, ast.Continue),
)
_EXPRESSIONS = (
    *(ast.Constant, ast.Name, ast.Attribute, ast.Subscript, ast.Slice, ast.Call, ast.keyword, ast.Starred),
    *(ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.IfExp, ast.NamedExpr, ast.Lambda, ast.arguments, ast.arg),
    *(ast.List, ast.Tuple, ast.Dict, ast.Set, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp),
    *(ast.comprehension, ast.JoinedStr, ast.FormattedValue, ast.Yield, ast.YieldFrom),
)
_CONTEXTS = (ast.Load, ast.Store, ast.Del, ast.boolop, ast.cmpop, ast.unaryop)
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
_ALLOWED = _STATEMENTS + _EXPRESSIONS + _CONTEXTS + _OPERATORS

_REFUSED: tuple[tuple[tuple[type[ast.AST], ...], str, str], ...] = (
    ((ast.ClassDef,), "definitions", "a class; write functions, and keep values in dictionaries"),
    ((ast.With,), "definitions", "a with statement; there is nothing to open or close here, so write its body alone"),
    (
        (ast.AsyncFunctionDef, ast.AsyncFor, ast.AsyncWith, ast.Await),
        "definitions",
        "a coroutine; nothing runs at the same time here, so write def, for and calls without async and await",
    ),
    ((ast.Match,), "syntax", "a match statement; write if, elif and else"),
    ((ast.TryStar,), "syntax", "except*; write except"),
    ((ast.LShift, ast.RShift), "syntax", "a shift of bits; multiply or divide by a power of two"),
)


def checked_tree(source: str, limits: Limits) -> ast.Module:
    """The syntax tree of a source text, checked to be of the small language.

    Raises:
        SandboxError: it is not Python, or more of it than is allowed.
    """
    if len(source) > limits.source_chars:
        raise SandboxError(1, "size", f"{len(source)} characters of source; {limits.source_chars} are allowed")
    _require_text(source)
    tree = _tree(source)
    yields = {id(node.value) for node in ast.walk(tree) if isinstance(node, (ast.Expr, ast.Assign, ast.AnnAssign))}
    for node, line, depth in _walk(tree):
        if depth > limits.nesting:
            raise SandboxError(line, "nesting", f"syntax more than {limits.nesting} levels deep")
        try:
            _check(node)
            if isinstance(node, (ast.Yield, ast.YieldFrom)) and id(node) not in yields:
                raise Refusal("syntax", "a yield inside an expression; write it as a statement of its own")
        except Refusal as refusal:
            raise SandboxError(line, refusal.rule, refusal.reason) from None
    _check_places(tree.body, in_function=False, in_loop=False)
    return tree


def reads(body: Iterable[ast.stmt], name: str) -> bool:
    """Whether statements read a variable anywhere; changing it in place reads it."""
    nodes = [node for statement in body for node in ast.walk(statement)]
    names = [node.target if isinstance(node, ast.AugAssign) else node for node in nodes]
    return any(
        isinstance(found, ast.Name) and found.id == name and (isinstance(found.ctx, ast.Load) or found is not node)
        for node, found in zip(nodes, names, strict=True)
    )


def _require_text(source: str) -> None:
    """Refuse characters that no file has, of which versions of Python think differently."""
    for place, character in enumerate(source):
        if character == "\0" or "\ud800" <= character <= "\udfff":
            line = len(re.findall(r"\r\n|\r|\n", source[:place])) + 1
            raise SandboxError(line, "syntax", f"not Python: U+{ord(character):04X} is not a character of text")


def _tree(source: str) -> ast.Module:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of escapes that Python does not know, such as \d
            return ast.parse(source)
    except SyntaxError as error:
        raise SandboxError(error.lineno or 1, "syntax", f"not Python: {error.msg}") from None
    except (RecursionError, MemoryError):  # Python's parser gives up on deep nesting with either
        raise SandboxError(1, "nesting", "syntax nested too deep to parse") from None
    except ValueError as error:
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
    if not isinstance(node, _ALLOWED):
        raise Refusal("syntax", f"{_called(node)} is not part of the language")
    check = _CHECKS.get(type(node))
    if check is not None:
        check(node)


def _called(node: ast.AST) -> str:
    """What people call a kind of node: "an assert statement"."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(node).__name__).lower()
    return f"a '{words}'"


def _check_places(body: Iterable[ast.AST], *, in_function: bool, in_loop: bool) -> None:
    """Refuse yield outside functions, nonlocal at the top, and break and continue outside loops."""
    for node in body:
        if isinstance(node, (ast.Break, ast.Continue)) and not in_loop:
            raise SandboxError(node.lineno, "syntax", f"'{type(node).__name__.lower()}' outside a loop")
        if isinstance(node, (ast.Yield, ast.YieldFrom, ast.Nonlocal)) and not in_function:
            raise SandboxError(node.lineno, "syntax", f"'{type(node).__name__.lower()}' outside a function")
        if isinstance(node, ast.FunctionDef):
            _check_places(node.body, in_function=True, in_loop=False)
        elif isinstance(node, ast.Lambda):
            _check_places([node.body], in_function=False, in_loop=False)
        elif isinstance(node, (ast.For, ast.While)):
            _check_places(node.body, in_function=in_function, in_loop=True)
            _check_places(node.orelse, in_function=in_function, in_loop=in_loop)
        else:
            _check_places(ast.iter_child_nodes(node), in_function=in_function, in_loop=in_loop)


def _require_public(name: str) -> None:
    """Refuse an attribute, or a keyword of a given function, that starts with an underscore."""
    if name.startswith("_") and name != "_":
        raise Refusal("underscores", f"{name!r}: attributes that start with an underscore are out of reach")


def _require_plain(*names: str | None) -> None:
    """Refuse a name that starts with two underscores: Python's own."""
    for name in names:
        if name is not None and name.startswith("__"):
            raise Refusal("underscores", f"{name!r}: names that start with two underscores are out of reach")


def _check_constant(node: ast.Constant) -> None:
    value = node.value
    if value is not Ellipsis and not isinstance(value, (str, bool, int, float, type(None))):
        raise Refusal("values", f"{type(value).__name__} is not a kind of value that a program may hold")
    if type(value) is int and value.bit_length() > _CONSTANT_BITS:
        raise Refusal("size", f"an integer of {value.bit_length()} bits; {_CONSTANT_BITS} are allowed")
    if isinstance(value, str) and any("\ud800" <= character <= "\udfff" or character == "\0" for character in value):
        raise Refusal("values", "text with characters that no encoding has")


def _check_target(target: ast.expr) -> None:
    if isinstance(target, ast.Attribute):
        raise Refusal("attributes", f"attribute {target.attr!r} is assigned to; attributes are only read")
    if isinstance(target, ast.Starred):
        _check_target(target.value)


def _check_targets(targets: Iterable[ast.expr]) -> None:
    for target in targets:
        if isinstance(target, ast.Starred):
            raise Refusal("syntax", "a starred name by itself; write it in a list or tuple of names")
        _check_target(target)


def _check_group(node: ast.Tuple | ast.List) -> None:
    if not isinstance(node.ctx, ast.Store):
        return
    for target in node.elts:
        _check_target(target)
    if sum(isinstance(target, ast.Starred) for target in node.elts) > 1:
        raise Refusal("syntax", "two starred names; only one can take what is left")


def _check_comparison(node: ast.Compare) -> None:
    for operator, side in zip(node.ops, node.comparators, strict=True):
        if isinstance(operator, (ast.Is, ast.IsNot)) and not isinstance(side, ast.Constant):
            raise Refusal("syntax", "'is' compares with None, True and False only")


def _check_comprehension(node: ast.comprehension) -> None:
    if node.is_async:
        raise Refusal("definitions", "an asynchronous loop; write for without async")
    _check_targets([node.target])


def _check_function(node: ast.FunctionDef) -> None:
    _require_plain(node.name)
    if node.decorator_list:
        raise Refusal("definitions", "a decorator; call the function on the value instead")


def _check_arguments(node: ast.arguments) -> None:
    starred = [argument for argument in (node.vararg, node.kwarg) if argument is not None]
    names = [argument.arg for argument in (*node.posonlyargs, *node.args, *node.kwonlyargs, *starred)]
    if len(set(names)) < len(names):
        raise Refusal("syntax", "two parameters of one name")


def _check_lambda(node: ast.Lambda) -> None:
    if any(isinstance(inner, (ast.Yield, ast.YieldFrom)) for inner in ast.walk(node.body)):
        raise Refusal("syntax", "a yield in a lambda; write def")


def _check_names(node: ast.Global | ast.Nonlocal) -> None:
    _require_plain(*node.names)


# Bits of an integer that a source text holds.
_CONSTANT_BITS = 63

_CHECKS: dict[type[ast.AST], Callable[[Any], None]] = {
    ast.Name: lambda node: _require_plain(node.id),
    ast.Attribute: lambda node: _require_public(node.attr),
    ast.keyword: lambda node: _require_public(node.arg or ""),
    ast.arg: lambda node: _require_plain(node.arg),
    ast.arguments: _check_arguments,
    ast.alias: lambda node: _require_plain(node.asname),
    ast.ExceptHandler: lambda node: _require_plain(node.name),
    ast.Constant: _check_constant,
    ast.Assign: lambda node: _check_targets(node.targets),
    ast.AugAssign: lambda node: _check_targets([node.target]),
    ast.AnnAssign: lambda node: _check_targets([node.target]),
    ast.Delete: lambda node: _check_targets(node.targets),
    ast.For: lambda node: _check_targets([node.target]),
    ast.Tuple: _check_group,
    ast.List: _check_group,
    ast.Compare: _check_comparison,
    ast.comprehension: _check_comprehension,
    ast.FunctionDef: _check_function,
    ast.Lambda: _check_lambda,
    ast.Global: _check_names,
    ast.Nonlocal: _check_names,
}
