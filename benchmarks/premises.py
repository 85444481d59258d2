"""Whether every start is what its task file says: the premises of all suites' starts, on every backend.

For each settled start: every ``:init`` predicate of the BDDL about objects and joints holds, the goal is not yet true,
and nothing has moved by more than 5 mm after 50 further idle ticks. A row is a suite, with the number of starts that
miss each premise; the file lists them by task, predicate or object, and episode. With ``--start stored`` the predicates
are asked of the init states exactly as LIBERO stores them, which says what it missed from the beginning.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from common import RESULTS, report
from rich.progress import track

import vecenv
from vecenv.libero import goals
from vecenv.libero.arenas import ARENAS
from vecenv.libero.bddl import Problem
from vecenv.libero.env import SETTLE_ACTION, LiberoEnv
from vecenv.libero.scene import compile_scene
from vecenv.libero.suites import NUM_EPISODES
from vecenv.physics.native import Group, Start

IDLE_TICKS = 50
MOVED = 0.005
BACKENDS = ("native",)


def check_task(suite: str, task: int, start: str, backend: str) -> dict[str, dict[str, list[int]]]:
    """Premise -> what -> episodes that miss it."""
    options: dict[str, Any] = {"start": "raw", "settle_steps": 0} if start == "stored" else {"start": start}
    env = vecenv.make(suite, task=task, episodes=range(NUM_EPISODES), backend=backend, **options)
    assert isinstance(env, LiberoEnv)
    env.reset()
    missed: dict[str, dict[str, list[int]]] = defaultdict(dict)
    for name, holds in init_predicates(env, suite, task).items():
        if not holds.all():
            missed["init"][name] = np.flatnonzero(~holds).tolist()
    solved = env.check_success()
    if solved.any():
        missed["goal already true"]["goal"] = np.flatnonzero(solved).tolist()
    if start == "stored":
        env.close()
        return missed
    before = object_positions(env)
    control = env.step_continuous(np.tile(SETTLE_ACTION, (env.num_envs, IDLE_TICKS, 1)))
    moved = np.linalg.norm(object_positions(env) - before, axis=-1)
    for index, name in enumerate(entity.name for entity in env.physics.groups[0].scene.objects):
        if (moved[:, index] > MOVED).any():
            missed["moved"][name] = np.flatnonzero(moved[:, index] > MOVED).tolist()
    faults = [slot for slot, fault in enumerate(control.info["fault"]) if fault]
    if faults:
        missed["fault"]["physics"] = faults
    env.close()
    return missed


def init_predicates(env: LiberoEnv, suite: str, task: int) -> dict[str, np.ndarray]:
    """Each ``:init`` predicate about objects and joints, bool [50], on the present state."""
    problem = vecenv.list_tasks(suite)[task].problem()
    objects = {instance.name for instance in problem.objects}
    group = env.physics.groups[0]
    wanted = tuple(p for p in problem.init if len(p.args) == 1 or p.args[0] in objects)
    premise = dataclasses.replace(problem, goal=wanted)
    scene = compile_scene(premise, contact_pairs=goals.contact_pairs([premise]))
    table = goals.build_table([premise], scene, [0] * env.num_envs)
    probe = Group(scene, np.arange(env.num_envs))
    bodies = np.array([scene.model.body(entity.root_body).id for entity in scene.fixtures], int)
    pos, quat = (group.expand(field)[:, bodies] for field in ("body_pos", "body_quat"))
    start = Start(qpos=group.qpos, qvel=group.qvel, bodies=bodies, body_pos=pos, body_quat=quat)
    probe.place(np.arange(env.num_envs), start)
    values = goals.predicates(
        table, xpos=probe.xpos, site_xpos=probe.site_xpos, site_xmat=probe.site_xmat, qpos=probe.qpos, touch=probe.touch
    )
    return {" ".join((p.name, *p.args)): values[:, i] for i, p in enumerate(wanted)}


def object_positions(env: LiberoEnv) -> np.ndarray:
    """Origins of the movable objects, metres, [50, objects, 3]."""
    group = env.physics.groups[0]
    group.refresh_kinematics()
    bodies = [group.scene.model.body(entity.root_body).id for entity in group.scene.objects]
    return group.xpos[:, bodies].copy()


def summarise(exceptions: Mapping[str, Any], suites: Sequence[str], backends: Sequence[str]) -> list[dict[str, Any]]:
    """A row a suite and backend: how many starts miss each premise."""
    rows = []
    for backend in backends:
        for suite in suites:
            specs = vecenv.list_tasks(suite)
            missed: dict[str, set[tuple[int, int]]] = defaultdict(set)
            for spec in specs:
                for premise, what in exceptions.get(f"{backend}/{suite}/{spec.index}", {}).items():
                    for name, episodes in what.items():
                        kind = premise if premise != "init" or on_workspace(name, spec.problem()) else "init elsewhere"
                        missed[kind] |= {(spec.index, episode) for episode in episodes}
            rows.append(
                {
                    "suite": suite,
                    "backend": backend,
                    "starts": len(specs) * NUM_EPISODES,
                    "init: region of the table or floor": len(missed["init"]),
                    "init: anything else": len(missed["init elsewhere"]),
                    "goal already true": len(missed["goal already true"]),
                    "moved > 5 mm": len(missed["moved"]),
                    "fault": len(missed["fault"]),
                }
            )
    return rows


def on_workspace(predicate: str, problem: Problem) -> bool:
    """Whether a predicate places something in a rectangle of the table or floor."""
    words = predicate.split()
    return words[0] == "on" and len(words) == 3 and ARENAS[problem.name].workspace in words[2]


def main() -> None:
    """Check the suites asked for, or count again what a finished run found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", default=list(vecenv.list_suites()))
    parser.add_argument("--start", default="settled", choices=("settled", "raw", "stored"))
    parser.add_argument("--recount", action="store_true", help="only count again what the last run wrote")
    arguments = parser.parse_args()
    name = f"premises_{arguments.start}"
    exceptions: dict[str, Any] = {}
    if arguments.recount:
        exceptions = json.loads((RESULTS / f"{name}.json").read_text())["exceptions"]
    else:
        for backend in BACKENDS:
            for suite in arguments.suites:
                for spec in track(vecenv.list_tasks(suite), description=f"{suite} ({backend})"):
                    missed = check_task(suite, spec.index, arguments.start, backend)
                    if missed:
                        exceptions[f"{backend}/{suite}/{spec.index}"] = missed
    rows = summarise(exceptions, arguments.suites, BACKENDS)
    report(name, rows, title=f"starts ({arguments.start}) that miss a premise", notes={"exceptions": exceptions})


if __name__ == "__main__":
    main()
