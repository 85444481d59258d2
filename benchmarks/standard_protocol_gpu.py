"""LIBERO's standard protocol whole on GPUs: 2,000 episodes with images, from the command to the table, in seconds.

``vecenv eval --backend warp --engine ray``: four suites, ten tasks, 50 episodes each, openpi's horizons; a policy that
answers at once with five actions and looks at both cameras (256 x 256) first. No episode is solved, so all take their
whole number of ticks; a run that has other ones fails. Several actors share a GPU: the worlds of one scene, 50 in most
suites, do not fill it. Nothing else may use the GPUs meanwhile.

The first run of a machine fills the caches of compiled programs; ``--runs`` says how many are made, and a row is
written for each. ``--scenes`` is a folder that ``vecenv compile --images rays`` wrote.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from common import ROOT, report
from standard_protocol import EPISODES, PROTOCOL, SUITES, TASKS


def main() -> None:
    """Measure what the command line asks for."""
    options = _parse()
    rows: list[dict[str, Any]] = []
    for geometry in options.geometry:
        for run in range(options.runs):
            row = {"geometry": geometry, "GPUs": options.gpus, "actors": options.actors, "run": run + 1}
            rows.append(row | measure(geometry, options))
            print(rows[-1], flush=True)
            report(options.name, rows, title="LIBERO's standard protocol on GPUs", notes={"suites": options.suites})


def measure(geometry: str, options: argparse.Namespace) -> dict[str, Any]:
    """One run of the command."""
    render = {"engine": "raytrace", "lod": "fast"}
    arguments = {
        "--suite": [",".join(options.suites)],
        "--protocol": [PROTOCOL.name],
        "--backend": ["warp"],
        "--policy": ["standard_protocol:Instant"],
        "--policy-arg": ["images=true"],
        "--cameras": ["agentview,wrist"],
        "--env-arg": [f"geometry={geometry}", f"render={json.dumps(render)}"],
        "--engine": ["ray"],
        "--engine-arg": [
            f"actors={options.actors}",
            f"gpus={options.gpus / options.actors:.4g}",
            f"unit={options.unit}",
        ],
    }
    if options.scenes:
        arguments["--env-arg"].append(f"scenes={options.scenes}")
    command = [sys.executable, "-c", "from vecenv.cli import main; main()", "eval"]
    command += [text for name, values in arguments.items() for value in values for text in (name, value)]
    paths = [
        str(ROOT),
        str(ROOT / "eval"),
        str(ROOT / "benchmarks"),
        *os.environ.get("PYTHONPATH", "").split(os.pathsep),
    ]
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        done = subprocess.run(
            [*command, "--out", f"{folder}/run"],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        )
        seconds = time.perf_counter() - started
        if done.returncode:
            raise RuntimeError(f"{command[3:]} failed:\n{(done.stdout + done.stderr)[-3000:]}\n{_errors(Path(folder))}")
        ticks = _ticks(Path(folder))
    print(done.stdout[-2000:], flush=True)
    return {
        "s": round(seconds, 1),
        "episodes": len(options.suites) * TASKS * EPISODES,
        "steps/s": round(ticks / seconds),
    }


def _errors(folder: Path) -> str:
    """What the logs of the runs say about errors, the last of each."""
    logs = [f"{path.relative_to(folder)}: {path.read_text()[-1500:]}" for path in folder.rglob("errors.log")]
    return "\n".join(logs)


def _ticks(folder: Path) -> int:
    """Control steps of all episodes; each must have taken its suite's horizon."""
    rows = [json.loads(line) for path in folder.rglob("episodes*.jsonl") for line in path.read_text().splitlines()]
    wrong = [row for row in rows if row["num_steps"] != PROTOCOL.horizon_of(row["suite"]) or row.get("fault")]
    if wrong:
        raise RuntimeError(f"{len(wrong)} of {len(rows)} episodes ended early or failed: {wrong[0]}")
    return sum(row["num_steps"] for row in rows)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--suites", nargs="+", choices=SUITES, default=SUITES)
    parser.add_argument("--geometry", nargs="+", default=["exact"])
    parser.add_argument("--gpus", type=int, default=1)
    parser.add_argument("--actors", type=int, default=6, help="on all GPUs together")
    parser.add_argument("--unit", type=int, default=250, help="most episodes that an actor takes at once")
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--scenes", help="folder that `vecenv compile` wrote")
    parser.add_argument("--name", default="standard_protocol_gpu", help="name of the results file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
