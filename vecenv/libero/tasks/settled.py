"""Starts that have come to rest: every stored init state after ten idle control ticks under MuJoCo 3.3.0.

Stored init states precede settling, and MuJoCo 3.4 and later settle some of them elsewhere than the version that
LIBERO's published results used; what settled under 3.3.0 stays at rest under later versions. The arrays ship with the
package, one file a suite, and `scripts/settle_starts.py` recreates them. Fixtures stood at the centres of their
regions.
"""

from __future__ import annotations

import functools
import hashlib
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vecenv.errors import InvalidFile
from vecenv.libero.tasks.suites import TaskSpec

FOLDER = Path(__file__).parent / "settled_starts"
# Simulated time at which the starts were taken, seconds.
TIME = 0.5


class SettledStartsError(InvalidFile):
    """The settled starts of a task are missing, damaged, or belong to other init states; the message says which."""


@dataclass(frozen=True)
class SettledStarts:
    """Settled states of a task: ``qpos`` [50, nq] and ``qvel`` [50, nv]."""

    qpos: np.ndarray
    qvel: np.ndarray


def load(spec: TaskSpec) -> SettledStarts:
    """The settled starts of a task, as shipped.

    Raises:
        SettledStartsError: see there.
    """
    return read(FOLDER, spec)


def read(folder: Path, spec: TaskSpec) -> SettledStarts:
    """The settled starts of a task from another folder; errors as for ``load``."""
    path = folder / f"{spec.suite}.npz"
    arrays = _arrays(path)
    names = tuple(f"{part}_{spec.index}" for part in ("qpos", "qvel", "source"))
    if not all(name in arrays for name in names):
        raise SettledStartsError(f"{path}: holds no settled starts of {spec.suite} task {spec.index}")
    qpos, qvel, source = (arrays[name] for name in names)
    if bytes(source) != digest(spec):
        raise SettledStartsError(
            f"{path}: the starts of {spec.suite} task {spec.index} were settled from other init states than "
            f"{spec.init_states_path} holds; use start='raw', or settle them again with `make settled`"
        )
    return SettledStarts(qpos, qvel)


def digest(spec: TaskSpec) -> bytes:
    """Checksum of the init states that settled starts were made from."""
    return hashlib.sha256(np.ascontiguousarray(spec.init_states()).tobytes()).digest()


@functools.lru_cache(maxsize=32)
def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError as error:
        raise SettledStartsError(f"{path}: no such file; use start='raw', or run `make settled`") from error
    except (ValueError, OSError, zipfile.BadZipFile, EOFError) as error:
        raise SettledStartsError(f"{path}: damaged: {error}") from error
    for array in arrays.values():
        array.flags.writeable = False
    return arrays


def write(folder: Path, suite: str, specs: Sequence[TaskSpec], starts: Sequence[tuple[np.ndarray, np.ndarray]]) -> Path:
    """Write the settled starts of a suite: for each task qpos [50, nq] and qvel [50, nv]. Returns the file."""
    arrays: dict[str, np.ndarray] = {}
    for spec, (qpos, qvel) in zip(specs, starts, strict=True):
        arrays[f"qpos_{spec.index}"], arrays[f"qvel_{spec.index}"] = qpos, qvel
        arrays[f"source_{spec.index}"] = np.frombuffer(digest(spec), np.uint8)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{suite}.npz"
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    return path
