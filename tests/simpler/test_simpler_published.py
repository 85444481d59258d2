"""SIMPLER's published lists: as many episodes as upstream's scripts run, the same ones, beginning where upstream's do.

``simpler_published_upstream.json`` was written by ``scripts/simpler_published_upstream.py``: upstream's own parser and
loop over its own scripts (a hash of every list and three rows of it), and resets of a sample on SAPIEN 2.2.2.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support import simpler_assets_small
from support.paths import DATA as RECORDED
from typer.testing import CliRunner

from vecenv.assets import AssetsMissing
from vecenv.placement import PlacementError
from vecenv.simpler.assets.files import VARIANTS_MANIFEST, how_to_get, read_manifest
from vecenv.simpler.cli import assets_app
from vecenv.simpler.layouts import LayoutError, episode_layout, episode_seed, lay_out
from vecenv.simpler.models import model_folder
from vecenv.simpler.published import lists as published
from vecenv.simpler.published.lists import (
    PROTOCOLS,
    EpisodeSpec,
    PublishedError,
    episodes,
    num_episodes,
    place,
    scene_of,
)
from vecenv.simpler.published.metadata import eval_metadata
from vecenv.simpler.task_spec import BRIDGE, DATA, GOOGLE
from vecenv.simpler.tasks import TASKS, UnknownTask

if TYPE_CHECKING:
    from vecenv.simpler.env import SimplerEnv

UPSTREAM: dict[str, Any] = json.loads((RECORDED / "simpler_published_upstream.json").read_text())
STARTS: list[dict[str, Any]] = UPSTREAM["starts"]
MATCHING, AGGREGATION, SEED = PROTOCOLS
COKE, NEAR, OPEN = "google_robot_pick_coke_can", "google_robot_move_near", "google_robot_open_drawer"
APPLE, CARROT = "google_robot_place_apple_in_closed_top_drawer", "widowx_carrot_on_plate"
OBJECT, CLOSED = "google_robot_pick_object", "google_robot_place_in_closed_drawer"
# Visual matching, variant aggregation.
COUNTS = {
    **{name: (24, 0) for name in TASKS if name.startswith("widowx")},
    COKE: (300, 825),
    **{f"google_robot_pick_{lies}_coke_can": (100, 275) for lies in ("horizontal", "vertical", "standing")},
    OBJECT: (10, 0),
    **{f"{NEAR}{version}": (240, 600) for version in ("", "_v0", "_v1")},
    **{f"google_robot_{verb}_drawer": (108, 189) for verb in ("open", "close")},
    **{f"google_robot_{verb}_{d}_drawer": (36, 63) for verb in ("open", "close") for d in ("top", "middle", "bottom")},
    **{f"google_robot_place_in_closed_{d}drawer": (10, 0) for d in ("", "top_", "middle_", "bottom_")},
    APPLE: (108, 189),
}


def rounded(values: Sequence[float]) -> list[float]:
    return [round(float(value), 6) + 0.0 for value in values]


def signed(quat: Sequence[float]) -> list[float]:
    """Of a quaternion and its negative, the one that begins positive."""
    values = rounded(quat)
    leading = next((value for value in values if value), 1)
    return [(-value if leading < 0 else value) + 0.0 for value in values]


def row(spec: EpisodeSpec) -> list[Any]:
    """An episode as the file of upstream's has it."""
    return [
        spec.environment,
        spec.robot,
        spec.scene,
        rounded(spec.robot_xy),
        signed(spec.robot_quat),
        None if spec.object_xy is None else rounded(spec.object_xy),
        spec.episode_id,
        spec.control_hz,
        spec.sim_hz,
        spec.max_steps,
        spec.control_mode,
        spec.overlay.name if spec.overlay else "",
        [[name, str(value)] for name, value in spec.build_kwargs],
    ]


# -- lists -----------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_there_are_as_many_episodes_as_upstream_runs(task: str) -> None:
    assert (num_episodes(MATCHING, task), num_episodes(AGGREGATION, task)) == COUNTS[task]
    assert num_episodes(SEED, task) == len(episodes(SEED, task)) == 50


@pytest.mark.parametrize("name", UPSTREAM["lists"])
def test_a_list_is_the_one_that_upstreams_scripts_run_row_by_row(name: str) -> None:
    protocol, task = name.split("/")
    ours, theirs = [row(spec) for spec in episodes(protocol, task)], UPSTREAM["lists"][name]
    assert len(ours) == theirs["count"]
    for index, expected in theirs["rows"].items():
        assert ours[int(index)] == expected
    assert hashlib.sha256(json.dumps(ours).encode()).hexdigest() == theirs["digest"]


def test_every_sweep_was_compared() -> None:
    compared = {tuple(name.split("/")) for name in UPSTREAM["lists"]}
    alike = {f"{NEAR}_v1", NEAR}
    swept = {(p, task) for task, counts in COUNTS.items() for p, n in zip(PROTOCOLS, counts, strict=False) if n > 10}
    assert {(protocol, task) for protocol, task in swept if task not in alike} == compared


@pytest.mark.parametrize("version", ["", "_v1"])
def test_move_nears_other_versions_differ_in_their_environment_only(version: str) -> None:
    for one, other in zip(episodes(MATCHING, f"{NEAR}_v0"), episodes(MATCHING, NEAR + version), strict=True):
        changes = {"task": NEAR + version, "environment": "MoveNearGoogleBakedTexInScene-v1"}
        assert replace(one, **changes) == other
    assert [row(spec) for spec in episodes(AGGREGATION, f"{NEAR}_v0")] == [
        row(spec) for spec in episodes(AGGREGATION, NEAR + version)
    ]


def test_rows_are_numbered_and_name_their_task_and_script() -> None:
    for task in TASKS:
        for protocol in PROTOCOLS:
            for index, spec in enumerate(episodes(protocol, task) if num_episodes(protocol, task) else ()):
                assert (spec.index, spec.task, spec.protocol) == (index, task, protocol)
                assert spec.source.endswith((".sh", ".py"))


def test_a_can_of_visual_matching_in_full() -> None:
    spec = episodes(MATCHING, COKE)[3 * 25 + 25 + 7]
    assert (spec.robot, spec.robot_xy, spec.robot_quat) == ("google_robot_static", (0.35, 0.2), (0.0, 0.0, 0.0, 1.0))
    assert spec.object_xy == pytest.approx((-0.2925, 0.2))
    assert (spec.orientation, spec.urdf_version) == ("upright", "recolor_tabletop_visual_matching_1")
    assert (spec.scene, spec.model, spec.station, spec.drawer) == (
        "google_pick_coke_can_1_v4",
        "opened_coke_can",
        "",
        "",
    )
    assert str(spec.overlay) == "data/real_inpainting/google_coke_can_real_eval_1.png"
    assert (spec.max_steps, spec.control_hz, spec.sim_hz, spec.setting, spec.averaged) == (80, 3, 513, "base", True)
    assert spec.build_kwargs == (("upright", True), ("urdf_version", "recolor_tabletop_visual_matching_1"))


def test_a_drawer_of_variant_aggregation_in_full() -> None:
    spec = episodes(AGGREGATION, "google_robot_close_middle_drawer")[5 * 9 + 2]
    assert spec.environment == "CloseMiddleDrawerCustomInScene-v0"
    assert (spec.setting, spec.station, spec.lighting, spec.drawer) == ("cabinet", "mk_station2", "room", "middle")
    assert spec.robot_xy == pytest.approx((0.65, 0.2))
    assert (spec.scene, spec.overlay, spec.urdf_version) == ("frl_apartment_stage_simple", None, "")
    assert spec.build_kwargs == (("shader_dir", "rt"), ("station_name", "mk_station2"))


def test_upstreams_average_leaves_out_turned_cameras() -> None:
    counted = {task: sum(spec.averaged for spec in episodes(AGGREGATION, task)) for task in (COKE, NEAR, OPEN, APPLE)}
    assert counted == {COKE: 675, NEAR: 480, OPEN: 189, APPLE: 189}
    assert {spec.setting for spec in episodes(AGGREGATION, COKE) if not spec.averaged} == {"camera"}


def test_every_listed_episode_has_a_scene_of_its_own_kind() -> None:
    for protocol in (MATCHING, AGGREGATION):
        for name, counts in COUNTS.items():
            for spec in episodes(protocol, name) if counts[PROTOCOLS.index(protocol)] else ():
                task, layout = scene_of(spec)
                assert task.max_steps == spec.max_steps
                assert (task.station.stem if task.station else "") == spec.station
                assert (task.stage.name or "dummy_drawer") == spec.scene
                assert layout.overlay == spec.overlay
                assert {placed.model for placed in layout.with_role("source")} <= {
                    spec.model,
                    *task.models,
                    *sum(task.triplets, ()),
                }
                assert len(layout.with_role("distractor")) == {"less": 4, "more": 6}.get(spec.distractors, 0)


def test_seeds_are_a_protocol_too() -> None:
    for name, task in TASKS.items():
        for episode in (0, 17, 49):
            spec = episodes(SEED, name)[episode]
            assert scene_of(spec) == (task, episode_layout(task, episode_seed(episode)))
            assert spec.seed == 2022 + episode


@pytest.mark.parametrize(
    ("protocol", "task", "error", "says"),
    [
        ("openvla", COKE, PublishedError, "protocol='openvla' is not available; available: visual-matching, variant-"),
        (None, COKE, PublishedError, "available: visual-matching"),
        (MATCHING, "pick_coke", UnknownTask, "did you mean"),
        (AGGREGATION, CARROT, PublishedError, f"no episodes of {CARROT}; it has some of {COKE}, "),
        (AGGREGATION, OBJECT, PublishedError, f"no episodes of {OBJECT}"),
    ],
)
def test_what_upstream_does_not_run_is_refused(protocol: Any, task: str, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        episodes(protocol, task)


def test_choices_that_a_task_does_not_have_are_refused() -> None:
    def changed(task: str, **changes: Any) -> None:
        lay_out(TASKS[task], replace(episodes(MATCHING, task)[0], **changes))

    for task, changes, says in (
        (CARROT, {"episode_id": 24}, "no arrangement 24; there are 24"),
        (NEAR, {"episode_id": None}, "no arrangement None; there are 60"),
        (OPEN, {"drawer": "left"}, "drawer='left': expected one of top, middle, bottom"),
        (COKE, {"orientation": "askew"}, "orientation='askew': expected one of upright"),
        (COKE, {"object_xy": None}, "needs an object and its place"),
    ):
        with pytest.raises(LayoutError, match=says):
            changed(task, **changes)


# -- where episodes begin --------------------------------------------------


def started(protocol: str, task: str) -> list[dict[str, Any]]:
    return [start for start in STARTS if (start["protocol"], start["task"]) == (protocol, task)]


SAMPLED = sorted({(start["protocol"], start["task"]) for start in STARTS})


def test_the_sample_has_every_family() -> None:
    tasks = {task for _, task in SAMPLED}
    assert tasks >= {name for name, counts in COUNTS.items() if counts[0] == 24} | {COKE, OPEN, APPLE, OBJECT, CLOSED}
    settings = {
        (start["task"], episodes(AGGREGATION, start["task"])[start["index"]].setting)
        for start in STARTS
        if start["protocol"] == AGGREGATION
    }
    assert {setting for task, setting in settings if task == COKE} == {"base", "distractors", "lighting", "camera"}
    assert {setting for task, setting in settings if task == APPLE} == {"base", "background", "lighting", "cabinet"}


@pytest.mark.parametrize(("protocol", "task"), SAMPLED)
def test_robot_and_objects_are_put_where_upstream_puts_them(protocol: str, task: str) -> None:
    for start in started(protocol, task):
        _, layout = scene_of(episodes(protocol, task)[start["index"]])
        np.testing.assert_allclose([*layout.base_position, *signed(layout.base_quat)], start["base"], atol=2e-6)
        np.testing.assert_allclose(layout.qpos, start["qpos"], atol=2e-6)
        assert layout.instruction == start["instruction"]
        assert {placed.model for placed in layout.objects} == set(start["objects"])
        for placed in layout.objects:
            dropped = start["dropped"][placed.model] or start["objects"][placed.model]
            np.testing.assert_allclose([*placed.position, *signed(placed.quat)], dropped, atol=3e-6)
        if start["drawers"]:
            opened = [layout.drawer_qpos if name == layout.drawer else 0.0 for name in ("top", "middle", "bottom")]
            np.testing.assert_allclose(opened, start["drawers"], atol=2e-6)


def test_ten_resets_in_a_row_are_the_list_of_what_is_not_swept() -> None:
    """The model, the drawer and the robot's place of every reset."""
    assert [start["index"] for start in started(MATCHING, OBJECT)] == list(range(10))
    assert {len(start["objects"]) for start in started(MATCHING, OBJECT)} == {1}
    assert len({next(iter(start["objects"])) for start in started(MATCHING, OBJECT)}) > 4


# -- files -----------------------------------------------------------------


def test_whatever_only_variant_aggregation_opens_can_be_pulled() -> None:
    wanted = {stage for task, counts in COUNTS.items() if counts[1] for stage in stages(AGGREGATION, task)}
    usual = read_manifest().by_path
    assert wanted - set(usual) == {
        path for path in read_manifest(VARIANTS_MANIFEST).by_path if path.parent.name == "stages"
    }
    assert stages(MATCHING, COKE) | stages(MATCHING, CARROT) <= set(usual)
    known = {*usual, *read_manifest(VARIANTS_MANIFEST).by_path}
    for spec in (*episodes(AGGREGATION, COKE), *episodes(AGGREGATION, NEAR), *episodes(AGGREGATION, APPLE)):
        for placed in scene_of(spec)[1].objects:
            meshes = {model_folder(placed.model) / f"textured.{kind}" for kind in ("obj", "dae", "glb")}
            assert meshes & known, placed.model
    for spec in episodes(AGGREGATION, OPEN):
        assert DATA / f"custom/{spec.station}.urdf" in usual
    assert how_to_get(DATA / "custom/models/stone_tabletop.glb") == "vecenv assets pull simpler-variants"


def stages(protocol: str, task: str) -> set[PurePosixPath]:
    meshes = (scene_of(spec)[0].stage.mesh for spec in episodes(protocol, task))
    return {mesh for mesh in meshes if mesh is not None}


def test_the_command_pulls_variants_alone(tmp_path: Path) -> None:
    stone = "data/custom/models/stone_tabletop.glb"
    (tmp_path / "from" / stone).parent.mkdir(parents=True)
    (tmp_path / "from" / stone).write_bytes(b"not the stone")
    command = ["pull", "simpler-variants", "--from", str(tmp_path / "from"), "--to", str(tmp_path / "to")]
    done = CliRunner().invoke(assets_app, command)
    assert done.exit_code == 1
    assert f"0 files fetched, 0 were there, {len(read_manifest(VARIANTS_MANIFEST).files)} missing" in done.output
    assert f"missing: {stone}" in done.output


# -- environments ----------------------------------------------------------


def made(root: Path, protocol: str, task: Any, rows: Any, **options: Any) -> SimplerEnv:
    pytest.importorskip("sapien")
    from vecenv import make
    from vecenv.simpler import env as simpler_env

    tasks = [task] if isinstance(task, str) else task
    suite = TASKS[tasks[0]].suite
    env = make(suite, tasks=tasks, protocol=protocol, episodes=rows, assets=root, num_threads=1, **options)
    assert isinstance(env, simpler_env.SimplerEnv)
    return env


def batch(root: Path, protocol: str, task: str, rows: Sequence[int]) -> SimplerEnv:
    env = made(root, protocol, task, rows)
    env.reset()
    return env


def test_metadata_counts_the_episodes_of_a_protocol() -> None:
    assert eval_metadata(BRIDGE, MATCHING)["episodes_per_task"] == (24,) * 4
    assert eval_metadata(GOOGLE, AGGREGATION)["num_episodes"] == sum(counts[1] for counts in COUNTS.values())
    assert eval_metadata(GOOGLE)["episodes_per_task"] == 50
    with pytest.raises(PublishedError, match="'variant-aggregation' has no episodes of simpler/bridge"):
        eval_metadata(BRIDGE, AGGREGATION)


@pytest.mark.parametrize(("protocol", "task"), SAMPLED)
def test_robots_and_drawers_begin_in_upstreams_state(small: Path, protocol: str, task: str) -> None:
    """On generated assets, so objects are left out."""
    starts = started(protocol, task)
    env = batch(small, protocol, task, [start["index"] for start in starts])
    info = env.reset()
    assert info.instruction == tuple(start["instruction"] for start in starts)
    assert info.max_steps.tolist() == [TASKS[task].max_steps] * len(starts)
    state = env.observe_egocentric().state
    dof = (state.shape[1] - 7) // 2
    np.testing.assert_allclose(state[:, :dof], [start["qpos"] for start in starts], atol=3e-6)
    np.testing.assert_allclose(state[:, -7:-4], [start["base"][:3] for start in starts], atol=3e-6)
    turned = [signed(quat) for quat in state[:, -4:].astype(float)]
    np.testing.assert_allclose(turned, [start["base"][3:] for start in starts], atol=3e-6)
    drawers = np.array([start["drawers"] for start in starts])
    np.testing.assert_allclose(env.state().qpos[:, dof : dof + drawers.shape[1]], drawers, atol=3e-6)
    env.close()


def test_a_batch_mixes_settings_and_repeats_each_as_if_it_were_alone(small: Path) -> None:
    kinds = {spec.setting: spec.index for spec in episodes(AGGREGATION, COKE)}
    rows = [kinds[kind] for kind in ("base", "distractors", "lighting", "camera")]
    env = batch(small, AGGREGATION, COKE, rows)
    assert env.step_continuous(np.zeros((len(rows), 2, 7))).info["fault"] == ("",) * len(rows)
    together, counts = env.state().qpos.copy(), env.state().nq
    assert counts[1] > counts[0] == counts[2], "distractors are in their own slot only"
    assert together[3, 10] != together[0, 10], "the head is tilted in its own slot only"
    assert [spec.setting for spec in env.specs] == ["base", "distractors", "lighting", "camera"]
    env.close()
    for slot, index in enumerate(rows):
        env = batch(small, AGGREGATION, COKE, [index])
        env.step_continuous(np.zeros((1, 2, 7)))
        np.testing.assert_array_equal(env.state().qpos[0], together[slot, : counts[slot]])
        env.close()


def test_episodes_are_chosen_from_the_list_and_no_further(small: Path) -> None:
    env = made(small, MATCHING, CARROT, None)
    assert env.reset().episode_id == tuple(f"{BRIDGE}/{CARROT}/{episode}" for episode in range(24))
    with pytest.raises(PlacementError, match="episode 24 does not exist; there are 24"):
        env.set_episodes(episodes=24)
    env.close()
    with pytest.raises(PlacementError, match="episode 10 does not exist; there are 10"):
        made(small, MATCHING, [COKE, OBJECT], [10])
    with pytest.raises(PublishedError, match=f"no episodes of {OBJECT}"):
        made(small, AGGREGATION, OBJECT, [0])
    with pytest.raises(PublishedError, match="available: visual-matching, variant-aggregation, seed"):
        made(small, "published", COKE, [0])
    with pytest.raises(ValueError, match="protocol 'visual-matching' already decides the variants"):
        made(small, MATCHING, COKE, [0], variant={"camera": "lower"})


def test_tasks_of_a_batch_have_as_many_episodes_as_their_lists(small: Path) -> None:
    env = made(small, MATCHING, [CARROT, "widowx_stack_cube"], {1: [3], 2: range(2)})
    assert env.placement.task.tolist() == [1, 2, 2]
    assert env.placement.episode.tolist() == [3, 0, 1]
    env.close()
    placement = place(MATCHING, GOOGLE, None, None)
    assert len(placement) == sum(counts[0] for task, counts in COUNTS.items() if not task.startswith("widowx"))
    with pytest.raises(PlacementError, match="5 is none of the tasks"):
        place(MATCHING, GOOGLE, [0, 1], {5: [0]})


def test_a_table_that_is_not_there_is_named(small: Path) -> None:
    named = {}
    for spec in episodes(AGGREGATION, COKE):
        if spec.setting in ("table", "background") and spec.scene not in named:
            with pytest.raises(AssetsMissing, match=rf"stages/{spec.scene}\.glb"):
                made(small, AGGREGATION, COKE, [spec.index])
            named[spec.scene] = spec.index
    assert len(named) == 4


def test_a_room_that_is_not_there_is_named_by_its_images_and_physics_runs(small: Path) -> None:
    env = batch(small, AGGREGATION, "google_robot_open_top_drawer", [0, 62])
    assert env.step_continuous(np.zeros((2, 7))).info["fault"] == ("", "")
    seen = env.observe_egocentric()
    with pytest.raises(AssetsMissing, match=r"stages/frl_apartment_stage_simple\.glb, the room around the cabinet"):
        _ = seen.rgb
    env.close()


# Millimetres. Oranges still roll when settling ends; in four of the sink's 24 layouts the eggplant slides elsewhere.
FAR = {"orange": 70.0, "eggplant": 60.0, "dummy_sink_target_plane": 6.0}
NEARBY, ON_THE_TABLE = {"put_on": 0.2}, 2.5


@pytest.mark.parametrize(("protocol", "task"), SAMPLED)
def test_objects_come_to_rest_where_upstreams_do(original: Path, protocol: str, task: str) -> None:
    """Distractors are left out: they fall on each other, and upstream's own go elsewhere when a can lies 1 um off."""
    starts = started(protocol, task)
    env = batch(original, protocol, task, [start["index"] for start in starts])
    for start, snapshot, spec in zip(starts, env.observe_objects().snapshot, env.specs, strict=True):
        assert snapshot is not None
        crowded = spec.distractors in ("less", "more")
        for name in [spec.model] if crowded else start["objects"]:
            away = 1e3 * np.linalg.norm(snapshot.poses[name][:3] - start["objects"][name][:3])
            allowed = 5.0 if crowded else FAR.get(name, NEARBY.get(TASKS[task].family, ON_THE_TABLE))
            assert away < allowed, (spec.index, name, away)
    env.close()


@pytest.mark.heavy  # a CPU compiles shaders for a quarter of a minute
def test_images_of_variant_aggregation_show_the_rendered_scene_and_its_light(small: Path) -> None:
    """Beside them, visual matching's show the photograph."""
    pytest.importorskip("sapien")
    from vecenv.simpler import overlay

    try:
        overlay.check_renderer()
    except overlay.RendererMissing:
        pytest.skip("no Vulkan driver")
    lit = {spec.lighting: spec.index for spec in episodes(AGGREGATION, COKE) if spec.setting in ("base", "lighting")}
    seen = {}
    for protocol, rows in ((AGGREGATION, [lit[light] for light in ("darker", "", "brighter")]), (MATCHING, [0])):
        env = batch(small, protocol, COKE, rows)
        observed = env.observe_egocentric()
        seen[protocol] = [rgb[shown == 0] for rgb, shown in zip(observed.rgb, observed.segmentation, strict=True)]
        env.close()
    darker, usual, brighter = (float(pixels.mean()) for pixels in seen[AGGREGATION])
    assert darker < usual < brighter
    assert (seen[MATCHING][0] == (90, 120, 150)).all(), "the generated photograph has one colour"
    assert not (seen[AGGREGATION][1] == (90, 120, 150)).all()


@pytest.mark.heavy
def test_a_room_is_seen_around_its_cabinet_and_not_touched(tmp_path: Path) -> None:
    pytest.importorskip("sapien")
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    from vecenv.simpler import overlay

    try:
        overlay.check_renderer()
    except overlay.RendererMissing:
        pytest.skip("no Vulkan driver")
    root = simpler_assets_small.build(tmp_path)
    # A green slab that fills the place of robot and cabinet: nothing could move if it had collision shapes.
    slab = trimesh.creation.box((20.0, 2.0, 20.0))
    slab.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[0, 200, 0, 255]))
    mesh = published.ROOMS["frl_apartment_stage_simple"].mesh
    assert mesh is not None
    (root / mesh).parent.mkdir(parents=True)
    slab.export(root / mesh)
    env = batch(root, AGGREGATION, "google_robot_close_top_drawer", [4])
    before = env.state().qpos
    seen = env.observe_egocentric()
    red, green, _ = (float(seen.rgb[0][seen.segmentation[0] == 0][:, channel].mean()) for channel in range(3))
    assert green > red + 30
    env.step_continuous(np.zeros((1, 7)))
    np.testing.assert_allclose(env.state().qpos[0, 11:14], before[0, 11:14], atol=1e-3)
    env.close()
