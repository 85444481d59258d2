"""SIMPLER's files that lie beside the repository on some machines: recorded rollouts and an archive of assets."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest

SHARED = Path(__file__).parents[2] / "shared"
_ARCHIVE = SHARED / "simpler_assets.tar.xz"
WIDOWX_ROLLOUTS, GOOGLE_ROLLOUTS = "widowx_carrot_on_plate", "google_robot_pick_coke_can"
SEEDS = (0, 1, 2)


def rollouts(task: str, key: str) -> np.ndarray:
    """One recorded array of the three rollouts of a task, stacked; skips the test where there is no recording."""
    path = SHARED / "simpler_refs" / f"ref_{task}.npz"
    if not path.is_file():
        pytest.skip("no recorded rollouts beside the repository")
    with np.load(path, allow_pickle=False) as archive:
        return np.stack([archive[f"s{seed}_{key}"] for seed in SEEDS])


def small_files(folder: Path) -> Path:
    """Robot descriptions and models' files of the archive, unpacked; skips the test where there is no archive."""
    if not _ARCHIVE.is_file():
        pytest.skip("no archive of SIMPLER's assets beside the repository")
    with tarfile.open(_ARCHIVE) as archive:
        chosen = [member for member in archive if member.name.endswith((".urdf", ".json"))]
        archive.extractall(folder, chosen, filter="data")
    return folder
