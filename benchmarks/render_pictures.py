"""Make ``docs/rendering/``: the same state as upstream draws it, with ``lod="exact"`` and with ``lod="fast"``.

Each picture has upstream, exact and fast from left to right, the third-person camera above and the wrist camera below.
Prints how alike they are: PSNR in dB and SSIM against upstream, the lower of the two cameras.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from common import ROOT
from pictures import psnr, ssim
from test_render_parity import CAMERAS, fixtures_of, pair

import vecenv
from vecenv.render.options import RenderConfig

SCENES = (("libero_object", 0), ("libero_spatial", 0), ("libero_goal", 0), ("libero_10", 0))
FOLDER = ROOT / "docs" / "rendering"


def pictures(suite: str, task: int) -> dict[str, dict[str, np.ndarray]]:
    """By side, then by camera: uint8 [256, 256, 3]. One upstream environment for both: it places fixtures at random."""
    with pair(suite, task, 0) as (peer, theirs, exact):
        options: Any = {"fixtures": fixtures_of(peer), "start": "raw", "settle_steps": 0}
        fast = vecenv.make(suite, task=task, episodes=[0], render=RenderConfig(lod="fast"), **options)
        fast.reset()
        seen = {"exact": exact.observe_egocentric(), "fast": fast.observe_egocentric()}
        found = {level: {name: egocentric.images[name][0] for name in CAMERAS} for level, egocentric in seen.items()}
        fast.close()
    return {"upstream": {name: theirs[key][::-1, ::-1] for name, key in CAMERAS.items()}, **found}


def write(path: Path, found: dict[str, dict[str, np.ndarray]]) -> None:
    """Three columns, two rows."""
    from PIL import Image

    columns = [np.concatenate([found[side][name] for name in CAMERAS]) for side in ("upstream", "exact", "fast")]
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.concatenate(columns, axis=1)).save(path, quality=85)


def main() -> None:
    for suite, task in SCENES:
        found = pictures(suite, task)
        path = FOLDER / f"{suite}_{task}.jpg"
        write(path, found)
        for level in ("exact", "fast"):
            pairs = [(found["upstream"][name], found[level][name]) for name in CAMERAS]
            print(
                f"{path.name} {level}: {min(psnr(*p) for p in pairs):.1f} dB, SSIM {min(ssim(*p) for p in pairs):.3f}"
            )


if __name__ == "__main__":
    main()
