"""Record the rollouts of upstream under MuJoCo 3.3.0 that ``tests/libero/physics/test_parity.py`` rests on.

    make upstream && python scripts/record_rollouts.py

They are few and short: idle starts of scenes in which current contacts throw or shift objects, and random actions in
which the arm touches boxes, meshes and fixtures.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "tests" / "data" / "rollouts_mujoco_3_3_0.npz"


def main() -> None:
    """Record them."""
    sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT)]
    from peer import Job, rollouts

    python = sys.argv[1] if len(sys.argv) > 1 else ROOT / ".venv-upstream" / "bin" / "python"
    jobs = [
        Job(suite="libero_spatial", task=5, episode=0, actions="idle", ticks=30),
        Job(suite="libero_10", task=0, episode=0, actions="idle", ticks=20),
        Job(suite="libero_object", task=0, episode=2, ticks=50),
        Job(suite="libero_goal", task=9, episode=13, ticks=45),
        Job(suite="libero_10", task=2, episode=16, ticks=60),
        Job(suite="libero_10", task=9, episode=30, ticks=40),
    ]
    arrays = {"jobs": np.array(json.dumps([asdict(job) for job in jobs]))}
    kept = ("fixtures", "fixture_pos", "fixture_quat", "actions", "qpos", "success", "touched", "mujoco")
    for number, rollout in enumerate(rollouts(jobs, python)):
        arrays |= {f"{number}/{name}": getattr(rollout, name) for name in kept}
    np.savez_compressed(OUT, **arrays)  # type: ignore[arg-type]
    print(
        f"{len(jobs)} rollouts under MuJoCo {arrays['0/mujoco']}: {OUT.relative_to(ROOT)}, {OUT.stat().st_size} bytes"
    )


if __name__ == "__main__":
    main()
