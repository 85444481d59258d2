"""Verdicts against upstream: the goal function of every task on states of every kind, none left out.

States of a task: settled and stored starts; random rollouts; `pick_place` rollouts, which pass through grasps, carries
and, mostly, success; and states placed at and across each border of the goal (sides of regions, first contact, support
radius, joint thresholds). Both sides get the same positions and fixture poses; ours judges with `goals.evaluate`,
upstream with `check_success`. A row is a suite.
"""

from __future__ import annotations

import argparse
from collections import Counter
from typing import Any

import numpy as np
from common import report
from rich.progress import track

import vecenv
from eval.policies import make_policy
from vecenv.contract import BatchEnv
from vecenv.libero import fixtures, goals
from vecenv.libero.env import LiberoEnv
from vecenv.libero.scene import compile_scene
from vecenv.libero.suites import BASE_SUITES, TaskSpec, list_tasks

EPISODES = 4
RANDOM_TICKS, POLICY_TICKS, EVERY = 40, 160, 8


def make(spec: TaskSpec) -> LiberoEnv:
    """Four episodes of a task, live."""
    env: BatchEnv = vecenv.make(spec.suite, task=spec.index, episodes=range(EPISODES))
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def rollout_states(spec: TaskSpec, kind: str) -> list[np.ndarray]:
    """qpos of every few ticks of a rollout, each [nq]."""
    env, rng = make(spec), np.random.default_rng(spec.index)
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


def compare(spec: TaskSpec) -> tuple[Counter[str], int, int]:
    """How many states of each kind, on how many both say yes, and on how many they differ."""
    import upstream
    from goal_states import GoalStates, Simulation

    from vecenv.libero import settled

    problem, rng = spec.problem(), np.random.default_rng(spec.index)
    scene = compile_scene(problem, contact_pairs=goals.contact_pairs([problem]))
    simulation, peer = Simulation(scene), upstream.peer_of(spec.bddl_path)
    bodies, pos, quat = fixtures.poses(problem, scene, "center", keys=[(0, spec.suite, spec.index, 0)], slots=[0])
    simulation.stand(list(bodies), pos[0], quat[0])
    upstream.set_fixtures(peer, bodies, pos[0], quat[0])
    nq = scene.model.nq
    stored = spec.init_states()[::5, 1 : 1 + nq]
    builder = GoalStates(problem, simulation, stored[0], rng)
    states: dict[str, list[np.ndarray]] = {
        "starts": [*stored, *settled.load(spec).qpos[::2]],
        "random": rollout_states(spec, "random"),
        "pick_place": rollout_states(spec, "pick_place"),
        "edges": [*builder.edges(), *builder.scattered(20)],
    }
    everything = [state for group in states.values() for state in group]
    table = goals.build_table([problem], scene, [0] * len(everything))
    ours = goals.evaluate(table, **simulation.reads(everything))
    theirs = []
    for state in everything:
        upstream.set_state(peer, state, np.zeros(scene.model.nv))
        theirs.append(upstream.verdict(peer, problem.goal))
    differ = ours != np.array(theirs)
    return Counter({kind: len(group) for kind, group in states.items()}), int((ours & ~differ).sum()), int(differ.sum())


def main() -> None:
    """Compare every task of the suites asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suites", nargs="*", default=list(BASE_SUITES))
    rows: list[dict[str, Any]] = []
    for suite in parser.parse_args().suites:
        counts: Counter[str] = Counter()
        solved = differ = 0
        for spec in track(list_tasks(suite), description=suite):
            found, yes, no = compare(spec)
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
    report(
        "verdicts",
        rows,
        title="states judged by both sides",
        notes={"states": sum(row["states"] for row in rows), "differ": sum(row["verdicts differ"] for row in rows)},
    )


if __name__ == "__main__":
    main()
