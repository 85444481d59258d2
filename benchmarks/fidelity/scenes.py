"""Batches of one scene: which tasks share it, how it is made, and how it is run with given actions or a policy."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from vecenv_eval.policies.pick_place.policy import PickPlacePolicy

import vecenv
from fidelity.recordings import GRACE
from vecenv.libero.env import LiberoEnv
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import Task, installed_tasks


def tasks_of(suite: str, scenes: str | None) -> Sequence[Task]:
    """The tasks of a suite, installed or exported."""
    return installed_tasks(suite) if scenes is None else exported_tasks(scenes, suite)


def by_scene(tasks: Sequence[Task]) -> list[list[int]]:
    """Task indices, those of one scene together, in upstream's order."""
    sharing: dict[Hashable, list[int]] = {}
    for index, task in enumerate(tasks):
        sharing.setdefault(task.problem().scene_key(), []).append(index)
    return list(sharing.values())


def scene_name(suite: str, tasks: Sequence[int], names: Sequence[str]) -> str:
    """A short name: suite, first task, and the scene's name where the tasks' names have it."""
    found = re.match(r"[A-Z_]+_SCENE\d+", names[0])
    return f"{suite}/{tasks[0]}" + (f" {found[0].lower()}" if found else "")


def make(suite: str, **options: Any) -> LiberoEnv:
    """A live batch whose slots share a scene."""
    env = vecenv.make(suite, **options)
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def begin_again(env: LiberoEnv) -> None:
    """Every slot at its start."""
    env.set_episodes()
    env.reset()


def object_columns(scene: Scene) -> np.ndarray:
    """Columns of qpos with the positions of the movable objects, int [M, 3]."""
    first = [scene.model.joint(entity.joints[0]).qposadr[0] for entity in scene.objects]
    return np.array(first)[:, None] + np.arange(3)


class Ended(NamedTuple):
    """A batch after a run: positions of joints [B, nq] and objects [B, M, 3], ticks taken, verdicts, faults by slot."""

    qpos: np.ndarray
    objects: np.ndarray
    ticks: np.ndarray
    success: np.ndarray
    faults: Mapping[int, str]

    @property
    def healthy(self) -> np.ndarray:
        """Slots without a fault, bool [B]."""
        mask = np.ones(len(self.ticks), bool)
        mask[list(self.faults)] = False
        return mask


def ended(env: LiberoEnv, ticks: np.ndarray, success: np.ndarray) -> Ended:
    """The state of the batch now. Positions of objects are read from qpos, so no kinematics is needed."""
    (group,) = env.physics.groups
    qpos = np.array(group.qpos)
    return Ended(qpos, qpos[:, object_columns(group.scene)], ticks, success, dict(env.physics.faults))


def run(env: LiberoEnv, chunk: np.ndarray, limit: np.ndarray) -> Ended:
    """Give every slot its actions [B, K, 7], up to its own limit [B], in one call."""
    ran = env.physics.run(chunk, np.ones(env.num_envs, bool), limit)
    return ended(env, ran.ticks, ran.success)


def play(env: LiberoEnv) -> tuple[np.ndarray, Ended]:
    """Let `pick_place` act until all slots are finished or given up; actions [B, K, 7], rounded to 32 bits."""
    policy = PickPlacePolicy()
    policy.reset(env, env.reset())
    actions: list[np.ndarray] = []
    resting = 0
    while resting < GRACE:
        actions.append(np.clip(policy.act(env), -1, 1).astype(np.float32))
        control = env.step_continuous(actions[-1])
        idle = control.done.copy()
        idle[[slot for slot, _ in policy.unsupported]] = True
        resting = GRACE if control.done.all() else (resting + 1 if idle.all() else 0)
    return np.stack(actions, axis=1), ended(env, control.step_index, control.success)


def part(end: Ended, mask: np.ndarray) -> Ended:
    """Some of the slots, bool [B]."""
    chosen = np.flatnonzero(mask).tolist()
    faults = {chosen.index(slot): text for slot, text in end.faults.items() if slot in chosen}
    return Ended(end.qpos[mask], end.objects[mask], end.ticks[mask], end.success[mask], faults)
