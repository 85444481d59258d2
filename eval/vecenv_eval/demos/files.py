"""The demonstration files among paths and folders, and every demonstration in them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from vecenv.errors import InvalidInput
from vecenv_eval.demos.hdf5 import DemoError, Unreadable
from vecenv_eval.demos.read import read_demos
from vecenv_eval.demos.schema import SUFFIXES, Demo


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
    """Every demonstration of the files, and what cannot be used; see ``vecenv_eval.demos.read.read_demos``."""
    demos: list[Demo] = []
    problems: list[Unreadable] = []
    for path in files:
        try:
            good, bad = read_demos(path, suite=suite, task=task)
        except DemoError as error:
            good, bad = [], [Unreadable(path=path, name="", reason=str(error).removeprefix(f"{path}: "))]
        demos += good
        problems += bad
    return demos, problems
