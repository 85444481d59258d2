"""Trajectories against upstream: the same starts, fixture poses and actions, 60 control steps, all 32 scenes.

Both sides run under the installed MuJoCo from the stored start (no settling in advance). Actions are piecewise constant
at random, some without rotation, with gripper flips. A row is a task: the largest difference of joint positions before
the robot's first contact with anything and after it, of the 8-D proprioception, and whether all verdicts agreed.
Where contact amplifies rounding beyond 1e-3, a last column says how far upstream diverges from itself when one joint
starts 1e-15 rad away.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from common import report

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.suites import TaskSpec

TICKS = 60
SETTLE = 10
# Above this, upstream is run against itself from a start 1e-15 rad away, to tell chaos from error.
BOUND = 1e-3


def random_actions(seed: int, ticks: int) -> np.ndarray:
    """Settling ticks, then piecewise constant actions with gripper flips, [ticks, 7]."""
    rng = np.random.default_rng(seed)
    actions = [np.array([0, 0, 0, 0, 0, 0, -1.0])] * SETTLE
    while len(actions) < ticks:
        action = rng.uniform(-1, 1, 7)
        action[2] = rng.uniform(-1, 0.2)  # mostly down, so that the hand meets things
        action[3:6] *= rng.random() < 0.7
        action[6] = rng.choice([-1.0, 1.0])
        actions += [action] * int(rng.integers(1, 8))
    return np.array(actions[:ticks])


def robot_touches(model: Any, data: Any) -> bool:
    """Whether a geom of the robot's moving parts touches anything that is not the robot."""
    names = [model.body(model.geom_bodyid[g]).name for g in range(model.ngeom)]
    robot = np.array([name.startswith(("robot0", "gripper0")) for name in names])
    pairs = data.contact.geom[: data.ncon]
    return bool((robot[pairs[:, 0]] != robot[pairs[:, 1]]).any()) if len(pairs) else False


def compare(spec: TaskSpec, episode: int) -> dict[str, Any]:
    """One row."""
    import upstream

    peer = upstream.bare_peer(spec.bddl_path)
    peer.seed(episode)
    with upstream.silence():
        peer.reset()
    model, data = upstream.model_of(peer), upstream.data_of(peer)
    bodies = {name: model.body(fixture.root_body) for name, fixture in peer.env.fixtures_dict.items()}
    fixtures = {name: (body.pos.copy(), body.quat.copy()) for name, body in bodies.items()}
    peer.set_init_state(spec.init_states()[episode])
    env = vecenv.make(spec.suite, task=spec.index, episodes=[episode], fixtures=fixtures, start="raw", settle_steps=0)
    assert isinstance(env, LiberoEnv)
    env.reset()
    touched, first, before, after, state, agree = False, "never", 0.0, 0.0, 0.0, True
    for tick, action in enumerate(random_actions(episode, TICKS)):
        observation, _, done, _ = peer.step(action)
        control = env.step_continuous(action[None])
        difference = float(np.abs(env.state().qpos[0] - data.qpos).max())
        if not touched and robot_touches(model, data):
            touched, first = True, str(tick)
        before, after = (before, max(after, difference)) if touched else (max(before, difference), after)
        theirs = np.concatenate(
            [
                observation["robot0_eef_pos"],
                upstream.rotation_vector(observation["robot0_eef_quat"]),
                observation["robot0_gripper_qpos"],
            ]
        )
        state = max(state, float(np.abs(env.observe_egocentric().state[0] - theirs.astype(np.float32)).max()))
        agree &= bool(control.success[0]) == bool(done)
    env.close()
    return {
        "task": f"{spec.suite}/{spec.index}",
        "episode": episode,
        "first contact": first,
        "max |dq| before": before,
        "max |dq| after": after,
        "max |d state|": state,
        "verdicts agree": str(agree),
    }


def sensitivity(spec: TaskSpec, episode: int) -> float:
    """How far upstream strays from itself when one arm joint starts 1e-15 rad away: largest |dq| of seven tries."""
    exact = _upstream_states(spec, episode, np.zeros(7))
    return max(float(np.abs(_upstream_states(spec, episode, row) - exact).max()) for row in 1e-15 * np.eye(7))


def _upstream_states(spec: TaskSpec, episode: int, nudge: np.ndarray) -> np.ndarray:
    """Joint positions after each tick, [TICKS, nq], from a start whose arm is moved by ``nudge`` [7]."""
    import upstream

    peer = upstream.bare_peer(spec.bddl_path)
    peer.seed(episode)
    with upstream.silence():
        peer.reset()
    start = spec.init_states()[episode].copy()
    start[1:8] += nudge
    peer.set_init_state(start)
    rows = []
    for action in random_actions(episode, TICKS):
        peer.step(action)
        rows.append(upstream.data_of(peer).qpos.copy())
    return np.array(rows)


def main() -> None:
    """Compare one task of every scene, and two of those that several tasks share."""
    import upstream

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=32, help="how many scenes")
    scenes = list(upstream.scene_tasks().values())[: parser.parse_args().scenes]
    specs = [spec for tasks in scenes for spec in {tasks[0].name: tasks[0], tasks[-1].name: tasks[-1]}.values()]
    rows = []
    for number, spec in enumerate(specs):
        rows.append(compare(spec, episode=number % 50))
        rows[-1]["upstream nudged 1e-15"] = sensitivity(spec, number % 50) if rows[-1]["max |dq| after"] > BOUND else ""
        print(rows[-1], flush=True)
    report(
        "trajectories",
        rows,
        title=f"{len(rows)} tasks of {len(scenes)} scenes, {TICKS} control steps, against upstream",
        notes={
            "tasks": len(rows),
            "scenes": len(scenes),
            "worst before contact": max(row["max |dq| before"] for row in rows),
            "worst after contact": max(row["max |dq| after"] for row in rows),
            "worst state": max(row["max |d state|"] for row in rows),
        },
    )


if __name__ == "__main__":
    main()
