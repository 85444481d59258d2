"""The rules of ``vecenv.contract`` under calls in any order, right ones and wrong ones.

One batch takes every call. A second one, its twin, has the same episodes in other slots, among neighbours that do
something else and fail; it takes the calls that advance or place slots, but neither observations nor wrong calls. After
every call each slot and its twin have the same state, bit for bit, and the same counters and flags.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from support.calls import NEVER, VERBS, told

import vecenv
from vecenv.contract import Control, State
from vecenv.errors import VecenvError

B = 3
# Slots of the twin that have the same episodes, and those of its neighbours.
TWINS, NEIGHBOURS = np.array([4, 0, 2]), np.array([1, 3])
BUDGET = 9
SEEDS = st.integers(0, 2**32 - 1)
MASKS = st.lists(st.booleans(), min_size=B, max_size=B).map(np.array)
WRONG = st.sampled_from(
    [(verb, name) for verb in VERBS for name in NEVER if name not in VERBS[verb].takes and name != "endless"]
)


class Verbs(RuleBasedStateMachine):
    """Calls of the verbs; a subclass has the environments and the size of its actions."""

    env: ClassVar[Any]
    twin: ClassVar[Any]
    reach: ClassVar[float]
    # Rules that were run.
    calls: ClassVar[int]

    @initialize(seed=SEEDS)
    def place(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        episodes = rng.integers(0, 50, len(TWINS) + len(NEIGHBOURS))
        self.twin.set_episodes(episodes=episodes)
        self.env.set_episodes(episodes=episodes[TWINS])
        self.waits = np.ones(B, bool)
        self.saved: State | None = None

    # -- what both take ----------------------------------------------------------------------------------------------

    def both(self, call: Callable[[Any, np.random.Generator, np.ndarray], Control], seed: int) -> tuple[Any, Any]:
        """Call for both, with the same numbers for slots that are the same and other numbers for the neighbours."""
        before, done = told(self.env), self.env.done
        state = self.env.state()
        mine = call(self.env, np.random.default_rng(seed), np.arange(B))
        theirs = call(self.twin, np.random.default_rng(seed), TWINS)
        for name in ("reward", "terminated", "truncated", "success", "step_index"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name)[TWINS], name)
        for name in ("sanitized", "ticks"):
            np.testing.assert_array_equal(mine.info[name], theirs.info[name][TWINS], name)
        assert mine.info["fault"] == tuple(theirs.info["fault"][slot] for slot in TWINS)
        # A finished slot ignores a step, and counters go up by the ticks that a call took.
        assert (mine.reward[done] == 0).all()
        assert (mine.info["ticks"][done] == 0).all()
        np.testing.assert_array_equal(mine.step_index, np.array(before[6]) + mine.info["ticks"])
        still = mine.info["ticks"] == 0
        np.testing.assert_array_equal(self.env.state().qpos[still], state.qpos[still])
        np.testing.assert_array_equal(self.env.state().qvel[still], state.qvel[still])
        assert (mine.step_index <= BUDGET).all()
        np.testing.assert_array_equal(mine.done, self.env.done)
        return mine, theirs

    def spread(self, rows: np.ndarray, slots: np.ndarray, num_envs: int, rng: np.random.Generator) -> np.ndarray:
        """Rows of the slots that are the same, among others."""
        every = rng.uniform(-1, 1, (num_envs, *rows.shape[1:])) * self.reach if num_envs != B else np.zeros_like(rows)
        every[slots] = rows
        return every

    @precondition(lambda self: not self.waits.any())
    @rule(seed=SEEDS, count=st.integers(1, 3), spoiled=st.booleans())
    def step_continuous(self, seed: int, count: int, spoiled: bool) -> None:
        def call(env: Any, rng: np.random.Generator, slots: np.ndarray) -> Control:
            rows = rng.uniform(-1, 1, (B, count, 7)) * self.reach
            if spoiled:
                rows[rng.integers(B), 0, rng.integers(7)] = rng.choice([np.nan, np.inf, 1e300, -5.0])
            return env.step_continuous(self.spread(rows, slots, env.num_envs, rng))

        self.both(call, seed)

    @precondition(lambda self: not self.waits.any())
    @rule(seed=SEEDS, hold=st.integers(0, 2), carry=st.booleans(), chosen=MASKS)
    def step_ee_pose(self, seed: int, hold: int, carry: bool, chosen: np.ndarray) -> None:
        where = self.env.step_ee_pose([]).final_pose

        def call(env: Any, rng: np.random.Generator, slots: np.ndarray) -> Control:
            poses = np.tile([0.0, 0, 0, 1, 0, 0, 0, 0], (env.num_envs, 1))
            poses[slots, :7] = where + np.pad(rng.uniform(-0.02, 0.02, (B, 3)), ((0, 0), (0, 4)))
            mask = np.ones(env.num_envs, bool)
            mask[slots] = chosen
            return env.step_ee_pose(poses, hold, carry=carry, slots=mask)

        mine, theirs = self.both(call, seed)
        np.testing.assert_array_equal(mine.final_pose, theirs.final_pose[TWINS])
        assert (mine.step_count[~chosen] == 0).all()

    @precondition(lambda self: not self.waits.any())
    @rule(seed=SEEDS, misses=st.sampled_from([None, 1]))
    def step_waypoints(self, seed: int, misses: int | None) -> None:
        where = self.env.step_ee_pose([]).final_pose

        def call(env: Any, rng: np.random.Generator, slots: np.ndarray) -> Control:
            plan = {name: np.zeros((env.num_envs, 2)) for name in ("grip", "hold")}
            poses = np.tile([0.3, 0, 1, 1, 0, 0, 0], (env.num_envs, 2, 1)).astype(float)
            poses[slots] = where[:, None] + np.pad(rng.uniform(-0.02, 0.02, (B, 2, 3)), ((0, 0), (0, 0), (0, 4)))
            valid = np.ones((env.num_envs, 2), bool)
            valid[slots] = rng.random((B, 2)) < 0.8
            return env.step_waypoints({**plan, "poses": poses, "valid": valid}, misses)

        self.both(call, seed)

    @precondition(lambda self: not self.waits.any())
    @rule(chosen=MASKS)
    def end_episodes(self, chosen: np.ndarray) -> None:
        done = self.env.done
        self.env.end_episodes(chosen)
        self.twin.end_episodes(TWINS[chosen])
        np.testing.assert_array_equal(self.env.done, done | chosen)

    @rule()
    def reset(self) -> None:
        stale = self.env.done | self.waits
        steps = self.env.evaluate().num_steps
        state = None if self.waits.any() else self.env.state()
        self.env.reset()
        self.twin.reset()
        self.waits[:] = False
        if state is not None:
            np.testing.assert_array_equal(self.env.state().qpos[~stale], state.qpos[~stale])
        np.testing.assert_array_equal(self.env.evaluate().num_steps, np.where(stale, 0, steps))
        again = told(self.env)
        self.env.reset()
        assert told(self.env) == again
        assert not self.env.done.any()

    @rule(seed=SEEDS, chosen=MASKS)
    def set_episodes(self, seed: int, chosen: np.ndarray) -> None:
        episodes = np.random.default_rng(seed).integers(0, 50, B)[chosen]
        if not chosen.any():
            return
        self.env.set_episodes(episodes=episodes, slots=chosen)
        self.twin.set_episodes(episodes=episodes, slots=TWINS[chosen])
        self.waits |= chosen
        assert not self.env.done[chosen].any()
        assert (self.env.evaluate().num_steps[chosen] == 0).all()

    @precondition(lambda self: not self.waits.any())
    @rule(seed=SEEDS, fail=st.booleans())
    def set_state(self, seed: int, fail: bool) -> None:
        """Velocities that differ a little; in a neighbour of the twin, so large that it fails."""
        rng = np.random.default_rng(seed)
        mine, theirs = self.env.state(), self.twin.state()
        mine.qvel[:, :7] += rng.uniform(-0.1, 0.1, (B, 7))
        theirs.qvel[TWINS] = mine.qvel
        neighbour = int(rng.choice(NEIGHBOURS))
        if fail and np.isfinite(theirs.qvel).all():
            theirs.qvel[neighbour] = 1e12
        if np.isfinite(theirs.qvel).all() and np.isfinite(theirs.qpos).all():
            self.env.set_state(mine)
            self.twin.set_state(theirs)

    # -- what one takes ----------------------------------------------------------------------------------------------

    @precondition(lambda self: not self.waits.any())
    @rule(slots=st.none() | MASKS, points=st.sampled_from(["surface", "aabb"]))
    def observe(self, slots: np.ndarray | None, points: str) -> None:
        before, seen = told(self.env), self.env.observe_egocentric(slots=slots).state
        snapshots = self.env.observe_objects(points, slots=slots).snapshot
        wanted = np.ones(B, bool) if slots is None else slots
        assert [each is not None for each in snapshots] == wanted.tolist()
        np.testing.assert_array_equal(self.env.observe_egocentric().state, seen)
        tools = self.env.step_ee_pose([]).final_pose
        if hasattr(self.env, "check_success"):
            self.env.check_success()
        np.testing.assert_array_equal(self.env.step_ee_pose([]).final_pose, tools)
        assert told(self.env) == before

    @rule(wrong=WRONG)
    def wrong_call(self, wrong: tuple[str, str]) -> None:
        before = self.said()
        with pytest.raises(VecenvError):
            VERBS[wrong[0]].verb(self.env, NEVER[wrong[1]]())
        assert self.said() == before

    def said(self) -> list[Any]:
        if not self.waits.any():
            return told(self.env)
        metrics, placed = self.env.evaluate(), self.env.placement
        arrays = (metrics.num_steps, metrics.success, metrics.cumulative_reward, placed.task, placed.episode)
        return [array.tolist() for array in (*arrays, self.env.done)]

    # -- what always holds -------------------------------------------------------------------------------------------

    @invariant()
    def slots_are_independent_of_their_neighbours(self) -> None:
        if not hasattr(self, "waits"):
            return
        type(self).calls += 1
        np.testing.assert_array_equal(self.env.done, self.twin.done[TWINS])
        mine, theirs = self.env.evaluate(), self.twin.evaluate()
        for name in ("success", "num_steps", "cumulative_reward", "success_first"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name)[TWINS], name)
        np.testing.assert_array_equal(self.env.placement.episode, self.twin.placement.episode[TWINS])
        if self.waits.any():
            return
        one, other = self.env.state(), self.twin.state()
        for name in ("qpos", "qvel", "time"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name)[TWINS], name)
        eyes = [env.observe_egocentric().state for env in (self.env, self.twin)]
        np.testing.assert_array_equal(eyes[0], eyes[1][TWINS])

    def teardown(self) -> None:
        self.env.reset()
        self.twin.reset()


def machine(env: Any, twin: Any, reach: float) -> type[Verbs]:
    # Hypothesis collects rules by class.
    return type("Machine", (Verbs,), {"env": env, "twin": twin, "reach": reach, "calls": 0})


@pytest.fixture(scope="module", params=["libero_object", "simpler/bridge"])
def verbs(request: pytest.FixtureRequest, small: Path) -> Iterator[type[Verbs]]:
    options: dict[str, Any] = {"task": 0, "max_steps": BUDGET, "num_threads": 1}
    if request.param == "simpler/bridge":
        pytest.importorskip("sapien")
        options["assets"] = small
    else:
        options["waypoint"] = {"max_steps": 3}
    with (
        vecenv.make(request.param, episodes=range(B), **options) as env,
        vecenv.make(request.param, episodes=range(len(TWINS) + len(NEIGHBOURS)), **options) as twin,
    ):
        yield machine(env, twin, 1.0 if request.param == "libero_object" else 0.02)


def run(verbs: type[Verbs], examples: int, calls: int) -> None:
    run_state_machine_as_test(
        verbs,
        settings=settings(
            max_examples=examples,
            stateful_step_count=calls,
            deadline=None,
            derandomize=True,
            database=None,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
        ),
    )


def test_calls_in_any_order_keep_the_rules(verbs: type[Verbs]) -> None:
    run(verbs, 26, 50)
    assert verbs.calls >= 1000


@pytest.mark.heavy
def test_a_hundred_thousand_calls_keep_the_rules(verbs: type[Verbs]) -> None:
    verbs.calls = 0
    run(verbs, 1150, 100)
    assert verbs.calls >= 100_000
