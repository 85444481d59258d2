"""How much contact memory MJX needs for a scene: measured once, remembered in the cache, or shipped with an export.

In: a scene and the tasks that share it. Out: a ``vecenv.libero.physics.budgets.Budget``. Measuring a scene takes half a
minute, a third of a cold start on a GPU; ``vecenv compile --budgets`` measures when a folder is written
(``export_budgets``), so that nodes which read the folder need not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from vecenv.libero import starts as start_states
from vecenv.libero.physics import budgets
from vecenv.libero.physics.base import Start
from vecenv.libero.physics.budgets import Budget, BudgetError
from vecenv.libero.scene.bddl import SceneKey
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks import fixtures
from vecenv.libero.tasks.export import ExportedTask, ExportFolder, Track, untracked, write_budgets
from vecenv.libero.tasks.sources import Task
from vecenv.libero.tasks.suites import NUM_EPISODES

# Starts of a scene on which its memory on MJX is measured.
BUDGET_STARTS = 64
# Which starts are measured, by how episodes begin.
_NEEDED = {"settled": ("settled",), "raw": ("settled", "raw")}
_KINDS = ("settled", "raw")


def sharing(sources: Sequence[Task], key: SceneKey) -> list[Task]:
    """The tasks whose scene has this key."""
    return [task for task in sources if task.problem().scene_key() == key]


def measured_budget(scene: Scene, tasks: Sequence[Task], start: str = "settled") -> Budget:
    """Contact and constraint memory on MJX, measured on starts of all the tasks that share a scene.

    Args:
        scene: the scene.
        tasks: the tasks.
        start: how episodes begin, as in ``LiberoConfig``. From ``"raw"`` starts things settle first, then an episode
            goes on as from ``"settled"`` ones: it gets room for both.

    Raises:
        ExportError: the tasks come from an exported folder whose budgets are damaged.
    """
    return budgets.largest([_known(scene, tasks, _starts(scene, tasks, begun)) for begun in _NEEDED[start]])


def _known(scene: Scene, tasks: Sequence[Task], starts: Start) -> Budget:
    """What was measured of these starts: shipped with the tasks, remembered, or measured now."""
    first = tasks[0]
    if isinstance(first, ExportedTask):
        shipped = first.folder.budgets().get(budgets.key_of(scene, starts))
        if shipped is not None:
            try:
                return Budget(**shipped)  # pyright: ignore[reportArgumentType]  # checked there
            except (TypeError, BudgetError) as error:
                raise first.folder.budgets_damaged() from error
    return budgets.cached(scene, starts)


def export_budgets(out: str | Path, suites: Sequence[str] | None = None, *, track: Track = untracked) -> int:
    """Measure scenes of an exported folder and write their budgets into it, for any start; returns how many scenes.

    Args:
        out: the folder, which ``vecenv.libero.tasks.export.export`` wrote.
        suites: which of its suites; all by default.
        track: called with a list of what is to be done and a word for it, returns it to iterate over.

    Raises:
        ExportError: there is no such folder, or something in it is damaged.
        OSError: the folder cannot be written.
    """
    folder = ExportFolder(out)
    # Scenes of the same id may be shared by other tasks in another suite, and their starts differ.
    wanted: dict[tuple[str, str], list[ExportedTask]] = {}
    for suite in folder.suites if suites is None else suites:
        for task in folder.tasks(suite):
            for scene_id in task.scene_ids.values():
                wanted.setdefault((suite, scene_id), []).append(task)
    found = dict(folder.budgets())
    for (_, scene_id), tasks in track(list(wanted.items()), "contact memory"):
        scene = folder.scene(scene_id)
        for begun in _KINDS:
            starts = _starts(scene, tasks, begun)
            key = budgets.key_of(scene, starts)
            if key not in found:
                found[key] = asdict(budgets.cached(scene, starts))
    write_budgets(folder.path, found)
    return len(wanted)


def _starts(scene: Scene, tasks: Sequence[Task], begun: str) -> Start:
    """Settled or raw starts of all the tasks, fixtures at the centres of their regions."""
    each = -(-BUDGET_STARTS // len(tasks))
    episodes = np.linspace(0, NUM_EPISODES - 1, min(each, NUM_EPISODES)).astype(int)
    return _joined([_central_start(task, scene, episodes, begun) for task in tasks])


def _central_start(task: Task, scene: Scene, episodes: np.ndarray, begun: str) -> Start:
    """Settled or raw starts of a task, fixtures at the centres of their regions."""
    problem = task.problem()
    qpos, qvel = start_states.stored(task, problem, settled=begun == "settled")
    bodies, pos, quat = fixtures.poses(
        problem, scene, "center", keys=[(0, "", 0, 0)] * len(episodes), slots=range(len(episodes))
    )
    return Start(
        qpos=qpos[episodes],
        qvel=qvel[episodes],
        bodies=bodies,
        body_pos=pos,
        body_quat=quat,
        settled=begun == "settled",
    )


def _joined(starts: Sequence[Start]) -> Start:
    """Starts of one scene and one kind, one after the other."""

    def join(name: str) -> np.ndarray:
        return np.concatenate([getattr(start, name) for start in starts])

    return Start(
        qpos=join("qpos"),
        qvel=join("qvel"),
        bodies=starts[0].bodies,
        body_pos=join("body_pos"),
        body_quat=join("body_quat"),
        settled=starts[0].settled,
    )
