"""SIMPLER's tasks and episodes: upstream's, draw for draw.

``simpler_layouts_upstream.json`` was written by upstream's own reset code (ManiSkill2_real2sim ef7a4d4, its simulator
replaced by stubs): two episodes of each task in full, and a hash of all fifty.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.paths import DATA
from support.simpler_files import GOOGLE_ROLLOUTS, WIDOWX_ROLLOUTS, rollouts, small_files

from vecenv.simpler.control.robots import ROBOTS
from vecenv.simpler.layouts import (
    DROP_HEIGHT,
    Layout,
    LayoutError,
    episode_layout,
    episode_seed,
    object_words,
    unseeded_seeds,
)
from vecenv.simpler.models import ModelDataError, read_models
from vecenv.simpler.published.metadata import eval_metadata
from vecenv.simpler.task_spec import DrawerSuccess, SimplerTask
from vecenv.simpler.task_table import PLACE_MODELS
from vecenv.simpler.tasks import SUITES, TASKS, UnknownSuite, UnknownTask, find_task, list_tasks

UPSTREAM: dict[str, Any] = json.loads((DATA / "simpler_layouts_upstream.json").read_text())


def rounded(values: Sequence[float]) -> list[float]:
    return [round(value, 6) + 0.0 for value in values]


def canonical_quat(quat: Sequence[float]) -> list[float]:
    values = rounded(quat)
    leading = next((value for value in values if value), 1)
    return [(-value if leading < 0 else value) + 0.0 for value in values]


def canonical(layout: Layout) -> dict[str, Any]:
    """A layout as the file of upstream's episodes has it."""
    return {
        "seed": layout.seed,
        "objects": [[o.model, rounded(o.position), canonical_quat(o.quat)] for o in layout.objects],
        "base": [rounded(layout.base_position), canonical_quat(layout.base_quat)],
        "urdf": layout.urdf_version,
        "overlay": layout.overlay.name if layout.overlay else "",
        "drawer": layout.drawer,
        "instructions": [text for text in (layout.instruction, layout.second_instruction) if text],
        "orientation": layout.orientation,
        "episode_id": layout.episode_id,
    }


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_files(tmp_path_factory.mktemp("tree"))


# Tasks


def test_there_are_upstreams_tasks_in_upstreams_order() -> None:
    google = [name for name in UPSTREAM if name.startswith("google")]
    bridge = [name for name in UPSTREAM if name.startswith("widowx")]
    assert [task.name for task in list_tasks("simpler/google_robot")] == google
    assert [task.name for task in list_tasks("simpler/bridge")] == bridge
    assert [task.index for task in list_tasks("simpler/google_robot")] == list(range(21))


def test_episodes_are_counted() -> None:
    assert {suite: eval_metadata(suite)["num_episodes"] for suite in SUITES} == {
        "simpler/bridge": 200,
        "simpler/google_robot": 1050,
    }


@pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
def test_control_steps_are_whole_numbers_of_substeps(task: SimplerTask) -> None:
    assert task.sim_hz == task.control_hz * task.robot.substeps
    assert task.robot is ROBOTS[task.robot.name]


def test_budgets_are_upstreams() -> None:
    budgets = {task.name: task.max_steps for task in TASKS.values()}
    assert budgets["widowx_put_eggplant_in_basket"] == 120
    assert budgets["widowx_stack_cube"] == 60
    assert {budgets[name] for name in budgets if "pick" in name or "near" in name} == {80}
    assert {budgets[name] for name in budgets if "place" in name} == {200}
    assert {budgets[name] for name in budgets if "open_" in name or "close_" in name} == {113}


def test_opening_and_closing_have_opposite_thresholds() -> None:
    opened, closed = (TASKS[f"google_robot_{verb}_drawer"].success for verb in ("open", "close"))
    assert isinstance(opened, DrawerSuccess)
    assert isinstance(closed, DrawerSuccess)
    assert opened.reached([0.149, 0.15]).tolist() == [False, True]
    assert closed.reached([0.05, 0.051]).tolist() == [True, False]
    assert not opened.reached(opened.start)
    assert not closed.reached(closed.start)


def test_a_camera_looks_through_its_principal_point() -> None:
    camera = TASKS["widowx_stack_cube"].camera
    projected = camera.intrinsics @ [0, 0, 1]
    np.testing.assert_allclose(projected[:2], [319.501, 239.545])


def test_tasks_are_found_by_name_and_by_index() -> None:
    assert find_task("simpler/bridge", "widowx_stack_cube") is find_task("simpler/bridge", 2)


def test_an_unknown_task_is_named_with_what_comes_close() -> None:
    with pytest.raises(UnknownTask, match="widowx_stack_cube"):
        find_task("simpler/bridge", "widowx_stack_cubes")
    with pytest.raises(UnknownTask, match="0 to 3, not 4"):
        find_task("simpler/bridge", 4)
    with pytest.raises(UnknownTask, match="not -1"):
        find_task("simpler/bridge", -1)
    with pytest.raises(UnknownSuite, match="simpler/google_robot"):
        list_tasks("simpler/franka")


def test_objects_are_read_from_upstreams_files(tree: Path) -> None:
    for task in TASKS.values():
        if task.models_path:
            known = read_models(tree / task.models_path)
            assert set(task.models).union(*task.triplets) <= set(known)
    cloth = read_models(tree / "data/custom/info_bridge_custom_v0.json")["table_cloth_generated_shorter"]
    np.testing.assert_allclose(cloth.size, [0.1, 0.1, 0.01])
    assert cloth.density == 330


def test_place_draws_from_all_objects_of_its_file(tree: Path) -> None:
    task = TASKS["google_robot_place_in_closed_drawer"]
    assert task.models_path
    assert tuple(sorted(read_models(tree / task.models_path))) == PLACE_MODELS == task.models


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", "JSONDecodeError"),
        ("[1]", "AttributeError"),
        ('{"can": {}}', "KeyError"),
        ('{"can": {"bbox": {"min": [0, 0], "max": [1, 1, 1]}}}', "'can' is not two points"),
        ('{"can": {"bbox": {"min": [0, 0, 0], "max": [1, 1, 1]}, "scales": [1.0, 2.0]}}', "'can' has scales"),
    ],
)
def test_a_damaged_models_file_is_named(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "info.json").write_text(text)
    with pytest.raises(ModelDataError, match=rf"info\.json.*{problem}"):
        read_models(tmp_path / "info.json")


def test_an_objects_density_has_a_default(tmp_path: Path) -> None:
    (tmp_path / "info.json").write_text('{"can": {"bbox": {"min": [0, 0, 0], "max": [1, 2, 3]}}}')
    can = read_models(tmp_path / "info.json")["can"]
    assert can.density == 1000
    assert can.size.tolist() == [1, 2, 3]


# Episodes


@pytest.mark.parametrize("name", UPSTREAM)
def test_episodes_are_those_upstream_sets_up(name: str) -> None:
    for row in UPSTREAM[name]["rows"]:
        assert canonical(episode_layout(TASKS[name], row["seed"])) == row
    fifty = [canonical(episode_layout(TASKS[name], episode_seed(episode))) for episode in range(50)]
    assert hashlib.sha256(json.dumps(fifty).encode()).hexdigest() == UPSTREAM[name]["digest"]


@pytest.mark.parametrize("task", [GOOGLE_ROLLOUTS, WIDOWX_ROLLOUTS])
def test_episodes_are_those_of_recorded_rollouts(task: str) -> None:
    settled, names = rollouts(task, "obj_pose0"), rollouts(task, "obj_names")
    said, versions, qpos = (rollouts(task, key) for key in ("instruction", "urdf_version", "qpos0"))
    base, resets = rollouts(task, "base_pose"), rollouts(task, "reset_info")
    for i, seed in enumerate(rollouts(task, "seed")):
        layout, reset = episode_layout(TASKS[task], int(seed)), json.loads(str(resets[i]))
        assert [placed.model for placed in layout.objects] == names[i].tolist()
        assert (layout.instruction, layout.urdf_version) == (said[i], versions[i])
        assert layout.orientation == reset.get("orientation", "")
        assert layout.episode_id == (int(reset["episode_id"]) if "episode_id" in reset else None)
        np.testing.assert_allclose(qpos[i], layout.qpos, atol=1e-6)
        np.testing.assert_allclose(base[i], [*layout.base_position, *layout.base_quat], atol=1e-6)
        # They fall straight down, and roll a little.
        dropped = np.array([placed.position for placed in layout.objects])
        np.testing.assert_allclose(settled[i, :, :2], dropped[:, :2], atol=2e-3)
        turned = np.abs(np.sum(settled[i, :, 3:] * [placed.quat for placed in layout.objects], axis=1))
        assert (turned > 0.99).all()


def test_the_first_unseeded_reset_is_the_published_one() -> None:
    """SimplerEnv's example.ipynb prints it: robot base at (0.35, 0.2), turned by half a turn."""
    layout = episode_layout(TASKS["google_robot_pick_coke_can"], unseeded_seeds(1)[0])
    published = 0.35 - 0.587925, 0.20 + 0.0238302
    assert (layout.orientation, layout.urdf_version) == ("laid_vertically", "recolor_tabletop_visual_matching_1")
    np.testing.assert_allclose(layout.objects[0].position[:2], published, atol=1e-3)


def test_a_task_with_one_object_draws_none() -> None:
    """Upstream's single candidate costs no draw, so the robot's colour differs from the task with fourteen."""
    one, many = (
        [episode_layout(TASKS[f"google_robot_{name}"], seed).urdf_version for seed in range(20)]
        for name in ("pick_coke_can", "pick_object")
    )
    assert one != many


def test_objects_are_dropped_from_half_a_metre() -> None:
    dropped = [o for t in TASKS.values() for o in episode_layout(t, 7).objects if o.role != "fixture"]
    np.testing.assert_allclose([placed.position[2] for placed in dropped], 0.87 + DROP_HEIGHT)


def test_toy_fruit_is_light_in_move_near_only() -> None:
    densities = {
        o.model: o.density for s in range(40) for o in episode_layout(TASKS["google_robot_move_near"], s).objects
    }
    assert (densities["orange"], densities["baked_apple_v2"], densities["baked_sponge_v2"]) == (200.0, 200.0, None)
    placed = episode_layout(TASKS["google_robot_place_apple_in_closed_top_drawer"], 0).objects[0]
    assert (placed.model, placed.density) == ("baked_apple_v2", None)


def test_the_sink_does_not_move() -> None:
    layout = episode_layout(TASKS["widowx_put_eggplant_in_basket"], 3)
    assert [placed.model for placed in layout.with_role("fixture")] == ["sink"]
    assert layout.with_role("fixture")[0].position == (-0.16, 0.13, 0.88)


def test_a_drawer_to_be_closed_starts_open() -> None:
    starts = {
        verb: episode_layout(TASKS[f"google_robot_{verb}_top_drawer"], 5).drawer_qpos for verb in ("open", "close")
    }
    assert starts == {"open": 0.0, "close": 0.2}


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("opened_coke_can", "coke can"),
        ("baked_opened_7up_can_v2", "7up can"),
        ("bridge_spoon_generated_modified", "spoon"),
        ("green_cube_3cm", "green cube"),
        ("blue_plastic_bottle", "blue plastic bottle"),
    ],
)
def test_objects_are_called_what_upstream_calls_them(model: str, words: str) -> None:
    assert object_words(model) == words


def test_episodes_and_seeds_have_a_range() -> None:
    assert (episode_seed(0), episode_seed(49)) == (2022, 2071)
    for episode in (-1, 50):
        with pytest.raises(LayoutError, match=f"episode {episode}"):
            episode_seed(episode)
    for seed in (-1, 2**32):
        with pytest.raises(LayoutError, match=f"seed {seed}"):
            episode_layout(TASKS["widowx_stack_cube"], seed)
