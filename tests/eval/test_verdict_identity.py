"""A verdict belongs to (task, init state, seed, what the policy replied), and not to the batch around it.

Rows of the results folder, without what says when and how fast they came about, are the same byte for byte at any
number of slots and threads, in any order of refills, for any split into shards and runs, in either kind of store. Each
row holds a hash of every state the episode went through, so that two trajectories with the same verdict are told apart.
"""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.hashing_policy import Hashing
from vecenv_eval import loop, policies
from vecenv_eval.config import STORE_CHOICES, EvalConfig
from vecenv_eval.episodes import Stream
from vecenv_eval.merge import merge
from vecenv_eval.policies.pick_place.policy import PickPlacePolicy
from vecenv_eval.policies.random import RandomPolicy
from vecenv_eval.policies.voxposer import VoxPoserPolicy
from vecenv_eval.results import Progress, begin, resume
from vecenv_eval.runner import evaluate
from vecenv_eval.store import EPISODES, ResultStore

from vecenv.contract import BatchEnv, ResetInfo

POLICIES = {"random": RandomPolicy, "pick_place": PickPlacePolicy}


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Built-in policies report what they went through."""
    monkeypatch.setattr(policies, "_load", lambda name: lambda: Hashing(POLICIES[name](), name))


def rows(folder: Path) -> list[str]:
    """Lines of the store without their circumstances, ordered by episode."""
    records = sorted(ResultStore.open(folder).records().values(), key=lambda record: record.key)
    return [json.dumps(record.verdict, sort_keys=True) for record in records]


def run(folder: Path, policy: str, **settings: Any) -> list[str]:
    config = EvalConfig(**{"suite": "libero_goal", "policy": policy, "tasks": "1,3,7", "episodes": "3", **settings})
    assert evaluate(config, begin(config, folder)).ok
    return rows(folder)


@pytest.mark.usefixtures("hashed")
@pytest.mark.parametrize(("policy", "max_steps"), [("random", 12), ("pick_place", 60)])
def test_rows_do_not_depend_on_slots_threads_or_refills(tmp_path: Path, policy: str, max_steps: int) -> None:
    whole = run(tmp_path / "whole", policy, max_steps=max_steps)
    assert len(set(whole)) == 9
    for number, (num_envs, threads) in enumerate([(1, 1), (2, 2), (4, 1), (7, 3)]):
        split = run(tmp_path / str(number), policy, max_steps=max_steps, num_envs=num_envs, num_threads=threads)
        assert split == whole, f"{num_envs} slots on {threads} threads"


@pytest.mark.usefixtures("hashed")
def test_rows_do_not_depend_on_where_a_run_was_interrupted(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole", "random", max_steps=12)
    folder = tmp_path / "resumed"
    run(folder, "random", max_steps=12, num_envs=3)
    lines = (folder / EPISODES).read_text().splitlines(keepends=True)
    (folder / EPISODES).write_text("".join(lines[:4]) + lines[4][:20])  # as a crash leaves it
    config, store = resume(folder, num_envs=2)
    assert evaluate(config, store).ok
    assert rows(folder) == whole


@pytest.mark.usefixtures("hashed")
@pytest.mark.parametrize("protocol", ["openvla", "lerobot"])
def test_rows_of_published_protocols_do_not_depend_on_the_batch(tmp_path: Path, protocol: str) -> None:
    """Raw starts, idle ticks, and fixtures where upstream's resets put them."""
    settings = {"protocol": protocol, "max_steps": 6, "episodes": "0,4", "tasks": "0-2"}
    assert run(tmp_path / "one", "random", num_envs=1, **settings) == run(tmp_path / "all", "random", **settings)


@pytest.mark.usefixtures("hashed")
def test_rows_do_not_depend_on_how_scenes_share_the_slots(tmp_path: Path) -> None:
    settings = {"suite": "libero_object", "tasks": "0-2", "episodes": "3", "max_steps": 10}
    assert run(tmp_path / "few", "random", num_envs=4, **settings) == run(tmp_path / "all", "random", **settings)


@dataclass(frozen=True, kw_only=True)
class Arrangement:
    """How an evaluation is run: in how many shards, with which slots, threads, store and refills, where it stops."""

    shards: int
    num_envs: int
    num_threads: int
    store: str
    order: int
    stop_after: int | None


ARRANGEMENTS = st.builds(
    Arrangement,
    shards=st.integers(1, 4),
    num_envs=st.integers(1, 10),
    num_threads=st.integers(1, 3),
    store=st.sampled_from(STORE_CHOICES),
    order=st.integers(0, 2**16),
    stop_after=st.none() | st.integers(0, 4),
)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Rows of a run in one go, by policy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policies, "_load", lambda name: lambda: Hashing(POLICIES[name](), name))
        folder = tmp_path_factory.mktemp("undisturbed")
        return {name: run(folder / name, name, max_steps=STEPS[name]) for name in POLICIES}


STEPS = {"random": 8, "pick_place": 30}


@pytest.mark.usefixtures("hashed")
@pytest.mark.parametrize("policy", POLICIES)
@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(arrangement=ARRANGEMENTS)
def test_rows_do_not_depend_on_how_an_evaluation_was_arranged(
    tmp_path_factory: pytest.TempPathFactory, undisturbed: dict[str, list[str]], policy: str, arrangement: Arrangement
) -> None:
    folder = tmp_path_factory.mktemp("arranged")
    whole = EvalConfig(suite="libero_goal", policy=policy, tasks="1,3,7", episodes="3", max_steps=STEPS[policy])
    shards = range(1, arrangement.shards + 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "streams", shuffled(random.Random(arrangement.order)))
        for part in shards:
            arranged = replace(
                whole,
                shard=f"{part}/{arrangement.shards}",
                store=arrangement.store,
                num_envs=arrangement.num_envs,
                num_threads=arrangement.num_threads,
            )
            evaluate_with_a_stop(arranged, folder / str(part), arrangement.stop_after)
    (merged,) = merge(folder / "merged", [folder / str(part) for part in shards]).results
    assert merged.ok
    assert rows(folder / "merged") == undisturbed[policy]


def evaluate_with_a_stop(config: EvalConfig, folder: Path, stop_after: int | None) -> None:
    """Run, stop after so many verdicts as Ctrl-C does, and go on with fewer slots."""

    def stop(progress: Progress) -> None:
        if stop_after is not None and progress.done >= stop_after and not progress.setting_up:
            raise KeyboardInterrupt

    result = evaluate(config, begin(config, folder), on_progress=stop)
    if stop_after is not None and len(result.records) > stop_after:
        assert result.interrupted
    config, store = resume(folder, num_envs=2)
    assert evaluate(config, store).ok


def shuffled(chance: random.Random) -> Callable[..., list[Stream]]:
    """Streams whose slots and refills come in another order within each scene."""
    plan = loop.streams

    def mixed(episodes: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(chance.sample(list(episodes), len(episodes)))

    def streams(*args: Any, **options: Any) -> list[Stream]:
        return [
            replace(each, waiting={scene: mixed(episodes) for scene, episodes in each.waiting.items()})
            for each in plan(*args, **options)
        ]

    return streams


class Planned(VoxPoserPolicy):
    """VoxPoser, with a hash of the state that each episode ended in in its record."""

    env: BatchEnv

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self.env = env
        super().reset(env, info)

    def extras(self, slot: int) -> dict[str, Any]:
        state, said = self.env.state(), super().extras(slot)
        ended = hashlib.sha256(state.qpos[slot].tobytes() + state.qvel[slot].tobytes()).hexdigest()
        return {"ended": ended, **{name: said[name] for name in ("subtasks", "waypoints", "cause")}}


class PlannedInBatches:
    """The same without single slots: a batch waits for its slowest episode."""

    name = "planned"

    def __init__(self) -> None:
        self._policy = Planned()
        self.name = self._policy.name
        self.reset, self.act, self.extras = self._policy.reset, self._policy.act, self._policy.extras


def test_rows_of_voxposer_are_those_of_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"suite": "libero_object", "tasks": "0,3", "episodes": "3", "max_steps": 130}
    monkeypatch.setattr(policies, "_load", lambda name: PlannedInBatches)
    batches = run(tmp_path / "batches", "voxposer", num_envs=6, **settings)
    monkeypatch.setattr(policies, "_load", lambda name: Planned)
    refilled = run(tmp_path / "refilled", "voxposer", num_envs=4, **settings)
    assert refilled == batches
    assert len(set(refilled)) == 6
