"""The picture of README.md: the start of a task as LIBERO was published, and as the installed MuJoCo draws it.

    python scripts/published_picture.py [SUITE/TASK]

Both halves are drawn by vecenv from one state, upright and not mirrored (those that policies get are turned left to
right); docs/as_published.md has images of upstream's code under MuJoCo 3.3.0 beside such ones. Writes
docs/as_published/colours.jpg.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
from vecenv_eval.video.grid import render_grid

import vecenv

PICTURE = Path(__file__).resolve().parent.parent / "docs" / "as_published" / "colours.jpg"
SIDE, BORDER = 384, 3
TITLES = {
    "published": "as published: MuJoCo up to 3.3.2, and vecenv on any",
    "current": f"drawn by MuJoCo {mujoco.__version__} from the same files",
}


def image(suite: str, task: int, colors: str) -> np.ndarray:
    """The third-person camera's image of episode 0 of a task, uint8 [H, W, 3]."""
    render = vecenv.RenderConfig(height=SIDE, width=SIDE, colors=colors)
    with vecenv.make(suite, task=task, episodes=[0], cameras=["agentview"], render=render, num_threads=1) as env:
        env.reset()
        return env.observe_egocentric().images["agentview"][0][:, ::-1]


def main() -> None:
    """Draw the picture."""
    from PIL import Image

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", metavar="SUITE/TASK", default="libero_object/0")
    suite, task = parser.parse_args().task.rsplit("/", 1)
    images = np.stack([image(suite, int(task), colors) for colors in TITLES])
    picture = render_grid(images, list(TITLES.values()), columns=2, border=BORDER)
    PICTURE.parent.mkdir(exist_ok=True)
    Image.fromarray(picture).save(PICTURE, quality=85, optimize=True)
    print(f"{PICTURE}: {picture.shape[1]} x {picture.shape[0]} pixels, {PICTURE.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
