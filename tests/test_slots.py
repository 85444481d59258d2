"""The rules about slots that hold whatever simulates them: verdicts, rewards, quarantine and re-arming."""

from __future__ import annotations

import copy
import os
import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from vecenv import placement as placing
from vecenv.contract import Control
from vecenv.observations import Rendered
from vecenv.slots import SlotBatch

BUDGET = 3


class Refused(ValueError):
    """What this environment raises."""


class Scripted(SlotBatch):
    """A simulator controlled by the test: ``tick`` takes the slots that succeed and those whose physics fails."""

    _error = Refused

    def __init__(self, num_envs: int, **options: Any) -> None:
        super().__init__("suite", num_envs, **options)
        self.armed: list[list[int]] = []
        self.failures: dict[int, str] = {}
        self.failing_starts: dict[int, str] = {}
        self._place(placing.cross(range(num_envs), [0], num_tasks=num_envs, num_episodes=50))

    def tick(self, success: tuple[int, ...] = (), fail: Mapping[int, str] | None = None) -> Control:
        """One tick of all slots that are not done."""
        self._check_live()
        self.failures |= fail or {}
        before, active = self._states.steps.copy(), ~self.done
        reward = self._book(active, active & np.isin(np.arange(self.num_envs), success))
        return self._control(Control, reward, before)

    def _chosen(self, tasks: Any, episodes: Any) -> placing.Placement:
        return placing.each(tasks, episodes, self._placement, num_tasks=self.num_envs, num_episodes=50)

    def _prepare(self) -> np.ndarray:
        return np.full(self.num_envs, BUDGET)

    def _arm(self, stale: np.ndarray) -> None:
        self.armed.append(np.flatnonzero(stale).tolist())
        self.failures = {slot: reason for slot, reason in self.failures.items() if not stale[slot]}
        self.failures |= {slot: reason for slot, reason in self.failing_starts.items() if stale[slot]}

    def _instruction(self, slot: int) -> str:
        return f"do {self._placement.task[slot]}"

    def _label(self, task: int) -> str:
        return "abc"[task]

    def _failures(self) -> Mapping[int, str]:
        return self.failures

    def _drive(
        self, targets: np.ndarray, hold: np.ndarray, moves: np.ndarray, carry: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        del carry
        return self._book(moves & ~self.done, np.zeros(self.num_envs, bool)), np.ones(self.num_envs, bool)

    def _follow(self, plan: Any, max_misses: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        raise NotImplementedError

    def _tools(self) -> np.ndarray:
        return np.zeros((self.num_envs, 7))


@pytest.fixture
def env() -> Scripted:
    made = Scripted(3)
    made.reset()
    return made


def test_success_terminates_and_pays_once(env: Scripted) -> None:
    first, second = env.tick(success=(1,)), env.tick(success=(0, 1))
    assert (first.reward.tolist(), second.reward.tolist()) == ([0, 1, 0], [1, 0, 0])
    assert second.terminated.tolist() == [True, True, False]
    assert second.step_index.tolist() == [2, 1, 2]
    assert second.info["ticks"].tolist() == [1, 0, 1]
    assert env.evaluate().cumulative_reward.tolist() == [1, 1, 0]


def test_a_budget_that_runs_out_truncates_unless_the_last_tick_succeeds(env: Scripted) -> None:
    for _ in range(BUDGET - 1):
        assert not env.tick().done.any()
    last = env.tick(success=(2,))
    assert last.truncated.tolist() == [True, True, False]
    assert last.terminated.tolist() == [False, False, True]


def test_a_slot_that_fails_in_the_tick_of_its_success_has_none_and_earns_nothing(env: Scripted) -> None:
    control = env.tick(success=(0, 1), fail={1: "it broke"})
    assert control.success.tolist() == control.terminated.tolist() == [True, False, False]
    assert control.truncated.tolist() == [False, True, False]
    assert control.info["fault"] == ("", "it broke", "")
    assert env.evaluate().cumulative_reward.tolist() == [1, 0, 0]


def test_slots_that_fail_in_reset_are_done_and_said_to_be(caplog: pytest.LogCaptureFixture) -> None:
    env = Scripted(3)
    env.failing_starts = {0: "it broke", 2: "it broke"}
    env.reset()
    assert env.done.tolist() == [True, False, True]
    (said,) = caplog.records
    assert (said.levelname, said.name) == ("WARNING", "vecenv.slots")
    for part in ("suite, tasks a, b, c", "3 slots; 1 running", "2 of 3 slots failed in reset", "it broke"):
        assert part in said.getMessage()
    caplog.clear()
    env.failing_starts = {1: "live, so it does not begin again"}
    env.reset()
    assert not env.done.any()
    assert not caplog.records


def test_the_first_failure_of_a_slot_is_the_one_reported(env: Scripted) -> None:
    env.tick(fail={0: "first"})
    assert env.tick(fail={0: "second"}).info["fault"] == ("first", "", "")


def test_a_finished_slot_that_fails_later_keeps_its_verdict(env: Scripted) -> None:
    env.tick(success=(0,))
    control = env.tick(fail={0: "too late"})
    assert control.success.tolist() == [True, False, False]
    assert control.info["fault"] == ("", "", "")


def test_reset_rearms_finished_slots_and_leaves_the_others(env: Scripted) -> None:
    env.tick(success=(0,), fail={2: "it broke"})
    info = env.reset()
    assert env.armed == [[0, 1, 2], [0, 2]]
    assert info.episode_id == ("suite/a/0", "suite/b/0", "suite/c/0")
    assert info.instruction == ("do 0", "do 1", "do 2")
    control = env.tick()
    assert control.step_index.tolist() == [1, 2, 1]
    assert control.info["fault"] == ("", "", "")
    assert env.evaluate().cumulative_reward.tolist() == [0, 0, 0]


def test_reset_of_live_slots_does_nothing(env: Scripted) -> None:
    env.tick()
    env.reset()
    assert env.armed == [[0, 1, 2]]
    assert env.evaluate().num_steps.tolist() == [1, 1, 1]


def test_what_is_placed_is_not_live_before_reset(env: Scripted) -> None:
    env.tick(success=(0,))
    env.set_episodes(episodes=7)
    assert env.placement.episode.tolist() == [7, 7, 7]
    with pytest.raises(Refused, match="reset"):
        env.tick()
    assert not env.evaluate().success.any()


def test_slots_without_a_pose_stay_and_say_so(env: Scripted) -> None:
    poses = np.tile([0.0, 0, 0, 1, 0, 0, 0, 0], (3, 1))
    poses[1] = np.nan
    control = env.step_ee_pose(poses)
    assert control.step_count.tolist() == [1, 0, 1]
    assert control.converged.tolist() == [True, False, True]
    assert control.error == ("", "pose is not finite", "")


@pytest.mark.parametrize("call", [Scripted.reset, Scripted.tick, Scripted.evaluate, Scripted.set_episodes])
def test_a_closed_environment_says_so_with_its_own_error(env: Scripted, call: Callable[[Scripted], object]) -> None:
    env._closed = True
    with pytest.raises(Refused, match="closed"):
        call(env)


def test_what_a_caller_gets_does_not_change_with_the_batch(env: Scripted) -> None:
    control, metrics = env.tick(), env.evaluate()
    env.tick(success=(0, 1, 2))
    assert control.step_index.tolist() == metrics.num_steps.tolist() == [1, 1, 1]
    assert not control.terminated.any()
    assert not metrics.success.any()


def test_episodes_that_are_ended_ignore_steps_until_reset() -> None:
    env = Scripted(3)
    env.reset()
    env.tick(success=(2,))
    env.end_episodes([1, 2])
    control = env.tick()
    assert control.step_index.tolist() == [2, 1, 1]
    assert (control.truncated.tolist(), control.terminated.tolist()) == ([False, True, False], [False, False, True])
    env.reset()
    assert env.armed[-1] == [1, 2]


# -- the object --------------------------------------------------------------------------------------------------------


def test_an_environment_is_closed_at_the_end_of_a_with_block() -> None:
    with Scripted(2) as env:
        env.reset()
    with pytest.raises(Refused, match="closed"):
        env.reset()


def test_an_environment_says_what_it_is_and_how_far() -> None:
    env = Scripted(2)
    assert repr(env) == "<Scripted suite, tasks a, b: 2 slots; waiting for reset()>"
    env.reset()
    env.tick(success=(1,))
    assert repr(env) == "<Scripted suite, tasks a, b: 2 slots; 1 running, 1 successful>"
    env.close()
    assert repr(env) == "<Scripted suite, tasks a, b: 2 slots; closed>"


def test_pickling_and_copying_say_what_to_do_instead() -> None:
    for attempt in (pickle.dumps, copy.deepcopy):
        with pytest.raises(Refused, match=r"cannot be pickled.*functools.partial\(vecenv.make.*state\(\)"):
            attempt(Scripted(1))


def test_another_process_is_refused_with_what_to_do_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    env = Scripted(1)
    env.reset()
    parent = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: parent + 1)
    for call in (env.reset, env.tick, env.evaluate):
        with pytest.raises(Refused, match=f"made in process {parent} and this is process {parent + 1}.*'spawn'"):
            call()


# -- images ------------------------------------------------------------------------------------------------------------


def test_images_answer_to_liberos_names_and_list_the_cameras_otherwise() -> None:
    drawn: list[str] = []

    def draw(names: Sequence[str]) -> dict[str, str]:
        drawn.extend(names)
        return {name: f"image of {name}" for name in names}

    images = Rendered(["agentview", "wrist"], draw)
    assert images["agentview_image"] == images["agentview"] == "image of agentview"
    assert images["robot0_eye_in_hand_image"] == "image of wrist"
    assert drawn == ["agentview", "wrist"]
    assert list(images) == ["agentview", "wrist"]
    assert "front" not in images
    assert images.get("front") is None
    with pytest.raises(KeyError, match="no camera 'front'; cameras: agentview, wrist"):
        images["front"]


def test_an_environment_without_limits_of_waypoints_says_so() -> None:
    batch = Scripted(1)
    with pytest.raises(Refused, match="cannot change pos_tol"), batch.waypoint_limits(pos_tol=0.1):
        pass
