"""Random programs of everything that the sandbox allows, with hostile numbers, for hypothesis.

Every statement and expression of the grammar is drawn, and functions and methods come from the tables of the sandbox
itself, so a name that is added there is tried here as well.
"""

from __future__ import annotations

from hypothesis import strategies as st

from voxposer.sandbox import vocabulary

_CONSTANTS = (
    *("0", "1", "-1", "2", "3", "9999", "10 ** 9", "2 ** 62", "-2 ** 62", "1.5", "-0.0", "1e300", "1e-320", "0.1"),
    *("np.inf", "-np.inf", "np.nan", "True", "False", "None", "...", "''", "'a'", "'{}'", "'%s'", "'a' * 9999"),
    *("[]", "()", "{}", "set()", "[0]", "(0,)", "{0: 0}", "{0}", "[[0], [1, 2]]", "[None]", "range(3)", "[x, x]"),
    *("range(10 ** 9)", "np.zeros(3)", "np.zeros((0, 9))", "np.ones((3, 3))", "np.arange(9) > 4", "get_map()"),
    *("np.array(5)", "[0] * 9999", "np.ones(10 ** 6)", "np.float32(1)", "np.int64(7)", "detect('bowl')", "detect"),
    *("np.sum", "int", "ValueError", "ValueError('x')", "iter([1, 2])", "(v for v in [1])", "(lambda *p, **q: p)"),
    *("'\\u2028'", "'\\x0c'"),
)
_NAMES = ("x", "y", "z", "f")
_BINARY = ("+", "-", "*", "/", "//", "%", "**", "@", "&", "|", "^", "==", "!=", "<", "<=", ">", ">=", "in", "not in")
_METHODS = sorted({name for table in vocabulary.METHODS.values() for name in table})
_FUNCTIONS = (
    *sorted(vocabulary.BUILTINS),
    *(f"np.{name}" for name in sorted(vocabulary.NUMPY)),
    *(f"math.{name}" for name in sorted(vocabulary.MATH)),
    *("detect", "get_map", "cm2index", "f", "int", "float", "bool", "np.float32", "np.bool_", "ValueError", "KeyError"),
)
_KEYWORDS = ("axis", "key", "default", "keepdims", "dtype", "reverse", "start", "strict", "sep", "shape", "x", "guard")
_FORMATS = ("", ":>9", ":.2f", "!r", ":d", "!s:<5", ":{y}", ":99")


def _expressions(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    index = st.one_of(inner, st.tuples(inner, inner).map("{0[0]}:{0[1]}".format), st.just("..."), st.just("None, :"))
    arguments = st.lists(st.one_of(inner, inner.map("*({})".format)), max_size=3).map(", ".join)
    named = st.one_of(st.just(""), st.tuples(st.sampled_from(_KEYWORDS), inner).map(", {0[0]}={0[1]}".format))
    call = st.tuples(arguments, named).map(lambda parts: "".join(parts).removeprefix(", "))
    return st.one_of(
        st.tuples(inner, st.sampled_from(_BINARY), inner).map("({0[0]} {0[1]} {0[2]})".format),
        st.tuples(st.sampled_from(("-", "+", "~", "not ")), inner).map("({0[0]}{0[1]})".format),
        st.tuples(st.sampled_from(_FUNCTIONS), call).map("{0[0]}({0[1]})".format),
        st.tuples(inner, st.sampled_from(_METHODS), call).map("({0[0]}).{0[1]}({0[2]})".format),
        st.tuples(inner, index).map("({0[0]})[{0[1]}]".format),
        st.tuples(inner, inner, inner).map("({0[0]} if {0[1]} else {0[2]})".format),
        st.tuples(inner, st.sampled_from(("and", "or")), inner).map("({0[0]} {0[1]} {0[2]})".format),
        st.lists(inner, max_size=3).map(lambda items: f"[{', '.join(items)}]"),
        st.lists(inner, max_size=3).map(lambda items: f"({''.join(item + ', ' for item in items)})"),
        st.tuples(inner, inner).map("{{{0[0]}: {0[1]}}}".format),
        inner.map("{{{}}}".format),
        st.tuples(inner, inner, inner).map("[{0[0]} for x in {0[1]} if {0[2]}]".format),
        st.tuples(inner, inner).map("{{x: {0[0]} for x in {0[1]}}}".format),
        st.tuples(inner, inner).map("list({0[0]} for x in {0[1]})".format),
        st.tuples(inner, inner).map("(lambda x={0[0]}: {0[1]})".format),
        inner.map("(y := {})".format),
        st.tuples(inner, st.sampled_from(_FORMATS)).map(lambda pair: f"f'{{({_quoted(pair[0])}){pair[1]}}}'"),
        st.tuples(inner, inner).map("'{{}} {{!r}}'.format({0[0]}, {0[1]})".format),
        st.tuples(inner, st.sampled_from(("shape", "T", "size", "position", "args", "real", "x"))).map(
            "({0[0]}).{0[1]}".format
        ),
    )


def _quoted(expression: str) -> str:
    """An expression that fits into an f-string between single quotes."""
    return expression if "'" not in expression and "\\" not in expression else "x"


EXPRESSIONS = st.recursive(st.sampled_from((*_CONSTANTS, *_NAMES)), _expressions, max_leaves=8)
_TARGETS = st.sampled_from(("x", "y", "x, y", "x, *y", "x[0]", "y[...]", "z['a']", "(x, [y, z])", "x[1:]"))


_OTHERS = ("del x", "del x[0]", "pass", "global x", "import math as m", "from math import pi as y", "raise")


def _simple() -> st.SearchStrategy[list[str]]:
    return st.one_of(
        st.tuples(_TARGETS, EXPRESSIONS).map(lambda pair: [f"{pair[0]} = {pair[1]}"]),
        st.tuples(st.sampled_from(_NAMES), st.sampled_from("+-*/%&|@"), EXPRESSIONS).map(
            lambda parts: [f"{parts[0]} {parts[1]}= {parts[2]}"]
        ),
        EXPRESSIONS.map(lambda made: [made]),
        EXPRESSIONS.map(lambda made: [f"assert {made}"]),
        EXPRESSIONS.map(lambda made: [f"raise ValueError({made})"]),
        st.sampled_from(_OTHERS).map(lambda made: [made]),
    )


def _indented(lines: list[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _compound(inner: st.SearchStrategy[list[str]]) -> st.SearchStrategy[list[str]]:
    block = st.lists(inner, min_size=1, max_size=3).map(
        lambda parts: _indented([line for part in parts for line in part])
    )
    return st.one_of(
        st.tuples(EXPRESSIONS, block, block).map(lambda p: [f"if {p[0]}:", *p[1], "else:", *p[2]]),
        st.tuples(_TARGETS, EXPRESSIONS, block).map(lambda p: [f"for {p[0]} in {p[1]}:", *p[2]]),
        st.tuples(EXPRESSIONS, block).map(lambda p: [f"while {p[0]}:", *p[1]]),
        st.tuples(block, block, block).map(
            lambda p: ["try:", *p[0], "except Exception as z:", *p[1], "finally:", *p[2]]
        ),
        st.tuples(block, EXPRESSIONS).map(lambda p: ["def f(x=0, *y, **z):", *p[0], f"    return {p[1]}"]),
        st.tuples(block, EXPRESSIONS).map(lambda p: ["def f(x=1):", *p[0], f"    yield {p[1]}", "    yield from f(x)"]),
    )


def _guarded(lines: list[str]) -> list[str]:
    """A statement whose error does not keep the next one from being run."""
    return ["try:", *_indented(lines), "except Exception as z:", "    pass"]


# So that the names in a program have values, at first.
_HEAD = "x, y, z = [1, 2, 3], np.arange(4), {'a': 1}\ndef f(*p, **q): return p\n"
PROGRAMS = st.lists(st.recursive(_simple(), _compound, max_leaves=6), min_size=1, max_size=6).map(
    lambda parts: _HEAD + "\n".join(line for part in parts for line in _guarded(part))
)
