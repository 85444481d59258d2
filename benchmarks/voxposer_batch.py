"""VoxPoser on the episodes of one task, as one batch and one at a time: wall seconds, and whether verdicts agree.

Both run in this process through the evaluation harness, with the offline model (rule-based, no language model), whose
replies the first run leaves behind for the second: one episode is run beforehand, so that neither pays for compiling.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from common import report
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import EvalResult, begin
from vecenv_eval.runner import evaluate


def main() -> None:
    """Measure one task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="libero_object")
    parser.add_argument("--task", default="0")
    parser.add_argument("--episodes", default="all")
    options = parser.parse_args()
    run(options, 1, "0-0")
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
