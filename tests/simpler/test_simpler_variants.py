"""Variants of SIMPLER's scenes: what each changes, on which tasks, and that they run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import simpler_assets_small

import vecenv
from vecenv.assets import AssetsMissing
from vecenv.simpler.layouts import episode_layout, episode_seed
from vecenv.simpler.task_spec import Lighting
from vecenv.simpler.tasks import TASKS
from vecenv.simpler.variants import DISTRACTORS, STATIONS, Variant, VariantError, varied

COKE, NEAR, OPEN = "google_robot_pick_coke_can", "google_robot_move_near", "google_robot_open_top_drawer"
GOOGLE = "simpler/google_robot"


def under(task: str, episode: int = 0, **changes: str) -> tuple[Any, Any]:
    chosen = TASKS[task]
    return varied(chosen, episode_layout(chosen, episode_seed(episode)), Variant(**changes))


def brightness(light: Lighting) -> float:
    return sum(
        float(sum(each.colour) * -each.direction[2] / np.linalg.norm(each.direction)) for each in light.directional
    )


def test_no_variant_changes_nothing() -> None:
    task = TASKS[COKE]
    layout = episode_layout(task, 2022)
    assert varied(task, layout, None) == varied(task, layout, Variant()) == (task, layout)


@pytest.mark.parametrize("task", [COKE, NEAR, OPEN])
def test_light_gets_brighter_and_darker_and_nothing_else_changes(task: str) -> None:
    (bright, same), (dark, _) = under(task, lighting="brighter"), under(task, lighting="darker")
    plain = TASKS[task].lighting if task != OPEN else under(task, lighting="room")[0].lighting
    assert brightness(bright.lighting) > brightness(plain) > brightness(dark.lighting)
    assert dataclasses.replace(bright, lighting=TASKS[task].lighting) == TASKS[task]
    assert same == episode_layout(TASKS[task], 2022)


@pytest.mark.parametrize("station", STATIONS)
def test_a_cabinet_is_another_file(station: str) -> None:
    assert str(under(OPEN, station=station)[0].station) == f"data/custom/{station}.urdf"


@pytest.mark.parametrize("kind", ["less", "more"])
@pytest.mark.parametrize("episode", [0, 7, 49])
def test_distractors_lie_beside_the_can(kind: str, episode: int) -> None:
    _, layout = under(COKE, episode, distractors=kind)
    can, *others = layout.objects
    assert [placed.model for placed in others] == list(DISTRACTORS[kind])
    assert {placed.role for placed in others} == {"distractor"}
    for placed in others:
        assert np.hypot(placed.position[0] - can.position[0], placed.position[1] - can.position[1]) > 0.25
        assert -0.5 <= placed.position[0] <= -0.1
        assert 0.05 <= placed.position[1] <= 0.35
    assert under(COKE, episode, distractors=kind)[1] == layout


def test_move_near_can_do_without_its_third_object() -> None:
    assert [placed.role for placed in under(NEAR, distractors="none")[1].objects] in (
        ["source", "target"],
        ["target", "source"],
    )


@pytest.mark.parametrize(
    ("task", "changes", "says"),
    [
        (
            COKE,
            {"lighting": "room"},
            "lighting='room' is not available for google_robot_pick_coke_can; expected one of bri",
        ),
        (COKE, {"station": "mk_station2"}, "station='mk_station2' is not available for .*; expected none at all"),
        (
            OPEN,
            {"stage": "modern_bedroom_no_roof"},
            f"stage='modern_bedroom_no_roof' is not available for {OPEN}; expected none at all",
        ),
        (OPEN, {"distractors": "less"}, f"distractors='less' is not available for {OPEN}; expected none at all"),
        (NEAR, {"distractors": "more"}, "expected one of none"),
        (COKE, {"camera": "left"}, "camera='left': expected one of lower, higher"),
        ("widowx_stack_cube", {"lighting": "darker"}, "widowx_stack_cube has none"),
    ],
)
def test_what_does_not_fit_a_task_is_refused(task: str, changes: dict[str, str], says: str) -> None:
    with pytest.raises(VariantError, match=says):
        under(task, 0, **changes)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = simpler_assets_small.build(tmp_path_factory.mktemp("small"))
    custom = root / "data/custom"
    (custom / "mk_station2.urdf").write_text((custom / "mk_station_recolor.urdf").read_text())
    return root


def test_a_turned_head_stays_turned_and_looks_elsewhere(small: Path) -> None:
    pytest.importorskip("sapien")
    down = []
    for camera in ("lower", "higher"):
        env = vecenv.make(GOOGLE, task=COKE, episodes=[0], assets=small, num_threads=1, variant={"camera": camera})
        env.reset()
        env.step_continuous(np.zeros((1, 3, 7)))
        seen = env.observe_egocentric()
        np.testing.assert_allclose(seen.state[0, 10], 0.9351361 if camera == "lower" else 0.6651361, atol=1e-3)
        down.append(-seen.views["agentview"].mat[0, 2, 2])
        env.close()
    assert down[0] > down[1] + 0.1


def test_a_variant_runs(small: Path) -> None:
    pytest.importorskip("sapien")
    variant = Variant(station="mk_station2", lighting="darker")
    env = vecenv.make(GOOGLE, task=OPEN, episodes=[0], assets=small, num_threads=1, variant=variant)
    env.reset()
    assert env.step_continuous(np.zeros((1, 7))).info["fault"] == ("",)
    env.close()


def test_a_variant_whose_file_is_missing_names_the_file(small: Path) -> None:
    pytest.importorskip("sapien")
    stage = "google_pick_coke_can_1_v4_alt_background"
    with pytest.raises(AssetsMissing, match=f"{stage}.glb"):
        vecenv.make(GOOGLE, task=COKE, episodes=[0], assets=small, num_threads=1, variant={"stage": stage})
    station = small / "data/custom/mk_station3.urdf"
    station.write_text(
        (small / "data/custom/mk_station_recolor.urdf")
        .read_text()
        .replace("</link>", '<visual><geometry><mesh filename="models/stone.glb"/></geometry></visual></link>', 1)
    )
    with pytest.raises(AssetsMissing, match=r"no data/custom/models/stone.glb, a part of mk_station3.urdf"):
        vecenv.make(GOOGLE, task=OPEN, episodes=[0], assets=small, variant={"station": "mk_station3"})
    with pytest.raises(VariantError, match="'sun' is not one of lighting, camera"):
        vecenv.make(GOOGLE, task=COKE, episodes=[0], assets=small, variant={"sun": "high"})


def test_distractors_fall_after_the_can_and_do_not_move_it(small: Path) -> None:
    pytest.importorskip("sapien")
    poses = []
    for variant in (None, {"distractors": "less"}):
        env = vecenv.make(GOOGLE, task=COKE, episodes=[0, 3], assets=small, num_threads=1, variant=variant)
        env.reset()
        snapshots = env.observe_objects().snapshot
        assert all(snapshot is not None for snapshot in snapshots)
        poses.append([snapshot.poses for snapshot in snapshots if snapshot is not None])
        env.close()
    for alone, crowded in zip(*poses, strict=True):
        np.testing.assert_allclose(crowded["opened_coke_can"], alone["opened_coke_can"], atol=1e-4)
        assert set(crowded) == {"opened_coke_can", *DISTRACTORS["less"]}
        assert all(pose[2] > 0.85 for pose in crowded.values())
