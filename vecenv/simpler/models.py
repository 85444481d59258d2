"""Sizes and densities of SIMPLER's objects, read from the JSON files of the asset tree."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from vecenv.errors import InvalidFile
from vecenv.simpler.task_spec import DATA


class ModelDataError(InvalidFile):
    """A file with sizes and densities is missing or not what it should be; the message names it."""


@dataclass(frozen=True, kw_only=True)
class ModelInfo:
    """An object's size and weight.

    Attributes:
        name: its name, also of its folder.
        bbox_min, bbox_max: corners of its bounding box, metres, in its own frame, [3].
        density: kg/m³.
    """

    name: str
    bbox_min: np.ndarray
    bbox_max: np.ndarray
    density: float

    @property
    def size(self) -> np.ndarray:
        """Extents of the bounding box, metres, [3]."""
        return self.bbox_max - self.bbox_min


def model_folder(name: str) -> PurePosixPath:
    """Folder of an object's meshes in the asset tree."""
    return DATA / "custom/models" / name


def read_models(path: Path) -> dict[str, ModelInfo]:
    """Sizes and densities of the objects in one of SIMPLER's JSON files.

    Raises:
        ModelDataError: the file is missing, damaged, or lists an object in another size than its own (SIMPLER has none,
            and layouts rely on it).
    """
    try:
        entries = json.loads(path.read_bytes())
        return {name: _model(name, entry) for name, entry in entries.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelDataError(f"{path}: no sizes and densities of objects: {type(error).__name__}: {error}") from error


def _model(name: str, entry: Mapping[str, Any]) -> ModelInfo:
    low, high = (np.array(entry["bbox"][key], np.float64) for key in ("min", "max"))
    if low.shape != (3,) or high.shape != (3,):
        raise ValueError(f"the bounding box of {name!r} is not two points")
    if list(entry.get("scales", [1.0])) != [1.0]:
        raise ValueError(f"{name!r} has scales {entry['scales']}; only 1.0 is supported")
    return ModelInfo(name=name, bbox_min=low, bbox_max=high, density=float(entry.get("density", 1000)))
