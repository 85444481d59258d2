"""The animated picture docs/assets/wall.webp: 64 episodes side by side, each framed by its verdict.

    python scripts/wall_picture.py [--keep DIR]

Runs ``vecenv video`` (8 tasks of libero_goal with 8 episodes each, policy pick_place, at most 200 ticks) and keeps
every eighth frame, 512 pixels wide. Prints the time and the size.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

OUT = Path(__file__).resolve().parent.parent / "docs" / "assets" / "wall.webp"
COMMAND = (
    "video --suite libero_goal --tasks 0-7 --episodes 8 --policy pick_place --max-steps 200 "
    "--image-size 64 --lod fast --num-threads 1"
)
# Frames of the film a second (one a tick), and how many are skipped for each that is kept.
RATE, EVERY = 20, 8
WIDTH = 512


def frames(film: Path) -> list:
    """Every ``EVERY``-th frame of a film and its last one, as images of width ``WIDTH``."""
    import av

    with av.open(str(film)) as container:
        read = [frame.to_image() for frame in container.decode(video=0)]
    kept = read[::EVERY]
    if (len(read) - 1) % EVERY:
        kept.append(read[-1])
    return [image.resize((WIDTH, round(image.height * WIDTH / image.width))) for image in kept]


def main() -> None:
    """Record the film, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, help="folder for the film; an existing film.mp4 in it is used again")
    options = parser.parse_args()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        film = (options.keep or Path(scratch)) / "film.mp4"
        if not film.exists():
            program = [sys.executable, "-m", "vecenv", *COMMAND.split(), "--out", str(film)]
            subprocess.run(program, check=True)
        first, *rest = frames(film)
    durations = [1000 * EVERY // RATE // 2] * len(rest) + [3000]  # twice as fast as it was, the end stays
    first.save(OUT, save_all=True, append_images=rest, duration=durations, loop=0, quality=45, method=6)
    seconds, size = time.monotonic() - begin, OUT.stat().st_size / 1024
    print(f"{OUT.name}: {len(rest) + 1} frames, {size:.0f} KiB, {seconds:.0f} s")


if __name__ == "__main__":
    main()
