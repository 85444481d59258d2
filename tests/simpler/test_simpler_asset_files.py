"""The tree of SIMPLER's assets: its manifest, where it is, and plain shapes in place of missing files."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.asset_server import CAN, FILES, write

from vecenv.assets import AssetsMissing
from vecenv.simpler.assets import files as assets
from vecenv.simpler.assets.files import read_manifest, resolve, visual_mesh
from vecenv.simpler.models import model_folder
from vecenv.simpler.tasks import TASKS

# The package's manifest


def test_the_manifest_lists_whatever_the_tasks_open() -> None:
    paths = set(read_manifest().by_path)
    for task in TASKS.values():
        files = [task.stage.mesh, task.station, task.models_path, *task.overlays]
        files += [task.robot.urdf_path(version) for version in task.robot.versions]
        models = {*task.models}.union(*task.triplets)
        files += [model_folder(model) / "collision.obj" for model in models]
        assert {file for file in files if file} <= paths
        for model in models:
            assert any(model_folder(model) / name in paths for name in ("textured.dae", "textured.glb"))


def test_files_without_a_hash_of_ours_all_have_stand_ins(tmp_path: Path) -> None:
    manifest = read_manifest()
    assert len(manifest.by_path) == len(manifest.files)
    unknown = [entry.path for entry in manifest.files if not entry.sha256]
    assert len(unknown) == 9
    for path in unknown:
        if path.name == "textured.dae":
            write(tmp_path, {str(path.parent / "collision.obj"): b""})
        assert str(path) in resolve(path, tmp_path).note


# Resolving


def test_a_file_that_is_there_has_no_stand_in(tmp_path: Path) -> None:
    write(tmp_path, FILES)
    found = resolve(CAN, tmp_path)
    assert (found.path, found.stand_in, found.note) == (tmp_path / CAN, None, "")


@pytest.mark.parametrize(
    ("stage", "top", "certainty"),
    [
        ("bridge_table_1_v1", 0.869532, "published"),
        ("bridge_table_1_v2", 0.869532, "unverified"),
        ("google_pick_coke_can_1_v4", 0.887532, "published"),
    ],
)
def test_a_missing_stage_becomes_a_table_of_its_height(stage: str, top: float, certainty: str, tmp_path: Path) -> None:
    stand_in = resolve(f"data/hab2_bench_assets/stages/{stage}.glb", tmp_path).stand_in
    assert stand_in is not None
    assert (stand_in.kind, stand_in.top) == ("table", top)
    assert f"{stage}.glb is missing" in stand_in.note
    assert certainty in stand_in.note


def test_a_missing_textured_mesh_is_replaced_by_the_collision_mesh(tmp_path: Path) -> None:
    write(tmp_path, {"data/custom/models/eggplant/collision.obj": b""})
    stand_in = visual_mesh("eggplant", tmp_path).stand_in
    assert stand_in is not None
    assert stand_in.mesh == tmp_path / "data/custom/models/eggplant/collision.obj"
    assert "eggplant/textured.dae is missing" in stand_in.note


def test_textured_meshes_are_looked_for_in_upstreams_order(tmp_path: Path) -> None:
    folder = "data/custom/models/can"
    for name in ("textured.glb", "textured.dae", "textured.obj"):
        write(tmp_path, {f"{folder}/{name}": b""})
        assert visual_mesh("can", tmp_path).path == tmp_path / folder / name


@pytest.mark.parametrize("name", ["data/real_inpainting/x.png", "data/hab2_bench_assets/stages/moon.glb", CAN])
def test_what_nothing_can_stand_in_for_is_missing(name: str, tmp_path: Path) -> None:
    with pytest.raises(AssetsMissing, match="vecenv assets pull simpler"):
        resolve(name, tmp_path)
    with pytest.raises(AssetsMissing):
        assets.collision_mesh("can", tmp_path)


def test_the_tree_is_where_the_variable_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(assets.VARIABLE, str(tmp_path / "tree"))
    with pytest.raises(AssetsMissing, match=r"tree.* is not a directory.*vecenv assets pull simpler"):
        assets.simpler_root()
    (tmp_path / "tree/data/custom").mkdir(parents=True)
    row = assets.asset_row()
    assert (row.ok, row.how_to_get.split(",")[0]) == (False, "vecenv assets pull simpler")
    assert "has no mani_skill2_real2sim/assets/descriptions" in row.problem
    (tmp_path / "tree/mani_skill2_real2sim/assets/descriptions").mkdir(parents=True)
    assert assets.simpler_root() == tmp_path / "tree"
    row = assets.asset_row()
    assert (row.ok, row.path, row.problem) == (True, tmp_path / "tree", "")
    assert any("bridge_table_1_v1.glb is missing" in note for note in assets.stand_ins())
