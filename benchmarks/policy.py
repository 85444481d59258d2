"""How often the built-in `pick_place` policy solves each suite, with Wilson 95 % intervals and mean ticks."""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from common import report
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import begin
from vecenv_eval.runner import evaluate

from vecenv.libero.tasks.suites import BASE_SUITES

EPISODES = {"libero_object": "all", "libero_90": "2"}
MAX_STEPS = 800


def main() -> None:
    """Evaluate the suites asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suites", nargs="*", default=list(BASE_SUITES))
    rows = []
    for suite in parser.parse_args().suites:
        config = EvalConfig(suite=suite, episodes=EPISODES.get(suite, "10"), max_steps=MAX_STEPS)
        with TemporaryDirectory() as folder:
            result = evaluate(config, begin(config, Path(folder) / "results"))
        total = result.summary.total
        rows.append(
            {
                "suite": suite,
                "solved": f"{total.successes}/{total.episodes}",
                "rate": round(total.rate or 0.0, 3),
                "95 % interval": f"{total.low:.3f} to {total.high:.3f}",
                "mean ticks when solved": round(total.steps_to_solve or 0.0),
            }
        )
        print(rows[-1], flush=True)
    report("policy", rows, title=f"pick_place, native backend, settled starts, at most {MAX_STEPS} ticks")


if __name__ == "__main__":
    main()
