"""An evaluation that records is killed at any moment: a verdict is never without its recordings, none is there twice.

Runs kill themselves with SIGKILL before a chosen one of all the things that they do to files, so that every moment
between two of them can be tried.
"""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from support import recorded_world as world
from vecenv_eval.config import STORE_CHOICES
from vecenv_eval.datasets import lerobot
from vecenv_eval.episodes import Episode
from vecenv_eval.store import ResultStore

pytest.importorskip("pyarrow")
pytest.importorskip("av")
# What pyarrow and other libraries start are threads of their own, which a fork does not use.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
EVERY = {Episode(world.SUITE, task, episode) for task in (0, 1) for episode in range(5)}


def check_killed(folder: Path) -> None:
    """What has a verdict was recorded before, as it went."""
    done = world.verdicts(folder)
    recorded, filmed = world.recordings(folder), [*world.dataset(folder), *world.waiting(folder)]
    assert done.items() <= recorded.items()
    assert done.items() <= dict(filmed).items()
    assert len({key for key, _ in filmed}) == len(filmed)
    for key in done:
        assert (folder / "videos" / f"{world.SUITE}_{key.task}_{key.episode}.mp4").stat().st_size > 0


def check_finished(folder: Path) -> None:
    """Every episode once, everywhere, as it went."""
    done = world.verdicts(folder)
    assert set(done) == EVERY
    assert world.recordings(folder) == done
    assert sorted(world.dataset(folder)) == sorted(done.items())
    assert not (folder / "lerobot" / ".pending").exists()
    assert not (folder / "lerobot" / ".partial").exists()
    assert list(folder.rglob("*.tmp")) == []


def survive(folder: Path, store: str, events: list[int]) -> None:
    """Kill a run at each of these moments, one after the other, then let it finish."""
    for event in events:
        killed = world.run_until(folder, event, store=store)
        if folder.exists():
            check_killed(folder)
        if not killed:
            break
    assert world.run(folder, store=store).ok
    check_finished(folder)
    assert len(ResultStore.open(folder).records()) == len(EVERY)


@pytest.mark.parametrize("flush", [2, 100])
@pytest.mark.parametrize("store", STORE_CHOICES)
def test_kills_cost_no_recording_and_leave_none_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: str, flush: int
) -> None:
    monkeypatch.setattr(lerobot, "FLUSH", flush)
    chance = random.Random(f"{store} {flush}")
    survive(tmp_path / "run", store, [chance.randint(60, 260) for _ in range(3)])


@pytest.mark.heavy
@pytest.mark.parametrize("flush", [2, 100])
@pytest.mark.parametrize("store", STORE_CHOICES)
def test_many_kills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: str, flush: int) -> None:
    monkeypatch.setattr(lerobot, "FLUSH", flush)
    for number in range(15):
        chance = random.Random(f"{store} {flush} {number}")
        survive(tmp_path / str(number), store, [chance.randint(1, 600) for _ in range(chance.randint(1, 4))])


def test_what_is_recorded_while_nothing_is_killed(tmp_path: Path) -> None:
    assert world.run(tmp_path / "run").ok
    check_finished(tmp_path / "run")
    before = world.dataset(tmp_path / "run")
    assert world.run(tmp_path / "run").ok  # nothing is left to run
    assert world.dataset(tmp_path / "run") == before
