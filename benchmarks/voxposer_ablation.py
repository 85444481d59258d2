"""What VoxPoser's success rests on: the same episodes with one part replaced at a time.

    python benchmarks/voxposer_ablation.py
    python benchmarks/voxposer_ablation.py --suites libero_object --tasks 0-9 --episodes 0-2 --variants map,straight

Each variant (``voxposer_variants.VARIANTS``) is a setting of public config fields. A row is a variant on a suite: how
many episodes it solved, with a 95 % Wilson interval, and mean control steps. Every episode is stored as it ends in the
folder ``--work``; the same command continues where it was stopped, and ``--report`` writes the rows of what is there.
Ground truth of the simulator is used in every variant but ``camera``; the column "privileged" says for what.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import ROOT, report
from vecenv_eval.config import EvalConfig
from vecenv_eval.report import wilson
from vecenv_eval.results import begin, resume
from vecenv_eval.runner import evaluate
from vecenv_eval.store import Record, ResultStore
from voxposer_variants import VARIANTS

SUITES = ("libero_object", "libero_spatial", "libero_goal", "libero_10")
# What a variant reads of the simulator beyond images and joints.
POSES, FIELDS = "poses and surfaces", "grasps and places"
PRIVILEGES = {"centroid": POSES, "camera": "names of pixels"}


def main() -> None:
    """Run the variants on the suites, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suites", default=",".join(SUITES))
    parser.add_argument("--tasks", default="all")
    parser.add_argument("--episodes", default="0-9")
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--num-envs", type=int, default=30)
    parser.add_argument("--work", type=Path, default=ROOT / "results" / "voxposer_ablation")
    parser.add_argument("--report", action="store_true", help="run nothing; report what the folder has")
    options = parser.parse_args()
    unknown = [name for name in options.variants.split(",") if name not in VARIANTS]
    if unknown:
        parser.error(f"no variant {unknown[0]!r}; there are {', '.join(VARIANTS)}")
    rows = []
    for suite in options.suites.split(","):
        for variant in options.variants.split(","):
            row = run(suite, variant, options)
            if row:
                rows.append(row)
                write(rows)
    if not rows:
        raise SystemExit(f"{options.work}: no episodes of these variants yet")


def write(rows: list[dict[str, Any]]) -> None:
    """The table and the results file."""
    about = {name: variant.about for name, variant in VARIANTS.items()}
    notes = {"privileged": PRIVILEGED, "variants": about}
    report("voxposer_ablation", rows, title="VoxPoser (offline/libero), one part replaced at a time", notes=notes)


PRIVILEGED = (
    "All variants but 'camera' read ground truth of the simulator: names, poses and surface points of objects and "
    "parts. All of them but 'centroid' also use grasps and places computed on it. Programs are written by rules, not "
    "by a language model."
)


def run(suite: str, variant: str, options: argparse.Namespace) -> dict[str, Any] | None:
    """One row: a variant on a suite, continued if it was begun; None for no episodes."""
    folder = options.work / suite / variant
    begun = (folder / "config.json").is_file()
    if options.report:
        records = tuple(ResultStore.open(folder).records().values()) if begun else ()
    else:
        asked = {"tasks": options.tasks, "episodes": options.episodes, "num_envs": options.num_envs}
        policy = {"policy": "voxposer", "policy_args": dict(VARIANTS[variant].options)}
        config = EvalConfig(suite=suite, **policy, **asked)
        config, store = resume(folder, **asked) if begun else (config, begin(config, folder))
        records = evaluate(config, store).records
    return row_of(suite, variant, records) if records else None


def row_of(suite: str, variant: str, records: Sequence[Record]) -> dict[str, Any]:
    """The row of a variant's records."""
    solved = sum(record.success for record in records)
    low, high = wilson(solved, len(records))
    return {
        "suite": suite,
        "variant": variant,
        "privileged": PRIVILEGES.get(variant, f"{POSES}, {FIELDS}"),
        "episodes": len(records),
        "solved": solved,
        "rate": round(solved / len(records), 3),
        "95 %": f"{low:.2f}-{high:.2f}",
        "steps": round(sum(record.num_steps for record in records) / len(records)),
    }


if __name__ == "__main__":
    main()
