"""Images of docs/suites.md: the first start of every LIBERO task, one small JPEG each.

    python scripts/suite_images.py [SUITE ...] [--force]

Images are as published, upright, and not mirrored: the ones that policies get are turned left to right
(docs/rendering.md). An image that is there is not drawn again without ``--force``. Prints the time and the size.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import vecenv

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "suites"
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
SIDE = 128


def draw(suite: str, task: int, path: Path) -> None:
    """The third-person camera's image of episode 0 of a task, as a JPEG."""
    from PIL import Image

    render = vecenv.RenderConfig(height=SIDE, width=SIDE)
    with vecenv.make(suite, task=task, episodes=[0], cameras=["agentview"], render=render, num_threads=1) as env:
        env.reset()
        image = env.observe_egocentric().images["agentview"][0]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image[:, ::-1]).save(path, quality=80, optimize=True)


def main() -> None:
    """Draw what is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", metavar="SUITE", default=SUITES)
    parser.add_argument("--force", action="store_true", help="draw images again that are there")
    options = parser.parse_args()
    for suite in options.suites:
        begin, drawn = time.monotonic(), 0
        for index in range(len(vecenv.list_tasks(suite))):
            path = FOLDER / suite / f"{index}.jpg"
            if options.force or not path.exists():
                draw(suite, index, path)
                drawn += 1
        size = sum(path.stat().st_size for path in (FOLDER / suite).glob("*.jpg"))
        print(f"{suite}: {drawn} drawn in {time.monotonic() - begin:.0f} s, {size / 1024:.0f} KiB in all", flush=True)


if __name__ == "__main__":
    main()
