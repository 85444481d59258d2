"""What runs recorded beside their rows, copied from the folders that are merged.

That is demonstrations, videos, policies' logs and datasets. Only what belongs to a row that is taken over is copied.
Files are replaced in one step: a copy is whole or not there.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from vecenv_eval.episodes import Episode
from vecenv_eval.merge.sources import Source
from vecenv_eval.store import ERRORS, ResultStore, log_path
from vecenv_eval.video.episodes import video_path


def copy_artifacts(store: ResultStore, episodes: Mapping[Episode, Source]) -> None:
    """Copy what was recorded of some episodes.

    Args:
        store: the merged folder.
        episodes: the folder that each episode is taken from.

    Raises:
        DemoError, DatasetError: a recording cannot be read.
        MissingDependency: there is a LeRobot dataset, and pyarrow is not installed.
    """
    sources = {source.folder: source for source in episodes.values()}
    for source in sources.values():
        own = [key for key, other in episodes.items() if other is source]
        _copy_demos(store, source.store, own)
        _copy_files(store.folder, source.folder, own, video_path)
        _copy_files(store.folder, source.folder, own, log_path)
        _copy_dataset(store.folder, source.folder, own)
        if (source.folder / ERRORS).is_file():
            _copy(source.folder / ERRORS, store.folder / f"errors-{source.id[:8]}.log")


def _copy_demos(store: ResultStore, source: ResultStore, keys: Sequence[Episode]) -> None:
    by_task: dict[tuple[str, int], list[int]] = {}
    for key in keys:
        if source.demos_path(key.suite, key.task).is_file():
            by_task.setdefault((key.suite, key.task), []).append(key.episode)
    if not by_task:
        return
    from vecenv_eval.demos.copy import copy_demos

    for key, episodes in by_task.items():
        copy_demos(source.demos_path(*key), store.demos_path(*key), episodes)


def _copy_files(target: Path, source: Path, keys: Sequence[Episode], path_of: Callable[[Path, Episode], Path]) -> None:
    """Copy the file of each episode, where it has one."""
    for key in keys:
        if (path := path_of(source, key)).is_file():
            _copy(path, path_of(target, key))


def _copy_dataset(target: Path, source: Path, keys: Sequence[Episode]) -> None:
    if not (source / "lerobot" / "meta" / "info.json").is_file():
        return
    from vecenv_eval.datasets.join import copy_episodes

    copy_episodes(source / "lerobot", target / "lerobot", frozenset(keys))


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(target.name + ".tmp")
    shutil.copyfile(source, temporary)
    temporary.replace(target)
