"""What the harness costs: the same episodes with the same actions and refills, through it and in a bare loop.

Both sides make the same environment, begin the same episodes in the same slots, execute the same actions from a table,
end each episode after the same number of ticks, place the next episode of the scene in its slot and, where images are
asked for, read those of both cameras in every live slot at every tick. The harness also checks the settings, keeps
clocks, writes every verdict to its results folder and summarises. Sides take turns within a round and begin in turns;
a first, short round is not counted. The time is the whole of either side, environments and all; *loop* leaves out what
comes before the first tick and after the last. Medians over rounds, ratio first.

    python benchmarks/harness.py
    python benchmarks/harness.py --table      # fills the table of docs/performance.md from the results
"""

from __future__ import annotations

import argparse
import tempfile
import time
import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import RESULTS, ROOT, fill_table, report
from vecenv_eval import policies
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import begin
from vecenv_eval.runner import evaluate

import vecenv
from vecenv.contract import BatchEnv, Control, ResetInfo

CAMERAS = ("agentview", "wrist")


@dataclass(frozen=True, kw_only=True)
class Work:
    """What both sides do: ``episodes`` of one task in ``slots``, each of about ``ticks`` ticks, with images or not."""

    suite: str
    task: int
    episodes: int
    slots: int
    ticks: int
    images: bool

    @property
    def most(self) -> int:
        """The longest episode."""
        return self.ticks * 3 // 2

    def length(self, episode: int) -> int:
        """Ticks of an episode, between half as many and half as many again, so that slots end one by one."""
        return self.ticks // 2 + zlib.crc32(f"{self.suite}/{self.task}/{episode}".encode()) % (self.ticks + 1)

    @property
    def total(self) -> int:
        """Ticks of all episodes."""
        return sum(map(self.length, range(self.episodes)))


@dataclass
class Clock:
    """When the first tick began and the last one ended."""

    first: float = 0.0
    last: float = 0.0

    @property
    def seconds(self) -> float:
        return self.last - self.first


class Table:
    """Executes actions from a table; both sides call it, so that only what is around it differs."""

    name = "table"

    def __init__(self, work: Work) -> None:
        rng = np.random.default_rng(0)
        self._work, self.clock = work, Clock()
        self._actions = np.repeat(rng.uniform(-0.5, 0.5, (work.most // 5 + 1, 7)), 5, axis=0)
        self._ticks = self._ends = np.zeros(0, int)

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self._ticks, self._ends = np.zeros((2, env.num_envs), int)
        self.reset_slots(env, info, np.arange(env.num_envs))

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        for slot in slots.tolist():
            self._ticks[slot] = 0
            self._ends[slot] = self._work.length(int(info.episode_id[slot].rsplit("/", 1)[1]))

    def act(self, env: BatchEnv) -> Control:
        self.clock.first = self.clock.first or time.perf_counter()
        live = ~env.done
        if self._work.images:
            seen = env.observe_egocentric(live).images
            assert all(seen[camera].any() for camera in CAMERAS)
        control = env.step_continuous(self._actions[self._ticks])
        self._ticks += live
        over = live & (self._ticks >= self._ends)
        if over.any():
            env.end_episodes(over)
            control = replace(control, truncated=control.truncated | (over & ~control.terminated))
        self.clock.last = time.perf_counter()
        return control


def run_bare(work: Work) -> tuple[Clock, int]:
    """The loop that somebody would write without a harness; returns the ticks too."""
    policy, waiting = Table(work), deque(range(work.slots, work.episodes))
    first = list(range(min(work.slots, work.episodes)))
    with vecenv.make(work.suite, tasks=[work.task], episodes=first, max_steps=work.most + 1) as env:
        info = env.reset()
        policy.reset(env, info)
        done, ticks = np.zeros(env.num_envs, bool), 0
        while not done.all():
            control = policy.act(env)
            ended = np.flatnonzero(control.done & ~done)
            done |= control.done
            ticks += int(control.info["ticks"].sum())
            rows = ended[: len(waiting)]
            if len(rows):
                env.set_episodes(episodes=[waiting.popleft() for _ in rows], slots=rows)
                policy.reset_slots(env, env.reset(), rows)
                done[rows] = False
                env.end_episodes(done)  # the reset has begun them anew
    return policy.clock, ticks


def run_harness(work: Work) -> tuple[Clock, int]:
    """The same through ``evaluate``, results folder included."""
    policy = Table(work)
    policies._load = lambda name: lambda: policy  # type: ignore[assignment]
    config = EvalConfig(
        suite=work.suite,
        policy="table",
        tasks=str(work.task),
        episodes=f"0-{work.episodes - 1}",
        num_envs=work.slots,
        max_steps=work.most + 1,
    )
    with tempfile.TemporaryDirectory() as folder:
        result = evaluate(config, begin(config, Path(folder) / "run"))
        assert result.ok, result.causes
    return policy.clock, sum(record.num_steps for record in result.records)


SIDES = {"bare": run_bare, "harness": run_harness}


def compare(work: Work, rounds: int) -> dict[str, Any]:
    """One row."""
    whole: dict[str, list[float]] = {side: [] for side in SIDES}
    loop: dict[str, list[float]] = {side: [] for side in SIDES}
    for number in range(rounds):
        names: Sequence[str] = list(SIDES) if number % 2 == 0 else list(SIDES)[::-1]
        for side in names:
            started = time.perf_counter()
            clock, ticks = SIDES[side](work)
            whole[side].append(time.perf_counter() - started)
            loop[side].append(clock.seconds)
            assert ticks == work.total, f"{side} took {ticks} ticks, not {work.total}"
    ratios = [ours / bare for ours, bare in zip(loop["harness"], loop["bare"], strict=True)]
    return {
        "scene": f"{work.suite}/{work.task}",
        "images": "2" if work.images else "none",
        "slots": work.slots,
        "harness / bare, loop": round(median(ratios), 3),
        "range": f"{min(ratios):.3f} to {max(ratios):.3f}",
        "harness / bare, whole": round(
            median(ours / bare for ours, bare in zip(whole["harness"], whole["bare"], strict=True)), 3
        ),
        "bare s": round(median(whole["bare"]), 2),
        "harness s": round(median(whole["harness"]), 2),
        "control steps": work.total,
        "us a call": round(
            1e6 * median(a - b for a, b in zip(loop["harness"], loop["bare"], strict=True)) / (work.total / work.slots)
        ),
    }


def main() -> None:
    options = _parse()
    if options.table:
        print(fill_table("harness", RESULTS / f"{options.name}.json", ROOT / "docs" / "performance.md"))
        return
    rows = []
    for images in (False, True):
        for slots in options.slots:
            episodes = min(50, slots * (options.refills + 1))
            ticks = options.image_ticks if images else options.ticks
            work = Work(
                suite=options.suite, task=options.task, episodes=episodes, slots=slots, ticks=ticks, images=images
            )
            compare(replace(work, ticks=4), 1)
            rows.append(compare(work, options.rounds))
            print(rows[-1], flush=True)
    if options.name:
        report(options.name, rows, title="The harness against a bare loop of the same steps")


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--suite", default="libero_object")
    parser.add_argument("--task", type=int, default=0)
    parser.add_argument("--slots", type=int, nargs="+", default=[8, 25], help="a task has 50 episodes")
    parser.add_argument("--refills", type=int, default=5, help="episodes that follow in a slot, at most 50 in all")
    parser.add_argument("--ticks", type=int, default=200, help="mean ticks of an episode without images")
    parser.add_argument("--image-ticks", type=int, default=20, help="mean ticks of an episode with images")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--name", default="harness", help="name of the results file; empty to write none")
    parser.add_argument("--table", action="store_true", help="fill the table of docs/performance.md, measure nothing")
    return parser.parse_args()


if __name__ == "__main__":
    main()
