"""Whether memory, file handles and threads of a process stay as they are while it works for long.

Two parts, each for half of the time. ``evaluation``: one evaluation after the other, each with an environment of its
own, slots that are filled again when their episode ends, and a camera image of every slot read at every tick. Each is
interrupted on the way, as by Ctrl-C, and resumed from its folder.
``batch``: one environment whose episodes run to their budget, started again and again, with random actions. A row is
what the process holds at one moment; the last lines have the most that it held in each third of a part.

    python benchmarks/soak.py --minutes 60
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from common import report
from vecenv_eval.config import EvalConfig
from vecenv_eval.policies.random import RandomPolicy
from vecenv_eval.results import Progress
from vecenv_eval.runner import evaluate

import vecenv
from vecenv.contract import BatchEnv

MIB = 2**20
SUITE = "libero_object"
HELD = ("rss_mib", "handles", "threads")


class LookingPolicy(RandomPolicy):
    """Random actions of a policy that reads a camera image at every tick."""

    name = "looking"

    def act(self, env: BatchEnv) -> np.ndarray:
        """The next action of every slot, [B, 7]."""
        image = env.observe_egocentric().images["agentview"]
        assert image.any()
        return super().act(env)


class Meter:
    """Notes what this process holds every few seconds, on a thread of its own.

    Args:
        every: seconds between two rows.
    """

    def __init__(self, every: float) -> None:
        self.rows: list[dict[str, Any]] = []
        self.part, self.episodes, self.ticks = "", 0, 0
        self._process, self._began, self._every = psutil.Process(), time.monotonic(), every
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Meter:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def note(self) -> None:
        """Add a row."""
        with self._process.oneshot():
            self.rows.append(
                {
                    "part": self.part,
                    "minutes": round((time.monotonic() - self._began) / 60, 2),
                    "rss_mib": round(self._process.memory_info().rss / MIB, 1),
                    "handles": self._process.num_fds(),
                    "threads": self._process.num_threads(),
                    "children": len(self._process.children(recursive=True)),
                    "episodes": self.episodes,
                    "ticks": self.ticks,
                }
            )

    def _run(self) -> None:
        while not self._over.wait(self._every):
            self.note()


class Interruption:
    """Presses Ctrl-C once so many episodes have ended.

    Args:
        after: how many.
    """

    def __init__(self, after: int) -> None:
        self._after = after

    def __call__(self, progress: Progress) -> None:
        """Look at how far the evaluation is."""
        if progress.done >= self._after:
            raise KeyboardInterrupt


def evaluations(meter: Meter, until: float, *, tasks: str, slots: int, budget: int, size: int) -> None:
    """Evaluate, again and again, with refills and images; each evaluation in two goes."""
    config = EvalConfig(
        suite=SUITE,
        tasks=tasks,
        episodes=str(slots + 1),
        policy="soak:LookingPolicy",
        max_steps=budget,
        num_envs=slots,
        image_size=size,
    )
    while time.monotonic() < until:
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            assert evaluate(config, run, on_progress=Interruption(slots)).interrupted
            result = evaluate(config, run)
            assert result.ok
        meter.episodes += len(result.records)
        meter.ticks += sum(record.num_steps for record in result.records)


def batch(meter: Meter, until: float, *, slots: int, budget: int) -> None:
    """Episodes of one large batch."""
    rng = np.random.default_rng(0)
    options: dict[str, Any] = {"success": "final", "max_steps": budget}
    with vecenv.make(SUITE, task=0, episodes=[episode % 50 for episode in range(slots)], **options) as env:
        while time.monotonic() < until:
            env.reset()
            while time.monotonic() < until and not env.done.all():
                meter.ticks += int(env.step_continuous(rng.uniform(-1, 1, (slots, 5, 7))).info["ticks"].sum())
            meter.episodes += int(env.done.sum())


def peaks(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """By part: the most that there was of everything in each third of its time."""
    found: dict[str, Any] = {}
    for part in dict.fromkeys(row["part"] for row in rows):
        own = [row for row in rows if row["part"] == part]
        thirds = np.array_split(np.arange(len(own)), 3)
        found[part] = {name: [max(own[k][name] for k in third) for third in thirds] for name in HELD}
    return found


def main() -> None:
    """Run both parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="how long, both parts together")
    parser.add_argument("--slots", type=int, default=512, help="slots of the batch")
    parser.add_argument("--ticks", type=int, default=2500, help="budget of its episodes")
    parser.add_argument("--tasks", default="0-1", help="tasks of the evaluations; each compiles a scene to draw")
    parser.add_argument("--eval-slots", type=int, default=4, help="slots of the evaluations")
    parser.add_argument("--eval-ticks", type=int, default=40, help="budget of their episodes")
    parser.add_argument("--size", type=int, default=128, help="height and width of images, pixels")
    parser.add_argument("--every", type=float, default=10.0, help="seconds between two rows")
    given = parser.parse_args()
    with Meter(given.every) as meter:
        half = given.minutes * 30
        meter.part = "evaluation"
        evaluations(
            meter,
            time.monotonic() + half,
            tasks=given.tasks,
            slots=given.eval_slots,
            budget=given.eval_ticks,
            size=given.size,
        )
        meter.note()
        meter.part = "batch"
        batch(meter, time.monotonic() + half, slots=given.slots, budget=given.ticks)
        meter.note()
    notes = {"peaks": peaks(meter.rows)}
    report("soak", meter.rows, title="What a process holds over time", notes=notes)
    for part, most in notes["peaks"].items():
        print(f"{part}: most in each third: " + ", ".join(f"{name} {values}" for name, values in most.items()))


if __name__ == "__main__":
    main()
