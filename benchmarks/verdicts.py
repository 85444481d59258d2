"""Verdicts against upstream: the goal function of every task on states of every kind, none left out.

States of a task: settled and stored starts; random rollouts; `pick_place` rollouts, which pass through grasps, carries
and, mostly, success; and states placed at and across each border of the goal (sides of regions, first contact, support
radius, joint thresholds). Both sides get the same positions and fixture poses; ours judges with `goals.evaluate`,
upstream with `check_success`, under MuJoCo 3.3.0 for published contacts (`make upstream`) and under the installed one
for current contacts. A row is a suite; rows of other suites that the results file holds are kept if they were made with
the same versions.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from typing import Any

import numpy as np
import peer
from common import RESULTS, report
from rich.progress import track
from vecenv_eval.policies import make_policy

import vecenv
from vecenv.contract import BatchEnv
from vecenv.doctor import versions
from vecenv.libero.env import LiberoEnv
from vecenv.libero.scene import goals
from vecenv.libero.scene.contacts import Contacts
from vecenv.libero.scene.scene import compile_scene
from vecenv.libero.tasks import fixtures
from vecenv.libero.tasks.suites import BASE_SUITES, TaskSpec, list_tasks

EPISODES = 4
RANDOM_TICKS, POLICY_TICKS, EVERY = 40, 160, 8


def make(spec: TaskSpec, contacts: Contacts) -> LiberoEnv:
    """Four episodes of a task, live."""
    env: BatchEnv = vecenv.make(spec.suite, task=spec.index, episodes=range(EPISODES), contacts=contacts)
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def rollout_states(spec: TaskSpec, kind: str, contacts: Contacts) -> list[np.ndarray]:
    """qpos of every few ticks of a rollout, each [nq]."""
    env, rng = make(spec, contacts), np.random.default_rng(spec.index)
    policy = make_policy("pick_place") if kind == "pick_place" else None
    if policy is not None:
        policy.reset(env, env.reset())
    states = []
    for tick in range(POLICY_TICKS if policy else RANDOM_TICKS):
        actions = policy.act(env) if policy else rng.uniform(-1, 1, (EPISODES, 7))
        assert isinstance(actions, np.ndarray)
        control = env.step_continuous(actions)
        if tick % EVERY == 0 or control.done.all():
            states += list(env.state().qpos)
        if control.done.all():
            break
    states += list(env.state().qpos)
    env.close()
    return states


def compare(spec: TaskSpec, contacts: Contacts, python: str) -> tuple[Counter[str], int, int]:
    """How many states of each kind, on how many both find the goal true, and on how many they differ."""
    from support.goal_states import GoalStates, Simulation

    from vecenv.libero.tasks import settled

    problem, rng = spec.problem(), np.random.default_rng(spec.index)
    scene = compile_scene(problem, contact_pairs=goals.contact_pairs([problem]), contacts=contacts)
    simulation = Simulation(scene)
    bodies, pos, quat = fixtures.poses(problem, scene, "center", keys=[(0, spec.suite, spec.index, 0)], slots=[0])
    simulation.stand(list(bodies), pos[0], quat[0])
    nq = scene.model.nq
    stored = spec.init_states()[::5, 1 : 1 + nq]
    builder = GoalStates(problem, simulation, stored[0], rng)
    states: dict[str, list[np.ndarray]] = {
        "starts": [*stored, *settled.load(spec).qpos[::2]],
        "random": rollout_states(spec, "random", contacts),
        "pick_place": rollout_states(spec, "pick_place", contacts),
        "edges": [*builder.edges(), *builder.scattered(20)],
    }
    everything = [state for group in states.values() for state in group]
    table = goals.build_table([problem], scene, [0] * len(everything))
    ours = goals.evaluate(table, **simulation.reads(everything))
    fixed = bodies, pos[0], quat[0]
    theirs = peer.verdicts(spec.suite, spec.index, np.array(everything), fixed, python)
    differ = ours != theirs
    return Counter({kind: len(group) for kind, group in states.items()}), int((ours & ~differ).sum()), int(differ.sum())


def kept(name: str, suites: list[str]) -> list[dict[str, Any]]:
    """Rows of a results file about suites other than these; none where other versions made them."""
    path = RESULTS / f"{name}.json"
    content = json.loads(path.read_text()) if path.is_file() else {}
    if content.get("versions") != versions():
        return []
    return [row for row in content["rows"] if row["suite"] not in suites]


def main() -> None:
    """Compare every task of the suites asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suites", nargs="*", default=list(BASE_SUITES))
    peer.add_arguments(parser)
    options = parser.parse_args()
    python = peer.python_of(options)
    rows: list[dict[str, Any]] = []
    for suite in options.suites:
        counts: Counter[str] = Counter()
        solved = differ = 0
        for spec in track(list_tasks(suite), description=suite):
            found, yes, no = compare(spec, options.contacts, python)
            counts, solved, differ = counts + found, solved + yes, differ + no
        rows.append(
            {
                "suite": suite,
                "tasks": len(list_tasks(suite)),
                **{kind: counts[kind] for kind in ("starts", "random", "pick_place", "edges")},
                "states": counts.total(),
                "goal holds": solved,
                "verdicts differ": differ,
            }
        )
        print(rows[-1], flush=True)
    name = "verdicts" if options.contacts == "published" else "verdicts_current"
    order = list(BASE_SUITES)
    rows = sorted(kept(name, options.suites) + rows, key=lambda row: order.index(row["suite"]))
    report(
        name,
        rows,
        title=f"states judged by both sides, {options.contacts} contacts",
        notes={
            "contacts": options.contacts,
            "states": sum(row["states"] for row in rows),
            "differ": sum(row["verdicts differ"] for row in rows),
        },
    )


if __name__ == "__main__":
    main()
