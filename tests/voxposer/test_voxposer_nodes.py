"""VoxPoser's tools: the two-scope graph through their ports alone, and each tool on its own."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.node_graph import Graph, Verdict
from support.voxposer_world import box, snapshot

import vecenv
from vecenv.errors import InvalidInput
from vecenv.interop.nodes import EnvLiberoNodeSet, snapshot_to_dict
from voxposer import node_episodes
from voxposer.agent import Agent, AgentConfig
from voxposer.episode import ALL_SUBTASKS, EXHAUSTED, MAX_SUBTASKS, MAX_WAYPOINTS, SUCCESS
from voxposer.language.llm import Llm, LlmConfig
from voxposer.node_episodes import RuntimeManager
from voxposer.nodes import VoxPoserNodeSet

CUBE = snapshot_to_dict(snapshot({"cube_1": box((0.02, 0.02, 0.02), (0.1, 0, 0.02))}))
POSE = [0.1, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
OPEN, CLOSED = [*POSE, 0.0], [*POSE, 1.0]


@pytest.fixture
def nodes() -> Iterator[VoxPoserNodeSet]:
    made = VoxPoserNodeSet(manager=RuntimeManager())
    yield made
    made.shutdown()


@pytest.fixture
def call(nodes: VoxPoserNodeSet) -> Any:
    def run(verb: str, config: Mapping[str, Any] | None = None, node: str = "", **inputs: Any) -> dict[str, Any]:
        return nodes.tools[f"voxposer__{verb}"].run(inputs, config, node=node)

    return run


# -- the graph ---------------------------------------------------------------------------------------------------------


def by_graph(suite: str, task: int, episodes: Sequence[int], **options: Any) -> list[Verdict]:
    libero, voxposer = EnvLiberoNodeSet((suite,)), VoxPoserNodeSet(manager=RuntimeManager())
    found = []
    try:
        libero.panel.set_field("task_id", task)
        for episode in episodes:
            assert libero.panel.set_field("episode_index", episode).error == ""
            graph = Graph(libero, voxposer, **options)
            found.append(graph.run())
            assert graph.errors == []
    finally:
        libero.shutdown()
        voxposer.shutdown()
    return found


def by_agent(suite: str, task: int, episodes: Sequence[int], **options: Any) -> list[tuple[bool, int]]:
    with vecenv.make(suite, task=task, episodes=episodes) as env:
        info = env.reset()
        config = AgentConfig(passes=1, wait=False, max_subtasks=MAX_SUBTASKS, max_waypoints=MAX_WAYPOINTS, **options)
        acting = Agent(env, info.instruction, Llm(LlmConfig(model="offline/libero")), config)
        while not env.done.all():
            acting.step()
        metrics = env.evaluate()
        return list(zip(metrics.success.tolist(), metrics.num_steps.tolist(), strict=True))


def test_the_graph_ends_as_the_batched_agent_does_with_everything_as_json() -> None:
    (verdict,) = by_graph("libero_object", 0, [1], through_json=True)
    assert by_agent("libero_object", 0, [1]) == [verdict[:2]]
    assert verdict.success
    assert verdict.reason == SUCCESS


# Tasks with a grasp and a place, drawers, a stove's knob, and one that is pushed.
TWENTY = [
    ("libero_object", 0, 4),
    ("libero_object", 6, 2),
    ("libero_spatial", 2, 4),
    ("libero_spatial", 6, 2),
    ("libero_goal", 0, 2),
    ("libero_goal", 5, 2),
    ("libero_goal", 7, 2),
    ("libero_goal", 8, 2),
]


@pytest.mark.heavy
@pytest.mark.parametrize(("suite", "task", "count"), TWENTY)
def test_the_graph_ends_as_the_batched_agent_does_in_twenty_episodes(suite: str, task: int, count: int) -> None:
    assert sum(count for _, _, count in TWENTY) == 20
    episodes = range(count)
    found = by_graph(suite, task, episodes)
    print(suite, task, found)
    assert [verdict[:2] for verdict in found] == by_agent(suite, task, episodes)


@pytest.mark.heavy
@pytest.mark.parametrize(("suite", "task", "count"), TWENTY[::3])
def test_without_the_additional_wire_it_is_the_agent_that_never_gives_up(suite: str, task: int, count: int) -> None:
    episodes = range(count)
    found = by_graph(suite, task, episodes, wired=False)
    assert [verdict[:2] for verdict in found] == by_agent(suite, task, episodes, max_misses=1_000_000)


# -- planning ----------------------------------------------------------------------------------------------------------


def test_planning_reads_the_snapshot_that_it_is_given_and_moves_nothing(call: Any) -> None:
    with vecenv.make("libero_object", task=0, episodes=[0]) as env:
        info = env.reset()
        (seen,) = env.observe_objects().snapshot
        assert seen is not None
        frozen = snapshot_to_dict(seen)
        before, qpos = json.dumps(frozen, default=np.ndarray.tolist), env.state().qpos
        handle = call("init", snapshot=frozen)["runtime_handle"]
        planned = call("planner_lmp", runtime_handle=handle, instruction=info.instruction[0])
        env.step_continuous(np.ones((1, 20, 7)))
        arguments = {"runtime_handle": handle, "subtask_list": planned["subtask_list"], "subtask_index": 0}
        subtask = call("plan_subtask", **arguments, snapshot=frozen)
        assert env.evaluate().num_steps.tolist() == [20]
        assert not np.array_equal(env.state().qpos, qpos)
    assert planned["subtask_count"] == len(planned["subtask_list"]) > 1
    assert json.dumps(frozen, default=np.ndarray.tolist) == before
    assert subtask["n_waypoints"] == len(subtask["trajectory"]) > 1
    assert subtask["next_subtask_index"] == 1
    assert subtask["prev_gripper"] is False
    again = call("init", snapshot=frozen)["runtime_handle"]
    assert again != handle
    call("planner_lmp", runtime_handle=again, instruction=info.instruction[0])
    same = call("plan_subtask", **{**arguments, "runtime_handle": again}, snapshot=frozen)
    assert [row["pose"] for row in same["trajectory"]] == [row["pose"] for row in subtask["trajectory"]]


def test_a_handle_that_is_of_no_open_episode_is_named(call: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "'nothing'" in call("planner_lmp", runtime_handle="nothing", instruction="lift it")["error"]
    monkeypatch.setattr(node_episodes, "MOST_EPISODES", 2)
    first, second, third = (call("init", snapshot=CUBE)["runtime_handle"] for _ in range(3))
    assert "no open episode has the handle" in call("planner_lmp", runtime_handle=first, instruction="x")["error"]
    for handle in (second, third):
        assert "handle" not in call("planner_lmp", runtime_handle=handle, instruction="x")["error"]


def test_shutdown_releases_the_episodes(nodes: VoxPoserNodeSet, call: Any) -> None:
    handle = call("init", snapshot=CUBE)["runtime_handle"]
    nodes.shutdown()
    assert "call initialize() first" in call("planner_lmp", runtime_handle=handle, instruction="x")["error"]
    nodes.initialize()
    assert "no open episode" in call("planner_lmp", runtime_handle=handle, instruction="x")["error"]


def test_options_reach_the_planner_and_graphs_cannot_name_files_or_addresses(nodes: VoxPoserNodeSet, call: Any) -> None:
    config = {"map_size": 60, "options": {"planner.max_steps": 200}}
    handle = call("init", config, snapshot=CUBE)["runtime_handle"]
    made = nodes.manager.runtimes(handle).config
    assert (made.perception.map_size, made.planner.max_steps) == (60, 200)
    other = call("init", config, snapshot=CUBE)["runtime_handle"]
    assert nodes.manager.runtimes(other) is nodes.manager.runtimes(handle)
    for name in ("api_base", "cache", "prompts_dir", "replay", "options", "perception.map_size"):
        refused = call("init", {"options": {name: "x"}}, snapshot=CUBE)
        assert refused["error"].startswith(f"config.options.{name} is not taken from a graph")
        assert refused["runtime_handle"] == ""
    assert "no option 'planer'" in call("init", {"options": {"planer": 1}}, snapshot=CUBE)["error"]
    assert "api_key is not taken" in call("init", {"options": {"api_key": "x"}}, snapshot=CUBE)["error"]
    for name, value in (("passes", 2), ("plan.settle", 3), ("perception", "camera"), ("max_misses", 1)):
        assert "has no effect here" in call("init", {"options": {name: value}}, snapshot=CUBE)["error"]
    with pytest.raises(InvalidInput, match="no option 'nothing'"):
        nodes.initialize(nothing=1)
    nodes.initialize(num_waypoints_per_plan=7)
    assert nodes.manager.runtimes(call("init", snapshot=CUBE)["runtime_handle"]).config.num_waypoints_per_plan == 7


# -- following ---------------------------------------------------------------------------------------------------------


def test_a_change_of_the_grip_is_a_drive_and_a_hold_and_the_grip_is_carried(call: Any) -> None:
    found = call("expand_for_settle", {"settle": 0}, trajectory=[OPEN, CLOSED, CLOSED])
    assert [(row["pose"][7], row["hold_steps"]) for row in found["expanded"]] == [(0, 0), (0, 0), (1, 60), (1, 0)]
    assert (found["n_in"], found["n_out"], found["n_holds_inserted"], found["last_gripper"]) == (3, 4, 1, True)
    carried = call("expand_for_settle", {"settle": 0}, trajectory=[CLOSED])
    assert carried["n_holds_inserted"] == 0
    assert call("expand_for_settle", {"settle": 0}, node="other", trajectory=[CLOSED])["n_holds_inserted"] == 1
    told = call("expand_for_settle", {"settle": 0, "settle_steps": 5}, trajectory=[CLOSED], prev_gripper=0.0)
    assert [row["hold_steps"] for row in told["expanded"]] == [0, 5]
    assert call("expand_for_settle", {"max_waypoints": 2}, trajectory=[OPEN] * 9)["n_out"] == 2


def test_a_new_episode_begins_with_open_fingers_and_at_the_first_waypoint(nodes: VoxPoserNodeSet, call: Any) -> None:
    call("expand_for_settle", trajectory=[CLOSED])
    assert call("dispense_waypoint", trajectory=[OPEN, OPEN])["cursor"] == 1
    nodes.on_signal("something_else")
    assert call("dispense_waypoint", trajectory=[OPEN, OPEN])["cursor"] == 2
    nodes.on_signal("episode_reset", {"suite": "libero_object"})
    assert call("dispense_waypoint", trajectory=[OPEN, OPEN])["cursor"] == 1
    assert call("expand_for_settle", trajectory=[CLOSED])["n_holds_inserted"] == 1


def test_a_panels_signal_reaches_the_tools(nodes: VoxPoserNodeSet, call: Any) -> None:
    libero = EnvLiberoNodeSet(("libero_object",))
    libero.panel.subscribe(nodes.on_signal)
    call("expand_for_settle", trajectory=[CLOSED])
    assert libero.panel.action("reset").signal_name == "episode_reset"
    assert call("expand_for_settle", trajectory=[CLOSED])["n_holds_inserted"] == 1
    libero.shutdown()


def test_the_cursor_goes_through_a_trajectory_and_begins_anew_with_another(call: Any) -> None:
    rows = call("expand_for_settle", {"settle": 0}, trajectory=[OPEN, OPEN, CLOSED])["expanded"]
    given = [call("dispense_waypoint", trajectory=rows) for _ in range(5)]
    assert [each["cursor"] for each in given] == [1, 2, 3, 4, 4]
    assert [each["done"] for each in given] == [False, False, False, True, True]
    assert [each["progress"] for each in given] == [0.25, 0.5, 0.75, 1.0, 1.0]
    assert given[3]["waypoint"]["hold_steps"] == 60
    assert given[4]["waypoint"] is None
    assert call("dispense_waypoint", trajectory=[OPEN])["cursor"] == 1
    empty = call("dispense_waypoint", trajectory=[])
    assert (empty["waypoint"], empty["done"], empty["cursor"]) == (None, True, 0)
    # Equal waypoints of another plan are another trajectory.
    for plan in ("a", "b"):
        assert call("dispense_waypoint", trajectory=[{"pose": OPEN, "plan": plan}])["cursor"] == 1


def test_waypoints_out_of_reach_are_left_out_where_the_dispenser_hears_of_them(call: Any) -> None:
    rows = call("expand_for_settle", {"settle": 0}, trajectory=[OPEN, OPEN, OPEN, OPEN, CLOSED])["expanded"]
    call("dispense_waypoint", trajectory=rows)
    call("dispense_waypoint", trajectory=rows, converged=False)
    third = call("dispense_waypoint", trajectory=rows, converged=False)
    assert third["waypoint"]["hold_steps"] == 60
    for _ in range(4):
        given = call("dispense_waypoint", {"max_misses": None}, trajectory=rows, converged=False)
        assert given["waypoint"]["hold_steps"] == 0


def test_an_action_is_an_8_vector_or_an_object(call: Any) -> None:
    def action(waypoint: Any, **config: Any) -> Any:
        outputs = call("plan_executor", config, waypoint=waypoint)
        assert outputs["has_action"] is (outputs["action"] != "[]")
        return json.loads(outputs["action"])

    assert action(CLOSED) == CLOSED
    assert action({"pose": CLOSED, "hold_steps": 60}) == {"pose": CLOSED, "hold_steps": 60}
    carried = {"pose": CLOSED, "hold_steps": 0, "carry": True}
    assert action(carried) == {"pose": CLOSED, "carry": True}
    assert action(carried, carry=False) == CLOSED
    assert action(None) == action([]) == []


def test_the_loops_end_for_the_reasons_of_the_layer(call: Any) -> None:
    def inner(**inputs: bool) -> str:
        return call("check_waypoint_done", **{"cursor_done": False, "episode_success": False, **inputs})["reason"]

    assert [inner(), inner(cursor_done=True), inner(episode_success=True)] == ["", EXHAUSTED, SUCCESS]
    assert "budget" in inner(truncated=True)
    usual = {"subtask_index": 1, "subtask_count": 3, "episode_success": False, "step_index": 9, "max_steps": 10}
    for changes, reason in (
        ({}, ""),
        ({"subtask_index": 3}, ALL_SUBTASKS),
        ({"episode_success": True}, SUCCESS),
        ({"step_index": 10}, "env step budget spent"),
    ):
        ended = call("check_done", **{**usual, **changes})
        assert (ended["done"], ended["reason"]) == (bool(reason), reason)
    broken = call("check_done", **{**usual, "step_index": "many"})
    assert broken["done"]
    assert "'step_index': got a str" in broken["error"]


NESTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.just(OPEN),
    lambda inner: (
        st.lists(inner, max_size=8)
        | st.dictionaries(st.sampled_from(["pose", "hold_steps", "plan", "motion", "final", "velocity"]), inner)
    ),
    max_leaves=10,
)
PORTS = ("snapshot", "runtime_handle", "trajectory", "waypoint", "prev_gripper", "subtask_list", "subtask_index")


@given(inputs=st.dictionaries(st.sampled_from(PORTS), NESTED))
@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_tool_raises_whatever_it_is_given(nodes: VoxPoserNodeSet, inputs: Any) -> None:
    for tool in nodes.get_tools():
        fitting = {port.name: inputs[port.name] for port in tool.inputs if port.name in inputs}
        for each in (inputs, fitting):
            outputs = tool.run(each)
            assert set(outputs) == {port.name for port in tool.outputs}
            assert isinstance(outputs["error"], str)


def test_waypoints_that_are_none_are_named(call: Any) -> None:
    for rows, message in (
        ("[]", "got a str; expected a list of waypoints"),
        ([OPEN, [1, 2]], "waypoint 1: expected 8 numbers"),
        ([[*POSE, float("nan")]], "waypoint 0 is not finite"),
        ([{"pose": OPEN, "speed": 1}], "waypoint 0: unknown key 'speed'"),
        ([{"pose": OPEN, "velocity": "fast"}], "waypoint 0: velocity: got a str"),
        ([OPEN] * 100_001, "100,001 waypoints; at most 100,000 are read"),
    ):
        assert message in call("expand_for_settle", trajectory=rows)["error"]
    assert "hold_steps" in call("plan_executor", waypoint={"pose": OPEN, "hold_steps": -1})["error"]
