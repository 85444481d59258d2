"""Contact memory that was measured when a folder was exported is not measured again where the folder is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from vecenv.libero.contact_memory import export_budgets, measured_budget, sharing
from vecenv.libero.physics import budgets
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.scene import goals
from vecenv.libero.tasks.export import BUDGETS, ExportError, ExportFolder, export
from vecenv.libero.tasks.seal import write_seal

BUDGET = Budget(contacts=7, rows=21, pairs=3, candidates=5, share=4)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An export of one suite, whose scene "was measured"."""
    monkeypatch.setattr(budgets, "cached", lambda scene, starts: BUDGET)
    export(tmp_path / "out", ["libero_goal"])
    assert export_budgets(tmp_path / "out") == 1
    return tmp_path / "out"


def budget(folder: Path) -> Budget:
    tasks = ExportFolder(folder).tasks("libero_goal")
    scene = tasks[0].scene(goals.contact_pairs([tasks[0].problem()]))
    return measured_budget(scene, sharing(tasks, tasks[0].problem().scene_key()))


def never(*_: Any) -> Budget:
    raise AssertionError("measured")


def test_what_was_exported_is_not_measured_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budgets, "cached", never)
    assert budget(folder) == BUDGET
    assert export_budgets(folder) == 1  # nor when the folder is brought up to date
    (folder / BUDGETS).unlink()
    write_seal(folder)
    with pytest.raises(AssertionError, match="measured"):
        budget(folder)


@pytest.mark.parametrize("text", ["", "[]", '{"KEY": 3}', '{"KEY": {"contacts": 7}}', '{"KEY": {"contacts": -1}}'])
def test_damaged_budgets_are_named(folder: Path, text: str) -> None:
    (key,) = json.loads((folder / BUDGETS).read_text())
    numbers = '"rows": 1, "pairs": 1, "candidates": 1'
    (folder / BUDGETS).write_text(text.replace("KEY", key).replace("-1}", f"-1, {numbers}}}"))
    with pytest.raises(ExportError, match=r"budgets.json: damaged"):
        budget(folder)
    write_seal(folder)
    with pytest.raises(ExportError, match=r"budgets.json: damaged"):
        budget(folder)
