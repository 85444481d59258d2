"""A folder of prompts in upstream's layout drives LIBERO and SIMPLER's WidowX scenes, by a model that copies them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from support import prompt_folder
from support.prompt_folder import Copyist

import vecenv
from vecenv.contract import BatchEnv
from voxposer.agent import Agent, AgentConfig
from voxposer.interface import Interface
from voxposer.language.lmp_config import NAMES
from voxposer.language.prompts import load_prompts
from voxposer.simpler_scene import hands


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return prompt_folder.write(tmp_path / "prompts")


def test_every_function_that_the_examples_import_is_given(folder: Path) -> None:
    given = {*Interface().functions(), *NAMES}
    for name, text in load_prompts(folder).items():
        for names in re.findall(r"^from (?!transforms3d)\w+ import (.*)$", text, re.MULTILINE):
            assert set(names.split(", ")) <= given, name


def followed(env: BatchEnv, folder: Path, config: AgentConfig, rounds: int) -> tuple[Agent, Copyist]:
    """An agent after its instructions were followed once, or solved."""
    llm = Copyist()
    agent = Agent(env, env.reset().instruction, llm, config, prompts_dir=str(folder))
    for _ in range(rounds):
        agent.step()
        if agent.succeeded.all() or all(slot.cause for slot in agent.slots):
            break
    agent.close()
    return agent, llm


def test_libero_closes_a_drawer_from_a_folder_of_prompts(folder: Path) -> None:
    env = cast(BatchEnv, vecenv.make("libero_90", task=0, episodes=[1], backend="native"))
    agent, llm = followed(env, folder, AgentConfig(passes=1), rounds=8)
    env.close()
    assert agent.succeeded.all(), agent.slots[0].cause
    assert llm.asked[0] == ("planner", "close the top drawer of the cabinet")


def test_libero_follows_grasping_programs_from_a_folder_of_prompts(folder: Path) -> None:
    env = cast(BatchEnv, vecenv.make("libero_object", task=0, episodes=[0], backend="native"))
    heights: list[float] = []
    agent = Agent(env, env.reset().instruction, Copyist(), AgentConfig(passes=1), prompts_dir=str(folder))
    while not agent.slots[0].cause and not agent.succeeded.all():
        agent.step()
        (seen,) = env.observe_objects().snapshot
        assert seen is not None
        heights.append(float(seen.poses["alphabet_soup_1"][2]))
    agent.close()
    env.close()
    assert agent.slots[0].progress.begun >= 4
    assert agent.slots[0].cause in ("", "followed to the end without success")
    assert max(heights) > heights[0] + 0.1  # the can was lifted by a grasp at its middle


def test_widowx_follows_programs_from_a_folder_of_prompts(folder: Path, small: Path) -> None:
    pytest.importorskip("sapien")
    env = vecenv.make("simpler/bridge", task=0, episodes=[0], assets=small, num_threads=1, max_steps=400)
    batch, config = hands(cast(Any, env), "simpler/bridge", AgentConfig(passes=1))
    start = _spoon_and_hand(batch)
    agent, llm = followed(batch, folder, config, rounds=8)
    env.close()
    slot = agent.slots[0]
    assert slot.cause in ("", "followed to the end without success")
    assert slot.progress.begun == 5 or agent.succeeded.all()
    assert {name for name, _ in llm.asked} >= {"planner", "composer", "parse_query_obj", "get_affordance_map"}
    assert start > 0.05
    assert slot.counts.waypoints > 20


def _spoon_and_hand(batch: Any) -> float:
    """Distance of the hand from the spoon, metres."""
    batch.reset()
    (seen,) = batch.observe_objects().snapshot
    return float(np.linalg.norm(seen.objects["spoon"].points.mean(axis=0) - seen.ee_pose[:3]))
