"""A live session on LIBERO: what is planned is shown, the hand's way is recorded, images are drawn, runs repeat."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from support.streams import read
from vecenv_eval.config import EvalConfig
from vecenv_eval.panel.frames import View
from vecenv_eval.panel.session import Session


@pytest.fixture(scope="module")
def live() -> Iterator[Session]:
    config = EvalConfig(suite="libero_object", tasks="0", episodes="2", policy="zero")
    with Session(config) as live:
        live.wait_until("ready", timeout=200)
        yield live


@pytest.fixture(scope="module")
def planned() -> Iterator[Session]:
    config = EvalConfig(suite="libero_object", tasks="0", episodes="2", policy="voxposer")
    with Session(config) as live:
        live.wait_until("ready", timeout=200)
        yield live


@pytest.mark.heavy
def test_what_voxposer_plans_is_shown_slot_by_slot(planned: Session) -> None:
    assert planned.act("step", 3) == "run_start"
    deadline = time.monotonic() + 200
    while planned.state().tick < 3:  # the first plan waits for compiled code
        assert time.monotonic() < deadline
        time.sleep(0.1)
    state, other = planned.state(0), planned.state(1)
    assert state.planning is not None
    assert other.planning is not None
    assert (state.planning.slot, other.planning.slot) == (0, 1)
    assert state.planning.instruction == state.slots[0].instruction
    assert state.planning.text in state.planning.subtasks
    assert 2 <= len(state.planning.path) <= 64
    assert state.planning.path != other.planning.path
    hand = planned.history(0).eef_pos[0]
    assert np.linalg.norm(np.subtract(state.planning.path[0], hand)) < 0.05
    assert state.planning.waypoints
    assert state.policy is not None
    assert state.policy.startswith("voxposer (offline/libero")


@pytest.mark.heavy
def test_a_run_that_is_stopped_in_the_middle_of_a_plan_can_be_repeated(planned: Session) -> None:
    first = planned.history(0)
    planned.act("reset")
    planned.act("step", 3)
    deadline = time.monotonic() + 100
    while planned.state().tick < 3:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert planned.history(0) == first


def test_the_hands_way_and_the_gripper_are_recorded(live: Session) -> None:
    live.act("step", 3)
    history = live.history(1)
    assert history.step == (0, 1, 2)
    assert len(history.eef_pos) == len(history.gripper) == 3
    assert 0.0 < history.gripper[0] < 0.1


def test_a_choice_in_the_panel_places_one_episode_of_the_task(live: Session) -> None:
    fields = live.set_field("task_id", 3)
    assert (fields.suite, fields.task, fields.episode) == ("libero_object", 3, 0)
    live.wait_until("ready", timeout=100)
    fields = live.set_field("episode_index", "7")
    state = live.wait_until("ready", timeout=100)
    assert [slot.episode_id for slot in state.slots] == ["libero_object/3/7"]
    assert state.slots[0].max_steps > 0
    assert state.policy == "zero"


@pytest.mark.heavy
def test_images_of_a_live_slot_are_those_of_the_environment(live: Session) -> None:
    view = View(0, "agentview", 1024)
    live.frames.want(view)
    deadline = time.monotonic() + 200
    while live.frames.newest(view) is None:
        assert not live.frames.error, live.frames.error
        assert time.monotonic() < deadline
        time.sleep(0.1)
    frame = live.frames.newest(view)
    assert frame is not None
    header, jpeg = read(frame.message)
    seen = live.call(lambda env: env.observe_egocentric().images["agentview"][0]).result(100)
    assert (header["height"], header["width"]) == seen.shape[:2]
    import io

    from PIL import Image

    shown = np.asarray(Image.open(io.BytesIO(jpeg))).astype(int)
    assert np.abs(shown - seen).mean() < 4
