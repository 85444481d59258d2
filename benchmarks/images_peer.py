"""Upstream's own images, with the states they show, written to a folder.

Run by the Python of a venv with the MuJoCo that LIBERO was published with (3.3.0); ``benchmarks/images.py`` starts it.
In: names of scenes. Out: ``{scene}.npz`` for each, with ``images`` uint8 [moments, cameras, size, size, 3] as VLA
evaluations deliver them (turned by 180 degrees), ``qpos`` and ``qvel`` of each moment, where the fixtures stand, and
``about``, what the images depend on. Scenes whose file is there and says the same are left alone.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

# An image of the start, one in motion, and one with every hinge and slide somewhere else.
MOMENTS = ("start", "moving", "shuffled")
CAMERAS = {"agentview": "agentview_image", "wrist": "robot0_eye_in_hand_image"}
TICKS = 10
FORMAT = 1


def about(episode: int, size: int, moments: int) -> dict[str, Any]:
    made = {"format": FORMAT, "mujoco": mujoco.__version__, "episode": episode, "size": size, "ticks": TICKS}
    return {**made, "moments": MOMENTS[:moments]}


def is_current(path: Path, wanted: dict[str, Any]) -> bool:
    if not path.exists():
        return False
    with np.load(path, allow_pickle=False) as file:
        return json.loads(str(file["about"])) == json.loads(json.dumps(wanted))


def record(suite: str, task: int, episode: int, size: int, moments: int) -> dict[str, np.ndarray]:
    """The arrays of one scene's file, without ``about``, of the first so many moments."""
    from support import upstream

    from vecenv.libero.tasks import suites

    spec = suites.list_tasks(suite)[task]
    rng = np.random.default_rng(task)
    peer = upstream.peer_with_images(spec.bddl_path, size)
    peer.seed(task)
    with upstream.silence():
        peer.reset()
    model, data = upstream.model_of(peer), upstream.data_of(peer)
    fixtures = upstream.fixtures_of(peer)
    peer.set_init_state(spec.init_states()[episode])
    states = [(data.qpos.copy(), data.qvel.copy())]
    for _ in range(TICKS):
        peer.step(upstream.random_action(rng))
    states.append((data.qpos.copy(), data.qvel.copy()))
    states.append((upstream.shuffled(model, data.qpos, rng), np.zeros_like(data.qvel)))
    states, images = states[:moments], []
    for qpos, qvel in states:
        seen = peer.set_init_state(np.concatenate([[0.0], qpos, qvel]))
        images.append([seen[key][::-1, ::-1] for key in CAMERAS.values()])
    peer.close()
    return {
        "images": np.array(images),
        "qpos": np.array([qpos for qpos, _ in states]),
        "qvel": np.array([qvel for _, qvel in states]),
        "fixtures": np.array(list(fixtures), dtype=str),
        "fixture_pos": np.array([pos for pos, _ in fixtures.values()]).reshape(-1, 3),
        "fixture_quat": np.array([quat for _, quat in fixtures.values()]).reshape(-1, 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Write upstream's own images.")
    parser.add_argument("--out", type=Path, required=True, help="folder that the files go to")
    parser.add_argument("--mujoco", required=True, help="the version this Python must have")
    parser.add_argument("--episode", type=int, default=0)
    parser.add_argument("--size", type=int, default=256, help="pixels a side")
    parser.add_argument("--moments", type=int, default=len(MOMENTS), help=f"how many of {', '.join(MOMENTS)}")
    parser.add_argument("scenes", nargs="+", help="suite-task")
    options = parser.parse_args()
    if mujoco.__version__ != options.mujoco:
        sys.exit(f"{sys.executable} has mujoco {mujoco.__version__}; the images are to be those of {options.mujoco}")
    options.out.mkdir(parents=True, exist_ok=True)
    wanted = about(options.episode, options.size, options.moments)
    for scene in options.scenes:
        path = options.out / f"{scene}.npz"
        if is_current(path, wanted):
            continue
        suite, task = scene.rsplit("-", 1)
        found = record(suite, int(task), options.episode, options.size, options.moments)
        part = path.with_suffix(".part.npz")
        found["about"] = np.array(json.dumps(wanted))
        np.savez_compressed(part, **found)  # type: ignore[arg-type]
        part.replace(path)
        print(f"{scene}: {path}", flush=True)


if __name__ == "__main__":
    main()
