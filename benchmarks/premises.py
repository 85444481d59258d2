"""Whether every start is what its task file says: the premises of all suites' starts, on every backend.

For each settled start: every ``:init`` predicate of the BDDL holds, the goal is not yet true, and nothing has moved by
more than 5 mm after 50 further idle ticks. A row is a suite, with the number of starts that miss each premise; the file
lists them by task and episode, and predicates that no start of a task fulfils apart from those that only some miss.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import defaultdict
from typing import Any

import numpy as np
from common import report
from rich.progress import track

import vecenv
from vecenv.libero import goals
from vecenv.libero.env import SETTLE_ACTION, LiberoEnv
from vecenv.libero.scene import compile_scene
from vecenv.libero.suites import NUM_EPISODES
from vecenv.physics.native import Group, Start

IDLE_TICKS = 50
MOVED = 0.005
BACKENDS = ("native",)


def check_task(suite: str, task: int, start: str, backend: str) -> dict[str, dict[str, list[int]]]:
    """Premise -> what -> episodes that miss it."""
    env = vecenv.make(
        suite, task=task, episodes=range(NUM_EPISODES), start=start, backend=backend, max_steps=IDLE_TICKS + 1
    )
    assert isinstance(env, LiberoEnv)
    env.reset()
    missed: dict[str, dict[str, list[int]]] = defaultdict(dict)
    for name, holds in init_predicates(env, suite, task).items():
        if not holds.all():
            missed["init"][name] = np.flatnonzero(~holds).tolist()
    solved = env.check_success()
    if solved.any():
        missed["goal already true"]["goal"] = np.flatnonzero(solved).tolist()
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
    probe = Group(scene, np.arange(env.num_envs), 0)
    bodies = np.array([scene.model.body(entity.root_body).id for entity in scene.fixtures], int)
    pos, quat = (group.batch.expand(field)[:, bodies] for field in ("body_pos", "body_quat"))
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


def main() -> None:
    """Check the suites asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", default=list(vecenv.list_suites()))
    parser.add_argument("--start", default="settled", choices=("settled", "raw"))
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    exceptions: dict[str, Any] = {}
    for backend in BACKENDS:
        for suite in arguments.suites:
            counts: dict[str, set[tuple[int, int]]] = defaultdict(set)
            tasks = vecenv.list_tasks(suite)
            for spec in track(tasks, description=suite):
                missed = check_task(suite, spec.index, arguments.start, backend)
                for premise, what in missed.items():
                    for episodes in what.values():
                        counts[premise] |= {(spec.index, episode) for episode in episodes}
                if missed:
                    exceptions[f"{backend}/{suite}/{spec.index}"] = missed
            row: dict[str, Any] = {"suite": suite, "backend": backend, "starts": len(tasks) * NUM_EPISODES}
            for premise in ("init", "goal already true", "moved", "fault"):
                row[premise] = len(counts[premise])
            rows.append(row)
            print(row, flush=True)
    report(
        f"premises_{arguments.start}",
        rows,
        title=f"starts ({arguments.start}) that miss a premise",
        notes={"exceptions": exceptions},
    )


if __name__ == "__main__":
    main()
