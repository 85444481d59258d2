"""SIMPLER's files that lie beside the repository on some machines: recorded rollouts and an archive of assets."""

from __future__ import annotations

import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support.paths import REPOSITORY

SHARED = REPOSITORY.parent / "shared"
ARCHIVE = SHARED / "simpler_assets.tar.xz"
WIDOWX_ROLLOUTS, GOOGLE_ROLLOUTS = "widowx_carrot_on_plate", "google_robot_pick_coke_can"
SEEDS = (0, 1, 2)


def rollouts(task: str, key: str) -> np.ndarray:
    """One recorded array of the three rollouts of a task, stacked; skips the test where there is no recording."""
    path = SHARED / "simpler_refs" / f"ref_{task}.npz"
    if not path.is_file():
        pytest.skip("no recorded rollouts beside the repository")
    with np.load(path, allow_pickle=False) as archive:
        return np.stack([archive[f"s{seed}_{key}"] for seed in SEEDS])


def unpacked(folder: Path, wanted: Callable[[str], bool]) -> Path:
    """The files of the archive whose names are wanted, unpacked; skips the test where there is no archive."""
    if not ARCHIVE.is_file():
        pytest.skip("no archive of SIMPLER's assets beside the repository")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, [member for member in archive if wanted(member.name)], filter="data")
    return folder


def small_files(folder: Path) -> Path:
    """Robot descriptions and models' files, unpacked; skips the test where there is no archive."""
    return unpacked(folder, lambda name: name.endswith((".urdf", ".json")))


def physics_files(folder: Path) -> Path:
    """Everything but pictures and what is only drawn, unpacked; skips the test where there is no archive."""
    return unpacked(folder, lambda name: not name.endswith((".png", ".jpg", ".dae", ".glb")))
