"""Programs written by a model: the honest ones run, the others end in an error that names line and rule."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.hostile_programs import HEAVY, HOSTILE
from support.paths import TESTS
from support.sandbox_runs import FUNCTIONS, refusal, run, variables

from voxposer.sandbox.guard import Budget, HostFault, Kept, Limits
from voxposer.sandbox.interpreter import parse
from voxposer.sandbox.syntax import RULES, SandboxError

# Hostile programs


@pytest.mark.parametrize(("rule", "line", "source"), HOSTILE, ids=[repr(source)[:60] for _, _, source in HOSTILE])
def test_a_hostile_program_ends_in_an_error_that_names_line_and_rule(rule: str, line: int, source: str) -> None:
    error = refusal(source)
    assert (error.rule, error.line) == (rule, line), str(error)
    assert str(error).startswith(f"line {line}: ")
    assert str(error).endswith(f"[rule: {rule}]")
    assert error.reason
    assert len(str(error)) < 1000


def test_every_rule_that_a_program_breaks_is_explained() -> None:
    assert {rule for rule, _, _ in HOSTILE} <= set(RULES)


IN_LITTLE_ROOM = """
import resource, sys
sys.path[:0] = [{tests!r}]
from support import sandbox_runs as tests
from support.hostile_programs import HOSTILE
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 800 * 2**20,) * 2)
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
for rule, line, source in HOSTILE:
    error = tests.refusal(source)
    assert (error.rule, error.line) == (rule, line), (source[:80], str(error))
print("all refused", len(HOSTILE))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits an address space as Linux does")
def test_hostile_programs_are_refused_in_little_memory_without_a_file_or_process(tmp_path: Path) -> None:
    source = IN_LITTLE_ROOM.format(tests=str(TESTS))
    command = [sys.executable, "-B", "-c", source]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.stdout.strip() == f"all refused {len(HOSTILE)}", done.stderr
    assert list(tmp_path.iterdir()) == []


NESTING = tuple(source for rule, _, source in HOSTILE if rule == "nesting" and ("f(" in source or "next(g)" in source))


@pytest.mark.parametrize("source", NESTING)
def test_depth_is_refused_before_pythons_own_limit_even_far_down_the_stack(source: str) -> None:
    def deep(frames: int) -> SandboxError:
        return deep(frames - 1) if frames else refusal(source)

    assert "recursion" not in deep(300).reason


MEASURED = """
import json, os, resource, sys
sys.path[:0] = [{tests!r}]
from support import sandbox_runs as tests
from support.hostile_programs import HOSTILE
from support.hostile_programs import HEAVY
for place, source in enumerate(("x = 1", *HEAVY)):
    child = os.fork()
    if not child:
        try:
            tests.run(source, limits=tests.Limits())
        except tests.SandboxError as error:
            print(json.dumps([place, error.rule]), flush=True)
        os._exit(0)
    _, status, used = os.wait4(child, 0)
    print(json.dumps([place, status, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024]), flush=True)
"""


@pytest.mark.heavy
@pytest.mark.skipif(sys.platform != "linux", reason="measures a process as Linux does")
def test_heavy_programs_stay_within_time_and_memory_as_measured_from_outside(tmp_path: Path) -> None:
    source = MEASURED.format(tests=str(TESTS))
    done = subprocess.run(
        [sys.executable, "-B", "-c", source], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    refused = {row[0]: row[1] for row in rows if len(row) == 2}
    measured = {row[0]: row[1:] for row in rows if len(row) == 4}
    assert set(refused) == set(range(1, len(HEAVY) + 1))
    assert set(refused.values()) <= {"steps", "memory", "time", "calls", "nesting", "size"}
    idle = measured[0][2]
    for place, (status, seconds, megabytes) in measured.items():
        assert status == 0, HEAVY[place - 1]  # no signal, no crash
        assert seconds < Limits().seconds + 2, (HEAVY[place - 1], seconds)
        assert megabytes - idle < Limits().memory_bytes / 2**20 + 200, (HEAVY[place - 1], megabytes)


def test_a_program_is_stopped_at_its_time_limit() -> None:
    endless = "while True:\n    pass"
    error = refusal(endless, limits=Limits(steps=10**9, seconds=0.05))
    assert error.rule == "time"
    assert error.line in (1, 2)


def test_computing_in_host_functions_counts_and_waiting_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    spent, passed = [0.0], [0.0]
    monkeypatch.setattr("voxposer.sandbox.guard.time.thread_time", lambda: spent[0])
    monkeypatch.setattr("voxposer.sandbox.guard.time.monotonic", lambda: passed[0])

    def wait() -> int:
        passed[0] += 3600
        return 1

    def compute() -> int:
        passed[0] += 6
        spent[0] += 6
        return 1

    functions = {"wait": wait, "compute": compute}
    source = "x = wait()\nfor i in range(2000):\n    x += 1"
    assert parse(source).run(functions).variables["x"] == 2001
    with pytest.raises(SandboxError, match=r"more than 10\.0 s of computing") as caught:
        parse("for i in range(9):\n    try: compute()\n    except Exception: pass").run(functions)
    assert (caught.value.rule, spent[0]) == ("time", 12.0)


def test_the_model_is_asked_off_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    spent = [0.0]
    monkeypatch.setattr("voxposer.sandbox.guard.time.thread_time", lambda: spent[0])
    budget = Budget(Limits())

    def ask() -> int:
        with budget.clock(running=False):
            spent[0] += 3600
        return 1

    assert parse("x = ask()\nfor i in range(999): x += 1").run({"ask": ask}, budget=budget).variables["x"] == 1000


def test_nested_programs_share_memory_and_give_back_what_they_leave() -> None:
    budget = Budget(Limits(memory_bytes=20_000_000))
    inner = parse("x = np.zeros(2000000)")

    def again() -> None:
        inner.run({}, budget=budget)

    parse("for i in range(9): again()").run({"again": again}, budget=budget)
    assert budget.memory == 20_000_000
    with pytest.raises(SandboxError, match="values of more than 20000000 bytes"):
        parse("y = np.zeros(1000000)\nagain()").run({"again": again}, budget=budget)


def test_what_the_host_keeps_is_the_programs_memory() -> None:
    source = "for i in range(9):\n    x = keep()"
    assert parse(source).run({"keep": lambda: Kept(1000)}).variables["x"] is None
    with pytest.raises(SandboxError, match="values of more than") as caught:
        parse(source, limits=Limits(memory_bytes=8000)).run({"keep": lambda: Kept(1000)})
    assert caught.value.rule == "memory"


def test_maps_of_a_program_that_failed_are_released_with_its_error() -> None:
    import gc
    import weakref

    made: list[weakref.ref[Any]] = []

    class Map(np.ndarray):
        pass

    def get_map() -> np.ndarray:
        value = np.zeros((9, 9, 9)).view(Map)
        made.append(weakref.ref(value))
        return value

    failing = (
        "m = get_map()\nx = 1 / 0",
        "m = get_map()\ntry: 1 / 0\nexcept Exception as e:\n    k = get_map()\n    raise",
        "m = get_map()\ntry: 1 / 0\nexcept KeyError: pass\nfinally: k = get_map()",
        "def g():\n    k = get_map()\n    yield k\nfor m in g(): raise ValueError",
    )
    gc.disable()
    try:
        for source in failing:
            with pytest.raises(SandboxError):
                parse(source).run({"get_map": get_map})
    finally:
        gc.enable()
    assert made
    assert [reference() is None for reference in made] == [True] * len(made)


@given(st.text(alphabet="_.()[]{}:=,+*'\"\n fornixlambdapetcs0129@", max_size=60))
def test_any_text_runs_or_is_refused(source: str) -> None:
    try:
        run(source)
    except SandboxError as error:
        assert error.rule in RULES  # noqa: PT017


# The host's side


def test_an_error_of_a_host_function_names_it_and_is_the_cause() -> None:
    error = refusal("x = 1\ny = detect('unicorn')")
    assert (error.line, error.rule) == (2, "call")
    assert "detect: KeyError" in error.reason
    assert isinstance(error.__cause__, KeyError)


def test_a_host_fault_passes_unchanged() -> None:
    fault = HostFault("the robot is on fire")

    def burn() -> None:
        raise fault

    with pytest.raises(HostFault) as caught:
        parse("burn()").run({"burn": burn})
    assert caught.value is fault


def test_a_host_function_with_a_forbidden_result_is_named() -> None:
    with pytest.raises(SandboxError, match="module is not a kind of value") as caught:
        parse("x = leak()").run({"leak": lambda: np})
    assert caught.value.rule == "values"


def test_programs_share_a_budget_with_those_that_call_them() -> None:
    budget = Budget(Limits(steps=1000))
    inner = parse("for i in range(50):\n    x = i")

    def again() -> None:
        inner.run({}, budget=budget)

    with pytest.raises(SandboxError, match="more than 1000 steps") as caught:
        parse("while True:\n    again()").run({"again": again}, budget=budget)
    assert isinstance(caught.value.__cause__, SandboxError)


def test_fields_read_from_an_observation_are_copies() -> None:
    found = variables("p = detect('bowl').position\np[0] = 99\nq = detect('bowl').position")
    assert found["p"].tolist() == [99, 30, 40]
    assert found["q"].tolist() == [20, 30, 40]


def test_an_observation_in_text_is_its_name_and_a_position_its_numbers() -> None:
    found = variables("b = detect('bowl')\nx = f'{b} at {b.position}, {[b, b.position[0]]}'")
    assert found["x"] == "bowl at [20 30 40], ['bowl', 20]"


def test_an_error_quotes_the_line() -> None:
    assert "`y = x / 0`" in str(refusal("x = 1\ny = x / 0\nz = 2"))


def test_similar_known_names_are_suggested() -> None:
    assert "did you mean 'detect'" in refusal("x = detekt('bowl')").reason
    assert "did you mean np.linalg.norm" in refusal("x = np.linalg.nrom([1])").reason


# Honest programs: what Python would have computed


PYTHON = (
    "a = b = 3\nc = a * b - 7 // 2 + 2 ** 3 % 5 - 1.5 / 3",
    "(a, b), [c, d] = (1, 2), [3, 4]\na, b = b, a",
    "x = [1, 2, 3]\ny = x\ny += [4]\nx[0] = 9\nz = x[1:] + x[:-1]",
    "x = 0\nfor i in range(10):\n    if i == 3:\n        continue\n    if i == 7:\n        break\n    x += i",
    "x = 10\nwhile x > 3 and x != 5:\n    x -= 1",
    "x = [i * j for i in range(4) if i % 2 for j in range(3) if j != 1]\ni = 5\ny = [i for i in [1]]\nz = i",
    "x = {'a': 1, 2: 'b'}\nx['c'] = [1]\ny = [k for k in x]\nz = [v for k, v in x.items()]\nw = x.get('q', 7)",
    "x = 'a' if 1 < 2 < 3 else 'b'\ny = not x == 'b'\nz = 0 or None or 'end'\nw = 1 and 2",
    "x = f'{1 + 1} of {3.14159:.2f} {\"s\"!s:>4} {7:03d} {[1, 2.5]}'",
    "x = max(3, 1, 2), min([4, 5]), sum([1, 2]), abs(-3), round(2.567, 1), len('abc')",
    "x = sorted([3, 1, 2], reverse=True)\ny = list(reversed(x))\nz = list(enumerate(['a']))\nw = list(zip([1], [2]))",
    "x = 'Top Drawer'.lower().split()\ny = ' '.join(x)\nz = 'top' in y\nw = y.replace('top', 'b')",
    "x = [3, 1]\nx.append(2)\nx.sort()\nx.insert(0, 9)\ny = x.pop()\nz = x.index(1)\nx.reverse()",
    "x = 5 in range(10)\ny = 5.5 in range(10)\nz = None is None\nw = 3 not in [1, 2]",
    "x = any([0, 1]), all([0, 1]), bool([]), int('7'), float('1.5'), str(None), tuple([1])",
    "x = ~5 & 12 | 3 ^ 1\ny = -x\nz = +y",
    "x = 1\nif x > 1:\n    y = 'a'\nelif x == 1:\n    y = 'b'\nelse:\n    y = 'c'",
)


@pytest.mark.parametrize("source", PYTHON)
def test_allowed_python_gives_pythons_results(source: str) -> None:
    expected: dict[str, Any] = {}
    exec(source, {}, expected)
    assert dict(variables(source)) == expected


NUMPY = (
    "np.array([1, 2, 3]) * 2 + np.array([0.5])",
    "np.linalg.norm(np.array([3, 4]) - [0, 0])",
    "np.linalg.norm(np.array([[3, 4], [6, 8]]), axis=1)",
    "np.zeros((2, 3), dtype=int)",
    "np.full((2, 2), np.pi)",
    "np.arange(2, 10, 3)",
    "np.linspace(0, 1, 5)",
    "np.clip([1, 5, 9], 2, 6)",
    "np.where(np.array([1, 0]) > 0, 7, 8)",
    "np.array(np.where(np.array([1, 0, 1]) > 0))",
    "np.argwhere(np.eye(3) == 1)",
    "np.stack([np.array([1, 2]), np.array([3, 4])], axis=1)",
    "np.concatenate([[1], [2, 3]])",
    "np.cross([1, 0, 0], [0, 1, 0])",
    "np.dot([[1, 2], [3, 4]], [1, 1])",
    "np.array([[1, 2], [3, 4]]) @ np.array([1, 1])",
    "np.round(np.array([1.234, 5.678]), 1)",
    "np.array([1.7, 2.2]).astype(int)",
    "np.array([[1, 2], [3, 4]]).mean(axis=0)",
    "np.array([3, 1, 2]).argmin()",
    "np.argmax(np.array([[1, 9], [3, 4]]), axis=1)",
    "np.array(np.unravel_index(5, (2, 3)))",
    "np.array([1, 2, 3])[::-1]",
    "np.array([[1, 2], [3, 4]])[:, 1]",
    "np.array([[1, 2], [3, 4]])[[0, 1], [1, 0]]",
    "np.array([5, 6, 7])[np.array([True, False, True])]",
    "np.array([[1, 2], [3, 4]]).T",
    "np.sum(np.ones((3, 4)), axis=(0, 1))",
    "np.arctan2(1, 2) + np.deg2rad(90) + np.sqrt(2)",
    "np.maximum([1, 5], 3)",
    "np.logical_and(np.array([True, False]), True)",
    "np.meshgrid([1, 2], [3], indexing='ij')[0]",
    "np.array([1, 2, 3, 4]).reshape(2, 2)",
    "np.array([1, 2, 3, 4]).reshape((2, -1))",
    "np.median([1, 5, 2])",
    "np.roll([1, 2, 3], 1)",
    "np.allclose([1.0], [1.0 + 1e-9])",
    "np.expand_dims(np.array([1, 2]), 0)",
    "np.interp(0.5, [0, 1], [10, 20])",
    "np.array([4, 2]).copy().max()",
)


@pytest.mark.parametrize("expression", NUMPY)
def test_allowed_numpy_gives_numpys_results(expression: str) -> None:
    expected = eval(expression, {"np": np})
    found = variables(f"x = {expression}")["x"]
    np.testing.assert_array_equal(found, expected)
    assert np.asarray(found).dtype == np.asarray(expected).dtype


# Maps


def marked(source: str) -> list[list[int]]:
    """Voxels that are 1 in the map ``m`` of a program."""
    return np.argwhere(variables(f"m = get_map()\n{source}")["m"] == 1).tolist()


@pytest.mark.parametrize(
    ("index", "voxel"),
    [
        ("1, 2, 3", [1, 2, 3]),
        ("1.4, 2.6, 3.0", [1, 3, 3]),
        ("250, 99, 100", [99, 99, 99]),
        ("-7, 2, 3", [0, 2, 3]),
        ("-1, 2, 3", [99, 2, 3]),
        ("np.array([1, 2, 3])", [1, 2, 3]),
        ("np.array([1.2, 2.9, 300])", [1, 3, 99]),
        ("[1, 2, 3]", [1, 2, 3]),
        ("(1, 2, np.int64(3))", [1, 2, 3]),
        ("detect('bowl').position", [20, 30, 40]),
    ],
)
def test_map_indices_are_rounded_and_clipped(index: str, voxel: list[int]) -> None:
    assert marked(f"m[{index}] = 1") == [voxel]


def test_a_slice_of_a_map_begins_at_its_start_when_asked_to_begin_before_it() -> None:
    assert marked("m[-3:2, 5, 5] = 1") == [[0, 5, 5], [1, 5, 5]]
    assert marked("m[-3:-2, 5, 5] = 1") == []
    assert marked("m[97.6:, 5, 5] = 1") == [[98, 5, 5], [99, 5, 5]]
    assert marked("m[..., 5, 5][:2] = 1") == [[0, 5, 5], [1, 5, 5]]
    assert marked("m[3, ..., 5][:2] = 1") == [[3, 0, 5], [3, 1, 5]]


def test_a_map_is_written_by_a_mask_and_by_lists_of_places() -> None:
    assert marked("g = np.indices((100, 100, 100))\nm[(g[0] + g[1] + g[2]) < 1] = 1") == [[0, 0, 0]]
    assert marked("m[np.array([1, 2]), np.array([3, 400]), 5] = 1") == [[1, 3, 5], [2, 99, 5]]


def test_a_quaternion_is_written_to_every_voxel_or_where_a_mask_says() -> None:
    source = "q = get_quats()\nq[:, :, :] = [1, 0, 0, 0]\nq[get_map() == 0] = [0, 1, 0, 0]\nx = q[500, 0, 0.4]"
    assert variables(source)["x"].tolist() == [0, 1, 0, 0]


def test_many_single_voxels_fit_into_the_budget() -> None:
    source = "m = get_map()\nfor x in range(40):\n    for y in range(40):\n        m[x, y, 5] = 1\ns = m.sum()"
    assert variables(source)["s"] == 1600


def test_changing_a_map_in_place_takes_no_memory() -> None:
    source = "m = get_map()\nfor i in range(100):\n    m += 1\n    m = same(m)\n    m[:50] *= 1\ns = m.max()"
    functions = {**FUNCTIONS, "same": lambda value: value}
    assert parse(source, limits=Limits(memory_bytes=20_000_000)).run(functions).variables["s"] == 100


# What is returned


@pytest.mark.parametrize(
    ("source", "value"),
    [
        ("ret_val = 3", 3),
        ("if True:\n    ret_val = 1\nelse:\n    ret_val = 2", 1),
        ("for x in [1, 2, 3]:\n    if x > 1:\n        ret_val = x", 2),
        ("ret_val = []\nfor x in [1, 2]:\n    ret_val.append(x)", [1, 2]),
        ("ret_val = 0\nfor x in [1, 2]:\n    ret_val += x", 3),
        ("x = ret_val = 4\nx = 5", 4),
        ("return 6", 6),
        ("x = 1", None),
    ],
)
def test_an_assignment_to_the_return_value_returns_unless_it_is_read(source: str, value: Any) -> None:
    assert run(source, returns="ret_val").value == value


def test_without_a_return_value_the_name_is_a_variable_like_any_other() -> None:
    assert variables("ret_val = 1\nret_val = 2")["ret_val"] == 2


def test_a_program_runs_again_from_the_start() -> None:
    program = parse("x = x + [1]\nret_val = x")
    assert [program.run({}, {"x": [0]}, returns="ret_val").value for _ in range(2)] == [[0, 1], [0, 1]]
