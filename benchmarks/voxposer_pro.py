"""VoxPoser on LIBERO-PRO: the success rate of each of its 16 suites, programs written by the rule base.

    python benchmarks/voxposer_pro.py --jobs 8
    python benchmarks/voxposer_pro.py --suites libero_goal_task --tasks 1,4 --episodes 0-1 --scenes DIR

LIBERO-PRO changes words, objects, places or goals of LIBERO's suites. A task of a suite is a results folder below
``--work``, and ``--jobs`` processes of their own run the tasks side by side, each on its share of the cores. Episodes
are stored as they end: the same command continues where it was stopped, and ``--report`` writes the rows of what is
there. ``--scenes`` reads a folder that ``vecenv compile`` wrote; LIBERO's packages are then not needed. A row is a
suite, with a 95 % Wilson interval; ``failures`` in the results file has the episodes that were not solved, with causes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple

from common import ROOT, report
from vecenv_eval.report import wilson
from vecenv_eval.store import Record, ResultStore

SUITES = tuple(
    f"libero_{suite}_{change}"
    for suite in ("spatial", "object", "goal", "10")
    for change in ("lan", "object", "swap", "task")
)
TASKS = 10


class Job(NamedTuple):
    """Episodes of a task: their suite, the task, which, how many at once, exported scenes or "", and the folder."""

    suite: str
    task: int
    episodes: str
    num_envs: int
    scenes: str
    folder: Path


def main() -> None:
    """Run what is missing, and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suites", default=",".join(SUITES))
    parser.add_argument("--tasks", default=f"0-{TASKS - 1}", help="indices and ranges: 0,3,5-7")
    parser.add_argument("--episodes", default="0-9", help="of each task: all, 5 for the first five, or 0,3,5-7")
    parser.add_argument("--num-envs", type=int, default=10, help="episodes at once in a process")
    parser.add_argument("--jobs", type=int, default=1, help="processes side by side, about 1.5 GB each")
    parser.add_argument("--scenes", default="", help="folder of scenes that vecenv compile wrote")
    parser.add_argument("--work", type=Path, default=ROOT / "results" / "voxposer_pro")
    parser.add_argument("--report", action="store_true", help="run nothing; report what the folder has")
    options = parser.parse_args()
    suites = options.suites.split(",")
    unknown = [suite for suite in suites if suite not in SUITES]
    if unknown:
        parser.error(f"no suite {unknown[0]!r}; there are {', '.join(SUITES)}")
    if options.jobs < 1 or options.num_envs < 1:
        parser.error("--jobs and --num-envs must be at least 1")
    tasks = _indices(parser, options.tasks)
    scenes = str(Path(options.scenes).resolve()) if options.scenes else ""
    common = (options.episodes, options.num_envs, scenes)
    jobs = [Job(suite, task, *common, options.work / suite / f"{task}") for task in tasks for suite in suites]
    causes = [] if options.report else run(jobs, options.jobs)
    rows, failures = rows_of(jobs)
    if not rows:
        raise SystemExit("\n".join([f"{options.work}: no episodes of these suites yet", *causes]))
    notes = {"privileged": PRIVILEGED, "not run": causes, "failures": failures}
    report("voxposer_pro", rows, title="VoxPoser (offline/libero) on LIBERO-PRO", notes=notes)
    if causes:
        raise SystemExit("\n".join(["not everything was run; the same command continues:", *causes]))


PRIVILEGED = (
    "Ground truth of the simulator: names, poses and surface points of objects and parts, and grasps and places "
    "computed on them. Programs are written by rules, not by a language model. Goals are not read."
)


def _indices(parser: argparse.ArgumentParser, text: str) -> list[int]:
    """Indices of tasks: "0,3,5-7"."""
    try:
        spans = [[int(end) for end in part.split("-")] for part in text.split(",")]
        found = [task for span in spans for task in range(span[0], span[-1] + 1)]
    except ValueError:
        parser.error(f"--tasks {text!r}: expected indices and ranges such as 0,3,5-7")
    if not found or max(found) >= TASKS or any(len(span) > 2 for span in spans):
        parser.error(f"--tasks {text!r}: expected indices from 0 to {TASKS - 1}")
    return sorted(set(found))


# -- running -----------------------------------------------------------------------------------------------------------


def run(jobs: Sequence[Job], processes: int) -> list[str]:
    """Run jobs in processes, as many at once; a sentence for each that came to no end."""
    # A process that forked could inherit locks of threads.
    context = multiprocessing.get_context("spawn")
    share = max(1, len(os.sched_getaffinity(0)) // processes) if hasattr(os, "sched_getaffinity") else 1
    # Libraries count cores when they are imported, before a process knows its share.
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), str(share)))
    numbers = context.Value("i", 0)
    causes = []
    with ProcessPoolExecutor(processes, context, initializer=_begin, initargs=(numbers, processes)) as pool:
        running = {pool.submit(run_job, job): job for job in jobs}
        for count, done in enumerate(as_completed(running), 1):
            job = running[done]
            try:
                print(f"{count}/{len(jobs)} {job.suite}/{job.task}: {done.result()}", flush=True)
            except BrokenProcessPool:
                causes.append(f"{job.suite}/{job.task}: its process, or one beside it, was killed (memory?)")
            except Exception as error:  # other tasks go on; the status says that one did not
                causes.append(f"{job.suite}/{job.task}: {type(error).__name__}: {error}")
    return causes


def _begin(numbers: Any, processes: int) -> None:
    """Give this process its share of the cores, before any library counts them."""
    with numbers.get_lock():
        number = numbers.value
        numbers.value += 1
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        share = [core for i, core in enumerate(cores) if i % processes == number % processes]
        os.sched_setaffinity(0, share or [cores[number % len(cores)]])


def run_job(job: Job) -> str:
    """Run the episodes of a job that its folder does not have; how many were solved."""
    from vecenv_eval.config import EvalConfig
    from vecenv_eval.runner import evaluate

    config = EvalConfig(
        suite=job.suite,
        policy="voxposer",
        tasks=str(job.task),
        episodes=job.episodes,
        num_envs=job.num_envs,
        env_args={"scenes": job.scenes} if job.scenes else {},
    )
    records = evaluate(config, job.folder).records
    return f"{sum(record.success for record in records)} of {len(records)} solved"


# -- reporting ---------------------------------------------------------------------------------------------------------


def rows_of(jobs: Sequence[Job]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A row for each suite with episodes, and the episodes that were not solved."""
    by_suite: dict[str, list[Record]] = {}
    for job in jobs:
        if (job.folder / "config.json").is_file():
            by_suite.setdefault(job.suite, []).extend(ResultStore.open(job.folder).records().values())
    found = {suite: records for suite, records in by_suite.items() if records}
    order = [suite for suite in SUITES if suite in found]
    failures = [failure_of(record) for suite in order for record in found[suite] if not record.success]
    return [row_of(suite, found[suite]) for suite in order], failures


def row_of(suite: str, records: Sequence[Record]) -> dict[str, Any]:
    """The row of a suite; "failed" has, by task, how many of its episodes were not solved."""
    solved = sum(record.success for record in records)
    low, high = wilson(solved, len(records))
    failed = {
        task: f"{sum(not r.success for r in own)}/{len(own)}"
        for task in sorted({record.task for record in records})
        for own in [[record for record in records if record.task == task]]
        if not all(record.success for record in own)
    }
    return {
        "suite": suite,
        "episodes": len(records),
        "solved": solved,
        "rate": round(solved / len(records), 3),
        "95 %": f"{low:.2f}-{high:.2f}",
        "steps": round(sum(record.num_steps for record in records) / len(records)),
        "failed": ", ".join(f"{task}: {share}" for task, share in failed.items()),
    }


def failure_of(record: Record) -> dict[str, Any]:
    """What is known about an episode that was not solved."""
    cause = record.error or record.fault or record.extras.get("cause", "")
    which = {"suite": record.suite, "task": record.task, "episode": record.episode}
    return {**which, "instruction": record.instruction, "steps": record.num_steps, "cause": cause}


if __name__ == "__main__":
    main()
