"""Start states of episodes: stored or settled init states with the fixture poses of the options.

In: a task, its compiled scene, the options of the batch and the episodes. Out: a
``vecenv.libero.physics.base.Start``, ready to be written into the physics.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vecenv.errors import InvalidInput
from vecenv.libero.config import EpisodeRules, LiberoConfig
from vecenv.libero.physics import settling
from vecenv.libero.physics.base import Start
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks import fixtures, settled
from vecenv.libero.tasks.sources import Task


class StoredStartsError(InvalidInput):
    """Stored starts that do not fit the compiled scene; the message says how they differ."""


def start_of(
    source: Task,
    scene: Scene,
    config: LiberoConfig,
    rules: EpisodeRules,
    episodes: np.ndarray,
    slots: np.ndarray,
    keys: Sequence[tuple[int, str, int, int]],
) -> Start:
    """Start states of n slots of one task.

    Args:
        source: the task.
        scene: its compiled scene.
        config: options; ``geometry`` and ``contacts`` are read.
        rules: how episodes begin; ``start``, ``fixtures`` and ``reset_loop`` are read.
        episodes: init state of each slot, int [n].
        slots: indices of the slots in the batch, int [n]; fixture poses given per slot are looked up by them.
        keys: (seed, suite, task, episode) of each slot, what sampled fixture poses depend on.

    Raises:
        StoredStartsError: the stored states do not fit the scene, or one is not finite.
        FixtureError, ResetError, SettlingError: the fixture poses cannot be had, or things do not come to rest.
    """
    problem = source.problem()
    qpos, qvel = stored(source, problem, settled=_ships_settled(rules))
    nq, nv = scene.model.nq, scene.model.nv
    if (qpos.shape[1], qvel.shape[1]) != (nq, nv):
        raise StoredStartsError(
            f"starts of {qpos.shape[1]} + {qvel.shape[1]} numbers, but the scene has {nq} positions and {nv} velocities"
        )
    bad = ~(np.isfinite(qpos[episodes]).all(axis=1) & np.isfinite(qvel[episodes]).all(axis=1))
    if bad.any():
        raise StoredStartsError(f"the start of episode {int(episodes[bad.argmax()])} is not finite")
    bodies, pos, quat = fixtures.poses(
        problem, scene, rules.fixtures, keys=keys, slots=slots.tolist(), loop=rules.reset_loop
    )
    shipped = _ships_settled(rules)
    start = Start(
        qpos=qpos[episodes],
        qvel=qvel[episodes],
        bodies=bodies,
        body_pos=pos,
        body_quat=quat,
        time=settled.TIME if shipped else 0.0,
        settled=shipped,
    )
    if shipped or rules.start == "raw":
        return start
    return settling.at_rest(_settling_scene(source, problem, scene, config), start)


def _ships_settled(rules: EpisodeRules) -> bool:
    """Whether settled starts come with the package: only with fixtures at the centres of their regions."""
    return rules.start == "settled" and rules.fixtures == "center"


def stored(source: Task, problem: Problem, *, settled: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions [50, nq] and velocities [50, nv] of a task's starts: settled ones, or the stored init states."""
    if settled:
        starts = source.settled()
        return starts.qpos, starts.qvel
    states, free_joints = source.init_states(), len(problem.objects)
    # Robot, hinges and slides have as many positions as velocities; a free joint has one position more.
    nq = (states.shape[1] - 1 + free_joints) // 2
    return states[:, 1 : 1 + nq], states[:, 1 + nq :]


def _settling_scene(source: Task, problem: Problem, scene: Scene, config: LiberoConfig) -> Scene:
    """The scene that starts settle in: upstream's geometry, published contacts."""
    if config.geometry == "exact" and config.contacts == "published":
        return scene
    return source.scene(goals.contact_pairs([problem]))
