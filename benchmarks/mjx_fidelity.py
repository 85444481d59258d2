"""Whether MJX plays LIBERO as native MuJoCo does: settling, replayed and closed-loop verdicts, scene by scene.

Three stages, so that the GPU machine needs no LIBERO packages and no native physics. ``record`` runs `pick_place` on
the native backend with upstream's geometry and writes one file a suite: starts, what moves in 50 idle ticks, actions,
verdicts, where objects end. ``compare`` gives every backend and geometry the same starts and actions: one batch a
scene, in which every episode is once idle and twice replayed (the second shows how far MJX repeats itself).
``table`` turns the results of ``compare`` into Markdown. The backend ``nudged`` is the yardstick: native once more,
every action moved by the rounding error of single precision; no float32 backend can be expected to differ by less.

Scenes are compiled and run by worker processes; a scene that fails or hangs is reported and the others continue.
Results are written after every scene, and a second run does what is missing.

    python benchmarks/mjx_fidelity.py record --out recordings
    vecenv compile --out scenes --suite libero_object ... --geometry exact --geometry lean
    python benchmarks/mjx_fidelity.py compare recordings --scenes scenes --workers 6
    python benchmarks/mjx_fidelity.py table
"""

from __future__ import annotations

import argparse
import queue
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from common import RESULTS, ROOT
from fidelity.jobs import IDLE_TICKS, Job, Setup, perform
from fidelity.measures import Row
from fidelity.recordings import Recording, RecordingError, joined, kept_length, recording_path
from fidelity.rows import NAME, conditions, contacts_of, key_of, line, read_rows, write_rows
from fidelity.scenes import begin_again, by_scene, ended, make, play, run, scene_name, tasks_of
from fidelity.tables import SUITES, markdown
from fidelity.workers import Worker

from vecenv.libero.env import SETTLE_ACTION
from vecenv.libero.scene.contacts import CONTACTS

# Episodes of each task to record, where they are not 10.
EPISODES = {"libero_object": 50}
CAP = 400
DOC = ROOT / "docs" / "mjx_fidelity_table.md"


def record(options: argparse.Namespace) -> None:
    """Write the recordings of the suites asked for; a suite's file is complete up to the last scene named."""
    options.out.mkdir(parents=True, exist_ok=True)
    for suite in options.suite:
        tasks, parts, started = tasks_of(suite, options.scenes), [], time.perf_counter()
        episodes = options.episodes or EPISODES.get(suite, 10)
        for chosen in by_scene(tasks):
            parts.append(record_scene(suite, chosen, episodes, options))
            whole = joined(parts)
            whole.save(recording_path(options.out, suite))
            name = scene_name(suite, chosen, [tasks[i].name for i in chosen])
            solved, seconds = parts[-1].success, time.perf_counter() - started
            text = f"{name}: {solved.sum()}/{len(solved)} solved, at most {parts[-1].length.max()} ticks"
            print(f"{text}, {seconds:.0f} s", flush=True)
        size = recording_path(options.out, suite).stat().st_size
        print(f"{suite}: {whole.success.sum()}/{len(whole.task)} solved, {size / 1e6:.2f} MB", flush=True)


def record_scene(suite: str, tasks: Sequence[int], episodes: int, options: argparse.Namespace) -> Recording:
    """Idle and played episodes of one scene on the native backend."""
    options_of_scene = {"max_steps": options.cap, "scenes": options.scenes, "contacts": options.contacts}
    env = make(suite, tasks=tasks, episodes=range(episodes), **options_of_scene)
    b = env.num_envs
    start = ended(env, np.zeros(b, int), np.zeros(b, bool)).objects
    settled = run(env, np.tile(SETTLE_ACTION, (b, IDLE_TICKS, 1)), np.full(b, IDLE_TICKS)).objects
    begin_again(env)
    actions, end = play(env)
    env.close()
    if end.faults:
        raise RecordingError(f"{suite} tasks {tasks}: native physics failed in slots {sorted(end.faults)}")
    played = [row[:ticks] for row, ticks in zip(actions, end.ticks, strict=True)]
    played = [row if solved else row[: kept_length(row)] for row, solved in zip(played, end.success, strict=True)]
    return Recording(
        suite=suite,
        task=np.repeat(tasks, episodes),
        episode=np.tile(np.arange(episodes), len(tasks)),
        length=np.array([len(row) for row in played]),
        success=end.success,
        actions=np.concatenate(played),
        start=start,
        settled=settled,
        end=end.objects,
        notes={"policy": "pick_place", "cap": options.cap, "contacts": options.contacts, **conditions()},
    )


def jobs_of(options: argparse.Namespace) -> list[Job]:
    """What is to be done, the most important first: replays of all suites, then closed loops."""
    jobs = []
    for kind, suites in (("replay", options.suite), ("closed", options.closed_loop)):
        for suite in sorted(suites, key=SUITES.index):
            tasks = tasks_of(suite, options.scenes)
            for sharing in by_scene(tasks):
                chosen = [task for task in sharing if options.task is None or task in options.task]
                if not chosen:
                    continue
                name = scene_name(suite, chosen, [tasks[i].name for i in chosen])
                for geometry in options.geometry:
                    shared = {"suite": suite, "scene": name, "tasks": tuple(chosen), "geometry": geometry}
                    jobs += [Job(kind=kind, backend=backend, **shared) for backend in options.backend]
    return jobs


def shared_out(jobs: Sequence[Job], setup: Setup, options: argparse.Namespace) -> Iterator[tuple[Job, Row]]:
    """Rows of the jobs as they come, from all workers; after ``--limit-seconds`` what still runs is cut off."""
    deadline = time.monotonic() + options.limit_seconds
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    done: queue.SimpleQueue[tuple[Job, Row] | None] = queue.SimpleQueue()
    for job in jobs:
        waiting.put(job)

    def work(gpu: int | None) -> None:
        worker = Worker(perform, gpu)
        while time.monotonic() < deadline:
            try:
                job = waiting.get_nowait()
            except queue.Empty:
                break
            row = worker.call((job, setup), min(options.job_seconds, deadline - time.monotonic()))
            if "error" not in row or time.monotonic() < deadline:  # what was cut off has not failed
                done.put((job, row))
        worker.close()
        done.put(None)

    gpus = [i % options.gpus if options.gpus > 1 else None for i in range(options.workers)]
    threads = [threading.Thread(target=work, args=(gpu,)) for gpu in gpus]
    for thread in threads:
        thread.start()
    for _ in threads:
        yield from iter(done.get, None)


def compare(options: argparse.Namespace) -> None:
    """Do the jobs that the results file does not have yet; print a line a job."""
    setup = Setup(
        recordings=options.recordings,
        contacts=options.contacts,
        scenes=options.scenes,
        episodes=options.episodes,
        ticks=options.ticks,
        again=tuple(options.again),
    )
    path = options.out / f"{NAME}.json"
    rows = {key_of(row): row for row in ([] if options.anew else read_rows([path])) if "error" not in row}
    if other := contacts_of(list(rows.values())) - {options.contacts}:
        raise SystemExit(f"{path} has rows with contacts={', '.join(other)}: another --out, or --anew to forget them")
    jobs = [job for job in jobs_of(options) if job.key not in rows]
    print(f"{len(jobs)} jobs, {len(rows)} rows are there already", flush=True)
    started = time.monotonic()
    for job, row in shared_out(jobs, setup, options):
        rows[job.key] = {
            **asdict(job),
            "contacts": options.contacts,
            "workers": options.workers,
            "gpus": options.gpus,
            "at most": options.ticks,
            **row,
        }
        write_rows(path, list(rows.values()))
        print(f"{time.monotonic() - started:4.0f} s {line(rows[job.key])}", flush=True)
    missing = sum(job.key not in rows for job in jobs)
    failed = sum("error" in rows[job.key] for job in jobs if job.key in rows)
    print(f"rows in {path}; {failed} jobs failed, {missing} were not reached")


def table(options: argparse.Namespace) -> None:
    """Merge results files and write the Markdown."""
    rows = read_rows(options.results)
    if not rows:
        raise SystemExit(f"no rows in {', '.join(map(str, options.results))}")
    if len(contacts_of(rows)) > 1:
        raise SystemExit(f"rows with different contacts ({', '.join(sorted(contacts_of(rows)))}) do not make one table")
    options.out.write_text(markdown(rows))
    print(f"{len(rows)} rows in {options.out}")


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    stages = parser.add_subparsers(required=True, metavar="record | compare | table")
    both = argparse.ArgumentParser(add_help=False)
    both.add_argument("--suite", nargs="+", choices=SUITES, default=list(SUITES))
    both.add_argument("--scenes", help="folder that `vecenv compile` wrote; the installed packages otherwise")
    both.add_argument("--episodes", type=int, help="of each task, at most; all that are recorded, or 10 (50) to record")
    both.add_argument("--contacts", choices=CONTACTS, default="published", help="of native and of all backends")

    stage = stages.add_parser("record", parents=[both], help="run pick_place on native MuJoCo")
    stage.add_argument("--out", type=Path, required=True, help="folder for the recordings")
    stage.add_argument("--cap", type=int, default=CAP, help="control ticks of an episode at most")
    stage.set_defaults(stage=record)

    stage = stages.add_parser("compare", parents=[both], help="give MJX the same starts and actions")
    stage.add_argument("recordings", type=Path, help="folder of the recordings")
    stage.add_argument("--task", nargs="+", type=int, help="only these tasks of each suite, to look into something")
    stage.add_argument("--ticks", type=int, help="end every replayed episode after this many, on both sides")
    stage.add_argument("--backend", nargs="+", default=["warp"], choices=("warp", "jax", "native", "nudged"))
    stage.add_argument("--geometry", nargs="+", default=["exact", "lean"], choices=("exact", "lean"))
    stage.add_argument("--closed-loop", nargs="+", choices=SUITES, default=[], help="suites to play closed-loop too")
    stage.add_argument(
        "--again", nargs="*", default=["libero_spatial"], help="suites whose replay is run a second time"
    )
    stage.add_argument("--workers", type=int, default=1, help="processes; compiling is what takes long")
    stage.add_argument("--gpus", type=int, default=1, help="GPUs that the workers spread over")
    stage.add_argument("--limit-seconds", type=float, default=3600.0, help="stop after this long")
    stage.add_argument("--job-seconds", type=float, default=300.0, help="give a scene up after this long")
    stage.add_argument("--out", type=Path, default=RESULTS, help="folder for the results file")
    stage.add_argument("--anew", action="store_true", help="forget the rows that are in it")
    stage.set_defaults(stage=compare)

    stage = stages.add_parser("table", help="write the Markdown")
    stage.add_argument("results", nargs="*", type=Path, default=[RESULTS / f"{NAME}.json"], help="results files")
    stage.add_argument("--out", type=Path, default=DOC)
    stage.set_defaults(stage=table)
    return parser.parse_args(given)


if __name__ == "__main__":
    options = arguments()
    options.stage(options)
