"""VoxPoser on the episodes of one task, as one batch and one at a time: wall seconds, and whether verdicts agree.

Both run in this process through the evaluation harness, with the offline model (rule-based, no language model), whose
replies the first run leaves behind for the second: one episode is run beforehand, so that neither pays for compiling.

    python benchmarks/voxposer_batch.py
    python benchmarks/voxposer_batch.py --slots 8 --episodes 24

With ``--slots`` it compares slots that take the next episode when theirs has ended with batches of as many slots, which
wait for their slowest episode.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from common import report
from vecenv_eval import policies
from vecenv_eval.config import EvalConfig
from vecenv_eval.policies.voxposer import VoxPoserPolicy
from vecenv_eval.results import EvalResult, begin
from vecenv_eval.runner import evaluate


def main() -> None:
    """Measure one task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="libero_object")
    parser.add_argument("--task", default="0")
    parser.add_argument("--episodes", default="all")
    parser.add_argument("--slots", type=int, help="refilled slots against batches of so many")
    options = parser.parse_args()
    run(options, 1, "0-0")
    if options.slots:
        compare_refilled(options)
        return
    together, seconds = run(options, 50, options.episodes)
    alone, one_by_one = run(options, 1, options.episodes)
    pairs = list(zip(together.records, alone.records, strict=True))
    row = {
        "task": f"{options.suite}/{options.task}",
        "one at a time / batch": round(one_by_one / seconds, 2),
        "batch s": round(seconds, 1),
        "one at a time s": round(one_by_one, 1),
        "episodes": len(pairs),
        "solved in the batch": sum(a.success for a, _ in pairs),
        "verdicts differ": sum(a.success != b.success for a, b in pairs),
        "ticks differ": sum(a.num_steps != b.num_steps for a, b in pairs),
    }
    report("voxposer_batch", [row], title="VoxPoser (offline/libero): a batch against one episode at a time")


class InBatches:
    """VoxPoser without ``reset_slots``, so that the harness runs batches, each to its end."""

    def __init__(self) -> None:
        policy = VoxPoserPolicy()
        self.name, self.reset, self.act, self.extras = policy.name, policy.reset, policy.act, policy.extras


def compare_refilled(options: argparse.Namespace) -> None:
    """One row of refilled slots against batches; a run beforehand leaves the replies behind for both."""
    load = policies._load
    run(options, options.slots, options.episodes)
    policies._load = lambda name: InBatches
    begun = time.process_time()
    batches, waiting = run(options, options.slots, options.episodes)
    policies._load = load
    between = time.process_time()
    refilled, seconds = run(options, options.slots, options.episodes)
    cpu = between - begun, time.process_time() - between
    pairs = list(zip(refilled.records, batches.records, strict=True))
    row = {
        "task": f"{options.suite}/{options.task}",
        "batches / refilled": round(waiting / seconds, 2),
        "refilled s": round(seconds, 1),
        "batches s": round(waiting, 1),
        "refilled CPU s": round(cpu[1], 1),
        "batches CPU s": round(cpu[0], 1),
        "slots": options.slots,
        "episodes": len(pairs),
        "solved": sum(a.success for a, _ in pairs),
        "verdicts differ": sum(a.success != b.success for a, b in pairs),
        "ticks differ": sum(a.num_steps != b.num_steps for a, b in pairs),
    }
    report("voxposer_refill", [row], title="VoxPoser (offline/libero): refilled slots against batches")


def run(options: argparse.Namespace, num_envs: int, episodes: str) -> tuple[EvalResult, float]:
    """Evaluate with so many slots; the result and the wall seconds."""
    config = EvalConfig(
        suite=options.suite, policy="voxposer", tasks=options.task, episodes=episodes, num_envs=num_envs
    )
    start = time.perf_counter()
    with TemporaryDirectory() as folder:
        result: Any = evaluate(config, begin(config, Path(folder) / "results"))
    return result, time.perf_counter() - start


if __name__ == "__main__":
    main()
