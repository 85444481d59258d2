"""Make ``docs/rendering/``: the same state as upstream draws it under MuJoCo 3.3.0, and as vecenv does.

    python benchmarks/render_images.py [--peer .venv-upstream/bin/python]

Each image has upstream, ``lod="exact"``, ``lod="fast"`` and, with the colours of the installed MuJoCo, ``"current"``
from left to right, the third-person camera above and the wrist camera below. Prints how alike they are: PSNR in dB and
SSIM against upstream, the lower of the two cameras.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from common import ROOT
from images import REFERENCES, RENDER, add_peer, write_references
from support.images import Reference, agreement, ssim

SCENES = ("libero_object-0", "libero_spatial-0", "libero_goal-0", "libero_10-0")
FOLDER = ROOT / "docs" / "rendering"
KINDS = ("exact", "fast", "current")


def write(path: Path, columns: list[np.ndarray]) -> None:
    """Images of both cameras [2, H, W, 3] as columns."""
    from PIL import Image

    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.concatenate([np.concatenate(list(pair)) for pair in columns], axis=1)).save(path, quality=85)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_peer(parser)
    options = parser.parse_args()
    write_references(options.peer, REFERENCES, SCENES)
    for scene in SCENES:
        reference = Reference.load(REFERENCES, scene)
        theirs = reference.images[0]
        drawn = {kind: reference.drawn(RENDER[kind], [0])[0] for kind in KINDS}
        path = FOLDER / f"{scene.replace('-', '_')}.jpg"
        write(path, [theirs, *drawn.values()])
        for kind, ours in drawn.items():
            alike = min(ssim(a, b) for a, b in zip(ours, theirs, strict=True))
            print(f"{path.name} {kind}: {agreement(ours, theirs).min():.1f} dB, SSIM {alike:.3f}", flush=True)


if __name__ == "__main__":
    main()
