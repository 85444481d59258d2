"""Trajectories against upstream: the same starts, fixture poses and actions, 60 control steps, all 32 scenes.

Published contacts are held against upstream under MuJoCo 3.3.0 (`make upstream`), current ones against upstream under
the installed MuJoCo; both sides begin at the stored start, without settling in advance. Actions are piecewise constant
at random, some without rotation, with gripper flips. A row is a task: the largest difference of joint positions before
the robot's first contact with anything and after it, of the 8-D proprioception, and whether all verdicts agreed. Where
contact amplifies differences beyond 1e-3, two columns show how far upstream diverges from itself when one joint
starts 1e-15 rad away (the largest of seven tries), and when every action that is not zero is 1e-15 larger.

    make upstream && python benchmarks/trajectories.py
    python benchmarks/trajectories.py --contacts current
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
import peer
from common import report
from peer import Job, Rollout

import vecenv
from vecenv.libero.env import LiberoEnv

# Above this, upstream is run against itself from a start 1e-15 rad away, to tell chaos from error.
BOUND = 1e-3
NUDGE = 1e-15


def compare(job: Job, theirs: Rollout, contacts: str) -> dict[str, Any]:
    """One row."""
    poses = zip(theirs.fixtures.tolist(), theirs.fixture_pos, theirs.fixture_quat, strict=True)
    env = vecenv.make(
        job.suite,
        task=job.task,
        episodes=[job.episode],
        fixtures={name: (pos, quat) for name, pos, quat in poses},
        start="raw",
        settle_steps=0,
        contacts=contacts,
    )
    assert isinstance(env, LiberoEnv)
    env.reset()
    apart, state, agree, solved = np.zeros(len(theirs.qpos)), 0.0, True, False
    for tick, action in enumerate(theirs.actions):
        control = env.step_continuous(action[None])
        apart[tick] = np.abs(env.state().qpos[0] - theirs.qpos[tick]).max()
        seen = env.observe_egocentric().state[0]
        state = max(state, float(np.abs(seen - theirs.state[tick].astype(np.float32)).max()))
        agree &= solved or bool(control.success[0]) == bool(theirs.success[tick])
        solved |= bool(control.success[0])  # ours stands still from there on
    env.close()
    return {
        "task": f"{job.suite}/{job.task}",
        "episode": job.episode,
        "first contact": str(int(theirs.touched.argmax())) if theirs.touched.any() else "never",
        "max |dq| before": float(apart[~theirs.touched].max(initial=0)),
        "max |dq| after": float(apart[theirs.touched].max(initial=0)),
        "max |d state|": state,
        "verdicts agree": str(agree),
    }


def twins(job: Job, theirs: Rollout, python: str) -> tuple[float, float]:
    """How far upstream strays from itself: started 1e-15 rad away (largest of seven joints), acting 1e-15 apart."""
    nudged = [replace(job, joint=joint, start_nudge=NUDGE) for joint in range(7)]
    found = peer.rollouts([*nudged, replace(job, action_nudge=NUDGE)], python)
    apart = [float(np.abs(rollout.qpos - theirs.qpos).max()) for rollout in found]
    return max(apart[:7]), apart[7]


def main() -> None:
    """Compare one task of every scene, and two of those that several tasks share."""
    from support import upstream

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=32, help="how many scenes")
    peer.add_arguments(parser)
    options = parser.parse_args()
    python = peer.python_of(options)
    scenes = list(upstream.scene_tasks().values())[: options.scenes]
    specs = [spec for tasks in scenes for spec in {tasks[0].name: tasks[0], tasks[-1].name: tasks[-1]}.values()]
    jobs = [Job(suite=spec.suite, task=spec.index, episode=number % 50) for number, spec in enumerate(specs)]
    rows, version = [], ""
    for job, theirs in zip(jobs, peer.rollouts(jobs, python), strict=True):
        row, version = compare(job, theirs, options.contacts), str(theirs.mujoco)
        amplified = max(row["max |dq| before"], row["max |dq| after"]) > BOUND
        row["start nudged 1e-15"], row["actions nudged 1e-15"] = twins(job, theirs, python) if amplified else ("", "")
        rows.append(row)
        print(row, flush=True)
    before, after = (np.array([row[f"max |dq| {when}"] for row in rows]) for when in ("before", "after"))
    report(
        "trajectories" if options.contacts == "published" else "trajectories_current",
        rows,
        title=f"{len(rows)} tasks of {len(scenes)} scenes, {peer.TICKS} control steps, {options.contacts} contacts "
        f"against upstream under MuJoCo {version}",
        notes={
            "contacts": options.contacts,
            "peer": f"MuJoCo {version}",
            "tasks": len(rows),
            "scenes": len(scenes),
            "worst before contact": float(before.max()),
            "worst after contact": float(after.max()),
            "tasks above 1e-3": int((np.maximum(before, after) > BOUND).sum()),
            "worst state": max(row["max |d state|"] for row in rows),
        },
    )


if __name__ == "__main__":
    main()
