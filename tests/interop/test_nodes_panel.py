"""Panels of node sets, the thread of their environment, its lifetime, and SIMPLER's tools."""

from __future__ import annotations

import asyncio
import itertools
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.node_calls import BUDGET, SMALL, STAY, SUITE, Caller

import vecenv
from vecenv.interop.nodes import (
    EnvLiberoNodeSet,
    EnvManager,
    EnvSimplerNodeSet,
    NodeError,
    node_sets,
)
from vecenv.interop.nodes import worker as worker_module
from vecenv.interop.nodes.catalog import LiberoCatalog, SimplerCatalog
from vecenv.interop.nodes.worker import Worker
from vecenv.libero.env import LiberoEnv

# -- panel -------------------------------------------------------------------------------------------------------------


def test_a_changed_field_begins_those_below_anew_and_signals_it(libero: EnvLiberoNodeSet) -> None:
    panel, heard = libero.panel, []
    panel.subscribe(lambda name, snapshot: heard.append((name, snapshot)))
    panel.set_field("split", "libero_goal")
    panel.set_field("task_id", "3")
    chosen = panel.set_field("episode_index", 7)
    assert chosen.fields == {"suite": "libero_goal", "task_id": 3, "episode_index": 7} == chosen.snapshot
    assert (chosen.signal_name, chosen.run_start, chosen.step_budget) == ("episode_reset", False, BUDGET)
    assert Caller(libero)("reset")["episode_id"] == "libero_goal/3/7"
    task = panel.set_field("task_id", 4)
    assert task.fields["episode_index"] == 0
    suite = panel.set_field("suite", SUITE)
    assert suite.fields == {"suite": SUITE, "task_id": 0, "episode_index": 0}
    assert [name for name, _ in heard] == ["episode_reset"] * 5
    assert heard[-1][1] == suite.snapshot


def test_play_places_the_episode_and_starts_the_run_and_no_response_has_two_effects(call: Caller) -> None:
    panel = call.nodes.panel
    assert panel is not None
    call("step_continuous", [STAY] * 2)
    responses = {"play": panel.action("play")}
    assert call("evaluate")["metrics"]["num_steps"] == 0
    call("step_continuous", [STAY] * 2)
    responses["pause"] = panel.action("pause")
    resumed = panel.action("play")
    assert (resumed.state, resumed.run_start, resumed.signal_name) == ("playing", False, None)
    assert call("evaluate")["metrics"]["num_steps"] == 2
    responses |= {name: panel.action(name) for name in ("stop", "reset")}
    assert call("evaluate")["metrics"]["num_steps"] == 0
    assert {name: each.state for name, each in responses.items()} == {
        "play": "playing",
        "pause": "paused",
        "stop": "idle",
        "reset": "idle",
    }
    assert [name for name, each in responses.items() if each.run_start] == ["play"]
    assert [name for name, each in responses.items() if each.signal_name] == ["reset"]


def test_what_a_panel_cannot_do_is_a_text_and_changes_nothing(libero: EnvLiberoNodeSet) -> None:
    panel = libero.panel
    panel.set_field("suite", SUITE)
    before = panel.values
    for name, value, message in (
        ("suite", "libero_90", "suite='libero_90' does not exist; there are libero_object, libero_goal"),
        ("task_id", 10, "task_id='10' does not exist; there are 0, 1, 2"),
        ("task_id", True, "task_id='True' does not exist"),
        ("episode_index", "-1", "episode_index='-1' does not exist; there are 0 to 49"),
        ("seed", 3, "field 'seed' does not exist; fields: suite, task_id, episode_index"),
        (["suite"], 1, "does not exist; fields"),
        ("task_id", {"a": []}, "does not exist"),
    ):
        response = panel.set_field(name, value)  # pyright: ignore[reportArgumentType]
        assert message in response.error
        assert (response.fields, response.signal_name) == (before, None)
    assert "there are play, pause, stop, reset" in panel.action("rewind").error
    panel.action("stop")
    assert "nothing is playing" in panel.action("pause").error


def test_an_episode_that_cannot_be_made_leaves_the_selection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VECENV_SIMPLER_ASSETS", "/nowhere")
    manager = EnvSimplerNodeSet.new_manager()
    nodes = EnvSimplerNodeSet(manager=manager)
    response = nodes.panel.set_field("split", "google_robot")
    assert "vecenv assets pull simpler" in response.error or "vecenv[simpler]" in response.error
    assert response.fields["split"] == "bridge"
    assert Caller(nodes)("reset")["error"]
    assert response.step_budget == 60
    nodes.shutdown()


# -- threads and lifetimes ---------------------------------------------------------------------------------------------

SIMULATOR = (
    "reset",
    "set_episodes",
    "step_continuous",
    "step_ee_pose",
    "observe_egocentric",
    "observe_objects",
    "close",
)


def test_every_call_of_the_simulator_is_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: dict[str, set[int]] = {name: set() for name in ("__init__", *SIMULATOR)}

    def watched(name: str, method: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            threads[name].add(threading.get_ident())
            return method(*args, **kwargs)

        return call

    for name in threads:
        monkeypatch.setattr(LiberoEnv, name, watched(name, getattr(LiberoEnv, name)))
    nodes = EnvLiberoNodeSet((SUITE,))
    call = Caller(nodes)
    call("reset")

    def work(number: int) -> list[str]:
        texts = [call("step_continuous", STAY)["error"], call("step_ee_pose", "[]")["error"]]
        texts += [call(verb)["error"] for verb in ("reset", "observe_objects", "evaluate")]
        if not number:
            texts += [nodes.panel.set_field("task_id", 1).error, call("observe_egocentric", **SMALL)["error"]]
        return texts

    with ThreadPoolExecutor(3) as pool:
        assert not any(itertools.chain.from_iterable(pool.map(work, range(3))))
    thread = nodes.manager.worker.thread
    nodes.shutdown()
    assert set.union(*threads.values()) == {thread} != {threading.get_ident()}
    assert all(threads.values())


def test_after_shutdown_tools_refuse_until_initialize() -> None:
    nodes = EnvLiberoNodeSet((SUITE,))
    call = Caller(nodes)
    nodes.initialize(max_steps=5)
    assert call("reset")["max_steps"] == 5
    nodes.shutdown()
    nodes.shutdown()
    assert call("reset")["error"] == "env_libero is shut down: call initialize() first"
    nodes.initialize(max_steps=7)
    assert call("reset")["max_steps"] == 7
    assert nodes.panel.step_budget == 7
    nodes.initialize(max_steps=8)
    assert "no episode is placed" in call("evaluate")["error"]
    with pytest.raises(vecenv.OptionError, match="max_step"):
        nodes.initialize(max_step=8)
    nodes.shutdown()


def test_node_sets_of_a_process_share_their_environments() -> None:
    first, second = node_sets(), node_sets()
    for name in ("env_libero", "env_simpler"):
        one, other = first[name], second[name]
        assert isinstance(one, EnvLiberoNodeSet | EnvSimplerNodeSet)
        assert isinstance(other, EnvLiberoNodeSet | EnvSimplerNodeSet)
        assert one.manager is other.manager
    own = EnvLiberoNodeSet(manager=EnvManager("env_libero", LiberoCatalog()))
    assert own.manager is not EnvLiberoNodeSet().manager
    with pytest.raises(NodeError, match="no suite 'libero_11'"):
        EnvLiberoNodeSet(("libero_11",))


def test_a_fork_is_told_that_the_thread_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = Worker("env")
    assert worker.call(lambda: worker.call(lambda: 3)) == 3
    monkeypatch.setattr(worker_module.os, "getpid", lambda: -1)
    with pytest.raises(NodeError, match="this is its fork -1"):
        worker.call(lambda: 3)
    monkeypatch.undo()
    worker.shutdown(lambda: None)


def test_tools_run_beside_an_event_loop(call: Caller) -> None:
    async def both() -> list[dict[str, Any]]:
        tools = call.nodes.tools
        wanted = [("step_continuous", {"action": json.dumps(STAY)}), ("evaluate", {})]
        return await asyncio.gather(*(tools[f"env_libero__{verb}"].run_async(inputs) for verb, inputs in wanted))

    assert [outputs["error"] for outputs in asyncio.run(both())] == ["", ""]


# -- SIMPLER -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def simpler(small: Path) -> Iterator[EnvSimplerNodeSet]:
    pytest.importorskip("sapien")
    nodes = EnvSimplerNodeSet(manager=EnvManager("env_simpler", SimplerCatalog(), {"gripper": "binary"}, keep=True))
    nodes.initialize(assets=str(small), num_threads=1)
    yield nodes
    nodes.shutdown()


def test_simplers_episode_goes_through_both_generations_of_names(simpler: EnvSimplerNodeSet) -> None:
    call = Caller(simpler)
    first = call("reset")
    assert first["episode_id"] == "bridge/widowx_spoon_on_towel/0"
    assert (first["instruction"], first["max_steps"]) == ("put the spoon on the towel", 60)
    assert (first["observation"], first["state"], first["wrist_image"]) == ([], None, None)
    assert first["scene_id"]
    stepped = call("step", [0, 0, 0, 0, 0, 0, 1])
    assert (stepped["step_index"], stepped["done"], stepped["success"]) == (1, False, False)
    assert stepped["state"].shape == (23,)
    assert stepped["episode_id"] == first["episode_id"]
    assert (stepped["agentview_image"] is None) == bool(stepped["error"])
    old, new = call("get_observation"), call("observe_egocentric")
    np.testing.assert_array_equal(old["state"], new["state"])
    info = call("episode_info")
    assert (info["step_index"], info["cumulative_reward"], info["done"], info["error"]) == (1, 0.0, False, "")
    signals = call("step_continuous", [[0, 0, 0, 0, 0, 0, 1]] * 70)
    assert (signals["step_index"], signals["truncated"], signals["terminated"]) == (60, True, False)
    assert call("episode_info")["done"]
    assert call("evaluate")["metrics"] == {
        "success": 0.0,
        "num_steps": 60,
        "split": "bridge",
        "task_id": "widowx_spoon_on_towel",
        "cumulative_reward": 0.0,
    }
    assert call("step", "[]")["done"]
    assert call("reset", observation=True)["state"].shape == (23,)
    assert call("episode_info")["step_index"] == 0


def test_in_simpler_one_closes_and_zero_opens(simpler: EnvSimplerNodeSet) -> None:
    call = Caller(simpler)
    call("reset")
    widths = []
    for grip in (1, 0):
        call("step_continuous", [[0, 0, 0, 0, 0, 0, grip]] * 8)
        widths.append(call("observe_objects")["snapshot"]["gripper"].sum())
    assert widths[0] + 0.01 < widths[1]


def test_simplers_environments_stay_open_when_the_split_changes(simpler: EnvSimplerNodeSet) -> None:
    simpler.panel.action("reset")
    bridge = simpler.manager.run(lambda env, _: env)
    changed = simpler.panel.set_field("split", "google_robot")
    assert changed.error == ""
    assert changed.fields == {"split": "google_robot", "task_id": "google_robot_pick_coke_can", "episode_index": 0}
    assert changed.step_budget == 80
    assert simpler.panel.set_field("split", "bridge").error == ""
    assert simpler.manager.run(lambda env, _: env) is bridge


def test_simplers_tool_is_driven_to_poses_within_the_limits_of_a_call(simpler: EnvSimplerNodeSet) -> None:
    call = Caller(simpler)
    call("reset")
    there = [*(call("step_ee_pose", "[]")["final_pose"] + [0.05, 0, 0.03, 0, 0, 0, 0]), 1.0]
    assert call("step_ee_pose", there, max_steps=1)["step_count"] == 1
    moved = call("step_ee_pose", there)
    assert moved["converged"]
    assert np.linalg.norm(moved["final_pose"][:3] - there[:3]) < 0.01
    assert call("step_ee_pose", {"pose": there, "hold_steps": 4})["step_count"] == 4


def test_the_step_budget_is_the_protocols() -> None:
    nodes = EnvLiberoNodeSet((SUITE,))
    nodes.initialize(protocol="openpi")
    expected = vecenv.eval_metadata(SUITE, "openpi")["max_steps"]
    assert nodes.panel.step_budget == nodes.get_eval_metadata()["step_budget"] == expected < 2500
    nodes.shutdown()
