"""Refilled slots against batches that wait for their slowest episode, on a policy whose episodes differ in length.

Both sides run the same episodes with the same actions in turns: once through ``reset_slots``, once in batches. The
policy holds still. The length of an episode is drawn from an exponential distribution by its name, as with a policy
that solves most tasks early and a few late. Ratio first.

    python benchmarks/refill.py --slots 16 --episodes 160
"""

from __future__ import annotations

import argparse
import tempfile
import time
import zlib
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
from common import report
from vecenv_eval import policies
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import begin
from vecenv_eval.runner import evaluate

from vecenv.contract import BatchEnv, Control, ResetInfo

MEAN_TICKS, MOST_TICKS = 40, 300


class LongTailed:
    """Holds still; ends an episode when its time is up. ``reply_s`` is what a call of a policy server takes."""

    name = "long-tailed"

    def __init__(self, reply_s: float) -> None:
        self._reply_s = reply_s
        self._ends = np.zeros(0, int)

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self._ends = np.array([_ticks(name) for name in info.episode_id])

    def act(self, env: BatchEnv) -> np.ndarray | Control:
        if self._reply_s:
            time.sleep(self._reply_s)
        over = (env.evaluate().num_steps + 1 >= self._ends) & ~env.done
        control = env.step_continuous(np.zeros((env.num_envs, 7)))
        env.end_episodes(over)
        return replace(control, truncated=control.truncated | (over & ~control.terminated))


class Refilled(LongTailed):
    """The same, one slot at a time."""

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        for slot in slots.tolist():
            self._ends[slot] = _ticks(info.episode_id[slot])


def _ticks(name: str) -> int:
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    return int(np.clip(rng.exponential(MEAN_TICKS), 5, MOST_TICKS))


def main() -> None:
    options = _parse()
    seconds: dict[str, list[float]] = {"refilled": [], "batches": []}
    kinds = {"refilled": Refilled, "batches": LongTailed}
    for _ in range(options.rounds):
        for side, kind in kinds.items():
            seconds[side].append(_run(kind, options))
    refilled, batches = median(seconds["refilled"]), median(seconds["batches"])
    row = {
        "batches / refilled": round(batches / refilled, 2),
        "refilled s": round(refilled, 1),
        "batches s": round(batches, 1),
        "slots": options.slots,
        "episodes": options.episodes,
        "reply ms": options.reply_ms,
    }
    report(options.name, [row], title="Refilled slots against batches")


def _run(kind: type[LongTailed], options: argparse.Namespace) -> float:
    """Seconds of one evaluation, environments included."""
    policies._load = lambda name: lambda: kind(options.reply_ms / 1000)  # type: ignore[assignment]
    tasks = f"0-{-(-options.episodes // 50) - 1}"
    config = EvalConfig(
        suite="libero_goal", policy="long-tailed", tasks=tasks, num_envs=options.slots, max_steps=MOST_TICKS + 1
    )
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        result = evaluate(config, begin(config, Path(folder) / "run"))
        assert result.ok
        return time.perf_counter() - started


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--slots", type=int, default=16)
    parser.add_argument("--episodes", type=int, default=150, help="a multiple of 50: whole tasks of libero_goal")
    parser.add_argument("--reply-ms", type=float, default=0.0, help="what a call of the policy takes")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--name", default="refill", help="name of the results file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
