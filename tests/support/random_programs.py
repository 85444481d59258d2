"""Random programs over functions, loops, errors, comprehensions, formats and generators, for comparison with Python."""

from __future__ import annotations

import random

_NAMES = ("a", "b", "c")
_ERRORS = ("ValueError", "(TypeError, KeyError)", "LookupError", "ZeroDivisionError", "Exception")
_LEAVES = ("a", "b", "c", "-2", "0", "1", "3", "'x'", "''", "[]", "[1, 2]", "(1,)", "{}", "None", "True", "1.5")
# Expressions over others, which stand where the braces are.
_FORMS = (
    *("({} + {})", "({} * {})", "({} - {})", "({} % {})", "({} if {} else {})", "({} < {} <= {})", "({} and {})"),
    *("({} or not {})", "[{}, {}]", "[v for v in [{}, {}] if v]", "(lambda q, r={}: [q, r])({})", "f({})", "len({})"),
    *(
        "str({})",
        "{{1: {}}}.get({}, {})",
        "[{}][{}]",
        "sum(w for w in [{}, {}])",
        "(*[{}], {})[-1]",
        "f'{{a}}-{{b!r:>5}}'",
    ),
    *("list(g(3))", "list(map(str, {}))", "sorted([{}, {}], key=str)"),
)
_HEAD = """\
log = []
a, b, c = 1, 'x', [1]
def g(n):
    for i in range(n):
        try:
            yield i
        finally:
            log.append(i)
def f(x):
    {}
"""


def program(seed: int) -> str:
    """A program that leaves the variables ``a``, ``b``, ``c`` and ``log``, or ends in an error."""
    draw = random.Random(seed)
    head = _HEAD.format(draw.choice(["global a", "log.append('f')"]))
    return head + "\n".join([*_block(draw, 1, 0, function=True), "    return x", *_block(draw, 0, 0)])


def _expression(draw: random.Random, depth: int = 0) -> str:
    if depth == 3 or draw.random() < 0.3:
        return draw.choice(_LEAVES)
    form = draw.choice(_FORMS)
    count = form.replace("{{", "").count("{}")
    return form.format(*(_expression(draw, depth + 1) for _ in range(count)))


def _block(draw: random.Random, indent: int, depth: int, *, loop: bool = False, function: bool = False) -> list[str]:
    return [
        line
        for _ in range(draw.randrange(1, 4))
        for line in _statement(draw, "    " * indent, indent, depth, loop=loop, function=function)
    ]


def _statement(draw: random.Random, space: str, indent: int, depth: int, *, loop: bool, function: bool) -> list[str]:
    def inner(in_loop: bool = loop) -> list[str]:
        return _block(draw, indent + 1, depth + 1, loop=in_loop, function=function)

    name, other, value = draw.choice(_NAMES), draw.choice(_NAMES), _expression(draw)
    simple = [f"{name} = {value}", f"{name} {draw.choice(['+=', '*=', '-='])} {value}", f"log.append({value})"]
    simple += [f"{name}, *{other} = {value}, {_expression(draw)}", f"if (n := {value}): log.append(n)"]
    simple += [f"assert {value}, 'no'", f"raise {draw.choice(['ValueError(1)', 'KeyError', 'TypeError(str(1))'])}"]
    simple += ["break", "continue"] if loop else []
    simple += [f"return {value}"] if function else []
    if depth == 2 or draw.random() < 0.6:
        return [space + draw.choice(simple)]
    kind = draw.choice(["if", "for", "try"])
    if kind == "if":
        return [f"{space}if {value}:", *inner(), f"{space}else:", *inner()]
    if kind == "for":
        return [f"{space}for {name} in range({draw.randrange(4)}):", *inner(True), f"{space}else:", *inner()]
    caught = [f"{space}except {draw.choice(_ERRORS)} as error:", *inner()]
    return [f"{space}try:", *inner(), *caught, f"{space}else:", *inner(), f"{space}finally:", *inner()]
