"""Whether every start is as its task file describes it: the premises of all suites' starts, on every backend.

For each settled start: every ``:init`` predicate of the BDDL about objects and joints holds, the goal is not yet true,
and nothing has moved by more than 5 mm after 50 further idle ticks. A row is a suite on a backend, with the number of
starts that miss each premise; all but the predicates, of which there are thousands, are listed by task and episode.
``--details FILE`` lists these as well, and ``--summarise FILE`` makes the results file of such a list. With ``--start
stored`` the predicates are asked of the init states exactly as LIBERO stores them, which says what it missed from the
beginning.

Two stages: ``--observe`` runs the backend, scene by scene in worker processes, and writes a file a scene with what it
saw; with ``--scenes`` it needs no LIBERO packages, so it can be done on a GPU machine. ``--judge`` asks the predicates
of these files, on native physics, and needs the packages. Without either, both are done in turn. Rows of other suites
and backends that the results file holds are kept; a suite that is judged again, be it in part, gets a new one.

    python benchmarks/premises.py                                        # native physics
    vecenv compile --out scenes --suite libero_object ... --geometry exact --geometry lean
    python benchmarks/premises.py --backend warp --scenes scenes --workers 6 --observe seen     # on a GPU machine
    python benchmarks/premises.py --judge seen
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import json
import queue
import tempfile
import threading
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import RESULTS, report
from fidelity.scenes import by_scene, tasks_of
from fidelity.workers import Worker

import vecenv
from vecenv.libero.env import SETTLE_ACTION, LiberoEnv
from vecenv.libero.physics.native import Group, Start
from vecenv.libero.scene import goals
from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import compile_scene
from vecenv.libero.tasks.suites import NUM_EPISODES, list_tasks

IDLE_TICKS = 50
MOVED = 0.005
# Metres by which a state of single precision may miss a touch: a bowl rests 4e-8 m deep, and 1 m is rounded by 6e-8.
ROUNDING = {"native": 0.0, "warp": 1e-6, "jax": 1e-6}
NOTE = "exceptions of predicates are left out; --details lists them"


# -- observing ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Job:
    """Tasks of one suite in one scene, on one backend with one geometry; ``start`` as on the command line."""

    suite: str
    tasks: tuple[int, ...]
    backend: str
    geometry: str
    start: str
    scenes: str | None
    episodes: int

    @property
    def side(self) -> str:
        """Short for backend and geometry."""
        return self.backend if self.geometry == "exact" else f"{self.backend} {self.geometry}"

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.side.replace(' ', '-')}_{self.start}_{self.suite}_{self.tasks[0]}.npz"


def observe(job: Job, folder: str) -> dict[str, Any]:
    """Write the starts of a scene as the backend has them, whether goals hold, and how far objects move; a summary."""
    options: dict[str, Any] = {"start": job.start}
    if job.start == "stored":
        options = {"start": "raw", "settle_steps": 0}
    env = vecenv.make(
        job.suite,
        tasks=list(job.tasks),
        episodes=range(job.episodes),
        backend=job.backend,
        geometry=job.geometry,
        scenes=job.scenes,
        **options,
    )
    assert isinstance(env, LiberoEnv)
    env.reset()
    (group,) = env.physics.groups
    bodies = np.array([group.scene.model.body(entity.root_body).id for entity in group.scene.fixtures], int)
    pos, quat = (group.expand(field)[:, bodies] for field in ("body_pos", "body_quat"))
    seen = {"qpos": np.array(group.qpos), "qvel": np.array(group.qvel), "body_pos": pos, "body_quat": quat}
    seen["solved"], before = env.check_success(), object_positions(env)
    if job.start != "stored":
        idle = np.tile(SETTLE_ACTION, (env.num_envs, IDLE_TICKS, 1))
        env.physics.run(idle, np.ones(env.num_envs, bool), np.full(env.num_envs, IDLE_TICKS))
    seen["moved"] = np.linalg.norm(object_positions(env) - before, axis=-1)
    names = [entity.name for entity in group.scene.objects]
    faults = {int(slot): text for slot, text in env.physics.faults.items()}
    env.close()
    about = {**dataclasses.asdict(job), "objects": names, "faults": faults}
    np.savez_compressed(Path(folder) / job.file, about=np.array(json.dumps(about)), **seen)
    return {"moved": int((seen["moved"] > MOVED).any(1).sum()), "solved": int(seen["solved"].sum()), "faults": faults}


def object_positions(env: LiberoEnv) -> np.ndarray:
    """Origins of the movable objects, metres, [n, objects, 3]."""
    (group,) = env.physics.groups
    group.refresh_kinematics()
    bodies = [group.scene.model.body(entity.root_body).id for entity in group.scene.objects]
    return np.array(group.xpos[:, bodies])


def observe_all(jobs: Sequence[Job], folder: Path, options: argparse.Namespace) -> None:
    """Do the jobs whose file is not there yet, in worker processes; print a line a job."""
    folder.mkdir(parents=True, exist_ok=True)
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in jobs:
        if not (folder / job.file).is_file():
            waiting.put(job)

    def work(gpu: int | None) -> None:
        worker = Worker(observe, gpu)
        while not waiting.empty():
            try:
                job = waiting.get_nowait()
            except queue.Empty:
                break
            row = worker.call((job, str(folder)), options.job_seconds)
            print(f"{job.side} {job.suite} {list(job.tasks)}: {row}", flush=True)
        worker.close()

    gpus = [i % options.gpus if options.gpus > 1 else None for i in range(options.workers)]
    threads = [threading.Thread(target=work, args=(gpu,)) for gpu in gpus]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


# -- judging -----------------------------------------------------------------------------------------------------------


def judge(path: Path) -> Iterator[tuple[str, int, dict[str, dict[str, list[int]]]]]:
    """For each task of a scene: key, number of starts, and premise -> what -> episodes that miss it."""
    with np.load(path, allow_pickle=False) as file:
        seen = {name: file[name] for name in file.files}
    about = json.loads(str(seen.pop("about")))
    job = Job(**{field.name: about[field.name] for field in dataclasses.fields(Job)})
    for index, task in enumerate(job.tasks):
        rows = slice(index * job.episodes, (index + 1) * job.episodes)
        own = {name: array[rows] for name, array in seen.items()}
        missed: dict[str, dict[str, list[int]]] = defaultdict(dict)
        for name, holds in init_predicates(job.suite, task, own, ROUNDING[job.backend]).items():
            if not holds.all():
                missed["init"][name] = np.flatnonzero(~holds).tolist()
        if own["solved"].any():
            missed["goal already true"]["goal"] = np.flatnonzero(own["solved"]).tolist()
        # A world that went non-finite has moved, too.
        far = ~(own["moved"] <= MOVED)
        for column in np.flatnonzero(far.any(0)):
            missed["moved"][about["objects"][column]] = np.flatnonzero(far[:, column]).tolist()
        for slot, text in about["faults"].items():
            if rows.start <= int(slot) < rows.stop:
                missed["fault"].setdefault(text, []).append(int(slot) - rows.start)
        yield f"{job.side}/{job.suite}/{task}", job.episodes, dict(missed)


def init_predicates(suite: str, task: int, seen: Mapping[str, np.ndarray], margin: float) -> dict[str, np.ndarray]:
    """Each ``:init`` predicate about objects and joints on the states that were seen, bool [n].

    Things that are at most ``margin`` metres apart touch.
    """
    problem, slots = list_tasks(suite)[task].problem(), np.arange(len(seen["qpos"]))
    objects = {instance.name for instance in problem.objects}
    wanted = tuple(p for p in problem.init if len(p.args) == 1 or p.args[0] in objects)
    premise = dataclasses.replace(problem, goal=wanted)
    scene = compile_scene(premise, contact_pairs=goals.contact_pairs([premise]))
    model = copy.copy(scene.model)
    model.geom_margin[:] += margin
    scene = dataclasses.replace(scene, model=model)
    table = goals.build_table([premise], scene, [0] * len(slots))
    probe = Group(scene, slots)
    bodies = np.array([scene.model.body(entity.root_body).id for entity in scene.fixtures], int)
    qpos, qvel, pos, quat = (seen[name] for name in ("qpos", "qvel", "body_pos", "body_quat"))
    probe.place(slots, Start(qpos=qpos, qvel=qvel, bodies=bodies, body_pos=pos, body_quat=quat))
    values = goals.predicates(
        table, xpos=probe.xpos, site_xpos=probe.site_xpos, site_xmat=probe.site_xmat, qpos=probe.qpos, touch=probe.touch
    )
    return {" ".join((p.name, *p.args)): values[:, i] for i, p in enumerate(wanted)}


# -- the table ---------------------------------------------------------------------------------------------------------


def summarise(exceptions: Mapping[str, Any], checked: Mapping[str, int]) -> list[dict[str, Any]]:
    """A row a suite and backend: how many starts miss each premise."""
    rows = []
    for side, suite in sorted({tuple(key.split("/")[:2]) for key in checked}):
        specs = list_tasks(suite)
        missed: dict[str, set[tuple[int, int]]] = defaultdict(set)
        counts = {key: number for key, number in checked.items() if key.startswith(f"{side}/{suite}/")}
        for key in counts:
            task = int(key.split("/")[2])
            for premise, what in exceptions.get(key, {}).items():
                for name, episodes in what.items():
                    elsewhere = premise == "init" and not on_workspace(name, specs[task].problem())
                    missed["init elsewhere" if elsewhere else premise] |= {(task, episode) for episode in episodes}
        rows.append(
            {
                "suite": suite,
                "backend": side,
                "tasks": len(counts),
                "starts": sum(counts.values()),
                "init: region of the table or floor": len(missed["init"]),
                "init: anything else": len(missed["init elsewhere"]),
                "goal already true": len(missed["goal already true"]),
                "moved > 5 mm": len(missed["moved"]),
                "fault": len(missed["fault"]),
            }
        )
    return in_order(rows)


def in_order(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows by backend, then in the order of the suites."""
    suites = vecenv.list_suites("libero")
    return sorted(rows, key=lambda row: (row["backend"], suites.index(row["suite"])))


def on_workspace(predicate: str, problem: Problem) -> bool:
    """Whether a predicate places something in a rectangle of the table or floor."""
    words = predicate.split()
    return words[0] == "on" and len(words) == 3 and ARENAS[problem.name].workspace in words[2]


def brief(exceptions: Mapping[str, Any]) -> dict[str, Any]:
    """Exceptions without the predicates."""
    without = {key: {k: what for k, what in missed.items() if k != "init"} for key, missed in exceptions.items()}
    return {key: missed for key, missed in without.items() if missed}


def kept(name: str, checked: Mapping[str, int]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows and exceptions that a results file has of suites on backends other than those that were checked."""
    path, anew = RESULTS / f"{name}.json", {tuple(key.split("/")[:2]) for key in checked}
    content = json.loads(path.read_text()) if path.is_file() else {"exceptions": {}, "rows": []}
    rows = [row for row in content["rows"] if (row["backend"], row["suite"]) not in anew]
    return rows, {key: what for key, what in content["exceptions"].items() if tuple(key.split("/")[:2]) not in anew}


def resummarise(details: Path) -> None:
    """Write the results file of a list that ``--details`` wrote, with that run's date, machine and versions."""
    content = json.loads(details.read_text())
    exceptions, checked, _ = (content.pop(name) for name in ("exceptions", "checked", "rows"))
    rows, others = kept(content["benchmark"], checked)
    content |= {"note": NOTE, "exceptions": {**others, **brief(exceptions)}}
    content["rows"] = in_order([*rows, *summarise(exceptions, checked)])
    (RESULTS / f"{content['benchmark']}.json").write_text(json.dumps(content, indent=1) + "\n")


def jobs_of(options: argparse.Namespace) -> list[Job]:
    """A job for every scene, backend and geometry."""
    jobs = []
    for suite in options.suites:
        for sharing in by_scene(tasks_of(suite, options.scenes)):
            chosen = tuple(task for task in sharing if options.task is None or task in options.task)
            shared = {"suite": suite, "tasks": chosen, "start": options.start, "scenes": options.scenes}
            jobs += [
                Job(**shared, backend=backend, geometry=geometry, episodes=options.episodes)
                for backend in options.backend
                for geometry in options.geometry
                if chosen
            ]
    return jobs


def main() -> None:
    """Observe and judge what is asked for."""
    options = arguments()
    if options.summarise:
        resummarise(options.summarise)
        return
    name = f"premises_{options.start}"
    exceptions: dict[str, Any] = {}
    checked: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as passing:
        folder = options.observe or options.judge or Path(passing)
        if not options.judge:
            observe_all(jobs_of(options), folder, options)
        if options.observe:
            print(f"files in {options.observe}; now --judge {options.observe} where LIBERO's packages are installed")
            return
        for path in sorted(folder.glob(f"*_{options.start}_*.npz")):
            for key, starts, missed in judge(path):
                checked[key] = starts
                if missed:
                    exceptions[key] = missed
    rows, others = kept(name, checked)
    rows = in_order([*rows, *summarise(exceptions, checked)])
    notes = {"note": NOTE, "exceptions": {**others, **brief(exceptions)}}
    path = report(name, rows, title=f"starts ({options.start}) that miss a premise", notes=notes)
    if options.details:
        content = json.loads(path.read_text()) | {"exceptions": exceptions, "checked": checked}
        options.details.write_text(json.dumps(content, indent=1) + "\n")


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", help="all by default")
    parser.add_argument("--start", default="settled", choices=("settled", "raw", "stored"))
    parser.add_argument("--backend", nargs="+", default=["native"], choices=("native", "warp", "jax"))
    parser.add_argument("--geometry", nargs="+", default=["exact"], choices=("exact", "lean"))
    parser.add_argument("--task", nargs="+", type=int, help="only these tasks of each suite")
    parser.add_argument("--episodes", type=int, default=NUM_EPISODES, help="starts of each task, the first so many")
    parser.add_argument("--scenes", help="folder that `vecenv compile` wrote; the installed packages otherwise")
    parser.add_argument("--observe", type=Path, metavar="DIR", help="only run the backend; files that are there stay")
    parser.add_argument("--judge", type=Path, metavar="DIR", help="only ask the predicates of what --observe wrote")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--gpus", type=int, default=1, help="GPUs that the workers spread over")
    parser.add_argument("--job-seconds", type=float, default=1200.0, help="give a scene up after this long")
    parser.add_argument("--details", type=Path, metavar="FILE", help="also list every exception, predicates too")
    parser.add_argument("--summarise", type=Path, metavar="FILE", help="only: the results file of what --details wrote")
    options = parser.parse_args()
    options.suites = options.suites or list(vecenv.list_suites("libero"))
    return options


if __name__ == "__main__":
    main()
