"""When an episode that reaches its goal ends, and what its verdict is: at the first tick, or at the last."""

from __future__ import annotations

import numpy as np
import pytest
from test_env import STILL, put_target_in_basket
from test_slots import BUDGET, Scripted

import vecenv
from vecenv.contract import SUCCESS_MODES, Metrics
from vecenv.libero.env import LiberoEnv, LiberoError
from vecenv.simpler.env import SimplerConfig, SimplerError

TICKS = 5


class Final(Scripted):
    """Slots that go on after success."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, success="final")


def libero(backend: str, success: str) -> LiberoEnv:
    """Two live slots with a short budget; the target of the first is in the basket, the goal."""
    options = {"backend": backend, "start": "raw", "settle_steps": 0, "max_steps": TICKS, "success": success}
    if backend != "native":
        options["geometry"] = "lean"
    env = vecenv.make("libero_object", task=1, episodes=[0, 1], **options)
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def idle(ticks: int) -> np.ndarray:
    return np.tile(STILL, (2, ticks, 1))


def verdicts(metrics: Metrics) -> list[list[bool]]:
    return [x.tolist() for x in (metrics.success, metrics.success_first, metrics.success_final)]


# -- the rules ---------------------------------------------------------------------------------------------------------


def test_read_at_the_last_tick_an_episode_goes_on_after_success_and_pays_once() -> None:
    env = Final(3)
    env.reset()
    controls = [env.tick(success=slots) for slots in ((0, 1), (1,), (1, 2))]
    assert len(controls) == BUDGET
    assert [c.reward.tolist() for c in controls] == [[1, 1, 0], [0, 0, 0], [0, 0, 1]]
    assert not controls[1].done.any()
    assert controls[1].success.tolist() == [False, True, False]
    assert controls[2].terminated.tolist() == [False, True, True]
    assert controls[2].truncated.tolist() == [True, False, False]
    assert verdicts(env.evaluate()) == [[False, True, True], [True, True, True], [False, True, True]]
    assert env.evaluate().cumulative_reward.tolist() == [1, 1, 1]


def test_ended_at_the_first_success_both_verdicts_are_one() -> None:
    env = Scripted(3)
    env.reset()
    env.tick(success=(0,))
    env.tick(success=(1,))
    env.tick()
    assert verdicts(env.evaluate()) == [[True, True, False]] * 3


def test_a_slot_that_fails_after_its_goal_held_has_neither_verdict() -> None:
    env = Final(2)
    env.reset()
    env.tick(success=(0, 1))
    control = env.tick(success=(0, 1), fail={1: "it broke"})
    assert control.truncated.tolist() == [False, True]
    assert verdicts(env.evaluate()) == [[True, False]] * 3


def test_a_new_episode_forgets_both_verdicts() -> None:
    env = Final(1)
    env.reset()
    for _ in range(BUDGET):
        env.tick(success=(0,))
    env.reset()
    assert verdicts(env.evaluate()) == [[False]] * 3
    assert env.tick(success=(0,)).reward.tolist() == [1]


# -- physics -----------------------------------------------------------------------------------------------------------

backends = pytest.mark.parametrize(
    "backend",
    ["native", pytest.param("warp", marks=pytest.mark.heavy), pytest.param("jax", marks=pytest.mark.heavy)],
)


@backends
def test_a_chunk_goes_on_after_success_when_the_last_tick_counts(backend: str) -> None:
    env = libero(backend, "final")
    before = env.state()
    put_target_in_basket(env, [0])
    first = env.step_continuous(idle(2))
    assert first.info["ticks"].tolist() == [2, 2]
    assert first.success.tolist() == [True, False]
    assert first.reward.tolist() == [1, 0]
    assert not first.done.any()
    env.set_state(before)  # the target is beside the basket again
    last = env.step_continuous(idle(TICKS))
    assert last.info["ticks"].tolist() == [TICKS - 2] * 2
    assert last.truncated.all()
    assert verdicts(env.evaluate()) == [[False, False], [True, False], [False, False]]
    assert env.evaluate().cumulative_reward.tolist() == [1, 0]
    env.close()


@backends
def test_a_plan_goes_on_after_success_when_the_last_tick_counts(backend: str) -> None:
    env = libero(backend, "final")
    put_target_in_basket(env, [0])
    snapshots = env.observe_objects().snapshot
    poses = np.stack([np.append(s.ee_pose, 0.0) for s in snapshots if s is not None])
    control = env.step_ee_pose(poses, hold_steps=TICKS)
    assert control.step_count.tolist() == [TICKS, TICKS]
    assert control.terminated.tolist() == [True, False]
    assert control.truncated.tolist() == [False, True]
    assert control.reward.tolist() == [1, 0]
    env.close()


@backends
def test_a_chunk_ends_at_success_when_the_first_tick_counts(backend: str) -> None:
    env = libero(backend, "first")
    put_target_in_basket(env, [0])
    control = env.step_continuous(idle(TICKS))
    assert control.info["ticks"].tolist() == [1, TICKS]
    assert verdicts(env.evaluate()) == [[True, False]] * 3
    env.close()


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_a_mode_of_another_type_is_refused_with_its_type() -> None:
    with pytest.raises(vecenv.OptionError, match=r"success.*str \| None.*1"):
        vecenv.make("libero_object", task=0, episodes=[0], success=1)


@pytest.mark.parametrize("mode", ["last", ""])
def test_other_modes_are_refused(mode: str) -> None:
    with pytest.raises(LiberoError, match=rf"success={mode!r} is not available; available: {', '.join(SUCCESS_MODES)}"):
        vecenv.make("libero_object", task=0, episodes=[0], success=mode)
    with pytest.raises(SimplerError, match=rf"success={mode!r} is not available; available: first, final"):
        SimplerConfig(success=mode)
