"""Language programs: what they may call, what their errors say, sessions and prompts."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.llm_server import Answer, code, failure
from support.lmps import ABOVE, FINDS, PROMPTS, Setup, call_of

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

from voxposer.language.llm import Llm
from voxposer.language.lmp import Lmps, build_lmps
from voxposer.language.lmp_config import CONFIGS, MAPS, NAMES, LmpError
from voxposer.language.observations import LazyMap
from voxposer.language.prompts import code_in, load_prompts
from voxposer.language.replies import LlmError, ReplyError
from voxposer.sandbox.guard import Limits

# Rights


def evaluated(made: LazyMap) -> np.ndarray:
    return made()


@pytest.mark.parametrize(
    ("name", "program"),
    [
        ("planner", "execute(1)"),
        ("planner", "reset_to_default_pose()"),
        ("composer", "composer('again')"),
        ("composer", "planner('again')"),
        ("parse_query_obj", "execute(detect('bowl_1'))"),
        ("parse_query_obj", "parse_query_obj('bowl')"),
        *[(name, "execute(1)") for name in MAPS],
        *[(name, "get_affordance_map('x')") for name in MAPS],
    ],
)
def test_a_program_calls_only_the_functions_of_its_lmp(setup: Callable[..., Setup], name: str, program: str) -> None:
    robot = setup({(name, "go"): program})
    with pytest.raises(LmpError) as caught:
        evaluated(getattr(robot.lmps, name)("go"))
    assert (caught.value.lmp, caught.value.rule, caught.value.line) == (name, "names", 1)
    assert robot.world.done == []


# What goes wrong


def test_an_error_names_lmp_query_line_and_rule_and_is_in_the_trace(setup: Callable[..., Setup]) -> None:
    robot = setup({("composer", "go"): "x = 1\ny = x / 0"})
    with pytest.raises(LmpError) as caught:
        robot.lmps.composer("go")
    error = caught.value
    assert (error.lmp, error.query, error.line, error.rule) == ("composer", "go", 2, "value")
    assert str(error) == "composer('go'): line 2: `y = x / 0`: division by zero [rule: value]"
    assert call_of(robot.lmps, "composer").error == str(error)


def test_a_nested_error_is_the_innermost_programs_with_the_call_chain(setup: Callable[..., Setup]) -> None:
    answers = {
        ("composer", "go"): "m = get_affordance_map('there')\nexecute(parse_query_obj('gripper'), m)",
        ("get_affordance_map", "there"): "\nret_val = parse_query_obj('unicorn')",
        ("parse_query_obj", "unicorn"): "ret_val = detect('unicorn')",
        ("parse_query_obj", "gripper"): "ret_val = detect('gripper')",
    }
    robot = setup(answers)
    with pytest.raises(LmpError) as caught:
        robot.lmps.composer("go")
    error = caught.value
    assert (error.lmp, error.line, error.rule) == ("parse_query_obj", 1, "call")
    assert isinstance(error.__cause__, KeyError)
    assert error.__notes__ == ["in get_affordance_map('there')", "in composer('go')"]
    assert [call.error is None for call in robot.lmps.trace] == [False, False, True, False]


@pytest.mark.parametrize("text", ["Sure! I would love to help.", "The bowl is on the table:\n- grasp it", "x = (1"])
def test_an_answer_that_is_not_a_program_is_reported_with_lmp_and_model(setup: Callable[..., Setup], text: str) -> None:
    robot = setup({("get_gripper_map", "go"): text})
    with pytest.raises(
        LmpError, match=r"get_gripper_map\('go'\): .*openai/local wrote a program that cannot be run"
    ) as caught:
        robot.lmps.get_gripper_map("go")
    assert caught.value.rule == "syntax"
    assert repr(text.splitlines()[0]) in caught.value.reason
    assert call_of(robot.lmps, "get_gripper_map").code == text


def test_an_answer_that_is_not_a_program_is_not_cached(setup: Callable[..., Setup], tmp_path: Path) -> None:
    robot = setup({("composer", "go"): "Sure thing!"})
    lmps = Lmps({}, Llm(replace(robot.llm.config, cache=tmp_path)), PROMPTS)
    with pytest.raises(LmpError):
        lmps.composer("go")
    robot.answers["composer", "go"] = "pass"
    lmps.composer("go")
    assert [call.cached for call in lmps.trace] == [False, False]


@pytest.mark.parametrize(
    ("answer", "told"), [(code("x = 1", finish="length"), "cut off at 512 tokens"), (code(""), "empty")]
)
def test_a_truncated_or_empty_answer_is_an_error_of_the_model_and_not_of_its_program(
    setup: Callable[..., Setup], answer: Answer, told: str
) -> None:
    robot = setup({("composer", "go"): answer})
    with pytest.raises(ReplyError, match=rf"^openai/local: .*{told}") as caught:
        robot.lmps.composer("go")
    assert caught.value.__notes__ == ["requested by composer('go')"]
    call = call_of(robot.lmps, "composer")
    assert (call.prompt_tokens, call.error) == (11, str(caught.value))


def test_a_provider_error_is_not_an_error_of_a_program(setup: Callable[..., Setup]) -> None:
    robot = setup({("composer", "go"): "get_gripper_map('open')", ("get_gripper_map", "open"): failure(401, "bad key")})
    with pytest.raises(LlmError, match="bad key") as caught:
        robot.lmps.composer("go")
    assert caught.value.__notes__ == ["requested by get_gripper_map('open')", "in composer('go')"]
    assert "bad key" in (call_of(robot.lmps, "get_gripper_map").error or "")


def test_endless_requests_for_programs_are_stopped(setup: Callable[..., Setup]) -> None:
    answers = {("composer", "go"): "while True:\n    get_gripper_map('open')", ("get_gripper_map", "open"): "pass"}
    robot = setup(answers, limits=Limits(programs=10))
    with pytest.raises(LmpError, match="more than 10 further programs") as caught:
        robot.lmps.composer("go")
    assert caught.value.rule == "calls"
    assert len(robot.server.requests) == 11
    robot.answers["composer", "wait"] = "pass"
    robot.lmps.composer("wait")


def test_a_map_may_be_computed_any_number_of_times(setup: Callable[..., Setup]) -> None:
    robot = setup({**FINDS, ("get_affordance_map", "above the bowl"): ABOVE}, limits=Limits(programs=1))
    above = robot.lmps.get_affordance_map("above the bowl")
    assert [int(above().sum()) for _ in range(4)] == [1, 1, 1, 1]


def test_nested_programs_use_the_outer_programs_steps(setup: Callable[..., Setup]) -> None:
    answers = {("composer", "go"): "g = parse_query_obj('gripper')\nfor i in range(100):\n    p = g.position"}
    busy = "x = 0\nfor i in range(20):\n    x += i\nret_val = detect('gripper')"
    robot = setup({**answers, ("parse_query_obj", "gripper"): busy}, limits=Limits(steps=2000))
    robot.lmps.parse_query_obj("gripper")()
    with pytest.raises(LmpError, match="more than 2000 steps"):
        robot.lmps.composer("go")


def test_a_failing_host_function_is_reported_with_the_calling_line(setup: Callable[..., Setup]) -> None:
    robot = setup({("composer", "go"): "pass\nexecute()"})
    with pytest.raises(LmpError, match=r"execute: TypeError: .*movable") as caught:
        robot.lmps.composer("go")
    assert (caught.value.line, caught.value.rule) == (2, "call")


# Sessions


def test_an_lmp_that_keeps_its_session_shows_it_and_keeps_its_variables(setup: Callable[..., Setup]) -> None:
    configs = {**CONFIGS, "composer": replace(CONFIGS["composer"], maintain_session=True)}
    robot = setup({("composer", "one"): "x = 1", ("composer", "two"): "y = x + 1"}, configs=configs)
    robot.lmps.composer("one")
    robot.lmps.composer("two")
    shown = [request["messages"][1]["content"] for request in robot.server.requests]
    assert "# Query: one.\nx = 1" not in shown[0]
    assert f"{PROMPTS['composer']}\n\n# Query: one.\nx = 1\n```" in shown[1]
    robot.lmps.clear_trace()
    with pytest.raises(LmpError, match="'x' is not known"):
        robot.lmps.composer("two")


# Prompts


def write_prompts(folder: Path, ending: str) -> None:
    for name in NAMES:
        (folder / f"{name}{ending}").write_text(f"\n{{variable_vars_imports}}\n# Query: {name}.\npass  # {{x}}\n\n")


@pytest.mark.parametrize("ending", [".txt", "_prompt.txt"])
def test_prompt_files_may_have_our_names_or_upstreams(setup: Callable[..., Setup], tmp_path: Path, ending: str) -> None:
    write_prompts(tmp_path, ending)
    robot = setup({("get_gripper_map", "open"): "pass"})
    lmps = build_lmps(robot.world.functions(), robot.llm, tmp_path)
    lmps.get_gripper_map("open")
    shown = robot.server.requests[0]["messages"][1]["content"]
    (imports,) = re.findall(r"```\nfrom utils import (.*)\n# Query: get_gripper_map\.\npass  # \{x\}\n```", shown)
    assert {"detect", "get_empty_gripper_map", "parse_query_obj"} <= set(imports.split(", "))
    assert "execute" not in imports


def test_a_prompt_that_is_missing_is_named(tmp_path: Path) -> None:
    write_prompts(tmp_path, ".txt")
    (tmp_path / "composer.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"neither composer\.txt nor composer_prompt\.txt is in .*"):
        load_prompts(tmp_path)


# Replies


@pytest.mark.parametrize(
    ("text", "program"),
    [
        ("x = 1", "x = 1"),
        ("```\nx = 1\n```", "x = 1"),
        ("```python\nx = 1\ny = 2\n```", "x = 1\ny = 2"),
        ("Here you are:\n\n```py\nx = 1\n```\nThat sets x.", "x = 1"),
        ("```python\nx = 1\n```\nand then\n```python\ny = 2\n```", "x = 1\ny = 2"),
        ("```python\nx = 1", "x = 1"),
        ("x = 1\n```", "x = 1"),
        ("  ```python\n  if x:\n      y = 1\n  ```", "if x:\n    y = 1"),
        ("    x = 1\n    y = 2", "x = 1\ny = 2"),
        ("if x:\r\n\ty = 'a python'\r\n", "if x:\n    y = 'a python'"),
        ("", ""),
    ],
)
def test_the_code_of_an_answer_is_inside_its_fences(text: str, program: str) -> None:
    assert code_in(text) == program
