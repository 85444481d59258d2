"""SIMPLER's verdicts against upstream: success and its parts on recorded states of every family, tick by tick.

States come from two kinds of rollouts here: ``simpler_scripted``, which passes through grasps, carries and success, and
random actions. With ``--peer``, the Python of an environment with upstream SIMPLER (SAPIEN 2.2.2), every state is put
into upstream's environment, which judges it: joints, drives' set-points and objects are set, one physics step finds the
contacts, the state is set again. Upstream's counters run along, tick by tick. Without it only ours are counted. A row
is a task: ticks, how often each side says yes, and ticks on which they differ, in success and in each part.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import common
import numpy as np
from vecenv_eval.policies import make_policy

from vecenv import make
from vecenv.contract import Control
from vecenv.simpler.env import SimplerEnv
from vecenv.simpler.layouts import episode_seed
from vecenv.simpler.tasks import TASKS

CHOSEN = (
    "google_robot_pick_horizontal_coke_can",
    "google_robot_pick_standing_coke_can",
    "google_robot_pick_object",
    "google_robot_move_near_v0",
    "google_robot_move_near_v1",
    "google_robot_open_top_drawer",
    "google_robot_close_middle_drawer",
    "google_robot_place_apple_in_closed_top_drawer",
    "widowx_spoon_on_towel",
    "widowx_carrot_on_plate",
    "widowx_stack_cube",
    "widowx_put_eggplant_in_basket",
)
NAME = "simpler_verdicts"
RANDOM_TICKS = 40
PARTS = (
    "is_grasped",
    "consecutive_grasp",
    "lifted_object",
    "lifted_object_significantly",
    "all_obj_keep_height",
    "moved_correct_obj",
    "moved_wrong_obj",
    "near_tgt_obj",
    "is_closest_to_tgt",
    "is_src_obj_grasped",
    "src_on_target",
    "has_contact",
)

_PEER = """
import json, sys
import numpy as np, gymnasium as gym
import sapien.core as sapien
import mani_skill2_real2sim.envs, simpler_env
jobs = json.load(open(sys.argv[1]))
answers = []
for name, episodes in jobs.items():
    kind, options = simpler_env.ENVIRONMENT_MAP[name]
    env = gym.make(kind, obs_mode='none', prepackaged_config=True, **options)
    for episode in episodes:
        env.reset(seed=episode['seed'])
        u = env.unwrapped
        robot = u.agent.robot
        objects = list(u.episode_objs) if hasattr(u, 'episode_objs') else ([u.obj] if hasattr(u, 'obj') else [])
        names = [j.name for j in robot.get_active_joints()]
        order = [episode['joints'].index(n) for n in names]
        def put(state):
            robot.set_qpos(np.array(state['qpos'])[order]); robot.set_qvel(np.array(state['qvel'])[order])
            for joint, target in zip(robot.get_active_joints(), np.array(state['held'])[order]):
                joint.set_drive_target(target); joint.set_drive_velocity_target(0.0)
            robot.set_qf(robot.compute_passive_force(external=False))
            for thing, row in zip(objects, state['objects']):
                thing.set_pose(sapien.Pose(row[:3], row[3:7]))
                thing.set_velocity(row[7:10]); thing.set_angular_velocity(row[10:13])
            if hasattr(u, 'art_obj'):
                drawers = [j.name for j in u.art_obj.get_active_joints()]
                which = [['top', 'middle', 'bottom'].index(n.split('_')[0]) for n in drawers]
                u.art_obj.set_qpos(np.array(state['drawers'])[which])
                u.art_obj.set_qvel(np.array(state['drawer_speeds'])[which])
        put(episode['settled'])
        if hasattr(u, 'obj_height_after_settle') and objects:
            u.obj_height_after_settle = u.obj.pose.p[2]
        if hasattr(u, 'episode_objs'):
            u.episode_obj_xyzs_after_settle = [o.pose.p for o in objects]
            u.episode_source_obj_xyz_after_settle = u.episode_source_obj.pose.p
            u.episode_target_obj_xyz_after_settle = u.episode_target_obj.pose.p
        verdicts = []
        for tick, state in enumerate(episode['states'], 1):
            put(state); u._scene.step(); put(state)
            if hasattr(u, 'force_advance_subtask_time_steps') and tick - 1 >= u.force_advance_subtask_time_steps:
                u.advance_to_next_subtask()
            info = u.evaluate()
            flat = {**info, **info.get('episode_stats', {})} if 'has_contact' in info.get('episode_stats', {}) else info
            verdicts.append({k: float(v) for k, v in flat.items() if np.isscalar(v) and not isinstance(v, str)})
        answers.append(verdicts)
    env.close()
json.dump(answers, open(sys.argv[2], 'w'))
"""


def record(task: str, episodes: int, kind: str) -> list[dict[str, Any]]:
    """Rollouts of a task: settled state, states and verdicts after every tick."""
    env = make(TASKS[task].suite, task=task, episodes=range(episodes), num_threads=1)
    assert isinstance(env, SimplerEnv)
    info = env.reset()
    rollouts = [
        {"seed": episode_seed(slot), "joints": env.robot.joints, "settled": state(env, slot), "states": [], "ours": []}
        for slot in range(env.num_envs)
    ]
    seen = np.zeros(env.num_envs, int)

    def keep() -> None:
        steps = env.evaluate().num_steps
        for slot, rollout in enumerate(rollouts):
            if steps[slot] > seen[slot]:
                seen[slot] = steps[slot]
                verdict = env._verdicts[slot]
                rollout["states"].append(state(env, slot))
                rollout["ours"].append(
                    {"success": float(verdict.success), **{k: float(v) for k, v in verdict.parts.items()}}
                )

    if kind == "random":
        rng = np.random.default_rng(0)
        scale = np.array([0.03, 0.03, 0.03, 0.1, 0.1, 0.1, 1.0])
        for _ in range(RANDOM_TICKS):
            env.step_continuous(rng.uniform(-1, 1, (env.num_envs, 7)) * scale)
            keep()
    else:
        policy, done = make_policy("simpler_scripted"), np.zeros(env.num_envs, bool)
        policy.reset(env, info)
        # A watcher is called before every tick, so it sees the state after the one before.
        with env.watched(lambda actions, active: keep()):
            while not done.all():
                control = policy.act(env)
                assert isinstance(control, Control)
                done = control.done
        keep()
    env.close()
    return rollouts


def state(env: SimplerEnv, slot: int) -> dict[str, Any]:
    """Everything the peer needs to stand where a slot stands."""
    facts, count = env._facts[slot], len(env._episodes[slot].spec.objects)
    held = env._controller.memory()["held"][slot]
    loose = env._episodes[slot].roles.loose
    things = np.concatenate([facts["objects"][:count], facts["velocities"][:count]], axis=1)[list(loose)]
    return {
        "qpos": facts["qpos"].tolist(),
        "qvel": facts["qvel"].tolist(),
        "held": held.tolist(),
        "objects": things.tolist(),
        "drawers": facts["drawers"].tolist(),
        "drawer_speeds": facts["drawer_speeds"].tolist(),
    }


def ask(peer: str, jobs: dict[str, list[dict[str, Any]]]) -> list[list[dict[str, float]]]:
    """Upstream's verdicts on the states of every rollout."""
    with tempfile.TemporaryDirectory() as folder:
        question, answer = Path(folder) / "states.json", Path(folder) / "verdicts.json"
        question.write_text(json.dumps(jobs))
        subprocess.run([peer, "-c", _PEER, str(question), str(answer)], check=True, env=dict(os.environ))
        return json.loads(answer.read_text())


def compare(task: str, rollouts: list[dict[str, Any]], theirs: list[list[dict[str, float]]] | None) -> dict[str, Any]:
    """A row of the table."""
    mine = [verdict for rollout in rollouts for verdict in rollout["ours"]]
    row: dict[str, Any] = {"task": task, "ticks": len(mine), "ours_yes": int(sum(v["success"] for v in mine))}
    if theirs is None:
        return row
    other = [verdict for verdicts in theirs for verdict in verdicts]
    assert len(other) == len(mine), "one verdict a state"
    differ = Counter(
        name
        for a, b in zip(mine, other, strict=True)
        for name in ("success", *PARTS)
        if name in a and name in b and a[name] != b[name]
    )
    compared = sum(name in a and name in b for a, b in zip(mine, other, strict=True) for name in PARTS)
    return {
        **row,
        "upstream_yes": int(sum(v["success"] for v in other)),
        "success_differs": differ.pop("success", 0),
        "parts_compared": compared,
        "parts_differ": ", ".join(f"{name} {count}" for name, count in sorted(differ.items())),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", help="Python of an environment with upstream SIMPLER")
    parser.add_argument("--tasks", nargs="*", default=list(CHOSEN))
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--keep", action="store_true", help="keep earlier rows about other tasks")
    chosen = parser.parse_args()
    rows = kept(chosen.tasks) if chosen.keep else []
    for task in chosen.tasks:
        rollouts = [*record(task, chosen.episodes, "scripted"), *record(task, chosen.episodes, "random")]
        theirs = ask(chosen.peer, {task: rollouts}) if chosen.peer else None
        rows.append(compare(task, rollouts, theirs))
        common.report(NAME, rows, title="SIMPLER's verdicts on equal states")


def kept(tasks: list[str]) -> list[dict[str, Any]]:
    """Rows of an earlier run about other tasks."""
    path = common.RESULTS / f"{NAME}.json"
    rows = json.loads(path.read_text())["rows"] if path.is_file() else []
    return [row for row in rows if row["task"] not in tasks]


if __name__ == "__main__":
    main()
