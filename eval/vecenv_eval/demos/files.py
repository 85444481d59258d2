"""The demonstration files among paths and folders, and every demonstration in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import vecenv
from vecenv.errors import InvalidInput
from vecenv.placement import episode_indices, parse_tasks
from vecenv_eval.demos.hdf5 import DemoError, Unreadable
from vecenv_eval.demos.read import read_demos
from vecenv_eval.demos.schema import SUFFIXES, Demo

# Actions of all files that are replayed together; they take 56 bytes each.
MOST_TICKS = 10_000_000


class ReplayError(InvalidInput):
    """There is nothing to replay; the message names what was searched."""


def find_files(paths: Iterable[Path]) -> list[Path]:
    """The files among the paths, and the HDF5 files in the folders among them, at any depth, sorted.

    Raises:
        ReplayError: a path does not exist, or a folder holds no HDF5 file.
    """
    files: list[Path] = []
    for path in paths:
        found = sorted(p for p in path.rglob("*") if p.suffix in SUFFIXES) if path.is_dir() else [path]
        if not path.exists() or not found:
            raise ReplayError(f"{path}: {'no HDF5 file in this folder' if path.is_dir() else 'no such file'}")
        files += found
    return list(dict.fromkeys(files))


def read_files(
    files: Iterable[Path], *, suite: str | None = None, task: int | None = None
) -> tuple[list[Demo], list[Unreadable]]:
    """Every demonstration of the files, and what cannot be used; see ``vecenv_eval.demos.read.read_demos``.

    One file that cannot be used costs itself alone; so does each one after `MOST_TICKS` actions.
    """
    demos: list[Demo] = []
    problems: list[Unreadable] = []
    for path in files:
        try:
            if sum(map(len, demos)) >= MOST_TICKS:
                raise DemoError(
                    f"{path}: the files before it have more than {MOST_TICKS:,} actions: replay fewer at once"
                )
            good, bad = read_demos(path, suite=suite, task=task)
        except DemoError as error:
            good, bad = [], [Unreadable(path=path, name="", reason=str(error).removeprefix(f"{path}: "))]
        demos += good
        problems += bad
    return demos, problems


def choose(demos: Sequence[Demo], tasks: str | None = None, episodes: str | Sequence[int] | None = None) -> list[Demo]:
    """Some of the demonstrations.

    Args:
        demos: what the files hold.
        tasks: those of these tasks, as for ``vecenv eval``; None for all.
        episodes: those of these episodes (of LIBERO's own files, with these numbers), likewise.

    Raises:
        SpecError: the text cannot be parsed, or names tasks that the suite or episodes that the files do not have.
        ReplayError: nothing is left.
    """
    chosen = list(demos)
    if tasks is not None:
        wanted = {suite: _tasks(tasks, suite) for suite in {demo.suite for demo in chosen}}
        chosen = [demo for demo in chosen if demo.task in wanted[demo.suite]]
    if episodes is not None and chosen:
        numbers = episode_indices(episodes, 1 + max(demo.number for demo in chosen))
        chosen = [demo for demo in chosen if demo.number in numbers]
    if demos and not chosen:
        asked = {"--tasks": tasks, "--episodes": episodes}
        text = " ".join(f"{name} {value}" for name, value in asked.items() if value is not None)
        raise ReplayError(f"{text}: none of the {len(demos)} demonstrations is one of these")
    return chosen


def _tasks(spec: str, suite: str) -> tuple[int, ...]:
    names = [task.name for task in vecenv.list_tasks(suite)]
    return parse_tasks(spec, len(names), names)
