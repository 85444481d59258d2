"""Images against upstream's own under the MuJoCo that LIBERO was published with: the table of docs/rendering.md.

    python benchmarks/images.py --peer .venv-upstream/bin/python [--scenes libero_goal-0 ...] [--rays all]

The peer's Python writes upstream's images and the states they show to a folder (``benchmarks/images_peer.py``, once);
the same states, fixtures in the same places, are then shown by vecenv, and each image is compared. A scene's number
is its worst image's: three moments (of rays two), two cameras. ``exact`` and ``fast`` are levels of detail in GL; ``rays`` is
``engine="raytrace"``, which takes a minute a scene on a CPU and by default is run in one scene of each workspace;
``current`` is what the installed MuJoCo shows, for comparison.
"""

from __future__ import annotations

import argparse
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import ROOT, report
from images_peer import CAMERAS, MOMENTS
from pictures import psnr

import vecenv
from vecenv.contract import Egocentric
from vecenv.libero import suites
from vecenv.libero.bddl import SceneKey
from vecenv.libero.env import LiberoEnv
from vecenv.render.gl import choose
from vecenv.render.options import RenderConfig

PUBLISHED = "3.3.0"
REFERENCES = ROOT / "build" / "upstream_images"
# Rays are not compared in the last one: they draw no sky, which is what an arm somewhere else may look at.
RAY_MOMENTS = MOMENTS[:2]
# What the project promises of every image, dB.
ENOUGH = {"exact": 40.0, "fast": 32.0, "rays": 24.0}
RENDER = {
    "exact": RenderConfig(lod="exact"),
    "fast": RenderConfig(lod="fast"),
    "rays": RenderConfig(lod="fast", engine="raytrace"),
    "current": RenderConfig(lod="exact", colors="current"),
}


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Upstream's images of one scene.

    Attributes:
        images: uint8 [moments, cameras, 256, 256, 3]. qpos, qvel: [moments, n].
        fixtures: by name, position and orientation. episode: the start state.
    """

    images: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    fixtures: dict[str, tuple[np.ndarray, np.ndarray]]

    @classmethod
    def load(cls, path: Path) -> Reference:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        poses = zip(arrays["fixture_pos"], arrays["fixture_quat"], strict=True)
        fixtures = dict(zip(arrays["fixtures"].tolist(), poses, strict=True))
        return cls(images=arrays["images"], qpos=arrays["qpos"], qvel=arrays["qvel"], fixtures=fixtures)


def scenes() -> dict[str, str]:
    """The distinct scenes of all suites, LIBERO-PRO's too, by the first task of each: the name of its workspace."""
    found: dict[SceneKey, tuple[str, str]] = {}
    for suite in suites.list_suites():
        for task in suites.list_tasks(suite):
            problem = task.problem()
            found.setdefault(problem.scene_key(), (f"{suite}-{task.index}", problem.name))
    return dict(found.values())


def write_references(peer: Path, folder: Path, names: Sequence[str]) -> None:
    """Have the peer write the files that are not there; the GL is the one that vecenv draws with."""
    script = Path(__file__).with_name("images_peer.py")
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    command = [str(peer), str(script), "--out", str(folder), "--mujoco", PUBLISHED, *names]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": paths, "MUJOCO_GL": choose()})


@contextmanager
def environment(name: str, reference: Reference, render: RenderConfig) -> Iterator[LiberoEnv]:
    """An environment of a scene, its fixtures where upstream's stand."""
    suite, task = name.rsplit("-", 1)
    options: Any = {"fixtures": reference.fixtures, "start": "raw", "settle_steps": 0}
    env = vecenv.make(suite, task=int(task), episodes=[0], render=render, **options)
    assert isinstance(env, LiberoEnv)
    try:
        env.reset()
        yield env
    finally:
        env.close()


def images(name: str, reference: Reference, render: RenderConfig) -> np.ndarray:
    """The reference's images as vecenv draws them, uint8 [moments, cameras, 256, 256, 3]."""
    with environment(name, reference, render) as env:
        found = []
        for qpos, qvel in zip(reference.qpos, reference.qvel, strict=True):
            env.set_state(qpos=qpos[None], qvel=qvel[None])
            seen = env.observe_egocentric()
            assert isinstance(seen, Egocentric)
            found.append([seen.images[camera][0] for camera in CAMERAS])
    return np.array(found)


def agreement(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """PSNR of each image, dB, [moments, cameras]; equal ones count as 100."""
    pairs = zip(ours, theirs, strict=True)
    return np.array([[min(psnr(a, b), 100.0) for a, b in zip(x, y, strict=True)] for x, y in pairs])


def row(name: str, workspace: str, reference: Reference, kinds: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "scene": name,
        "workspace": workspace.removeprefix("libero_").removesuffix("_manipulation"),
    }
    for kind in RENDER:
        if kind in kinds:
            seen = agreement(images(name, reference, RENDER[kind]), reference.images)
            seen = seen[: len(RAY_MOMENTS)] if kind == "rays" else seen
            found[kind] = round(float(seen.min()), 1)
        else:
            found[kind] = None
    print(found, flush=True)
    return found


def first_of_each(workspaces: dict[str, str]) -> set[str]:
    """The first scene of each workspace."""
    first: dict[str, str] = {}
    for name, workspace in workspaces.items():
        first.setdefault(workspace, name)
    return set(first.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", type=Path, required=True, help=f"Python of a venv with mujoco {PUBLISHED} and LIBERO")
    parser.add_argument("--references", type=Path, default=REFERENCES, help="folder of upstream's images")
    parser.add_argument("--scenes", nargs="+", metavar="SUITE-TASK", help="which scenes; all of them by default")
    parser.add_argument("--rays", choices=("workspaces", "all", "none"), default="workspaces")
    parser.add_argument("--out", default="images", help="name of the result file")
    options = parser.parse_args()
    every = scenes()
    names = options.scenes or list(every)
    if unknown := [name for name in names if name not in every]:
        parser.error(f"no scene {unknown[0]!r}; there are {', '.join(every)}")
    write_references(options.peer, options.references, names)
    traced = {"all": set(names), "none": set(), "workspaces": first_of_each({name: every[name] for name in names})}
    rows = []
    for name in names:
        kinds = [kind for kind in RENDER if kind != "rays" or name in traced[options.rays]]
        rows.append(row(name, every[name], Reference.load(options.references / f"{name}.npz"), kinds))
    lowest = {
        kind: min((each[kind], each["scene"]) for each in rows if each[kind] is not None)
        for kind in RENDER
        if any(each[kind] is not None for each in rows)
    }
    moments = {"moments": MOMENTS, "ray_moments": RAY_MOMENTS}
    notes = {"upstream_mujoco": PUBLISHED, **moments, "unit": "dB, the scene's worst image", "lowest": lowest}
    report(options.out, rows, title=f"Images against upstream under MuJoCo {PUBLISHED}", notes=notes)
    if failed := {kind: lowest[kind] for kind in ENOUGH if kind in lowest and lowest[kind][0] < ENOUGH[kind]}:
        raise SystemExit(f"below what is promised: {failed}")


if __name__ == "__main__":
    main()
