"""Planning behind handles, and following a waypoint at a time: the same episodes as the batched agent's."""

from __future__ import annotations

import gc
import weakref
from typing import Any, cast

import numpy as np
import pytest
from support.two_scope import run_two_scopes
from support.voxposer_world import HOME, Obedient, box, snapshot
from test_voxposer_agent import CUBE, REPLIES, Scripted, agent

import vecenv
from vecenv.contract import BatchEnv
from vecenv.errors import InvalidInput
from vecenv.manipulation import reach, rooms
from vecenv.observations import ObjectsSnapshot
from voxposer.agent import Agent, AgentConfig
from voxposer.episode import SUBTASK_BUDGET, SUCCESS
from voxposer.language.llm import Llm, LlmConfig
from voxposer.planned import PlannedMotion
from voxposer.runtime import HandleError, RuntimeConfig, Runtimes

PUSHING = {
    "push": 'composer("push it")\ncomposer("lift up")',
    "push it": "it = parse_query_obj('plate')\nexecute(it, affordance_map=get_affordance_map('aside'))",
    "plate": "ret_val = detect('plate_1')",
    "aside": "volume = get_empty_affordance_map()\nx, y, z = parse_query_obj('plate').position\n"
    "volume[x + 20, y, z] = 1\nret_val = volume",
    "on the table": "if detect('plate_1').position[2] > 50: raise ValueError('no plate on the table')\n"
    "composer('look')",
    "nothing": 'composer("look")\ncomposer("lift up")',
    "look": "parse_query_obj('gripper')",
    "nowhere": "x = 1",
    "far": 'composer("go far")\ncomposer("lift up")',
    "go far": "execute(parse_query_obj('gripper'), affordance_map=get_affordance_map('over there'))",
    "over there": "volume = get_empty_affordance_map()\nvolume[80, 50, 50] = 1\nret_val = volume",
}
PLATE = {"plate_1": box((0.07, 0.07, 0.02), (0, 0, 0.02))}


def runtimes(most: int = 8, **options: Any) -> Runtimes:
    replies = {**REPLIES, **PUSHING}
    llm = Scripted(dict(sorted(replies.items(), key=lambda item: -len(item[0]))))
    return Runtimes(llm, RuntimeConfig(**options), most=most)


def opened(table: Runtimes, words: str, seen: ObjectsSnapshot) -> tuple[list[str], tuple[tuple[str, ...], ...]]:
    handles = table.init([seen])
    return handles, table.planner(handles, [words]).subtask_list


# -- handles -----------------------------------------------------------------------------------------------------------


def test_a_handle_is_good_until_it_is_released() -> None:
    table = runtimes()
    handles = table.init([snapshot(CUBE), snapshot(CUBE)])
    assert len(set(handles)) == len(table) == 2
    table.release(handles[:1])
    assert len(table) == 1
    with pytest.raises(HandleError, match=f"no open episode has the handle '{handles[0]}'"):
        table.planner(handles[:1], ["lift"])
    with pytest.raises(HandleError):
        table.release(handles[:1])


def test_only_so_many_episodes_are_open_at_once() -> None:
    table = runtimes(most=2)
    table.init([snapshot(CUBE)])
    with pytest.raises(HandleError, match="1 episodes are open, and 2 may be"):
        table.init([snapshot(CUBE)] * 2)
    assert len(table) == 1


def test_a_released_episode_frees_its_snapshot() -> None:
    table, seen = runtimes(), snapshot(CUBE)
    handles, subtasks = opened(table, "lift", seen)
    table.plan_subtask(handles, subtasks, [0], [seen])
    there = weakref.ref(table.slot(handles[0]).interface.perception)
    table.release(handles)
    gc.collect()
    assert there() is None


def test_the_time_of_programs_is_not_spent_on_compiling() -> None:
    kernels = (reach._kernel, reach._forward_kernel, rooms._kernel)
    for kernel in kernels:
        kernel.cache_clear()
    runtimes()
    assert all(kernel.cache_info().currsize for kernel in kernels)


# -- subtasks ----------------------------------------------------------------------------------------------------------


def test_an_instruction_becomes_subtasks_and_errors_are_told_by_slot() -> None:
    table = runtimes()
    handles = table.init([snapshot(CUBE), snapshot(CUBE), None])
    found = table.planner(handles, ["lift", "nowhere", "lift"])
    assert found.subtask_list[0] == ("lift up", "lift up")
    assert found.subtask_count.tolist() == [2, 0, 0]
    assert found.error == ("", "the planner found nothing to do", "no observation: the slot is not running")


def test_what_a_plan_presupposes_is_checked_before_anything_moves_and_only_once() -> None:
    table, high = runtimes(), snapshot({"plate_1": box((0.07, 0.07, 0.02), (0, 0, 0.4))})
    (refused,) = table.planner(table.init([high]), ["on the table"]).error
    assert "no plate on the table" in refused
    handles, first = opened(table, "on the table", snapshot(PLATE))
    assert first == (("look",),)
    table.observe(handles, [high])
    again = table.planner(handles, ["on the table"])
    assert (again.subtask_list, again.error) == (first, ("",))


def test_a_subtask_becomes_a_trajectory() -> None:
    table, seen = runtimes(), snapshot(CUBE)
    handles, subtasks = opened(table, "lift", seen)
    found = table.plan_subtask(handles, subtasks, [0], [seen])
    assert (found.subtask_text, found.movable_name, found.error) == (("lift up",), ("gripper",), ("",))
    assert found.next_subtask_index.tolist() == [1]
    assert not found.object_centric.any()
    assert not found.prev_gripper.any()
    trajectory = found.trajectory
    assert found.n_waypoints[0] == trajectory.valid.sum()
    assert trajectory.waypoints[0, found.n_waypoints[0] - 1, 2] > HOME[2] + 0.02
    np.testing.assert_allclose(trajectory.waypoints[0, 0, 3:7], HOME[3:], atol=1e-9)
    assert trajectory.final[0].sum() == 1


def test_every_trajectory_has_an_identity_of_its_own() -> None:
    table, seen = runtimes(), snapshot(CUBE)
    handles, subtasks = opened(table, "lift", seen)
    identities = [int(table.plan_subtask(handles, subtasks, [0], [seen]).trajectory.identity[0]) for _ in range(3)]
    assert len(set(identities)) == 3


def test_programs_that_ask_for_nothing_are_followed_by_the_next() -> None:
    table, seen = runtimes(), snapshot(CUBE)
    handles, subtasks = opened(table, "nothing", seen)
    found = table.plan_subtask(handles, subtasks, [0], [seen])
    assert found.subtask_text == ("lift up",)
    assert found.next_subtask_index.tolist() == [2]
    found = table.plan_subtask(handles, subtasks, found.next_subtask_index, [snapshot(CUBE)])
    assert (found.n_waypoints[0], found.error[0]) == (0, "")


def test_an_error_stops_its_slot_and_no_other() -> None:
    table = runtimes()
    seen = [snapshot(CUBE), snapshot(CUBE)]
    handles = table.init(seen)
    subtasks = table.planner(handles, ["break", "lift"]).subtask_list
    found = table.plan_subtask(handles, subtasks, [0, 0], seen)
    assert "nothing_like_this" in found.error[0]
    assert found.error[1] == ""
    assert found.n_waypoints[0] == 0 < found.n_waypoints[1]
    assert found.next_subtask_index.tolist() == [1, 1]  # past the last of the first slot's


def pushed(x: float) -> ObjectsSnapshot:
    return snapshot({"plate_1": box((0.07, 0.07, 0.02), (x, 0, 0.02))}, gripper=np.array([0.0, 0.0]))


def test_a_pushed_object_keeps_the_index_until_it_has_arrived() -> None:
    table = runtimes()
    handles, subtasks = opened(table, "push", pushed(0.0))
    first = table.plan_subtask(handles, subtasks, [0], [pushed(0.0)])
    assert first.object_centric.all()
    assert first.movable_name == ("plate_1",)
    assert first.next_subtask_index.tolist() == [0]
    assert first.n_waypoints[0] > 0
    again = table.plan_subtask(handles, subtasks, first.next_subtask_index, [pushed(0.1)])
    assert again.next_subtask_index.tolist() == [0]
    assert table.slot(handles[0]).progress.begun == 1  # its program was not run again
    last = table.plan_subtask(handles, subtasks, again.next_subtask_index, [pushed(0.2)])
    assert last.subtask_text == ("lift up",)
    assert last.next_subtask_index.tolist() == [2]


def test_another_index_abandons_an_unfinished_subtask() -> None:
    table = runtimes()
    handles, subtasks = opened(table, "push", pushed(0.0))
    table.plan_subtask(handles, subtasks, [0], [pushed(0.0)])
    found = table.plan_subtask(handles, subtasks, [1], [pushed(0.0)])
    assert found.subtask_text == ("lift up",)
    assert not found.object_centric.any()


def test_a_motion_is_planned_again_until_the_hand_is_there() -> None:
    """With three waypoints a plan, the way over a tower takes several plans, each from where the hand is."""
    tower = {"tower_1": box((0.03, 0.03, 0.2), (0.15, 0, 0.2), 4000)}
    table, env = runtimes(num_waypoints_per_plan=3, max_plan_iter=9), Obedient(snapshot(tower))
    handles, subtasks = opened(table, "far", env.snapshots[0])
    index, visited = np.array([0]), [HOME[:3]]
    while True:
        found = table.plan_subtask(handles, subtasks, index, env.snapshots)
        index = found.next_subtask_index
        if found.subtask_text != ("go far",):
            break
        assert found.n_waypoints[0] <= 3
        assert index[0] == 0
        end = found.trajectory.waypoints[0, found.n_waypoints[0] - 1, :7]
        env.snapshots = [snapshot(tower, ee_pose=end)]
        visited.append(env.snapshots[0].ee_pose[:3])
    assert len(visited) > 3
    np.testing.assert_allclose(visited[-1], [0.31, 0.0, 0.2], atol=0.02)


def test_a_motion_is_planned_no_more_often_than_allowed() -> None:
    """A hand that does not move never gets there."""
    table, texts = runtimes(max_plan_iter=3), list[int]()
    handles, subtasks = opened(table, "lift", snapshot(CUBE))
    index = np.array([0])
    for _ in range(4):
        found = table.plan_subtask(handles, subtasks, index, [snapshot(CUBE)])
        index = found.next_subtask_index
        texts.append(table.slot(handles[0]).progress.begun)
    assert texts == [1, 1, 1, 2]


@pytest.mark.parametrize("name", ["max_subtasks", "max_waypoints", "num_waypoints_per_plan", "max_plan_iter"])
def test_budgets_are_positive_and_default_to_those_of_the_method(name: str) -> None:
    with pytest.raises(InvalidInput, match=f"{name} must be at least 1, got 0"):
        RuntimeConfig(**cast(Any, {name: 0}))
    wanted = {"max_subtasks": 8, "max_waypoints": 80, "num_waypoints_per_plan": 10_000, "max_plan_iter": 1}
    assert getattr(RuntimeConfig(), name) == wanted[name]


def test_motions_are_kept_as_they_were_planned() -> None:
    motions: list[PlannedMotion] = []
    acting, _ = agent(Obedient(snapshot(CUBE), snapshot(CUBE)), ("break", "lift"), motions.append)
    acting.step()
    (motion,) = motions
    assert motion.slot == 1  # of the batch, not the row of the call
    assert motion.obstacles is not None
    assert motion.obstacles.max() > 0.3  # the table and the cube
    np.testing.assert_array_equal(motion.start, HOME)
    lmps = [acting.slots[1].lmps.trace[i].lmp for i in motion.calls]
    assert lmps[0] == "composer"
    assert "get_affordance_map" in lmps


# -- the agent on the layer --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [("lift",), ("break", "lift"), ("lift", "lift", "nothing")])
def test_a_waypoint_a_call_takes_the_ticks_of_a_plan(words: tuple[str, ...]) -> None:
    ended = []
    for follow in ("plan", "waypoint"):
        env = Obedient(*[snapshot(CUBE) for _ in words])
        replies = {**REPLIES, **PUSHING}
        llm = Scripted(dict(sorted(replies.items(), key=lambda item: -len(item[0]))))
        acting = Agent(cast(BatchEnv, env), words, llm, AgentConfig(passes=1, follow=cast(Any, follow)))
        for _ in range(3):
            acting.step()
        assert bool(env.waypoints) == (follow == "waypoint")
        ended.append((env.ticks.tolist(), [s.ee_pose.tolist() for s in env.snapshots], [s.cause for s in acting.slots]))
    assert ended[0] == ended[1]


def test_another_way_to_follow_is_refused() -> None:
    with pytest.raises(InvalidInput, match="follow='both': expected one of plan, waypoint"):
        AgentConfig(follow=cast(Any, "both"))


def test_the_agent_keeps_budgets_of_subtasks_and_waypoints() -> None:
    env = Obedient(snapshot(CUBE))
    acting, _ = agent(env, ("lift",), max_subtasks=1, max_waypoints=3)
    acting.step()
    assert env.plans[0].valid.sum() == 3
    acting.step()
    assert acting.slots[0].cause == SUBTASK_BUDGET


def test_an_episode_that_is_stopped_ends_at_once_if_it_is_not_to_wait() -> None:
    env = Obedient(snapshot(CUBE), snapshot(CUBE))
    acting, _ = agent(env, ("break", "lift"), wait=False)
    control = acting.step()
    assert control.done.tolist() == [True, False]
    while not control.done.all():
        control = acting.step()
    assert acting.slots[1].cause == "followed to the end without success"


# -- on native physics -------------------------------------------------------------------------------------------------


def batched(suite: str, task: int, episodes: list[int], **options: Any) -> list[tuple[bool, int]]:
    """Verdict and ticks of each episode, by the agent."""
    with vecenv.make(suite, task=task, episodes=episodes) as env:
        info = env.reset()
        config = AgentConfig(passes=1, wait=False, **options)
        acting = Agent(env, info.instruction, Llm(LlmConfig(model="offline/libero")), config)
        while not env.done.all():
            acting.step()
        found = env.evaluate()
        return list(zip(found.success.tolist(), found.num_steps.tolist(), strict=True))


def two_scopes(suite: str, task: int, episode: int) -> tuple[bool, int, str]:
    with vecenv.make(suite, task=task, episodes=[episode]) as env:
        return run_two_scopes(env, Runtimes(Llm(LlmConfig(model="offline/libero"))))


def test_two_loops_over_the_layer_end_as_the_batched_agent_does() -> None:
    success, ticks, reason = two_scopes("libero_object", 0, 1)
    assert batched("libero_object", 0, [0, 1])[1] == (success, ticks)
    assert success
    assert reason == SUCCESS


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("suite", "task"), [("libero_object", 5), ("libero_spatial", 2), ("libero_goal", 0), ("libero_goal", 7)]
)
def test_both_ways_to_follow_and_two_loops_take_the_same_ticks(suite: str, task: int) -> None:
    episodes = [0, 1, 2]
    plans = batched(suite, task, episodes)
    assert batched(suite, task, episodes, follow="waypoint") == plans
    assert [two_scopes(suite, task, episode)[:2] for episode in episodes] == plans
    assert all(success for success, _ in plans)


@pytest.mark.heavy
def test_pushes_take_the_same_ticks_a_waypoint_a_call() -> None:
    plans = batched("libero_goal", 5, [0, 1])
    assert batched("libero_goal", 5, [0, 1], follow="waypoint") == plans
    # With the budgets of the two loops there is room for eight pushes.
    budgets = {"max_subtasks": 8, "max_waypoints": 80}
    assert [two_scopes("libero_goal", 5, episode)[:2] for episode in (0, 1)] == batched(
        "libero_goal", 5, [0, 1], **budgets
    )
