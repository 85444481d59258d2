"""What ``vecenv eval --live`` costs: CPU time of the frames of a run, beside that of the whole process.

One run of ``libero_goal`` task 0 with a policy that looks at no image, so that nobody else has made a renderer: the
first frame makes it. Seconds of the process's CPU time, all threads.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from common import report
from vecenv_eval.config import EvalConfig
from vecenv_eval.live import LivePublisher
from vecenv_eval.runner import evaluate


def measure(slots: int, ticks: int) -> dict[str, object]:
    """One run; every frame is timed."""
    costs: list[float] = []
    make = LivePublisher._make_frame

    def timed(self: LivePublisher, live: Sequence[int]) -> None:
        began = time.process_time()
        make(self, live)
        costs.append(time.process_time() - began)

    LivePublisher._make_frame = timed
    config = EvalConfig(
        suite="libero_goal",
        policy="zero",
        tasks="0",
        episodes=str(slots),
        max_steps=ticks,
        num_threads=1,
        image_size=128,
        live=True,
    )
    began = time.process_time()
    try:
        with tempfile.TemporaryDirectory() as folder:
            evaluate(config, Path(folder) / "run")
    finally:
        LivePublisher._make_frame = make
    whole, rest = time.process_time() - began, sum(costs[1:])
    return {
        "slots": slots,
        "ticks": ticks,
        "frames": len(costs),
        "first frame": round(costs[0], 2),
        "other frames": round(rest, 2),
        "process": round(whole, 2),
        "share of the others": round(rest / (whole - costs[0]), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slots", type=int, default=16)
    parser.add_argument("--ticks", type=int, default=600)
    arguments = parser.parse_args()
    rows = [measure(arguments.slots, arguments.ticks)]
    report("live_images", rows, title="vecenv eval --live: CPU seconds of the process")


if __name__ == "__main__":
    main()
