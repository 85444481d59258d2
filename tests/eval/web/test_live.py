"""Newest images of running episodes: bounded, cheap, harmless, and seen while evaluations run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fakes import SUITE, FakeWorld
from support.filmed import FilmedEnv, record
from vecenv_eval.config import EvalConfig
from vecenv_eval.engines.ledger import Ledger
from vecenv_eval.engines.ray_actor import Outbox, Report
from vecenv_eval.episodes import Episode
from vecenv_eval.live import MOST_SLOTS, SHARE, LivePublisher, unpack
from vecenv_eval.results import begin
from vecenv_eval.runner import Evaluation, evaluate
from vecenv_eval.watch import watching
from vecenv_eval.web.live import live_frames
from vecenv_eval.web.runs import RunReader

pytest.importorskip("PIL")


class Watched:
    """A publisher over filmed slots, with a clock of its own; every look costs as much as it says."""

    def __init__(self, num_envs: int = 3, **options: Any) -> None:
        self.now, self.cost, self.frames = 0.0, 0.0, list[bytes | None]()
        self.env = FilmedEnv(num_envs, **options)
        look = self.env.observe_egocentric

        def observe_egocentric(slots: Any = None) -> Any:
            self.now += self.cost * len(slots)
            self.drawn.append(list(slots))
            return look(slots)

        self.env.observe_egocentric = observe_egocentric  # type: ignore[method-assign]
        self.drawn: list[list[int]] = []
        self.publisher = LivePublisher(self.publish, ["", "open the drawer"], name="box-1", clock=lambda: self.now)
        self.publisher.begin(self.env, {i: Episode("libero_goal", 1, i) for i in range(num_envs)})  # type: ignore[arg-type]

    def publish(self, name: str, content: bytes | None) -> None:
        assert name == "box-1"
        self.frames.append(content)

    def run(self, seconds: float, tick_s: float = 0.125) -> None:
        """Ticks of every slot for so long."""
        until = self.now + seconds
        with watching(self.env, [self.publisher]):  # type: ignore[arg-type]
            while self.now < until:
                self.env.tick(*range(self.env.num_envs))
                self.now += tick_s

    @property
    def last(self) -> tuple[dict[str, Any], np.ndarray]:
        import io

        from PIL import Image

        content = self.frames[-1]
        assert content is not None
        header, jpeg = unpack(content)
        return header, np.asarray(Image.open(io.BytesIO(jpeg)))


def test_a_frame_a_second_shows_every_slot() -> None:
    watched = Watched()
    watched.run(5)
    assert len(watched.frames) == 5
    header, image = watched.last
    assert (header["slots"], header["verdicts"], header["ticks"]) == ([0, 1, 2], ["live"] * 3, [33] * 3)
    assert header["episodes"][2] == "libero_goal/1/2"
    assert header["instructions"] == ["open the drawer"] * 3
    assert header["steps_per_s"] == 24
    assert image.shape == (96, 3 * 96, 3)


def test_a_verdict_stays_until_the_next_episode_begins() -> None:
    watched = Watched()
    watched.run(1)
    watched.publisher.finish(watched.env, {0: record(0), 1: record(1, False), 2: record(2, False, fault="boom")})  # type: ignore[arg-type]
    watched.run(1.5)
    assert watched.last[0]["verdicts"] == ["success", "failure", "fault"]
    watched.publisher.begin(watched.env, {1: Episode("libero_goal", 1, 9)})  # type: ignore[arg-type]
    watched.run(1.5)
    assert watched.last[0]["verdicts"] == ["success", "live", "fault"]
    assert watched.last[0]["episodes"][1] == "libero_goal/1/9"


@pytest.mark.parametrize("cost", [0.001, 0.02, 0.5])
def test_drawing_takes_its_share_of_the_time_and_every_slot_has_its_turn(cost: float) -> None:
    watched = Watched(num_envs=6)
    watched.cost = cost
    watched.run(5)  # the first frame, which is not counted
    began, drawn = watched.now, len(watched.drawn)
    watched.run(100)
    spent = cost * sum(map(len, watched.drawn[drawn:]))
    assert spent <= 1.2 * SHARE * (watched.now - began) + 6 * cost
    assert {slot for slots in watched.drawn[drawn:] for slot in slots} == set(range(6))
    assert len(watched.frames) > 100 * SHARE / max(cost, SHARE) / 2


def test_a_mosaic_has_a_limit() -> None:
    watched = Watched(num_envs=300)
    watched.run(3)
    header, image = watched.last
    assert (len(header["slots"]), header["num_slots"]) == (MOST_SLOTS, 300)
    assert image.shape == (8 * 96, 8 * 96, 3)
    assert max(slot for slots in watched.drawn for slot in slots) < MOST_SLOTS
    content = watched.frames[-1]
    assert content is not None
    assert len(content) < 200_000


def test_other_recorders_images_are_not_drawn_for_it() -> None:
    watched = Watched(num_envs=50)
    watched.run(0.1)
    assert [len(slots) for slots in watched.drawn] == [8]


def test_what_goes_wrong_costs_no_episode(caplog: pytest.LogCaptureFixture) -> None:
    watched = Watched()

    def broken(slots: Any = None) -> Any:
        raise RuntimeError("no GL")

    watched.env.observe_egocentric = broken  # type: ignore[method-assign]
    watched.run(5)
    assert len(caplog.records) == 1
    assert "no GL" in caplog.text
    assert len(watched.frames) == 5, "what the slots do is still said"


def test_a_full_disk_costs_no_episode(caplog: pytest.LogCaptureFixture) -> None:
    calls = []

    def full(name: str, content: bytes | None) -> None:
        calls.append(name)
        raise OSError(28, "No space left on device")

    watched = Watched()
    watched.publisher = LivePublisher(full, clock=lambda: watched.now)
    watched.publisher.begin(watched.env, {0: Episode("libero_goal", 1, 0)})  # type: ignore[arg-type]
    watched.run(5)
    assert len(calls) == 1
    assert "No space left" in caplog.text


def test_an_environment_without_cameras_has_a_wall_without_images() -> None:
    watched = Watched(cameras={})
    watched.run(2.5)
    assert watched.last[0]["slots"] == [0, 1, 2]
    assert len(watched.drawn) == 1


def test_closing_removes_the_frame() -> None:
    watched = Watched()
    watched.run(1)
    watched.publisher.close()
    assert watched.frames[-1] is None


def test_the_frame_of_an_actor_reaches_the_folder(tmp_path: Path) -> None:
    evaluation = Evaluation(EvalConfig(suite=SUITE, policy="random", tasks="0"), FakeWorld().simulator)
    store = begin(evaluation.config, tmp_path / "run")
    outbox, ledger = Outbox(tmp_path), Ledger(store, evaluation)
    outbox.publish("node/../7", b"old")
    outbox.publish("node/../7", b"new")
    ledger.receive(Report(live=outbox.take_live()))
    assert [(path.name, path.read_bytes()) for path in (store.folder / "live").iterdir()] == [
        ("node-..-7.frame", b"new")
    ]
    assert outbox.take_live() == {}
    outbox.publish("node/../7", None)
    ledger.receive(Report(live=outbox.take_live()))
    assert list((store.folder / "live").iterdir()) == []


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    config = EvalConfig(suite=SUITE, policy="random", tasks="0", episodes="2")
    store = begin(config, tmp_path / "run")
    (store.folder / "live").mkdir()
    (store.folder / "live" / "old-1.frame").write_bytes(b"")
    evaluate(config, store, simulator=FakeWorld().simulator)
    assert not (store.folder / "live").exists()


def test_two_shards_are_seen_while_they_run(tmp_path: Path) -> None:
    settings = "--suite libero_object --tasks 0 --episodes 2 --max-steps 60 --num-threads 1 --live --image-size 64"
    policy = ["--policy", "support.slow_policy:SlowPolicy", "--policy-arg", "seconds=0.1"]
    command = [sys.executable, "-c", "from vecenv.cli import main; main()", "eval", *settings.split(), *policy]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    shards = [
        subprocess.Popen(
            [*command, "--shard", f"{i}/2", "--out", str(tmp_path / f"part{i}"), "--quiet"], env=environment
        )
        for i in (1, 2)
    ]
    try:
        seen: dict[str, set[int]] = {}
        until = time.monotonic() + 240
        while time.monotonic() < until and any(shard.poll() is None for shard in shards):
            if all((tmp_path / f"part{i}" / "config.json").is_file() for i in (1, 2)):
                run = RunReader("run", tmp_path).snapshot()
                for frame in live_frames(run):
                    assert frame.jpeg.startswith(b"\xff\xd8")
                    seen.setdefault(frame.header.episodes[0], set()).add(frame.header.number)
                if len(live_frames(run)) == 2:
                    assert run.state(True) == "running"
            time.sleep(0.05)
        assert [shard.wait(60) for shard in shards] == [0, 0]
    finally:
        for shard in shards:
            shard.kill()
    assert set(seen) == {"libero_object/0/0", "libero_object/0/1"}
    assert all(len(numbers) >= 2 for numbers in seen.values()), "it moves"
    run = RunReader("run", tmp_path).snapshot()
    assert live_frames(run) == []
    assert not list(tmp_path.glob("*/live"))
    (leg,) = run.legs
    assert (leg.total.episodes, run.state()) == (2, "complete")


def test_live_images_change_no_verdict(tmp_path: Path) -> None:
    rows = []
    for live in (False, True):
        config = EvalConfig(
            suite="libero_object", policy="random", tasks="0", episodes="2", max_steps=12, image_size=64, live=live
        )
        result = evaluate(config, tmp_path / str(live))
        rows.append([json.dumps(each.verdict, sort_keys=True) for each in result.records])
    assert rows[0] == rows[1]
