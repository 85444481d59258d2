"""Contact memory that was measured when a folder was exported is not measured again where the folder is read."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vecenv
from vecenv.libero import contact_memory
from vecenv.libero.contact_memory import export_budgets, measured_budget, sharing
from vecenv.libero.physics import budgets
from vecenv.libero.physics.base import Start
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.native import NativePhysics
from vecenv.libero.scene import goals
from vecenv.libero.scene.scene import Scene
from vecenv.libero.starts import stored
from vecenv.libero.tasks import fixtures
from vecenv.libero.tasks.export import BUDGETS, ExportError, ExportFolder, export
from vecenv.libero.tasks.seal import write_seal
from vecenv.libero.tasks.sources import installed_tasks

BUDGET = Budget(contacts=7, rows=21, pairs=3, candidates=5, share=4)
RAW = Budget(contacts=9, rows=20, pairs=1, candidates=6, share=5)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An export of one suite, whose scene "was measured"."""
    monkeypatch.setattr(budgets, "cached", lambda scene, starts: BUDGET if starts.settled else RAW)
    export(tmp_path / "out", ["libero_goal"])
    assert export_budgets(tmp_path / "out") == 1
    return tmp_path / "out"


def budget(folder: Path, start: str = "settled") -> Budget:
    tasks = ExportFolder(folder).tasks("libero_goal")
    scene = tasks[0].scene(goals.contact_pairs([tasks[0].problem()]))
    return measured_budget(scene, sharing(tasks, tasks[0].problem().scene_key()), start)


def never(*_: Any) -> Budget:
    raise AssertionError("measured")


def test_what_was_exported_is_not_measured_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budgets, "cached", never)
    assert budget(folder) == BUDGET
    assert budget(folder, "raw") == Budget(contacts=9, rows=21, pairs=3, candidates=6, share=5)  # room for both
    assert export_budgets(folder) == 1  # nor when the folder is brought up to date
    (folder / BUDGETS).unlink()
    write_seal(folder)
    with pytest.raises(AssertionError, match="measured"):
        budget(folder)


@pytest.mark.parametrize("text", ["", "[]", '{"KEY": 3}', '{"KEY": {"contacts": 7}}', '{"KEY": {"contacts": -1}}'])
def test_damaged_budgets_are_named(folder: Path, text: str) -> None:
    found = json.loads((folder / BUDGETS).read_text())
    (key,) = (name for name, numbers in found.items() if numbers == asdict(BUDGET))
    numbers = '"rows": 1, "pairs": 1, "candidates": 1'
    (folder / BUDGETS).write_text(text.replace("KEY", key).replace("-1}", f"-1, {numbers}}}"))
    with pytest.raises(ExportError, match=r"budgets.json: damaged"):
        budget(folder)
    write_seal(folder)
    with pytest.raises(ExportError, match=r"budgets.json: damaged"):
        budget(folder)


def test_raw_starts_get_room_for_things_that_stand_in_the_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    """50 raw starts of libero_object task 1 have more contacts at once than was measured from settled ones."""
    settled = Budget(contacts=183, rows=750, pairs=503, candidates=179, share=161)

    def cached(scene: Scene, starts: Start) -> Budget:
        return settled if starts.settled else budgets.measure(scene, starts)

    monkeypatch.setattr(budgets, "cached", cached)
    task = installed_tasks("libero_object")[1]
    scene = task.scene(goals.contact_pairs([task.problem()]))
    contacts = contacts_of_raw_starts(scene, task)
    assert measured_budget(scene, [task]) == settled
    assert contacts.sum() > settled.warp_sizes(50)["naconmax"]
    raw = measured_budget(scene, [task], "raw")
    for slots in (1, 2, 50):
        assert 1.2 * contacts[:slots].sum() < raw.warp_sizes(slots)["naconmax"]


@pytest.mark.parametrize(("protocol", "start"), [("seed", "settled"), ("openpi", "raw")])
def test_an_environment_asks_for_memory_for_the_starts_of_its_protocol(
    protocol: str, start: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def ask(scene: Scene, tasks: Any, start: str) -> Budget:
        asked.append(start)
        raise LookupError("asked")

    monkeypatch.setattr(contact_memory, "measured_budget", ask)
    with pytest.raises(LookupError, match="asked"):
        vecenv.make("libero_object", task=1, episodes=[0], backend="warp", protocol=protocol)
    assert asked == [start]


def contacts_of_raw_starts(scene: Scene, task: Any) -> np.ndarray:
    """Contacts of each of the 50 raw starts before the first tick."""
    qpos, qvel = stored(task, task.problem(), settled=False)
    keys = [(0, "", 0, 0)] * 50
    bodies, pos, quat = fixtures.poses(task.problem(), scene, "center", keys=keys, slots=range(50))
    physics = NativePhysics([scene], np.zeros(50, int))
    found = physics.groups[0].bind("ncon")
    start = Start(qpos=qpos, qvel=qvel, bodies=bodies, body_pos=pos, body_quat=quat)
    physics.place(physics.groups[0], np.arange(50), start)
    contacts = found.copy()
    physics.close()
    return contacts


def test_memory_for_several_needs_is_the_largest_of_each() -> None:
    assert budgets.largest([BUDGET, RAW]) == Budget(contacts=9, rows=21, pairs=3, candidates=6, share=5)
    assert budgets.largest([BUDGET, Budget(contacts=1, rows=1, pairs=1, candidates=1)]).share is None
