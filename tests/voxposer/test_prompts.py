"""The prompts teach what the runtime runs: every example is of the small language, and does what its query says."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from typing import Any

import pytest

from voxposer.language.lmp_config import CONFIGS
from voxposer.language.prompts import load_prompts
from voxposer.offline import provider as offline
from voxposer.offline.names import NotUnderstood
from voxposer.sandbox.interpreter import parse

PROMPTS = load_prompts()
SEES_OBJECTS = [name for name, config in CONFIGS.items() if config.include_context]
# Examples for language models that the offline writer has no rule for.
BY_HAND = {
    "the red block",
    "anywhere within 6cm of the sponge",
    "the left half of the table",
    "faster on the right half of the table",
    "close everywhere but open on the back side of the table",
}
# Functions of the runtime, beside np and builtins, by the LMP whose programs may call them.
VOXELS = {"parse_query_obj", "cm2index", "index2cm", "set_voxel_by_radius"}
CALLABLE = {
    "planner": {"composer"},
    "composer": {"parse_query_obj", "execute", "reset_to_default_pose", *(name for name in CONFIGS if "map" in name)},
    "parse_query_obj": {"detect", "index2cm"},
    "get_affordance_map": {*VOXELS, "get_empty_affordance_map"},
    "get_avoidance_map": {*VOXELS, "get_empty_avoidance_map"},
    "get_rotation_map": {
        *VOXELS,
        "get_empty_rotation_map",
        "vec2quat",
        "qmult",
        "qinverse",
        "euler2quat",
        "quat2euler",
    },
    "get_velocity_map": {*VOXELS, "get_empty_velocity_map"},
    "get_gripper_map": {*VOXELS, "get_empty_gripper_map"},
}
FIELDS = {"position", "aabb", "normal", "name", "held", "occupancy_map", "axis", "hand_offset"} | {
    f"{what}_{kind}" for what in ("grasp", "place", "left", "right", "push") for kind in ("position", "quat")
}


@dataclass(frozen=True)
class Example:
    """One example of a prompt."""

    lmp: str
    query: str
    program: str
    objects: tuple[str, ...] = ()

    @property
    def messages(self) -> list[dict[str, str]]:
        """The query as a request."""
        context = f"objects = {list(self.objects)!r}\n" if self.lmp in SEES_OBJECTS else ""
        return [
            {"role": "user", "content": f"Queries are for `{self.lmp}`."},
            {"role": "user", "content": f"{context}# Query: {self.query}."},
        ]


def examples(lmp: str) -> list[Example]:
    found = re.findall(
        r"(?:^objects = (\[.*\])\n)?^# Query: (.*)\.\n((?:(?!objects = |# Query: ).*\n?)*)", PROMPTS[lmp], re.MULTILINE
    )
    return [
        Example(lmp, query, program.strip(), tuple(ast.literal_eval(objects or "[]")))
        for objects, query, program in found
    ]


ALL = [example for lmp in PROMPTS for example in examples(lmp)]


def of(*lmps: str) -> list[Any]:
    """The examples of these prompts as parameters."""
    return [pytest.param(example, id=f"{example.lmp}: {example.query}") for example in ALL if example.lmp in lmps]


EXAMPLES = of(*PROMPTS)
UNDERSTOOD = [example for example in ALL if example.query not in BY_HAND]


@pytest.mark.parametrize("lmp", CONFIGS)
def test_every_lmp_has_a_prompt_with_enough_examples(lmp: str) -> None:
    assert len(examples(lmp)) >= 4
    assert len(examples(lmp)) == PROMPTS[lmp].count("# Query: ")
    assert len({example.query for example in examples(lmp)}) == len(examples(lmp)) or lmp in SEES_OBJECTS


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_are_programs_that_the_sandbox_accepts(example: Example) -> None:
    parse(example.program)


def test_the_offline_writer_lacks_rules_for_the_examples_written_by_hand_only() -> None:
    queries = set()
    for example in ALL:
        try:
            offline.write(example.messages)
        except NotUnderstood:
            queries.add(example.query)
    assert queries == BY_HAND


@pytest.mark.parametrize("example", UNDERSTOOD, ids=lambda example: f"{example.lmp}: {example.query}")
def test_examples_are_what_the_offline_writer_writes(example: Example) -> None:
    """One vocabulary: a model taught by the prompts and the rule-based writer say the same."""
    written = offline.write(example.messages)
    assert ast.dump(ast.parse(written)) == ast.dump(ast.parse(example.program))


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_use_only_existing_functions_and_fields(example: Example) -> None:
    tree = ast.parse(example.program)
    called = {node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    assert called <= CALLABLE[example.lmp] | {"sum", "len"}
    read = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    of_numpy = {"append", "array", "clip", "dot", "linalg", "norm", "argmin", "argmax", "maximum", "pi", "cos", "sin"}
    assert read <= FIELDS | of_numpy


@pytest.mark.parametrize("example", of("composer"))
def test_map_queries_of_the_composer_are_understood(example: Example) -> None:
    asked = re.findall(r"(get_\w+_map)\((['\"])(.+?)\2\)", example.program)
    assert asked or "reset_to_default_pose" in example.program
    for lmp, _, query in asked:
        offline.write(Example(lmp, query, "").messages)


@pytest.mark.parametrize("example", of("planner"))
def test_subtasks_that_the_planner_names_are_understood(example: Example) -> None:
    subtasks = re.findall(r'composer\("(.+?)"\)', example.program)
    assert subtasks
    for subtask in subtasks:
        offline.write(Example("composer", subtask, "").messages)


@pytest.mark.parametrize("example", of("parse_query_obj"))
def test_only_existing_objects_are_detected(example: Example) -> None:
    names = {node.value for node in ast.walk(ast.parse(example.program)) if isinstance(node, ast.Constant)}
    strings = {name for name in names if isinstance(name, str)} - {"x", "y", "z"}
    assert strings <= {*example.objects, "gripper", "table", "held object"}


@pytest.mark.parametrize("lmp", CONFIGS)
def test_prompts_contain_no_stop_token_inside_a_program(lmp: str) -> None:
    for example in examples(lmp):
        assert not any(stop in example.program for stop in CONFIGS[lmp].stop)
