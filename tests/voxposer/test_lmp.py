"""Language programs: what the model is asked, what its programs may do, what becomes of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.lmps import ABOVE, FINDS, OBJECTS, PROMPTS, Answers, Setup, call_of

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

from voxposer.language.llm import Llm
from voxposer.language.lmp import Lmps
from voxposer.language.lmp_config import NAMES, LmpError
from voxposer.language.observations import DynamicObservation, DynamicObservations, LazyMap, Observation

# What the model is asked


def test_a_request_shows_examples_first_and_ends_with_the_query(setup: Callable[..., Setup]) -> None:
    robot = setup({("composer", "grasp the bowl"): "pass"})
    robot.lmps.composer("grasp the bowl")
    (request,) = robot.server.requests
    assert [message["role"] for message in request["messages"]] == ["system", "user", "assistant", "user"]
    assert f"```\n{PROMPTS['composer']}\n```" in request["messages"][1]["content"]
    assert request["messages"][-1]["content"] == "# Query: grasp the bowl."
    assert (request["max_tokens"], request["temperature"]) == (512, 0)


@pytest.mark.parametrize("name", NAMES)
def test_only_planner_and_parse_query_obj_see_the_objects(setup: Callable[..., Setup], name: str) -> None:
    robot = setup({(name, "something"): "ret_val = 1"})
    with pytest.raises(LmpError) if name == "parse_query_obj" else no_error():
        getattr(robot.lmps, name)("something")
    sees = robot.server.requests[0]["messages"][-1]["content"].startswith(f"objects = {list(OBJECTS)}\n# Query: ")
    assert sees == (name in ("planner", "parse_query_obj"))


class no_error:
    def __enter__(self) -> None: ...
    def __exit__(self, *exception: object) -> None: ...


def test_a_map_program_without_ret_val_returns_the_map_it_made(setup: Callable[..., Setup]) -> None:
    """Two of upstream's own examples end so."""
    made = "affordance_map = get_empty_affordance_map()\naffordance_map[1, 2, 3] = 1"
    robot = setup(
        {("get_affordance_map", "here"): made, ("get_affordance_map", "there"): "m = get_empty_affordance_map()"}
    )
    np.testing.assert_array_equal(np.argwhere(robot.lmps.get_affordance_map("here")()), [[1, 2, 3]])
    with pytest.raises(LmpError, match="returned nothing, not a map"):
        robot.lmps.get_affordance_map("there")()


@pytest.mark.parametrize(
    ("name", "stop"), [("planner", ["# Query: ", "objects = "]), ("composer", ["# Query: ", "objects ="])]
)
def test_an_answer_ends_at_the_lmps_own_stop_tokens(setup: Callable[..., Setup], name: str, stop: list[str]) -> None:
    robot = setup({(name, "wait"): "x = 1\n# Query: next.\nboom()", (name, "go"): "x = 1\nobjects = ['a']\nboom()"})
    getattr(robot.lmps, name)("wait")
    getattr(robot.lmps, name)("go")
    assert [request["stop"] for request in robot.server.requests] == [[f"\n{token}" for token in stop]] * 2
    assert [call.code for call in robot.lmps.trace] == ["x = 1", "x = 1"]


@pytest.mark.parametrize(
    ("query", "line"),
    [
        ("grasp the bowl.", "# Query: grasp the bowl."),
        ("  grasp\tthe  bowl \n", "# Query: grasp the bowl."),
        ("wait\n# Query: burn.\nobjects = []", "# Query: wait # Query: burn. objects = []."),
    ],
)
def test_a_query_is_one_line_with_one_full_stop(setup: Callable[..., Setup], query: str, line: str) -> None:
    robot = setup({})
    robot.server.say("pass")
    robot.lmps.composer(query)
    assert robot.server.requests[0]["messages"][-1]["content"] == line


@pytest.mark.parametrize("query", ["", " . ", "x" * 2000])
def test_a_query_without_words_or_with_too_many_is_refused(setup: Callable[..., Setup], query: str) -> None:
    robot = setup({})
    with pytest.raises(LmpError, match="a query has 1 to 1000 characters") as caught:
        robot.lmps.composer(query)
    assert (caught.value.lmp, caught.value.rule) == ("composer", "query")
    assert robot.server.requests == []


def test_a_query_that_is_not_text_is_refused_at_the_call(setup: Callable[..., Setup]) -> None:
    robot = setup({("composer", "go"): "get_affordance_map(5)"})
    with pytest.raises(LmpError, match="a query is text, not int") as caught:
        robot.lmps.composer("go")
    assert caught.value.lmp == "get_affordance_map"
    assert caught.value.__notes__ == ["in composer('go')"]


def test_lmps_that_need_objects_are_not_asked_without_them(setup: Callable[..., Setup]) -> None:
    robot = setup({})
    lmps = Lmps(robot.world.functions(), robot.llm, PROMPTS)
    with pytest.raises(LmpError, match="call set_context first"):
        lmps.parse_query_obj("bowl")


@pytest.mark.parametrize("objects", ["bowl", [1], [("bowl", 1)]])
def test_objects_are_names(setup: Callable[..., Setup], objects: Any) -> None:
    with pytest.raises(TypeError, match="objects are a list of names"):
        setup({}).lmps.set_context(objects)


# The planner


PLAN = """composer('grasp the bowl')
for place in ['left', 'right']:
    composer(f'move to the {place}')
# done"""


def test_planning_records_the_subtasks_without_executing(setup: Callable[..., Setup]) -> None:
    robot = setup({("planner", "tidy up"): PLAN})
    assert robot.lmps.plan("tidy up") == ("grasp the bowl", "move to the left", "move to the right")
    assert robot.world.done == []
    assert [call.lmp for call in robot.lmps.trace] == ["planner"]


def test_the_planner_executes_its_subtasks_in_order(setup: Callable[..., Setup]) -> None:
    answers = {("planner", "tidy up"): "composer('wait')\ncomposer('go home')", ("composer", "wait"): "pass"}
    robot = setup({**answers, ("composer", "go home"): "reset_to_default_pose()"})
    robot.lmps.planner("tidy up")
    assert [(call.lmp, call.query) for call in robot.lmps.trace] == [
        ("planner", "tidy up"),
        ("composer", "wait"),
        ("composer", "go home"),
    ]
    assert robot.world.done == [("reset",)]


@pytest.mark.parametrize(
    ("program", "told"),
    [("composer(5)", "a subtask is text"), ("for i in range(101):\n    composer('x')", "more than 100 subtasks")],
)
def test_a_plan_that_cannot_be_followed_is_an_error(setup: Callable[..., Setup], program: str, told: str) -> None:
    robot = setup({("planner", "tidy up"): program})
    with pytest.raises(LmpError, match=told):
        robot.lmps.plan("tidy up")


# The composer


COMPOSED = """movable = parse_query_obj('gripper')
affordance_map = get_affordance_map(f'a point 5cm above the bowl at {parse_query_obj("bowl").position}')
gripper_map = get_gripper_map('close everywhere')
execute(movable, affordance_map, gripper_map=gripper_map)
for cup in parse_query_obj('cups'):
    execute(cup)"""
GRASP: Answers = {
    **FINDS,
    ("composer", "go"): COMPOSED,
    ("get_affordance_map", "a point 5cm above the bowl at [5 6 7]"): ABOVE,
    ("get_gripper_map", "close everywhere"): "gripper_map = get_empty_gripper_map()\ngripper_map[:, :, :] = 0\n"
    "ret_val = gripper_map",
}


def test_a_subtask_executes_once_or_several_times_with_maps_and_without(setup: Callable[..., Setup]) -> None:
    robot = setup(GRASP)
    robot.lmps.composer("go")
    (first, maps), *others = robot.world.done
    assert (first, others) == ("gripper", [("cup_1", {}), ("cup_2", {})])
    assert np.argwhere(maps["affordance_map"]).tolist() == [[5, 6, 13]]
    assert not maps["gripper_map"].any()
    assert maps["affordance_map"].dtype == np.float64


def test_the_trace_has_queries_programs_and_costs(setup: Callable[..., Setup]) -> None:
    robot = setup(GRASP)
    robot.lmps.composer("go")
    call = call_of(robot.lmps, "get_affordance_map")
    assert (call.query, call.code) == ("a point 5cm above the bowl at [5 6 7]", ABOVE)
    assert (call.model, call.cached, call.prompt_tokens, call.completion_tokens) == ("openai/local", False, 11, 7)
    assert (call.context, call.error, call.cost_usd) == ("", None, None)
    found = next(call for call in robot.lmps.trace if call.lmp == "parse_query_obj")
    assert found.context == f"objects = {list(OBJECTS)}"
    robot.lmps.clear_trace()
    assert robot.lmps.trace == []


def test_the_trace_marks_cached_answers(setup: Callable[..., Setup], tmp_path: Path) -> None:
    robot = setup({("composer", "wait"): "pass"})
    llm = Llm(replace(robot.llm.config, cache=tmp_path))
    lmps = Lmps({}, llm, PROMPTS)
    lmps.composer("wait")
    lmps.composer("wait")
    assert [call.cached for call in lmps.trace] == [False, True]


# Maps and observations are programs still


def test_a_map_is_computed_from_the_state_when_it_is_called(setup: Callable[..., Setup]) -> None:
    robot = setup({**FINDS, ("get_affordance_map", "above the bowl"): ABOVE})
    above = robot.lmps.get_affordance_map("above the bowl")
    assert isinstance(above, LazyMap)
    assert (above.lmp, above.query) == ("get_affordance_map", "above the bowl")
    assert [call.lmp for call in robot.lmps.trace] == ["get_affordance_map"]
    assert np.argwhere(above()).tolist() == [[5, 6, 13]]
    robot.world.positions["bowl_1"] = [1, 2, 3]
    assert np.argwhere(above()).tolist() == [[1, 2, 9]]


def test_an_observation_is_refreshed_at_each_read(setup: Callable[..., Setup]) -> None:
    robot = setup(FINDS)
    bowl = robot.lmps.parse_query_obj("bowl")
    assert isinstance(bowl, DynamicObservation)
    before = bowl()
    robot.world.positions["bowl_1"] = [1, 2, 3]
    assert bowl.position.tolist() == bowl["position"].tolist() == [1, 2, 3]
    assert bowl()["position"].tolist() == [1, 2, 3]
    assert before["position"].tolist() == [5, 6, 7]
    assert len(robot.server.requests) == 1


def test_several_objects_are_a_list_of_observations(setup: Callable[..., Setup]) -> None:
    robot = setup(FINDS)
    cups = robot.lmps.parse_query_obj("cups")
    assert isinstance(cups, DynamicObservations)
    first, second = cups
    robot.world.positions["cup_2"] = [1, 1, 1]
    assert isinstance(second, DynamicObservation)
    assert (first.name, second.name, second.position.tolist()) == ("cup_1", "cup_2", [1, 1, 1])
    assert [cup["name"] for cup in cups()] == ["cup_1", "cup_2"]
    assert (len(cups), cups[-1].name, [cup.name for cup in cups[1:]]) == (2, "cup_2", ["cup_2"])


def test_programs_read_an_observations_fields_but_not_those_of_the_host(setup: Callable[..., Setup]) -> None:
    robot = setup({("parse_query_obj", "x"): "ret_val = detect(detect('bowl_1')['name'])"})
    bowl = robot.lmps.parse_query_obj("x")
    assert isinstance(bowl, DynamicObservation)
    found = bowl()
    assert (found.name, found["_points"], str(found)) == ("bowl_1", [1], "bowl_1")
    assert list(found.fields()) == ["name", "position", "aabb", "normal"]
    with pytest.raises(AttributeError, match=r"no 'colour'; it has .*aabb"):
        _ = found.colour


def test_programs_get_copies_of_observation_fields() -> None:
    seen = Observation({"position": np.zeros(3), "parts": ["lid"]})
    seen["position"][0] = 9
    seen["parts"].append("knob")
    assert (seen.position.tolist(), seen.parts) == ([0, 0, 0], ["lid"])


@pytest.mark.parametrize("program", ["ret_val = None", "ret_val = []", "ret_val = 5", "x = 1", "ret_val = [None]"])
def test_a_reference_to_nothing_is_an_error(setup: Callable[..., Setup], program: str) -> None:
    robot = setup({("parse_query_obj", "unicorn"): program})
    with pytest.raises(LmpError, match=r"parse_query_obj\('unicorn'\): the program found") as caught:
        robot.lmps.parse_query_obj("unicorn")
    assert caught.value.rule == "result"
    assert "not an observation" in (call_of(robot.lmps, "parse_query_obj").error or "")


@pytest.mark.parametrize(
    ("name", "program", "told"),
    [
        ("get_affordance_map", "m = get_empty_affordance_map()", "returned nothing"),
        ("get_affordance_map", "ret_val = 5", "returned int '5'"),
        ("get_affordance_map", "ret_val = np.zeros((3, 3, 4))", r"returned an array \[3, 3, 4\]"),
        ("get_affordance_map", "ret_val = get_empty_rotation_map()", r"not a map \[N, N, N\]"),
        ("get_rotation_map", "ret_val = get_empty_velocity_map()", r"not a map \[N, N, N, 4\]"),
        ("get_velocity_map", "ret_val = get_empty_velocity_map() * np.nan", "not finite"),
    ],
)
def test_an_invalid_map_is_an_error_when_it_is_computed(
    setup: Callable[..., Setup], name: str, program: str, told: str
) -> None:
    robot = setup({(name, "here"): program})
    made = getattr(robot.lmps, name)("here")
    with pytest.raises(LmpError, match=told) as caught:
        made()
    assert (caught.value.lmp, caught.value.rule) == (name, "result")


# Programs as upstream's prompts show them, in our words


def voxels(*places: Sequence[int]) -> list[list[int]]:
    return [list(place) for place in places]


AFFORDANCES = {
    "a point 3cm in front of [10, 15, 6]": (
        "m = get_empty_affordance_map()\nx = 10 + cm2index(3, 'x')\ny = 15\nz = 6\nm[x, y, z] = 1\nret_val = m",
        voxels([13, 15, 6]),
    ),
    "a point far above the plate": (
        "m = get_empty_affordance_map()\np = parse_query_obj('bowl')\nx, y, z = p.position\n"
        "m[x, y, z + cm2index(500, 'z')] = 1\nret_val = m",
        voxels([5, 6, 19]),
    ),
    "a point 4cm away from the bowl": (
        "m = get_empty_affordance_map()\nbowl = parse_query_obj('bowl')\n"
        "xyz = bowl.position + cm2index(4, bowl.normal)\nm[xyz[0], xyz[1], xyz[2]] = 1\nret_val = m",
        voxels([5, 6, 11]),
    ),
    "the lower cup": (
        "m = get_empty_affordance_map()\ncups = parse_query_obj('cups')\nbest = cups[0]\nfor cup in cups:\n"
        "    if np.linalg.norm(cup.position - parse_query_obj('bowl').position) < "
        "np.linalg.norm(best.position - parse_query_obj('bowl').position):\n        best = cup\n"
        "m[tuple(best.position)] = 1\nret_val = m",
        voxels([3, 3, 3]),
    ),
    "half a voxel": (
        "m = get_empty_affordance_map()\nlow, high = parse_query_obj('bowl').aabb\nmiddle = (low + high + 1) / 2\n"
        "m[middle[0], middle[1], middle[2]] = 1\nreturn m",
        voxels([6, 6, 8]),
    ),
    "1cm around the bowl, only below": (
        "m = set_voxel_by_radius(get_empty_affordance_map(), parse_query_obj('bowl').position, radius_cm=1)\n"
        "m[:, :, 7:] = 0\nm[:5, :, :] = 0\nm[:, 6:, :] = 0\nret_val = m",
        voxels([5, 5, 6], [6, 5, 6]),
    ),
}


@pytest.mark.parametrize("query", AFFORDANCES)
def test_a_program_marks_the_place_it_means(setup: Callable[..., Setup], query: str) -> None:
    program, marked = AFFORDANCES[query]
    robot = setup({**FINDS, ("get_affordance_map", query): program})
    assert np.argwhere(robot.lmps.get_affordance_map(query)() == 1).tolist() == marked


def test_a_program_turns_the_hand_in_a_part_of_the_space(setup: Callable[..., Setup]) -> None:
    program = (
        "m = get_empty_rotation_map()\nq = vec2quat(-parse_query_obj('bowl').normal)\nm[:, 6:, :] = q\nret_val = m"
    )
    robot = setup({**FINDS, ("get_rotation_map", "face the bowl"): program})
    made = robot.lmps.get_rotation_map("face the bowl")()
    assert made[0, 5, 0].tolist() == [1, 0, 0, 0]
    assert made[0, 6, 0].tolist() == [0, 0, 0, -1]


def test_a_program_slows_down_and_avoids(setup: Callable[..., Setup]) -> None:
    slow = "m = get_empty_velocity_map()\nm[:] = 0.75\nm[:, :parse_query_obj('bowl').position[1], :] *= 2\nret_val = m"
    avoid = (
        "m = get_empty_avoidance_map()\nfor cup in parse_query_obj('cups'):\n"
        "    set_voxel_by_radius(m, cup.position, radius_cm=1, value=1)\nret_val = m"
    )
    robot = setup({**FINDS, ("get_velocity_map", "slow"): slow, ("get_avoidance_map", "avoid the cups"): avoid})
    made = robot.lmps.get_velocity_map("slow")()
    assert (made[0, 5, 0], made[0, 6, 0]) == (1.5, 0.75)
    assert robot.lmps.get_avoidance_map("avoid the cups")().sum() == 54
