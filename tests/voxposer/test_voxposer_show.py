"""The page and the picture of a task: everything planned is in them, and nothing a model wrote can break out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("plotly")

from support.voxposer_world import Obedient, box, snapshot
from test_voxposer_agent import agent

from voxposer.agent import PlannedMotion
from voxposer.language.lmp_config import Call
from voxposer.show import EpisodeRecord, layers, parse_task, render_page, save_image


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
    page = render_page(shown())
    for text in ("execute(&#x27;&lt;b&gt;&#x27;)", "from the cache", "went wrong", "0.2500 US dollars", "lift higher"):
        assert text in page
    assert "lift &lt;it&gt; &amp; hold" in page
    assert "rule-based, no language model" in page
    assert "rule-based" not in render_page(shown(model="gpt-4o")).split("<h2>Motions")[0].split("<body>")[1]


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
