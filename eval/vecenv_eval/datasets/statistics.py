"""Statistics of a dataset's features, as LeRobot stores them: of each episode, and of all of them together.

Values come in, [T, n] or [T], or the counts of an image's values; out go mappings of ``min``, ``max``, ``mean``,
``std``, ``count`` and quantiles ``q01`` to ``q99``. Images are scaled to [0, 1] and have one number a channel,
[3, 1, 1]. :func:`together` follows ``aggregate_feature_stats`` of ``lerobot.datasets.compute_stats``: low quantiles are
the lowest of any episode's, high ones the highest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

Statistics: TypeAlias = dict[str, np.ndarray]
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_LEVELS, _MEDIAN = 256, 0.5


def of_values(values: np.ndarray) -> Statistics:
    """Statistics of a feature over an episode's ticks, [T, n] or [T]; each is [n] or [1]."""
    table = np.asarray(values, np.float64).reshape(len(values), -1)
    found = {name: np.quantile(table, level, axis=0) for name, level in QUANTILES.items()}
    return {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        "count": np.array([len(table)]),
        **found,
    }


class ImageCounts:
    """How often each channel of a camera's images takes each of its 256 values: all that their statistics need."""

    def __init__(self) -> None:
        self.images, self._counts = 0, np.zeros((3, _LEVELS), np.int64)

    def add(self, image: np.ndarray) -> None:
        """Count an image, uint8 [H, W, 3]."""
        self.images += 1
        for channel in range(3):
            self._counts[channel] += np.bincount(image[..., channel].reshape(-1), minlength=_LEVELS)

    def statistics(self) -> Statistics:
        """Statistics of what was counted, scaled to [0, 1], [3, 1, 1]; ``count`` is the number of images."""
        levels, share = np.arange(_LEVELS) / (_LEVELS - 1), self._counts / self._counts.sum(axis=1, keepdims=True)
        seen, reached = self._counts > 0, np.cumsum(share, axis=1)
        mean = share @ levels
        found = {
            "min": levels[seen.argmax(axis=1)],
            "max": levels[_LEVELS - 1 - seen[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(share @ levels**2 - mean**2, 0.0)),
            **{name: levels[(reached >= level - 1e-12).argmax(axis=1)] for name, level in QUANTILES.items()},
        }
        return {name: value.reshape(3, 1, 1) for name, value in found.items()} | {"count": np.array([self.images])}


def together(parts: Sequence[Mapping[str, np.ndarray]]) -> Statistics:
    """Statistics of one feature over several episodes, from those of each."""
    counts = np.array([float(part["count"][0]) for part in parts])
    weights = (counts / counts.sum()).reshape(-1, *[1] * np.ndim(parts[0]["mean"]))
    means = np.stack([part["mean"] for part in parts])
    mean = (weights * means).sum(axis=0)
    variances = np.stack([part["std"] for part in parts]) ** 2 + (means - mean) ** 2
    found = {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt((weights * variances).sum(axis=0)),
        "count": np.array([int(counts.sum())]),
    }
    for name, level in QUANTILES.items():
        found[name] = (np.min if level <= _MEDIAN else np.max)([part[name] for part in parts], axis=0)
    return found
