"""The page and the picture of a task: everything planned is in them, and nothing a model wrote can break out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("plotly")

from support.voxposer_world import Obedient, box, snapshot
from test_voxposer_agent import agent

from voxposer.agent import PlannedMotion
from voxposer.figures import color_of, grip_figure, layers, map_views, scene_figure
from voxposer.language.lmp_config import Call
from voxposer.planning.config import PlannerConfig
from voxposer.show import EpisodeRecord, parse_task, render_page, save_image


def planned() -> list[PlannedMotion]:
    motions: list[PlannedMotion] = []
    env = Obedient(snapshot({"cube_1": box((0.02, 0.02, 0.02), (0.2, 0.1, 0.02))}))
    acting, _ = agent(env, ("lift",), motions.append)
    acting.step()
    return motions


def shown(**changes: object) -> EpisodeRecord:
    values = {
        "title": "libero_goal/0/0",
        "instruction": "lift <it> & hold",
        "model": "offline/libero",
        "subtasks": ("lift up", "lift higher"),
        "motions": tuple(planned()),
        "calls": (
            Call(
                lmp="composer", query="lift up", context="objects = []", model="m", code="execute('<b>')", cached=True
            ),
            Call(lmp="planner", query="lift", context="", model="m", code="", error="went wrong", cost_usd=0.25),
        ),
        "success": False,
        "ticks": 12,
        "cause": "",
        **changes,
    }
    return EpisodeRecord(**values)  # pyright: ignore[reportArgumentType]


def test_a_motion_shows_targets_planned_path_and_hand_route() -> None:
    (motion,) = planned()
    found = layers(motion)
    assert found["targets"].shape == (1, 3)
    assert len(found["planner's path"]) > 1
    np.testing.assert_allclose(found["hand's way"][-1], found["targets"][0], atol=1e-6)
    assert len(found["surroundings"]) > 300


def test_the_page_has_every_program_and_its_source() -> None:
    page = render_page(shown(model="gpt-4o"))
    for text in ("execute(&#39;&lt;b&gt;&#39;)", "from the cache", "went wrong", "0.2500 US dollars", "lift higher"):
        assert text in page
    assert "lift &lt;it&gt; &amp; hold" in page
    by_rule = render_page(shown())
    assert "rule-based, no language model" in by_rule
    assert "dollars" not in by_rule.split("<body>")[1]
    assert " tokens" not in by_rule.split("<body>")[1]
    assert "rule-based" not in render_page(shown(model="gpt-4o")).split("<h2>Motions")[0].split("<body>")[1]


def test_the_maps_are_those_that_were_planned_on() -> None:
    (motion,) = planned()
    value, avoidance, rotation, gripper, velocity = map_views(motion, PlannerConfig())
    assert avoidance.values is motion.obstacles
    assert value.values is not None
    assert motion.request.targets is not None
    assert value.values is motion.value
    # The voxels of these maps are moved so that one is exactly at the goal.
    target, best = np.argwhere(motion.request.targets)[0], np.argwhere(value.values == value.values.min())[0]
    assert np.abs(target - best).max() <= 1
    assert gripper.constant == "open everywhere"
    assert velocity.constant == "1.00 of full speed everywhere"
    assert rotation.constant.startswith("wxyz 0.00, 1.00")


def test_a_rotation_map_is_shown_as_degrees_from_the_hand() -> None:
    (motion,) = planned()
    quats = np.broadcast_to(motion.start[3:], (100, 100, 100, 4)).copy()
    quats[0] = [1.0, 0.0, 0.0, 0.0]  # half a turn away
    turned = replace(motion, request=replace(motion.request, rotation=quats))
    view = map_views(turned, PlannerConfig())[2]
    assert view.values is not None
    assert view.values[0, 0, 0] == pytest.approx(180, abs=1e-3)
    assert view.values[1, 0, 0] == pytest.approx(0, abs=1e-3)


def test_figures_name_objects_and_show_the_grip_along_the_way() -> None:
    (motion,) = planned()
    scene = {trace["name"]: trace for trace in scene_figure(motion, ["cube_1", "plate_1"])["data"]}
    assert scene["cube_1"]["marker"]["color"] == color_of("cube_1", ["plate_1", "cube_1"])
    assert "cube_1" in scene["names"]["text"]
    assert {"keep away", "targets", "planner's path", "hand's way"} <= set(scene)
    closing = replace(motion, stops=(*motion.stops, replace(motion.stops[-1], closed=True)))
    figure = grip_figure(closing)
    assert figure is not None
    assert figure["data"][0]["y"] == ["open", *["open"] * len(motion.stops), "closed"]


def test_a_motion_is_linked_to_its_programs_settings_and_commit() -> None:
    calls = [Call(lmp=name, query="q", context="", model="m") for name in ("planner", "composer", "get_gripper_map")]
    (motion,) = planned()
    page = render_page(
        shown(calls=tuple(calls), motions=(replace(motion, calls=range(1, 3)),), commit="abc123", no_images="no GL")
    )
    section = page[page.index('id="motion-1"') : page.index("</section>")]
    assert 'href="#call-2">composer' in section
    assert 'href="#call-3">get_gripper_map' in section
    assert "abc123" in section
    assert "planner.max_curvature: 3\n" in page
    assert "No camera images: no GL" in page


def test_images_of_the_camera_are_put_into_the_page() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    page = render_page(shown(images=(image,), last_image=image))
    assert page.count('<figure><img src="data:image/png;base64,') == 3  # start, end, and when it was planned


def test_the_page_needs_no_network() -> None:
    page = render_page(shown(motions=()))
    before, scripts = page.split("<script>", 1)
    assert "src=" not in before
    assert "default-src 'none'" in before
    assert "Plotly" in scripts


def test_the_picture_is_a_png(tmp_path: Path) -> None:
    save_image(shown(), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_tasks_are_named_by_suite_number_and_episode() -> None:
    assert parse_task("libero_goal/3") == ("libero_goal", 3, 0)
    assert parse_task("libero_goal/3/7") == ("libero_goal", 3, 7)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("libero_goal", "write SUITE/TASK"),
        ("libero_goal/x", "write SUITE/TASK"),
        ("libero_gaol/1", "no suite 'libero_gaol'"),
        ("libero_goal/10", "tasks 0 to 9"),
        ("libero_goal/1/50", "episodes 0 to 49"),
    ],
)
def test_tasks_that_do_not_exist_are_refused(text: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        parse_task(text)
