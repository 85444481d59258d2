"""Idioms of the programs that language models write: each gives Python's result, or is refused in words that help."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from support.program_idioms import GIVEN, IDIOMS, REFUSED
from support.random_programs import program
from support.sandbox_runs import refusal, run, variables

from voxposer.sandbox.syntax import SandboxError


@pytest.mark.parametrize("name", IDIOMS)
def test_an_idiom_gives_pythons_result(name: str) -> None:
    expected: dict[str, Any] = {}
    exec(IDIOMS[name], expected, None)  # the oracle is Python itself
    found = variables(IDIOMS[name])
    data = {key: value for key, value in expected.items() if not _is_code(value) and not key.startswith("__")}
    shown = {key: value for key, value in found.items() if key in data}
    assert shown == data
    assert {key: type(value) for key, value in shown.items()} == {key: type(value) for key, value in data.items()}
    assert any(key in data for key in ("x", "log", "d", "a", "total", "low", "n", "xs"))


def _is_code(value: object) -> bool:
    if isinstance(value, (list, tuple)):
        return any(_is_code(item) for item in value)
    if isinstance(value, dict):
        return any(_is_code(item) for item in value.values())
    return callable(value) or hasattr(value, "__next__")


@pytest.mark.parametrize("name", GIVEN)
def test_an_idiom_over_observations_and_maps_gives_what_it_should(name: str) -> None:
    source, expected = GIVEN[name]
    assert variables(source)["x"] == expected


@pytest.mark.parametrize("name", REFUSED)
def test_a_refused_idiom_says_what_to_write_instead(name: str) -> None:
    source, rule, words = REFUSED[name]
    error = refusal(source)
    assert error.rule == rule
    assert words in error.reason


def test_random_programs_end_as_in_python() -> None:
    """Where Python gives a result, so does the sandbox, and where Python raises, it refuses; limits aside."""
    compared = 0
    for seed in range(400):
        source = program(seed)
        expected: dict[str, Any] = {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python warns of comparisons and calls that such programs make
            raised = _raised(source, expected)
        try:
            found = run(source)
        except SandboxError as error:
            if error.rule in ("size", "memory", "steps", "nesting"):
                continue
            refused = error.error and error.error.python
            found = None
        else:
            refused = None
        assert (refused is None) == (raised is None), (source, refused, raised)
        if refused is not None and raised is not None:
            assert issubclass(refused, raised) or issubclass(raised, refused), (source, refused, raised)
        for name in () if found is None else ("a", "b", "c", "log"):
            assert found is not None
            assert repr(found.variables.get(name)) == repr(expected.get(name)), source
        compared += 1
    assert compared > 350


def _raised(source: str, variables: dict[str, Any]) -> type[BaseException] | None:
    """The class of the error with which Python ends a program, None for none."""
    try:
        exec(source, variables)
    except Exception as error:
        return type(error)
    return None


def test_functions_of_a_program_end_with_it() -> None:
    assert dict(variables("f = lambda: 1\ng = (v for v in [1])\nimport math as m\nx = f()")) == {"x": 1}
    kept = variables("fs = [lambda: 1]")["fs"]
    assert refusal("x = fs[0]()", variables={"fs": kept}).rule == "functions"


def test_a_programs_maps_are_released_with_it() -> None:
    import gc
    import weakref

    class Map(np.ndarray):
        pass

    made: list[weakref.ref[np.ndarray]] = []

    def get_map() -> np.ndarray:
        value = np.zeros((10, 10, 10))
        made.append(weakref.ref(value))
        return value

    from voxposer.sandbox.interpreter import parse

    source = (
        "m = get_map()\ndef f():\n    k = get_map()\n    g = lambda: (k, m)\n    return g\nh = f()\nx = h()[0].sum()"
    )
    gc.disable()
    try:
        parse(source).run({"get_map": get_map}, returns="ret_val")
        assert len(made) == 2
        assert [reference() is None for reference in made] == [True, True]
    finally:
        gc.enable()
