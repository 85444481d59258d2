"""Two runs of the same episodes compared: settling, verdicts, and how far joint positions differ. Metres throughout."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from fidelity.recordings import Recording
from fidelity.scenes import Ended

Row: TypeAlias = dict[str, Any]


def settling(recording: Recording, rows: np.ndarray, start: np.ndarray, end: Ended, names: Sequence[str]) -> Row:
    """How far objects move in 50 idle ticks, here and in native, and how far apart they end; metres."""
    objects, healthy = start.shape[1], end.healthy
    native = recording.settled[rows, :objects]
    moved = np.linalg.norm(end.objects - start, axis=-1)
    apart = np.linalg.norm(end.objects - native, axis=-1)
    worst = np.unravel_index(np.argmax(np.where(healthy[:, None], apart, -1)), apart.shape)
    row, thing = map(int, worst)
    return {
        "native": spread(np.linalg.norm(native - recording.start[rows, :objects], axis=-1)),
        "here": spread(moved[healthy]),
        "apart": spread(apart[healthy]),
        "objects": int(apart[healthy].size),
        "over 5 mm": int((apart[healthy] > 0.005).sum()),
        "worst": {**episode_of(recording, rows[row]), "object": names[thing]},
        "faults": dict(Counter(end.faults.values())),
    }


def verdicts(recording: Recording, rows: np.ndarray, end: Ended, names: Sequence[str]) -> Row:
    """Verdicts against native's; of those that differ, which object ends farthest from where native left it."""
    native = recording.success[rows]
    apart = np.linalg.norm(end.objects - recording.end[rows, : end.objects.shape[1]], axis=-1)
    differ = []
    for i in np.flatnonzero(native != end.success):
        differ.append(
            {
                **episode_of(recording, rows[i]),
                "native": bool(native[i]),
                "fault": end.faults.get(int(i), ""),
                **farthest(apart[i], names),
            }
        )
    return {
        "native": int(native.sum()),
        "here": int(end.success.sum()),
        "only native": int((native & ~end.success).sum()),
        "only here": int((~native & end.success).sum()),
        "faults": dict(Counter(end.faults.values())),
        "differ": differ,
    }


def farthest(apart: np.ndarray, names: Sequence[str]) -> Row:
    """Which object is farthest away, and how far; nothing where that is not known."""
    if not np.isfinite(apart).all():
        return {"object": "", "metres": None}
    return {"object": names[int(apart.argmax())], "metres": float(f"{apart.max():.3g}")}


def episode_of(recording: Recording, row: int) -> dict[str, int]:
    """Task and episode of a row."""
    return {"task": int(recording.task[row]), "episode": int(recording.episode[row])}


def spread_of_runs(one: Ended, other: Ended) -> Row:
    """Two runs of the same episodes: verdicts that differ, and max |dqpos| at the end of those that took as long."""
    same = (one.ticks == other.ticks) & one.healthy & other.healthy
    return {
        "episodes": len(same),
        "verdicts differ": int((one.success != other.success).sum()),
        "ticks differ": int((one.ticks != other.ticks).sum()),
        "dqpos": spread(np.abs(one.qpos - other.qpos)[same].max(axis=1, initial=0)),
    }


def spread(values: np.ndarray) -> list[float]:
    """Median, 90th percentile and largest; empty when there is nothing."""
    if not values.size:
        return []
    return [float(f"{x:.3g}") for x in (*np.quantile(values, [0.5, 0.9]), values.max())]
