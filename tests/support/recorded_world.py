"""A fake suite whose episodes can be recorded and filmed, a policy that never does the same twice, and killed runs.

The moment of a kill is chosen.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from vecenv_eval.config import EvalConfig
from vecenv_eval.episodes import Episode
from vecenv_eval.results import EvalResult, open_or_begin
from vecenv_eval.runner import evaluate
from vecenv_eval.store import ResultStore

from support.fakes import SUITE, FakeEnv, FakeWorld
from vecenv.contract import BatchEnv, ResetInfo, State
from vecenv.observations import Egocentric

SIZE = 16


class RecordedEnv(FakeEnv):
    """Ticks can be watched; there is a state, and one camera whose shade is the tick."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._watchers: list[Callable[[np.ndarray, np.ndarray], None]] = []

    @contextmanager
    def watched(self, watcher: Callable[[np.ndarray, np.ndarray], None]) -> Iterator[None]:
        self._watchers.append(watcher)
        yield
        self._watchers.remove(watcher)

    def _tick(self) -> None:
        for watcher in self._watchers:
            watcher(self.actions[-1], ~(self.terminated | self.truncated))
        super()._tick()

    def state(self) -> State:
        ticks, one = self.ticks[:, None].astype(float), np.ones(self.num_envs, int)
        return State(qpos=ticks, qvel=-ticks, time=ticks[:, 0] / 20, nq=one, nv=one)

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        shades = np.broadcast_to((20 * self.ticks)[:, None, None, None], (self.num_envs, SIZE, SIZE, 3))
        return Egocentric(
            state=np.repeat(self.ticks[:, None], 8, axis=1).astype(np.float32),
            images={"agentview": shades.astype(np.uint8)},
        )


class RecordedWorld(FakeWorld):
    """The fake suite of such environments."""

    def make(self, suite: str, *, tasks: Any, episodes: Any, max_steps: int = 5, seed: int = 0, **_: Any) -> FakeEnv:
        return RecordedEnv(tasks, episodes, max_steps=max_steps)


class UnlikelyPolicy:
    """Every episode has one random number as its action, which it reports: no second run of an episode is like it."""

    name = "unlikely"

    def __init__(self) -> None:
        self._actions = np.zeros((0, 7))

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self._actions = np.zeros((env.num_envs, 7))
        self.reset_slots(env, info, np.arange(env.num_envs))

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        for slot in slots.tolist():
            self._actions[slot] = int.from_bytes(os.urandom(2), "big") / 2**16

    def act(self, env: BatchEnv) -> np.ndarray:
        return self._actions

    def extras(self, slot: int) -> dict[str, float]:
        return {"action": float(self._actions[slot, 0])}


def config(store: str = "jsonl", **settings: Any) -> EvalConfig:
    """Two tasks of five episodes, recorded in every way."""
    recorded = {"record_states": True, "record_lerobot": True, "video": "all", "num_envs": 3, "tasks": "0-1"}
    name = f"{UnlikelyPolicy.__module__}:{UnlikelyPolicy.__name__}"
    return EvalConfig(suite=SUITE, policy=name, store=store, **{**recorded, **settings})


def run(folder: Path, **settings: Any) -> EvalResult:
    """The evaluation, begun or continued."""
    wanted = config(**settings)
    return evaluate(wanted, open_or_begin(wanted, folder), simulator=RecordedWorld().simulator)


def run_until(folder: Path, event: int, **settings: Any) -> bool:
    """The evaluation in a fork that kills itself at the so-manieth thing it does to files in the folder.

    Returns:
        Whether it was killed; False if it came to its end before.
    """
    pid = os.fork()
    if pid:
        _, status = os.waitpid(pid, 0)
        assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, status
        return os.WIFSIGNALED(status)
    left = event

    def watch(name: str, arguments: tuple[Any, ...]) -> None:
        nonlocal left
        if name in _EVENTS and any(
            str(folder) in os.fsdecode(a) for a in arguments if isinstance(a, str | bytes | Path)
        ):
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)
    try:
        os._exit(0 if run(folder, **settings).ok else 1)
    except BaseException:
        import traceback

        traceback.print_exc()
        os._exit(2)


# What Python tells of before it does it: files made, renamed, linked and removed. Half of a write is `cut_last_line`'s.
_EVENTS = frozenset(
    {"open", "os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "sqlite3.connect"}
)


def verdicts(folder: Path) -> dict[Episode, float]:
    """The episodes with a verdict, and the action that each reported."""
    if not (folder / "config.json").is_file():
        return {}
    return {key: r.extras["action"] for key, r in ResultStore.open(folder).records().items() if not r.error}


def recordings(folder: Path) -> dict[Episode, float]:
    """The episodes in HDF5 files, and their actions."""
    found = {}
    for path in sorted((folder / "demos").glob("*.hdf5")):
        with h5py.File(path) as file:
            data: Any = file["data"]
            for demo in data.values():
                key = Episode(SUITE, int(data.attrs["task"]), int(demo.attrs["episode"]))
                assert key not in found
                assert len(demo["states"]) == len(demo["actions"]) == demo.attrs["num_samples"]
                found[key] = float(demo["actions"][0, 0])
    return found


def dataset(folder: Path) -> list[tuple[Episode, float]]:
    """The episodes of the LeRobot dataset in the order of its frames, and their actions; checks that it is whole."""
    import av
    import pyarrow.parquet as pq
    from vecenv_eval.datasets import files

    root = folder / "lerobot"
    if not (root / files.INFO).is_file():
        return []
    there, found = files.read(root), []
    frames = [row for path in sorted(root.glob("data/*/*.parquet")) for row in pq.read_table(path).to_pylist()]
    frames = [row for row in frames if row["episode_index"] < len(there.rows)]
    assert [row["index"] for row in frames] == list(range(there.info["total_frames"]))
    assert int(there.stats["index"]["count"][0]) == len(frames)
    for number, row in enumerate(there.rows):
        own = [each for each in frames if each["episode_index"] == number]
        assert len(own) == row["length"] == row["dataset_to_index"] - row["dataset_from_index"]
        assert [each["frame_index"] for each in own] == list(range(len(own)))
        found.append((files.key_of(row), round(own[0]["action"][0] * 2**16) / 2**16))
        with av.open(str(root / files.VIDEO.format(0, number, key="observation.images.image"))) as video:
            assert len(list(video.decode(video=0))) == len(own)
    return found


def waiting(folder: Path) -> list[tuple[Episode, float]]:
    """The episodes that wait for the LeRobot dataset's files, and their actions."""
    from vecenv_eval.datasets import files
    from vecenv_eval.datasets import waiting as pending

    root = folder / "lerobot"
    total = files.read(root).info.get("total_episodes", 0) if root.exists() else 0
    each = [pending.load(path) for path in pending.folders(root) if int(path.name) >= total]
    return [(one.key, round(float(one.columns["action"][0, 0]) * 2**16) / 2**16) for one in each]
