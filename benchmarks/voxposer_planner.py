"""VoxPoser's planner and pushing search against their NumPy and SciPy references, both sides in one run.

The references in ``tests/support/voxposer_reference.py`` make upstream's calls, one slot at a time; here all slots are
planned in one call on JAX's default device. Problems are drawn with a fixed seed: boxes, cluttered tables, noise and
open space on a 100³ grid. The sides take turns, and the medians are compared. Planner rows also say on how many
problems the raw voxel paths are identical, which must be all of them, and how far the finished paths are apart at most,
in voxels.

    python benchmarks/voxposer_planner.py --batch 50
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import common
import jax
import numpy as np

from voxposer.planning.config import PlannerConfig
from voxposer.planning.planner import optimize_paths
from voxposer.planning.push import PushConfig, best_push

from support import voxposer_reference as reference  # isort: skip - common puts the tests on the path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=50, help="slots planned in one call")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each side")
    parser.add_argument("--points", type=int, nargs="+", default=[320, 2000], help="points of the things pushed")
    parser.add_argument("--engines", nargs="+", help="auto, jax, numba; by default auto, and on a CPU jax as well")
    parser.add_argument("--name", default="voxposer", help="first part of the files' names under benchmarks/results")
    args = parser.parse_args()
    on_cpu = jax.default_backend() == "cpu"
    engines = args.engines or (["auto", "jax"] if on_cpu else ["auto"])
    device = {"device": jax.devices()[0].device_kind, "platform": jax.default_backend()}
    rows = planner_rows(args.batch, args.rounds, engines)
    common.report(f"{args.name}_planner", rows, title=f"Plans a second on {device['device']}", notes=device)
    rows = [push_row(points, batch, args.rounds) for points in args.points for batch in (1, args.batch)]
    common.report(f"{args.name}_push", rows, title=f"Pushing searches a second on {device['device']}", notes=device)


def planner_rows(batch: int, rounds: int, engines: list[str]) -> list[dict[str, Any]]:
    rng, config = np.random.default_rng(0), PlannerConfig()
    problems = [reference.random_problem(rng) for _ in range(batch)]
    arrays = reference.stack(problems)

    def theirs() -> list[tuple[np.ndarray, np.ndarray]]:
        return [reference.optimize_path(**vars(problem), config=config) for problem in problems]

    def ours(engine: Any) -> Any:
        return jax.tree.map(np.asarray, optimize_paths(*arrays, config, engine=engine))

    ours_by_engine = {engine: (lambda engine=engine: ours(engine)) for engine in engines}
    seconds, results = take_turns({"reference": theirs, **ours_by_engine}, rounds)
    return [
        {
            "ratio": seconds["reference"] / seconds[engine],
            "engine": engine,
            "batch": batch,
            "plans/s": batch / seconds[engine],
            "reference plans/s": batch / seconds["reference"],
            "same raw paths": agreement(results[engine], results["reference"])[0],
            "voxels apart": agreement(results[engine], results["reference"])[1],
        }
        for engine in engines
    ]


def agreement(paths: Any, wanted: list[tuple[np.ndarray, np.ndarray]]) -> tuple[str, float]:
    """How many raw paths are identical, and the largest difference of finished ones (infinite if lengths differ)."""
    same, apart = 0, 0.0
    for i, (raw, path) in enumerate(wanted):
        same += np.array_equal(paths.raw[i, : paths.raw_length[i]], raw)
        equal = paths.path_length[i] == len(path)
        apart = max(apart, float(np.abs(paths.path[i, : len(path)] - path).max()) if equal else np.inf)
    return f"{same} of {len(wanted)}", apart


def push_row(points: int, batch: int, rounds: int) -> dict[str, Any]:
    """One call of the pushing search; the reference moves the whole cloud once a sample, as upstream does."""
    rng, config = np.random.default_rng(0), PushConfig()
    clouds = rng.uniform(-0.08, 0.08, (batch, points, 3)).astype(np.float32)
    targets = rng.uniform(-0.1, 0.1, (batch, 3)).astype(np.float32)
    key = jax.random.key(0)

    def theirs() -> Any:
        samples = reference.sample_pushes(clouds[0], targets[0], config.num_samples, rng)
        return int(np.argmin(reference.push_costs(clouds[0], targets[0], samples)))

    def ours() -> Any:
        return jax.block_until_ready(best_push(clouds, targets, key, config))

    seconds, _ = take_turns({"reference": theirs, "ours": ours}, rounds)
    return {
        "ratio": batch * seconds["reference"] / seconds["ours"],
        "points": points,
        "batch": batch,
        "ms a call": 1e3 * seconds["ours"],
        "reference ms a slot": 1e3 * seconds["reference"],
    }


def take_turns(sides: dict[str, Callable[[], Any]], rounds: int) -> tuple[dict[str, float], dict[str, Any]]:
    """Median seconds of each side, after one turn that is not counted, and what each returned last."""
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    results: dict[str, Any] = {}
    for turn in range(rounds + 1):
        for name, side in sides.items():
            begin = time.perf_counter()
            results[name] = side()
            if turn:
                seconds[name].append(time.perf_counter() - begin)
    return {name: float(np.median(times)) for name, times in seconds.items()}, results


if __name__ == "__main__":
    main()
