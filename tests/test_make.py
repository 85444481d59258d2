"""``vecenv.make`` and the lists: every suite by its name, and only the library that runs it."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vecenv
from vecenv.actions import GRIPPER
from vecenv.assets import AssetsMissing
from vecenv.contract import BatchEnv
from vecenv.controllers.waypoint import WaypointConfig
from vecenv.simpler.control.robots import GOOGLE_ROBOT, WIDOWX

BRIDGE, GOOGLE = "simpler/bridge", "simpler/google_robot"
SPOON, COKE = "widowx_spoon_on_towel", "google_robot_pick_coke_can"


# -- lists -------------------------------------------------------------------------------------------------------------


def test_suites_of_all_families_are_listed_and_each_family_alone() -> None:
    assert vecenv.list_suites("simpler") == (BRIDGE, GOOGLE)
    assert vecenv.list_suites() == vecenv.list_suites("libero") + vecenv.list_suites("simpler")
    assert "libero_90" in vecenv.list_suites("libero")
    with pytest.raises(vecenv.OptionError, match="family='maniskill': expected one of libero, simpler"):
        vecenv.list_suites("maniskill")


def test_simplers_tasks_and_metadata_need_neither_sapien_nor_assets() -> None:
    code = (
        "import json, sys, vecenv\n"
        "suites = vecenv.list_suites('simpler')\n"
        "counts = {s: vecenv.eval_metadata(s)['num_episodes'] for s in suites}\n"
        "names = [task.name for task in vecenv.list_tasks('simpler/bridge')]\n"
        "loaded = {m.split('.')[0] for m in sys.modules}\n"
        "print(json.dumps([counts, names, sorted(loaded & {'sapien', 'mujoco', 'jax'})]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PATH": "", "VECENV_SIMPLER_ASSETS": "/nowhere"},
        capture_output=True,
        text=True,
        check=True,
    )
    counts, names, loaded = json.loads(done.stdout)
    assert counts == {BRIDGE: 200, GOOGLE: 1050}
    assert names[0] == SPOON
    assert loaded == []


@pytest.mark.parametrize("suite", ["simpler/frank", "libero_nothing"])
def test_an_unknown_suite_is_a_key_error_that_names_those_there_are(suite: str) -> None:
    for ask in (vecenv.make, vecenv.list_tasks, vecenv.eval_metadata):
        with pytest.raises(KeyError, match=BRIDGE if suite.startswith("simpler") else "libero_90"):
            ask(suite)


# -- make --------------------------------------------------------------------------------------------------------------


def test_a_simpler_task_is_made_by_name(small: Path) -> None:
    pytest.importorskip("sapien")
    env = vecenv.make(BRIDGE, task=SPOON, episodes=range(2), assets=small, num_threads=1)
    assert isinstance(env, BatchEnv)
    info = env.reset()
    assert info.episode_id == (f"{BRIDGE}/{SPOON}/0", f"{BRIDGE}/{SPOON}/1")
    assert info.instruction == ("put the spoon on the towel",) * 2
    assert info.max_steps.tolist() == [60, 60]
    env.close()


@pytest.mark.parametrize(
    ("suite", "options", "says"),
    [
        (BRIDGE, {"geometry": "lean"}, "simpler/bridge has no option geometry='lean'; its own: .*gripper"),
        (BRIDGE, {"start": "raw", "settle_steps": 3}, "no option start='raw', settle_steps=3"),
        (GOOGLE, {"fixtures": {"table": ([0, 0, 0], [1, 0, 0, 0])}}, "no option fixtures="),
        ("libero_goal", {"gripper": "binary"}, "libero_goal has no option gripper='binary'; its own: .*geometry"),
        ("libero_goal", {"overlay": "none", "shadows": True}, "no option overlay='none', shadows=True"),
    ],
)
def test_options_of_the_other_family_are_refused(suite: str, options: dict[str, Any], says: str) -> None:
    with pytest.raises(vecenv.OptionError, match=says):
        vecenv.make(suite, task=0, episodes=[0], **options)


def test_gpu_physics_of_simpler_is_refused_with_what_there_is(small: Path) -> None:
    pytest.importorskip("sapien")
    with pytest.raises(ValueError, match=r"physx_cuda' is not supported.*physx_cpu.*num_threads"):
        vecenv.make(BRIDGE, task=SPOON, episodes=[0], assets=small, backend="physx_cuda")
    with pytest.raises(ValueError, match="backend='warp' is not available"):
        vecenv.make(BRIDGE, task=SPOON, episodes=[0], assets=small, backend="warp")


def test_missing_packages_are_named_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "sapien" else find(name))
    with pytest.raises(vecenv.ExtraMissing, match=r"needs sapien: pip install 'vecenv\[simpler\]'"):
        vecenv.make(BRIDGE, task=SPOON, episodes=[0])
    assert vecenv.eval_metadata(BRIDGE)["num_tasks"] == 4


def test_missing_assets_are_named_with_the_command_and_the_variable(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("sapien")
    monkeypatch.setenv("VECENV_SIMPLER_ASSETS", str(tmp_path))
    with pytest.raises(AssetsMissing, match=r"vecenv assets pull simpler, or point VECENV_SIMPLER_ASSETS at"):
        vecenv.make(BRIDGE, task=SPOON, episodes=[0])
    with pytest.raises(AssetsMissing, match=f"{tmp_path}/other is not a directory"):
        vecenv.make(BRIDGE, task=SPOON, episodes=[0], assets=tmp_path / "other")


# -- the contract, whatever the simulator ------------------------------------------------------------------------------


@pytest.fixture(params=["libero_object", BRIDGE, GOOGLE])
def env(request: pytest.FixtureRequest, small: Path) -> Iterator[BatchEnv]:
    if request.param == "libero_object":
        made = vecenv.make(request.param, task=0, episodes=[0, 1], max_steps=3)
    else:
        pytest.importorskip("sapien")
        made = vecenv.make(request.param, task=0, episodes=[0, 1], max_steps=3, assets=small, num_threads=1)
    yield made
    made.close()


def test_a_chunk_ends_at_the_budget_and_finished_slots_ignore_what_follows(env: BatchEnv) -> None:
    assert env.reset().max_steps.tolist() == [3, 3]
    control = env.step_continuous(np.zeros((2, 5, 7)))
    assert control.truncated.tolist() == [True, True]
    assert control.terminated.tolist() == [False, False]
    assert control.info["ticks"].tolist() == [3, 3]
    again = env.step_continuous(np.ones((2, 7)))
    assert again.step_index.tolist() == [3, 3]
    assert again.reward.tolist() == [0.0, 0.0]
    assert again.truncated.all()
    assert env.evaluate().num_steps.tolist() == [3, 3]


def test_reset_rearms_what_is_finished_and_leaves_the_rest(env: BatchEnv) -> None:
    env.reset()
    env.step_continuous(np.zeros((2, 7)))
    env.reset()
    assert env.evaluate().num_steps.tolist() == [1, 1]
    env.step_continuous(np.zeros((2, 5, 7)))
    env.reset()
    assert env.evaluate().num_steps.tolist() == [0, 0]


def test_bad_numbers_are_sanitized_and_reported(env: BatchEnv) -> None:
    env.reset()
    actions = np.zeros((2, 7))
    actions[1] = [np.nan, 5.0, 0.0, 0.0, 0.0, np.inf, 0.0]
    control = env.step_continuous(actions)
    assert control.info["sanitized"].tolist() == [False, True]
    assert control.info["fault"] == ("", "")
    with pytest.raises(ValueError, match=r"expected \[2, 7\]"):
        env.step_continuous(np.zeros((2, 6)))


def test_a_chunk_without_actions_moves_nothing_and_says_how_the_slots_stand(env: BatchEnv) -> None:
    env.reset()
    env.step_continuous(np.zeros((2, 7)))
    env.end_episodes([1])
    before = env.state()
    control = env.step_continuous(np.zeros((2, 0, 7)))
    assert (control.done.tolist(), control.info["fault"]) == ([False, True], ("", ""))
    assert (control.step_index.tolist(), control.info["ticks"].tolist()) == ([1, 1], [0, 0])
    np.testing.assert_array_equal(env.state().qpos, before.qpos)


def test_an_empty_pose_is_a_no_op_and_a_bad_one_is_an_error_of_its_slot(env: BatchEnv) -> None:
    env.reset()
    assert env.step_ee_pose([]).step_count.tolist() == [0, 0]
    poses = np.zeros((2, 8))
    poses[:, :7] = env.step_ee_pose([]).final_pose
    poses[1, 3:7] = 0.0
    control = env.step_ee_pose(poses)
    assert control.error == ("", "quaternion has no length")
    assert control.step_count[1] == 0


@pytest.mark.parametrize(("suite", "task"), [(BRIDGE, SPOON), (GOOGLE, COKE)])
@pytest.mark.parametrize("option", ["native", "binary"])
def test_the_table_of_gripper_signs_is_what_happens(small: Path, suite: str, task: str, option: str) -> None:
    pytest.importorskip("sapien")
    column = GRIPPER[suite if option == "native" else "binary"]
    robot = WIDOWX if suite == BRIDGE else GOOGLE_ROBOT
    env = vecenv.make(suite, task=task, episodes=[0, 0], assets=small, num_threads=1, gripper=option)
    env.reset()
    actions = np.zeros((2, 6, 7))
    actions[:, :, 6] = [[column.open], [column.closed]]
    env.step_continuous(actions)
    opening = env.observe_egocentric().state[:, list(robot.gripper)].sum(axis=1) * (1 if suite == BRIDGE else -1)
    assert opening[0] > opening[1] + 0.02
    env.close()


# -- options -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"render": True}, r"libero_goal.*render.*Mapping\[str, Any\] \| RenderConfig"),
        ({"render": {"lods": "fast"}}, "render has no option lods='fast'; did you mean lod"),
        ({"render": {"lod": 3}}, "render.*lod"),
        ({"max_steps": "many"}, "max_steps.*many"),
        ({"max_steps": True}, "max_steps=True"),
        ({"waypoint": {"pos_tol": "near"}}, "pos_tol"),
        ({"seed": 1.5}, "seed"),
        ({"num_devices": 0}, "num_devices=0: need at least 1"),
        ({"max_stps": 4}, r"no option max_stps=4; did you mean max_steps\?"),
    ],
)
def test_a_mistyped_option_is_refused_at_make_with_its_type(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        vecenv.make("libero_goal", task=0, episodes=[0], **options)


def test_simpler_refuses_a_seed_for_its_episodes_depend_on_their_number_alone(small: Path) -> None:
    with pytest.raises(vecenv.OptionError, match="simpler/bridge has no option seed=3"):
        vecenv.make(BRIDGE, task=SPOON, episodes=[0], assets=small, seed=3)


def test_what_is_given_comes_before_the_protocol_and_the_protocol_before_defaults() -> None:
    config = vecenv.LiberoConfig(protocol="openvla", render={"lod": "fast"})
    rules = config.rules("libero_goal")
    assert (rules.max_steps, rules.start, rules.fixtures) == (300, "raw", "upstream")
    assert (rules.render.lod, rules.render.height) == ("fast", 256)
    given = vecenv.LiberoConfig(protocol="openvla", max_steps=7, start="settled", fixtures="center").rules(
        "libero_goal"
    )
    assert (given.max_steps, given.start, given.fixtures) == (7, "settled", "center")
    # The default of the protocol "seed" given on purpose is not taken for "not given".
    assert vecenv.LiberoConfig(protocol="openvla", max_steps=2500).rules("libero_goal").max_steps == 2500


def test_a_config_is_taken_whole_and_fields_replace_parts_of_it() -> None:
    config = vecenv.LiberoConfig(max_steps=9, waypoint=WaypointConfig(pos_tol=0.02))
    env = vecenv.make("libero_goal", task=0, episodes=[0], config=config, max_steps=4)
    assert env.reset().max_steps.tolist() == [4]
    assert isinstance(env.config, vecenv.LiberoConfig)
    assert env.config.waypoint.pos_tol == 0.02
    assert env.control_hz == 20
    env.close()
    with pytest.raises(vecenv.OptionError, match="config is a LiberoConfig, expected SimplerConfig"):
        vecenv.make(BRIDGE, task=SPOON, config=config)


def test_the_public_mask_says_which_slots_are_done(env: BatchEnv) -> None:
    env.reset()
    assert env.done.tolist() == [False, False]
    env.step_continuous(np.zeros((2, 3, 7)))
    assert env.done.tolist() == [True, True]
    assert len(env.instructions()) == 2
    assert env.placement.episode.tolist() == [0, 1]
