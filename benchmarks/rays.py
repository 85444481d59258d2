"""Ray-traced images against GL's of the same states, in every scene of LIBERO: the table of docs/rendering.md.

    python benchmarks/rays.py [--scenes libero_10/3 ...] [--samples 2] [--references FOLDER]
    python benchmarks/rays.py --table

One episode at its start and after eight random actions, both cameras, 256 x 256. GL draws every triangle
(``lod="original"``), rays meet those of the sceneries' default, ``"fast"``; both with ``colors="current"``. A row has
the lower PSNR of each camera's two images, without and with antialiasing, and the instance of 500 pixels or more whose
mask overlaps least in one image.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from common import RESULTS, ROOT, fill_table, report
from support.images import psnr

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.render.options import POLICY_CAMERAS, RenderConfig
from vecenv.libero.render.raytrace import RayTracer, poses
from vecenv.libero.render.scenery import installed_scenery
from vecenv.libero.scene.bddl import SceneKey
from vecenv.libero.tasks import suites
from vecenv.observations import Egocentric

SIZE, ACTIONS = 256, 8
# At the edge of a thing of fewer pixels, one pixel is much.
LEAST_PIXELS = 500


def scenes() -> list[str]:
    """``suite/task`` of the first task of each scene of LIBERO's five suites."""
    found: dict[SceneKey, str] = {}
    for suite in suites.BASE_SUITES:
        for task in suites.list_tasks(suite):
            found.setdefault(task.problem().scene_key(), f"{suite}/{task.index}")
    return list(found.values())


def reference(scene: str) -> dict[str, np.ndarray]:
    """Two states of a scene: the poses of its bodies, its joints, and what GL's cameras show."""
    suite, task = scene.rsplit("/", 1)
    render = RenderConfig(height=SIZE, width=SIZE, lod="original", colors="current")
    env = vecenv.make(suite, task=int(task), episodes=[0], render=render)
    assert isinstance(env, LiberoEnv)
    env.reset()
    found = [snapshot(env)]
    for action in np.random.default_rng(int(task)).uniform(-1, 1, (ACTIONS, 1, 7)):
        env.step_continuous(action)
    found.append(snapshot(env))
    names = np.array(env.observe_egocentric().instances[0])
    env.close()
    return {"names": names, **{key: np.concatenate([each[key] for each in found]) for key in found[0]}}


def snapshot(env: LiberoEnv) -> dict[str, np.ndarray]:
    """The only slot's state and its images, each with a leading axis of 1."""
    seen, (group,) = env.observe_egocentric(), env.physics.groups
    assert isinstance(seen, Egocentric)
    qpos = group.seen_qpos
    xpos, xquat = poses(group.scene.model, qpos, group.expand("body_pos"), group.expand("body_quat"))
    return {
        "xpos": xpos,
        "xquat": xquat,
        "qpos": qpos.astype(np.float32),
        "rgb": np.stack([seen.images[camera] for camera in POLICY_CAMERAS], axis=1),
        "segmentation": np.stack([seen.segmentations[camera] for camera in POLICY_CAMERAS], axis=1),
    }


def kept_reference(scene: str, folder: Path | None) -> dict[str, np.ndarray]:
    """``reference``, from a file of the folder if it is there, or written to one."""
    path = folder / f"{scene.replace('/', '_')}.npz" if folder else None
    if path is None:
        return reference(scene)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, Any] = reference(scene)
        np.savez_compressed(path, **arrays)
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def row(scene: str, folder: Path | None, samples: int) -> dict[str, Any]:
    """What the rays of a scene show, compared with GL."""
    suite, task = scene.rsplit("/", 1)
    drawn = kept_reference(scene, folder)
    scenery = installed_scenery(suites.list_tasks(suite)[int(task)].problem(), colors="current")
    begun = time.process_time()
    found: dict[str, Any] = {"scene": scene}
    masks = np.zeros(0)
    for antialias, note in ((False, ""), (True, " antialiased")):
        options = {"samples": samples, "antialias": antialias}
        tracer = RayTracer(scenery, height=SIZE, width=SIZE, segmentation=True, **options)
        seen = jax.jit(jax.vmap(tracer.look))(drawn["xpos"], drawn["xquat"], drawn["qpos"])
        rgb, masks = np.asarray(seen.rgb), np.asarray(seen.segmentation)
        for camera, name in enumerate(POLICY_CAMERAS):
            pairs = zip(rgb[:, camera], drawn["rgb"][:, camera], strict=True)
            found[f"{name}{note}, dB"] = round(min(psnr(a, b) for a, b in pairs), 1)
    overlap, instance = least_overlap(masks, drawn["segmentation"])
    found |= {"lowest IoU": f"{overlap:.3f} {drawn['names'][instance]}"}
    print(found, f"{time.process_time() - begun:.0f} s of CPU time, compilation included", flush=True)
    return found


def least_overlap(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, int]:
    """The lowest IoU of an instance's mask in an image, and the instance."""
    found = []
    for a, b in zip(ours.reshape(-1, SIZE, SIZE), theirs.reshape(-1, SIZE, SIZE), strict=True):
        for instance in np.flatnonzero(np.bincount(b.ravel()) >= LEAST_PIXELS):
            one, other = a == instance, b == instance
            found.append((float((one & other).sum() / (one | other).sum()), int(instance)))
    return min(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", metavar="SUITE/TASK", help="which scenes; all of them by default")
    parser.add_argument("--samples", type=int, default=1, help="rays a pixel along each side")
    parser.add_argument("--references", type=Path, help="folder to keep GL's images in, and to read them from")
    parser.add_argument("--out", default="rays", help="name of the result file")
    parser.add_argument("--table", action="store_true", help="put the rows of the result file into docs/rendering.md")
    chosen = parser.parse_args()
    if chosen.table:
        print(fill_table("rays", RESULTS / f"{chosen.out}.json", ROOT / "docs" / "rendering.md"))
        return
    every = scenes()
    names = chosen.scenes or every
    if unknown := [name for name in names if name not in every]:
        parser.error(f"no scene {unknown[0]!r}; there are {', '.join(every)}")
    rows = [row(name, chosen.references, chosen.samples) for name in names]
    columns = [name for name in rows[0] if name.endswith("dB")]
    lowest = {column: min((each[column], each["scene"]) for each in rows) for column in columns}
    report(chosen.out, rows, title="Rays against GL", notes={"samples": chosen.samples, "size": SIZE, "lowest": lowest})


if __name__ == "__main__":
    main()
