"""Language programs: what the model is asked, what its programs may do, what becomes of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.llm_server import Answer, LlmServer, code, failure, serving

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.lmp import Lmps, build_lmps
from voxposer.language.lmp_config import CONFIGS, MAPS, NAMES, Call, LmpError
from voxposer.language.observations import DynamicObservation, DynamicObservations, LazyMap, Observation
from voxposer.language.prompts import code_in, load_prompts
from voxposer.language.replies import LlmError
from voxposer.sandbox.guard import Limits

# Of a library that litellm uses.
pytestmark = pytest.mark.filterwarnings("ignore:Item .* on TypedDict class:UserWarning")

SIZE = 20
OBJECTS = ("bowl_1", "plate_1", "cup_1", "cup_2")
PROMPTS = {name: f"# Query: an example for {name}.\npass" for name in NAMES}


class World:
    """Things at voxels, one centimetre a voxel, and what was done."""

    def __init__(self) -> None:
        self.positions = {"bowl_1": [5, 6, 7], "plate_1": [10, 12, 2], "cup_1": [3, 3, 3], "cup_2": [4, 15, 3]}
        self.positions["gripper"] = [9, 9, 15]
        self.done: list[tuple[Any, ...]] = []

    def detect(self, name: str) -> Observation:
        position = np.array(self.positions[name])
        aabb = np.stack([position - 1, position + 1])
        return Observation(
            {"name": name, "position": position, "aabb": aabb, "normal": np.array([0.0, 0.0, 1.0]), "_points": [1]}
        )

    def execute(self, movable: Any, affordance_map: Any = None, **maps: Any) -> None:
        given = {"affordance_map": affordance_map, **maps}
        evaluated = {name: value() for name, value in given.items() if value is not None}
        self.done.append((movable()["name"], evaluated))

    def set_voxel_by_radius(self, voxel_map: np.ndarray, xyz: Any, radius_cm: float = 0, value: Any = 1) -> np.ndarray:
        low, high = (np.clip(np.asarray(xyz) + sign * int(radius_cm), 0, SIZE - 1) for sign in (-1, 1))
        voxel_map[low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1] = value
        return voxel_map

    def cm2index(self, cm: float, direction: Any) -> Any:
        return int(cm) if isinstance(direction, str) else np.round(cm * direction).astype(int)

    def functions(self) -> dict[str, Callable[..., Any]]:
        return {
            "detect": self.detect,
            "execute": self.execute,
            "reset_to_default_pose": lambda: self.done.append(("reset",)),
            "set_voxel_by_radius": self.set_voxel_by_radius,
            "cm2index": self.cm2index,
            "vec2quat": lambda vector: np.array([0.0, *vector]),
            "get_empty_affordance_map": lambda: np.zeros((SIZE,) * 3),
            "get_empty_avoidance_map": lambda: np.zeros((SIZE,) * 3),
            "get_empty_velocity_map": lambda: np.ones((SIZE,) * 3),
            "get_empty_gripper_map": lambda: np.ones((SIZE,) * 3),
            "get_empty_rotation_map": lambda: np.tile([1.0, 0, 0, 0], (SIZE,) * 3 + (1,)),
        }


class Setup:
    """Language programs whose model answers from a table: (LMP, query) -> reply."""

    def __init__(self, server: LlmServer, answers: Mapping[tuple[str, str], str | Answer], **options: Any) -> None:
        self.server, self.answers, self.world = server, dict(answers), World()
        server.requests.clear()
        server.answer = self._answer
        self.llm = Llm(LlmConfig(model="openai/local", api_base=server.base, api_key="k", cache=False, attempts=1))
        self.lmps = Lmps(self.world.functions(), self.llm, PROMPTS, **options)
        self.lmps.set_context(OBJECTS)

    def _answer(self, request: Mapping[str, Any]) -> Answer:
        found = self.answers[asked_of(request), asked(request)]
        return code(found) if isinstance(found, str) else found


def asked_of(request: Mapping[str, Any]) -> str:
    (name,) = re.findall(r"Queries are for `(\w+)`", request["messages"][1]["content"])
    return name


def asked(request: Mapping[str, Any]) -> str:
    return request["messages"][-1]["content"].splitlines()[-1].removeprefix("# Query: ").removesuffix(".")


Answers = Mapping[tuple[str, str], str | Answer]


@pytest.fixture(scope="module")
def running() -> Iterator[LlmServer]:
    with serving() as server:
        yield server


@pytest.fixture
def setup(running: LlmServer) -> Callable[..., Setup]:
    return lambda answers, **options: Setup(running, answers, **options)


FINDS: Answers = {
    ("parse_query_obj", "gripper"): "ret_val = detect('gripper')",
    ("parse_query_obj", "bowl"): "bowl = detect('bowl_1')\nret_val = bowl",
    ("parse_query_obj", "cups"): "ret_val = [detect(name) for name in objects if 'cup' in name]",
}
ABOVE = """affordance_map = get_empty_affordance_map()
bowl = parse_query_obj('bowl')
(min_x, min_y, min_z), (max_x, max_y, max_z) = bowl.aabb
center_x, center_y, center_z = bowl.position
affordance_map[center_x, center_y, max_z + cm2index(5, 'z')] = 1
ret_val = affordance_map"""


def call_of(lmps: Lmps, name: str) -> Call:
    """The only question to an LMP."""
    (call,) = [call for call in lmps.trace if call.lmp == name]
    return call


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


@pytest.mark.parametrize(
    ("name", "stop"), [("planner", ["# Query: ", "objects = "]), ("composer", ["# Query: ", "objects ="])]
)
def test_an_answer_ends_at_the_lmps_own_stop_tokens(setup: Callable[..., Setup], name: str, stop: list[str]) -> None:
    robot = setup({(name, "wait"): "x = 1\n# Query: next.\nboom()", (name, "go"): "x = 1\nobjects = ['a']\nboom()"})
    getattr(robot.lmps, name)("wait")
    getattr(robot.lmps, name)("go")
    assert [request["stop"] for request in robot.server.requests] == [stop, stop]
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
def test_a_truncated_or_empty_answer_is_an_error_of_the_lmp(
    setup: Callable[..., Setup], answer: Answer, told: str
) -> None:
    robot = setup({("composer", "go"): answer})
    with pytest.raises(LmpError, match=rf"composer\('go'\): openai/local: .*{told}") as caught:
        robot.lmps.composer("go")
    assert (caught.value.rule, caught.value.line) == ("reply", None)


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
