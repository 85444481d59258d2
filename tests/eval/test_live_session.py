"""A live session without a server: states and actions, what is written, images, and failures."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.live_world import LiveWorld, config, session
from vecenv_eval.panel.frames import WALL, View
from vecenv_eval.panel.session import Action, Session
from vecenv_eval.panel.state import SessionClosed, SessionError, UnknownSlot
from vecenv_eval.store import ResultStore

import vecenv

ACTIONS: tuple[Action, ...] = ("play", "pause", "step", "stop", "reset")


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait for something that another thread does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


def test_a_run_goes_from_ready_to_finished_and_counts_its_episodes() -> None:
    with session() as live:
        assert live.wait_until("ready", timeout=20).num_slots == 6
        assert live.act("play") == "run_start"
        state = live.wait_until("finished", timeout=20)
    assert (state.planned, state.finished, state.successes, state.errors) == (6, 6, 3, 0)
    assert [slot.step for slot in state.slots] == [2, 3, 4, 10, 10, 10]
    assert [slot.verdict for slot in state.slots] == ["success"] * 3 + ["failure"] * 3
    assert [slot.episode_id for slot in state.slots][:2] == ["fake_suite/0/0", "fake_suite/0/1"]


def test_a_step_executes_exactly_its_ticks_and_then_waits() -> None:
    with session() as live:
        live.wait_until("ready", timeout=20)
        assert live.act("step", 2) == "run_start"
        assert (live.state().state, live.state().tick) == ("paused", 2)
        assert live.act("step") is None
        assert live.state().tick == 3
        time.sleep(0.05)
        assert live.state().tick == 3


def test_pause_stops_ticks_and_play_goes_on_with_the_same_run() -> None:
    with session(config=config(max_steps=100_000, tasks="1")) as live:
        live.wait_until("ready", timeout=20)
        live.act("play")
        until(lambda: live.state().tick > 20)
        live.act("pause")
        before = live.state()
        time.sleep(0.05)
        assert live.state().tick == before.tick
        assert before.state == "paused"
        assert live.act("play") is None
        until(lambda: live.state().tick > before.tick)


def test_reset_puts_the_episodes_back_to_their_start() -> None:
    with session() as live:
        live.wait_until("ready", timeout=20)
        live.act("step", 3)
        assert live.act("reset") == "episode_reset"
        state = live.state()
        assert (state.state, state.tick, state.finished) == ("ready", 0, 0)
        assert all(slot.step == 0 and slot.verdict == "live" for slot in state.slots)


@pytest.mark.parametrize("action", ["pause", "stop"])
def test_what_is_taken_back_before_it_has_begun_does_not_begin(action: Action) -> None:
    with session(config=config(tasks="1", max_steps=1_000_000)) as live:
        live.wait_until("ready", timeout=20)
        hold = threading.Event()
        live.call(lambda env: hold.wait(20))
        live.act("play")
        threading.Timer(0.2, hold.set).start()
        live.act(action)
        assert live.state().state == "ready"
        assert live.state().tick == 0


def test_stop_ends_a_run_and_play_begins_a_new_one() -> None:
    with session() as live:
        live.wait_until("ready", timeout=20)
        live.act("step", 3)
        live.act("stop")
        state = live.state()
        assert (state.state, state.finished) == ("finished", 2)
        assert live.act("play") == "run_start"
        assert live.wait_until("finished", timeout=20).finished == 6


def test_more_episodes_than_slots_follow_one_another() -> None:
    with session(config=config(tasks="0", episodes="5", num_envs=2)) as live:
        assert live.wait_until("ready", timeout=20).num_slots == 2
        live.act("play")
        state = live.wait_until("finished", timeout=20)
    assert (state.finished, state.successes) == (5, 5)


def test_the_speed_limit_holds() -> None:
    with session(config=config(tasks="1", episodes="1", max_steps=15)) as live:
        live.wait_until("ready", timeout=20)
        live.set_speed(50.0)
        began = time.monotonic()
        live.act("play")
        live.wait_until("finished", timeout=20)
    assert time.monotonic() - began > 14 / 50


def test_every_run_gets_a_results_folder_that_an_evaluation_would_have_written(tmp_path: Path) -> None:
    with session(out=tmp_path) as live:
        live.wait_until("ready", timeout=20)
        live.act("play")
        first = live.wait_until("finished", timeout=20).results
        live.act("play")
        second = live.wait_until("finished", timeout=20).results
    assert first is not None
    assert first != second
    for name in (first, second):
        store = ResultStore.open(tmp_path / str(name))
        records = store.records()
        assert len(records) == 6
        assert sum(record.success for record in records.values()) == 3
        summary = json.loads((tmp_path / str(name) / "summary.json").read_text())
        assert summary["complete"]


def test_what_has_ended_is_on_the_disk_before_the_run_ends_and_after_the_session_was_closed(tmp_path: Path) -> None:
    with session(out=tmp_path) as live:
        live.wait_until("ready", timeout=20)
        live.act("step", 3)
        folder = tmp_path / str(live.state().results)
        assert len(ResultStore.open(folder).records()) == 2
    assert len(ResultStore.open(folder).records()) == 2
    assert json.loads((folder / "summary.json").read_text())["complete"] is False


def test_a_run_in_which_nothing_ended_leaves_no_folder(tmp_path: Path) -> None:
    with session(out=tmp_path) as live:
        live.wait_until("ready", timeout=20)
        live.act("step")
        live.act("reset")
        assert live.state().results is None
    assert list(tmp_path.iterdir()) == []


def test_history_has_a_row_a_tick_and_begins_anew_with_the_episode() -> None:
    with session(config=config(tasks="0", episodes="2", num_envs=1)) as live:
        live.wait_until("ready", timeout=20)
        live.act("step")
        assert live.history(0).episode_id == "fake_suite/0/0"
        live.act("step", 3)  # the second of these is the first of the next episode
        history = live.history(0)
        assert history.episode_id == "fake_suite/0/1"
        assert history.step == (0, 1)
        assert history.action == ((0.0,) * 6 + (-1.0,),) * 2
        with pytest.raises(UnknownSlot, match="no slot 3"):
            live.history(3)


def test_history_ends_where_the_episode_ended() -> None:
    with session(config=config(tasks="0", episodes="1", num_envs=1)) as live:
        live.wait_until("ready", timeout=20)
        live.act("play")
        live.wait_until("finished", timeout=20)
        (slot,), history = live.state().slots, live.history(0)
    assert len(history.action) == slot.step
    assert len(history.step) == len(history.reward) == slot.step + 1
    assert history.reward[-1] == slot.reward


def test_what_cannot_be_done_in_a_state_is_refused_with_the_reason() -> None:
    with Session(simulator=LiveWorld().simulator) as live:
        assert live.state().state == "idle"
        with pytest.raises(SessionError, match="cannot play: nothing is built yet"):
            live.act("play")
        with pytest.raises(SessionError, match="choose a suite first"):
            live.set_field("task", 0)
    with pytest.raises(SessionClosed):
        live.act("play")
    live.close()


def test_a_config_that_cannot_run_is_refused_at_once_and_the_session_stays() -> None:
    with session() as live:
        live.wait_until("ready", timeout=20)
        with pytest.raises(vecenv.VecenvError, match="no task 9"):
            live.build(config(tasks="9"))
        with pytest.raises(SessionError, match="one suite"):
            live.build(config(suite="fake_suite,other"))
        assert live.state().state == "ready"


def test_an_environment_that_cannot_be_built_is_an_error_and_the_next_build_works() -> None:
    world = LiveWorld()
    world.refuse = vecenv.OptionError("lod='x': there is no such level")
    with session(world) as live:
        with pytest.raises(SessionError, match="no such level"):
            live.wait_until("ready", timeout=20)
        with pytest.raises(SessionError, match="cannot play: it failed"):
            live.act("play")
        world.refuse = None
        live.build(config())
        assert live.wait_until("ready", timeout=20).error is None


def test_a_simulator_that_fails_costs_its_episodes_and_says_why() -> None:
    world = LiveWorld(raise_in={0: RuntimeError("the gripper melted")})
    with session(world) as live:
        live.wait_until("ready", timeout=20)
        live.act("play")
        state = live.wait_until("finished", timeout=30)
        assert "the gripper melted" in str(state.error)
        assert state.errors > 0
        assert live.act("reset") == "episode_reset"
        assert live.state().state == "ready"


def test_faults_are_shown_in_their_slot() -> None:
    with session(LiveWorld(faults={(1, 2): "non-finite state"})) as live:
        live.wait_until("ready", timeout=20)
        live.act("play")
        slot = live.wait_until("finished", timeout=20).slots[5]
    assert (slot.verdict, slot.fault) == ("fault", "non-finite state")


def test_building_while_a_run_goes_on_ends_it_and_closes_its_environment() -> None:
    world = LiveWorld()
    with session(world, config=config(tasks="1", max_steps=1_000_000)) as live:
        live.wait_until("ready", timeout=20)
        live.act("play")
        until(lambda: live.state().tick > 3)
        live.build(config(tasks="0", episodes="1"))
        assert live.wait_until("ready", timeout=20).num_slots == 1
        assert world.envs[0].closed
    assert all(env.closed for env in world.envs)


def test_calls_of_many_threads_at_once_leave_a_session_that_works() -> None:
    failures: list[BaseException] = []

    def press(live: Session, number: int) -> None:
        generator = np.random.default_rng(number)
        for _ in range(15):
            try:
                live.act(ACTIONS[generator.integers(5)])
                live.state()
                live.frames.want(View(int(generator.integers(8)), "agentview", 32))
            except SessionError:
                pass
            except BaseException as error:
                failures.append(error)

    with session() as live:
        live.wait_until("ready", timeout=20)
        threads = [threading.Thread(target=press, args=(live, number)) for number in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert not failures
        live.act("pause")
        until(lambda: live.state().state in ("ready", "paused", "finished"))
        live.act("reset")
        live.act("play")
        assert live.wait_until("finished", timeout=20).finished == 6


def test_nothing_is_drawn_that_nobody_asked_for() -> None:
    world = LiveWorld()
    with session(world) as live:
        live.wait_until("ready", timeout=20)
        live.act("play")
        live.wait_until("finished", timeout=20)
    assert world.last.drawn == []


def test_nothing_is_drawn_any_more_when_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vecenv_eval.panel.frames._INTEREST_S", 0.0)
    world = LiveWorld()
    with session(world) as live:
        live.wait_until("ready", timeout=20)
        live.frames.want(View(0, "wrist", 32))
        until(lambda: live.frames.newest(View(0, "wrist", 32)))
        live.act("play")
        live.wait_until("finished", timeout=20)
    assert world.last.drawn == [(0, "wrist")]


def test_the_end_of_an_episode_is_seen_by_who_looks_although_the_next_has_begun() -> None:
    world = LiveWorld()
    view = View(0, "wrist", 32)
    with session(world, config=config(tasks="0", episodes="2", num_envs=1)) as live:
        live.wait_until("ready", timeout=20)
        live.frames.want(view)
        until(lambda: live.frames.newest(view))
        live.act("step", 2)
        until(lambda: world.last.drawn == [(0, "wrist")] * 2)
        assert live.state().slots[0].episode == 1


def test_a_frame_is_drawn_once_however_often_it_is_asked_for() -> None:
    world = LiveWorld()
    view = View(1, "wrist", 32)
    with session(world) as live:
        live.wait_until("ready", timeout=20)
        for _ in range(50):
            live.frames.want(view)
        until(lambda: live.frames.newest(view))
        for _ in range(50):
            live.frames.want(view)
        time.sleep(0.1)
        assert world.last.drawn == [(1, "wrist")]
        live.act("step")
        live.frames.want(view)
        until(lambda: len(world.last.drawn) == 2)


def test_a_frame_says_what_it_shows_and_shows_it() -> None:
    with session() as live:
        live.wait_until("ready", timeout=20)
        view = View(2, "agentview", 32)
        live.act("step", 3)
        live.frames.want(view)
        until(lambda: live.frames.newest(view))
        header, image = decoded(live.frames.newest(view).message)  # pyright: ignore[reportOptionalMemberAccess]
    assert header == {"type": "frame", "slot": 2, "camera": "agentview", "tick": 3, "width": 32, "height": 32}
    assert np.abs(image[16, 16].astype(int) - [80, 30, 100]).max() < 8


def test_the_wall_is_one_image_with_a_tile_a_slot() -> None:
    with session() as live:
        live.wait_until("ready", timeout=20)
        live.act("step", 3)
        live.frames.want(WALL)
        until(lambda: live.frames.newest(WALL))
        header, image = decoded(live.frames.newest(WALL).message)  # pyright: ignore[reportOptionalMemberAccess]
    assert header["columns"] == 6
    assert header["slots"] == list(range(6))
    assert header["verdicts"] == ["success", "success", "live", "live", "live", "live"]
    assert image.shape == (96, 6 * 96, 3)
    middles = image[48, 48::96].astype(int)
    assert np.abs(middles[:, 0] - [40, 60, 80, 100, 120, 140]).max() < 10


def test_a_slot_that_is_shown_and_on_the_wall_is_drawn_once() -> None:
    world = LiveWorld()
    with session(world, config=config(tasks="1", episodes="3", max_steps=1000)) as live:
        live.wait_until("ready", timeout=20)
        hold = threading.Event()
        held = live.call(lambda env: hold.wait(10))  # both are asked for before any is drawn
        live.frames.want(View(1, "agentview", 64))
        live.frames.want(WALL)
        hold.set()
        assert held.result(10)
        until(lambda: live.frames.newest(WALL) and live.frames.newest(View(1, "agentview", 64)))
    assert sorted(world.last.drawn) == [(slot, "agentview") for slot in range(3)]


def test_images_that_cannot_be_drawn_end_no_run() -> None:
    world = LiveWorld()
    with session(world) as live:
        live.wait_until("ready", timeout=20)
        world.last.broken = RuntimeError("no GL")
        live.frames.want(WALL)
        until(lambda: live.frames.error)
        assert "no GL" in str(live.frames.error)
        live.act("play")
        assert live.wait_until("finished", timeout=20).finished == 6


def test_functions_are_called_with_the_environment_on_its_thread() -> None:
    with session() as live:
        live.wait_until("ready", timeout=20)
        name, slots = live.call(lambda env: (threading.current_thread().name, env.num_envs)).result(10)
        assert (name, slots) == ("vecenv-session", 6)
        with pytest.raises(ZeroDivisionError):
            live.call(lambda env: 1 // 0).result(10)
        assert live.state().state == "ready"


def test_observers_see_every_tick_and_what_they_raise_ends_nothing() -> None:
    class Watching:
        def __init__(self) -> None:
            self.seen: list[str] = []

        def placed(self, env: object) -> None:
            self.seen.append("placed")

        def tick(self, env: object) -> None:
            self.seen.append("tick")
            raise ValueError("a viewer's own mistake")

        def planned(self, motion: object) -> None:
            raise AssertionError("nothing plans here")

        def lost(self) -> None:
            self.seen.append("lost")

    watching = Watching()
    with session() as live:
        live.wait_until("ready", timeout=20)
        live.observe(watching)
        live.act("play")
        assert live.wait_until("finished", timeout=20).finished == 6
    assert watching.seen[0] == "placed"
    assert watching.seen.count("tick") >= 10
    assert watching.seen[-1] == "lost"


def decoded(message: bytes) -> tuple[dict[str, object], np.ndarray]:
    """Header and image of a binary message."""
    import io

    from PIL import Image

    length = int.from_bytes(message[:4], "little")
    image = Image.open(io.BytesIO(message[4 + length :]))
    return json.loads(message[4 : 4 + length]), np.asarray(image)
